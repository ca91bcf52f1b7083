"""The journal: rows in SQLite, each durable before `insert` returns and verified when it is read."""

from __future__ import annotations

import json
import os
import sqlite3
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from store.arrays import decode_payload
from store.errors import DamageError, StoreClosedError, StoreError
from store.records import JSON, Record, from_json
from store.reporting import reported
from store.schema import checksum

__all__ = ["GenerationRow", "Journal"]

# Seconds for another program, such as a backup, to leave a transaction before it is reported.
PATIENCE = 5.0

RECORD_COLUMNS = "sequence, kind, label, key, time, attributes, payload, checksum"
GENERATION_COLUMNS = "number, upto, time, attributes, content, checksum"


@dataclass(frozen=True)
class GenerationRow:
    """What the journal knows of a generation; `content` is what `write_generation` returned, as JSON."""

    number: int
    upto: int
    time: float
    attributes: bytes
    content: bytes
    checksum: bytes

    @classmethod
    def of(cls, number: int, upto: int, time: float, attributes: str, content: dict[str, Any]) -> GenerationRow:
        """Return the row with its checksum."""
        texts = attributes.encode(), json.dumps(content, separators=(",", ":")).encode()
        return cls(number, upto, time, *texts, checksum("generation", number, upto, time, *texts))

    def verified(self, journal: Path) -> tuple[dict[str, JSON], dict[str, Any]]:
        """Return the attributes and the content; raise DamageError if they are not as written."""
        try:
            expected = checksum("generation", self.number, self.upto, self.time, self.attributes, self.content)
            if expected == self.checksum:
                return from_json(self.attributes.decode()), dict(from_json(self.content.decode()))
        except (TypeError, ValueError, AttributeError):
            # A flipped bit can also change a value's type.
            pass
        raise DamageError(f"the row of generation {self.number} in {journal} fails its checksum", path=journal)


