"""A memory: exact statistics with their pool, and how both are kept in a store."""

from __future__ import annotations

import ctypes
import logging
import sys
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import MismatchError
from scroll_tactile.ridge.pool import Pool, Touch
from scroll_tactile.ridge.statistics import Statistics, fold_of
from scroll_tactile.windows import extent, scored, stages
from store import Record, Store

__all__ = ["OBSERVE", "Memory", "give_back_scratch", "pack_codes", "unpack_codes"]

logger = logging.getLogger(__name__)

OBSERVE = "observe"  # the kind of a journal row
Codes = dict[int, npt.NDArray[np.int32]]


class Memory:
    """What was felt: statistics at every scale, and the pool of touches that readouts are tried on."""

    def __init__(self, dimension: int, scales: Sequence[int]) -> None:
        self.statistics = Statistics(dimension, scales)
        self.pool = Pool()
        self.sequence = 0

    def add(self, material: str, key: bytes, columns: int, codes: Codes, sequence: int) -> None:
        """Add an observation: a touch of so many columns, its codes by scale.

        Raises CapacityError before anything is added.
        """
        self.statistics.add(material, fold_of(key), codes, columns)
        if self.pool.wants(material, key):
            read = extent(columns, self.statistics.scales)
            scored_at = [scored(read, length) for length in stages(columns, self.statistics.scales)]
            self.pool.add(material, key, Touch.of(scored_at, codes))
        self.sequence = sequence

    def replay(self, record: Record) -> None:
        """Add the observation of a journal row, without embedding anything again.

        Raises MismatchError for a row of a kind that this version does not know.
        """
        if record.kind != OBSERVE:
            raise MismatchError(
                f"row {record.sequence} of the journal is of kind {record.kind!r}; this version knows {OBSERVE!r} "
                "only. Open the memory with the version that wrote it, or a newer one"
            )
        columns = cast(int, record.attributes["columns"])
        self.add(record.label, record.key, columns, unpack_codes(record.arrays), record.sequence)

    def to_arrays(self) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Arrays and attributes of a generation."""
        arrays, names = self.statistics.to_arrays()
        pooled, materials = self.pool.to_arrays()
        attributes = {
            "dimension": self.statistics.dimension,
            "scales": list(self.statistics.scales),
            "materials": names,
            "pool": materials,
        }
        return arrays | pooled, attributes

    @classmethod
    def load(cls, store: Store, dimension: int, scales: Sequence[int]) -> Memory:
        """The memory that a store holds: its newest generation, then the journal's rows after it."""
        memory = cls(dimension, scales)
        generation = store.latest()
        if generation is not None:
            names = cast(list[str], generation.attributes["materials"])
            pool = cast(list[str], generation.attributes["pool"])
            memory.statistics = Statistics.from_arrays(dimension, scales, generation.arrays, names)
            memory.pool = Pool.from_arrays(generation.arrays, pool)
            memory.sequence = generation.upto
        replayed = 0
        for record in store.records(after=memory.sequence):
            memory.replay(record)
            replayed += 1
        logger.info(
            "%s: generation %s, %d observations replayed",
            store.path,
            generation and generation.number,
            replayed,
        )
        return memory


def pack_codes(codes: Mapping[int, npt.NDArray[np.int32]]) -> dict[str, npt.NDArray[Any]]:
    """Codes by scale as the arrays of a journal row: their distinct values, and places among them.

    Windows hold few distinct values (a proportion of 22 positions has 23), so a place is a byte and packs well.
    """
    arrays: dict[str, npt.NDArray[Any]] = {}
    for scale, rows in codes.items():
        values, places = np.unique(rows, return_inverse=True)
        kind = np.uint8 if len(values) <= 2**8 else np.uint16 if len(values) <= 2**16 else np.uint32
        arrays[f"values-{scale}"] = values
        # Feature by feature: one feature's values in neighbouring windows are alike.
        arrays[f"places-{scale}"] = np.ascontiguousarray(places.reshape(rows.shape).T.astype(kind))
    return arrays


def unpack_codes(arrays: Mapping[str, npt.NDArray[Any]]) -> Codes:
    """The codes that `pack_codes` packed."""
    scales = [int(name.removeprefix("values-")) for name in arrays if name.startswith("values-")]
    return {
        scale: np.ascontiguousarray(arrays[f"values-{scale}"][arrays[f"places-{scale}"].T]).astype(np.int32, copy=False)
        for scale in sorted(scales)
    }


def give_back_scratch() -> None:
    """Return freed memory to the system where the C library can: fitting and saving leave 40 MB of it."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
