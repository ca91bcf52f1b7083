"""A memory: exact statistics, sampled and kept touches, exemplars and the tuned model; and the arrays it is kept as."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Self, cast

import numpy as np
import numpy.typing as npt
from scroll_tactile_store import Checkpoint, Head, Record

from scroll_tactile.matching.kept_arrays import KeptTouch
from scroll_tactile.memory.descriptions import Description, checked
from scroll_tactile.memory.exemplars import Exemplar, ExemplarFields, ExemplarSample
from scroll_tactile.memory.touch_rows import (
    Changed,
    Codes,
    Encode,
    Readings,
    annotation_of,
    declaration,
    place_of,
    refusing,
    row_codes,
    unpack_readings,
)
from scroll_tactile.memory.tuned import Tuned
from scroll_tactile.quantities import Quantity
from scroll_tactile.recipe import Recipe
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.correction import Correction
from scroll_tactile.signals.levels import LevelArray, levels_of
from scroll_tactile.statistics.annotations import NO_ANNOTATION, Annotation, TargetFields, TargetSums
from scroll_tactile.statistics.fields import Bytes, Ints, Must, Name, decode, encode
from scroll_tactile.statistics.sample import Sample, SampledTouch, SampleFields, TouchFields, TouchSample
from scroll_tactile.statistics.statistics import LONGEST_TOUCH, Statistics, StatisticsFields

__all__ = ["MOST_CORRECTIONS", "KeptTouches", "Memory", "MemoryFields"]

LONGEST_KEPT = 2.0  # times the usual length: what is kept of a touch
MOST_CORRECTIONS = 16  # that a memory can come back to, one retraction after another


class KeptTouches(Sample[KeptTouch]):
    """Kept touches: a bounded sample of what was observed, as levels, to compare others with (see `matching.matcher`).

    A function of the set of touches observed: at most `capacity` of a sensor's.
    """

    def __init__(self, sensor: Sensor, capacity: int) -> None:
        super().__init__(capacity)
        self.sensor = sensor

    @property
    def most_columns(self) -> int:
        """Of a touch that is kept: twice the usual length."""
        return max(2, round(LONGEST_KEPT * self.sensor.readings))

    def levels(self, readings: npt.NDArray[np.floating]) -> LevelArray:
        """What is kept of readings (T, C) in the sensor's unit: levels (C, T'), T' at most `most_columns`."""
        return levels_of(readings[: self.most_columns], self.sensor)

    def touches(self) -> list[KeptTouch]:
        """All of them, by material and key."""
        return list(self.items())

    def take(
        self,
        material: str,
        key: bytes,
        readings: npt.NDArray[np.floating] | None,
        annotation: Annotation = NO_ANNOTATION,
    ) -> None:
        """Keep a touch where it belongs in, if its readings are there."""
        if readings is not None and self.wants(material, key):
            self.add(material, key, KeptTouch(material, key, self.levels(readings), annotation))

    def to_fields(self) -> KeptFields:
        """What a store keeps of them."""
        levels = np.concatenate([np.zeros(0, np.uint8), *(touch.levels.ravel() for touch in self.items())])
        columns = np.array([touch.levels.shape[1] for touch in self.items()], dtype=np.int64)
        return KeptFields(*self.named(), columns, levels)

    def fill(self, kept: KeptFields) -> None:
        """Take in what `to_fields` gave."""
        channels = self.sensor.channels
        parts = np.split(kept.levels, np.cumsum(kept.columns * channels)[:-1])
        for (material, key, annotation), levels in zip(kept.named(), parts, strict=False):
            self.add(material, key, KeptTouch(material, key, levels.reshape(channels, -1), annotation))


@dataclass
class KeptFields(TouchFields):
    """What a store keeps of `KeptTouches`.

    columns: the length of each touch, (n,). levels: of each touch, channel by channel, (Σ columns · channels,).
    """

    columns: Annotated[Ints, Must("int64", "n", 1, LONGEST_TOUCH)]
    levels: Annotated[Bytes, Must("uint8", "*")]


