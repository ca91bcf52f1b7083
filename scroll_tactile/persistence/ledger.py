"""The changes of a memory: each is atomic, and durable when its method returns."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from scroll_tactile_store import Head, Record, Store

from scroll_tactile.errors import AnnotationError, FineTuneError, InputError
from scroll_tactile.health.channel_numbers import MOST_CHANNELS, channel_numbers, to_text
from scroll_tactile.memory.axes import axis_memory
from scroll_tactile.memory.descriptions import Description, require_units
from scroll_tactile.memory.exemplars import Exemplar
from scroll_tactile.memory.gate import MemoryStore
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import (
    ADAPT,
    CHANNELS,
    CORRECTION,
    DECLARE,
    DESCRIBE,
    OBSERVE,
    RETRACT,
    RETRACTS,
    SENSE,
    SOURCE,
    Changed,
    Codes,
    annotated,
    annotation_of,
    declaration,
    pack_codes,
    pack_readings,
    require_row,
    spans,
)
from scroll_tactile.memory.tuned import Tuned
from scroll_tactile.persistence.merge import MergePlan, MergeRules
from scroll_tactile.persistence.observations import (
    adaptation_of,
    compaction_point,
    observation_of,
    observations_from,
    observations_of,
)
from scroll_tactile.persistence.open_memory import OpenMemory, give_back_scratch
from scroll_tactile.persistence.replaying import (
    append_row,
    apply_note,
    exemplar_candidates,
    refill,
    until,
)
from scroll_tactile.quantities import Quantity, require_declarable
from scroll_tactile.results import Adaptation, Compacted, Merged, Receipt
from scroll_tactile.signals.correction import Correction
from scroll_tactile.signals.stream import Stream
from scroll_tactile.statistics.annotations import NO_ANNOTATION, Annotation

__all__ = ["AxisLedger", "Ledger"]


class Ledger(OpenMemory):
    """The memory of one learner, and all that changes it.

    An observation appends its row to the journal before it changes the sums. A retraction changes the sums first, and
    reverts them if the journal refuses its row.
    """

    def _receipt(self, sequence: int, material: str, stream: Stream, *, repeated: bool = False) -> Receipt:
        durable = self.store is not None and not self._batching
        return Receipt(
            sequence=sequence,
            material=material,
            key=stream.key,
            seconds=stream.seconds,
            clipped=stream.clipped,
            durable=durable,
            repeated=repeated,
        )

    def observe(
        self,
        material: str,
        stream: Stream,
        columns: int,
        codes: Codes,
        source: str | None = None,
        annotation: Annotation = NO_ANNOTATION,
    ) -> Receipt:
        """Append an observation to the journal, then add it to the memory; durable on return, in a batch at its end.

        Of a touch that the memory has under this name nothing is learned. Raises AnnotationError for one that it has
        with another annotation.
        """
        require_row(stream)
        with self.lock:
            self.require_open()
            # A memory opened to read skips this: its journal refuses the row below.
            if self.store is None or self.store.mode == "write":
                known = self._known(material, stream.key, annotation)
                if known is None and stream.raw is not None:  # learned before the memory was adapted
                    known = self._known(material, stream.raw.key, annotation)
                if known is not None:
                    return self._receipt(known, material, stream, repeated=True)
            # Checked before the row is in the journal: the next opening must be able to add every row.
            self.memory.statistics.require_room(codes)
            self.memory.targets.require_room(annotation)
            undo = self._undo_of(material, stream.key, columns, annotation) if self.store is None else None
            with self._mutation(_nothing, undo):
                sequence = self._append(material, stream, columns, codes, source, annotation)
                if self._contents is not None:
                    self._contents.add(material, stream.key, sequence, annotation)
                self._changed([Changed(material, annotation.labels)])
            self._checkpoint_if_due()
            return self._receipt(sequence, material, stream)

    def _known(self, material: str, key: bytes, annotation: Annotation) -> int | None:
        """The row that has a touch under this name; None where there is none.

        Raises AnnotationError where it has the touch annotated otherwise than is said, if anything is.
        """
        sequence, there = self.contents().rows(key).get(material, (None, annotation))
        if annotation and there != annotation:
            quantities = self.memory.quantities
            raise AnnotationError(
                f"observation {sequence} has this touch of {material!r} with {there.shown(quantities)}; came "
                f"{annotation.shown(quantities)}. Retract it first, which takes a path and a row that was not compacted"
            )
        return sequence

    def _undo_of(self, material: str, key: bytes, columns: int, annotation: Annotation) -> Callable[[], None]:
        """A function that undoes the next observation, for a memory without a store."""
        memory = self._memory.undo(material, key, columns, annotation)

        def undo() -> None:
            memory()
            if self._contents is not None:
                self._contents.remove(material, key)

        return undo

    def _append(
        self, material: str, stream: Stream, columns: int, codes: Codes, source: str | None, annotation: Annotation
    ) -> int:
        memory = self._memory
        # Readings of every stream are kept, not of exemplars alone: any can take the place of a retracted exemplar.
        kept = self._bare or memory.exemplars is not None or memory.kept is not None
        packed = pack_readings(stream.readings) if kept else {}
        if self.store is None:
            sequence, stages = memory.sequence + 1, memory.plan.scored_stages(columns)
            held = Exemplar.of(material, stream.key, packed, stages, codes) if kept else None
            memory.add(material, stream.key, columns, codes, sequence, held, stream.readings, annotation)
            return sequence
        attributes: dict[str, Any] = {"columns": columns} | annotated(annotation)
        attributes |= ({"nbytes": stream.readings.nbytes} if kept else {}) | ({SOURCE: source} if source else {})
        if (numbers := channel_numbers(stream)) is not None:
            attributes[CHANNELS] = to_text(numbers)
        arrays = packed if self._bare else packed | pack_codes(codes)
        return append_row(
            memory, self.store, OBSERVE, material, stream.key, attributes=attributes, arrays=arrays, codes=codes
        )[0]

    def _note(self, kind: str, label: str, attributes: dict[str, Any]) -> int:
        """Append a row that has no arrays, and apply it; without a journal that is one change of a mapping."""
        memory, store = self.memory, self.store
        if store is None:
            apply_note(memory, Head(memory.sequence, kind, label, b"", 0.0, attributes, 0), Path())
            return memory.sequence
        with self._mutation(_nothing):
            sequence, _ = append_row(memory, store, kind, label, attributes=attributes)
        self._checkpoint_if_due()
        return sequence

    def describe(self, material: str, constituents: Description | None) -> None:
        """As `TactileLearner.describe`, for a description that was checked."""
        with self.lock:
            self.require_open()
            memory = self.memory
            if repr(memory.descriptions.get(material)) == repr(constituents):  # 1.0 == True, but means another thing
                return
            require_units(memory.descriptions, material, constituents or {})
            self.described += 1
            self._note(DESCRIBE, material, {"constituents": constituents})

    def declare(self, quantity: Quantity) -> None:
        """As `TactileLearner.declare`."""
        with self.lock:
            self.require_open()
            if require_declarable(self.memory.quantities, quantity):
                self._note(DECLARE, quantity.name, declaration(quantity))

    def sense(self, material: str, stream: Stream) -> None:
        """As `TactileLearner.sense`; material "" for the sensor at rest."""
        numbers = channel_numbers(stream)
        if numbers is None:
            raise InputError(
                f"the health of a sensor is told from its channels, 1 to {MOST_CHANNELS}, and three readings or more; "
                f"came {len(stream)} readings of {stream.sensor.name!r}"
            )
        with self.lock:
            self.require_store("tell how its sensor is")
            self._note(SENSE, material, {"columns": len(stream), CHANNELS: to_text(numbers)})

    @property
    def correction(self) -> Correction | None:
        """Through which new touches are read; None where the skin is the one that learned."""
        with self.lock:
            return self.memory.correction

    def adapt(self, correction: Correction) -> int:
        """Read touches through a correction from now on; durable when this returns, in a batch at its end.

        Returns its row in the journal. The model stays: what was learned is what it was.
        """
        text = correction.to_text()
        with self.lock:
            self.require_store("be adapted")
            # What replay would refuse must not come into the journal.
            Correction.from_text(text, self.memory.recipe.sensor)
            return self._note(ADAPT, "", {CORRECTION: text})

    def retract(self, receipt: Receipt | Adaptation | int) -> None:
        """As `TactileLearner.retract`."""
        with self.lock:
            store = self.require_store("retract anything")
            if (adaptation := adaptation_of(store, self.memory, receipt)) is not None:
                self._note(ADAPT, "", {RETRACTS: adaptation})  # the one before it counts again, if there is one
                return
            assert not isinstance(receipt, Adaptation)
            self._retract(store, [observation_of(store, self.memory, receipt)], "")

    def forget(self, material: str | None, source: str | None) -> int:
        """As `TactileLearner.forget`."""
        with self.lock:
            store = self.require_store("forget anything")
            if material is not None:
                found = observations_of(store, self.memory, material)
            else:
                found = observations_from(store, self.memory, source or "")
            self._retract(store, [store.record(sequence) for sequence in found], material or "")
        return len(found)

    def _retract(self, store: Store, records: list[Record], material: str) -> None:
        # The memory changes before the journal: that reads rows again, and one may be damaged. With the retraction in
        # the journal, every later opening would fail on that row.
        store.compaction()  # raises where it is damaged: choosing samples again needs it
        memory, sequences = self._memory, spans(record.sequence for record in records)
        chosen, tuned = memory.chosen, memory.tuned

        def revert() -> None:
            for record in records:
                memory.put_back(record)
            memory.chosen, memory.tuned = chosen, tuned

        with self._mutation(revert):
            retracted = [memory.retract(record) for record in records]
            refill(memory, store)
            head = store.append(RETRACT, material, b"", attributes={"sequences": sequences})
            memory.sequence = head.sequence
            apply_note(memory, head, store.path)
            self._changed(retracted)
        self._checkpoint_if_due()

    def relabel(self, receipt: Receipt | int, material: str) -> int:
        """As `TactileLearner.relabel`."""
        with self.lock:
            store = self.require_store("relabel anything")
            self._require_no_batch("a relabelling")
            record = observation_of(store, self.memory, receipt)
            if record.label == material:
                raise InputError(f"observation {record.sequence} of {store.path} is called {material!r} already")
            if (known := self._known(material, record.key, annotation_of(record.attributes))) is not None:
                self._retract(store, [record], "")
                return known
            store.compaction()  # raises where it is damaged: choosing samples again needs it
            memory = self._memory
            with self._mutation(), store.batch():
                removed = memory.retract(record)
                refill(memory, store)
                store.append(RETRACT, "", b"", attributes={"sequences": spans([record.sequence])})
                kept: Any = {"attributes": record.attributes, "arrays": record.arrays, "time": record.time}
                sequence, added = append_row(memory, store, OBSERVE, material, record.key, **kept)
                self._changed([removed, *(added or ())])
            self._checkpoint_if_due()
            return sequence

    def _require_no_batch(self, what: str) -> None:
        if self._batching:
            raise InputError(f"{what} is a batch of its own: end the batch before it")

    @contextmanager
    def batch(self) -> Iterator[None]:
        """As `TactileLearner.batch`."""
        with self.lock:
            self.require_open()
            if self.store is None or self._batching:
                yield
                return
            raised: BaseException | None = None
            self._batching = True
            try:
                with self.store.batch():
                    try:
                        yield
                    except BaseException as error:  # the store must not see it: it would undo the batch
                        raised = error
            except BaseException:
                self._whole = False
                raise
            finally:
                self._batching = False
            self._checkpoint_if_due()
            if raised is not None:
                raise raised

    def merge(
        self, other: str | os.PathLike[str], rules: MergeRules, progress: Callable[[str, int, int], object]
    ) -> tuple[Merged, list[tuple[Head, str]]]:
        """As `TactileLearner.merge`; also returns the rows of the other memory that are refused, and why.

        Raises ObservationError also where a refused row was compacted there, and cannot be left out.
        """
        with self.lock:
            store, memory = self.require_store("merge"), self.memory
            self._require_no_batch("a merge")
            with MemoryStore.open(other, mode="read") as source:
                plan = MergePlan.of(store, memory, source, self.contents(), rules)
                with self._mutation(), store.batch():
                    added = plan.append_to(store, memory, lambda done, of: progress("merging", done, of))
            self._changed()
            self._checkpoint_if_due()
        return Merged(added, plan.shared, len(plan.descriptions)), plan.refused

    def compact(self, keep: int) -> Compacted:
        """As `TactileLearner.compact`."""
        with self.lock:
            store, memory = self.require_store("compact"), self.memory
            last_sequence = compaction_point(store, memory, keep)
            before = sum(store.size().values())
            self.require_writing()
            if last_sequence > memory.compacted:
                store.compaction()  # raises where it is damaged: the new one is made from it
                # The newest state has the tuned model, which the compaction checkpoint may lack.
                newest = memory.to_arrays() if last_sequence < memory.sequence else None
                kept = until(memory, store, last_sequence) if last_sequence < memory.sequence else memory
                arrays, attributes = kept.to_arrays(last_sequence, exemplar_candidates(kept, store))
                with self._mutation():
                    store.compact(arrays, last_sequence=last_sequence, attributes=attributes, newest=newest)
                    self._saved, self._saved_weighings = memory.sequence, {}  # it has none
                    memory.note_compaction(last_sequence)
                give_back_scratch()
            return Compacted(memory.compacted, before, sum(store.size().values()))

    def keep_tuned(self, tuned: Tuned, made_from: Memory, last_sequence: int, retractions: int) -> None:
        """Keep the tuned model, durably. Raises FineTuneError where something was retracted since its training began.

        made_from, last_sequence, retractions: the memory, its last row and its count of retractions when it began.
        """
        with self.lock:
            self.require_writing()
            memory = self.memory
            if memory is not made_from or memory.retractions != retractions:
                raise FineTuneError("what the tuned model was being made from was retracted meanwhile: fine-tune again")
            before = memory.tuned, memory.tuned_last_sequence
            memory.tuned, memory.tuned_last_sequence = tuned, last_sequence
            try:
                self._write_checkpoint()
            except BaseException:
                # Ctrl-C may come when the checkpoint is already current: closing writes the earlier tuned model again.
                (memory.tuned, memory.tuned_last_sequence), self._saved = before, -1
                raise


class AxisLedger(Ledger):
    """What a memory learned by the labels on one axis, in place of materials; nobody changes it but the memory itself.

    ledger: of the memory, whose lock is held by whoever reads it. axis: its name.
    """

    def __init__(self, ledger: Ledger, axis: str) -> None:
        self._of, self._axis = ledger, axis
        super().__init__(lambda: axis_memory(ledger.memory, axis))
        self.lock = ledger.lock
        self._seen = ledger.version
        ledger.followers.append(self._follow)

    @property
    def memory(self) -> Memory:
        """The memory of the axis as it is now."""
        of = self._of.memory  # reads it again if a change was cut short
        if self._seen != self._of.version:
            self._memory, self._seen = axis_memory(of, self._axis), self._of.version
        return self._memory

    @property
    def correction(self) -> Correction | None:
        """As of the memory."""
        return self._of.correction

    def take_weighing(self) -> str | None:
        """As of the memory, of the axis."""
        return self._of.memory.weighings.pop(self._axis, None)

    def _follow(self, changes: Sequence[Changed] | None) -> None:
        """Note what the memory changed by: of touches without a label that something did."""
        if changes is None:
            self._changed()
            return
        labels = (dict(touch.labels).get(self._axis) for touch in changes)
        self._changed([Changed(label) for label in labels if label is not None])


def _nothing() -> None:
    """Nothing to revert: the journal refused the row before the memory was changed."""
