"""A memory and the store that keeps it: a change is durable when its method returns, and whole or not there at all."""

from __future__ import annotations

import itertools
import logging
import os
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FineTuneError, InputError, ScrollTactileError
from scroll_tactile.memory.buffer import candidates_of, ranked_exemplars
from scroll_tactile.memory.changes import apply_appended, relabel
from scroll_tactile.memory.contents import Contents, StoredContents
from scroll_tactile.memory.descriptions import Description
from scroll_tactile.memory.exemplars import Exemplar
from scroll_tactile.memory.gate import MemoryStore
from scroll_tactile.memory.merge import Choice, MergePlan
from scroll_tactile.memory.observations import compaction_point, observation_of, observations_from, observations_of
from scroll_tactile.memory.packing import pack_memory
from scroll_tactile.memory.rows import (
    DESCRIBE,
    MEMBER,
    OBSERVE,
    RETRACT,
    SOURCE,
    Added,
    Codes,
    pack_codes,
    pack_readings,
    require_row,
    spans,
)
from scroll_tactile.memory.state import Memory, give_back_scratch
from scroll_tactile.memory.tuned import Tuned
from scroll_tactile.results import Compacted, Merged, Receipt
from scroll_tactile.signals.stream import Stream
from store import (
    Checkpoint,
    CompactedError,
    DamageError,
    Head,
    ReadOnlyError,
    Record,
    Store,
    StoreClosedError,
    StoreError,
)

__all__ = ["Ledger"]

logger = logging.getLogger(__name__)

Derived = tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]
"""Arrays and attributes."""

MOST_ADDED = 1024  # touches: a model is fitted again long before
SNAPSHOT_EVERY = 128  # rows between checkpoints: opening embeds so many again in half a second
LOOKS = 5  # of a reader at a memory that is written to meanwhile, before it is read anew
MATERIALS_A_ROW = 16  # and where there are many materials, as many rows as a part of them: a checkpoint has all


