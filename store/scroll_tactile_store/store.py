"""The store: a journal of durable rows beside snapshots of arrays, with one writer and any readers."""

from __future__ import annotations

import os
import threading
import time as clock
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Literal, Self, cast

from scroll_tactile_store.archive import files_of
from scroll_tactile_store.backup import back_up
from scroll_tactile_store.checkpoint_files import CheckpointDraft
from scroll_tactile_store.checkpoints import Checkpoints
from scroll_tactile_store.exceptions import (
    NotAStoreError,
    ReadOnlyError,
    RecordError,
    StoreClosedError,
    StoreError,
    reported,
)
from scroll_tactile_store.files import is_file, store_folder
from scroll_tactile_store.found_log import Progress
from scroll_tactile_store.journal import Journal
from scroll_tactile_store.layout import CHECKPOINTS, holds_store
from scroll_tactile_store.lock import WriterLock, lock_to_write
from scroll_tactile_store.records import (
    JSON,
    Arrays,
    Attributes,
    Checkpoint,
    Head,
    Record,
    check_key,
    check_text,
    to_json,
)

__all__ = ["Store"]


class Store:
    """A folder of records that survive a power cut, and of arrays that are replaced as a whole.

    Open it with `Store.open`. One Store may write a folder at a time, any number may read it. The methods may be called
    from any thread, but not in a forked child.
    """

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        identity: Mapping[str, JSON] | None = None,
        mode: Literal["write", "read"] = "write",
    ) -> Self:
        """Open the store at `path`, a folder, or to read also a packed one, see `write_archive`.

        To write, it makes the folder and its parents where there is nothing, and keeps `identity` in it for good; an
        existing store keeps its own, and the caller compares. To read, it makes and changes nothing, and each call sees
        what is committed at that moment.

        Raises NotAStoreError when there is no store and none may be made (no identity, mode "read", a file, a folder of
        other things), LockedError for a second writer, VersionError for another format, DamageError, ReadOnlyError,
        StoreFullError, and RecordError for another mode or an identity not in JSON.
        """
        if mode not in ("write", "read"):
            raise RecordError(f"mode must be 'write' or 'read', not {mode!r}")
        folder = store_folder(path)
        kept = None if identity is None else to_json("identity", identity)
        if is_file(folder) and mode == "write":
            raise NotAStoreError(f'{folder} is a file: a packed store is opened with mode="read", or merged')
        if not is_file(folder) and not holds_store(folder) and (mode == "read" or kept is None):
            hint = "" if mode == "read" else "; give an identity to make one"
            raise NotAStoreError(f"{folder} holds no store{hint}")
        return cls(folder, kept, mode)

    def __init__(self, folder: Path, identity: str | None, mode: Literal["write", "read"]) -> None:
        self.path = folder
        self.mode = mode
        self._process = os.getpid()
        self._closing = threading.Lock()
        self._closed = False
        self._lock: WriterLock | None = None
        with ExitStack() as undo:
            if mode == "write":
                self._lock = lock_to_write(folder, identity)
                undo.callback(self._lock.release)
            files = files_of(folder)
            undo.callback(files.close)
            self._journal = Journal(files, write=mode == "write")
            undo.callback(self._journal.close)
            self.identity: Mapping[str, JSON] = self._journal.identity
            self._checkpoints = Checkpoints(files, self._journal)
            self._files = files
            if mode == "write":
                self._checkpoints.remove_unnamed()
            self._held = undo.pop_all()

    def __repr__(self) -> str:
        return f"<Store {str(self.path)!r}, {'closed' if self._closed else self.mode}>"

    def _check_open(self, after: int = 0, *, write: bool = False) -> None:
        if os.getpid() != self._process:
            raise StoreClosedError(
                f"{self.path} was opened by process {self._process}, of which this is a fork: open it here again"
            )
        if self._closed:
            raise StoreClosedError(f"the store in {self.path} is closed")
        if write and self.mode != "write":
            raise ReadOnlyError(f'{self.path} was opened with mode="read"')
        if after < 0:
            raise RecordError(f"after must not be negative, not {after}")

    @property
    def is_packed(self) -> bool:
        """Whether it is a packed store, which is only read."""
        return self._files.is_packed

    @property
    def last(self) -> int:
        """The sequence of the last durable record, 0 when there is none."""
        self._check_open()
        return self._journal.last()

    def append(
        self,
        kind: str,
        label: str,
        key: bytes,
        *,
        attributes: Attributes = None,
        arrays: Arrays | None = None,
        time: float | None = None,
    ) -> Head:
        """Add a record and return its head once it is durable; in a batch, once it is written.

        `time` is in Unix seconds, now when not given. Raises RecordError for what cannot be kept, StoreFullError,
        ReadOnlyError or another StoreError; after any of them the store can be used on.
        """
        self._check_open(write=True)
        return self._journal.insert(kind, label, key, clock.time() if time is None else time, attributes, arrays)

    @contextmanager
    def batch(self) -> Iterator[None]:
        """Make the records appended in the block durable together, when it ends, or none of them.

        They wait for the disk once, not once each. After an exception in the block, or an append that failed on the
        disk, none is kept; a record refused with RecordError was never part of it. Other threads that append or read
        wait meanwhile. In the block, committing, flushing, closing and beginning another batch raise StoreError. Raises
        StoreFullError, ReadOnlyError or another StoreError.
        """
        self._check_open(write=True)
        self._journal.refuse_in_batch("beginning a batch")
        self._checkpoints.wait()
        with self._journal.batch():
            yield

    def heads(self, after: int = 0, *, kind: str | None = None, label: str | None = None) -> Iterator[Head]:
        """Yield the records behind sequence `after` without their arrays, up to the last at the start.

        `kind`, `label`: only those of this kind, or label. Compacted records keep their heads, but for those that a
        repair named as lost. Raises DamageError at the first that is damaged or, without `kind` and `label`, missing;
        with them, a record whose kind or label is damaged is passed over.
        """
        self._check_open(after)
        for what, text in (("the kind", kind), ("the label", label)):
            if text is not None:
                check_text(what, text)
        return self._journal.rows(after, self._journal.last(), arrays=False, kind=kind, label=label)

    def record(self, sequence: int) -> Record:
        """Return the record of this sequence.

        Raises RecordError where there is none, CompactedError where compaction gave up its arrays, DamageError.
        """
        self._check_open()
        last = self._journal.last()
        if isinstance(sequence, bool) or not isinstance(sequence, int) or not 1 <= sequence <= last:
            raise RecordError(f"{self.path} has records 1 to {last}, not {sequence!r}")
        for record in self._journal.rows(sequence - 1, sequence, arrays=True):
            return cast(Record, record)
        raise self._journal.given_up(sequence)  # a repair left it out

    def records(self, after: int = 0) -> Iterator[Record]:
        """Yield the records behind sequence `after`, verified and in order, up to the last at the start.

        One is in memory at a time. Raises DamageError at the first that is damaged or missing; its `sequence` is the
        `after` with which to continue behind it. Raises CompactedError where the first are compacted: `compaction` has
        their place, and its `last_sequence` is the `after` to continue with.
        """
        self._check_open(after)
        if after < self._journal.current().compacted:
            raise self._journal.given_up(after + 1)
        return cast(Iterator[Record], self._journal.rows(after, self._journal.last(), arrays=True))

    def with_key(self, key: bytes) -> Iterator[Head]:
        """Yield the heads of the records with this key, in order; damaged ones are left out.

        The first call may read where the records are; each after it takes about a nanosecond a record.
        """
        self._check_open()
        return self._journal.with_key(check_key(key))

    def latest(self) -> Checkpoint | None:
        """Return the newest checkpoint that verifies, None when there is none.

        A logged warning names the file and the array of each checkpoint that it passes over. Raises VersionError for a
        checkpoint of another format.
        """
        self._check_open()
        return self._checkpoints.latest()

    @property
    def newest(self) -> int | None:
        """The number of the newest committed checkpoint, None when there is none; `latest` may pass it over."""
        self._check_open()
        newest = self._journal.current().newest
        return None if newest is None else newest.number

    @property
    def compacted(self) -> int:
        """The last record that has given up its arrays for a compaction checkpoint, 0 where none has."""
        self._check_open()
        return self._journal.current().compacted

    def compaction(self) -> Checkpoint | None:
        """Return the checkpoint that stands for the compacted records, None when there are none.

        Raises DamageError where it does not verify, and VersionError for another format.
        """
        self._check_open()
        return self._checkpoints.compaction()

    def commit(self, arrays: Arrays, *, last_sequence: int, attributes: Attributes = None) -> int:
        """Write a checkpoint that contains the records up to `last_sequence`, make it current, return its number.

        The checkpoint with the highest `last_sequence` is current, and of several with the same the last committed. It
        waits for a background commit first, and raises its failure here in place of committing. Raises RecordError for
        arrays, attributes or a `last_sequence` that cannot be kept, StoreFullError, ReadOnlyError or another
        StoreError; the checkpoint before then stays current.
        """
        draft = self._draft(arrays, last_sequence, attributes)
        self._idle()
        return self._checkpoints.commit(draft)

    def compact(
        self,
        arrays: Arrays,
        *,
        last_sequence: int,
        attributes: Attributes = None,
        newest: tuple[Arrays, Mapping[str, JSON]] | None = None,
    ) -> None:
        """Let a checkpoint stand for the records up to `last_sequence`: they give up their arrays and keep their heads.

        This compaction checkpoint is one like others, but kept until the next compaction; a replay of the records
        begins with it. newest: arrays and attributes of a checkpoint that contains all records, committed beside it;
        without it that of the compaction is the newest. A log without the arrays is written beside the one there is,
        all is read back, and takes effect together or not at all; then the earlier log and checkpoints are removed.
        Nobody can append meanwhile. Raises DamageError where a record behind `last_sequence` cannot be read, and as
        `commit`.
        """
        compaction = self._draft(arrays, last_sequence, attributes)
        last = None if newest is None else self._draft(newest[0], self._journal.last(), newest[1])
        self._idle()
        self._checkpoints.compact(compaction, last)

    def commit_later(self, arrays: Arrays, *, last_sequence: int, attributes: Attributes = None) -> None:
        """Do as `commit` in a background thread; the arrays are handed over and must not change any more.

        While one is being written, only the newest of those handed over waits. A failure is logged and raised, once, by
        the next `commit`, `commit_later` (which then queues nothing), `flush` or `close`. What cannot be kept is
        refused at once, with RecordError.
        """
        draft = self._draft(arrays, last_sequence, attributes)
        self._checkpoints.raise_failure()
        self._checkpoints.commit_later(draft)

    def _draft(self, arrays: Arrays, last_sequence: int, attributes: Attributes) -> CheckpointDraft:
        self._check_open(write=True)
        return self._checkpoints.draft(arrays, last_sequence, attributes)

    def flush(self) -> None:
        """Return when what was handed to `commit_later` is committed; raise the failure if it is not."""
        self._check_open()
        self._journal.refuse_in_batch("waiting for the background commit")
        self._idle()

    def _idle(self) -> None:
        self._checkpoints.wait()
        self._checkpoints.raise_failure()

    def backup(self, destination: str | os.PathLike[str], *, progress: Progress | None = None) -> None:
        """Copy the store to the new folder `destination`, also while it is written, from here or elsewhere.

        The copy is the store as it was at one moment since the call: all records durable then, and the checkpoints. It
        appears there verified, complete and durable, or not at all; a power cut may leave a folder named
        `destination`.….partial. Nobody who writes waits for it. `progress` is called as by `check_store`.

        Raises NotAStoreError where something is at `destination` or it lies inside the store, DamageError where the
        copy does not verify, StoreFullError, ReadOnlyError or another StoreError.
        """
        self._check_open()
        back_up(self.path, store_folder(destination), progress)

    def size(self) -> dict[str, int]:
        """Return the bytes on the disk: {"journal": …, "checkpoints": …}."""
        self._check_open()
        with reported(self.path, "measuring the store"):
            return {"journal": self._journal.size(), "checkpoints": sum(self._files.sizes(self.path / CHECKPOINTS))}

    def close(self) -> None:
        """Wait for the background commit, release the files and the lock; a second call does nothing.

        Raises the failure of a background commit, after everything is released, and StoreError in a batch.
        """
        # What a fork inherited belongs to the parent.
        if os.getpid() != self._process:
            return
        self._journal.refuse_in_batch("closing the store")
        with self._closing:
            if self._closed:
                return
            self._checkpoints.close()
            self._closed = True
            self._held.close()
        self._checkpoints.raise_failure()

    def __enter__(self) -> Self:
        self._check_open()
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        try:
            self.close()
        except StoreError:
            # Logged already, and it says less than what went wrong inside.
            if error is None:
                raise
