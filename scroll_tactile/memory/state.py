"""A memory: exact statistics, sampled and kept touches, exemplars and the tuned model; and the arrays it is kept as."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Self, cast

import numpy as np
import numpy.typing as npt
from scroll_tactile_store import Head, Record

from scroll_tactile.matching.kept_arrays import KeptTouch
from scroll_tactile.memory.descriptions import Description
from scroll_tactile.memory.exemplars import Exemplar, ExemplarSample, Source, exemplars_to_arrays
from scroll_tactile.memory.touch_rows import (
    Arrays,
    Changed,
    Codes,
    Encode,
    Readings,
    annotated,
    annotation_of,
    declaration,
    row_codes,
    unpack_readings,
)
from scroll_tactile.memory.tuned import Tuned
from scroll_tactile.quantities import Quantity
from scroll_tactile.recipe import Recipe
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.correction import Correction
from scroll_tactile.signals.levels import LevelArray, levels_of
from scroll_tactile.statistics.annotations import NO_ANNOTATION, Annotation, TargetSums
from scroll_tactile.statistics.sample import Sample, SampledTouch, TouchSample
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["ANNOTATED", "MOST_CORRECTIONS", "WEIGHINGS", "KeptTouches", "Memory"]

WEIGHINGS = "weighings"  # an array of JSON
ANNOTATED = "sample-annotations", "kept-annotations"  # attributes: of each of their touches, how it was annotated
LONGEST_KEPT = 2.0  # times the usual length: what is kept of a touch
MOST_CORRECTIONS = 16  # that a memory can come back to, one retraction after another
Chosen = tuple[TouchSample, "KeptTouches | None", ExemplarSample | None]


class KeptTouches(Sample[KeptTouch]):
    """Kept touches: a bounded sample of what was observed, as levels, to compare others with (see `matching.matcher`).

    A function of the set of touches observed: at most `capacity` of a sensor's. In a checkpoint these are `kept-keys`
    (n, 32), `kept-columns` (n), and `kept-levels`, each channel by channel; their materials are the attribute `kept`.
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
        return [touch for *_, touch in self]

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

    def to_arrays(self) -> tuple[dict[str, npt.NDArray[Any]], list[str]]:
        """What a store keeps: arrays by name, and the material of each touch."""
        kept = self.touches()
        levels = np.concatenate([np.zeros(0, np.uint8), *(touch.levels.ravel() for touch in kept)])
        return {
            "kept-keys": np.array([list(touch.key) for touch in kept] or [[]], np.uint8)[: len(kept)],
            "kept-columns": np.array([touch.levels.shape[1] for touch in kept], dtype=np.int64),
            "kept-levels": levels,
        }, [touch.material for touch in kept]

    def fill(self, arrays: Arrays, materials: Sequence[str], annotations: Sequence[Annotation] = ()) -> None:
        """Take in what `to_arrays` described; annotations: of each touch."""
        noted = annotations or [NO_ANNOTATION] * len(materials)
        columns, channels = arrays["kept-columns"], self.sensor.channels
        parts = np.split(arrays["kept-levels"], np.cumsum(columns * channels)[:-1])
        for i, material in enumerate(materials):
            key, levels = arrays["kept-keys"][i].tobytes(), parts[i].reshape(channels, -1)
            self.add(material, key, KeptTouch(material, key, levels, noted[i]))


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

    def add(
        self,
        material: str,
        key: bytes,
        columns: int,
        codes: Codes,
        sequence: int,
        source: Source | None,
        readings: Readings | None,
        annotation: Annotation = NO_ANNOTATION,
    ) -> None:
        """Add an observation without a journal: a touch of so many columns, its rows of codes by scale, and its number.

        source: of its readings, for the exemplars. readings: for the kept touches. None: they are not kept.
        `replaying.replay` adds what a journal has. Raises CapacityError before anything is added.
        """
        self.statistics.add(material, codes, columns)
        self.targets.add(material, key, annotation, codes, columns)
        if self.sample.wants(material, key):
            self.sample.add(material, key, self._touch(columns, codes, annotation))
        if self.kept is not None and source is not None:
            self.kept.take(material, key, readings, annotation)
        if self.exemplars is not None and source is not None:
            self.exemplars.add(material, key, source)
        self.sequence = sequence

    def undo(self, material: str, key: bytes, columns: int, annotation: Annotation) -> Callable[[], None]:
        """What takes the next `add` back, of this touch, however much of it was done; it can be called again."""
        parts = [sample.undo(material, key) for sample in self.samples if sample.wants(material, key)]
        parts += [self.statistics.undo(material, columns), self.targets.undo(annotation, columns)]
        sequence = self.sequence

        def undo() -> None:
            for part in parts:
                part()
            self.sequence = sequence

        return undo

    def retract(self, record: Record) -> Changed:
        """Subtract an observation from the sums; call `replaying.refill` afterwards, for what was chosen."""
        material, key, annotation = record.label, record.key, annotation_of(record.attributes)
        columns, codes = self.codes(record)
        self.statistics.remove(material, codes, columns)
        self.targets.remove(material, key, annotation, codes, columns)
        self.retracted.add(record.sequence)
        self.retractions += 1
        self.weighings.clear()
        if any(sample.holds(material, key) for sample in self.samples):
            self.stale = True
        if record.sequence <= self.tuned_last_sequence:
            self.tuned = None
        return Changed(material, annotation.labels)

    @property
    def samples(self) -> list[Sample[Any]]:
        """What was chosen among the observations, as far as the recipe keeps it."""
        return [sample for sample in (self.sample, self.kept, self.exemplars) if sample is not None]

    def put_back(self, record: Record) -> None:
        """Undo `retract` in the sums, exactly; the caller restores sample, exemplars and the tuned model."""
        columns, codes = self.codes(record)
        self.statistics.add(record.label, codes, columns)
        self.targets.add(record.label, record.key, annotation_of(record.attributes), codes, columns)
        self.retracted.discard(record.sequence)
        self.stale = False

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

    @property
    def chosen(self) -> Chosen:
        """What was chosen among the observations: sample, kept touches and exemplars."""
        return self.sample, self.kept, self.exemplars

    @chosen.setter
    def chosen(self, chosen: Chosen) -> None:
        self.sample, self.kept, self.exemplars = chosen
        self.stale = False

    def take_sums(self, memory: Memory, later: Memory, last_sequence: int) -> None:
        """Take the sums of a memory without those of the rows behind one; `chosen` is of the rows up to it already."""
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
        """Arrays and attributes of a checkpoint.

        compaction_at: of a compaction checkpoint, whose rows can no longer be retracted. candidates: those for
        exemplars, with their readings, for a compaction checkpoint and for what leaves the journal behind.
        """
        arrays, names = self.statistics.to_arrays()
        sampled, materials = self.sample.to_arrays()
        attributes: dict[str, Any] = {
            "dimension": self.statistics.dimension,
            "scales": list(map(int, self.statistics.scales)),
            "materials": names,
            "sample": materials,
            "tuned_last_sequence": self.tuned_last_sequence,
            "descriptions": dict(sorted(self.descriptions.items())),
        }
        arrays |= sampled
        if self.corrections:
            rows = self.corrections.items()
            attributes["corrections"] = [[sequence, correction.to_text()] for sequence, correction in rows]
        if self.kept is not None:
            levels, attributes["kept"] = self.kept.to_arrays()
            arrays |= levels
        if self.quantities:
            declared = sorted(self.quantities.items())
            attributes["quantities"] = {name: declaration(quantity) for name, quantity in declared}
        if self.targets:
            sums, attributes["targets"] = self.targets.to_arrays(self.statistics.touches)
            arrays |= sums
            for which, sample in zip(ANNOTATED, (self.sample, self.kept), strict=True):
                if sample is not None:
                    attributes[which] = [annotated(touch.annotation) for *_, touch in sample]
        # The rows after a compaction checkpoint are replayed, and say themselves which of them were retracted.
        retracted = sorted(self.retracted if compaction_at is None else ())
        compacted = self.compacted if compaction_at is None else compaction_at
        excluded = sorted(row for row in self.retracted | self.excluded if row <= compacted)
        arrays["retracted"], arrays["excluded"] = (np.array(rows, dtype=np.int64) for rows in (retracted, excluded))
        if self.exemplars is not None:
            held = self.exemplars.to_arrays() if candidates is None else exemplars_to_arrays(candidates)
            arrays |= held[0]
            attributes["exemplars"] = held[1]
        if self.weighings and candidates is None and compaction_at is None:
            arrays[WEIGHINGS] = np.frombuffer(json.dumps(self.weighings).encode(), np.uint8)
        if self.tuned is not None:
            own, attributes["tuned"] = self.tuned.to_arrays()
            arrays |= own
        return arrays, attributes

    def fill(
        self,
        arrays: Arrays,
        attributes: Any,
        sequence: int = 0,
        *,
        source: int | None = None,
    ) -> Self:
        """This memory, empty before, filled with what `to_arrays` gave; the arrays are taken over.

        sequence: the last row that they hold. source: the row that has the readings of exemplars for which the arrays
        name none, 0 for the compaction checkpoint; None where the arrays have them.
        """
        self.sequence = sequence
        names, scales = attributes["materials"], self.plan.scales
        self.statistics = Statistics.from_arrays(self.statistics.dimension, scales, arrays, names)
        if "targets" in attributes:
            self.targets = TargetSums.from_arrays(self.statistics, arrays, attributes["targets"])
        noted, kept_noted = ([annotation_of(told) for told in attributes.get(which, ())] for which in ANNOTATED)
        self.sample = TouchSample.from_arrays(arrays, attributes["sample"], noted)
        if self.kept is not None:
            self.kept.fill(arrays, attributes["kept"], kept_noted)
        if self.exemplars is not None and "exemplars" in attributes:
            self.exemplars = ExemplarSample.from_arrays(arrays, attributes["exemplars"], self.recipe.exemplars, source)
        self.retracted, self.excluded = (set(arrays[name].tolist()) for name in ("retracted", "excluded"))
        self.descriptions = dict(attributes.get("descriptions", {}))  # a merge brings them as rows
        for name, fields in attributes.get("quantities", {}).items():
            self.quantities[name] = Quantity(name=name, **fields)
        for row, text in attributes.get("corrections", ()):
            self.corrections[row] = Correction.from_text(text, self.recipe.sensor)
        self.take_tuned(arrays, attributes)
        if WEIGHINGS in arrays:
            self.weighings = json.loads(arrays[WEIGHINGS].tobytes())
        return self

    def take_tuned(self, arrays: Arrays, attributes: Any) -> None:
        """Take the tuned model of a checkpoint, if it has another one."""
        if "tuned" in attributes:
            self.tuned_last_sequence = attributes["tuned_last_sequence"]
            tuned = Tuned.from_arrays(arrays, attributes["tuned"])
            if self.tuned is None or self.tuned.digest() != tuned.digest():
                self.tuned = tuned
