"""A memory: exact statistics, sampled touches, exemplars and f*, and how a store keeps them."""

from __future__ import annotations

import ctypes
import logging
import sys
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import MismatchError
from scroll_tactile.memory.descriptions import Description
from scroll_tactile.memory.exemplars import Exemplar, ExemplarSample
from scroll_tactile.memory.rows import Codes, unpack_codes, unspanned
from scroll_tactile.memory.tuned import Tuned
from scroll_tactile.signals.windows import NOISE, Scale, WindowPlan
from scroll_tactile.statistics.sample import SampledTouch, TouchSample
from scroll_tactile.statistics.statistics import Statistics
from store import CompactedError, DamageError, Head, Record, Store

__all__ = [
    "DESCRIBE",
    "MEMBER",
    "MERGE",
    "OBSERVE",
    "READINGS",
    "RETRACT",
    "Memory",
    "apply_description",
    "give_back_scratch",
]

logger = logging.getLogger(__name__)

# The kinds of journal rows.
OBSERVE = "observe"  # a stream was observed; its codes and, where exemplars are kept, its readings are the arrays
RETRACT = "retract"  # observations were retracted; the attribute "sequences" holds [first, last] pairs
MERGE = "merge"  # a compacted memory came in as a whole; the arrays are those of its base
MEMBER = "felt"  # a stream that such a memory had observed: its name and hash alone ("felt" is the word on disk)
DESCRIBE = "describe"  # what a material is made of, in the attribute "constituents"; null removes the description
KINDS = [OBSERVE, RETRACT, MERGE, MEMBER, DESCRIBE]
READINGS = "readings"  # the array of a row that holds the raw stream
ATTEMPTS = 20  # of a reader, while a writer changes the store


