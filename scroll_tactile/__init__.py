"""A robot's memory of how things feel.

learner = TactileLearner.open("memory", sensor=sensors.BIOTAC)
learner.observe("felt", stream)          # stream: (T, n) readings
learner.predict(stream).material         # "felt"; or known=False: never felt this
"""

from scroll_tactile import errors, sensors
from scroll_tactile.embeddings import (
    Embedding,
    Frames,
    Joined,
    Kernels,
    Maps,
    ModuleEmbedding,
    Robust,
    Vision,
)
from scroll_tactile.learner import TactileLearner
from scroll_tactile.results import Composition, Constituent, Prediction, Receipt
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.copies import Augmented
from scroll_tactile.signals.stream import Stream
from scroll_tactile.testing import check_embedding

__all__ = [
    "Augmented",
    "Composition",
    "Constituent",
    "Embedding",
    "Frames",
    "Joined",
    "Kernels",
    "Maps",
    "ModuleEmbedding",
    "Prediction",
    "Receipt",
    "Robust",
    "Sensor",
    "Stream",
    "TactileLearner",
    "Vision",
    "check_embedding",
    "errors",
    "sensors",
]
