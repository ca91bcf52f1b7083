"""Re-embedding a memory: with another embedding, or another version of its own, from the readings in its journal.

The new memory is written beside the old one, row for row, and takes its place when it is whole:

1. `name.reembedding` grows in batches. A run that was cut short resumes after the last one.
2. It is renamed to `name.reembedded`: now it is complete.
3. The old memory is renamed to `name.before`, and the new one to `name`.

Where nothing has the memory's name, step 3 was cut short: the next opening completes it.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any, cast

from scroll_tactile_store import Record, Store, StoreError
from scroll_tactile_store.exceptions import reported
from scroll_tactile_store.files import sync_folder
from scroll_tactile_store.lock import WriterLock

from scroll_tactile.errors import MismatchError
from scroll_tactile.memory.gate import MemoryStore, beside, finish_interrupted
from scroll_tactile.memory.identity import Identity
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import Codes, Kind, Readings, pack_codes, pack_readings, unpack_readings
from scroll_tactile.persistence.ledger import Ledger
from scroll_tactile.persistence.replaying import refill
from scroll_tactile.recipe import Recipe

__all__ = ["Reembedding"]

ROWS_TOGETHER = 64  # rows that wait for the disk together
LEARNED = Kind.OBSERVE, Kind.MEMBER, Kind.MERGE  # the first alone may have readings


class Reembedding:
    """The memory that takes the place of another one.

    source: the store of the old one. recipe: of the new one. encode: readings → the steps of the touch, and its rows of
    codes by scale.

    Raises MismatchError where an observation has no readings, DamageError where a checkpoint counts touches that no row
    has, StoreError.
    """

    def __init__(self, source: Store, recipe: Recipe, encode: Callable[[Readings], tuple[int, Codes]]) -> None:
        identity = Identity.of(recipe)
        bare = [head.sequence for head in source.heads() if head.kind in LEARNED and not head.attributes.get("nbytes")]
        if source.compacted or bare:
            what = f"rows 1 to {source.compacted} were compacted"
            raise MismatchError(
                f"{source.path} cannot be embedded again, which takes the readings of every observation: "
                + (what if source.compacted else f"{len(bare)} rows, such as row {bare[0]}, have none")
                + ". Open it with the embedding that made it, or touch again what it knows"
            )
        self.recipe = recipe
        self._source, self._encode, self._bare = source, encode, identity.embedding.bare
        folder = beside(source.path, "reembedding")
        whole = beside(source.path, "reembedded")
        if os.path.exists(whole):  # it was complete; the old memory may have more rows now
            with reported(folder, "going on with a memory embedded anew"):
                whole.rename(folder)
        self._draft = MemoryStore.open(folder, identity=identity.to_json())
        if Identity.read(self._draft) != identity:  # begun for another embedding
            self._draft.close()
            shutil.rmtree(folder)
            self._draft = MemoryStore.open(folder, identity=identity.to_json())
        self._made = Ledger(Memory(recipe, lambda readings: encode(readings)[1]), self._draft, self._bare)

    def copy(self, progress: Callable[[str, int, int], object]) -> None:
        """Embed the rows that the new memory does not have yet; the old one stays usable meanwhile.

        progress: called with (what is being done, rows done, rows in all).
        """
        made, draft = self._made, self._draft
        while draft.last < self._source.last:
            with made.batch():
                for record in islice(self._source.records(after=draft.last), ROWS_TOGETHER):
                    made.append(record.kind, record.label, record.key, time=record.time, **self._embedded(record))
                refill(made.memory, draft)
            progress("embedding", draft.last, self._source.last)
        made.save()  # here, and not when both are exchanged: a full disk stops it before that

    def _embedded(self, record: Record) -> dict[str, Any]:
        attributes, arrays = dict(record.attributes), dict(record.arrays)
        if record.kind != Kind.OBSERVE:
            return {"attributes": attributes, "arrays": arrays}
        readings = cast(Readings, unpack_readings(arrays))
        steps, codes = self._encode(readings)
        arrays = pack_readings(readings) | ({} if self._bare else pack_codes(codes))
        return {"attributes": attributes | {"columns": steps}, "arrays": arrays, "applied": {"codes": codes}}

    def put_in_place(self) -> Path:
        """Close both memories and exchange them; returns the folder of the old one.

        The caller has copied all rows. Raises StoreError where another process has written to the old one since.
        """
        folder = self._source.path.resolve()  # a link to the memory stays one
        last_sequence = self._draft.last
        for store in (self._draft, self._source):
            store.close()
        whole, before, count = beside(folder, "reembedded"), beside(folder, "before"), 1
        while before.exists():
            before, count = beside(folder, f"before-{count + 1}"), count + 1
        lock = WriterLock(folder)
        try:
            with Store.open(folder, mode="read") as old:
                if old.last != last_sequence:
                    raise StoreError(f"{folder} was written while it was exchanged: embed it again, to go on")
            with reported(folder, "putting a memory embedded anew in place"):
                self._draft.path.rename(whole)
                sync_folder(folder.parent)
                folder.rename(before)
                sync_folder(folder.parent)
        finally:
            lock.release()
        finish_interrupted(folder)
        return before

    def close(self) -> None:
        """Release the files; the copied rows stay, for a run that resumes."""
        self._draft.close()
