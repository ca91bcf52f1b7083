"""The memory of one learner and the journal that keeps it: each change is atomic, and durable when its method returns.

A change appends a row to the journal, then applies it. One that was cut short, by ctrl-C for instance, is read again
from the journal before the memory's next use.
"""

from __future__ import annotations

import ctypes
import logging
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from scroll_tactile_store import CompactedError, Head, ReadOnlyError, Record, Store, StoreClosedError, StoreError

from scroll_tactile.errors import AnnotationError, FineTuneError, InputError
from scroll_tactile.health.channel_numbers import MOST_CHANNELS, channel_numbers, to_text
from scroll_tactile.health.watch import WatchedRows, WatchRules
from scroll_tactile.memory.descriptions import Description, require_units
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
    Arrays,
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
from scroll_tactile.persistence.merge import Merge, MergeRules
from scroll_tactile.persistence.observations import (
    adaptation_of,
    compaction_point,
    observation_of,
    observations_to_forget,
    rows_with,
)
from scroll_tactile.persistence.ram_store import AnyStore, RamStore
from scroll_tactile.persistence.replaying import (
    apply,
    apply_appended,
    chosen_without,
    exemplar_candidates,
    load,
    until,
)
from scroll_tactile.quantities import Quantity, require_declarable
from scroll_tactile.results import Adaptation, Compacted, Merged, Receipt
from scroll_tactile.signals.correction import Correction
from scroll_tactile.signals.stream import Stream
from scroll_tactile.statistics.annotations import NO_ANNOTATION, Annotation

__all__ = ["Ledger", "give_back_scratch"]

logger = logging.getLogger(__name__)

Answer = TypeVar("Answer")

CHECKPOINT_EVERY = 128  # rows between checkpoints: opening embeds so many again in half a second
MOST_CHANGES = 1024  # that are remembered for those who follow
# A checkpoint writes all materials, so many of them in the time that one touch takes to learn: it waits until as long
# was spent on touches. With 100 000 materials and a row for each 16, writing took twice as long as learning.
MATERIALS_PER_ROW = 8


