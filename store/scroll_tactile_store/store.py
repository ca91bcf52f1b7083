"""The store: a log of durable rows beside snapshots of arrays, with one writer and any readers."""

from __future__ import annotations

import logging
import os
import threading
import time as clock
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple, Self, cast

import numpy as np

from scroll_tactile_store.archive import unpacked
from scroll_tactile_store.backup import back_up
from scroll_tactile_store.checkpoint_files import (
    INDEX,
    CheckpointReader,
    index_name,
    write_checkpoint,
)
from scroll_tactile_store.encoding import check_arrays, decode_payload, encode_payload
from scroll_tactile_store.exceptions import (
    CompactedError,
    DamageError,
    NotAStoreError,
    ReadOnlyError,
    RecordError,
    StoreClosedError,
    StoreError,
    reported,
)
from scroll_tactile_store.files import remove_tree, store_folder, sync_folder, tree_size
from scroll_tactile_store.framing import LogPlace
from scroll_tactile_store.layout import (
    CHECKPOINT,
    CHECKPOINTS,
    CURRENT_FILE,
    LOG,
    NEW,
    PARTIAL,
    Current,
    NamedCheckpoint,
    checkpoint_path,
    holds_store,
    log_path,
    numbers,
    read_current,
    remove_unnamed,
    write_current,
)
from scroll_tactile_store.lock import WriterLock, lock_to_write
from scroll_tactile_store.log import Log, create_log
from scroll_tactile_store.records import (
    JSON,
    Arrays,
    Attributes,
    Checkpoint,
    Head,
    Record,
    from_json,
    to_json,
)
from scroll_tactile_store.rows import ROW, Rows, decode_row, encode_row, head_without_arrays, read_back, read_head
from scroll_tactile_store.survey import Progress

logger = logging.getLogger(__name__)

ATTEMPTS = 8  # of a reader, while a writer puts another log in the place of the one


class StoreState(NamedTuple):
    """What a store holds at one moment.

    last: the sequence of the last durable record, 0 without any. newest: the number of the newest committed checkpoint,
    None without one; `latest` may pass it over. compacted: the last record that has given up its arrays for a
    compaction checkpoint, 0 where none has.
    """

    last: int
    newest: int | None
    compacted: int


