"""The journal: rows in SQLite, each durable before `insert` returns and verified when it is read."""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from store.encoding import decode_payload
from store.exceptions import CompactedError, DamageError, StoreClosedError, StoreError, reported
from store.reader import JournalReader, Limits
from store.records import (
    GENERATION_COLUMNS,
    HEAD_COLUMNS,
    JSON,
    GenerationRow,
    Head,
    Record,
    checksum,
    from_json,
    lost_heads,
    payload_digest,
    read_head,
    read_meta,
    uncovered,
)
from store.schema import connect_to_write

__all__ = ["Journal"]

logger = logging.getLogger(__name__)

# Rows read at once where their arrays are not: a reader that pauses must hold no transaction open,
# for that would keep the write-ahead log from ever being emptied.
TOGETHER = 4096

# Far beyond what anybody appends, and short of where SQLite's integers end.
LAST_SEQUENCE = 2**62


class Journal:
    """An open journal file, usable from any thread; raises the store's own errors."""

    def __init__(self, path: Path, *, write: bool) -> None:
        self.path = path
        self._guard = threading.RLock()
        self._connection: sqlite3.Connection | None = None
        self._batch = False
        self._reader: JournalReader | None = None
        with reported(path, "opening the journal"):
            if write:
                self._connection = connect_to_write(path)
                self._limits = Limits(path, self._connection)
            else:
                self._reader = JournalReader(path)
        try:
            self.identity = self._read_identity()
            self._last = self.last() if write else 0
        except BaseException:
            self.close()
            raise

    @contextmanager
    def _using(self, doing: str) -> Iterator[sqlite3.Connection]:
        with self._guard, reported(self.path, doing):
            if self._connection is None:
                raise StoreClosedError(f"the store of {self.path} is closed")
            self._limits.begin()
            yield self._connection

    def _fetch(self, doing: str, query: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """Return the rows of a query, those of a writer's own transaction, too."""
        with self._guard, reported(self.path, doing):
            if self._reader is not None:
                return self._reader.fetch(query, values)
            if self._connection is None:
                raise StoreClosedError(f"the store of {self.path} is closed")
            return self._limits.fetch(query, values)

    def _read_identity(self) -> dict[str, JSON]:
        meta = read_meta(self._fetch("reading what the store is for", "SELECT key, value, checksum FROM meta"))
        self._lost = lost_heads(meta)
        try:
            return from_json(meta["identity"])
        except (KeyError, ValueError) as error:
            raise DamageError(
                f"the identity in {self.path}, table meta, fails its checksum: repair the store (repair_store), "
                "which takes it from a generation",
                path=self.path,
            ) from error

    def last(self) -> int:
        """Return the sequence of the last row, or the last that a generation contains, if later; or 0."""
        # Payloads and generations count only when rows were lost: then their numbers must not be given out
        # again, and whoever reads on to the last must meet the gap.
        query = (
            "SELECT max(coalesce((SELECT max(sequence) FROM record), 0),"
            " coalesce((SELECT max(sequence) FROM payload), 0)), (SELECT max(upto) FROM generation)"
        )
        ((last, upto),) = self._fetch("looking for the last row", query)
        if upto is None or (isinstance(upto, int) and upto <= last):
            return int(last)
        return max([int(last), *(row.upto for row in self.generations() if row.sound)])

    @contextmanager
    def batch(self) -> Iterator[None]:
        """Make the rows inserted in the block durable together, at its end, or none of them.

        Other threads wait for the end. After a failed insert the rest of the block's are refused.
        """
        with self._guard:
            self.refuse_in_batch("beginning a batch")
            with self._using("beginning a batch") as connection:
                connection.execute("BEGIN IMMEDIATE")
            self._batch = True
            # Not inside `_using`: what the block itself raises is not the store's error.
            try:
                yield
                with self._using("making a batch durable"):
                    if not connection.in_transaction:
                        raise StoreError(f"nothing of this batch was kept in {self.path}: a row of it failed")
                    connection.execute("COMMIT")
            except BaseException:
                self._undo_batch(connection)
                raise
            finally:
                self._batch = False

    def _undo_batch(self, connection: sqlite3.Connection) -> None:
        try:
            with self._using("rolling a batch back"):
                connection.rollback()
                self._last = self.last()
        except StoreError as error:
            # The caller has to learn what ended the batch; the next insert rolls back again.
            logger.warning("%s: a batch could not be rolled back yet: %s", self.path, error)

    def refuse_in_batch(self, doing: str) -> None:
        """Raise StoreError in a batch of this thread, and wait for the end of another thread's."""
        with self._guard:
            if self._batch:
                raise StoreError(f"{doing} is not possible in a batch of {self.path}: end it first")

    def insert(self, kind: str, label: str, key: bytes, time: float, attributes: str, payload: bytes) -> int:
        """Add a row and return its sequence once it is durable, or, in a batch, once it is written.

        After any error the row is not there, nor any other of its batch.
        """
        with self._using("appending a row") as connection:
            if self._batch and not connection.in_transaction:
                raise StoreError(f"nothing more can be appended to {self.path} in this batch: a row of it failed")
            if (sequence := self._last + 1) > LAST_SEQUENCE:
                raise DamageError(f"{self.path} has a row, or a generation, of number {self._last}", path=self.path)
            digest = payload_digest(payload)
            fields = (sequence, kind.encode(), label.encode(), key, time, attributes.encode(), len(payload), digest)
            values = (sequence, kind, label, key, time, attributes, len(payload), digest, checksum("record", *fields))
            try:
                if not self._batch:
                    connection.execute("BEGIN IMMEDIATE")
                connection.execute(f"INSERT INTO record ({HEAD_COLUMNS}) VALUES (?,?,?,?,?,?,?,?,?)", values)
                connection.execute("INSERT INTO payload (sequence, bytes) VALUES (?,?)", (sequence, payload))
                if not self._batch:
                    connection.execute("COMMIT")
            except BaseException:
                connection.rollback()
                # A failed sync may have left the row in place: then its number is taken.
                self._last = self.last()
                raise
            self._last = sequence
            return sequence

    def rows(
        self, after: int, last: int, *, arrays: bool, kind: str | None = None, label: str | None = None
    ) -> Iterator[Head]:
        """Yield the verified rows behind `after` up to `last`, of one kind or label only where it is given.

        arrays: as records, one in memory at a time. Raises DamageError at the first that fails its checksum, whose
        arrays do or are missing, or that is missing itself where all are asked for; CompactedError where a base has
        the arrays' place.
        """
        chosen = {column: value for column, value in (("kind", kind), ("label", label)) if value is not None}
        where = " AND ".join(["sequence > ?", "sequence <= ?", *(f"{column} = ?" for column in chosen)])
        payload = ", (SELECT bytes FROM payload WHERE sequence = record.sequence)" if arrays else ""
        together = 1 if arrays else TOGETHER
        query = f"SELECT {HEAD_COLUMNS}{payload} FROM record WHERE {where} ORDER BY sequence LIMIT {together}"
        while after < last:
            rows = self._fetch(f"reading rows behind {after}", query, (after, last, *chosen.values()))
            for *fields, payload in rows if arrays else ((*row, b"") for row in rows):
                if fields[0] <= after:
                    raise self._damage(f"row {fields[0]} follows row {after} in", fields[0])
                if not chosen:
                    self._require_no_gap(after + 1, fields[0] - 1)
                found = read_head(tuple(fields))
                if found is None:
                    raise self._damage(f"row {fields[0]} fails its checksum in", fields[0])
                yield self._record(*found, payload) if arrays else found[0]
                after = fields[0]
            if len(rows) < together:
                if not chosen:
                    self._require_no_gap(after + 1, last)
                return

    def _require_no_gap(self, first: int, last: int) -> None:
        for begin, end in uncovered(first, last, self._lost):
            raise self._damage(f"rows {begin} to {end} are missing from", end)

    def _record(self, head: Head, digest: bytes, payload: object) -> Record:
        if payload is None:
            if head.sequence <= self.compacted():
                raise self.given_up(head.sequence)
            raise self._damage(f"the arrays of row {head.sequence} are missing from", head.sequence)
        # A flipped bit can also change a value's type.
        if not isinstance(payload, bytes) or payload_digest(payload) != digest:
            raise self._damage(f"the arrays of row {head.sequence} fail their checksum in", head.sequence)
        try:
            return Record(**vars(head), arrays=decode_payload(payload))
        except (TypeError, ValueError) as error:  # anybody can make the checksum
            what = f"the arrays of row {head.sequence} were never written so ({error}) in"
            raise self._damage(what, head.sequence) from error

    def given_up(self, sequence: int) -> CompactedError:
        """Return the error for a row whose arrays a base stands for."""
        return CompactedError(
            f"the arrays of row {sequence} of {self.path} were given up when rows 1 to {self.compacted()} were "
            "compacted"
        )

    def compacted(self) -> int:
        """Return the last row that has given up its arrays for a base, 0 where none has."""
        query = f"SELECT {GENERATION_COLUMNS} FROM generation WHERE base"
        rows = [GenerationRow(*row) for row in self._fetch("looking for a base", query)]
        # One that fails its checksum does not count: then the rows themselves say that their arrays are missing.
        return max((row.upto for row in rows if row.sound), default=0)

    def _damage(self, what: str, sequence: int) -> DamageError:
        query = "SELECT number, upto FROM generation WHERE upto >= ? ORDER BY number DESC LIMIT 1"
        try:
            covering = self._fetch("looking for a generation", query, (sequence,))
            still = "no generation contains it"
            if covering:
                still = f"generation {covering[0][0]} (up to row {covering[0][1]}) still contains it"
        except StoreError:
            still = "the table of generations cannot be read either"
        return DamageError(
            f"{what} {self.path}; {still}; records(after={sequence}) continues behind it",
            path=self.path,
            sequence=sequence,
        )

    def generations(self) -> list[GenerationRow]:
        """Return the rows of the committed generations, the newest first, not yet verified."""
        query = f"SELECT {GENERATION_COLUMNS} FROM generation ORDER BY upto DESC, number DESC"
        return [GenerationRow(*row) for row in self._fetch("looking for generations", query)]

    def newest(self) -> int | None:
        """Return the number of the newest generation, None when there is none."""
        query = "SELECT number FROM generation ORDER BY upto DESC, number DESC LIMIT 1"
        rows = self._fetch("looking for the newest generation", query)
        return int(rows[0][0]) if rows else None

    def make_current(self, row: GenerationRow, *, forget: Iterable[int]) -> None:
        """In one transaction make `row` a generation and drop the rows numbered in `forget`.

        Where it is a base the rows up to its `upto` give up their arrays in the same transaction.
        """
        with self._using(f"committing generation {row.number}") as connection:
            self.refuse_in_batch("committing a generation")
            try:
                connection.execute("BEGIN IMMEDIATE")
                connection.execute(
                    f"INSERT INTO generation ({GENERATION_COLUMNS}) VALUES (?,?,?,?,?,?,?)", row.values()
                )
                connection.executemany("DELETE FROM generation WHERE number = ?", [(old,) for old in forget])
                if row.base:
                    connection.execute("DELETE FROM payload WHERE sequence <= ?", (row.upto,))
                connection.execute("COMMIT")
            except BaseException:
                connection.rollback()
                raise

    def shrink(self) -> None:
        """Give the space of what was dropped back to the disk; needs as much again meanwhile.

        Raises StoreError where that is not to be had, or where a reader is in the file just now.
        """
        with self._using("giving back space") as connection:
            connection.execute("VACUUM")
            (busy, *_) = connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
            if busy:
                raise StoreError(f"{self.path} is being read just now; it shrinks when the store is closed")

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        with self._guard, reported(self.path, "closing the journal"):
            reader, self._reader = self._reader, None
            connection, self._connection = self._connection, None
            for each in (reader, connection):
                if each is not None:
                    each.close()
