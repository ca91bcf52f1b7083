"""The journal: the rows of a store's log by their sequence, each durable before `insert` returns."""

from __future__ import annotations

import logging
import threading
from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from scroll_tactile_store.archive import Files
from scroll_tactile_store.encoding import check_arrays, encode_payload
from scroll_tactile_store.exceptions import CompactedError, DamageError, StoreClosedError, StoreError, reported
from scroll_tactile_store.files import sync_folder
from scroll_tactile_store.layout import CURRENT_FILE, Current, log_path, write_current
from scroll_tactile_store.log import LogPlace
from scroll_tactile_store.log_writer import LogWriter
from scroll_tactile_store.open_log import OpenLog
from scroll_tactile_store.records import (
    JSON,
    Arrays,
    Attributes,
    Head,
    check_key,
    check_text,
    check_time,
    from_json,
    to_json,
)
from scroll_tactile_store.row_encoding import ROW, encode_row, head_without_arrays, key_prefix

__all__ = ["Journal"]

logger = logging.getLogger(__name__)

LAST_SEQUENCE = 2**62  # far beyond what anybody appends
ATTEMPTS = 8  # of a reader, while a writer puts another log in the place of the one


class Journal:
    """The journal of a store, usable from any thread; raises the store's own errors.

    To write, it is opened by whoever holds the writer's lock; a damaged end is refused then, for what is appended
    would lie behind it.
    """

    def __init__(self, files: Files, *, write: bool) -> None:
        self._files, self.folder, self._write = files, files.folder, write
        self._guard, self._naming = threading.RLock(), threading.Lock()
        self._batch = self._failed = False
        self._unsettled = False
        with reported(self.folder, "opening the journal"):
            self._open: OpenLog | None = self._opened()

    def _opened(self) -> OpenLog:
        for _ in range(ATTEMPTS):
            current = self._files.current()
            try:
                return OpenLog(self._files, current, write=self._write)
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
    def _using(self, doing: str) -> Iterator[OpenLog]:
        with self._guard, reported(self.folder, doing):
            if self._open is None:
                raise StoreClosedError(f"the store in {self.folder} is closed")
            if self._unsettled:
                self._settle(self._open)
            yield self._open

    def _settle(self, at: OpenLog) -> None:
        """Find out what `CURRENT` names, and make it durable: what wrote it failed, or has put another log in place."""
        current = self._files.current()
        if current.log == at.current.log:
            at.current = current
            sync_folder(self.folder)
        else:
            self._open = self._opened()
            at.log.close()
        self._unsettled = False

    @contextmanager
    def _looking(self, doing: str) -> Iterator[OpenLog]:
        """The log in use, of a reader after it has read what was committed since."""
        with self._using(doing) as at:
            yield at if self._write or self._files.is_packed else self._renewed(at)

    def _renewed(self, at: OpenLog) -> OpenLog:
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

    def commit(self, current: Current) -> None:
        """Write `CURRENT`, with the same log."""
        with reported(self.folder, "committing"):
            try:
                with self._naming:
                    write_current(self.folder, current)
            except BaseException:
                # It may be another than before, or only in the system's memory.
                with self._guard:
                    self._unsettled = True
                raise
        with self._using("committing") as at:
            at.current = current

    def _note_last(self, at: OpenLog) -> None:
        """Have `CURRENT` say which row is the last, so that a log that is cut off later is not taken for whole."""
        try:
            with self._naming:
                if replace(self._files.current(), last=0) == replace(at.current, last=0):
                    current = replace(at.current, last=at.last)
                    write_current(self.folder, current)
                    at.current = current
        except (OSError, StoreError) as error:  # nothing is lost but this knowledge
            logger.warning("%s could not say that row %d is the last: %s", self.folder / CURRENT_FILE, at.last, error)

    def last(self) -> int:
        """Return the sequence of the last row, or the last that a checkpoint contains, if later; or 0."""
        with self._looking("looking for the last row") as at:
            return at.last

    @contextmanager
    def batch(self) -> Iterator[None]:
        """Make the rows inserted in the block durable together, at its end, or none of them.

        Other threads wait for the end. After a failed insert the rest of the block's are refused. The caller has asked
        `refuse_in_batch`.
        """
        with self._guard:
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
            self._note_first(at)

    def refuse_in_batch(self, doing: str) -> None:
        """Raise StoreError in a batch of this thread, and wait for the end of another thread's."""
        with self._guard:
            if self._batch:
                raise StoreError(f"{doing} is not possible in a batch of {self.folder}: end it first")

    def _writing(self, doing: str) -> tuple[OpenLog, LogWriter]:
        with self._using(doing) as at:
            assert isinstance(at.log, LogWriter), "a store that is read refuses before"
            return at, at.log

    def insert(
        self, kind: str, label: str, key: bytes, time: float, attributes: Attributes, arrays: Arrays | None
    ) -> Head:
        """Add a row and return its head once it is durable, or, in a batch, once it is written.

        Raises RecordError for what cannot be kept. After any other error neither the row nor any of its batch is there.
        """
        check_text("the kind", kind)
        check_text("the label", label)
        check_key(key)
        seconds, text = check_time(time), to_json("attributes", attributes)
        payload = encode_payload(check_arrays(arrays))
        with self._guard:
            at, writer = self._writing("appending a row")
            if self._batch and self._failed:
                raise StoreError(f"nothing more can be appended to {self.folder} in this batch: a row of it failed")
            if (sequence := at.last + 1) > LAST_SEQUENCE:
                raise DamageError(f"{at.path} has a row, or a checkpoint, of number {at.last}", path=at.path)
            data = encode_row(sequence, kind, label, key, seconds, text, payload, len(payload))
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
            if not self._batch:
                self._note_first(at)
        return Head(sequence, kind, label, key, seconds, from_json(text), len(payload))

    def _note_first(self, at: OpenLog) -> None:
        """Have `CURRENT` say that the log has rows, as soon as that is so: without any it would look like a new one."""
        if not at.current.last and at.last_row:
            self._note_last(at)

    @staticmethod
    def _undo(at: OpenLog, writer: LogWriter) -> None:
        """Take back what is not durable; what was committed before an interruption stays, and is known."""
        writer.rollback()
        at.rows.cut(bisect_left(at.rows.offsets, writer.place.offset))
        at.note_place(writer.place)

    def place(self, last_sequence: int) -> LogPlace:
        """Return a place in the log that all rows behind `last_sequence` are behind."""
        with self._using("looking for a place") as at:
            found = bisect_right(at.places, last_sequence, key=lambda noted: noted[0])
            return at.places[max(found - 1, 0)][1]

    def rows(
        self, after: int, last: int, *, arrays: bool, kind: str | None = None, label: str | None = None
    ) -> Iterator[Head]:
        """Yield the verified rows behind `after` up to `last`, of one kind or label only where it is given.

        arrays: as records, one in memory at a time. Raises DamageError at the first that is not as it was written,
        or that is missing itself where all are asked for; CompactedError where compaction gave the arrays up.
        """
        chosen, begin = kind is not None or label is not None, after
        while after < last:
            head = None
            with self._using(f"reading rows behind {after}") as at:
                index = at.find(after)
                found = at.rows.sequences[index] if index < len(at.rows) else last + 1
                try:
                    if chosen:
                        at.warn_of_damage()
                    else:
                        at.require_no_gap(after, min(found - 1, last), index)
                    if found > last:
                        break
                    head = at.row(index, arrays=arrays)
                except DamageError as damage:
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

    def with_key(self, key: bytes) -> Iterator[Head]:
        """Yield the rows of a key, but for damaged ones, which a logged warning names."""
        with self._looking("looking for a key") as at:
            at.find(0)
            at.warn_of_damage()
            sequences = [at.rows.sequences[index] for index in at.rows.with_key(key)]
        for sequence in sequences:
            try:
                for head in self.rows(sequence - 1, sequence, arrays=False):
                    if head.key == key:
                        yield head
            except DamageError as damage:
                logger.warning("%s", damage)

    def table(self, last_sequence: int) -> np.ndarray | None:
        """Return which rows up to a sequence are where in the log; None where any is damaged."""
        with self._using("looking where rows are") as at:
            return at.table(last_sequence)

    def given_up(self, sequence: int) -> CompactedError:
        """Return the error for a row whose arrays a compaction checkpoint stands for."""
        with self._using("looking for compacted rows") as at:
            return at.given_up(sequence)

    def payloads(self, last_sequence: int) -> Iterator[bytes]:
        """Yield the bytes of each row, in order, those up to `last_sequence` without their arrays, which are not read.

        Raises DamageError. Nothing can be appended meanwhile.
        """
        with self._using("reading rows") as at:
            at.find(0)
            for damage in at.rows.damage.values():
                raise DamageError(f"{damage[0]}: repair the store (repair_store)", path=at.path)
            for index, sequence in enumerate(at.rows.sequences):
                head = at.row(index, arrays=False)
                yield head_without_arrays(head) if sequence <= last_sequence else at.data(index)

    @contextmanager
    def switching(self) -> Iterator[None]:
        """In the block another log takes the place of this one, and nothing is appended; afterwards that is used."""
        with self._using("putting another log in place"):
            try:
                yield
            finally:
                # A sync that failed leaves it open which of the two is named.
                self._unsettled = True
            try:
                with self._using("opening the log that took its place"):
                    pass
            except StoreError as error:  # it stands; whoever uses it next opens it, or learns why that cannot be
                logger.warning(
                    "%s: the log that took the place of another could not be opened yet: %s", self.folder, error
                )

    def size(self) -> int:
        """Return the bytes of the log."""
        with self._looking("measuring the log") as at:
            return at.log.size

    def close(self) -> None:
        """Close the file, of which `CURRENT` says where it ends; a second call does nothing."""
        with self._guard, reported(self.folder, "closing the journal"):
            at, self._open = self._open, None
            if at is not None:
                if self._write and at.current.last < at.last_row:
                    self._note_last(at)
                at.log.close()
