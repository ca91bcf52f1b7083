"""The store: a journal of durable rows beside snapshots of arrays, with one writer and any readers."""

from __future__ import annotations

import logging
import os
import threading
import time as clock
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import numpy as np

from store.arrays import check_arrays, check_chunks, decode_payload, encode_payload
from store.background import Background
from store.errors import (
    DamageError,
    NotAStoreError,
    ReadOnlyError,
    RecordError,
    StoreClosedError,
    StoreError,
)
from store.files import file_size, sync_folder, tree_size
from store.generations import (
    folder_name,
    highest_number,
    read_generation,
    read_rows,
    remove_others,
    write_generation,
)
from store.journal import GenerationRow, Journal
from store.lock import WriterLock
from store.records import JSON, Generation, Record, check_key, check_text, check_time, from_json, to_json
from store.reporting import reported
from store.schema import GENERATIONS, JOURNAL_FILE, create_journal, holds_store

__all__ = ["KEPT_GENERATIONS", "Store"]

logger = logging.getLogger(__name__)

# The current one, and the one before it in case a disk error spoils the current: then only the
# journal's rows since then have to be gone through again. More would only cost space.
KEPT_GENERATIONS = 2


class Store:
    """A folder of records that survive a power cut, and of arrays that are replaced as a whole.

    Open it with `Store.open`. One Store may write a folder at a time, any number may read it. The
    methods may be called from any thread, but not in a forked child.
    """

    path: Path
    identity: Mapping[str, JSON]
    mode: Literal["write", "read"]

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        identity: Mapping[str, JSON] | None = None,
        mode: Literal["write", "read"] = "write",
    ) -> Store:
        """Open the store in folder `path`.

        To write, the folder and its parents are made where there is nothing, and `identity` is kept in
        it for good; in an existing store the one it was made with stays, and comparing is the caller's
        part. To read, nothing is made and no lock is taken, and each call sees what is committed then.

        Raises NotAStoreError when there is no store and none may be made (no identity, mode "read", a
        file, a folder of other things), LockedError for a second writer, VersionError for a newer
        format, DamageError, ReadOnlyError, StoreFullError, and RecordError for an identity not in JSON.
        """
        if mode not in ("write", "read"):
            raise ValueError(f"mode must be 'write' or 'read', not {mode!r}")
        folder = Path(path).absolute()
        kept = None if identity is None else to_json("identity", identity)
        if not holds_store(folder) and (mode == "read" or kept is None):
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
        self._committing = threading.Lock()
        self._background = Background(f"store commit {folder.name}")
        # Numbers of generations that failed to verify: they do not count as a fallback.
        self._spoilt: set[int] = set()
        with ExitStack() as undo:
            if mode == "write":
                self._make_folder()
                self._lock = WriterLock(folder)
                undo.callback(self._lock.release)
                self._make_journal(identity)
            self._journal = Journal(folder / JOURNAL_FILE, write=mode == "write")
            undo.callback(self._journal.close)
            self.identity = self._journal.identity
            if mode == "write":
                kept = [row.number for row in self._journal.generations()]
                with reported(folder, "removing unfinished generations"):
                    remove_others(folder / GENERATIONS, kept)
            undo.pop_all()

    def _make_folder(self) -> None:
        with reported(self.path, "making the folder"):
            if not self.path.is_dir():
                self.path.mkdir(parents=True, exist_ok=True)
                sync_folder(self.path.parent)

    def _make_journal(self, identity: str | None) -> None:
        # Asked again, under the lock: another writer may have made the store, and left, since.
        if not holds_store(self.path):
            if identity is None:
                raise NotAStoreError(f"{self.path} holds no store; give an identity to make one")
            with reported(self.path, "making the store"):
                create_journal(self.path, identity)

    def __repr__(self) -> str:
        return f"<Store {str(self.path)!r}, {'closed' if self._closed else self.mode}>"

    def _check_open(self, *, write: bool = False) -> None:
        if os.getpid() != self._process:
            raise StoreClosedError(
                f"{self.path} was opened by process {self._process}, of which this is a fork: open it here again"
            )
        if self._closed:
            raise StoreClosedError(f"the store in {self.path} is closed")
        if write and self.mode != "write":
            raise ReadOnlyError(f'{self.path} was opened with mode="read"')

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
        attributes: Mapping[str, JSON] | None = None,
        arrays: Mapping[str, np.ndarray] | None = None,
        time: float | None = None,
    ) -> Record:
        """Add a record and return it, as it will be read back, once it is durable.

        `time` is in Unix seconds, now when not given. Raises RecordError for what cannot be kept,
        StoreFullError, ReadOnlyError or another StoreError; after any of them the store goes on.
        """
        self._check_open(write=True)
        check_text("the kind", kind)
        check_text("the label", label)
        check_key(key)
        seconds = check_time(clock.time() if time is None else time)
        text = to_json("attributes", attributes)
        payload = encode_payload(check_arrays(arrays))
        sequence = self._journal.insert(kind, label, key, seconds, text, payload)
        return Record(sequence, kind, label, key, seconds, from_json(text), decode_payload(payload))

    def records(self, after: int = 0) -> Iterator[Record]:
        """Yield the records behind sequence `after`, verified and in order, up to the last at the start.

        One is in memory at a time. Raises DamageError at the first that is damaged or missing; its
        `sequence` is the `after` with which to go on behind it.
        """
        self._check_open()
        if after < 0:
            raise ValueError(f"after must not be negative, not {after}")
        return self._walk(after, self._journal.last())

    def _walk(self, after: int, last: int) -> Iterator[Record]:
        # A query for each row, so that a reader that pauses holds no transaction open: that would
        # keep the write-ahead log from ever being emptied.
        while after < last:
            self._check_open()
            record = self._journal.row_after(after)
            if record is None:
                return
            yield record
            after = record.sequence

    def latest(self) -> Generation | None:
        """Return the newest generation that verifies, None when there is none.

        One that does not is passed over with a logged warning that names the file and the array.
        Raises VersionError for a generation of a newer format.
        """
        self._check_open()
        passed: set[int] = set()
        while True:
            row = next((row for row in self._journal.generations() if row.number not in passed), None)
            if row is None:
                return None
            passed.add(row.number)
            try:
                return self._load(row)
            except DamageError as damage:
                # A writer may have replaced and removed it while it was read: no damage.
                if row.number in {row.number for row in self._journal.generations()}:
                    self._spoilt.add(row.number)
                    logger.warning("%s; falling back to an older generation", damage)

    def _load(self, row: GenerationRow) -> Generation:
        attributes, content = row.verified(self._journal.path)
        folder = self.path / GENERATIONS / folder_name(row.number)
        return Generation(row.number, row.upto, attributes, read_generation(folder, row.number, content))

    def read_rows(self, name: str, first: int, last: int, *, generation: int | None = None) -> np.ndarray:
        """Return rows `first` to before `last` of an array that was committed with `chunks`, and read no others.

        They are of the newest generation, or of the one with the number `generation`, which need not be
        the newest any more but must still be there. Only what is read is verified: damage elsewhere in
        the array does not matter here.

        Raises RecordError for an array that is not kept in chunks or has no such rows, DamageError that
        names file, array and chunk, VersionError, and StoreError where the generation is not there.
        """
        self._check_open()
        while True:
            row = next((row for row in self._journal.generations() if generation in (None, row.number)), None)
            if row is None:
                wanted = "no generation" if generation is None else f"generation {generation} no longer"
                raise StoreError(f"{self.path} has {wanted}: look at the newest again, with latest()")
            folder = self.path / GENERATIONS / folder_name(row.number)
            try:
                return read_rows(folder, row.number, row.verified(self._journal.path)[1], name, first, last)
            except DamageError:
                # A writer may have replaced and removed it while it was read: no damage.
                if row.number in {row.number for row in self._journal.generations()}:
                    raise

    def commit(
        self,
        arrays: Mapping[str, np.ndarray],
        *,
        upto: int,
        attributes: Mapping[str, JSON] | None = None,
        chunks: Mapping[str, int] | None = None,
    ) -> int:
        """Write a generation that contains the records up to `upto`, make it current, return its number.

        chunks: name → rows of a chunk, for arrays of which `read_rows` is to read a part. Each is one file.
        A background commit is waited for first, and its failure is raised here in place of committing.
        Raises RecordError for arrays, attributes, chunks or an `upto` that cannot be kept, StoreFullError,
        ReadOnlyError or another StoreError; the generation before then stays current.
        """
        checked, text, pieces = self._check_commit(arrays, upto, attributes, chunks)
        self._background.wait()
        self._background.check()
        return self._commit(checked, upto, text, pieces)

    def commit_later(
        self,
        arrays: Mapping[str, np.ndarray],
        *,
        upto: int,
        attributes: Mapping[str, JSON] | None = None,
        chunks: Mapping[str, int] | None = None,
    ) -> None:
        """Do as `commit` in a background thread; the arrays are handed over and must not change any more.

        While one is being written the newest given waits for it, in place of any that waited before. A
        failure is logged and raised, once, by the next `commit`, `commit_later` (which then queues
        nothing), `flush` or `close`. What cannot be kept is refused at once, with RecordError.
        """
        checked, text, pieces = self._check_commit(arrays, upto, attributes, chunks)
        self._background.check()
        self._background.submit(lambda: self._commit(checked, upto, text, pieces))

    def _check_commit(
        self,
        arrays: Mapping[str, np.ndarray],
        upto: int,
        attributes: Mapping[str, JSON] | None,
        chunks: Mapping[str, int] | None,
    ) -> tuple[dict[str, np.ndarray], str, dict[str, int]]:
        self._check_open(write=True)
        if isinstance(upto, bool) or not isinstance(upto, int) or not 0 <= upto <= self._journal.last():
            raise RecordError(f"upto must be a sequence from 0 to the last, {self._journal.last()}, not {upto!r}")
        checked = check_arrays(arrays)
        return checked, to_json("attributes", attributes), check_chunks(chunks, checked)

    def _commit(self, arrays: dict[str, np.ndarray], upto: int, attributes: str, chunks: dict[str, int]) -> int:
        parent = self.path / GENERATIONS
        with self._committing:
            earlier = [row.number for row in self._journal.generations()]
            number = 1 + max([highest_number(parent), *earlier])
            content = write_generation(parent, number, upto, arrays, from_json(attributes), chunks)
            fallback = [old for old in earlier if old not in self._spoilt][: KEPT_GENERATIONS - 1]
            row = GenerationRow.of(number, upto, clock.time(), attributes, content)
            try:
                self._journal.make_current(row, forget=set(earlier) - set(fallback))
            finally:
                # Those that the journal names, whether the transaction went through or not.
                self._remove_unnamed(parent)
            return number

    def _remove_unnamed(self, parent: Path) -> None:
        try:
            remove_others(parent, [row.number for row in self._journal.generations()])
        except (StoreError, OSError) as error:
            # The commit itself stands; the next one, or the next open, removes what is left.
            logger.warning("%s: old generations could not be removed: %s", parent, error)

    def flush(self) -> None:
        """Return when what was handed to `commit_later` is committed; raise the failure if it is not."""
        self._check_open()
        self._background.wait()
        self._background.check()

    def size(self) -> dict[str, int]:
        """Return the bytes on the disk: {"journal": …, "generations": …}."""
        self._check_open()
        with reported(self.path, "measuring the store"):
            journal = sum(file_size(self.path / (JOURNAL_FILE + suffix)) for suffix in ("", "-wal", "-shm"))
            return {"journal": journal, "generations": tree_size(self.path / GENERATIONS)}

    def close(self) -> None:
        """Wait for the background commit, let go of the files and the lock; a second call does nothing.

        Raises the failure of a background commit, after everything was let go.
        """
        with self._closing:
            # What a fork inherited belongs to the parent: closing SQLite there can undo its locks.
            if self._closed or os.getpid() != self._process:
                return
            self._background.wait()
            self._closed = True
            try:
                self._journal.close()
            finally:
                if self._lock is not None:
                    self._lock.release()
        self._background.check()

    def __enter__(self) -> Self:
        self._check_open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except StoreError:
            # Logged already, and less telling than what went wrong inside.
            if error is None:
                raise
