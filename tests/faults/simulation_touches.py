"""The touches of a simulation, and what memories of them are made with: all is tiny, and worked out once."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from touches import SmallSample

import scroll_tactile.memory.state
import scroll_tactile.persistence.open_memory
from faults import simulation_model as model
from faults.simulation_model import Expected
from scroll_tactile import Sensor, TactileLearner
from scroll_tactile.embeddings.protocol import Capabilities
from scroll_tactile.prediction.features import FeatureExtractor

MATERIALS = ("a", "b", "ü")
TOUCHES = 9
SAID = (None, (("silk", 1.0),), (("silk", 0.25), ("wool", 0.75)), (("soft", True),))
SNAPSHOT_EVERY = 7
PAD = Sensor(name="tiny", channels=1, rate=50.0, low=0.0, high=1.0, unit="N", duration=0.16)


class Tiny:
    """An embedding that costs nothing."""

    capabilities = Capabilities(partial_windows=False)
    name, dimension, bound = "tiny", 3, 1.0

    def __init__(self, fingerprint: str) -> None:
        self.fingerprint = fingerprint

    def embed(self, image: Any) -> Any:
        """Three numbers."""
        turned = -1.0 if self.fingerprint == "other" else 1.0
        return turned * np.array([image.mean(), image[:, -1].mean(), image.max()], np.float32)


EMBEDDINGS = {name: Tiny(name) for name in ("own", "other")}
SETTINGS: dict[str, Any] = {"sensor": PAD, "exemplars": 1, "kept_touches": 3}


@functools.cache
def stream(touch: int) -> Any:
    """The readings of a touch."""
    return np.random.default_rng(touch).integers(0, 64, size=(8 + touch % 3, 1)) / 64


def fed(pairs: tuple[model.Pair, ...], embedding: str) -> TactileLearner:
    """A memory without a path of these touches."""
    learner = TactileLearner(embedding=EMBEDDINGS[embedding], **SETTINGS)
    for material, touch in pairs:
        learner.observe(material, stream(touch), again=True)
    return learner


def prepare() -> None:
    """Have what a touch comes to be worked out once."""
    scroll_tactile.memory.state.TouchSample = SmallSample  # type: ignore[misc]
    scroll_tactile.persistence.open_memory.SNAPSHOT_EVERY = SNAPSHOT_EVERY
    worked, known = FeatureExtractor.codes, dict[Any, Any]()

    def codes(self: FeatureExtractor, image: Any, key: bytes) -> Any:
        about = getattr(self._embedding, "fingerprint", ""), key
        if about not in known:
            known[about] = worked(self, image, key)
        return known[about]

    FeatureExtractor.codes = codes  # type: ignore[method-assign]


@functools.cache
def key_of(touch: int) -> bytes:
    """The content hash of a touch."""
    return TactileLearner(embedding=EMBEDDINGS["own"], **SETTINGS).stream(stream(touch)).key


EXPECTED = Expected(fed, key_of)
