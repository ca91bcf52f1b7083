"""A memory carried over to another embedding, from the readings in its journal."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.protocol import Embedding, window_plan
from scroll_tactile.memory.identity import Identity, default_kept_touches
from scroll_tactile.memory.kept import Keeping, usual_kept
from scroll_tactile.memory.rows import Codes
from scroll_tactile.memory.state import Memory
from scroll_tactile.persistence.reembed import Reembedding, finish_interrupted
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.signals.stream import Stream
from scroll_tactile.validation.gate import MemoryStore
from store import Store

__all__ = ["reembed_memory", "reembedding"]


def reembed_memory(
    path: str | os.PathLike[str],
    embedding: Embedding | None = None,
    *,
    progress: Callable[[str, int, int], object] | None = None,
) -> Path:
    """As `TactileLearner.reembed`, with the memory in a folder, also where its own embedding is not at hand."""
    finish_interrupted(Path(path))
    with MemoryStore.open(path) as store:
        chosen = Identity.read(store).own_embedding(store.path) if embedding is None else embedding
        carried = reembedding(store, chosen)
        try:
            carried.copy(progress or (lambda what, done, of: None))
            return carried.put_in_place()
        finally:
            carried.close()


def reembedding(store: Store, embedding: Embedding) -> Reembedding:
    """What carries the memory in a store over to another embedding."""
    made = Identity.read(store)
    usual = usual_kept(made.sensor) if made.views else 0
    # As many as were asked for, none too; where nobody asked, as many as are usual with the embedding that it gets.
    kept_touches = default_kept_touches(made.sensor, embedding) if made.kept_touches == usual else made.kept_touches
    identity = Identity.of(made.sensor, embedding, made.exemplars, made.augmentation, kept_touches)
    keeping = Keeping(made.sensor, kept_touches)
    plan = window_plan(made.sensor, embedding)
    extractor = FeatureExtractor(made.sensor, embedding, plan, made.augmentation)

    def encode(readings: npt.NDArray[np.float32]) -> tuple[int, Codes]:
        touch = Stream(made.sensor, readings)
        image = extractor.image(touch)
        return image.shape[1], extractor.codes(image, touch.key)

    empty = Memory(embedding.dimension, plan, made.exemplars, lambda readings: encode(readings)[1], keeping)
    return Reembedding(store, identity, empty, encode, bare=identity.embedding.bare)
