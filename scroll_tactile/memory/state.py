"""A memory: exact statistics, sampled touches, exemplars and the tuned model, and how a store keeps them."""

from __future__ import annotations

import ctypes
import logging
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import takewhile
from typing import Any, Protocol, cast

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import UnknownMaterialError
from scroll_tactile.memory.descriptions import Description
from scroll_tactile.memory.exemplars import Exemplar, ExemplarSample, Source, exemplars_to_arrays
from scroll_tactile.memory.kept import Keeping, KeptTouches
from scroll_tactile.memory.rows import (
    DESCRIBE,
    MEMBER,
    MERGE,
    OBSERVE,
    RETRACT,
    Added,
    Arrays,
    Codes,
    Encode,
    Readings,
    only_readings,
    retracted_by,
    row_codes,
    unpack_readings,
    unspanned,
)
from scroll_tactile.memory.tuned import Tuned
from scroll_tactile.readouts.likelihood import LevelArray
from scroll_tactile.signals.windows import WindowPlan
from scroll_tactile.statistics.sample import SampledTouch, TouchSample
from scroll_tactile.statistics.statistics import Statistics
from store import Checkpoint, CompactedError, DamageError, Head, Record, Store
from store.late import LateArray

__all__ = ["Memory", "apply_description", "give_back_scratch"]

logger = logging.getLogger(__name__)

LATE_ROWS, LATE_SECOND = "sample-rows", "second-"  # arrays, most of a checkpoint, that no prediction reads
ATTEMPTS = 20  # of a reader, while a writer changes the store


class Rows(Protocol):
    """Where rows of observations can be read: a store, or a partial."""

    def record(self, sequence: int) -> Record:
        """A row with its arrays."""
        ...


