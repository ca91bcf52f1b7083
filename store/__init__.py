"""Arrays and records that survive a power cut.

A `Store` is a folder with a journal, whose rows are durable when `append` returns, and with
generations: snapshots of arrays that are replaced as a whole. It knows nothing of what the arrays
mean. FORMAT.md beside this file describes every byte of it.

    with Store.open(path, identity={"made for": "this"}) as store:
        record = store.append("add", "a label", key, arrays={"codes": codes})
        store.commit({"sums": sums}, upto=record.sequence)
"""

from store.errors import (
    DamageError,
    LockedError,
    NotAStoreError,
    ReadOnlyError,
    RecordError,
    StoreClosedError,
    StoreError,
    StoreFullError,
    VersionError,
)
from store.records import JSON, Generation, Record
from store.store import Store

__all__ = [
    "JSON",
    "DamageError",
    "Generation",
    "LockedError",
    "NotAStoreError",
    "ReadOnlyError",
    "Record",
    "RecordError",
    "Store",
    "StoreClosedError",
    "StoreError",
    "StoreFullError",
    "VersionError",
]
