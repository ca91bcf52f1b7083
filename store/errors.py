"""What the store raises, grouped by what the one who catches it does next.

Exception
└── StoreError             anything that the store reports
    ├── LockedError        another writer holds the store: close that one, or open with mode="read"
    ├── NotAStoreError     the path holds no store: give another path, or an identity to create one
    ├── VersionError       a newer release wrote it: upgrade; nothing was touched
    ├── DamageError        bytes on the disk are not those that were written: repair_store keeps what verifies
    ├── CompactedError     a row's arrays were given up when the store was compacted: go on from its base
    ├── StoreFullError     no space is left: free some and call again; nothing acknowledged is lost
    ├── ReadOnlyError      the store, or its folder, may not be written from here
    ├── StoreClosedError   the store was closed, or belongs to the process that forked this one
    └── RecordError        this cannot be stored as it is (also a ValueError)
"""

from __future__ import annotations

from pathlib import Path

__all__ = [
    "CompactedError",
    "DamageError",
    "LockedError",
    "NotAStoreError",
    "ReadOnlyError",
    "RecordError",
    "StoreClosedError",
    "StoreError",
    "StoreFullError",
    "VersionError",
]


class StoreError(Exception):
    """Anything that the store reports."""


class LockedError(StoreError):
    """Another writer holds the store; its process id, host and since when are in the message."""


class NotAStoreError(StoreError):
    """The path holds no store, or holds something else, which is left as it is."""


class VersionError(StoreError):
    """The store was written in a format newer than this release reads; nothing was touched."""


class DamageError(StoreError):
    """Bytes on the disk are not those that were written.

    `path` is the damaged file or array folder. `sequence` is the row of the journal that is damaged,
    when it is one: `records(after=sequence)` goes on behind it. `check_store` names all that is damaged,
    and `repair_store` keeps what verifies.
    """

    def __init__(self, message: str, *, path: Path, sequence: int | None = None) -> None:
        super().__init__(message)
        self.path = path
        self.sequence = sequence


class CompactedError(StoreError):
    """The arrays of this row were given up, on purpose, when the store was compacted; the row itself is there."""


class StoreFullError(StoreError):
    """The disk, or a quota on it, is full. The call had no effect and may be repeated."""


class ReadOnlyError(StoreError):
    """The store was opened for reading, or its folder may not be written."""


class StoreClosedError(StoreError):
    """The store was closed, or was opened in the process that forked this one."""


class RecordError(StoreError, ValueError):
    """A label, key, time, attribute or array that the store cannot keep as it is."""