class Store:
    """A folder of records that survive a power cut, and of arrays that are replaced as a whole.

    Open it with `Store.open`. One Store may write a folder at a time, any number may read it. The methods may be called
    from any thread, but not in a forked child. A reader sees the store as it was when it was opened, or last asked for
    its `state` or for a checkpoint.
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
        existing store keeps its own, and the caller compares. To read, it makes and changes nothing; a packed store is
        unpacked into a temporary folder, which is removed when it is closed.

        Raises NotAStoreError when there is no store and none may be made (no identity, mode "read", a file, a folder of
        other things), LockedError for a second writer, VersionError for another format, DamageError, ReadOnlyError,
        StoreFullError, and RecordError for another mode or an identity not in JSON.
        """
        if mode not in ("write", "read"):
            raise RecordError(f"mode must be 'write' or 'read', not {mode!r}")
        folder = store_folder(path)
        kept = None if identity is None else to_json("identity", identity)
        is_packed = mode == "read" and os.path.isfile(folder)
        if not is_packed and not holds_store(folder) and (mode == "read" or kept is None):
            raise NotAStoreError(f"{folder} holds no store; to make one, open it to write and give an identity")
        return cls(folder, kept, mode)

    def __init__(self, path: Path, identity: str | None, mode: Literal["write", "read"]) -> None:
        self.path = self._folder = path
        self.mode = mode
        self._process = os.getpid()
        # Of the log, `CURRENT` and what is known of them; of checkpoints, of which one is written at a time; and of the
        # one that was handed over last.
        self._guard, self._committing = threading.RLock(), threading.Lock()
        self._queue = threading.RLock()  # an executor may run what is handed over in the thread that hands it over
        self._closed = self._batching = self._failed = self._unsettled = False
        self._lock: WriterLock | None = None
        self._worker = ThreadPoolExecutor(1, f"store commit {path.name}")
        self._later: Future[None] | None = None
        with ExitStack() as undo:
            if mode == "write":
                self._lock = lock_to_write(path, identity)
                undo.callback(self._lock.release)
            elif os.path.isfile(path):
                self._folder = undo.enter_context(unpacked(path))
            with reported(path, "opening the store"):
                self._current, self._log, self._rows = self._take_current()
            undo.callback(lambda: self._log.close(trim=mode == "write"))
            if mode == "write":
                self._remove_unnamed()
            self._held = undo.pop_all()

    def __repr__(self) -> str:
        return f"<Store {str(self.path)!r}, {'closed' if self._closed else self.mode}>"

    def _check_open(self, *, write: bool = False) -> None:
        if os.getpid() != self._process:
            who = f"process {self._process}, of which this is a fork"
            raise StoreClosedError(f"{self.path} was opened by {who}: open it here again")
        if self._closed:
            raise StoreClosedError(f"the store in {self.path} is closed")
        if write and self.mode != "write":
            raise ReadOnlyError(f'{self.path} was opened with mode="read"')

    # What `CURRENT` names.

    def _take_current(self) -> tuple[Current, Log, Rows]:
        """Return what `CURRENT` says now, the log that it names, and the rows of that."""
        for _ in range(ATTEMPTS):
            try:
                current = read_current(self._folder / CURRENT_FILE)
                log = Log(
                    log_path(self._folder, current.log), write=self.mode == "write", identity=current.log_identity
                )
                break
            except FileNotFoundError as error:  # a writer removes a log after another has taken its place
                gone = Path(error.filename)
        else:
            what = f"{gone} is not there: put it back from a copy, or repair the store (repair_store), which resumes"
            raise DamageError(f"{what} from what verifies", path=gone)
        try:
            return current, log, self._read(current, log)
        except BaseException:
            log.close()
            raise

    def _read(self, current: Current, log: Log) -> Rows:
        if log.header_damage is not None:
            raise DamageError(f"{log.header_damage}: repair the store (repair_store)", path=log.path, offset=0, frame=0)
        try:
            self.identity: Mapping[str, JSON] = from_json(log.header.decode())
        except ValueError as error:
            what = f"the identity in {log.path} was never written so: {error}"
            raise DamageError(what, path=log.path) from error
        rows = Rows()
        if (named := current.newest) is not None:
            if not log.has_place(named.place):
                what = f"{log.path} holds no batch that ends where checkpoint {named.number} says"
                raise DamageError(f"{what}: repair the store (repair_store)", path=log.path)
            rows = Rows(named.last_sequence, self._index(named, log))
            log.place = named.place if len(rows) else log.place
        rows.catch_up(log, current.last)
        if self.mode == "write":
            log.prepare()
            # `CURRENT` may name this log in the system's memory alone: a power cut would take what follows.
            sync_folder(self._folder)
        return rows

    def _index(self, named: NamedCheckpoint, log: Log) -> np.ndarray | None:
        """Return where the newest checkpoint says that the rows before its place are; None where it does not say so."""
        name = index_name(log.identity)
        try:
            reader = CheckpointReader(checkpoint_path(self._folder, named.number))
            if reader.sha256 == named.sha256 and name in reader.names:
                table = reader.arrays([name])[name].astype(np.uint64)
                return table[:, table[1] < named.place.offset]
        except (StoreError, LookupError) as error:
            logger.info("%s: rows are looked for in the log itself: %s", log.path, error)
        return None

    @contextmanager
    def _using(self, doing: str) -> Iterator[None]:
        """In the block nobody else uses the log, which is the one that counts."""
        self._check_open()  # before the lock, which in a fork nobody gives back
        with self._guard, reported(self.path, doing):
            self._check_open()  # another thread may have closed it meanwhile
            if self._unsettled and not self._batching:
                self._renew()
            yield

    def _settled(self) -> Current:
        with self._using("looking for what counts"):
            return self._current

    def _renew(self) -> None:
        before = self._log
        self._current, self._log, self._rows = self._take_current()
        self._unsettled = False
        before.close()

    def _look(self) -> None:
        """Take in what was committed since, for a reader."""
        current = read_current(self._folder / CURRENT_FILE)
        if (current.log, current.log_identity) == (self._current.log, self._current.log_identity):
            if self._log.has_place(self._log.place):
                before = self._log.place
                try:
                    self._rows.catch_up(self._log, current.last)
                except BaseException:
                    self._log.place = before
                    self._rows.cut(before)
                    raise
                self._current = current
                return
            logger.info("%s: its writer took a batch back", self._log.path)
        self._renew()

    def state(self, *, look: bool = True) -> StoreState:
        """Return what the store holds now, which from now on is what a reader reads; look: whether it looks anew."""
        with self._using("looking for what was committed"):
            if look and self.mode == "read" and self._folder == self.path:  # one that was unpacked stays as it is
                self._look()
            newest = self._current.newest
            return StoreState(self._rows.last, None if newest is None else newest.number, self._current.compacted)

    @property
    def last(self) -> int:
        """The sequence of the last durable record, 0 when there is none; of a reader, at its last `state`."""
        return self.state(look=False).last

    @property
    def compacted(self) -> int:
        """The last record that has given up its arrays, 0 where none has; of a reader, at its last `state`."""
        return self.state(look=False).compacted

    # Records.

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
        seconds = clock.time() if time is None else time
        text, payload = to_json("attributes", attributes), encode_payload(check_arrays(arrays))
        with self._using("appending a row"):
            if self._batching and self._failed:
                raise StoreError(f"nothing more can be appended to {self.path} in this batch: a row of it failed")
            sequence = self._rows.last + 1
            data = encode_row(sequence, kind, label, key, seconds, text, payload, len(payload))
            with self._undoing():
                frame = self._log.stage(ROW, data)
                self._rows.append(sequence, frame.offset, frame.size, key)
                if not self._batching:
                    self._make_durable()
        return Head(sequence, kind, label, key, float(seconds), from_json(text), len(payload))

    @contextmanager
    def batch(self) -> Iterator[None]:
        """Make the records appended in the block durable together, when it ends, or none of them.

        They wait for the disk once, not once each. After an exception in the block, or an append that failed on the
        disk, none is kept; a record refused with RecordError was never part of it. Other threads that append or read
        wait meanwhile. In the block, committing, flushing, closing and beginning another batch raise StoreError. Raises
        StoreFullError, ReadOnlyError or another StoreError.
        """
        self._check_open(write=True)
        self._refuse_in_batch("beginning a batch")
        self._wait()
        with self._guard:
            with self._using("beginning a batch"):
                self._batching, self._failed = True, False
            try:
                with self._undoing():
                    yield
                    if self._failed:
                        raise StoreError(f"nothing of this batch was kept in {self.path}: a row of it failed")
                    with reported(self.path, "making a batch durable"):
                        self._make_durable()
            finally:
                self._batching = False

    def _make_durable(self) -> None:
        self._log.commit()
        if not self._current.last and self._rows.last:
            self._note_last()  # without any row the log would look like a new one

    @contextmanager
    def _undoing(self) -> Iterator[None]:
        """Where the block fails, take back what is not durable; what was committed before stays, and is known."""
        try:
            yield
        except BaseException:
            self._failed = True
            self._rows.cut(self._log.place)
            self._log.rollback()
            raise

    def _refuse_in_batch(self, doing: str) -> None:
        """Raise StoreError in a batch of this thread, and wait for the end of another thread's."""
        with self._guard:
            if self._batching:
                raise StoreError(f"{doing} is not possible in a batch of {self.path}: end it first")

    def _note_last(self) -> None:
        """Have `CURRENT` say which row is the last, so that a log that is cut off later is not taken for whole."""
        try:
            if read_current(self._folder / CURRENT_FILE) == self._current:  # the folder may be another's by now
                self._name(self._current)
        except (OSError, StoreError) as error:  # nothing is lost but this knowledge
            logger.warning("%s could not say which row is the last: %s", self._folder / CURRENT_FILE, error)

    def _name(self, current: Current) -> None:
        """Write `CURRENT`, with the last row that is durable."""
        self._unsettled = True  # where it fails, it may be another than before, or only in the system's memory
        current = replace(current, last=self._rows.last)
        write_current(self._folder, current)
        self._current, self._unsettled = current, current.log != self._current.log

    def heads(self, after: int = 0, *, kind: str | None = None) -> Iterator[Head]:
        """Yield the records behind sequence `after` without their arrays, up to the last at the start.

        `kind`: only those of this kind. Compacted records keep their heads, but for those that a repair named as lost.
        Raises DamageError at the first that is damaged or missing.
        """
        return (head for head in self._rows_behind(after, arrays=False) if kind in (None, head.kind))

    def record(self, sequence: int) -> Record:
        """Return the record of this sequence.

        Raises RecordError where there is none, CompactedError where compaction gave up its arrays, DamageError.
        """
        with self._using("reading a row"):
            last = self._rows.last
            if type(sequence) is not int or not 1 <= sequence <= last:
                raise RecordError(f"{self.path} has records 1 to {last}, not {sequence!r}")
            if (row := self._row_behind(sequence - 1, sequence, arrays=True)) is None:
                raise self._given_up(sequence)  # a repair left it out
            return cast(Record, row)

    def records(self, after: int = 0) -> Iterator[Record]:
        """Yield the records behind sequence `after`, verified and in order, up to the last at the start.

        One is in memory at a time. Raises DamageError at the first that is damaged or missing; its `sequence` is the
        `after` with which to continue behind it. Raises CompactedError where the first are compacted: `compaction` has
        their place, and its `last_sequence` is the `after` to continue with.
        """
        if after < self._settled().compacted:
            raise self._given_up(after + 1)
        return cast(Iterator[Record], self._rows_behind(after, arrays=True))

    def with_key(self, key: bytes) -> Iterator[Head]:
        """Yield the records with this key without their arrays. Raises DamageError."""
        with self._using("looking for a key"):
            sequences = self._rows.with_key(key)
        for sequence in sequences:
            with self._using("reading a row"):
                head = self._row_behind(sequence - 1, sequence, arrays=False)
            if head is not None and head.key == key:
                yield head

    def _rows_behind(self, after: int, *, arrays: bool) -> Iterator[Head]:
        with self._using("looking for rows"):
            last = self._rows.last
        while after < last:
            with self._using(f"reading rows behind {after}"):
                head = self._row_behind(after, last, arrays=arrays)
            if head is None:
                return  # those that are left gave up their arrays, and a repair left them out
            yield head
            after = head.sequence

    def _row_behind(self, after: int, last: int, *, arrays: bool) -> Head | None:
        """Return the first row behind one and up to `last`, verified, None where there is none; arrays: as a record.

        Raises DamageError, also where one is missing, and CompactedError for compacted arrays.
        """
        index = self._rows.find(after)
        sequence = self._rows.sequences[index] if index < len(self._rows) else last + 1
        # Of compacted ones a repair may have left some out.
        first, through = 1 + max(after, self._current.compacted), min(sequence - 1, last)
        if first <= through:
            missing = f"row {through} is missing" if first == through else f"rows {first} to {through} are missing"
            raise self._damage(f"{missing} from", through)
        if sequence > last:
            return None
        offset, size = self._rows.offsets[index], self._rows.sizes[index]
        try:
            if arrays:
                head, payload = decode_row(self._log.read(offset, size))
            else:
                head, payload = read_head(self._log, offset, size), None
            if head.sequence != sequence:
                raise ValueError(f"it has the number {head.sequence}")
            if not arrays:
                return head
            if payload is None:
                if sequence <= self._current.compacted:
                    raise self._given_up(sequence)
                raise ValueError("its arrays are missing")
            return Record(**vars(head), arrays=decode_payload(payload))
        except (DamageError, ValueError) as error:
            raise self._damage(f"row {sequence} is not as it was written ({error}) in", sequence) from error

    def _given_up(self, sequence: int) -> CompactedError:
        return CompactedError(
            f"records 1 to {self._current.compacted} of {self.path} gave up their arrays when it was compacted "
            f"(row {sequence}, too): begin with compaction(), and continue behind its last_sequence"
        )

    def _damage(self, what: str, sequence: int) -> DamageError:
        named = next((named for named in self._current.checkpoints if named.last_sequence >= sequence), None)
        still = "no checkpoint contains it"
        if named is not None:
            still = f"checkpoint {named.number} (up to row {named.last_sequence}) still contains it"
        path = self._log.path
        return DamageError(f"{what} {path}; {still}: repair the store (repair_store)", path=path, sequence=sequence)

    # Checkpoints.

    def latest(self) -> Checkpoint | None:
        """Return the newest checkpoint that verifies, None when there is none.

        A logged warning names the file and the array of each checkpoint that it passes over. Raises VersionError for a
        checkpoint of another format.
        """
        passed = set[int]()
        while left := [named for named in self._settled().checkpoints if named.number not in passed]:
            try:
                return self._load(left[0])
            except DamageError as damage:
                if self._is_named(left[0]):
                    passed.add(left[0].number)
                    logger.warning("%s; replaying the journal behind an older checkpoint, or all of it", damage)
        return None

    def compaction(self) -> Checkpoint | None:
        """Return the checkpoint that stands for the compacted records, None when there are none.

        Raises DamageError where it does not verify, VersionError for another format, and CompactedError for a reader of
        a store that was compacted again since its last `state`.
        """
        if (named := self._settled().compaction) is None:
            return None
        try:
            return self._load(named)
        except DamageError as error:
            if self._is_named(named):
                raise
            raise CompactedError(f"{self.path} was compacted again since it was read: read it anew") from error

    def _is_named(self, named: NamedCheckpoint) -> bool:
        """Whether a checkpoint still counts; a reader, whose writer replaces and removes them, looks again."""
        self.state()
        return named in self._settled().checkpoints

    def _load(self, named: NamedCheckpoint) -> Checkpoint:
        path = checkpoint_path(self._folder, named.number)
        reader = CheckpointReader(path)
        if reader.sha256 != named.sha256:
            raise DamageError(f"{path} is another checkpoint than the one that is named", path=path)
        return Checkpoint(named.number, named.last_sequence, reader.attributes, reader.arrays())

    def commit(self, arrays: Arrays, *, last_sequence: int, attributes: Attributes = None) -> int:
        """Write a checkpoint that contains the records up to `last_sequence`, make it current, return its number.

        The checkpoint with the highest `last_sequence` is current, and of several with the same the last committed. It
        waits for a background commit first, and raises its failure here in place of committing. Raises RecordError for
        arrays, attributes or a `last_sequence` that cannot be kept, StoreFullError, ReadOnlyError or another
        StoreError; the checkpoint before then stays current.
        """
        draft = self._draft(arrays, last_sequence, attributes)
        self._idle()
        return self._commit(draft)

    def commit_later(self, arrays: Arrays, *, last_sequence: int, attributes: Attributes = None) -> None:
        """Do as `commit` in a background thread; the arrays are handed over and must not change any more.

        While one is being written, only the newest of those handed over waits. A failure is logged, and that of the
        last one raised, once, by the next `commit`, `commit_later` (which then queues nothing), `flush` or `close`.
        What cannot be kept is refused at once, with RecordError. While the interpreter ends nothing is written: the
        log holds the rows.
        """
        draft = self._draft(arrays, last_sequence, attributes)
        if self._later is not None and self._later.done():
            self._idle()
        with self._queue, suppress(RuntimeError):  # it starts no job any more
            earlier, self._later = self._later, self._worker.submit(self._commit_later, draft)
            if earlier is not None:
                earlier.cancel()

    def _draft(self, arrays: Arrays, last_sequence: int, attributes: Attributes) -> Checkpoint:
        self._check_open(write=True)
        self._refuse_in_batch("committing a checkpoint")  # its rows may yet be rolled back
        first, last = self._settled().compacted, self._rows.last
        if type(last_sequence) is not int or not first <= last_sequence <= last:
            # Recovery could not resume among the compacted rows, which have given up their arrays.
            what = f"last_sequence must be from {first}, the last that was compacted, to {last}, the last that there is"
            raise RecordError(f"{what}, not {last_sequence!r}")
        if reserved := [name for name in arrays if name.startswith(INDEX)]:
            raise RecordError(f"no array may be called {reserved[0]!r}: {INDEX!r} begins the names of the store's own")
        return Checkpoint(0, last_sequence, from_json(to_json("attributes", attributes)), check_arrays(arrays))

    def _commit(self, draft: Checkpoint) -> int:
        with self._committing:
            with self._using("looking where rows are"):
                log, place = self._current.log_identity, self._rows.place(self._log, draft.last_sequence)
                table = self._rows.table(draft.last_sequence)
            named = self._write(draft, place, log, table)
            # When this fails all folders stay, for the next commit or open to remove: what could not be synced may
            # be on the disk all the same, and count after a crash.
            with self._using("committing"):
                newest = self._current.newest
                if newest is None or named.last_sequence >= newest.last_sequence:
                    self._name(replace(self._current, newest=named))
            self._remove_unnamed()
            return named.number

    def _write(self, draft: Checkpoint, place: LogPlace, log: bytes, table: np.ndarray) -> NamedCheckpoint:
        """Write a draft, with which rows are where in a log."""
        number = 1 + max(numbers(self._folder, CHECKPOINT, PARTIAL), default=0)
        draft = replace(draft, number=number, arrays={**draft.arrays, index_name(log): table})
        return NamedCheckpoint(number, draft.last_sequence, write_checkpoint(self._folder, draft, self.identity), place)

    def _commit_later(self, draft: Checkpoint) -> None:
        try:
            self._commit(draft)
        except Exception as error:
            if isinstance(error, RuntimeError) and "interpreter shutdown" in str(error):
                return  # no thread starts a job any more, without which zarr writes nothing
            logger.exception("%s: a background commit failed; the journal still holds its rows", self.path)
            if isinstance(error, StoreError):
                raise
            raise StoreError(f"a background commit failed: {error!r}") from error

    def _wait(self) -> None:
        if (later := self._later) is not None:
            wait_for([later])

    def _idle(self) -> None:
        """Wait for what was handed over, and raise its failure, once."""
        while (later := self._later) is not None:
            self._wait()
            with self._queue:
                if self._later is not later:  # another thread was here meanwhile
                    continue
                self._later = None
            later.result()

    def flush(self) -> None:
        """Return when what was handed to `commit_later` is committed; raise the failure if it is not."""
        self._check_open()
        self._refuse_in_batch("waiting for the background commit")
        self._idle()

    def _remove_unnamed(self) -> None:
        """Remove what `CURRENT` does not name: what was replaced, and what a writer that died left."""
        try:
            current = self._settled()
            with reported(self.path, "removing checkpoints"):
                remove_unnamed(self._folder, current)
        except StoreError as error:
            # The commit itself stands; the next one, or the next open, removes what is left.
            logger.warning("%s: what was replaced could not be removed: %s", self.path, error)

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
        drafts = [self._draft(arrays, last_sequence, attributes)]
        if newest is not None:
            drafts.append(self._draft(newest[0], self._rows.last, newest[1]))
        self._idle()
        with self._committing:
            with self._using("putting another log in place"):
                if last_sequence < self._current.compacted:  # another thread compacted meanwhile
                    raise RecordError(f"{self.path} was compacted up to {self._current.compacted} meanwhile")
                self._name(self._compacted(drafts))
            # This opens the log that took its place. Where it cannot, whoever uses the store next does, or learns why.
            self._remove_unnamed()

    def _compacted(self, drafts: list[Checkpoint]) -> Current:
        """Write a log in which rows have no arrays, and the checkpoints that stand for them; read all of it back."""
        number = 1 + max(numbers(self._folder, LOG, NEW), default=0)
        path = log_path(self._folder, number)
        try:
            header, last_sequence = to_json("identity", self.identity).encode(), drafts[0].last_sequence
            identity = create_log(path, header, ((ROW, data) for data in self._payloads(last_sequence)))
            with Log(path) as log:
                rows = read_back(log)
                places = [rows.place(log, each.last_sequence) for each in drafts]
            named = [
                self._write(each, place, identity, rows.table(each.last_sequence))
                for each, place in zip(drafts, places, strict=True)
            ]
            for one in named:
                self._load(one)
        except BaseException:
            remove_tree(path)
            raise
        return Current(number, identity, named[-1], named[0])

    def _payloads(self, last_sequence: int) -> Iterator[bytes]:
        """Yield the bytes of each row in order, of those up to `last_sequence` without their arrays."""
        rows = self._rows
        for index, sequence in enumerate(rows.sequences):
            if sequence <= last_sequence:
                head = self._row_behind(sequence - 1, sequence, arrays=False)
                assert head is not None
                yield head_without_arrays(head)
                continue
            try:
                yield self._log.read(rows.offsets[index], rows.sizes[index])
            except DamageError as error:
                raise self._damage(f"row {sequence} is not as it was written ({error}) in", sequence) from error

    # The folder.

    def backup(self, destination: str | os.PathLike[str], *, progress: Progress | None = None) -> None:
        """Copy the store to the new folder `destination`, also while it is written, from here or elsewhere.

        The copy is the store as it was at one moment since the call: all records durable then, and the checkpoints. It
        appears there verified, complete and durable, or not at all; a power cut may leave a folder named
        `destination`.….partial. Nobody who writes waits for it. `progress` is called as by `check_store`.

        Raises NotAStoreError where something is at `destination` or it lies inside the store, DamageError where the
        copy does not verify, StoreFullError, ReadOnlyError or another StoreError.
        """
        self._check_open()
        back_up(self._folder, store_folder(destination), progress)

    def size(self) -> dict[str, int]:
        """Return the bytes on the disk: {"journal": …, "checkpoints": …}."""
        with self._using("measuring the store"):
            return {"journal": self._log.size(), "checkpoints": tree_size(self._folder / CHECKPOINTS)}

    def close(self) -> None:
        """Wait for the background commit, release the files and the lock; a second call does nothing.

        Raises the failure of a background commit, after everything is released, and StoreError in a batch.
        """
        # What a fork inherited belongs to the parent.
        if os.getpid() != self._process:
            return
        self._refuse_in_batch("closing the store")
        self._worker.shutdown()
        with self._committing, self._guard:  # what another thread commits would be named under the next writer's lock
            if self._closed:
                return
            self._closed = True
            if self.mode == "write" and self._current.last < self._rows.last:
                self._note_last()
            self._held.close()
        self._idle()

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
