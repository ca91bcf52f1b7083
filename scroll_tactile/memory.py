"""A memory: exact statistics, pool, exemplars and f*, and how they are kept in a store."""

from __future__ import annotations

import ctypes
import logging
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import MismatchError
from scroll_tactile.exemplars import Exemplar, ExemplarPool
from scroll_tactile.ridge.pool import Pool, Touch
from scroll_tactile.ridge.statistics import Statistics, fold_of
from scroll_tactile.tuned import Tuned
from scroll_tactile.windows import Reading
from store import Record, Store

__all__ = ["OBSERVE", "READINGS", "Capacity", "Memory", "give_back_scratch", "pack_codes", "unpack_codes"]

logger = logging.getLogger(__name__)

OBSERVE = "observe"  # the kind of a journal row
READINGS = "readings"  # the array of a row that keeps a stream raw
Codes = dict[int, npt.NDArray[np.int32]]


@dataclass(frozen=True)
class Capacity:
    """Of the exemplar buffer: in streams, or in bytes of raw readings; 0 streams: nothing is kept raw."""

    streams: int | None = 400
    nbytes: int | None = None

    def pool(self) -> ExemplarPool | None:
        """An empty pool of this capacity; None where nothing is to be kept."""
        return None if self.streams == 0 else ExemplarPool(self.streams, capacity_bytes=self.nbytes)


class Memory:
    """What was felt: statistics at every scale, the pool of touches that readouts are tried on, and exemplars.

    dimension: d. reading: which windows are read of a touch, and judge. capacity: of the exemplar buffer.
    tuned: f*, of the last fine-tune; None before one.
    """

    def __init__(self, dimension: int, reading: Reading, capacity: Capacity | None = None) -> None:
        self.reading = reading
        self.capacity = capacity or Capacity()
        self.statistics = Statistics(dimension, reading.widths)
        self.pool = Pool()
        self.exemplars = self.capacity.pool()
        self.tuned: Tuned | None = None
        self.sequence = 0

    def wants_readings(self, material: str, key: bytes, nbytes: int) -> bool:
        """Whether a stream's readings, of so many bytes, are to be kept as an exemplar's."""
        return self.exemplars is not None and self.exemplars.wants(material, key, nbytes)

    def add(
        self,
        material: str,
        key: bytes,
        columns: int,
        codes: Codes,
        sequence: int,
        readings: npt.NDArray[np.float32] | None = None,
    ) -> None:
        """Add an observation: a touch of so many columns, its codes by scale, its readings where they are wanted.

        Raises CapacityError before anything is added.
        """
        self.statistics.add(material, fold_of(key), codes, columns)
        if self.pool.wants(material, key):
            scored_at = [self.reading.scored(columns, length) for length in self.reading.stages(columns)]
            self.pool.add(material, key, Touch.of(scored_at, codes))
        if readings is not None and self.wants_readings(material, key, readings.nbytes):
            assert self.exemplars is not None
            self.exemplars.add(Exemplar.of(material, key, readings, codes))
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
        codes, readings = unpack_codes(record.arrays), record.arrays.get(READINGS)
        self.add(record.label, record.key, columns, codes, record.sequence, readings)

    def to_arrays(self) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Arrays and attributes of a generation."""
        arrays, names = self.statistics.to_arrays()
        pooled, materials = self.pool.to_arrays()
        attributes: dict[str, Any] = {
            "dimension": self.statistics.dimension,
            "scales": list(self.statistics.scales),
            "materials": names,
            "pool": materials,
            "capacity": [self.capacity.streams, self.capacity.nbytes],
        }
        arrays |= pooled
        for name, part in (("exemplars", self.exemplars), ("tuned", self.tuned)):
            if part is not None:
                its_arrays, attributes[name] = part.to_arrays()
                arrays |= its_arrays
        return arrays, attributes

    def chunks(self) -> dict[str, int]:
        """Rows in a chunk, of the arrays that are read piece by piece: one exemplar of the usual length is one read."""
        lengths = [] if self.exemplars is None else [len(one.readings) for one in self.exemplars]
        return {"exemplar-readings": int(np.median(lengths))} if lengths else {}

    @classmethod
    def load(cls, store: Store, dimension: int, reading: Reading, capacity: Capacity | None = None) -> Memory:
        """The memory that a store holds: its newest generation, then the journal's rows after it."""
        memory = cls(dimension, reading, capacity)
        generation = store.latest()
        if generation is not None:
            memory._take(generation.arrays, cast(dict[str, Any], generation.attributes))
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

    def _take(self, arrays: Mapping[str, npt.NDArray[Any]], attributes: Mapping[str, Any]) -> None:
        names, widths = attributes["materials"], self.reading.widths
        self.statistics = Statistics.from_arrays(self.statistics.dimension, widths, arrays, names)
        self.pool = Pool.from_arrays(arrays, attributes["pool"])
        if self.exemplars is not None and "exemplars" in attributes:
            self.exemplars = ExemplarPool.from_arrays(
                arrays, attributes["exemplars"], self.capacity.streams, capacity_bytes=self.capacity.nbytes
            )
        if "tuned" in attributes:
            self.tuned = Tuned.from_arrays(arrays, attributes["tuned"])


def pack_codes(codes: Mapping[int, npt.NDArray[np.int32]]) -> dict[str, npt.NDArray[Any]]:
    """Codes by scale as the arrays of a journal row: their distinct values, and places among them.

    Windows hold few distinct values (a proportion of 22 positions has 23), so a place is a byte and packs well.
    A network's features hardly repeat: they are kept as they are.
    """
    arrays: dict[str, npt.NDArray[Any]] = {}
    for scale, rows in codes.items():
        values, places = np.unique(rows, return_inverse=True)
        if 4 * len(values) > rows.size and rows.size > 2**8:
            arrays[f"codes-{scale}"] = rows
            continue
        kind = np.uint8 if len(values) <= 2**8 else np.uint16 if len(values) <= 2**16 else np.uint32
        arrays[f"values-{scale}"] = values
        # Feature by feature: one feature's values in neighbouring windows are alike.
        arrays[f"places-{scale}"] = np.ascontiguousarray(places.reshape(rows.shape).T.astype(kind))
    return arrays


def unpack_codes(arrays: Mapping[str, npt.NDArray[Any]]) -> Codes:
    """The codes that `pack_codes` packed."""
    plain = {int(name.removeprefix("codes-")): rows for name, rows in arrays.items() if name.startswith("codes-")}
    scales = [int(name.removeprefix("values-")) for name in arrays if name.startswith("values-")]
    packed = {
        scale: np.ascontiguousarray(arrays[f"values-{scale}"][arrays[f"places-{scale}"].T]).astype(np.int32, copy=False)
        for scale in scales
    }
    return dict(sorted((plain | packed).items()))


def give_back_scratch() -> None:
    """Return freed memory to the system where the C library can: fitting and saving leave 40 MB of it."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
