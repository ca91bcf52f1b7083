"""Opening a memory without knowing what it was made with."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings import Capabilities, Embedding, Frames, Kernels
from scroll_tactile.errors import InputError, MismatchError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.sensors import Sensor
from store import NotAStoreError, Store

__all__ = ["open_for_upkeep", "open_memory"]


class Unneeded:
    """Stands for the embedding that a memory was made with, where nothing is to be embedded."""

    def __init__(self, made: dict[str, Any], reading: list[Any] | None) -> None:
        self.name: str = made["name"]
        self.dimension: int = made["dimension"]
        self.bound: float = made["bound"]
        self.fingerprint: str = made["fingerprint"]
        partial, judged = reading or [True, "all"]
        self.capabilities = Capabilities(partial_windows=partial, judged_scales=judged)

    def embed(self, image: npt.NDArray[np.float32]) -> npt.NDArray[np.floating]:
        """Raise MismatchError: there is nothing to embed with."""
        raise MismatchError(
            f"the memory was opened without its embedding {self.name!r}, to look after it only: open it with "
            "TactileLearner.open(path, embedding=...)"
        )


def open_for_upkeep(path: Path, *, mode: Literal["write", "read"] = "write") -> TactileLearner:
    """Open a memory of any embedding for all that needs none: taking back, merging, compacting, writing out.

    Raises what `TactileLearner.open` raises.
    """
    with Store.open(path, mode="read") as store:
        identity = cast(dict[str, Any], store.identity)
    if "embedding" not in identity:
        raise MismatchError(f"{path} is a store, but holds no memory of touch")
    embedding: Embedding = Unneeded(identity["embedding"], identity.get("reading"))
    return TactileLearner.open(path, embedding=embedding, mode=mode)


def open_memory(
    path: Path, *, sensor: Sensor | None = None, mode: Literal["write", "read"] = "write"
) -> TactileLearner:
    """Open a memory, or make one where there is nothing and a sensor is given.

    A memory of kernels is opened with as many of them as it was made with, one of frames with `Frames()`; of another
    embedding, seed or resting image, with the default one, which the learner then refuses by name.

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
    embedding: Embedding | None = usual
    if isinstance(made, dict) and made.get("name") == Frames.name:
        embedding = None  # the usual one of a camera
    elif isinstance(made, dict) and made.get("name") == usual.name and isinstance(made.get("dimension"), int):
        embedding = Kernels(dimension=made["dimension"])
    return TactileLearner.open(path, sensor=sensor, embedding=embedding, mode=mode)