class Journal:
    """An open journal file, usable from any thread; raises the store's own errors."""

    def __init__(self, path: Path, *, write: bool) -> None:
        self.path = path
        self._guard = threading.RLock()
        self._connection: sqlite3.Connection | None = None
        with reported(path, "opening the journal"):
            self._connection = _connect(path, write=write)
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
            yield self._connection

    def _read_identity(self) -> dict[str, JSON]:
        with self._using("reading what the store is for") as connection:
            rows = connection.execute("SELECT key, value, checksum FROM meta").fetchall()
        try:
            meta = {key: value for key, value, check in rows if checksum("meta", key, value) == check}
            return from_json(meta[b"identity"].decode())
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DamageError(f"the identity in {self.path}, table meta, fails its checksum", path=self.path) from error

    def last(self) -> int:
        """Return the sequence of the last row, or the last that a generation contains, if later; or 0."""
        # The second only when rows were lost: their numbers must not be given out again.
        query = (
            "SELECT max(coalesce((SELECT max(sequence) FROM record), 0),"
            " coalesce((SELECT max(upto) FROM generation), 0))"
        )
        with self._using("looking for the last row") as connection:
            return int(connection.execute(query).fetchone()[0])

    def insert(self, kind: str, label: str, key: bytes, time: float, attributes: str, payload: bytes) -> int:
        """Add a row and return its sequence once it is durable; after any error the row is not there."""
        with self._using("appending a row") as connection:
            sequence = self._last + 1
            fields = (sequence, kind.encode(), label.encode(), key, time, attributes.encode(), payload)
            values = (sequence, kind, label, key, time, attributes, payload, checksum("record", *fields))
            try:
                connection.execute(f"INSERT INTO record ({RECORD_COLUMNS}) VALUES (?,?,?,?,?,?,?,?)", values)
            except sqlite3.Error:
                _roll_back(connection)
                # A failed sync may have left the row in place: then its number is taken.
                self._last = self.last()
                raise
            self._last = sequence
            return sequence

    def row_after(self, after: int) -> Record | None:
        """Return the verified row that follows sequence `after`, None when that was the last.

        Raises DamageError when the row fails its checksum or is missing.
        """
        query = f"SELECT {RECORD_COLUMNS} FROM record WHERE sequence > ? ORDER BY sequence LIMIT 1"
        with self._using(f"reading row {after + 1}") as connection:
            row = connection.execute(query, (after,)).fetchone()
            missing_to = self.last() if row is None else row[0] - 1
        if missing_to > after:
            raise self._damage(f"rows {after + 1} to {missing_to} are missing from", missing_to)
        if row is None:
            return None
        *fields, stored = row
        try:
            if checksum("record", *fields) == stored:
                return _record(*fields)
        except (TypeError, ValueError, AttributeError):
            # A flipped bit can also change a value's type.
            pass
        raise self._damage(f"row {row[0]} fails its checksum in", row[0])

    def _damage(self, what: str, sequence: int) -> DamageError:
        query = "SELECT number, upto FROM generation WHERE upto >= ? ORDER BY number DESC LIMIT 1"
        try:
            with self._using("looking for a generation") as connection:
                covering = connection.execute(query, (sequence,)).fetchone()
            still = "no generation contains it"
            if covering is not None:
                still = f"generation {covering[0]} (up to row {covering[1]}) still contains it"
        except StoreError:
            still = "the table of generations cannot be read either"
        return DamageError(
            f"{what} {self.path}; {still}; records(after={sequence}) goes on behind it",
            path=self.path,
            sequence=sequence,
        )

    def generations(self) -> list[GenerationRow]:
        """Return the rows of the committed generations, the newest first, not yet verified."""
        query = f"SELECT {GENERATION_COLUMNS} FROM generation ORDER BY number DESC"
        with self._using("looking for generations") as connection:
            return [GenerationRow(*row) for row in connection.execute(query).fetchall()]

    def make_current(self, row: GenerationRow, *, forget: Iterable[int]) -> None:
        """In one transaction make `row` the newest generation and drop the rows numbered in `forget`."""
        values = (row.number, row.upto, row.time, row.attributes.decode(), row.content.decode(), row.checksum)
        with self._using(f"making generation {row.number} current") as connection:
            try:
                connection.execute("BEGIN IMMEDIATE")
                connection.execute(f"INSERT INTO generation ({GENERATION_COLUMNS}) VALUES (?,?,?,?,?,?)", values)
                connection.executemany("DELETE FROM generation WHERE number = ?", [(old,) for old in forget])
                connection.execute("COMMIT")
            except BaseException:
                _roll_back(connection)
                raise

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        with self._guard, reported(self.path, "closing the journal"):
            if self._connection is not None:
                connection, self._connection = self._connection, None
                connection.close()


def _connect(path: Path, *, write: bool) -> sqlite3.Connection:
    options = "mode=rw" if write else "mode=ro"
    if not write and _is_still(path):
        options = "immutable=1"
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?{options}",
        uri=True,
        timeout=PATIENCE,
        isolation_level=None,
        check_same_thread=False,
    )
    try:
        # Bytes, because damaged text need not be UTF-8, and the checksum is over the bytes.
        connection.text_factory = bytes
        if write:
            connection.execute("PRAGMA synchronous = FULL")
            # On a Mac a plain fsync stops at the drive's cache.
            connection.execute("PRAGMA fullfsync = 1")
            connection.execute("PRAGMA checkpoint_fullfsync = 1")
            (mode,) = connection.execute("PRAGMA journal_mode = WAL").fetchone()
            if mode != b"wal":
                raise StoreError(f"{path}: its file system cannot hold a write-ahead log (mode {mode!r})")
    except BaseException:
        connection.close()
        raise
    return connection


def _is_still(path: Path) -> bool:
    # Without a log, in a folder where SQLite could not make one, it refuses to read unless told
    # that nothing changes: an archive on a read-only disk.
    return not os.access(path.parent, os.W_OK) and not path.with_name(path.name + "-wal").exists()


def _roll_back(connection: sqlite3.Connection) -> None:
    if connection.in_transaction:
        connection.execute("ROLLBACK")


def _record(
    sequence: int, kind: bytes, label: bytes, key: bytes, time: float, attributes: bytes, payload: bytes
) -> Record:
    return Record(
        sequence,
        kind.decode(),
        label.decode(),
        key,
        time,
        from_json(attributes.decode()),
        decode_payload(payload),
    )
