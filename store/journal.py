"""The journal: the rows of a store's log by their sequence, each durable before `insert` returns."""

from __future__ import annotations

import logging
import threading
from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from contextlib import contextmanager

from store.archive import Files
from store.encoding import decode_payload
from store.exceptions import CompactedError, DamageError, StoreClosedError, StoreError, reported
from store.files import sync_folder
from store.layout import CURRENT_FILE, Current, log_path
from store.log import LogReader, Place
from store.log_writer import LogWriter
from store.records import JSON, Head, Record, from_json
from store.row_encoding import (
    ROW,
    decode_head,
    decode_row,
    encode_row,
    head_without_arrays,
    key_prefix,
)
from store.rows import EVERY, Index, Rows, head_bytes

__all__ = ["Journal"]

logger = logging.getLogger(__name__)

LAST_SEQUENCE = 2**62  # far beyond what anybody appends
ATTEMPTS = 8  # of a reader, while a writer puts another log in the place of the one
MOST_PLACES = 4096


class _OpenLog:
    """The log that `CURRENT` names, opened, and what is known of its rows.

    first: the last row before those that are known; read_all: whether there are none before these. places: rows, and
    where in the log all behind them follow.
    """

    def __init__(self, files: Files, current: Current, *, write: bool) -> None:
        self._files, self.current, self.path = files, current, log_path(files.folder, current.log)
        self.rows, self.first, self._told = Rows(), 0, 0
        named = current.newest
        self.log = self._reader(None if named is None else named.place, write=write)
        try:
            if self.log.identity != current.log_identity:
                raise DamageError(f"{self.path} is the log of another store, or of another time", path=self.path)
            self.identity = self._read_identity()
            self.index = Index(files.folder, current.log_identity, self.log.beginning)
            if named is not None and self.log.place == named.place:
                self.first = named.upto
            self.read_all = self.first == 0
            self.places = [(self.first, self.log.place)]
            self.catch_up()
            if write:
                self._begin_writing()
        except BaseException:
            self.log.close()
            raise

    def _reader(self, place: Place | None, *, write: bool) -> LogReader:
        """Return the log from a place on; where that is not in it a reader begins at the beginning."""
        try:
            return self._files.read_log(self.path, place=place)
        except DamageError as damage:
            if place is None:
                raise
            if write:
                raise DamageError(f"{damage}: repair the store (repair_store)", path=self.path) from damage
            logger.warning("%s; reading all of it", damage)
            return self._files.read_log(self.path)

    def _read_identity(self) -> dict[str, JSON]:
        try:
            return from_json(self.log.header.decode())
        except ValueError as error:
            raise DamageError(f"the identity in {self.path} was never written so: {error}", path=self.path) from error

    def _begin_writing(self) -> None:
        for damage in self.rows.damage.values():
            raise DamageError(
                f"{damage[0]}: repair the store (repair_store) before anything is appended behind it", path=self.path
            )
        self.log.close()
        self.log = LogWriter(self.path, place=self.log.place)
        # `CURRENT` may name this log in the system's memory alone: a power cut would take what follows.
        sync_folder(self.path.parent)

    def catch_up(self) -> None:
        """Take in what was committed since."""
        for behind in self.rows.take(self.log):
            self.note_place(behind)

    def note_place(self, place: Place) -> None:
        """Note the place behind all rows that are known."""
        self.places.append((self.last_row, place))
        if len(self.places) > MOST_PLACES:
            del self.places[1:-1:2]

    @property
    def last_row(self) -> int:
        """The sequence of the last row that is known."""
        return self.rows.sequences[-1] if self.rows.sequences else self.first

    @property
    def last(self) -> int:
        """The last row, or the last that a checkpoint contains, if later."""
        # A checkpoint counts only when rows were lost: then their numbers must not be given out again.
        return max([self.last_row, *(named.upto for named in self.current.checkpoints)])

    def find(self, after: int) -> int:
        """Return the index of the first row behind `after`, once all rows from there on are known."""
        if after < self.first and not self.read_all:
            self._read_before()
        return bisect_right(self.rows.sequences, after)

    def _read_before(self) -> None:
        until = self.places[0][1].offset
        earlier = Rows() if self._files.is_packed else self.index.read(self.log, until)
        for _ in earlier.take(self.log.beginning_at(self.index.end), until):
            pass
        earlier.extend(self.rows)
        self.rows, self.read_all = earlier, True

    def tell_damage(self) -> None:
        """Log a warning, once, for all that is damaged among the rows that are known."""
        for damage in () if self._told == len(self.rows.damage) else self.rows.damage.values():
            logger.warning(
                "%s; what was there is passed over where rows of one kind, name or key are asked for", damage[0]
            )
        self._told = len(self.rows.damage)

    def drop_index(self) -> bool:
        """Read the log itself where an index was used, which may be wrong; whether one was."""
        if not self.index.count:
            return False
        end, staged = self.log.place.offset, Rows()
        for row in zip(self.rows.sequences, self.rows.offsets, self.rows.sizes, self.rows.keys, strict=True):
            if row[1] >= end:
                staged.append(*row)
        self.index = Index(self._files.folder, self.current.log_identity, self.log.beginning)
        self.rows, self.first, self.read_all = Rows(), 0, True
        for _ in self.rows.take(self.log.beginning_at(self.log.beginning), end):
            pass
        self.rows.extend(staged)
        return True

    def keep_index(self) -> None:
        """Have the files of the index say what is known, where that is much more than they do."""
        if len(self.rows) >= EVERY:
            self.find(0)
            try:
                self.index.write(self.rows, self.log.place)
            except OSError as error:
                logger.warning("%s: the index of rows could not be written: %s", self.path, error)

    def head(self, index: int) -> Head:
        """Return the head of a row. Raises DamageError, and ValueError for what is none."""
        size = self.rows.sizes[index]
        return decode_head(head_bytes(self.log, self.rows.offsets[index], size), size)

    def data(self, index: int) -> bytes:
        """Return the bytes of a row, verified. Raises DamageError."""
        return self.log.read(self.rows.offsets[index], self.rows.sizes[index])[1]


