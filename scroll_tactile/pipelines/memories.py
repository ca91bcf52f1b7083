"""Opening a memory without knowing what it was made with."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from scroll_tactile.embeddings import Kernels
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.sensors import Sensor
from store import NotAStoreError, Store

__all__ = ["open_memory"]


def open_memory(
    path: Path, *, sensor: Sensor | None = None, mode: Literal["write", "read"] = "write"
) -> TactileLearner:
    """Open a memory, or make one where there is nothing and a sensor is given.

    A memory of kernels is opened with as many of them as it was made with; of another embedding, or another seed,
    with the default one, which the learner then refuses by name.

    Raises InputError for a new memory without a sensor, and what `TactileLearner.open` raises.
    """
    try:
        with Store.open(path, mode="read") as store:
            made = store.identity.get("embedding", {})
    except NotAStoreError as error:
        if path.is_file() or mode == "read":
            raise
        if sensor is None:
            raise InputError(f"{error}. To make a new memory, say whose readings these are, with --sensor") from error
        return TactileLearner.open(path, sensor=sensor, mode=mode)
    usual = Kernels()
    embedding = usual
    if isinstance(made, dict) and made.get("name") == usual.name and isinstance(made.get("dimension"), int):
        embedding = Kernels(dimension=made["dimension"])
    return TactileLearner.open(path, sensor=sensor, embedding=embedding, mode=mode)
