"""How the journal's file is opened, to be written or to be read."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

from store.errors import StoreError
from store.schema import LOG

__all__ = ["connect", "roll_back"]

# Seconds for another program, such as a backup, to leave a transaction before it is reported.
PATIENCE = 5.0

# Bytes to which the log is cut again when it was emptied: a large batch would leave one as large as itself.
LARGEST_IDLE_LOG = 16 * 2**20


def connect(path: Path, *, write: bool) -> sqlite3.Connection:
    """Return a connection that begins no transaction by itself, gives text as bytes and serves any thread."""
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


def _is_still(path: Path) -> bool:
    # Without a log, in a folder where SQLite could not make one, it refuses to read unless told
    # that nothing changes: an archive on a read-only disk.
    return not os.access(path.parent, os.W_OK) and not path.with_name(path.name + LOG).exists()


def roll_back(connection: sqlite3.Connection) -> None:
    """End the transaction, if one is open, as if it had not been."""
    if connection.in_transaction:
        connection.execute("ROLLBACK")
