"""What a simulation is made of: touches and memories that cost nothing, and all that must be seen of a memory."""

from __future__ import annotations

import functools
import gc
import warnings
from typing import Any

import numpy as np
from touches import SmallSample

import scroll_tactile.memory.state
import scroll_tactile.persistence.ledger
from faults import learners, simulation_disk
from faults.learners import KIT
from faults.model import LISTED, State
from scroll_tactile import Sensor, TactileLearner
from scroll_tactile.embeddings.protocol import Capabilities
from scroll_tactile.errors import FactWarning
from scroll_tactile.prediction.features import FeatureExtractor

CHECKPOINT_EVERY = 7
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


@functools.cache
def stream(touch: int) -> Any:
    """The readings of a touch."""
    return np.random.default_rng(touch).integers(0, 64, size=(8 + touch % 3, 1)) / 64


@functools.cache
def key_of(touch: int) -> bytes:
    """The content hash of a touch."""
    return learners.fed(()).stream(stream(touch)).key


def prepare() -> None:
    """Have everything small, quick and in the hands of the schedule, and what a touch comes to worked out once."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 100)
    warnings.simplefilter("ignore", FactWarning)
    simulation_disk.prepare()
    KIT.touches, KIT.stream, KIT.materials = tuple(range(9)), stream, ("a", "b", "ü")
    KIT.noted = lambda touch: ({}, {"slip": f"{touch % 2}"} if touch % 3 == 0 else {})
    KIT.embeddings = {name: Tiny(name) for name in ("own", "other")}
    KIT.settings = {"sensor": PAD, "exemplars": 1, "kept_touches": 3, "embedding": KIT.embeddings["own"]}
    scroll_tactile.memory.state.TouchSample = SmallSample  # type: ignore[misc]
    scroll_tactile.persistence.ledger.CHECKPOINT_EVERY = CHECKPOINT_EVERY
    worked, known = FeatureExtractor.codes, dict[Any, Any]()

    def codes(self: FeatureExtractor, image: Any) -> Any:
        about = getattr(self.embedding, "fingerprint", ""), image.shape, image.tobytes()
        if about not in known:
            known[about] = worked(self, image)
        return known[about]

    FeatureExtractor.codes = codes  # type: ignore[method-assign]


def seen(learner: TactileLearner) -> dict[str, Any]:
    """What can be seen of a memory in a folder, row by row, too."""
    listed = [(each.sequence, each.material, each.key, each.state) for each in learner.observations()]
    return learners.seen(learner) | {"listed": listed}


def expected(state: State) -> dict[str, Any]:
    """What must be seen of it."""
    listed = []
    for sequence, row in enumerate(state.rows, 1):
        if row[0] in LISTED and sequence not in state.unlisted:
            fixed = sequence <= state.compacted or row[0] == "member"
            kept = "retracted" if sequence in state.retracted else "compacted" if fixed else "kept"
            listed.append((sequence, row[1], key_of(row[2]), kept))
    return learners.expected(state) | {"listed": listed}