@dataclass
class MemoryFields:
    """What a checkpoint holds of a memory; see `Memory`, and `statistics.fields` for the names of its arrays.

    retracted, excluded: rows of the journal, (n,). descriptions: by material. quantities: by name, without it.
    corrections: the row of each, and its text. weighings: by axis, "" for materials.
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
        with refusing(path, *place_of(held)):
            sizes = {"d": dimension, "triangle": dimension * (dimension + 1) // 2}
            made = decode(cls, held.arrays, held.attributes, sizes)
            for material, constituents in made.descriptions.items():
                checked(material, constituents)
            return made


class Memory:
    """Everything that was learned, as far as a number of rows of the journal.

    recipe: what it is made with; plan: its windows. encode: readings → the rows of codes that the touch adds, by scale,
    for rows of the journal that have readings alone; None where all rows have codes.

    What was learned:

    - statistics: exact sums by scale. targets: those of values and labels.
    - sample: the touches that readouts are calibrated on.
    - kept: touches to match with; None where the recipe keeps none.
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
    - retracted: the retracted sequences after `compacted`.
    - excluded: the retracted sequences up to `compacted`, which the compaction checkpoint was made without.
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
        self.kept = KeptTouches(recipe.sensor, recipe.kept_touches) if recipe.kept_touches else None
        self.exemplars = ExemplarSample(recipe.exemplars) if recipe.exemplars else None
        self.tuned: Tuned | None = None
        self.tuned_last_sequence = 0
        self.retracted: set[int] = set()
        self.excluded: set[int] = set()
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
        material, key, annotation = row.label, row.key, annotation_of(row.attributes)
        self.statistics.add(material, codes, columns)
        self.targets.add(material, key, annotation, codes, columns)
        if self.sample.wants(material, key):
            self.sample.add(material, key, self._touch(columns, codes, annotation))
        if self.kept is not None and self.kept.wants(material, key):
            self.kept.take(material, key, unpack_readings(row.arrays), annotation)
        self.add_exemplar(row)
        return Changed(material, annotation.labels)

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
        if any(sample.holds(material, key) for sample in self.samples):
            self.stale = True
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
        touches = {(material, key): touch for material, key, touch in made.sample}

        def touch(head: Head) -> SampledTouch:
            annotation = annotation_of(head.attributes)  # another one where the touch was retracted in between
            if (own := touches.get((head.label, head.key))) is not None:
                return replace(own, annotation=annotation)
            return self._touch(*self.codes(record(head.sequence)), annotation)

        self.sample.refill(((head.label, head.key, head) for head in heads), touch)
        read = [head for head in heads if head.attributes.get("nbytes")]  # whose rows hold readings
        if self.kept is not None:
            mine, kept = {(material, key): own for material, key, own in made.kept or ()}, self.kept

            def keep(head: Head) -> KeptTouch:
                annotation = annotation_of(head.attributes)
                if (own := mine.get((head.label, head.key))) is not None:
                    return replace(own, annotation=annotation)
                levels = kept.levels(cast(Readings, unpack_readings(record(head.sequence).arrays)))
                return KeptTouch(head.label, head.key, levels, annotation)

            self.kept.refill(((head.label, head.key, head) for head in read), keep)
        if self.exemplars is not None:
            self.exemplars.update((head.label, head.key, head.sequence) for head in read)

    def empty_like(self) -> Memory:
        """An empty memory of this recipe."""
        return Memory(self.recipe, self.encode)

    def is_gone(self, sequence: int) -> bool:
        """Whether this observation was retracted, as far as the memory itself knows."""
        return sequence in self.retracted or sequence in self.excluded

    def codes(self, record: Record) -> tuple[int, Codes]:
        """The columns of an observation, and its rows of codes by scale."""
        columns = cast(int, record.attributes["columns"])
        return columns, row_codes(record.arrays, self.encode)

    def _touch(self, columns: int, codes: Codes, annotation: Annotation) -> SampledTouch:
        return SampledTouch.of(self.plan.scored_stages(columns), codes, annotation)

    def take_chosen(self, other: Memory) -> None:
        """Take sample, kept touches and exemplars of a memory in place of its own."""
        self.sample, self.kept, self.exemplars, self.stale = other.sample, other.kept, other.exemplars, False

    def take_sums(self, memory: Memory, later: Memory, last_sequence: int) -> None:
        """Take the sums of a memory without those of the rows behind one; its own samples have none of these."""
        self.statistics, self.targets = memory.statistics - later.statistics, memory.targets - later.targets
        self.compacted, self.sequence, self.tuned = memory.compacted, last_sequence, None
        self.retracted = set(memory.retracted)

    def note_compaction(self, last: int) -> None:
        """Have a compaction checkpoint stand for rows up to one: what was retracted of them is out of it for good."""
        self.compacted = last
        self.excluded |= {sequence for sequence in self.retracted if sequence <= last}
        self.retracted = {sequence for sequence in self.retracted if sequence > last}

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
        # The rows after a compaction checkpoint are replayed, and say themselves which of them were retracted.
        retracted = sorted(self.retracted if compaction_at is None else ())
        compacted = self.compacted if compaction_at is None else compaction_at
        excluded = sorted(row for row in self.retracted | self.excluded if row <= compacted)
        weighed = candidates is None and compaction_at is None
        return encode(
            MemoryFields(
                statistics=self.statistics.to_fields(),
                sample=self.sample.to_fields(self.statistics.dimension),
                kept=None if self.kept is None else self.kept.to_fields(),
                exemplars=None if self.exemplars is None else self.exemplars.to_fields(candidates),
                targets=self.targets.to_fields(self.statistics.touches) if self.targets else None,
                tuned=self.tuned,
                retracted=np.array(retracted, dtype=np.int64),
                excluded=np.array(excluded, dtype=np.int64),
                tuned_last_sequence=self.tuned_last_sequence,
                descriptions=dict(sorted(self.descriptions.items())),
                quantities={name: declaration(quantity) for name, quantity in sorted(self.quantities.items())},
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
        with refusing(path, *place_of(held)):
            self.statistics = Statistics.of(self.statistics.dimension, self.plan.scales, made.statistics)
            if made.targets is not None:
                self.targets = TargetSums.of(self.statistics, made.targets)
            self.sample = TouchSample.of(made.sample)
            if self.kept is not None and made.kept is not None:
                self.kept.fill(made.kept)
            if self.exemplars is not None and made.exemplars is not None:
                self.exemplars.fill(made.exemplars, source)
            self.quantities = {name: Quantity(name=name, **fields) for name, fields in made.quantities.items()}
            self.corrections = {row: Correction.from_text(text, sensor) for row, text in made.corrections}
        self.retracted, self.excluded = set(made.retracted.tolist()), set(made.excluded.tolist())
        self.descriptions, self.weighings = made.descriptions, made.weighings
        self.take_tuned(made)
        return self

    def take_tuned(self, made: MemoryFields) -> None:
        """Take the tuned model of a checkpoint, if it has another one."""
        if made.tuned is not None:
            self.tuned_last_sequence = made.tuned_last_sequence
            if self.tuned is None or self.tuned.digest() != made.tuned.digest():
                self.tuned = made.tuned
