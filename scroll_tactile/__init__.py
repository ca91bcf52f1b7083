"""A robot's memory of how things feel.

learner = TactileLearner.open("memory", sensor=sensors.BIOTAC)
learner.observe("felt", stream)          # stream: (T, n) readings
learner.predict(stream).material         # "felt"; or known=False: never felt this
"""

import importlib
import typing

if typing.TYPE_CHECKING:
    from scroll_tactile import errors, recordings, sensors
    from scroll_tactile.clients.firmware.c_files import write_firmware
    from scroll_tactile.clients.firmware.exported_judge import ExportedAnswer, ExportedJudge
    from scroll_tactile.clients.learning.fleet import FleetReport, learn
    from scroll_tactile.clients.learning.sources import SourceOptions
    from scroll_tactile.embeddings.frames import Frames
    from scroll_tactile.embeddings.joined import Joined
    from scroll_tactile.embeddings.kernels import Kernels
    from scroll_tactile.embeddings.modules import ModuleEmbedding
    from scroll_tactile.embeddings.protocol import Capabilities, Embedding
    from scroll_tactile.embeddings.vision import Vision
    from scroll_tactile.learner import TactileLearner
    from scroll_tactile.live.answers import LiveReport, LiveState, LiveTouch
    from scroll_tactile.live.session import LiveSession
    from scroll_tactile.quantities import Quantity
    from scroll_tactile.results import (
        Adaptation,
        Candidates,
        Compacted,
        Composition,
        Constituent,
        Estimate,
        Health,
        Merged,
        Observation,
        Prediction,
        Receipt,
    )
    from scroll_tactile.sensors import Sensor
    from scroll_tactile.settings import Settings
    from scroll_tactile.signals.stream import Stream
    from scroll_tactile.simulation.scene import Scene
    from scroll_tactile.testing.embedding_checks import check_embedding
    from scroll_tactile.testing.learner_checks import check_learner

__all__ = [
    "Adaptation",
    "Candidates",
    "Capabilities",
    "Compacted",
    "Composition",
    "Constituent",
    "Embedding",
    "Estimate",
    "ExportedAnswer",
    "ExportedJudge",
    "FleetReport",
    "Frames",
    "Health",
    "Joined",
    "Kernels",
    "LiveReport",
    "LiveSession",
    "LiveState",
    "LiveTouch",
    "Merged",
    "ModuleEmbedding",
    "Observation",
    "Prediction",
    "Quantity",
    "Receipt",
    "Scene",
    "Sensor",
    "Settings",
    "SourceOptions",
    "Stream",
    "TactileLearner",
    "Vision",
    "__version__",
    "check_embedding",
    "check_learner",
    "errors",
    "learn",
    "recordings",
    "sensors",
    "write_firmware",
]

__version__ = "0.20.0"

# Imported on first use: a sensor's name should not wait for the libraries behind a learner.
_MODULES = {
    "Adaptation": "results",
    "Candidates": "results",
    "Capabilities": "embeddings.protocol",
    "Compacted": "results",
    "Composition": "results",
    "Constituent": "results",
    "Embedding": "embeddings.protocol",
    "Estimate": "results",
    "Health": "results",
    "ExportedAnswer": "clients.firmware.exported_judge",
    "ExportedJudge": "clients.firmware.exported_judge",
    "FleetReport": "clients.learning.fleet",
    "Frames": "embeddings.frames",
    "Joined": "embeddings.joined",
    "Kernels": "embeddings.kernels",
    "LiveReport": "live.answers",
    "LiveSession": "live.session",
    "LiveState": "live.answers",
    "LiveTouch": "live.answers",
    "Merged": "results",
    "ModuleEmbedding": "embeddings.modules",
    "Observation": "results",
    "Prediction": "results",
    "Quantity": "quantities",
    "Receipt": "results",
    "Scene": "simulation.scene",
    "Sensor": "sensors",
    "Settings": "settings",
    "SourceOptions": "clients.learning.sources",
    "Stream": "signals.stream",
    "TactileLearner": "learner",
    "Vision": "embeddings.vision",
    "check_embedding": "testing.embedding_checks",
    "check_learner": "testing.learner_checks",
    "learn": "clients.learning.fleet",
    "write_firmware": "clients.firmware.c_files",
}


def __getattr__(name: str) -> typing.Any:
    if name in ("errors", "recordings", "sensors"):
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
