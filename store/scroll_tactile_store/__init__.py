"""Arrays and records that survive a power cut.

A `Store` is a folder with a journal, whose rows are durable when `append` returns, and with
checkpoints: snapshots of arrays, each replaced as a whole. It knows nothing of what the arrays mean.
FORMAT.md beside this file describes every byte of it.

    with Store.open(path, identity={"made for": "this"}) as store:
        head = store.append("add", "a label", key, arrays={"codes": codes})
        store.commit({"sums": sums}, last_sequence=head.sequence)

`Store.backup` copies a store while it is in use; `check_store` verifies a whole one; `repair_store` keeps what
verifies of a damaged one.
"""

from scroll_tactile_store.exceptions import (
    CompactedError,
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
from scroll_tactile_store.records import JSON, Checkpoint, Head, Record
from scroll_tactile_store.repair import Repair, repair_store
from scroll_tactile_store.store import Store, StoreState
from scroll_tactile_store.survey import Problem, check_store

__all__ = [
    "JSON",
    "Checkpoint",
    "CompactedError",
    "DamageError",
    "Head",
    "LockedError",
    "NotAStoreError",
    "Problem",
    "ReadOnlyError",
    "Record",
    "RecordError",
    "Repair",
    "Store",
    "StoreClosedError",
    "StoreError",
    "StoreFullError",
    "StoreState",
    "VersionError",
    "check_store",
    "repair_store",
]
