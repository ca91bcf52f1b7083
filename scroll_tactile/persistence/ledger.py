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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from copy import copy
from itertools import takewhile
from pathlib import Path
from typing import Any, TypeVar

from scroll_tactile_store import CompactedError, Head, ReadOnlyError, Record, Store, StoreClosedError, StoreError

from scroll_tactile.errors import AnnotationError, DescriptionError, FineTuneError, InputError
from scroll_tactile.health.channel_numbers import MOST_CHANNELS, channel_numbers, to_text
from scroll_tactile.health.watch import WatchedRows, WatchRules
from scroll_tactile.memory.descriptions import Description, require_units
from scroll_tactile.memory.gate import MemoryStore
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import (
    Changed,
    Codes,
    Kind,
    annotated,
    annotation_of,
    pack_codes,
    pack_readings,
    require_row,
    spans,
)
from scroll_tactile.memory.tuned import Tuned
from scroll_tactile.persistence.merge import Merge
from scroll_tactile.persistence.observations import adaptation_of, compaction_end, observation_of, rows_with, to_forget
from scroll_tactile.persistence.ram_store import AnyStore, RamStore
from scroll_tactile.persistence.replaying import apply, chosen_without, exemplar_candidates, follow, load, until
from scroll_tactile.quantities import Quantity, require_declarable
from scroll_tactile.results import Adaptation, Compacted, Merged, Receipt
from scroll_tactile.signals.correction import Correction
from scroll_tactile.signals.stream import Stream
from scroll_tactile.statistics.annotations import NO_ANNOTATION, Annotation

__all__ = ["Ledger", "give_back_scratch"]

logger = logging.getLogger(__name__)

Answer = TypeVar("Answer")

CHECKPOINT_EVERY = 128  # rows between checkpoints: opening embeds so many again in half a second


