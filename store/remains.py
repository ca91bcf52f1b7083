"""What is left of a journal: all of it that can be read, whatever is damaged; nothing is written."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import ExitStack, closing
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from store.connection import connect
from store.errors import DamageError, NotAStoreError, VersionError
from store.files import file_size
from store.header import header_fault, holds_store, with_new_header
from store.log import damaged_frame, log_text, mend_log
from store.reporting import SQLITE_ERRORS, from_sqlite, is_damage, reported
from store.rows import GENERATION_COLUMNS, HEAD_COLUMNS, GenerationRow, Spans, read_meta
from store.schema import FORMAT_VERSION, JOURNAL_FILE, LOG, PAGE_BYTES, build_journal, has_our_schema

__all__ = ["WINDOW", "Remains", "require_remains"]

# Rows looked at together; behind damage, sequences that are tried one by one.
WINDOW = 256


def require_remains(folder: Path) -> None:
    """Return where `folder` holds a store, or what is left of one.

    Raises NotAStoreError and VersionError as `holds_store`, but not where only the header says so, and the
    tables behind it are those of a store of this format.
    """
    try:
        if not holds_store(folder):
            raise NotAStoreError(f"{folder} holds no store")
    except DamageError:
        return
    except (NotAStoreError, VersionError):
        if not _is_ours_inside(folder / JOURNAL_FILE):
            raise


def _is_ours_inside(path: Path) -> bool:
    if not path.is_file():
        return False
    try:
        # Immutable: of another program's database not even a shared memory may be made.
        with closing(sqlite3.connect(f"{path.as_uri()}?immutable=1", uri=True)) as connection:
            connection.text_factory = bytes
            rows = connection.execute("SELECT key, value, checksum FROM meta").fetchall()
            return has_our_schema(connection) and read_meta(rows).get("format") == str(FORMAT_VERSION)
    except SQLITE_ERRORS:
        return False


class Remains:
    """A journal that is read as far as it goes; `damage` tells what is wrong with the file as a whole.

    Where its first page is damaged, which says where everything is, a copy with a new one is read in its
    place: that page is the same in every journal. Where its log is, a copy in which it counts. What is read
    is not thereby taken for right: rows have their checksums. Raises StoreError for a file that is not open
    to us.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: list[str] = []
        self._connection: sqlite3.Connection | None = None
        with ExitStack() as undo, reported(path, "reading what there is of the journal"):
            if not path.is_file():
                self.damage.append(f"{path} is missing")
            elif file_size(path) < PAGE_BYTES:
                self.damage.append(f"{path} was cut off: it has {file_size(path)} bytes, and nothing in it can be read")
            else:
                self._open(undo)
            self._undo = undo.pop_all()

    @property
    def is_gone(self) -> bool:
        """Whether there is nothing that could be read."""
        return self._connection is None

    def _open(self, undo: ExitStack) -> None:
        log = self.path.with_name(self.path.name + LOG)
        frame = damaged_frame(log)
        if frame is not None:
            self.damage.append(log_text(log, frame))
        fault = header_fault(self.path)
        fits = fault is None
        if fault is not None:
            self.damage.append(fault)
        elif frame is None:
            connection = undo.enter_context(closing(connect(self.path, write=False)))
            if fits := self._is_readable(connection):
                self._connection = connection
                self.damage += self._found_by_sqlite()
                return
            self.damage.append(f"the tables of {self.path} are not where and what they were made as")
        copy = _mended(self.path, Path(undo.enter_context(TemporaryDirectory())), page=not fits, log=frame is not None)
        self._connection = undo.enter_context(closing(connect(copy, write=False)))
        if not self._is_readable(self._connection) and fits:
            self.damage.append(f"the tables of {self.path} are not where and what they were made as")

    def _is_readable(self, connection: sqlite3.Connection) -> bool:
        try:
            return has_our_schema(connection)
        except SQLITE_ERRORS as error:
            self._require_damage(error)
            self.damage.append(f"SQLite refuses to read {self.path}: {error}")
        # With this it reads, all the same, a file that is shorter than it says; nothing is written.
        connection.execute("PRAGMA writable_schema = ON")
        try:
            return has_our_schema(connection)
        except SQLITE_ERRORS as error:
            self._require_damage(error)
            return False

    def _found_by_sqlite(self) -> list[str]:
        rows, whole = self._until_damage("PRAGMA integrity_check")
        found = [row[0].decode("utf-8", "replace") for row in rows]
        found = [one.removeprefix("*** in database main ***\n").replace("\n", "; ") for one in found if one != "ok"]
        return [f"SQLite finds in {self.path}: {one}" for one in found + ([] if whole else ["no more"])]

    def _require_damage(self, error: sqlite3.Error | UnicodeDecodeError) -> None:
        # A sector that the disk cannot read is damage, too.
        if not is_damage(error) and getattr(error, "sqlite_errorcode", -1) & 0xFF != sqlite3.SQLITE_IOERR:
            raise from_sqlite(error, self.path, "reading what there is of the journal") from error

    def _until_damage(self, query: str, *values: int) -> tuple[list[tuple[Any, ...]], bool]:
        """The rows up to the first that cannot be read, and whether that is all of them."""
        rows: list[tuple[Any, ...]] = []
        if self._connection is None:
            return rows, False
        try:
            with closing(self._connection.execute(query, values)) as cursor:
                rows.extend(cursor)
        except SQLITE_ERRORS as error:
            self._require_damage(error)
            return rows, False
        return rows, True

    def _number(self, query: str) -> int | None:
        rows, whole = self._until_damage(query)
        return int(rows[0][0]) if whole and isinstance(rows[0][0], int) else None

    def meta(self) -> tuple[dict[str, str], int]:
        """Return what verifies of table meta, and how many rows of it do not."""
        rows, _ = self._until_damage("SELECT key, value, checksum FROM meta")
        verified = read_meta(rows)
        return verified, len(rows) - len(verified)

    def generations(self) -> tuple[list[GenerationRow], bool]:
        """Return the rows of generations, not verified, and whether they are all that there were."""
        rows, whole = self._until_damage(f"SELECT {GENERATION_COLUMNS} FROM generation ORDER BY number")
        return [GenerationRow(*row) for row in rows], whole

    def last(self) -> tuple[int, bool]:
        """Return the last sequence that a row or a payload has, and whether both could be asked."""
        found = [self._number(f"SELECT coalesce(max(sequence), 0) FROM {table}") for table in ("record", "payload")]
        return max(number or 0 for number in found), None not in found

    def has_payloads(self, through: int) -> bool:
        """Return whether a row up to `through` has a payload, or may have: where it is not certain that none has."""
        return self._number(f"SELECT count(*) FROM payload WHERE sequence <= {through}") != 0

    def heads(self, after: int) -> tuple[list[tuple[Any, ...]], bool]:
        """Return some rows of table record behind `after`, not verified; False where not one more can be read.

        An empty list and True: there are no more.
        """
        query = f"SELECT {HEAD_COLUMNS} FROM record WHERE sequence > ? ORDER BY sequence LIMIT {WINDOW}"
        rows, whole = self._until_damage(query, after)
        return rows, whole or bool(rows)

    def heads_before(self, through: int) -> list[tuple[Any, ...]]:
        """Return the same from the other side: rows up to `through`, the last first."""
        query = f"SELECT {HEAD_COLUMNS} FROM record WHERE sequence <= ? ORDER BY sequence DESC LIMIT {WINDOW}"
        return self._until_damage(query, through)[0]

    def head(self, sequence: int) -> tuple[tuple[Any, ...] | None, bool]:
        """Return a row of table record, not verified, None where there is none; and whether that could be read."""
        rows, whole = self._until_damage(f"SELECT {HEAD_COLUMNS} FROM record WHERE sequence = ?", sequence)
        return (rows[0] if rows else None), whole

    def payload(self, sequence: int) -> tuple[bytes | None, bool]:
        """Return the payload of a row, not verified, None where there is none; and whether that could be read."""
        rows, whole = self._until_damage("SELECT bytes FROM payload WHERE sequence = ?", sequence)
        found = rows[0][0] if rows else None
        if found is None and self.damage and self._connection is not None:
            found = self._passed_by(self._connection, sequence)
        # A flipped bit can also change a value's type; no payload is empty.
        return (found if found is None or isinstance(found, bytes) else b""), whole

    def _passed_by(self, connection: sqlite3.Connection, sequence: int) -> Any:
        # In a damaged tree the way that leads to a row may be lost, and it is still passed by, from one side.
        for sides in ("> ? - ? ORDER BY sequence", "< ? + ? ORDER BY sequence DESC"):
            query = f"SELECT sequence, bytes FROM payload WHERE sequence {sides}"
            try:
                with closing(connection.execute(query, (sequence, WINDOW))) as cursor:
                    for number, found in islice(cursor, 2 * WINDOW):
                        if number == sequence:
                            return found
            except SQLITE_ERRORS as error:
                self._require_damage(error)
        return None

    def strays(self, compacted: int) -> Spans:
        """Return the payloads that have no row, or that a base stands for."""
        query = (
            "SELECT payload.sequence FROM payload LEFT JOIN record ON record.sequence = payload.sequence"
            " WHERE record.sequence IS NULL OR payload.sequence <= ? ORDER BY payload.sequence"
        )
        spans: Spans = []
        for (sequence,) in self._until_damage(query, compacted)[0]:
            if spans and spans[-1][1] == sequence - 1:
                spans[-1] = (spans[-1][0], sequence)
            else:
                spans.append((sequence, sequence))
        return spans

    def close(self) -> None:
        """Let go of the file."""
        self._connection = None
        self._undo.close()


def _mended(path: Path, scratch: Path, *, page: bool, log: bool) -> Path:
    """Copy the journal and its log, and give the copies a new first page, or a log that SQLite reads to its end."""
    copy, beside = scratch / JOURNAL_FILE, path.with_name(path.name + LOG)
    shutil.copyfile(path, copy)
    if log:
        mend_log(beside, scratch / beside.name)
    elif beside.exists():
        shutil.copyfile(beside, scratch / beside.name)
    if page:
        _put_new_first_page(copy, scratch / "new")
    return copy


def _put_new_first_page(copy: Path, new: Path) -> None:
    build_journal(new, {})
    with copy.open("r+b") as file:
        file.write(with_new_header(new.read_bytes()[:PAGE_BYTES]))