class Ledger:
    """The memory of one learner and the store that keeps it.

    load: reads the memory from the store, or makes an empty one without a store. bare: whether rows of observations
    hold readings alone, to be embedded again when they are read. contents: which touches a memory without a store has;
    None where nothing says.

    lock: held by whoever reads or changes the memory. version: grows with each change of what was observed.
    described: grows with each change of a description. added: where `follow` is set, what was observed and retracted
    since it was last cleared; None where that is too much, or more has changed. saves: whether checkpoints are written;
    without them the journal still has all.
    """

    def __init__(
        self,
        load: Callable[[], Memory],
        store: Store | None = None,
        bare: bool = False,
        contents: Contents | None = None,
    ) -> None:
        self.store = store
        self._contents = contents
        self._bare = bare
        self.lock = threading.RLock()
        self.version = 0
        self.described = 0
        self.follow = False
        self.saves = True
        self.added: list[Added] | None = []
        self._load = load
        self._memory = load()
        self._saved = self._memory.saved
        self._closed = False
        self._whole = True
        self._undo: Callable[[], None] | None = None
        self._batching = False

    @property
    def memory(self) -> Memory:
        """The memory; after a change that was cut short, by ctrl-C, say, it is read again, or the change is undone."""
        if not self._whole:
            if self._undo is not None:
                self._undo()
            else:
                self._memory = self._load()
            self._whole = True
            self._changed()
        return self._memory

    def contents(self) -> Contents | StoredContents:
        """Which touches the memory has, by their content; whoever calls holds the lock.

        Raises StoreClosedError for a snapshot of a memory that was closed before anybody asked.
        """
        _ = self.memory  # where a change was cut short, it is read again
        if self.store is not None:
            return StoredContents(self.store, lambda: self._memory)
        if self._contents is None:
            raise StoreClosedError(
                "this is a snapshot of a memory that was closed, which does not say what touches it has: make it "
                "before the memory is closed, or observe with again=True"
            )
        return self._contents

    def copied_contents(self) -> Contents | None:
        """All that `contents` has, to be changed apart; None where nobody knows."""
        memory, store = self.memory, self.store
        if store is None or self._closed:
            return None if self._contents is None else self._contents.copy()
        heads = itertools.takewhile(lambda head: head.sequence <= memory.sequence, _sound(store))
        stand = (head for head in heads if head.kind in (OBSERVE, MEMBER) and not memory.is_gone(head.sequence))
        return Contents((head.label, head.key, head.sequence) for head in stand)

    def _receipt(self, sequence: int, material: str, stream: Stream, *, repeated: bool = False) -> Receipt:
        durable = self.store is not None and not self._batching
        return Receipt(sequence, material, stream.key, stream.seconds, stream.clipped, durable, repeated)

    @contextmanager
    def _mutation(
        self, revert: Callable[[], None] | None = None, undo: Callable[[], None] | None = None
    ) -> Iterator[None]:
        """A change of the memory and its journal: where it is cut short, the memory is read again before its next use.

        revert: undoes in the memory what the journal refused; None where only reading again can. undo: of a memory
        without a path, which cannot be read again, takes back what was done of the change.
        """
        self._undo, self._whole = undo, False
        try:
            yield
        except StoreError:
            if revert is not None:
                revert()
                self._whole = not self._batching  # a batch that fails loses all that was added in it before
            raise
        self._whole = True

    def _changed(self, added: list[Added] | None = None) -> None:
        self.version += 1
        if added is None or (self.added is not None and len(self.added) + len(added) > MOST_ADDED):
            self.added = None
        elif self.follow and self.added is not None:
            self.added += added

    def require_open(self) -> None:
        """Raise StoreClosedError after `close`."""
        if self._closed:
            where = "in memory" if self.store is None else self.store.path
            raise StoreClosedError(f"the memory {where} is closed: open its path again")

    def require_store(self, doing: str) -> Store:
        """The store. Raises InputError where there is none: what asks for it needs the journal."""
        self.require_open()
        if self.store is None:
            raise InputError(
                f"a memory without a path keeps no journal, and cannot {doing}: TactileLearner.open(path, ...) makes "
                "one that does"
            )
        return self.store

    def require_writing(self) -> None:
        """Raise, before any work is done, what would keep a checkpoint from being written."""
        self.require_open()
        if self.store is None:
            return
        if self._batching:
            raise InputError("no checkpoint can be written in a batch: end it first")
        if self.store.mode == "read":
            raise ReadOnlyError(f'{self.store.path} was opened with mode="read": open it to write')
        self._pass_over_failures(self.store)

    def _pass_over_failures(self, store: Store) -> None:
        try:
            store.flush()
        except StoreError as error:  # of an earlier checkpoint: the next commit would raise it instead of committing
            logger.warning("%s: no checkpoint could be written: %s", store.path, error)

    def observe(
        self,
        material: str,
        stream: Stream,
        columns: int,
        codes: Codes,
        source: str | None = None,
        *,
        again: bool = False,
    ) -> Receipt:
        """Append an observation to the journal, then add it to the memory; again: also one that is there already."""
        require_row(stream)
        with self.lock:
            self.require_open()
            # In a memory opened to read the journal refuses all.
            if not again and (self.store is None or self.store.mode == "write"):
                known = self.contents().find(material, stream.key)
                if known is not None:
                    return self._receipt(known, material, stream, repeated=True)
            # Before the journal has it: every row there must fit at the next opening.
            self.memory.statistics.require_room(codes)
            undo = self._undo_of(material, stream.key, columns) if self.store is None else None
            with self._mutation(_nothing, undo):
                sequence = self._append(material, stream, columns, codes, source)
                if self._contents is not None:
                    self._contents.add(material, stream.key, sequence)
                self._changed([(material, codes, 1)])
            self._snapshot_if_due()
            return self._receipt(sequence, material, stream)

    def _undo_of(self, material: str, key: bytes, columns: int) -> Callable[[], None]:
        """What takes the next observation back, of a memory without a store."""
        memory, sequence = self._memory.undo(material, key, columns), self._memory.sequence + 1

        def undo() -> None:
            memory()
            if self._contents is not None:
                self._contents.remove(material, key, sequence)

        return undo

    def _append(self, material: str, stream: Stream, columns: int, codes: Codes, source: str | None) -> int:
        memory = self._memory
        # Of every stream, not of the exemplars alone: any can take the place of a retracted one.
        kept = self._bare or memory.exemplars is not None or memory.kept is not None
        packed = pack_readings(stream.readings) if kept else {}
        if self.store is None:
            sequence, stages = memory.sequence + 1, memory.plan.scored_stages(columns)
            held = Exemplar.of(material, stream.key, packed, stages, codes) if kept else None
            memory.add(material, stream.key, columns, codes, sequence, held, stream.readings)
            return sequence
        attributes: dict[str, Any] = {"columns": columns}
        attributes |= ({"nbytes": stream.readings.nbytes} if kept else {}) | ({SOURCE: source} if source else {})
        arrays = packed if self._bare else packed | pack_codes(codes)
        head = self.store.append(OBSERVE, material, stream.key, attributes=attributes, arrays=arrays)
        memory.replay(Record(**vars(head), arrays=arrays), self.store, codes)
        return head.sequence

    def describe(self, material: str, constituents: Description | None) -> None:
        """As `TactileLearner.describe`, of what was checked."""
        with self.lock:
            self.require_open()
            memory = self.memory
            if repr(memory.descriptions.get(material)) == repr(constituents):  # 1.0 == True, but means another thing
                return
            before = dict(memory.descriptions)

            def undo() -> None:
                memory.descriptions = before

            with self._mutation(_nothing, undo if self.store is None else None):
                if self.store is not None:
                    attributes = {"constituents": constituents}
                    memory.sequence = self.store.append(DESCRIBE, material, b"", attributes=attributes).sequence
                memory.describe(material, constituents)
                self.described += 1
            self._snapshot_if_due()

    def retract(self, receipt: Receipt | int) -> None:
        """As `TactileLearner.retract`."""
        with self.lock:
            store = self.require_store("retract anything")
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
        # In the memory first: it reads rows again that may be damaged, and after a retraction is in the journal every
        # opening would have to read them.
        store.base()
        memory, sequences = self._memory, spans(record.sequence for record in records)
        before = memory.sample, memory.kept, memory.exemplars, memory.tuned

        def revert() -> None:
            for record in records:
                memory.put_back(record)
            memory.sample, memory.kept, memory.exemplars, memory.tuned = before

        with self._mutation(revert):
            retracted = [memory.retract(record) for record in records]
            memory.refill(store)
            memory.sequence = store.append(RETRACT, material, b"", attributes={"sequences": sequences}).sequence
            memory.describe(material, None)
            self._changed(retracted)
        self._snapshot_if_due()

    def relabel(self, receipt: Receipt | int, material: str) -> int:
        """As `TactileLearner.relabel`."""
        with self.lock:
            store = self.require_store("relabel anything")
            self._require_no_batch("a relabelling")
            record = observation_of(store, self.memory, receipt)
            with self._mutation():
                with store.batch():
                    self._changed(relabel(self._memory, store, record, material))
                sequence = self._memory.sequence
            self._snapshot_if_due()
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
            self._snapshot_if_due()
            if raised is not None:
                raise raised

    def merge(
        self,
        other: str | os.PathLike[str],
        shared: Literal["once", "twice"],
        descriptions: Choice,
        progress: Callable[[str, int, int], object],
    ) -> Merged:
        """As `TactileLearner.merge`."""
        return self._merge(other, shared, descriptions, progress, one_name=False)[0]

    def merge_sources(
        self,
        other: str | os.PathLike[str],
        descriptions: Choice,
        progress: Callable[[str, int, int], object],
        clipped: Collection[bytes] = (),
        said: str | None = None,
        thorough: bool = True,
    ) -> tuple[Merged, list[tuple[Head, str]]]:
        """Merge what was learned from sources: each touch once, and under its first name.

        clipped: contents that clipping made. said: the source of touches that say none. thorough: see `Gate`. Returns
        also the rows there that are refused, and why. Raises ObservationError where one cannot be left out, for what it
        was learned into was compacted.
        """
        return self._merge(
            other, "once", descriptions, progress, one_name=True, clipped=clipped, said=said, thorough=thorough
        )

    def _merge(
        self,
        other: str | os.PathLike[str],
        shared: Literal["once", "twice"],
        descriptions: Choice,
        progress: Callable[[str, int, int], object],
        *,
        one_name: bool,
        clipped: Collection[bytes] = (),
        said: str | None = None,
        thorough: bool = True,
    ) -> tuple[Merged, list[tuple[Head, str]]]:
        with self.lock:
            store, memory = self.require_store("merge"), self.memory
            self._require_no_batch("a merge")
            with MemoryStore.open(other, mode="read") as source:
                source.read_with(memory.plan, thorough=thorough)
                plan = MergePlan.of(
                    store,
                    memory,
                    source,
                    self.contents(),
                    once=shared == "once",
                    one_name=one_name,
                    descriptions=descriptions,
                    clipped=clipped,
                    said=said,
                )
                with self._mutation(), store.batch():
                    added = plan.append_to(store, memory, lambda done, of: progress("merging", done, of))
            self._changed()
            self._snapshot_if_due()
        return Merged(added, plan.shared, len(plan.descriptions)), plan.refused

    def pack(self, path: str | os.PathLike[str], rows: bool, readings: bool, source: str | None) -> None:
        """As `TactileLearner.pack`."""
        with self.lock:
            store, memory = self.require_store("be packed"), self.memory
            pack_memory(store, memory, Path(path), rows=rows, readings=readings, source=source)

    def compact(self, keep: int) -> Compacted:
        """As `TactileLearner.compact`."""
        with self.lock:
            store, memory = self.require_store("compact"), self.memory
            upto = compaction_point(store, memory, keep)
            before = sum(store.size().values())
            self.require_writing()
            if upto > memory.base:
                store.base()  # a damaged one has what the new one needs
                # With the tuned model, which the base may lack.
                newest = memory.to_arrays() if upto < memory.sequence else None
                base = memory.until(store, upto) if upto < memory.sequence else memory
                arrays, attributes = base.to_arrays(upto, candidates_of(base, store))
                with self._mutation():
                    store.compact(arrays, upto=upto, attributes=attributes, newest=newest)
                    self._saved = memory.sequence
                    memory.base = upto
                    memory.excluded |= {sequence for sequence in memory.retracted if sequence <= upto}
                    memory.retracted = {sequence for sequence in memory.retracted if sequence > upto}
                give_back_scratch()
            return Compacted(memory.base, before, sum(store.size().values()))

    def refresh(self) -> bool:
        """As `TactileLearner.refresh`."""
        with self.lock:
            self.require_open()
            memory, store = self.memory, self.store
            if store is None or store.mode == "write":
                return False
            if (store.newest, store.last, store.compacted) == (memory.checkpoint, memory.sequence, memory.base):
                return False
            try:
                # A checkpoint that came between the reads may be of rows behind these, and hold a tuned model from
                # before them.
                for _ in range(LOOKS):
                    if store.compacted != memory.base or store.last - memory.sequence > SNAPSHOT_EVERY:
                        break
                    records = list(store.records(after=memory.sequence))  # one may be damaged: before any change
                    with self._mutation():
                        self._changed(apply_appended(memory, store, records))
                    if store.newest == memory.checkpoint and store.compacted == memory.base:
                        return True
            except CompactedError:  # just now, and a retraction needs what is gone
                pass
            self._memory, self._whole = self._load(), True
            self._changed()
            return True

    def ranked_exemplars(self) -> dict[str, list[Exemplar]]:
        """As `TactileLearner.ranked_exemplars`."""
        with self.lock:
            return ranked_exemplars(self.memory, self.store)

    def snapshot(self) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """The memory as arrays and attributes that need no journal: `Memory.filled` takes them."""
        with self.lock:
            return self.memory.to_arrays(candidates=candidates_of(self.memory, self.store))

    def keep_tuned(self, tuned: Tuned, made_from: Memory, upto: int, retractions: int) -> None:
        """Keep the tuned model, durably. Raises FineTuneError where something was retracted since its training began.

        made_from, upto, retractions: the memory, its sequence and its count of retractions when the training began.
        """
        with self.lock:
            self.require_writing()
            memory = self.memory
            if memory is not made_from or memory.retractions != retractions:
                raise FineTuneError("what the tuned model was being made from was retracted meanwhile: fine-tune again")
            before = memory.tuned, memory.tuned_upto
            memory.tuned, memory.tuned_upto = tuned, upto
            try:
                self._snapshot()
            except BaseException:
                # Ctrl-C may come when the checkpoint is already current: closing writes the earlier tuned model again.
                (memory.tuned, memory.tuned_upto), self._saved = before, -1
                raise

    def _snapshot_if_due(self) -> None:
        if self.saves:
            self.save_behind(max(SNAPSHOT_EVERY, len(self._memory.statistics.materials) // MATERIALS_A_ROW))

    def save_behind(self, rows: int) -> None:
        """Write a checkpoint, in the background, where so many rows or more are behind the last; whatever `saves`."""
        if self.store is None or self._batching or self._memory.sequence - self._saved < rows:
            return
        arrays, attributes = self._memory.to_arrays()
        try:
            self.store.commit_later(arrays, upto=self._memory.sequence, attributes=attributes)
        except StoreError as error:
            # The journal has it all; only the next opening has more to replay.
            logger.warning("%s: no checkpoint could be written: %s", self.store.path, error)
        self._saved = self._memory.sequence
        del arrays
        give_back_scratch()

    def _snapshot(self) -> None:
        if self.store is not None:
            arrays, attributes = self._memory.to_arrays()
            self._saved = self._memory.sequence  # even if it fails: the journal has all, and `close` must end
            self.store.commit(arrays, upto=self._saved, attributes=attributes)

    def derived(self, name: str) -> Checkpoint | None:
        """What was kept under a name of the checkpoint that the memory was loaded from; None where there is nothing."""
        if self.store is None or self._closed:
            return None
        found = self.store.derived(name)
        return found if found is not None and found.number == self.memory.checkpoint else None

    def saved_since(self, memory: Memory) -> bool:
        """Whether the store has another newest checkpoint than the one that the memory was loaded from."""
        return self.store is not None and self.store.newest != memory.checkpoint

    def close(self, name: str, derived: Callable[[], Derived | None]) -> None:
        """As `TactileLearner.close`. derived: makes what is kept under a name beside the checkpoint."""
        with self.lock:
            if self._batching:
                raise InputError("a memory cannot be closed in a batch: end it first")
            store, self._closed = self.store, True
            if store is None:
                return
            try:
                # A change that was cut short is never saved: the journal holds all of it, or nothing.
                if store.mode == "write" and self.saves and self._whole and self._memory.sequence > self._saved:
                    self._pass_over_failures(store)
                    self._snapshot()
                if store.mode == "write" and self.saves and self._whole:
                    self._keep(store, name, derived)
            finally:
                store.close()
                give_back_scratch()

    def _keep(self, store: Store, name: str, derived: Callable[[], Derived | None]) -> None:
        """Keep what follows from the memory; where that fails it will be made again."""
        try:
            if (made := derived()) is not None:
                store.keep_derived(name, made[0], upto=self._memory.sequence, attributes=made[1])
        except (StoreError, ScrollTactileError, MemoryError, np.linalg.LinAlgError) as error:
            logger.warning("%s: %s could not be kept, and will be made again: %s", store.path, name, error)


def _nothing() -> None:
    """Nothing to revert: the journal refused the row before the memory was changed."""


def _sound(store: Store, kind: str | None = None) -> Iterator[Head]:
    """The heads of a journal, of one kind or all, but for those that are damaged: nobody can say what they hold."""
    after = 0
    while True:
        try:
            for head in store.heads(after, kind=kind):
                yield head
                after = head.sequence
            return
        except DamageError as damage:
            logger.warning("%s", damage)
            if damage.sequence is None or damage.sequence <= after:
                return
            after = damage.sequence
