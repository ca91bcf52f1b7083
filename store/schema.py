"""The journal file: its names, its tables, and how one is made and opened."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Mapping
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from store.exceptions import DamageError, StoreError
from store.files import remove_tree, sync_file, sync_folder
from store.records import checksum

__all__ = [
    "APPLICATION_ID",
    "DAMAGED_FILE",
    "DRAFT_FILE",
    "FORMAT_VERSION",
    "GENERATIONS",
    "JOURNAL_FILE",
    "LOG",
    "PAGE_BYTES",
    "REPAIRED_FILE",
    "ROLLBACK",
    "SHARED",
    "SIDES",
    "build_journal",
    "connect",
    "connect_to_write",
    "create_journal",
    "has_our_schema",
    "new_meta",
    "remove_drafts",
]

FORMAT_VERSION = 1
APPLICATION_ID = 0x41725263  # "ArRc": arrays and records
JOURNAL_FILE = "journal.sqlite"
GENERATIONS = "generations"

# A draft is renamed when it is complete, so a file of the final name is never half made.
DRAFT_FILE = JOURNAL_FILE + ".new"
# The journal that a repair has made, complete, until it is put in the place of the damaged one.
REPAIRED_FILE = JOURNAL_FILE + ".repaired"
# What a repair calls the damaged one (and, after it, .damaged-2, .damaged-3 …).
DAMAGED_FILE = JOURNAL_FILE + ".damaged"
# What SQLite keeps beside a file: the write-ahead log holds rows, the shared memory nothing of worth.
LOG, SHARED = "-wal", "-shm"
SIDES = (LOG, SHARED)
# What another program may have left there: played back, it changes rows, and removes a file that it names anywhere.
ROLLBACK = "-journal"


# Seconds for another program, such as a backup, to leave a transaction before it is reported.
PATIENCE = 5.0

# Bytes to which SQLite cuts an emptied log: a large batch would leave one as large as itself.
LARGEST_IDLE_LOG = 16 * 2**20

# Part of the format, so that a damaged first page can be made anew: with TABLES it is always the same.
PAGE_BYTES = 4096
STRICT = " STRICT"
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
    size INTEGER NOT NULL,
    digest BLOB NOT NULL,
    checksum BLOB NOT NULL
)""",
    # Beside the rows and not in them: compaction takes payloads away, and reading rows without their
    # payloads has to pass over small pages only.
    """CREATE TABLE payload (
    sequence INTEGER PRIMARY KEY,
    bytes BLOB NOT NULL
)""",
    """CREATE TABLE generation (
    number INTEGER PRIMARY KEY,
    upto INTEGER NOT NULL,
    base INTEGER NOT NULL,
    time REAL NOT NULL,
    attributes TEXT NOT NULL,
    content TEXT NOT NULL,
    checksum BLOB NOT NULL
)""",
)

# In the order of TABLES each gets the next page of a new file, and again after a VACUUM. A number that
# changed would make one table pass for another, or for a shorter one.
ROOTS = (
    (b"table", b"meta", b"meta", 2),
    (b"index", b"sqlite_autoindex_meta_1", b"meta", 3),
    (b"table", b"record", b"record", 4),
    (b"table", b"payload", b"payload", 5),
    (b"table", b"generation", b"generation", 6),
)
ANALYZED = (
    (b"table", b"sqlite_stat1", b"sqlite_stat1", b"CREATE TABLE sqlite_stat1(tbl,idx,stat)"),
    (b"table", b"sqlite_stat4", b"sqlite_stat4", b"CREATE TABLE sqlite_stat4(tbl,idx,neq,nlt,ndlt,sample)"),
)

# What a value, a statement (a schema's, too) and the rest may be at most; a payload holds 256 MiB and its descriptions.
LIMITS = {
    sqlite3.SQLITE_LIMIT_LENGTH: 2**28 + 2**25,
    sqlite3.SQLITE_LIMIT_SQL_LENGTH: 10_000,
    sqlite3.SQLITE_LIMIT_EXPR_DEPTH: 100,
    sqlite3.SQLITE_LIMIT_TRIGGER_DEPTH: 0,
    sqlite3.SQLITE_LIMIT_ATTACHED: 1,  # VACUUM wants one
}
SETTINGS = ("trusted_schema = OFF", "cell_size_check = ON")


def connect(path: Path, options: str, *, require_schema: bool = True, named: Path | None = None) -> sqlite3.Connection:
    """Return a connection that begins no transaction by itself, gives text as bytes and serves any thread.

    options: of SQLite's URI, such as "mode=ro". It trusts nothing that the file says of itself: no function runs that
    a schema names. Raises DamageError, which names `named` in place of a copy of it, for another schema than ours
    unless told not to look, and sqlite3.Error.
    """
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
        for limit, most in LIMITS.items():
            connection.setlimit(limit, most)
        for setting in SETTINGS:
            connection.execute(f"PRAGMA {setting}")
        # Before anything else is read or written: what is written could set off a trigger.
        if require_schema and not has_our_schema(connection):
            raise DamageError(
                f"the tables of {named or path} are not those that a store has, where and what they were made as: "
                "if it comes from elsewhere, do not use it; if it is your own, repair it (repair_store)",
                path=named or path,
            )
    except BaseException:
        connection.close()
        raise
    return connection


