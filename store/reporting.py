"""Failures of the operating system and of SQLite, told as the store's own errors."""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from store.errors import (
    DamageError,
    LockedError,
    ReadOnlyError,
    RecordError,
    StoreError,
    StoreFullError,
)

__all__ = ["SQLITE_ERRORS", "from_sqlite", "is_damage", "reported"]

FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
FORBIDDEN = frozenset({errno.EACCES, errno.EPERM, errno.EROFS})

# SQLite says IOERR, not FULL, when it cannot grow the shared memory beside the journal.
IOERR_SHMSIZE = 10 | (19 << 8)
IOERR_SHORT_READ = 10 | (2 << 8)

# The second where a message quotes damaged text: Python cannot tell it.
SQLITE_ERRORS = (sqlite3.Error, UnicodeDecodeError)


@contextmanager
def reported(path: Path, doing: str) -> Iterator[None]:
    """Run the block, telling an OSError or an error of SQLite in it as the StoreError that it amounts to.

    `path` is the file or folder concerned and `doing` completes "while …" in the message.
    """
    try:
        yield
    except SQLITE_ERRORS as error:
        raise from_sqlite(error, path, doing) from error
    except OSError as error:
        raise from_system(error, path, doing) from error


def from_system(error: OSError, path: Path, doing: str) -> StoreError:
    """Return the StoreError for a failed system call."""
    where = Path(error.filename) if isinstance(error.filename, str) else path
    if error.errno in FULL:
        return StoreFullError(f"no space left for {where} while {doing}: free some space and call again")
    if error.errno in FORBIDDEN:
        return ReadOnlyError(f"{where} is not open to this user while {doing} ({error.strerror})")
    return StoreError(f"{where}: {error.strerror or error} while {doing}")


def is_damage(error: sqlite3.Error | UnicodeDecodeError) -> bool:
    """Return whether the error says that the file is not as SQLite, or the store, wrote it."""
    if isinstance(error, UnicodeDecodeError):
        return True
    extended: int = getattr(error, "sqlite_errorcode", -1)
    code = extended & 0xFF
    if code == sqlite3.SQLITE_ERROR:
        # Of statements that are right: tables or columns are not there, or their description is not to be read.
        return str(error).startswith(("no such", "malformed", "unsupported file format"))
    return code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB) or extended == IOERR_SHORT_READ


def from_sqlite(error: sqlite3.Error | UnicodeDecodeError, path: Path, doing: str) -> StoreError:
    """Return the StoreError for a failed call of SQLite, by its result code."""
    # Errors that Python itself raises, such as text that is not UTF-8, carry no code.
    extended: int = getattr(error, "sqlite_errorcode", -1)
    code = extended & 0xFF
    if code == sqlite3.SQLITE_FULL or extended == IOERR_SHMSIZE:
        return StoreFullError(f"no space left for {path} while {doing}: free some space and call again")
    if is_damage(error):
        return DamageError(
            f"{path} is damaged ({error}) while {doing}: copy the folder before anything else, then repair the "
            "store (repair_store)",
            path=path,
        )
    if code in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PERM):
        return ReadOnlyError(f"{path} may not be written while {doing} ({error})")
    if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        return LockedError(f"another program is inside {path} while {doing} ({error}): close it there")
    if code == sqlite3.SQLITE_TOOBIG:
        return RecordError(f"the record is larger than SQLite takes while {doing}: keep it in a generation")
    return StoreError(f"{path}: {error} while {doing}")
