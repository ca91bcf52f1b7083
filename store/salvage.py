"""What a damaged journal still holds: read as far as it goes, verified row by row; nothing is written."""

from __future__ import annotations

import enum
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from store.exceptions import SQLITE_ERRORS, DamageError, NotAStoreError, VersionError, from_sqlite, is_damage, reported
from store.files import file_size, require_room
from store.header import header_fault, holds_store, new_first_page
from store.reader import JournalReader, Limits
from store.records import GENERATION_COLUMNS, HEAD_COLUMNS, GenerationRow, Spans, read_meta, united
from store.schema import FORMAT_VERSION, JOURNAL_FILE, LOG, PAGE_BYTES, ROLLBACK, build_journal, connect, has_our_schema
from store.writeahead import damaged_frame, describe_frame, mend_log

__all__ = ["Fault", "Row", "Salvage", "require_salvageable"]

# Sequences in a row that cannot be read, behind which no more are tried: more than one page can lead to.
GIVE_UP = 16384

Row = tuple[Any, ...]


class Fault(enum.Enum):
    """What can be wrong with a row, said of one and of several."""

    MISSING = ("is missing", "are missing")
    DAMAGED = ("fails its checksum", "fail their checksums")
    UNREADABLE = ("cannot be read", "cannot be read")
    NO_ARRAYS = ("has lost its arrays", "have lost their arrays")
    DAMAGED_ARRAYS = ("has arrays that fail their checksum", "have arrays that fail their checksums")
    FOREIGN_ARRAYS = ("has arrays that were never written so", "have arrays that were never written so")
    UNREADABLE_ARRAYS = ("has arrays that cannot be read", "have arrays that cannot be read")

    @property
    def takes_head(self) -> bool:
        """Whether not even the row without its arrays is left."""
        return self in (Fault.MISSING, Fault.DAMAGED, Fault.UNREADABLE)

    def describe(self, first: int, last: int) -> str:
        """Return in words that rows `first` to `last` have this fault."""
        return f"row {first} {self.value[0]}" if first == last else f"rows {first} to {last} {self.value[1]}"


def require_salvageable(folder: Path) -> None:
    """Return where `folder` holds a store, or what is left of one.

    Raises NotAStoreError and VersionError as `holds_store`, but not where only the header says so and the
    tables behind it are those of a store of this format.
    """
    try:
        if not holds_store(folder):
            raise NotAStoreError(f"{folder} holds no store")
    except DamageError:
        return
    except (NotAStoreError, VersionError):
        if not _has_our_tables(folder / JOURNAL_FILE):
            raise


def _has_our_tables(path: Path) -> bool:
    if not path.is_file():
        return False
    try:
        # Immutable: of another program's database not even a shared memory may be made.
        with closing(connect(path, "mode=ro&immutable=1")) as connection:
            rows = Limits(path, connection).fetch("SELECT key, value, checksum FROM meta")
            return read_meta(rows).get("format") == str(FORMAT_VERSION)
    except (*SQLITE_ERRORS, DamageError):
        return False