class Memory:
    """Everything that was learned, as far as a number of rows of the journal.

    dimension: d, of the features. plan: which windows of a touch are read. exemplars: streams in the buffer, or 0;
    kept as `capacity`. encode: readings → the rows of codes that the touch adds, by scale, for rows of the journal that
    have readings alone; None where all rows have codes. keeping: which touches are kept for recall; None keeps none.

    What was learned:

    - statistics: exact sums by scale.
    - sample: the touches that readouts are calibrated on.
    - kept: touches for recall; None without `keeping`.
    - exemplars: the candidates for the buffer, and where their readings lie; None with a capacity of 0.
    - descriptions: material → what it is made of; the material need not have been observed.
    - tuned: the tuned model; None before a fine-tune, or after one of the observations behind it was retracted.
    - tuned_upto: the last sequence that the tuned model was trained on.

    Where it stands in the journal:

    - sequence: the last row that it holds.
    - base: the last row whose arrays were compacted; 0 before any compaction.
    - retracted: the retracted sequences after `base`.
    - excluded: the retracted sequences up to `base`, which the base was made without.
    - retractions: how many observations were retracted since the memory was loaded.
    - checkpoint, saved: the checkpoint that it was loaded from, and the last row in that; None and 0 without one.
    """

    def __init__(
        self,
        dimension: int,
        plan: WindowPlan,
        exemplars: int = 0,
        encode: Encode | None = None,
        keeping: Keeping | None = None,
    ) -> None:
        self.plan = plan
        self.keeping = keeping
        self.capacity = exemplars
        self.encode = encode
        self.statistics = Statistics(dimension, plan.scales)
        self._sample: TouchSample | Callable[[], TouchSample] = TouchSample()
        self.kept = KeptTouches(keeping) if keeping is not None and keeping.capacity else None
        self.exemplars = ExemplarSample(exemplars) if exemplars else None
        self.tuned: Tuned | None = None
        self.tuned_upto = 0
        self.retracted: set[int] = set()
        self.excluded: set[int] = set()
        self.base = 0
        self.checkpoint: int | None = None
        self.saved = 0
        self.sequence = 0
        self.retractions = 0
        self.descriptions: dict[str, Description] = {}
        self._stale = False

    @property
    def sample(self) -> TouchSample:
        """The touches that readouts are calibrated on. Raises DamageError where they are read only now."""
        if not isinstance(self._sample, TouchSample):
            self._sample = self._sample()
        return self._sample

    @sample.setter
    def sample(self, sample: TouchSample) -> None:
        self._sample = sample

    def add(
        self,
        material: str,
        key: bytes,
        columns: int,
        codes: Codes,
        sequence: int,
        source: Source | None,
        readings: Readings | None,
    ) -> None:
        """Add an observation without a journal: a touch of so many columns, its rows of codes by scale, and its number.

        source: of its readings, for the exemplars. readings: for the kept touches. None: they are not kept. What a
        journal has is added by `replay`. Raises CapacityError before anything is added.
        """
        self.statistics.add(material, codes, columns)
        if self.sample.wants(material, key) or self.sample.holds(material, key):
            self.sample.add(material, key, self._touch(columns, codes))
        if self.kept is not None:
            self.kept.take(material, key, readings)
        if self.exemplars is not None and source is not None:
            self.exemplars.add(material, key, source)
        self.sequence = sequence

    def undo(self, material: str, key: bytes, columns: int) -> Callable[[], None]:
        """What takes the next `add` back, of this touch, however much of it was done; it can be called again."""
        chosen = [sample for sample in (self.sample, self.kept, self.exemplars) if sample is not None]
        parts = [
            sample.undo(material, key)
            for sample in chosen
            if sample.wants(material, key) or sample.holds(material, key)
        ]
        parts.append(self.statistics.undo(material, columns))
        sequence = self.sequence

        def undo() -> None:
            for part in parts:
                part()
            self.sequence = sequence

        return undo

    def replay(self, record: Record, store: Store, codes: Codes | None = None) -> list[Added] | None:
        """Apply a journal row; return the touches that it added or retracted, None where it brought a whole memory.

        Every row becomes a part of the memory here, whether it was just written, read again or embedded anew.
        codes: of an observation, where they are known; None to make them. Call `refill` after the last row. Raises
        CapacityError before anything is added.
        """
        changed: list[Added] | None = []
        if record.kind == OBSERVE:
            columns = cast(int, record.attributes["columns"])
            codes = self.codes(record)[1] if codes is None else codes
            source = record.sequence if only_readings(record.arrays) else None
            self.add(record.label, record.key, columns, codes, record.sequence, source, self._to_keep(record))
            changed = [(record.label, codes, 1)]
        elif record.kind == RETRACT:
            gone = unspanned(record.attributes["sequences"])
            changed = [self._retracted_by(record, sequence, store) for sequence in gone if sequence > self.base]
            for sequence in sorted({sequence for sequence in gone if sequence <= self.base} - self.excluded):
                logger.warning(  # a repair made the base: `compact` would have left it out
                    "%s: observation %d was retracted by row %d, but still counts: its features were lost to "
                    "damage. Only a copy from before the damage can leave it out",
                    store.path,
                    sequence,
                    record.sequence,
                )
        elif record.kind == MERGE:
            self._join(record)
            changed = None
        else:
            assert record.kind in (MEMBER, DESCRIBE), "the gate lets no other row through"
        apply_description(self.descriptions, record)
        self.sequence = record.sequence
        return changed

    def _retracted_by(self, record: Record, sequence: int, store: Store) -> Added:
        """Retract an observation as a journal row says. Raises DamageError where there is none that could be."""
        observed = store.record(sequence)
        try:
            if observed.kind == OBSERVE and sequence not in self.retracted:
                return self.retract(observed)
        except UnknownMaterialError as error:  # the sums are without it
            logger.debug("%s", error)
        raise DamageError(
            f"row {record.sequence} of {store.path} retracts row {sequence}, which is no observation, or not in the "
            "sums any more: it is damaged, or was made by another program (scroll-tactile memory check)",
            path=store.path,
            sequence=record.sequence,
        )

    def describe(self, material: str, constituents: Any) -> None:
        """Keep what a material is made of, in place of its description before; None removes the description."""
        _describe(self.descriptions, material, constituents)

    def retract(self, record: Record) -> Added:
        """Subtract an observation from the sums; call `refill` afterwards for the sample and the exemplars."""
        material, key = record.label, record.key
        columns, codes = self.codes(record)
        self.statistics.remove(material, codes, columns)
        self.retracted.add(record.sequence)
        self.retractions += 1
        if any(
            sample.holds(material, key) for sample in (self.sample, self.kept, self.exemplars) if sample is not None
        ):
            self._stale = True
        if record.sequence <= self.tuned_upto:
            self.tuned = None
        return material, codes, -1

    def retractable(self, store: Store, material: str | None = None) -> list[Head]:
        """The observations whose arrays the journal still holds, of one material or all, in order; no damaged ones."""
        rows = store.heads(self.base, kind=OBSERVE, label=material)
        return [head for head in rows if head.sequence not in self.retracted]

    def put_back(self, record: Record) -> None:
        """Undo `retract` in the sums, exactly; the caller restores sample, exemplars and the tuned model."""
        columns, codes = self.codes(record)
        self.statistics.add(record.label, codes, columns)
        self.retracted.discard(record.sequence)
        self._stale = False

    def refill(self, store: Store) -> None:
        """Choose sample and exemplars again without what was retracted; does nothing where they held none of it."""
        if self._stale:
            # Rows that a writer appended since this memory was read are left for the next `load`.
            chosen = self._chosen(store, self.sequence)
            self.sample, self.kept, self.exemplars = chosen.sample, chosen.kept, chosen.exemplars
            self._stale = False

    def _chosen(self, store: Store, upto: int) -> Memory:
        """A memory with the sample and the exemplars of the observations up to a row that are not retracted."""
        fresh, heads = self._base_samples(store), self._behind_base(store, upto)
        for head in heads:
            if head.kind == MERGE:
                fresh._join(store.record(head.sequence))
        observed = [head for head in heads if head.kind == OBSERVE and head.sequence not in self.retracted]
        fresh.choose(observed, store, self)
        return fresh

    def _behind_base(self, store: Store, upto: int) -> list[Head]:
        """The rows up to one from which samples are chosen.

        A damaged row may be of any kind: without it other touches would be chosen, and be saved as if they were the
        right ones. So DamageError is raised; only who reads, and saves nothing, gets what is left, with a warning.
        """
        try:
            return list(takewhile(lambda head: head.sequence <= upto, store.heads(self.base)))
        except DamageError as damage:
            if store.mode == "write":
                raise DamageError(
                    f"{damage}. Without it the samples of touches cannot be chosen again after a retraction: repair "
                    "the memory (scroll-tactile memory repair)",
                    path=damage.path,
                    sequence=damage.sequence,
                ) from damage
            logger.warning("%s; samples of touches are chosen without it, others than there were", damage)
        left = (head for kind in (MERGE, OBSERVE) for head in store.heads(self.base, kind=kind))
        return [head for head in left if head.sequence <= upto]

    def choose(self, heads: Sequence[Head], source: Rows, made: Memory) -> None:
        """Choose samples and exemplars among what they hold and some observations, whose rows `source` has.

        made: a memory whose samples have some of them ready.
        """
        touches = {(material, key): touch for material, key, touch in made.sample}

        def touch(material: str, key: bytes, sequence: int) -> SampledTouch:
            own = touches.get((material, key))
            return self._touch(*self.codes(source.record(sequence))) if own is None else replace(own, copies=1)

        self.sample.refill(((head.label, head.key, head.sequence) for head in heads), touch)
        read = [head for head in heads if head.attributes.get("nbytes")]  # whose rows hold readings
        if self.kept is not None:
            mine, keeping = {(material, key): own for material, key, own in made.kept or ()}, self.kept.made

            def levels(material: str, key: bytes, sequence: int) -> LevelArray:
                if (own := mine.get((material, key))) is not None:
                    return own
                return keeping.levels(cast(Readings, unpack_readings(source.record(sequence).arrays)))

            self.kept.refill(((head.label, head.key, head.sequence) for head in read), levels)
        if self.exemplars is not None:
            self.exemplars.update((head.label, head.key, head.sequence) for head in read)

    def _to_keep(self, record: Record) -> Readings | None:
        """The readings of an observation, where it belongs to the kept touches and its row holds them."""
        wanted = self.kept is not None and self.kept.wants(record.label, record.key)
        return unpack_readings(record.arrays) if wanted else None

    def empty_like(self) -> Memory:
        """Another memory of the same making."""
        return Memory(self.statistics.dimension, self.plan, self.capacity, self.encode, self.keeping)

    def _base_samples(self, store: Store) -> Memory:
        """A memory with what the base holds; an empty one without a base."""
        fresh = self.empty_like()
        fresh.base = self.base
        self.require_base(store)
        try:
            base = store.base()
        except DamageError as damage:
            # The statistics are whole without it; a memory that did not open would lose them too.
            logger.warning(
                "%s; no other touch can take the place of a retracted one: repair the memory (scroll-tactile memory "
                "repair)",
                damage,
            )
            compacted = self._counted(store, self.base)
            fresh.sample.update(
                (name, key, replace(touch, copies=compacted[name, key]))
                for name, key, touch in self.sample
                if compacted[name, key]
            )
            if fresh.kept is not None and self.kept is not None:
                fresh.kept.update(item for item in self.kept if item[:2] in compacted)
            if fresh.exemplars is not None and self.exemplars is not None:
                fresh.exemplars.update(item for item in self.exemplars if item[:2] in compacted)
            return fresh
        if base is not None:
            fresh._take(base.arrays, base.attributes, 0)
        return fresh

    def _counted(self, store: Store, upto: int) -> Counter[tuple[str, bytes]]:
        """How often each stream was observed, by material and key, up to a row and without what was retracted."""
        gone = self.uncounted(store.heads(kind=RETRACT), upto)
        return Counter(
            (head.label, head.key)
            for head in store.heads()
            if head.sequence <= upto and head.kind in (OBSERVE, MEMBER) and head.sequence not in gone
        )

    def uncounted(self, retractions: Iterable[Head], upto: int) -> set[int]:
        """The observations that count no more at a row, by the journal and by the memory itself.

        The base was made without what a later row retracts of it, and a retraction may have been lost to damage since.
        """
        return retracted_by(head for head in retractions if head.sequence <= upto) | self.retracted | self.excluded

    def is_gone(self, sequence: int) -> bool:
        """Whether this observation was retracted, as far as the memory itself knows."""
        return sequence in self.retracted or sequence in self.excluded

    def require_base(self, store: Store) -> None:
        """Raise CompactedError where the store was compacted since this memory was read."""
        if store.compacted != self.base:
            raise CompactedError(f"{store.path} was compacted since it was read: read it again")

    def codes(self, record: Record) -> tuple[int, Codes]:
        """The columns of an observation, and its rows of codes by scale."""
        columns = cast(int, record.attributes["columns"])
        return columns, row_codes(record.arrays, self.encode)

    def _touch(self, columns: int, codes: Codes) -> SampledTouch:
        return SampledTouch.of(self.plan.scored_stages(columns), codes)

    def _join(self, record: Record) -> None:
        """Add another memory of the same making: a row that holds the arrays and attributes of its base."""
        other = self.empty_like()
        other._take(record.arrays, record.attributes, record.sequence)
        self.join(other, exemplars="exemplar-readings" in record.arrays)

    def of_sums(self, arrays: Arrays, attributes: Any) -> Memory:
        """Another memory of the same making, of what a partial holds; see `memory.partial`."""
        other = self.empty_like()
        other._take(arrays, attributes, None)
        return other

    def join(self, other: Memory, *, exemplars: bool = True) -> None:
        """Add another memory of the same making; descriptions and the tuned model are left out."""
        self.statistics = self.statistics + other.statistics
        self.sample.update(other.sample)
        if self.kept is not None and other.kept is not None:
            self.kept.update(other.kept)
        if exemplars and self.exemplars is not None and other.exemplars is not None:
            self.exemplars.update(other.exemplars)

    def to_arrays(
        self, base_at: int | None = None, candidates: list[Exemplar] | None = None
    ) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Arrays and attributes of a checkpoint.

        base_at: of a base, whose rows can no longer be retracted. candidates: those for exemplars, with their readings,
        for a base and for what leaves the journal behind.
        """
        arrays, names = self.statistics.to_arrays()
        sampled, materials = self.sample.to_arrays()
        attributes: dict[str, Any] = {
            "dimension": self.statistics.dimension,
            "scales": list(map(int, self.statistics.scales)),
            "materials": names,
            "sample": materials,
            "copies": [touch.copies for *_, touch in self.sample],
            "tuned_upto": self.tuned_upto,
            "descriptions": dict(sorted(self.descriptions.items())),
        }
        arrays |= sampled
        if self.kept is not None:
            levels, attributes["kept"] = self.kept.to_arrays()
            arrays |= levels
        # The rows after a base are replayed, and say themselves which of them were retracted.
        retracted = sorted(self.retracted if base_at is None else ())
        base = self.base if base_at is None else base_at
        excluded = sorted(row for row in self.retracted | self.excluded if row <= base)
        arrays["retracted"], arrays["excluded"] = (np.array(rows, dtype=np.int64) for rows in (retracted, excluded))
        if self.exemplars is not None:
            own, attributes["exemplars"] = (
                self.exemplars.to_arrays() if candidates is None else exemplars_to_arrays(candidates)
            )
            arrays |= own
        if self.tuned is not None:
            own, attributes["tuned"] = self.tuned.to_arrays()
            arrays |= own
        return arrays, attributes

    @classmethod
    def load(
        cls,
        store: Store,
        dimension: int,
        plan: WindowPlan,
        exemplars: int = 0,
        encode: Encode | None = None,
        keeping: Keeping | None = None,
    ) -> Memory:
        """The memory that a store holds: its newest checkpoint, then the journal's rows after it."""
        for _ in range(ATTEMPTS - 1):
            newest = store.newest
            try:
                memory = cls(dimension, plan, exemplars, encode, keeping)._loaded(store)
            except CompactedError:  # a writer compacted it between two reads
                continue
            # A checkpoint that came between the reads may hold a tuned model from before the rows that were read.
            if store.newest == newest:
                return memory
        return cls(dimension, plan, exemplars, encode, keeping)._loaded(store)

    def _loaded(self, store: Store) -> Memory:
        self.base = store.compacted
        # Without a sound checkpoint the base raises what is lost; without a base the journal has every row.
        newest = store.latest(late=[LATE_ROWS, *(f"{LATE_SECOND}{scale}" for scale in self.plan.scales)])
        start = store.base() if newest is None else newest
        if start is not None:
            self._take(start.arrays, start.attributes, 0, start.late)
            self.sequence = start.upto
        self.checkpoint = None if newest is None else newest.number
        self.saved = self.sequence
        for record in store.records(after=self.sequence):
            self.replay(record, store)
        self.refill(store)
        logger.info("%s: checkpoint %s, and rows up to %d", store.path, self.checkpoint, self.sequence)
        return self

    def until(self, store: Store, upto: int) -> Memory:
        """The memory of the observations up to `upto` that are not retracted: what a base at `upto` holds."""
        memory, later = self._chosen(store, upto), self.empty_like()
        for head in store.heads(self.base):  # whoever compacts has read all
            if head.sequence <= upto:
                apply_description(memory.descriptions, head)
            elif head.kind in (OBSERVE, MERGE) and head.sequence not in self.retracted:
                later.replay(store.record(head.sequence), store)
        memory.statistics = self.statistics - later.statistics
        memory.base, memory.sequence, memory.tuned = self.base, upto, None
        memory.retracted = set(self.retracted)
        return memory

    def filled(self, arrays: Arrays, attributes: Any, sequence: int) -> Memory:
        """This memory, empty before, filled with what `to_arrays` gave with readings; the arrays are taken over."""
        self._take(arrays, attributes, None)
        self.sequence = sequence
        return self

    def _take(
        self, arrays: Arrays, attributes: Any, source: int | None, late: Mapping[str, LateArray] | None = None
    ) -> None:
        """Take what `to_arrays` gave. late: arrays that predictions do not need, to be read when something does."""
        names, scales, reads = attributes["materials"], self.plan.scales, dict(late or {})
        seconds = {name: each.read for name, each in reads.items()}
        self.statistics = Statistics.from_arrays(self.statistics.dimension, scales, arrays, names, seconds)
        if LATE_ROWS in reads:
            small = {name: array for name, array in arrays.items() if name.startswith("sample-")}
            self._sample = partial(_sample_of, reads[LATE_ROWS], small, attributes["sample"], attributes["copies"])
        else:
            self.sample = TouchSample.from_arrays(arrays, attributes["sample"], attributes["copies"])
        if self.kept is not None:
            self.kept.fill(arrays, attributes["kept"])
        if self.exemplars is not None and "exemplars" in attributes:
            self.exemplars = ExemplarSample.from_arrays(arrays, attributes["exemplars"], self.capacity, source)
        self.retracted, self.excluded = (set(arrays[name].tolist()) for name in ("retracted", "excluded"))
        self.descriptions = dict(attributes.get("descriptions", {}))  # a merge brings them as rows
        self._take_tuned(arrays, attributes)

    def take_tuned(self, checkpoint: Checkpoint) -> None:
        """Take the tuned model from a checkpoint, if it has another one."""
        self._take_tuned(checkpoint.arrays, checkpoint.attributes)

    def _take_tuned(self, arrays: Arrays, attributes: Any) -> None:
        if "tuned" in attributes:
            tuned, self.tuned_upto = Tuned.from_arrays(arrays, attributes["tuned"]), attributes["tuned_upto"]
            if self.tuned is None or self.tuned.digest() != tuned.digest():
                self.tuned = tuned


def _sample_of(rows: LateArray, arrays: Arrays, materials: Sequence[str], copies: Sequence[int]) -> TouchSample:
    return TouchSample.from_arrays({**arrays, LATE_ROWS: rows.read()}, materials, copies)


def apply_description(descriptions: dict[str, Description], row: Head | Record) -> None:
    """Apply a journal row to descriptions; a forgotten material loses its description."""
    if row.kind in (DESCRIBE, RETRACT):  # a retraction has no constituents, and names a material only in `forget`
        _describe(descriptions, row.label, row.attributes.get("constituents"))


def _describe(descriptions: dict[str, Description], material: str, constituents: Any) -> None:
    if constituents is None:
        descriptions.pop(material, None)
    else:
        descriptions[material] = dict(constituents)


def give_back_scratch() -> None:
    """Return freed memory to the system where the C library can: fitting and saving leave 40 MB of it."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