def connect_to_write(path: Path) -> sqlite3.Connection:
    """Return such a connection whose commits are on the disk when they return; the caller holds the writer's lock."""
    connection = connect(path, "mode=rw")
    try:
        connection.execute("PRAGMA synchronous = FULL")
        # On a Mac a plain fsync stops at the drive's cache.
        connection.execute("PRAGMA fullfsync = 1")
        connection.execute("PRAGMA checkpoint_fullfsync = 1")
        connection.execute(f"PRAGMA journal_size_limit = {LARGEST_IDLE_LOG}")
        (mode,) = connection.execute("PRAGMA journal_mode = WAL").fetchone()
        if mode != b"wal":
            raise StoreError(f"{path}: its file system cannot hold a write-ahead log (mode {mode!r})")
        # Where opening to write fails, SQLite opens to read and says nothing until something is written.
        connection.execute("BEGIN IMMEDIATE")
        connection.execute("DELETE FROM meta WHERE 0")
        connection.execute("ROLLBACK")
    except BaseException:
        connection.close()
        raise
    return connection


def create_journal(folder: Path, identity: str) -> None:
    """Make an empty journal in `folder`, durable and complete or not there at all.

    `identity` is JSON. The caller holds the writer's lock.
    """
    (folder / GENERATIONS).mkdir(exist_ok=True)
    build_journal(folder / DRAFT_FILE, new_meta(identity))
    (folder / DRAFT_FILE).rename(folder / JOURNAL_FILE)
    sync_folder(folder)
    sync_folder(folder.parent)


def new_meta(identity: str) -> dict[str, str]:
    """Return what table meta of a new journal holds; `identity` is JSON."""
    created = datetime.now(UTC).isoformat(timespec="seconds")
    return {"format": str(FORMAT_VERSION), "created": created, "identity": identity}


def build_journal(
    draft: Path, meta: Mapping[str, str], fill: Callable[[sqlite3.Connection], None] | None = None
) -> None:
    """Make the durable file `draft` a journal in which table meta holds `meta`, in place of any that is there.

    fill: called with the connection, to add rows in the transaction that makes the tables.
    """
    for suffix in ("", ROLLBACK, *SIDES):
        remove_tree(draft.with_name(draft.name + suffix))
    with closing(sqlite3.connect(draft, isolation_level=None)) as connection:
        connection.execute("PRAGMA synchronous = FULL")
        for setting in (f"page_size = {PAGE_BYTES}", "auto_vacuum = NONE", "encoding = 'UTF-8'"):
            connection.execute(f"PRAGMA {setting}")
        connection.execute("BEGIN")
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {FORMAT_VERSION}")
        # STRICT refuses a value of a wrong type; SQLite knows it since 3.37.
        strict = STRICT if sqlite3.sqlite_version_info >= (3, 37) else ""
        for table in TABLES:
            connection.execute(table + strict)
        rows = [(key, value, checksum("meta", key.encode(), value.encode())) for key, value in meta.items()]
        connection.executemany("INSERT INTO meta VALUES (?, ?, ?)", rows)
        if fill is not None:
            fill(connection)
        connection.execute("COMMIT")
        connection.execute("PRAGMA journal_mode = WAL")
    sync_file(draft)


def remove_drafts(folder: Path) -> None:
    """Remove what a repair left that did not end; the caller holds the writer's lock, and a journal is in place."""
    for name in (REPAIRED_FILE, *(DRAFT_FILE + suffix for suffix in ("", ROLLBACK, *SIDES))):
        remove_tree(folder / name)


def has_our_schema(connection: sqlite3.Connection) -> bool:
    """Return whether the file has the tables of TABLES, to the letter and in their places, and nothing else.

    A view, an index or a trigger would be run, or asked, when a row is written or read. Only the table that ANALYZE
    makes, of any program, does no harm. The connection gives text as bytes. Raises sqlite3.Error where the schema
    cannot even be read.
    """
    query = "SELECT type, name, tbl_name, rootpage, sql FROM sqlite_master LIMIT 16"
    rows = [tuple(row) for row in connection.execute(query)]
    found = sorted((row for row in rows if (*row[:3], row[4]) not in ANALYZED), key=repr)
    meta, *rest = (table.encode() for table in TABLES)
    for strict in (b"", STRICT.encode()):
        texts = [meta + strict, None, *(table + strict for table in rest)]
        if found == sorted([(*root, text) for root, text in zip(ROOTS, texts, strict=True)], key=repr):
            return True
    return False
