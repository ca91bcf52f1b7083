"""A journal that is only read: its folder stays byte for byte as it is, and what it says costs bounded work.

SQLite makes two files beside a journal for whoever reads it, and changes them. So it reads in one of three ways:

- Where a writer holds the lock, and its two files are there, SQLite reads beside it, by its own locks.
- Where nobody does and the log is empty, it reads the file as one that nobody changes (`immutable=1`).
- Where nobody does and the log has rows, it reads a private copy of the journal and its log.

The last two rest on nobody writing meanwhile. A writer makes its log before it changes the journal, and removes the
log only after it changed the journal. Therefore, unless both files are of the same sizes and times behind a query as
they were before SQLite first read, what the query gave counts for nothing, and it is asked again, beside that writer.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from store.exceptions import SQLITE_ERRORS, DamageError, LockedError
from store.files import file_size, require_room
from store.header import strangers
from store.lock import is_held
from store.schema import LOG, SHARED, connect

__all__ = ["JournalReader", "Limits"]

# Nanoseconds: file systems note the time of a change in steps of up to this. Two changes in one step look like one.
CLOCK_STEP = 10_000_000
ATTEMPTS = 8

# Instructions of SQLite between two looks at their number. A sound journal needs less than one a byte for a query.
STEPS = 100_000
STEPS_A_BYTE = 10
SPARE_STEPS = 20_000_000
# Bytes that the rows of one query may hold beyond those of the files that they are in.
SPARE_BYTES = 64 * 2**20

Row = tuple[Any, ...]
Stamp = tuple[tuple[int, int, int] | None, ...]


class Limits:
    """What one query may cost: tables can be forged that lead SQLite through one page again and again."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path, self.connection = path, connection
        self._steps = 0
        connection.set_progress_handler(self._count, STEPS)

    def begin(self) -> None:
        """Count from here on."""
        self._steps = 0

    def _size(self) -> int:
        return file_size(self.path) + file_size(self.path.with_name(self.path.name + LOG))

    def _count(self) -> bool:
        self._steps += STEPS
        return self._steps > SPARE_STEPS and self._steps > SPARE_STEPS + STEPS_A_BYTE * self._size()

    def fetch(self, query: str, values: Sequence[object] = ()) -> list[Row]:
        """Return the rows of a query; raise DamageError where they are more than the file can hold, and sqlite3.Error.

        A query that takes too many steps raises sqlite3.OperationalError (SQLITE_INTERRUPT).
        """
        self.begin()
        rows: list[Row] = []
        held = 0
        with closing(self.connection.execute(query, tuple(values))) as cursor:
            while found := cursor.fetchmany(256):
                rows += found
                held += sum(len(value) for row in found for value in row if value.__class__ is bytes)
                if held > SPARE_BYTES and held > SPARE_BYTES + self._size():
                    raise DamageError(f"the rows of {self.path} hold more bytes than the file has", path=self.path)
        return rows


class JournalReader:
    """A journal opened to be read; `connection` is SQLite's, exchanged for another when a writer comes."""

    connection: sqlite3.Connection

    def __init__(self, path: Path, *, require_schema: bool = True) -> None:
        self.path = path
        self._files = str(path), f"{path}{LOG}"
        self._require_schema = require_schema
        self._undo = ExitStack()
        self._seen: Stamp | None = None
        self._open()

    def _open(self) -> None:
        for _ in range(ATTEMPTS):
            with ExitStack() as undo:
                seen = self._stamp()
                beside = [file_size(self.path.with_name(self.path.name + side)) for side in (LOG, SHARED)]
                # With its shared memory there, SQLite makes nothing. Until it is, the writer has changed nothing.
                if beside[1] and seen[1] is not None and is_held(self.path.parent):
                    connection = connect(self.path, "mode=ro", require_schema=self._require_schema)
                    self._adopt(undo, connection, None)
                    return
                _outwait(seen)
                if beside[0]:
                    copy = self._copied(Path(undo.enter_context(TemporaryDirectory(prefix="store-"))))
                    connection = connect(copy, "mode=ro", named=self.path, require_schema=self._require_schema)
                else:
                    connection = connect(self.path, "mode=ro&immutable=1", require_schema=self._require_schema)
                self._adopt(undo, connection, seen)
            if not self.moved():
                return
        raise LockedError(f"another program goes on writing to {self.path}: close it there")

    def _adopt(self, undo: ExitStack, connection: sqlite3.Connection, seen: Stamp | None) -> None:
        undo.callback(connection.close)
        self._undo.close()
        self.connection, self._seen, self._undo = connection, seen, undo.pop_all()
        self.limits = Limits(self.path, connection)

    def _copied(self, scratch: Path) -> Path:
        log = self.path.with_name(self.path.name + LOG)
        require_room(scratch, self.path, log)
        for file in (self.path, log):
            shutil.copyfile(file, scratch / file.name)
        return scratch / self.path.name

    def _stamp(self) -> Stamp:
        """Return what tells whether the journal or its log were changed."""
        found: list[tuple[int, int, int] | None] = []
        for file in self._files:
            try:
                entry = os.lstat(file)
                found.append((entry.st_ino, entry.st_size, entry.st_mtime_ns))
            except FileNotFoundError:
                found.append(None)
        return tuple(found)

    def moved(self) -> bool:
        """Return whether what was read since the last call may be worth nothing, for a writer has come since."""
        if self._seen is None or (now := self._stamp()) == self._seen:
            return False
        # A repair has put another journal there: this one stays as it is, under another name.
        return now[0] is not None and self._seen[0] is not None and now[0][0] == self._seen[0][0]

    def renew(self) -> bool:
        """Open the journal anew where it has moved, and return whether it had."""
        if not self.moved():
            return False
        for stranger in strangers(self.path.parent):
            raise stranger
        self._open()
        return True

    def fetch(self, query: str, values: Sequence[object] = ()) -> list[Row]:
        """Return the rows of a query, as the journal was at one moment; raise as `Limits.fetch`, and LockedError."""
        for _ in range(ATTEMPTS):
            try:
                rows = self.limits.fetch(query, values)
            except (*SQLITE_ERRORS, DamageError):
                if not self.renew():
                    raise
            else:
                if not self.renew():
                    return rows
        raise LockedError(f"another program goes on writing to {self.path}: close it there")

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._undo.close()


def _outwait(seen: Stamp) -> None:
    """Return when a change from now on has another time than the last one."""
    newest = max((entry[2] for entry in seen if entry is not None), default=0)
    if 0 <= time.time_ns() - newest < CLOCK_STEP:
        time.sleep(CLOCK_STEP / 1e9)