class Ledger:
    """The memory of one learner, the store that keeps it, and all that changes it.

    empty: a memory of the recipe. bare: whether rows of observations hold readings alone, to be embedded again when
    they are read.

    lock: held by whoever reads or changes the memory. version: grows with each change of observations and descriptions.
    watched: the rows that health was last read from, by some rules; others after a change that was cut short, whose
    rows may not be in the journal. saves: whether checkpoints are written; the journal alone has every row, too.
    """

    def __init__(self, empty: Memory, store: AnyStore, bare: bool) -> None:
        self.store = store
        self.lock = threading.RLock()
        self.version, self.saves = 0, True
        self.watched: dict[WatchRules, WatchedRows] = {}
        self._empty, self._bare = empty, bare
        self._memory = load(empty, store)
        self._axes: dict[str, tuple[int, Memory]] = {}
        self._touched: dict[tuple[str, str], int] = {}  # (axis, label), of materials ("", name) → the last version
        self._renewed = 0  # the last version in which anything may have changed
        self._saved_weighings = dict(self._memory.weighings)
        self._closed, self._batching, self._whole = False, False, True

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
                    self._read_again()
        return self._memory

    def _read_again(self) -> None:
        if isinstance(self.store, Store):
            self.store.state()  # a reader looks what there is now: what it saw last may be damaged, and mended since
        read = load(self._empty, self.store)
        read.retractions += self._memory.retractions + 1  # what was fitted to it may hold what is gone
        self._changed(None)
        self._memory, self._whole, self.watched = read, True, {}

    def memory_of(self, axis: str) -> Memory:
        """What was learned by the labels on an axis, in place of materials; of the axis "" the memory itself."""
        memory = self.memory
        if axis and (axis not in self._axes or self._axes[axis][0] != self.version):
            self._axes[axis] = self.version, memory.of_axis(axis)
        return self._axes[axis][1] if axis else memory

    def read(self, what: Callable[[Memory, AnyStore], Answer]) -> Answer:
        """What is read of the memory and its journal, while nobody changes them."""
        with self.lock:
            return what(self.memory, self.store)

    @property
    def correction(self) -> Correction | None:
        """Through which new touches are read; None where the skin is the one that learned."""
        return self.read(lambda memory, _: memory.correction)

    def _changed(self, touches: Iterable[Changed] | None) -> None:
        self.version += 1
        if touches is None:
            self._renewed = self.version
        for touch in touches or ():
            for name in (("", touch.material), *touch.labels):
                self._touched.pop(name, None)  # the last that were touched are the last in it
                self._touched[name] = self.version

    def changed_since(self, version: int, axis: str = "") -> set[str] | None:
        """The materials, or labels on an axis, of touches that came or went since a version.

        None where something else has changed.
        """
        if version < self._renewed:
            return None
        since = takewhile(lambda item: item[1] > version, reversed(self._touched.items()))
        return {name for (of, name), _ in since if of == axis}

    def require_open(self, *, to_write: bool = False) -> AnyStore:
        """The store. Raises StoreClosedError after `close`; to_write: ReadOnlyError where it takes no row."""
        if self._closed:
            raise StoreClosedError(f"{self.store.path} is closed: open it again")
        if to_write and self.store.mode == "read":
            raise ReadOnlyError(f'{self.store.path} was opened with mode="read": open it to write')
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
            return store.path if isinstance(store, Store) else copy(store)

    def require_writing(self) -> None:
        """Raise, before any work is done, if no checkpoint could be written."""
        self.require_open(to_write=True)
        if self._batching:
            raise InputError("no checkpoint can be written in a batch: end it first")
        self._pass_over_failures()

    def _pass_over_failures(self) -> None:
        try:
            self.store.flush()
        except StoreError as error:  # an earlier checkpoint's: otherwise the next commit would raise it
            logger.warning("%s: no checkpoint could be written: %s", self.store.path, error)

    def append(
        self, kind: str, label: str, key: bytes = b"", *, chosen: Memory | None = None, applied: Any = None, **row: Any
    ) -> int:
        """Append a row to the journal, then apply it; returns its number.

        row: see `Store.append`. applied: how it is applied, see `apply`. chosen: see `chosen_without`.
        """
        with self.lock:
            store, memory = self.require_open(), self.memory
            self._whole = False
            try:
                head = store.append(kind, label, key, **row)
            except StoreError:
                self._whole = not self._batching  # in a batch, rows before it may be lost, too
                raise
            record = Record(**vars(head) | {"arrays": row.get("arrays") or {}})
            changed = apply(memory, record, store, **applied or {})
            if chosen is not None:
                memory.take_chosen(chosen)
            if changed != []:
                self._changed(changed)
            self._whole = True
            self.checkpoint_if_due()
            return head.sequence

    @contextmanager
    def batch(self, *, whole: bool = False) -> Iterator[None]:
        """As `TactileLearner.batch`. whole: after an exception none of it is kept, nor can it be within another one."""
        with self.lock:
            self.require_open(to_write=True)
            if self._batching and whole:
                raise InputError("this is a batch of its own: end the batch before it")
            if self._batching:
                yield
                return
            begun, raised = self.memory.sequence, None
            self._batching = True
            try:
                with self.store.batch():
                    try:
                        yield
                    except BaseException as error:
                        if whole:  # else the store must not see it: it would undo the batch
                            raise
                        raised = error
            except BaseException:
                self._whole = self._whole and self._memory.sequence == begun
                raise
            finally:
                self._batching = False
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
            self.require_open(to_write=True)
            memory = self.memory
            keys = [of.key for of in (stream, stream.raw) if of is not None]  # it may be from before an adaptation
            rows = (self._known(material, key, annotation) for key in keys)
            known = next((row for row in rows if row is not None), None)
            if known is None:
                # Checked before the row is in the journal: the next opening must be able to add every row.
                memory.statistics.require_room(codes)
                memory.targets.require_room(annotation)
                # Readings of every stream are kept, not of exemplars alone: any can take the place of a retracted one.
                kept = self._bare or memory.exemplars is not None or memory.kept is not None
                attributes: dict[str, Any] = {"columns": columns} | annotated(annotation)
                attributes |= {"nbytes": stream.readings.nbytes} if kept else {}
                attributes |= {"source": source} if source else {}
                if (numbers := channel_numbers(stream)) is not None:
                    attributes["channels"] = to_text(numbers)
                arrays = (pack_readings(stream.readings) if kept else {}) | ({} if self._bare else pack_codes(codes))
                about: Any = {"attributes": attributes, "arrays": arrays, "applied": {"codes": codes}}
                row = self.append(Kind.OBSERVE, material, stream.key, **about)
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
        """The row that has a touch under this name. Raises AnnotationError where that says otherwise of it."""
        sequence, there = rows_with(self.store, self.memory, key).get(material, (None, annotation))
        if annotation and there != annotation:
            quantities = self.memory.quantities
            raise AnnotationError(
                f"observation {sequence} has this touch of {material!r} with {there.shown(quantities)}; came "
                f"{annotation.shown(quantities)}. Retract it first, which takes a row that was not compacted"
            )
        return sequence

    def describe(self, material: str, constituents: Description | None) -> None:
        """As `TactileLearner.describe`, for a description that was checked."""
        with self.lock:
            self.require_open()
            memory = self.memory
            if repr(memory.descriptions.get(material)) == repr(constituents):  # 1.0 == True, but means another thing
                return
            require_units(memory.descriptions, material, constituents or {})
            self.append(Kind.DESCRIBE, material, attributes={"constituents": constituents})
            self._changed(())

    def declare(self, quantity: Quantity) -> None:
        """As `TactileLearner.declare`."""
        with self.lock:
            self.require_open()
            if require_declarable(self.memory.quantities, quantity):
                self.append(Kind.DECLARE, quantity.name, attributes=quantity.model_dump(exclude={"name"}))

    def sense(self, material: str, stream: Stream) -> None:
        """As `TactileLearner.sense`; material "" for the sensor at rest."""
        numbers = channel_numbers(stream)
        if numbers is None:
            raise InputError(
                f"the health of a sensor is told from its channels, 1 to {MOST_CHANNELS}, and three readings or more; "
                f"came {len(stream)} readings of {stream.sensor.name!r}"
            )
        self.append(Kind.SENSE, material, attributes={"columns": len(stream), "channels": to_text(numbers)})

    def adapt(self, correction: Correction) -> int:
        """Read touches through a correction from now on; durable on return, in a batch at its end. Returns its row."""
        text = correction.to_text()
        Correction.from_text(text, self._empty.recipe.sensor)  # what replay would refuse must not come into the journal
        return self.append(Kind.ADAPT, "", attributes={"correction": text})

    def retract(self, receipt: Receipt | Adaptation | int) -> None:
        """As `TactileLearner.retract`."""
        with self.lock:
            store = self.require_open()
            if (adaptation := adaptation_of(self.memory, receipt)) is not None:
                self.append(Kind.ADAPT, "", attributes={"retracts": adaptation})  # one before it counts again
            else:
                self._retract([observation_of(store, self.memory, receipt)], "")

    def forget(self, material: str | None, source: str | None) -> int:
        """As `TactileLearner.forget`."""
        with self.lock:
            store, memory = self.require_open(), self.memory
            found = to_forget(store, memory, material, source)
            self._retract([store.record(sequence) for sequence in found], material or "")
        return len(found)

    def _retract(self, records: Sequence[Record], material: str) -> None:
        gone = {record.sequence: record for record in records}
        how: Any = {"chosen": chosen_without(self.memory, self.store, gone), "applied": {"gone": gone}}
        self.append(Kind.RETRACT, material, attributes={"sequences": spans(gone)}, **how)

    def relabel(self, receipt: Receipt | int, material: str) -> int:
        """As `TactileLearner.relabel`."""
        with self.batch(whole=True):
            record = observation_of(self.store, self.memory, receipt)
            if record.label == material:
                raise InputError(f"observation {record.sequence} of {self.store.path} is called {material!r} already")
            known = self._known(material, record.key, annotation_of(record.attributes))
            self._retract([record], "")
            kept: Any = {"attributes": record.attributes, "arrays": record.arrays, "time": record.time}
            return self.append(Kind.OBSERVE, material, record.key, **kept) if known is None else known

    def merge(
        self, other: str | os.PathLike[str] | RamStore, progress: Callable[[str, int, int], object], **how: Any
    ) -> tuple[Merged, list[tuple[Head, str]]]:
        """As `TactileLearner.merge`; also returns the rows of the other memory that are refused, and why.

        how: see `Merge`. Raises ObservationError also where a refused row was compacted there, and cannot be left out.
        """
        opened = nullcontext(other) if isinstance(other, RamStore) else MemoryStore.open(other, mode="read")
        with self.lock, opened as source:
            merge = Merge(self.require_open(), self.memory, source, **how)
            with self.batch(whole=True):
                try:
                    for quantity in merge.quantities:
                        self.declare(quantity)
                    for material, constituents in merge.descriptions.items():
                        require_units({**self.memory.descriptions, **merge.descriptions}, material, constituents)
                        self.append(Kind.DESCRIBE, material, attributes={"constituents": constituents})
                except (AnnotationError, DescriptionError) as error:
                    raise merge.refusing(error) from None
                for done, row in enumerate(merge.rows(), start=1):
                    self.append(**row, applied={"summed": merge.sums is not None})
                    progress("merging", done, merge.total)
                if merge.sums is not None:
                    self.memory.join(merge.sums, exemplars=False)
                self._changed(None)
        return Merged(merge.added, merge.shared, len(merge.descriptions)), merge.refused

    def compact(self, keep: int) -> Compacted:
        """As `TactileLearner.compact`."""
        with self.lock:
            store, memory = self.require_open(), self.memory
            last_sequence = compaction_end(store, memory, keep)
            before = sum(store.size().values())
            self.require_writing()
            if last_sequence > memory.compacted:
                # The newest state has the tuned model, which the compaction checkpoint may lack.
                newest = memory.to_arrays() if last_sequence < memory.sequence else None
                kept = until(memory, store, last_sequence) if last_sequence < memory.sequence else memory
                arrays, attributes = kept.to_arrays(last_sequence, exemplar_candidates(kept, store))
                self._whole = False
                store.compact(arrays, last_sequence=last_sequence, attributes=attributes, newest=newest)
                memory.saved, self._saved_weighings = memory.sequence, {}  # it has none
                memory.compacted = last_sequence
                self._whole = True
                give_back_scratch()
            return Compacted(memory.compacted, before, sum(store.size().values()))

    def keep_tuned(self, tuned: Tuned, last_sequence: int, retractions: int) -> None:
        """Keep the tuned model, durably. Raises FineTuneError where something was retracted since its training began.

        last_sequence, retractions: the memory's last row and its count of retractions when it began.
        """
        with self.lock:
            self.require_writing()
            memory = self.memory
            if memory.retractions != retractions:  # or it was read again
                raise FineTuneError("what the tuned model was being made from was retracted meanwhile: fine-tune again")
            made = copy(memory)
            made.tuned, made.tuned_last_sequence = tuned, last_sequence
            arrays, attributes = made.to_arrays()
            memory.saved = -1  # where this is cut short it may be current already: closing writes the one before again
            self.store.commit(arrays, last_sequence=memory.sequence, attributes=attributes)
            memory.tuned, memory.tuned_last_sequence, memory.saved = tuned, last_sequence, memory.sequence
            self._saved_weighings = dict(memory.weighings)

    def refresh(self) -> bool:
        """As `TactileLearner.refresh`."""
        with self.lock:
            store, memory = self.require_open(), self.memory
            if not isinstance(store, Store) or store.mode == "write":
                return False
            state = store.state()
            if state == (memory.sequence, memory.checkpoint, memory.compacted):
                return False
            near = state.last - memory.sequence <= CHECKPOINT_EVERY
            with suppress(CompactedError):  # just now, and a retraction needs what is gone
                if near and state.compacted == memory.compacted:
                    records = list(store.records(after=memory.sequence))  # one may be damaged: before any change
                    self._whole = False
                    self._changed(follow(memory, store, records))
                    self._whole = True
                    return True
            self._read_again()
            return True

    def checkpoint_if_due(self) -> None:
        """Write a checkpoint in a thread, where many rows came since the last."""
        memory = self._memory
        if not self.saves or self._batching or memory.sequence - memory.saved < CHECKPOINT_EVERY:
            return
        if not self._whole or memory.stale:  # half a change, or samples with what is gone: the journal has it all
            return
        try:
            self._write_checkpoint(later=True)
        except StoreError as error:
            # The journal has it all; only the next opening has more to replay.
            logger.warning("%s: no checkpoint could be written: %s", self.store.path, error)
        give_back_scratch()

    def save(self) -> None:
        """Write a checkpoint, if rows came since the last."""
        if self._memory.sequence > self._memory.saved or self._memory.weighings != self._saved_weighings:
            self._pass_over_failures()
            self._write_checkpoint()

    def _write_checkpoint(self, *, later: bool = False) -> None:
        memory = self._memory
        arrays, attributes = memory.to_arrays()
        memory.saved, self._saved_weighings = memory.sequence, dict(memory.weighings)
        commit = self.store.commit_later if later else self.store.commit
        commit(arrays, last_sequence=memory.sequence, attributes=attributes)

    def close(self, weighings: Mapping[str, str]) -> None:
        """As `TactileLearner.close`. weighings: see `Memory`."""
        with self.lock:
            if self._batching:
                raise InputError("a memory cannot be closed in a batch: end it first")
            if self._closed:
                return
            self._closed = True
            try:
                # A change that was cut short is never saved: the journal holds all of it, or nothing.
                if self.store.mode == "write" and self.saves and self._whole:
                    self._memory.weighings |= weighings
                    self.save()
            finally:
                self.store.close()
                give_back_scratch()


def give_back_scratch() -> None:
    """Return freed memory to the system where the C library can: fitting and saving leave 40 MB of it."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