class Salvage:
    """A journal that is read as far as it goes; `damage` names what is wrong with the file as a whole.

    A damaged first page says wrongly where everything is; but it is the same in every journal, so a copy with
    a new one is read instead. Of a damaged log a mended copy is read. Nothing that is read counts as
    right for that: the rows have their checksums. Raises StoreError for a file that this user may not read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: list[str] = []
        self._connection: sqlite3.Connection | None = None
        with ExitStack() as undo, reported(path, "salvaging the journal"):
            self._reader: JournalReader | None = None
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
        frame, fault = damaged_frame(log), header_fault(self.path)
        self.damage += [] if frame is None else [describe_frame(log, frame)]
        self.damage += [] if fault is None else [fault]
        if file_size(self.path.with_name(self.path.name + ROLLBACK)):
            self.damage.append(f"another program was writing to {self.path} and did not end")
        if not self.damage:
            self._reader = undo.enter_context(closing(JournalReader(self.path, require_schema=False)))
            self._connection, self._limits = self._reader.connection, self._reader.limits
            try:
                if has_our_schema(self._connection):
                    self.damage += self._found_by_sqlite()
                    return
                self.damage.append(f"the tables of {self.path} are not where and what they were made as")
            except SQLITE_ERRORS as error:
                self._require_damage(error)
                self.damage.append(f"SQLite refuses to read {self.path}: {error}")
        copy = _mended(self.path, Path(undo.enter_context(TemporaryDirectory())), log=frame is not None)
        self._connection = undo.enter_context(closing(connect(copy, "mode=ro", require_schema=False)))
        self._limits = Limits(self.path, self._connection)
        # So SQLite reads even a file that is shorter than it says; nothing is written.
        self._connection.execute("PRAGMA writable_schema = ON")

    def _found_by_sqlite(self) -> list[str]:
        rows, whole = self._until_damage("PRAGMA integrity_check")
        lines = [row[0].decode("utf-8", "replace") for row in rows]
        lines = [line.removeprefix("*** in database main ***\n").replace("\n", "; ") for line in lines if line != "ok"]
        return [f"SQLite finds in {self.path}: {line}" for line in lines + ([] if whole else ["no more"])]

    def _require_damage(self, error: sqlite3.Error | UnicodeDecodeError) -> None:
        # A sector that the disk cannot read is damage, too.
        if not is_damage(error) and getattr(error, "sqlite_errorcode", -1) & 0xFF != sqlite3.SQLITE_IOERR:
            raise from_sqlite(error, self.path, "salvaging the journal") from error

    def _scan(self, query: str, *values: int) -> Iterator[Row | None]:
        """Yield rows; None in place of those that cannot be read any more."""
        if self._connection is None:
            yield None
            return
        self._limits.begin()
        try:
            with closing(self._connection.execute(query, values)) as cursor:
                yield from cursor
        except SQLITE_ERRORS as error:
            self._require_damage(error)
            yield None

    def _until_damage(self, query: str, *values: int) -> tuple[list[Row], bool]:
        """Return the rows up to the first that cannot be read, and whether these are all."""
        found = list(self._scan(query, *values))
        rows = [row for row in found if row is not None]
        return rows, len(rows) == len(found)

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

    def compacted(self) -> int:
        """Return the last row that a base stands for, as far as the rows of generations tell."""
        return max((row.upto for row in self.generations()[0] if row.sound and row.base), default=0)

    def last(self) -> tuple[int, bool]:
        """Return the last sequence that a row or a payload has, and whether both tables could be read for it."""
        found = [self._number(f"SELECT coalesce(max(sequence), 0) FROM {table}") for table in ("record", "payload")]
        return max(number or 0 for number in found), None not in found

    def may_have_payloads(self, through: int) -> bool:
        """Return whether a row up to `through` has a payload, or may have, because that cannot be read."""
        return self._number(f"SELECT count(*) FROM payload WHERE sequence <= {through}") != 0

    def rows(self, last: int, lost: Spans, *, whole: bool) -> Iterator[tuple[int, int, Row | Fault]]:
        """Yield every sequence once, ascending: (s, s, its row), or (first, last, why there are no rows).

        The rows are not verified. whole: `last` is to be believed; otherwise there may be rows behind it.
        lost: rows that an earlier repair left out.
        """
        after = 0
        for row in self._scan(f"SELECT {HEAD_COLUMNS} FROM record ORDER BY sequence"):
            if row is None or row[0] <= after:
                break
            if row[0] > after + 1:
                yield after + 1, row[0] - 1, Fault.MISSING
            yield row[0], row[0], row
            after = row[0]
        else:
            if after < last:
                yield after + 1, last, Fault.MISSING
            return
        # Behind a page that cannot be read the index still leads to rows, one by one.
        misses = 0
        while not self.is_gone and misses < GIVE_UP and (after < last or not whole):
            after = next((end for begin, end in lost if begin <= after + 1 <= end), after + 1)
            rows, readable = self._until_damage(f"SELECT {HEAD_COLUMNS} FROM record WHERE sequence = ?", after)
            misses = 0 if rows else misses + 1
            yield after, after, rows[0] if rows else Fault.MISSING if readable else Fault.UNREADABLE
        if after < last:
            yield after + 1, last, Fault.MISSING if self.is_gone else Fault.UNREADABLE

    def payload(self, sequence: int) -> tuple[bytes | None, bool]:
        """Return the payload of a row, not verified, None where there is none; and whether that could be read."""
        rows, whole = self._until_damage("SELECT bytes FROM payload WHERE sequence = ?", sequence)
        found = rows[0][0] if rows else None
        # A flipped bit can also change a value's type; no payload is empty.
        return (found if found is None or isinstance(found, bytes) else b""), whole

    def strays(self, compacted: int) -> Spans:
        """Return the payloads that have no row, or that a base stands for."""
        query = (
            "SELECT payload.sequence FROM payload LEFT JOIN record ON record.sequence = payload.sequence"
            " WHERE record.sequence IS NULL OR payload.sequence <= ? ORDER BY payload.sequence"
        )
        return united((sequence, sequence) for (sequence,) in self._until_damage(query, compacted)[0])

    @property
    def moved(self) -> bool:
        """Whether a writer came meanwhile: then what was found may be of no moment, and has to be looked for again."""
        return self._reader is not None and self._reader.moved()

    def close(self) -> None:
        """Close the file."""
        self._connection = None
        self._undo.close()


def _mended(path: Path, scratch: Path, *, log: bool) -> Path:
    """Copy the journal, with a new first page, and its log; of a damaged log one that SQLite reads to its end."""
    copy, beside = scratch / JOURNAL_FILE, path.with_name(path.name + LOG)
    require_room(scratch, path, beside)
    shutil.copyfile(path, copy)
    if log:
        mend_log(beside, scratch / beside.name)
    elif beside.exists():
        shutil.copyfile(beside, scratch / beside.name)
    build_journal(scratch / "new", {})
    with copy.open("r+b") as file:
        file.write(new_first_page((scratch / "new").read_bytes()[:PAGE_BYTES]))
    return copy
