"""A memory carried over to another embedding, from the readings in its journal."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from scroll_tactile_store import Store

from scroll_tactile.embeddings.protocol import Embedding
from scroll_tactile.memory.identity import Identity
from scroll_tactile.persistence.reembed import Reembedding
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.predictor import Predictor
from scroll_tactile.recipe import Recipe, RecipeRequest, default_kept_touches
from scroll_tactile.settings import Settings
from scroll_tactile.signals.stream import Stream
from scroll_tactile.validation.gate import MemoryStore, finish_interrupted

__all__ = ["embed_again", "reembed_memory"]


def reembed_memory(
    path: str | os.PathLike[str],
    embedding: Embedding | None = None,
    *,
    progress: Callable[[str, int, int], object] | None = None,
) -> Path:
    """As `TactileLearner.reembed`, with the memory in a folder, also where its own embedding is not at hand."""
    finish_interrupted(Path(path))
    with MemoryStore.open(path) as store:
        carried = _reembedding(store, embedding)
        try:
            carried.copy(progress or (lambda what, done, of: None))
            return carried.put_in_place()
        finally:
            carried.close()


def embed_again(
    predictor: Predictor, embedding: Embedding | None, progress: Callable[[str, int, int], object]
) -> tuple[Path, Predictor]:
    """As `TactileLearner.reembed`; also returns the predictor of the new memory."""
    ledger = predictor.ledger
    with ledger.lock:  # not in the midst of another thread's batch
        store = ledger.require_store("be embedded again")
        ledger.require_writing()
    carried = _reembedding(store, embedding)
    try:
        carried.copy(progress)
        with ledger.lock:
            ledger.require_writing()
            carried.copy(progress)
            ledger.saves = False  # nothing more is written to the old one, which a full disk could stop half-way
            predictor.close()
            before = carried.put_in_place()
            predictor.replace()
            kept = {"exemplars": None, "kept_touches": None}  # those of the new one
            settings = predictor.recipe.settings.model_copy(update=kept)
            return before, Predictor.open(store.path, RecipeRequest(None, carried.recipe.embedding, settings))
    finally:
        carried.close()


def _reembedding(store: Store, embedding: Embedding | None) -> Reembedding:
    """The re-embedding of the memory in a store. embedding: None for its own, made again."""
    made = Identity.read(store)
    chosen = made.own_embedding(store.path) if embedding is None else embedding
    # As many kept touches as the memory was made with, also none; if that was the default, the default of the new
    # recipe.
    default = made.kept_touches == default_kept_touches(made.sensor, views=bool(made.views))
    kept = Settings(exemplars=made.exemplars, kept_touches=None if default else made.kept_touches)
    recipe = Recipe.of(made.sensor, chosen, kept)
    extractor = FeatureExtractor(recipe.sensor, recipe.embedding, recipe.plan)
    return Reembedding(store, recipe, lambda readings: extractor.learned(Stream(recipe.sensor, readings)))
