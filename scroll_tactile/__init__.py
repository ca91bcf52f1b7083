"""A robot's memory of how things feel.

learner = TactileLearner.open("memory", sensor=sensors.BIOTAC)
learner.observe("felt", stream)          # stream: (T, n) readings
learner.predict(stream).material         # "felt"; or known=False: never felt this
"""

import importlib
import typing

if typing.TYPE_CHECKING:
    from scroll_tactile import errors, sensors
    from scroll_tactile.embeddings.frames import Frames
    from scroll_tactile.embeddings.joined import Joined
    from scroll_tactile.embeddings.kernels import Kernels
    from scroll_tactile.embeddings.maps import Maps
    from scroll_tactile.embeddings.modules import ModuleEmbedding
    from scroll_tactile.embeddings.protocol import Capabilities, Embedding
    from scroll_tactile.embeddings.vision import Vision
    from scroll_tactile.learner import TactileLearner
    from scroll_tactile.results import Composition, Constituent, Observation, Prediction, Receipt
    from scroll_tactile.sensors import Sensor
    from scroll_tactile.settings import Settings
    from scroll_tactile.signals.copies import Augmented
    from scroll_tactile.signals.stream import Stream

__all__ = [
    "Augmented",
    "Capabilities",
    "Composition",
    "Constituent",
    "Embedding",
    "Frames",
    "Joined",
    "Kernels",
    "Maps",
    "ModuleEmbedding",
    "Observation",
    "Prediction",
    "Receipt",
    "Sensor",
    "Settings",
    "Stream",
    "TactileLearner",
    "Vision",
    "__version__",
    "errors",
    "sensors",
]

__version__ = "0.11.0"

# Imported on first use: a sensor's name should not wait for the libraries behind a learner.
_MODULES = {
    "Augmented": "signals.copies",
    "Capabilities": "embeddings.protocol",
    "Composition": "results",
    "Constituent": "results",
    "Embedding": "embeddings.protocol",
    "Frames": "embeddings.frames",
    "Joined": "embeddings.joined",
    "Kernels": "embeddings.kernels",
    "Maps": "embeddings.maps",
    "ModuleEmbedding": "embeddings.modules",
    "Observation": "results",
    "Prediction": "results",
    "Receipt": "results",
    "Sensor": "sensors",
    "Settings": "settings",
    "Stream": "signals.stream",
    "TactileLearner": "learner",
    "Vision": "embeddings.vision",
}


def __getattr__(name: str) -> typing.Any:
    if name in ("errors", "sensors"):
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
