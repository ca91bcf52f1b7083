"""The journal file: what it looks like when new, and whether a folder holds one."""

from __future__ import annotations

import hashlib
import sqlite3
import struct
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from store.errors import DamageError, NotAStoreError, VersionError
from store.files import remove_tree, sync_file, sync_folder
from store.lock import HOLDER_FILE, LOCK_FILE
from store.reporting import reported

__all__ = ["GENERATIONS", "JOURNAL_FILE", "checksum", "create_journal", "holds_store"]

FORMAT_VERSION = 1
APPLICATION_ID = 0x41725263  # "ArRc": arrays and records
JOURNAL_FILE = "journal.sqlite"
GENERATIONS = "generations"

# A draft is renamed when it is complete, so a file of the final name is never half made.
DRAFT_FILE = JOURNAL_FILE + ".new"
OURS = frozenset(
    {LOCK_FILE, HOLDER_FILE, HOLDER_FILE + ".new", GENERATIONS}
    | {DRAFT_FILE + suffix for suffix in ("", "-journal", "-wal", "-shm")}
)

SQLITE_MAGIC = b"SQLite format 3\0"
# The places of user_version and application_id in the header of every SQLite file.
USER_VERSION_AT, APPLICATION_ID_AT, HEADER_LENGTH = 60, 68, 100

TABLES = (
    """CREATE TABLE meta (
    key TEXT PRIMARY KEY NOT NULL,
    value TEXT NOT NULL,
    checksum BLOB NOT NULL
)""",
    """CREATE TABLE record (
    sequence INTEGER PRIMARY KEY,
    kind TEXT NOT NULL,
    label TEXT NOT NULL,
    key BLOB NOT NULL,
    time REAL NOT NULL,
    attributes TEXT NOT NULL,
    payload BLOB NOT NULL,
    checksum BLOB NOT NULL
)""",
    """CREATE TABLE generation (
    number INTEGER PRIMARY KEY,
    upto INTEGER NOT NULL,
    time REAL NOT NULL,
    attributes TEXT NOT NULL,
    content TEXT NOT NULL,
    checksum BLOB NOT NULL
)""",
)


def checksum(table: str, *fields: int | float | bytes) -> bytes:
    """Return the 16-byte BLAKE2b over a row's fields, each with its length before it.

    An int counts as 8 bytes little-endian and a float as its IEEE 754 double, little-endian; the name
    of the table goes first, so that no row passes for one of another table.
    """
    digest = hashlib.blake2b(digest_size=16)
    for field in (table.encode("ascii"), *fields):
        if isinstance(field, int):
            part = struct.pack("<q", field)
        elif isinstance(field, float):
            part = struct.pack("<d", field)
        else:
            part = field
        digest.update(struct.pack("<Q", len(part)))
        digest.update(part)
    return digest.digest()


def holds_store(folder: Path) -> bool:
    """Return whether `folder` holds a store that this release reads; False when one may be made there.

    Only looks. Raises NotAStoreError for a file, for a folder with other things in it and for another
    program's database, VersionError for a newer format, and DamageError for a journal whose first
    bytes are gone while its generations are still there.
    """
    with reported(folder, "looking for a store"):
        if not folder.exists():
            return False
        if not folder.is_dir():
            raise NotAStoreError(f"{folder} is a file; a store is a folder")
        journal = folder / JOURNAL_FILE
        if journal.is_file():
            with journal.open("rb") as file:
                _check_header(journal, file.read(HEADER_LENGTH))
            return True
        _refuse_foreign(folder)
        return False


def _refuse_foreign(folder: Path) -> None:
    generations = folder / GENERATIONS
    if generations.is_dir() and any(generations.iterdir()):
        raise DamageError(
            f"{folder} has generations but no {JOURNAL_FILE}: put the journal back from a copy; "
            "the generations alone do not say which of them is current",
            path=folder / JOURNAL_FILE,
        )
    if foreign := sorted(entry.name for entry in folder.iterdir() if entry.name not in OURS):
        raise NotAStoreError(
            f"{folder} holds no {JOURNAL_FILE} but other things ({', '.join(foreign[:3])}"
            f"{', …' if len(foreign) > 3 else ''}): nothing was written; choose an empty or a new folder"
        )


def _check_header(journal: Path, header: bytes) -> None:
    if len(header) < HEADER_LENGTH or not header.startswith(SQLITE_MAGIC):
        if (journal.parent / GENERATIONS).is_dir():
            raise DamageError(
                f"{journal} does not begin as a SQLite file: put it back from a copy of the folder",
                path=journal,
            )
        raise NotAStoreError(f"{journal} is not a SQLite file; nothing was written")
    (application,) = struct.unpack_from(">I", header, APPLICATION_ID_AT)
    (version,) = struct.unpack_from(">I", header, USER_VERSION_AT)
    if application != APPLICATION_ID:
        raise NotAStoreError(
            f"{journal} is another program's database (application id {application:#010x}, not "
            f"{APPLICATION_ID:#010x}); nothing was written"
        )
    if version > FORMAT_VERSION:
        raise VersionError(
            f"{journal} is written in format {version}; this release reads up to format {FORMAT_VERSION}: "
            "upgrade it, or open the store with the release that wrote it; nothing was changed"
        )


def create_journal(folder: Path, identity: str) -> None:
    """Make an empty journal in `folder`, durable and complete or not there at all.

    `identity` is JSON. The caller holds the writer's lock.
    """
    draft = folder / DRAFT_FILE
    for suffix in ("", "-journal", "-wal", "-shm"):
        remove_tree(folder / (DRAFT_FILE + suffix))
    (folder / GENERATIONS).mkdir(exist_ok=True)
    with closing(sqlite3.connect(draft, isolation_level=None)) as connection:
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("BEGIN")
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {FORMAT_VERSION}")
        # STRICT refuses a value of a wrong type; SQLite knows it since 3.37.
        strict = " STRICT" if sqlite3.sqlite_version_info >= (3, 37) else ""
        for table in TABLES:
            connection.execute(table + strict)
        connection.executemany("INSERT INTO meta VALUES (?, ?, ?)", _meta_rows(identity))
        connection.execute("COMMIT")
        connection.execute("PRAGMA journal_mode = WAL")
    sync_file(draft)
    draft.rename(folder / JOURNAL_FILE)
    sync_folder(folder)
    sync_folder(folder.parent)


def _meta_rows(identity: str) -> list[tuple[str, str, bytes]]:
    values = {
        "format": str(FORMAT_VERSION),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "identity": identity,
    }
    return [(key, value, checksum("meta", key.encode("utf-8"), value.encode("utf-8"))) for key, value in values.items()]