class Memory:
    """Everything that was learned, as far as a number of rows of the journal.

    dimension: d, of the features. plan: which windows of a touch are read. exemplars: streams in the buffer, or 0;
    kept as `capacity`.

    What was learned:

    - statistics: exact sums by scale.
    - sample: the touches that readouts are calibrated on.
    - exemplars: the candidates for the buffer, which keep their readings; None with a capacity of 0.
    - descriptions: material → what it is made of; the material need not have been observed.
    - tuned: f*; None before a fine-tune, or after one of the observations behind it was retracted.
    - tuned_upto: the last sequence that f* was trained on.

    Where it stands in the journal:

    - sequence: the last row that it holds.
    - base: the last row whose codes were compacted; 0 before any compaction.
    - retracted: the retracted sequences after `base`.
    - excluded: the retracted sequences up to `base`, which the base was made without.
    - retractions: how many observations were retracted since the memory was loaded.
    - generation, saved: the generation that it was loaded from, and the last row in that; None and 0 without one.
    """

    def __init__(self, dimension: int, plan: WindowPlan, exemplars: int = 0) -> None:
        self.plan = plan
        self.capacity = exemplars
        self.statistics = Statistics(dimension, plan.scales)
        self.sample = TouchSample()
        self.exemplars = ExemplarSample(exemplars) if exemplars else None
        self.tuned: Tuned | None = None
        self.tuned_upto = 0
        self.retracted: set[int] = set()
        self.excluded: set[int] = set()
        self.base = 0
        self.generation: int | None = None
        self.saved = 0
        self.sequence = 0
        self.retractions = 0
        self.descriptions: dict[str, Description] = {}
        self._stale = False

    def add(
        self,
        material: str,
        key: bytes,
        columns: int,
        codes: Codes,
        sequence: int,
        readings: npt.NDArray[np.float32] | None = None,
    ) -> None:
        """Add an observation: a touch of so many columns, its codes by scale, and its readings for the exemplars.

        Raises CapacityError before anything is added.
        """
        self.statistics.add(material, codes, columns)
        if self.sample.wants(material, key):
            self.sample.add(material, key, self._touch(columns, codes))
        if self.exemplars is not None and readings is not None and self.exemplars.wants(material, key):
            self.exemplars.add(Exemplar.of(material, key, readings, codes))
        self.sequence = sequence

    def replay(self, record: Record, store: Store) -> None:
        """Apply a journal row; nothing is embedded again.

        Call `refill` after the last row. Raises MismatchError for a row of a kind that this version does not know.
        """
        apply_description(self.descriptions, record)
        if record.kind == OBSERVE:
            codes, readings = unpack_codes(record.arrays), record.arrays.get(READINGS)
            self.add(record.label, record.key, _columns(record), codes, record.sequence, readings)
        elif record.kind == RETRACT:
            for sequence in unspanned(record.attributes["sequences"]):
                if sequence > self.base:
                    self.retract(store.record(sequence))
                elif sequence not in self.excluded:  # a repair made the base: `compact` would have left it out
                    logger.warning(
                        "%s: observation %d was retracted by row %d, but still counts: its features were lost to "
                        "damage. Only a copy from before the damage can leave it out",
                        store.path,
                        sequence,
                        record.sequence,
                    )
        elif record.kind == MERGE:
            self._join(record.arrays, record.attributes)
        elif record.kind not in (MEMBER, DESCRIBE):
            raise MismatchError(
                f"row {record.sequence} of the journal is of kind {record.kind!r}; this version knows only "
                f"{KINDS}. Open the memory with the version that wrote it, or a newer one"
            )
        self.sequence = record.sequence

    def describe(self, material: str, constituents: Any) -> None:
        """Keep what a material is made of, in place of its description before; None removes the description."""
        _describe(self.descriptions, material, constituents)

    def retract(self, record: Record) -> None:
        """Subtract an observation from the sums; call `refill` afterwards for the sample and the exemplars."""
        material, key = record.label, record.key
        self.statistics.remove(material, unpack_codes(record.arrays), _columns(record))
        self.retracted.add(record.sequence)
        self.retractions += 1
        if self.sample.holds(material, key) or (self.exemplars and self.exemplars.holds(material, key)):
            self._stale = True
        if record.sequence <= self.tuned_upto:
            self.tuned = None

    def retractable(self, store: Store, material: str | None = None) -> list[Head]:
        """The observations whose codes the journal still holds, of one material or all, in order."""
        rows = store.heads(self.base, kind=OBSERVE, label=material)
        return [head for head in rows if head.sequence not in self.retracted]

    def put_back(self, record: Record) -> None:
        """Undo `retract` in the sums, exactly; the caller restores sample, exemplars and f*."""
        self.statistics.add(record.label, unpack_codes(record.arrays), _columns(record))
        self.retracted.discard(record.sequence)
        self._stale = False

    def refill(self, store: Store) -> None:
        """Choose sample and exemplars again without what was retracted; does nothing where they held none of it."""
        if not self._stale:
            return
        touches = {(material, key): touch for material, key, touch in self.sample}
        kept = {(exemplar.material, exemplar.key): exemplar for exemplar in self.exemplars or ()}
        fresh = self._base_samples(store)
        # Rows that a writer appended since this memory was read are left for the next `load`.
        for head in store.heads(self.base, kind=MERGE):
            if head.sequence <= self.sequence:
                record = store.record(head.sequence)
                fresh._join(record.arrays, record.attributes)
        heads = [head for head in self.retractable(store) if head.sequence <= self.sequence]
        streams = [(head.label, head.key, head.sequence) for head in heads]

        def touch(material: str, key: bytes, sequence: int) -> SampledTouch:
            if (found := touches.get((material, key))) is not None:
                return found
            record = store.record(sequence)
            return self._touch(_columns(record), unpack_codes(record.arrays))

        def exemplar(material: str, key: bytes, sequence: int) -> Exemplar:
            return kept.get((material, key)) or _exemplar(store.record(sequence))

        fresh.sample.refill(streams, touch)
        self.sample = fresh.sample
        if fresh.exemplars is not None:
            raw = [(head.label, head.key, head.sequence) for head in heads if head.attributes.get("nbytes")]
            fresh.exemplars.refill(raw, exemplar)
            self.exemplars = fresh.exemplars
        self._stale = False

    def _empty(self) -> Memory:
        """Another memory of the same making."""
        return Memory(self.statistics.dimension, self.plan, self.capacity)

    def _base_samples(self, store: Store) -> Memory:
        """A memory with the sample and the exemplars of the base; empty ones without a base."""
        fresh = self._empty()
        if store.compacted != self.base:
            raise CompactedError(f"{store.path} was compacted since it was read: read it again")
        try:
            base = store.base()
        except DamageError as damage:
            # The statistics are whole without it; a memory that did not open would lose them too.
            logger.warning(
                "%s; no other touch can take the place of a retracted one: repair the memory (scroll-tactile memory "
                "repair)",
                damage,
            )
            heads = (head for head in store.heads() if head.sequence <= self.base and head.kind in (OBSERVE, MEMBER))
            compacted = {(head.label, head.key) for head in heads}
            fresh.sample.update((name, key, touch) for name, key, touch in self.sample if (name, key) in compacted)
            if fresh.exemplars is not None:
                for exemplar in self.exemplars or ():
                    if (exemplar.material, exemplar.key) in compacted:
                        fresh.exemplars.add(exemplar)
            return fresh
        if base is not None:
            fresh._take(base.arrays, base.attributes)
        return fresh

    def _touch(self, columns: int, codes: Codes) -> SampledTouch:
        stages = self.plan.scored_stages(columns)
        if all(scale in codes for scale in NOISE):  # the first noisy copy, at a stage after all others
            unreached: list[dict[Scale, list[int]]] = [{}] * (len(self.plan.milestones()) - len(stages))
            stages += [*unreached, {scale: [0] for scale in NOISE}]
        return SampledTouch.of(stages, codes)

    def _join(self, arrays: Mapping[str, npt.NDArray[Any]], attributes: Any) -> None:
        """Add another memory of the same making: the arrays and attributes of one of its generations."""
        other = self._empty()
        other._take(arrays, attributes)
        self.statistics = self.statistics + other.statistics
        self.sample.update(other.sample)
        if self.exemplars is not None and other.exemplars is not None:
            self.exemplars.update(other.exemplars)

    def to_arrays(self, base_at: int | None = None) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Arrays and attributes of a generation; base_at: of a base, whose rows can no longer be retracted.

        "pool" (the sample) and "withdrawn" (`retracted`) are the names that memories on disk have always had.
        """
        arrays, names = self.statistics.to_arrays()
        sampled, materials = self.sample.to_arrays()
        attributes: dict[str, Any] = {
            "dimension": self.statistics.dimension,
            "scales": list(map(int, self.statistics.scales)),
            "materials": names,
            "pool": materials,
            "capacity": [self.capacity, None],  # version 0.1 had a limit in bytes beside it
            "tuned_upto": self.tuned_upto,
            "descriptions": dict(sorted(self.descriptions.items())),
        }
        arrays |= sampled
        # The rows after a base are replayed, and say themselves which of them were retracted.
        retracted = sorted(self.retracted if base_at is None else ())
        excluded = sorted(row for row in self.retracted | self.excluded if base_at is not None and row <= base_at)
        arrays["withdrawn"], arrays["excluded"] = (np.array(rows, dtype=np.int64) for rows in (retracted, excluded))
        for name, part in (("exemplars", self.exemplars), ("tuned", self.tuned)):
            if part is not None:
                own, attributes[name] = part.to_arrays()
                arrays |= own
        return arrays, attributes

    @classmethod
    def load(cls, store: Store, dimension: int, plan: WindowPlan, exemplars: int = 0) -> Memory:
        """The memory that a store holds: its newest generation, then the journal's rows after it."""
        for _ in range(ATTEMPTS - 1):
            newest = store.newest
            try:
                memory = cls._loaded(store, dimension, plan, exemplars)
            except CompactedError:  # a writer compacted it between two reads
                continue
            # A generation that came between the reads may hold an f* from before the rows that were read.
            if store.newest == newest:
                return memory
        return cls._loaded(store, dimension, plan, exemplars)

    @classmethod
    def _loaded(cls, store: Store, dimension: int, plan: WindowPlan, exemplars: int) -> Memory:
        memory = cls(dimension, plan, exemplars)
        memory.base = store.compacted
        # Without a sound generation the base raises what is lost; without a base the journal has every row.
        generation = store.latest() or store.base()
        if generation is not None:
            memory._take(generation.arrays, generation.attributes)
            memory.sequence = memory.saved = generation.upto
            memory.generation = generation.number
        replayed = 0
        for record in store.records(after=memory.sequence):
            memory.replay(record, store)
            replayed += 1
        memory.refill(store)
        logger.info(
            "%s: generation %s, %d rows of the journal replayed, %d compacted",
            store.path,
            memory.generation,
            replayed,
            memory.base,
        )
        return memory

    def until(self, store: Store, upto: int) -> Memory:
        """The memory of the observations up to `upto` that are not retracted: what a base at `upto` holds."""
        memory = self._empty()
        memory.base, memory.sequence = self.base, self.base
        if (base := store.base()) is not None:
            memory._take(base.arrays, base.attributes)
        for record in store.records(after=self.base):
            if record.sequence > upto:
                break
            if record.kind == RETRACT:
                apply_description(memory.descriptions, record)
            elif record.sequence not in self.retracted:
                memory.replay(record, store)
        memory.sequence, memory.retracted = upto, set(self.retracted)
        return memory

    def filled(self, arrays: Mapping[str, npt.NDArray[Any]], attributes: Any, sequence: int) -> Memory:
        """This memory, empty before, filled with what `to_arrays` gave; the arrays are taken over."""
        self._take(arrays, attributes)
        self.sequence = sequence
        return self

    def _take(self, arrays: Mapping[str, npt.NDArray[Any]], attributes: Any) -> None:
        names, scales = attributes["materials"], self.plan.scales
        self.statistics = Statistics.from_arrays(self.statistics.dimension, scales, arrays, names)
        self.sample = TouchSample.from_arrays(arrays, attributes["pool"])
        if self.exemplars is not None and "exemplars" in attributes:
            self.exemplars = ExemplarSample.from_arrays(arrays, attributes["exemplars"], self.capacity)
        self.retracted, self.excluded = (set(arrays[name].tolist()) for name in ("withdrawn", "excluded"))
        self.descriptions = dict(attributes.get("descriptions", {}))  # made before there were any
        if "tuned" in attributes:
            self.tuned, self.tuned_upto = Tuned.from_arrays(arrays, attributes["tuned"]), attributes["tuned_upto"]


def apply_description(descriptions: dict[str, Description], row: Head | Record) -> None:
    """Apply a journal row to descriptions; a forgotten material loses its description."""
    if row.kind in (DESCRIBE, RETRACT):  # a retraction has no constituents, and names a material only in `forget`
        _describe(descriptions, row.label, row.attributes.get("constituents"))


def _describe(descriptions: dict[str, Description], material: str, constituents: Any) -> None:
    if constituents is None:
        descriptions.pop(material, None)
    else:
        descriptions[material] = dict(constituents)


def _columns(record: Record) -> int:
    return cast(int, record.attributes["columns"])


def _exemplar(record: Record) -> Exemplar:
    return Exemplar.of(record.label, record.key, record.arrays[READINGS], unpack_codes(record.arrays))


def give_back_scratch() -> None:
    """Return freed memory to the system where the C library can: fitting and saving leave 40 MB of it."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