class Journal:
    """The journal of a store, usable from any thread; raises the store's own errors.

    To write, it is opened by whoever holds the writer's lock; a damaged end is refused then, for what is appended
    would lie behind it.
    """

    def __init__(self, files: Files, *, write: bool) -> None:
        self._files, self.folder, self._write = files, files.folder, write
        self._guard = threading.RLock()
        self._batch = self._failed = False
        self._unsettled = False
        with reported(self.folder, "opening the journal"):
            self._open: _OpenLog | None = self._opened()

    def _opened(self) -> _OpenLog:
        for _ in range(ATTEMPTS):
            current = self._files.current()
            try:
                return _OpenLog(self._files, current, write=self._write)
            except FileNotFoundError as error:
                # A writer removes a log after another has taken its place.
                if self._files.current() == current:
                    path = log_path(self.folder, current.log)
                    raise DamageError(
                        f"{path}, which {self.folder / CURRENT_FILE} names, is not there: put it back from a copy, or "
                        "repair the store (repair_store), which resumes from what verifies",
                        path=path,
                    ) from error
        raise StoreError(f"{self.folder} is compacted again and again: open it later")

    @contextmanager
    def _using(self, doing: str) -> Iterator[_OpenLog]:
        with self._guard, reported(self.folder, doing):
            if self._open is None:
                raise StoreClosedError(f"the store in {self.folder} is closed")
            if self._unsettled:
                self._settle(self._open)
            yield self._open

    def _settle(self, at: _OpenLog) -> None:
        """Find out what `CURRENT` names, and make it durable: what wrote it failed, or has put another log in place."""
        current = self._files.current()
        if current.log == at.current.log:
            at.current = current
            sync_folder(self.folder)
        else:
            self._open = self._opened()
            at.log.close()
        self._unsettled = False

    def unsettle(self) -> None:
        """Take note that `CURRENT` may be another than before, or only in the system's memory."""
        with self._guard:
            self._unsettled = True

    @contextmanager
    def _looking(self, doing: str) -> Iterator[_OpenLog]:
        """The log in use, of a reader after it has read what was committed since."""
        with self._using(doing) as at:
            yield at if self._write or self._files.is_packed else self._renewed(at)

    def _renewed(self, at: _OpenLog) -> _OpenLog:
        current = self._files.current()
        if (current.log, current.log_identity) == (at.current.log, at.current.log_identity):
            at.current = current
            try:
                at.catch_up()
                return at
            except DamageError:
                raise
            except StoreError as error:  # its writer took back what had been read
                logger.info("%s", error)
        self._open = self._opened()
        at.log.close()
        return self._open

    @property
    def identity(self) -> dict[str, JSON]:
        """What the store is for."""
        with self._using("reading what the store is for") as at:
            return at.identity

    def current(self) -> Current:
        """Return what `CURRENT` says, for a reader at this moment."""
        with self._looking("looking for checkpoints") as at:
            return at.current

    def committed(self, current: Current) -> None:
        """Take note of what was just written as `CURRENT`, with the same log."""
        with self._using("committing") as at:
            at.current = current

    def last(self) -> int:
        """Return the sequence of the last row, or the last that a checkpoint contains, if later; or 0."""
        with self._looking("looking for the last row") as at:
            return at.last

    @contextmanager
    def batch(self) -> Iterator[None]:
        """Make the rows inserted in the block durable together, at its end, or none of them.

        Other threads wait for the end. After a failed insert the rest of the block's are refused.
        """
        with self._guard:
            self.refuse_in_batch("beginning a batch")
            at, writer = self._writing("beginning a batch")
            self._batch, self._failed = True, False
            try:
                yield
                if self._failed:
                    raise StoreError(f"nothing of this batch was kept in {self.folder}: a row of it failed")
                writer.commit()
                at.note_place(writer.place)
            except BaseException:
                self._undo(at, writer)
                raise
            finally:
                self._batch = False

    def refuse_in_batch(self, doing: str) -> None:
        """Raise StoreError in a batch of this thread, and wait for the end of another thread's."""
        with self._guard:
            if self._batch:
                raise StoreError(f"{doing} is not possible in a batch of {self.folder}: end it first")

    def _writing(self, doing: str) -> tuple[_OpenLog, LogWriter]:
        with self._using(doing) as at:
            assert isinstance(at.log, LogWriter), "a store that is read refuses before"
            return at, at.log

    def insert(self, kind: str, label: str, key: bytes, time: float, attributes: str, payload: bytes) -> int:
        """Add a row and return its sequence once it is durable, or, in a batch, once it is written.

        After any error the row is not there, nor any other of its batch.
        """
        with self._guard:
            at, writer = self._writing("appending a row")
            if self._batch and self._failed:
                raise StoreError(f"nothing more can be appended to {self.folder} in this batch: a row of it failed")
            if (sequence := at.last + 1) > LAST_SEQUENCE:
                raise DamageError(f"{at.path} has a row, or a checkpoint, of number {at.last}", path=at.path)
            data = encode_row(sequence, kind, label, key, time, attributes, payload, len(payload))
            try:
                frame = writer.stage(ROW, data)
                at.rows.append(sequence, frame.offset, frame.size, key_prefix(key))
                if not self._batch:
                    writer.commit()
                    at.note_place(writer.place)
            except BaseException:
                self._failed = True
                self._undo(at, writer)
                raise
            return sequence

    @staticmethod
    def _undo(at: _OpenLog, writer: LogWriter) -> None:
        """Take back what is not durable; what was committed before an interruption stays, and is known."""
        writer.rollback()
        at.rows.cut(bisect_left(at.rows.offsets, writer.place.offset))
        at.note_place(writer.place)

    def place(self, upto: int) -> Place:
        """Return a place in the log that all rows behind `upto` are behind."""
        with self._using("looking for a place") as at:
            found = bisect_right(at.places, upto, key=lambda noted: noted[0])
            return at.places[max(found - 1, 0)][1]

    def rows(
        self, after: int, last: int, *, arrays: bool, kind: str | None = None, label: str | None = None
    ) -> Iterator[Head]:
        """Yield the verified rows behind `after` up to `last`, of one kind or label only where it is given.

        arrays: as records, one in memory at a time. Raises DamageError at the first that is not as it was written,
        or that is missing itself where all are asked for; CompactedError where a base has the arrays' place.
        """
        chosen, begin = kind is not None or label is not None, after
        while after < last:
            head = None
            with self._using(f"reading rows behind {after}") as at:
                index = at.find(after)
                found = at.rows.sequences[index] if index < len(at.rows) else last + 1
                try:
                    if chosen:
                        at.tell_damage()
                    else:
                        self._require_no_gap(at, after, min(found - 1, last), index)
                    if found > last:
                        break
                    head = self._record(at, index) if arrays else self._head(at, index)
                except DamageError as damage:
                    if at.drop_index():
                        continue
                    if not chosen:
                        raise
                    logger.warning("%s", damage)
            after = found
            if head is not None and kind in (None, head.kind) and label in (None, head.label):
                yield head
        if not chosen:
            self._require_no_damage_at_the_end(begin, last)

    def _require_no_damage_at_the_end(self, after: int, last: int) -> None:
        """Raise for rows behind `after` that are damaged and are the last: frames that go on behind them prove it."""
        with self._using("reading the last rows") as at:
            begin, end = self.place(after).offset, at.log.place.offset
            for damage in at.rows.damage.get(len(at.rows), ()) if last >= at.last else ():
                if damage.offset is not None and begin <= damage.offset < end:
                    raise DamageError(f"{damage}: repair the store (repair_store)", path=at.path)

    def _require_no_gap(self, at: _OpenLog, after: int, through: int, index: int) -> None:
        why = at.rows.damage.get(index)
        # Up to the base a repair may have left some out.
        first = 1 + (after if why is not None else max(after, at.current.compacted))
        if first > through:
            return
        missing = f"row {through} is missing" if first == through else f"rows {first} to {through} are missing"
        raise self._damage(at, f"{missing}{'' if why is None else f' ({why[0]})'} from", through)

    def _head(self, at: _OpenLog, index: int) -> Head:
        sequence = at.rows.sequences[index]
        try:
            head = at.head(index)
            if head.sequence != sequence:
                raise ValueError(f"it has the number {head.sequence}")
        except ValueError as error:
            raise self._damage(at, f"row {sequence} is not as it was written ({error}) in", sequence) from error
        return head

    def _record(self, at: _OpenLog, index: int) -> Record:
        sequence = at.rows.sequences[index]
        try:
            row = decode_row(at.data(index))
            if row.head.sequence != sequence:
                raise ValueError(f"it has the number {row.head.sequence}")
            if row.payload is None:
                if sequence <= at.current.compacted:
                    raise self.given_up(sequence)
                raise ValueError("its arrays are missing")
            return Record(**vars(row.head), arrays=decode_payload(row.payload))
        except (DamageError, ValueError) as error:
            raise self._damage(at, f"row {sequence} is not as it was written ({error}) in", sequence) from error

    def with_key(self, key: bytes) -> Iterator[Head]:
        """Yield the rows of a key, but for damaged ones, which a logged warning names."""
        with self._looking("looking for a key") as at:
            at.find(0)
            at.tell_damage()
            for index in at.rows.with_key(key):
                try:
                    head = self._head(at, index)
                except DamageError as damage:
                    logger.warning("%s", damage)
                else:
                    if head.key == key:
                        yield head

    def keep_index(self) -> None:
        """Write what is known of the rows beside the log, so that nobody has to read it for that."""
        with self._using("keeping the index of rows") as at:
            at.keep_index()

    def given_up(self, sequence: int) -> CompactedError:
        """Return the error for a row whose arrays a base stands for."""
        with self._using("looking for a base") as at:
            compacted = at.current.compacted
        return CompactedError(
            f"the arrays of row {sequence} of {self.folder} were given up when rows 1 to {compacted} were compacted"
        )

    @staticmethod
    def _damage(at: _OpenLog, what: str, sequence: int) -> DamageError:
        named = next((named for named in at.current.checkpoints if named.upto >= sequence), None)
        still = "no checkpoint contains it"
        if named is not None:
            still = f"checkpoint {named.number} (up to row {named.upto}) still contains it"
        return DamageError(
            f"{what} {at.path}; {still}; records(after={sequence}) continues behind it",
            path=at.path,
            sequence=sequence,
        )

    def payloads(self, upto: int) -> Iterator[bytes]:
        """Yield the bytes of each row, in order, those up to `upto` without their arrays, which are not read.

        Raises DamageError. Nothing can be appended meanwhile.
        """
        with self._using("reading rows") as at:
            at.find(0)
            for damage in at.rows.damage.values():
                raise DamageError(f"{damage[0]}: repair the store (repair_store)", path=at.path)
            for index, sequence in enumerate(at.rows.sequences):
                head = self._head(at, index)
                try:
                    yield head_without_arrays(head) if sequence <= upto else at.data(index)
                except DamageError as error:
                    raise self._damage(at, f"row {sequence} is not as it was written ({error}) in", sequence) from error

    @contextmanager
    def switching(self) -> Iterator[None]:
        """In the block another log takes the place of this one, and nothing is appended; afterwards that is used."""
        with self._using("putting another log in place"):
            try:
                yield
            finally:
                # A sync that failed leaves it open which of the two is named.
                self._unsettled = True
            with self._using("putting another log in place"):
                pass

    def size(self) -> int:
        """Return the bytes of the log."""
        with self._looking("measuring the log") as at:
            return at.log.size

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        with self._guard, reported(self.folder, "closing the journal"):
            at, self._open = self._open, None
            if at is not None:
                at.log.close()
