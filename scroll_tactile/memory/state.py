"""A memory: exact statistics, sampled and kept touches, exemplars and the tuned model; and the arrays it is kept as."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar, cast

import numpy as np
import numpy.typing as npt
from scroll_tactile_store import Checkpoint, Head, Record

from scroll_tactile.errors import MismatchError
from scroll_tactile.matching.kept_arrays import KeptTouch
from scroll_tactile.memory.descriptions import Description
from scroll_tactile.memory.exemplars import CANDIDATES, Exemplar, ExemplarFields
from scroll_tactile.memory.touch_rows import (
    Changed,
    Codes,
    Encode,
    Readings,
    annotation_of,
    refusing,
    unpack_codes,
    unpack_readings,
)
from scroll_tactile.memory.tuned import Tuned
from scroll_tactile.quantities import Quantity
from scroll_tactile.recipe import Recipe
from scroll_tactile.signals.correction import Correction
from scroll_tactile.signals.levels import LevelArray, levels_of
from scroll_tactile.statistics.annotations import NO_ANNOTATION, TargetFields, TargetSums
from scroll_tactile.statistics.fields import Bytes, Ints, Must, Name, decode, encode
from scroll_tactile.statistics.sample import Sample, SampledTouch, SampleFields, TouchFields, TouchSample
from scroll_tactile.statistics.statistics import LONGEST_TOUCH, Statistics, StatisticsFields

__all__ = ["MOST_CORRECTIONS", "KeptFields", "Memory", "MemoryFields"]

LONGEST_KEPT = 2.0  # times the usual length: what is kept of a touch
T = TypeVar("T", SampledTouch, KeptTouch)
MOST_CORRECTIONS = 16  # that a memory can come back to, one retraction after another


@dataclass
class KeptFields(TouchFields):
    """What a store keeps of kept touches.

    columns: the length of each touch, (n,). levels: of each touch, channel by channel, (Σ columns · channels,).
    """

    columns: Annotated[Ints, Must("int64", "n", 1, LONGEST_TOUCH)]
    levels: Annotated[Bytes, Must("uint8", "*")]

    @classmethod
    def of(cls, kept: Sample[KeptTouch]) -> Self:
        """The fields of kept touches."""
        levels = np.concatenate([np.zeros(0, np.uint8), *(touch.levels.ravel() for touch in kept.touches())])
        return cls(*kept.named(), np.array([touch.levels.shape[1] for touch in kept.touches()], dtype=np.int64), levels)

    def touches(self, channels: int) -> list[tuple[str, bytes, KeptTouch]]:
        """The kept touches that these fields were made of, of a sensor of so many channels."""
        parts = np.split(self.levels, np.cumsum(self.columns * channels)[:-1])
        return [
            (material, key, KeptTouch(material, key, levels.reshape(channels, -1), annotation))
            for (material, key, annotation), levels in zip(self.named(), parts, strict=False)
        ]


@dataclass
class MemoryFields:
    """What a checkpoint holds of a memory; see `Memory`, and `statistics.fields` for the names of its arrays.

    retracted, excluded: rows of the journal behind the compacted ones, and among these, (n,). descriptions: by
    material. quantities: by name, without it. corrections: the row of each, and its text. weighings: by axis, "" for
    materials.
    """

    statistics: StatisticsFields
    sample: SampleFields
    retracted: Annotated[Ints, Must("int64", "*", 1)]
    excluded: Annotated[Ints, Must("int64", "*", 1)]
    kept: KeptFields | None = None
    exemplars: ExemplarFields | None = None
    targets: TargetFields | None = None
    tuned: Tuned | None = None
    tuned_last_sequence: int = 0
    descriptions: dict[Name, dict[str, Any]] = field(default_factory=dict)
    quantities: dict[Name, dict[str, Any]] = field(default_factory=dict)
    corrections: list[tuple[int, str]] = field(default_factory=list)
    weighings: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, held: Checkpoint | Record, dimension: int, path: Path) -> Self:
        """The fields of a checkpoint, or of a row that brought one. dimension: d. path: of the memory, for the error.

        Raises DamageError.
        """
        with refusing(path, held):
            sizes = {"d": dimension, "triangle": dimension * (dimension + 1) // 2}
            return decode(cls, held.arrays, held.attributes, sizes)


class Memory:
    """Everything that was learned, as far as a number of rows of the journal.

    recipe: what it is made with; plan: its windows. encode: readings → the rows of codes that the touch adds, by scale,
    for rows of the journal that have readings alone; None where all rows have codes.

    What was learned:

    - statistics: exact sums by scale. targets: those of values and labels.
    - sample: the touches that readouts are calibrated on.
    - kept: touches as levels, to compare others with (see `matching.matcher`); None where the recipe keeps none.
    - exemplars: the candidates for the buffer, and where their readings lie; None where the recipe has no buffer.
    - descriptions: material → what it is made of; the material need not have been observed.
    - quantities: those that touches can carry, by name.
    - corrections: of readings of a changed skin, by their rows, the last of those that count; see `correction`.
    - tuned: the tuned model; None before a fine-tune, or after one of the observations behind it was retracted.
    - weighings: how readouts and kept touches are weighed, by axis, "" for materials: text for the next opening, see
      `prediction.stored`; gone after a retraction.
    - tuned_last_sequence: the last sequence that the tuned model was trained on.

    Where it stands in the journal:

    - sequence: the last row that it holds.
    - compacted: the last row whose arrays were compacted; 0 before any compaction.
    - retracted: the retracted sequences; the compaction checkpoint was made without those up to `compacted`.
    - retractions: how many observations were retracted since the memory was loaded.
    - checkpoint, saved: the checkpoint that it was loaded from, and the last row in that; None and 0 without one.
    - stale: whether sample, kept touches or exemplars held what was retracted since they were chosen.
    """

    def __init__(self, recipe: Recipe, encode: Encode | None = None) -> None:
        self.recipe, self.plan = recipe, recipe.plan
        self.encode = encode
        self.statistics = Statistics(recipe.embedding.dimension, self.plan.scales)
        self.targets = TargetSums(recipe.embedding.dimension, self.plan.scales)
        self.sample = TouchSample()
        self.kept: Sample[KeptTouch] | None = Sample(recipe.kept_touches) if recipe.kept_touches else None
        self.exemplars: Sample[int] | None = Sample(CANDIDATES * recipe.exemplars) if recipe.exemplars else None
        self.tuned: Tuned | None = None
        self.tuned_last_sequence = 0
        self.retracted: set[int] = set()
        self.checkpoint: int | None = None
        self.sequence = self.compacted = self.saved = self.retractions = 0
        self.descriptions: dict[str, Description] = {}
        self.quantities: dict[str, Quantity] = {}
        self.corrections: dict[int, Correction] = {}
        self.weighings: dict[str, str] = {}
        self.stale = False

    def digest(self) -> str:
        """Hex of a SHA-256 over all sums, those of values and labels where there are any."""
        own = self.statistics.digest()
        return hashlib.sha256((own + self.targets.digest()).encode()).hexdigest() if self.targets else own

    @property
    def correction(self) -> Correction | None:
        """Through which new touches are read; None where the skin is the one that learned."""
        return next(reversed(self.corrections.values()), None)

    def correct(self, sequence: int, correction: Correction) -> None:
        """Read new touches through a correction, by its row; the oldest that nobody can come back to goes."""
        self.corrections[sequence] = correction
        for old in list(self.corrections)[:-MOST_CORRECTIONS]:
            del self.corrections[old]

    def add(self, row: Record, codes: Codes | None = None) -> Changed:
        """Add an observation; only `replaying.apply` does. codes: its own, where they are there already.

        Raises CapacityError before anything is added.
        """
        columns, codes = self.codes(row) if codes is None else (cast(int, row.attributes["columns"]), codes)
        touch, annotation = (row.label, row.key), annotation_of(row.attributes)
        self.statistics.add(row.label, codes, columns)
        self.targets.add(*touch, annotation, codes, columns)
        if self.sample.wants(*touch):
            self.sample.add(*touch, self._sampled(row, columns, codes))
        if self.kept is not None and self.kept.wants(*touch) and row.attributes.get("nbytes"):
            self.kept.add(*touch, self._levelled(row))
        self.add_exemplar(row)
        return Changed(row.label, annotation.labels)

    def add_exemplar(self, row: Head) -> None:
        """Add an observation to the candidates for exemplars, if its row holds readings."""
        if self.exemplars is not None and row.attributes.get("nbytes"):
            self.exemplars.add(row.label, row.key, row.sequence)

    def retract(self, row: Record) -> Changed:
        """Subtract an observation from the sums; `replaying.refill` chooses again what was chosen.

        Raises UnknownMaterialError for one that the sums do not have.
        """
        material, key, annotation = row.label, row.key, annotation_of(row.attributes)
        columns, codes = self.codes(row)
        self.statistics.remove(material, codes, columns)
        self.targets.remove(material, key, annotation, codes, columns)
        self.retracted.add(row.sequence)
        self.retractions += 1
        self.weighings.clear()
        self.stale |= any(sample.holds(material, key) for sample in self.samples)
        if row.sequence <= self.tuned_last_sequence <= self.sequence:  # a reader may have one from behind this
            self.tuned = None
        return Changed(material, annotation.labels)

    @property
    def samples(self) -> list[Sample[Any]]:
        """What was chosen among the observations, as far as the recipe keeps it."""
        return [sample for sample in (self.sample, self.kept, self.exemplars) if sample is not None]

    def choose(self, heads: Sequence[Head], record: Callable[[int], Record], made: Memory) -> None:
        """Choose samples and exemplars among what they hold and some observations.

        record: reads the row of one. made: a memory whose samples have some of them ready.
        """
        read = [head for head in heads if head.attributes.get("nbytes")]  # whose rows hold readings

        def sampled(head: Head) -> SampledTouch:
            row = record(head.sequence)
            return self._sampled(row, *self.codes(row))

        _refill(self.sample, heads, made.sample, sampled)
        if self.kept is not None:
            _refill(self.kept, read, made.kept or (), lambda head: self._levelled(record(head.sequence)))
        if self.exemplars is not None:
            self.exemplars.update((head.label, head.key, head.sequence) for head in read)

    def empty_like(self) -> Memory:
        """An empty memory of this recipe."""
        return Memory(self.recipe, self.encode)

    def of_axis(self, axis: str) -> Memory:
        """What was learned by the labels on an axis: its statistics follow it; samples are as they are now.

        Empty where no touch has a label on the axis. It has no exemplars, descriptions or f*.
        """
        view = self.empty_like()
        view.exemplars, view.sequence, view.retractions = None, self.sequence, self.retractions
        view.statistics = self.targets.axes.get(axis, view.statistics)
        for _, key, touch in self.sample:
            if (label := touch.annotation.label(axis)) is not None:
                view.sample.add(label, key, replace(touch, annotation=NO_ANNOTATION))
        for _, key, kept in self.kept or ():
            if view.kept is not None and (label := kept.annotation.label(axis)) is not None:
                view.kept.add(label, key, replace(kept, material=label, annotation=NO_ANNOTATION))
        return view

    def codes(self, record: Record) -> tuple[int, Codes]:
        """The columns of an observation, and its rows of codes by scale.

        Raises MismatchError for readings alone that this memory cannot embed.
        """
        if not (codes := unpack_codes(record.arrays)):
            if self.encode is None:
                raise MismatchError(
                    "a row holds readings alone, which can be embedded only by the embedding that made the memory: "
                    "open it with TactileLearner.open(path, embedding=...)"
                )
            codes = self.encode(cast(Readings, unpack_readings(record.arrays)))
        return cast(int, record.attributes["columns"]), codes

    def _sampled(self, row: Head, columns: int, codes: Codes) -> SampledTouch:
        return SampledTouch.of(self.plan.scored_stages(columns), codes, annotation_of(row.attributes))

    def _levelled(self, row: Record) -> KeptTouch:
        levels = self.levels(cast(Readings, unpack_readings(row.arrays)))
        return KeptTouch(row.label, row.key, levels, annotation_of(row.attributes))

    def levels(self, readings: npt.NDArray[np.floating]) -> LevelArray:
        """What is kept of readings (T, C) in the sensor's unit: levels (C, T'), T' at most twice the usual length."""
        sensor = self.recipe.sensor
        return levels_of(readings[: max(2, round(LONGEST_KEPT * sensor.readings))], sensor)

    def take_chosen(self, other: Memory) -> None:
        """Take sample, kept touches and exemplars of a memory in place of its own."""
        self.sample, self.kept, self.exemplars, self.stale = other.sample, other.kept, other.exemplars, False

    def take_sums(self, memory: Memory, later: Memory, last_sequence: int) -> None:
        """Take the sums of a memory without those of the rows behind one; its own samples have none of these."""
        self.statistics, self.targets = memory.statistics - later.statistics, memory.targets - later.targets
        self.compacted, self.sequence, self.tuned = memory.compacted, last_sequence, None
        self.retracted = set(memory.retracted)

    def join(self, other: Memory, *, exemplars: bool = True) -> None:
        """Add another memory of the same making; descriptions, quantities and the tuned model are left out."""
        self.statistics, self.targets = self.statistics + other.statistics, self.targets + other.targets
        self.sample.update(other.sample)
        if self.kept is not None and other.kept is not None:
            self.kept.update(other.kept)
        if exemplars and self.exemplars is not None and other.exemplars is not None:
            self.exemplars.update(other.exemplars)

    def to_arrays(
        self, compaction_at: int | None = None, candidates: list[Exemplar] | None = None
    ) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Arrays and attributes of a checkpoint, see `MemoryFields`.

        compaction_at: of a compaction checkpoint, whose rows can no longer be retracted. candidates: those for
        exemplars, with their readings, for a compaction checkpoint and for what leaves the journal behind.
        """
        compacted = self.compacted if compaction_at is None else compaction_at
        gone = np.array(sorted(self.retracted), dtype=np.int64)
        weighed = candidates is None and compaction_at is None
        return encode(
            MemoryFields(
                statistics=self.statistics.to_fields(),
                sample=self.sample.to_fields(self.statistics.dimension),
                kept=None if self.kept is None else KeptFields.of(self.kept),
                exemplars=None if self.exemplars is None else ExemplarFields.of(self.exemplars, candidates),
                targets=self.targets.to_fields(self.statistics.touches) if self.targets else None,
                tuned=self.tuned,
                # Rows behind a compaction checkpoint are replayed, and say themselves which of them were retracted.
                retracted=gone[gone > compacted][: None if compaction_at is None else 0],
                excluded=gone[gone <= compacted],
                tuned_last_sequence=self.tuned_last_sequence,
                descriptions=dict(sorted(self.descriptions.items())),
                quantities={name: one.model_dump(exclude={"name"}) for name, one in sorted(self.quantities.items())},
                corrections=[(row, correction.to_text()) for row, correction in self.corrections.items()],
                weighings=dict(self.weighings) if weighed else {},
            )
        )

    def fill(self, held: Checkpoint | Record, path: Path, source: int = 0) -> Self:
        """This memory, empty before, filled with what a checkpoint holds, or a row that brought one.

        The arrays are taken over. path: of the memory where they were read, for the error. source: the row that has the
        readings of exemplars which come with them, 0 for the compaction checkpoint. Raises DamageError.
        """
        made, sensor = MemoryFields.of(held, self.statistics.dimension, path), self.recipe.sensor
        self.sequence = 0 if isinstance(held, Record) else held.last_sequence
        with refusing(path, held):
            self.statistics = Statistics.of(self.statistics.dimension, self.plan.scales, made.statistics)
            if made.targets is not None:
                self.targets = TargetSums.of(self.statistics, made.targets)
            self.sample = TouchSample.of(made.sample)
            if self.kept is not None and made.kept is not None:
                self.kept.update(made.kept.touches(sensor.channels))
            if self.exemplars is not None and made.exemplars is not None:
                self.exemplars.update(made.exemplars.rows(source))
            self.quantities = {name: Quantity(name=name, **fields) for name, fields in made.quantities.items()}
            self.corrections = {row: Correction.from_text(text, sensor) for row, text in made.corrections}
        self.retracted = {*made.retracted.tolist(), *made.excluded.tolist()}
        self.descriptions, self.weighings = made.descriptions, made.weighings
        self.take_tuned(made)
        return self

    def take_tuned(self, made: MemoryFields) -> None:
        """Take the tuned model of a checkpoint, if it has another one."""
        if made.tuned is not None:
            self.tuned_last_sequence = made.tuned_last_sequence
            if self.tuned is None or self.tuned.digest() != made.tuned.digest():
                self.tuned = made.tuned


def _refill(sample: Sample[T], heads: Iterable[Head], ready: Iterable[tuple[str, bytes, T]], make: Any) -> None:
    """Choose among what a sample holds and some observations; ready: items by material and key; make: of a head."""
    made = {(material, key): item for material, key, item in ready}

    def item(head: Head) -> T:
        own = made.get((head.label, head.key))
        # It is annotated otherwise where the touch was retracted in between.
        return make(head) if own is None else replace(own, annotation=annotation_of(head.attributes))

    sample.refill(((head.label, head.key, head) for head in heads), item)
