"""What the store raises, a class for each thing that a caller does next; and how the system's errors become these."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
FORBIDDEN = frozenset({errno.EACCES, errno.EPERM, errno.EROFS})


class StoreError(Exception):
    """Anything that the store reports."""


class LockedError(StoreError):
    """Another writer holds the store, the message says which: close that one, or open with mode="read"."""


class NotAStoreError(StoreError):
    """The path holds no store: give another path, or an identity to make one. What is there is left as it is."""


class VersionError(StoreError):
    """The store was written in a format that this release does not read; nothing was touched."""


class DamageError(StoreError):
    """Bytes on the disk are not those that were written.

    `path` is the damaged file or array folder. `sequence` is the damaged row of the journal, if it is one:
    `records(after=sequence)` continues behind it. `offset` and `frame` are the byte and the number of the first
    damaged frame of a log, if it is one. `check_store` names all that is damaged, and `repair_store` keeps what
    verifies.
    """

    def __init__(
        self,
        message: str,
        *,
        path: Path = Path(),
        sequence: int | None = None,
        offset: int | None = None,
        frame: int | None = None,
    ) -> None:
        super().__init__(message)
        self.path = path
        self.sequence = sequence
        self.offset = offset
        self.frame = frame


class CompactedError(StoreError):
    """Compaction gave up the arrays of this row, on purpose: resume from the compaction checkpoint."""


class StoreFullError(StoreError):
    """The disk, or a quota on it, is full: free some and call again. The call had no effect."""


class ReadOnlyError(StoreError):
    """The store was opened for reading, or its folder may not be written."""


class StoreClosedError(StoreError):
    """The store was closed, or was opened in the process that forked this one."""


class RecordError(StoreError, ValueError):
    """A label, key, time, attribute or array that the store cannot keep as it is."""


@contextmanager
def reported(path: Path, doing: str) -> Iterator[None]:
    """Run the block; raise an OSError in it as the StoreError that it amounts to.

    `path` is the file or folder concerned and `doing` completes "while …" in the message.
    """
    try:
        yield
    except OSError as error:
        where = Path(error.filename) if isinstance(error.filename, str) else path
        if error.errno in FULL:
            full = f"no space left for {where} while {doing}: free some space and call again"
            raise StoreFullError(full) from error
        if error.errno in FORBIDDEN:
            raise ReadOnlyError(f"{where} is not open to this user while {doing} ({error.strerror})") from error
        raise StoreError(f"{where}: {error.strerror or error} while {doing}") from error