class Ledger:
    """The memory of one learner, the store that keeps it, and all that changes it.

    empty: a memory of the recipe. bare: whether rows of observations hold readings alone, to be embedded again when
    they are read.

    lock: held by whoever reads or changes the memory. version: grows with each change of the observations. described:
    grows with each change of a description. watched: the rows that health was last read from, by some rules; not there
    while they are read. lost: grows where a change was cut short, whose rows may not be in the journal. saves: whether
    checkpoints are written; the journal alone has every row, too.
    """

    def __init__(self, empty: Memory, store: AnyStore, bare: bool) -> None:
        self.store = store
        self.lock = threading.RLock()
        self.version = self.described = self.lost = 0
        self.saves = self.path is not None
        self.watched: dict[WatchRules, WatchedRows] = {}
        self._empty, self._bare = empty, bare
        self._memory = load(empty, store)
        self._axes: dict[str, tuple[int, Memory]] = {}
        self._changes: deque[Sequence[Changed] | None] = deque(maxlen=MOST_CHANGES)
        self._saved, self._saved_weighings = self._memory.saved, dict(self._memory.weighings)
        self._closed = self._batching = False
        self._whole = True

    @property
    def path(self) -> Path | None:
        """The folder of the memory; None where it is in memory only."""
        return self.store.path if isinstance(self.store, Store) else None

    @property
    def memory(self) -> Memory:
        """The memory. If a change was cut short it is read again."""
        if not self._whole:
            with self.lock:  # or a thread that is changing it would be taken for one that was cut short
                if not self._whole:
                    self.lost += 1
                    self._read_again()
        return self._memory

    def _read_again(self) -> None:
        read = load(self._empty, self.store)
        read.retractions += self._memory.retractions + 1  # what was fitted to it may hold what is gone
        self._changed(None)
        self._memory, self._whole = read, True

    def memory_of(self, axis: str) -> Memory:
        """What was learned by the labels on an axis, in place of materials; of the axis "" the memory itself."""
        memory = self.memory
        if not axis:
            return memory
        version, found = self._axes.get(axis, (-1, memory))
        if version != self.version:
            self._axes[axis] = self.version, (found := memory.of_axis(axis))
        return found

    def read(self, what: Callable[[Memory, AnyStore], Answer]) -> Answer:
        """What is read of the memory and its journal, while nobody changes them."""
        with self.lock:
            return what(self.memory, self.store)

    def names(self, key: bytes) -> list[str]:
        """The names of a touch with this content hash. Raises StoreError."""
        return self.read(lambda memory, store: list(rows_with(store, memory, key)))

    @property
    def correction(self) -> Correction | None:
        """Through which new touches are read; None where the skin is the one that learned."""
        return self.read(lambda memory, _: memory.correction)

    def _changed(self, touches: Sequence[Changed] | None) -> None:
        self.version += 1
        self._changes.append(touches)

    def changed_since(self, version: int, axis: str = "") -> set[str] | None:
        """The materials, or labels on an axis, of touches that came or went since a version.

        None where something else has changed, or it is too long ago.
        """
        found: set[str] = set()
        if self.version - version > len(self._changes):
            return None
        for touches in islice(reversed(self._changes), self.version - version):
            if touches is None:
                return None
            labels = ((touch.material if not axis else dict(touch.labels).get(axis)) for touch in touches)
            found |= {label for label in labels if label is not None}
        return found

    def require_open(self) -> AnyStore:
        """The store. Raises StoreClosedError after `close`."""
        if self._closed:
            where = "in RAM is closed: copy it before" if self.path is None else f"{self.path} is closed: open it again"
            raise StoreClosedError(f"the memory {where}")
        return self.store

    def require_folder(self, doing: str) -> Store:
        """The store in a folder. Raises InputError where there is none."""
        if isinstance(store := self.require_open(), Store):
            return store
        raise InputError(f"a memory without a path cannot {doing}: TactileLearner.open(path, ...) makes one that can")

    def merged_from(self) -> Path | RamStore:
        """Where another memory finds this one, to merge it: its folder, or its rows as they are now."""
        with self.lock:
            store = self.require_open()
            return store.path if isinstance(store, Store) else store.copy()

    def require_write_mode(self) -> AnyStore:
        """The store. Raises ReadOnlyError, before any work is done, where the journal takes no row."""
        store = self.require_open()
        if store.mode == "read":
            raise ReadOnlyError(f'{store.path} was opened with mode="read": open it to write')
        return store

    def require_writing(self) -> AnyStore:
        """The store. Raises, before any work is done, if no checkpoint could be written."""
        self.require_open()
        if self._batching:
            raise InputError("no checkpoint can be written in a batch: end it first")
        store = self.require_write_mode()
        self._pass_over_failures()
        return store

    def _pass_over_failures(self) -> None:
        try:
            self.store.flush()
        except StoreError as error:  # an earlier checkpoint's: otherwise the next commit would raise it
            logger.warning("%s: no checkpoint could be written: %s", self.store.path, error)

    def _require_no_batch(self, what: str) -> None:
        if self._batching:
            raise InputError(f"{what} is a batch of its own: end the batch before it")

    def append(
        self,
        kind: str,
        label: str,
        key: bytes = b"",
        *,
        attributes: Mapping[str, Any],
        arrays: Arrays | None = None,
        time: float | None = None,
        codes: Codes | None = None,
        gone: Mapping[int, Record] | None = None,
        chosen: Memory | None = None,
        summed: bool = False,
    ) -> int:
        """Append a row to the journal, then apply it; returns its number.

        codes, gone, summed: see `apply`. chosen: what is chosen after a retraction, see `chosen_without`.
        """
        memory = self.memory
        self._whole = False
        try:
            head = self.store.append(kind, label, key, attributes=attributes, arrays=arrays, time=time)
        except StoreError:
            self._whole = not self._batching  # in a batch, rows before it may be lost, too
            raise
        row = Record(**vars(head) | {"arrays": arrays or {}})
        changed = apply(memory, row, self.store, codes, gone=gone, summed=summed)
        if chosen is not None:
            memory.take_chosen(chosen)
        if changed != []:
            self._changed(changed)
        self._whole = True
        return head.sequence

    @contextmanager
    def _together(self) -> Iterator[None]:
        """Rows that are durable together, or not there."""
        self._batching = True
        try:
            with self.store.batch():
                yield
        except BaseException:
            self._whole = False
            raise
        finally:
            self._batching = False

    @contextmanager
    def batch(self) -> Iterator[None]:
        """As `TactileLearner.batch`."""
        with self.lock:
            self.require_write_mode()
            if self._batching:
                yield
                return
            raised: BaseException | None = None
            with self._together():
                try:
                    yield
                except BaseException as error:  # the store must not see it: it would undo the batch
                    raised = error
            self.checkpoint_if_due()
            if raised is not None:
                raise raised

    def observe(
        self,
        material: str,
        stream: Stream,
        columns: int,
        codes: Codes,
        source: str | None = None,
        annotation: Annotation = NO_ANNOTATION,
    ) -> Receipt:
        """Learn a touch; durable on return, in a batch at its end.

        Of a touch that the memory has under this name nothing is learned. Raises AnnotationError for one that it has
        with another annotation.
        """
        require_row(stream)
        with self.lock:
            self.require_write_mode()
            memory = self.memory
            known = self._known(material, stream.key, annotation)
            if known is None and stream.raw is not None:  # learned before the memory was adapted
                known = self._known(material, stream.raw.key, annotation)
            if known is None:
                # Checked before the row is in the journal: the next opening must be able to add every row.
                memory.statistics.require_room(codes)
                memory.targets.require_room(annotation)
                # Readings of every stream are kept, not of exemplars alone: any can take the place of a retracted one.
                kept = self._bare or memory.exemplars is not None or memory.kept is not None
                attributes: dict[str, Any] = {"columns": columns} | annotated(annotation)
                attributes |= {"nbytes": stream.readings.nbytes} if kept else {}
                attributes |= {SOURCE: source} if source else {}
                if (numbers := channel_numbers(stream)) is not None:
                    attributes[CHANNELS] = to_text(numbers)
                arrays = (pack_readings(stream.readings) if kept else {}) | ({} if self._bare else pack_codes(codes))
                row = self.append(OBSERVE, material, stream.key, attributes=attributes, arrays=arrays, codes=codes)
                self.checkpoint_if_due()
            return Receipt(
                sequence=row if known is None else known,
                material=material,
                key=stream.key,
                seconds=stream.seconds,
                clipped=stream.clipped,
                durable=self.path is not None and not self._batching,
                repeated=known is not None,
            )

    def _known(self, material: str, key: bytes, annotation: Annotation) -> int | None:
        """The row that has a touch under this name; None where there is none.

        Raises AnnotationError where it has the touch annotated otherwise than is said, if anything is.
        """
        sequence, there = rows_with(self.store, self.memory, key).get(material, (None, annotation))
        if annotation and there != annotation:
            quantities = self.memory.quantities
            raise AnnotationError(
                f"observation {sequence} has this touch of {material!r} with {there.shown(quantities)}; came "
                f"{annotation.shown(quantities)}. Retract it first, which takes a row that was not compacted"
            )
        return sequence

    def _note(self, kind: str, label: str, attributes: dict[str, Any]) -> int:
        """Append and apply a row that has no arrays."""
        sequence = self.append(kind, label, attributes=attributes)
        self.checkpoint_if_due()
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
            self.require_open()
            self._note(SENSE, material, {"columns": len(stream), CHANNELS: to_text(numbers)})

    def adapt(self, correction: Correction) -> int:
        """Read touches through a correction from now on; durable when this returns, in a batch at its end.

        Returns its row in the journal. The model stays: what was learned is what it was.
        """
        text = correction.to_text()
        with self.lock:
            self.require_open()
            # What replay would refuse must not come into the journal.
            Correction.from_text(text, self.memory.recipe.sensor)
            return self._note(ADAPT, "", {CORRECTION: text})

    def retract(self, receipt: Receipt | Adaptation | int) -> None:
        """As `TactileLearner.retract`."""
        with self.lock:
            store = self.require_open()
            if (adaptation := adaptation_of(store, self.memory, receipt)) is not None:
                self._note(ADAPT, "", {RETRACTS: adaptation})  # the one before it counts again, if there is one
                return
            assert not isinstance(receipt, Adaptation)
            self._retract([observation_of(store, self.memory, receipt)], "")
            self.checkpoint_if_due()

    def forget(self, material: str | None, source: str | None) -> int:
        """As `TactileLearner.forget`."""
        with self.lock:
            store, memory = self.require_open(), self.memory
            found = observations_to_forget(store, memory, material, source)
            self._retract([store.record(sequence) for sequence in found], material or "")
            self.checkpoint_if_due()
        return len(found)

    def _retract(self, records: Sequence[Record], material: str) -> None:
        gone = {record.sequence: record for record in records}
        chosen = chosen_without(self.memory, self.store, gone)
        self.append(RETRACT, material, attributes={"sequences": spans(gone)}, gone=gone, chosen=chosen)

    def relabel(self, receipt: Receipt | int, material: str) -> int:
        """As `TactileLearner.relabel`."""
        with self.lock:
            store = self.require_open()
            self._require_no_batch("a relabelling")
            record = observation_of(store, self.memory, receipt)
            if record.label == material:
                raise InputError(f"observation {record.sequence} of {store.path} is called {material!r} already")
            known = self._known(material, record.key, annotation_of(record.attributes))
            with self._together():
                self._retract([record], "")
                kept: Any = {"attributes": record.attributes, "arrays": record.arrays, "time": record.time}
                sequence = self.append(OBSERVE, material, record.key, **kept) if known is None else known
            self.checkpoint_if_due()
            return sequence

    def merge(
        self,
        other: str | os.PathLike[str] | RamStore,
        rules: MergeRules,
        progress: Callable[[str, int, int], object],
    ) -> tuple[Merged, list[tuple[Head, str]]]:
        """As `TactileLearner.merge`; also returns the rows of the other memory that are refused, and why.

        Raises ObservationError also where a refused row was compacted there, and cannot be left out.
        """
        with self.lock:
            store, memory = self.require_open(), self.memory
            self._require_no_batch("a merge")
            with _opened(other) as source:
                merge = Merge(store, memory, source, rules)
                sums = merge.sums()
                with self._together():
                    for done, row in enumerate(merge.rows(), start=1):
                        self.append(**row, summed=sums is not None)
                        progress("merging", done, merge.total)
                    if sums is not None:
                        memory.join(sums, exemplars=False)
            self._changed(None)
            self.checkpoint_if_due()
        return Merged(merge.added, merge.shared, len(merge.descriptions)), merge.refused

    def compact(self, keep: int) -> Compacted:
        """As `TactileLearner.compact`."""
        with self.lock:
            store, memory = self.require_open(), self.memory
            last_sequence = compaction_point(store, memory, keep)
            before = sum(store.size().values())
            self.require_writing()
            if last_sequence > memory.compacted:
                store.compaction()  # raises where it is damaged: the new one is made from it
                # The newest state has the tuned model, which the compaction checkpoint may lack.
                newest = memory.to_arrays() if last_sequence < memory.sequence else None
                kept = until(memory, store, last_sequence) if last_sequence < memory.sequence else memory
                arrays, attributes = kept.to_arrays(last_sequence, exemplar_candidates(kept, store))
                self._whole = False
                store.compact(arrays, last_sequence=last_sequence, attributes=attributes, newest=newest)
                self._saved, self._saved_weighings = memory.sequence, {}  # it has none
                memory.compacted = last_sequence
                self._whole = True
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
            made = copy(memory)
            made.tuned, made.tuned_last_sequence = tuned, last_sequence
            arrays, attributes = made.to_arrays()
            self._saved = -1  # where this is cut short it may be current already: closing writes the one before again
            self.store.commit(arrays, last_sequence=memory.sequence, attributes=attributes)
            memory.tuned, memory.tuned_last_sequence = tuned, last_sequence
            self._note_saved()

    def refresh(self) -> bool:
        """As `TactileLearner.refresh`."""
        with self.lock:
            store, memory = self.require_open(), self.memory
            if isinstance(store, RamStore) or store.mode == "write":
                return False
            state = store.state()
            if state == (memory.sequence, memory.checkpoint, memory.compacted):
                return False
            try:
                if state.compacted == memory.compacted and state.last - memory.sequence <= CHECKPOINT_EVERY:
                    records = list(store.records(after=memory.sequence))  # one may be damaged: before any change
                    self._whole = False
                    self._changed(apply_appended(memory, store, records))
                    self._whole = True
                    return True
            except CompactedError:  # just now, and a retraction needs what is gone
                pass
            self._read_again()
            return True

    def checkpoint_if_due(self) -> None:
        """Write a checkpoint in a thread, where many rows came since the last."""
        rows = max(CHECKPOINT_EVERY, self._memory.statistics.material_count // MATERIALS_PER_ROW)
        if not self.saves or self._batching or self._memory.sequence - self._saved < rows:
            return
        if not self._whole or self._memory.stale:  # half a change, or samples with what is gone: the journal has it all
            return
        arrays, attributes = self._memory.to_arrays()
        try:
            self.store.commit_later(arrays, last_sequence=self._memory.sequence, attributes=attributes)
        except StoreError as error:
            # The journal has it all; only the next opening has more to replay.
            logger.warning("%s: no checkpoint could be written: %s", self.store.path, error)
        self._note_saved()
        del arrays
        give_back_scratch()

    def save(self) -> None:
        """Write a checkpoint, if rows came since the last."""
        if self._memory.sequence > self._saved or self._memory.weighings != self._saved_weighings:
            self._pass_over_failures()
            self._write_checkpoint()

    def _write_checkpoint(self) -> None:
        arrays, attributes = self._memory.to_arrays()
        self.store.commit(arrays, last_sequence=self._memory.sequence, attributes=attributes)
        self._note_saved()

    def _note_saved(self) -> None:
        self._saved, self._saved_weighings = self._memory.sequence, dict(self._memory.weighings)

    def close(self, weighings: Mapping[str, str]) -> None:
        """As `TactileLearner.close`. weighings: see `Memory`."""
        with self.lock:
            if self._batching:
                raise InputError("a memory cannot be closed in a batch: end it first")
            store, closed, self._closed = self.store, self._closed, True
            if closed:
                return
            try:
                # A change that was cut short is never saved: the journal holds all of it, or nothing.
                if store.mode == "write" and self.saves and self._whole:
                    self._memory.weighings |= weighings
                    self.save()
            finally:
                store.close()
                give_back_scratch()


@contextmanager
def _opened(other: str | os.PathLike[str] | RamStore) -> Iterator[AnyStore]:
    """Another memory, to be merged."""
    if isinstance(other, RamStore):
        yield other
        return
    with MemoryStore.open(other, mode="read") as source:
        yield source


def give_back_scratch() -> None:
    """Return freed memory to the system where the C library can: fitting and saving leave 40 MB of it."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
