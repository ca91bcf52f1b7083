"""A memory that is open, with the store that keeps it: a change is whole or not there, and checkpoints follow it."""

from __future__ import annotations

import ctypes
import logging
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TypeVar

from scroll_tactile_store import ReadOnlyError, Store, StoreClosedError, StoreError

from scroll_tactile.errors import InputError
from scroll_tactile.health.watch import WatchedRows, WatchRules
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import Changed
from scroll_tactile.persistence.contents import ListedContents, StoredContents
from scroll_tactile.persistence.replaying import apply_appended

__all__ = ["OpenMemory", "give_back_scratch"]

logger = logging.getLogger(__name__)

Answer = TypeVar("Answer")

CHECKPOINT_EVERY = 128  # rows between checkpoints: opening embeds so many again in half a second
# A checkpoint writes all materials, so many of them in the time that one touch takes to learn: it waits until as long
# was spent on touches. With 100 000 materials and a row for each 16, writing took twice as long as learning.
MATERIALS_PER_ROW = 8


class OpenMemory:
    """The memory of one learner and the store that keeps it; `Ledger` has the changes.

    load: reads the memory from the store, or makes an empty one without a store. bare: whether rows of observations
    hold readings alone, to be embedded again when they are read. contents: the touches of a memory without a store;
    None where they are not known.

    lock: held by whoever reads or changes the memory. version: grows with each change of the observations. described:
    grows with each change of a description. changed: the materials of touches observed and retracted since the set was
    last cleared; None where something else has changed. followers: are called with the touches at each change. watched:
    the rows that health was last read from, by some rules; not there while they are read. lost: grows where a change
    was cut short, whose rows may not be in the journal. saves: whether checkpoints are
    written; the journal alone has every row, too.
    """

    def __init__(
        self,
        load: Callable[[], Memory],
        store: Store | None = None,
        bare: bool = False,
        contents: ListedContents | None = None,
    ) -> None:
        self.store = store
        self._contents = contents
        self._bare = bare
        self.lock = threading.RLock()
        self.version = 0
        self.described = 0
        self.saves = True
        self.changed: set[str] | None = set()
        self.followers: list[Callable[[Sequence[Changed] | None], None]] = []
        self._load = load
        self._memory = load()
        self._note_saved()
        self._saved = self._memory.saved
        self._closed = False
        self._whole = True
        self._undo: Callable[[], None] | None = None
        self._batching = False
        self.watched: dict[WatchRules, WatchedRows] = {}
        self.lost = 0

    @property
    def memory(self) -> Memory:
        """The memory. If a change was cut short, by ctrl-C for instance, it is read again, or the change is undone."""
        if not self._whole:
            if self._undo is not None:
                self._undo()
            else:
                self._memory = self._load()
            self._whole = True
            self.lost += 1
            self._changed()
        return self._memory

    def read(self, what: Callable[[Memory, Store | None], Answer]) -> Answer:
        """What is read of the memory and its journal, while nobody changes them."""
        with self.lock:
            return what(self.memory, self.store)

    def contents(self) -> ListedContents | StoredContents:
        """Which touches the memory has, by their content; the caller holds the lock.

        Raises StoreClosedError for a snapshot of a memory that was closed before anybody asked.
        """
        _ = self.memory  # reads it again if a change was cut short
        if self.store is not None:
            return StoredContents(self.store, self._memory)
        if self._contents is None:
            raise StoreClosedError(
                "this is a snapshot of a memory that was closed, which does not say what touches it has: make the "
                "snapshot before the memory is closed, or open the memory's folder again"
            )
        return self._contents

    def names(self, key: bytes) -> list[str]:
        """The names of a touch with this content hash; raises as `contents`."""
        with self.lock:
            return list(self.contents().rows(key))

    def copied_contents(self) -> ListedContents | None:
        """A copy of `contents` that changes independently; None where they are not known."""
        known = self._contents is not None or (self.store is not None and not self._closed)
        return self.contents().copy() if known else None

    @contextmanager
    def _mutation(
        self, revert: Callable[[], None] | None = None, undo: Callable[[], None] | None = None
    ) -> Iterator[None]:
        """A change of the memory and its journal: where it is cut short, the memory is read again before its next use.

        revert: undoes the change in the memory if the journal refuses it; None: the memory is read again. undo: does so
        for a memory without a path, which cannot be read again.
        """
        self._undo, self._whole = undo, False
        try:
            yield
        except StoreError:
            if revert is not None:
                revert()
                self._whole = not self._batching  # in a batch, earlier changes are lost too, and not reverted here
            raise
        self._whole = True

    def _changed(self, changes: Sequence[Changed] | None = None) -> None:
        self.version += 1
        for follow in self.followers:
            follow(changes)
        if changes is None:
            self.changed = None
        elif self.changed is not None:
            self.changed |= {touch.material for touch in changes}

    def require_open(self) -> None:
        """Raise StoreClosedError after `close`."""
        if self._closed:
            where = "in memory" if self.store is None else self.store.path
            raise StoreClosedError(f"the memory {where} is closed: open its path again")

    def require_store(self, doing: str) -> Store:
        """The store. Raises InputError where there is none, for an operation that needs the journal."""
        self.require_open()
        if self.store is None:
            raise InputError(
                f"a memory without a path keeps no journal, and cannot {doing}: TactileLearner.open(path, ...) makes "
                "one that does"
            )
        return self.store

    def require_writing(self) -> None:
        """Raise, before any work is done, if no checkpoint could be written."""
        self.require_open()
        if self.store is None:
            return
        if self._batching:
            raise InputError("no checkpoint can be written in a batch: end it first")
        self.require_write_mode()
        self._pass_over_failures(self.store)

    def require_write_mode(self) -> None:
        """Raise ReadOnlyError, before any work is done, where the journal takes no row."""
        if self.store is not None and self.store.mode == "read":
            raise ReadOnlyError(f'{self.store.path} was opened with mode="read": open it to write')

    def _pass_over_failures(self, store: Store) -> None:
        try:
            store.flush()
        except StoreError as error:  # an earlier checkpoint's: otherwise the next commit would raise it
            logger.warning("%s: no checkpoint could be written: %s", store.path, error)

    def refresh(self) -> bool:
        """As `TactileLearner.refresh`."""
        with self.lock:
            self.require_open()
            memory, store = self.memory, self.store
            if store is None or store.mode == "write":
                return False
            state = store.state()
            if state == (memory.sequence, memory.checkpoint, memory.compacted):
                return False
            if state.compacted == memory.compacted and state.last - memory.sequence <= CHECKPOINT_EVERY:
                records = list(store.records(after=memory.sequence))  # one may be damaged: before any change
                with self._mutation():
                    self._changed(apply_appended(memory, store, records))
                return True
            self._memory, self._whole = self._load(), True
            self._changed()
            return True

    def _checkpoint_if_due(self) -> None:
        if self.saves:
            materials = self._memory.statistics.material_count
            self.checkpoint_in_background(max(CHECKPOINT_EVERY, materials // MATERIALS_PER_ROW))

    def checkpoint_in_background(self, rows: int) -> None:
        """Write a checkpoint in a thread, if so many rows or more came since the last; also where `saves` is False."""
        if self.store is None or self._batching or self._memory.sequence - self._saved < rows:
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

    def _write_checkpoint(self) -> None:
        if self.store is not None:
            arrays, attributes = self._memory.to_arrays()
            self._note_saved()  # even if it fails: the journal has all, and `close` must end
            self.store.commit(arrays, last_sequence=self._saved, attributes=attributes)

    def _note_saved(self) -> None:
        self._saved, self._saved_weighings = self._memory.sequence, dict(self._memory.weighings)

    def take_weighing(self) -> str | None:
        """What the checkpoint that the memory was read from says of how materials are weighed, once."""
        return self.memory.weighings.pop("", None)

    def close(self, weighings: Mapping[str, str]) -> None:
        """As `TactileLearner.close`. weighings: see `Memory`."""
        with self.lock:
            if self._batching:
                raise InputError("a memory cannot be closed in a batch: end it first")
            store, closed, self._closed = self.store, self._closed, True
            if store is None or closed:
                return
            try:
                # A change that was cut short is never saved: the journal holds all of it, or nothing.
                if store.mode == "write" and self.saves and self._whole:
                    self._memory.weighings |= weighings
                    if self._memory.sequence > self._saved or self._memory.weighings != self._saved_weighings:
                        self._pass_over_failures(store)
                        self._write_checkpoint()
            finally:
                store.close()
                give_back_scratch()


def give_back_scratch() -> None:
    """Return freed memory to the system where the C library can: fitting and saving leave 40 MB of it."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
