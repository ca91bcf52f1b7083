"""Changes of several rows: what another process appended is taken in, and an observation gets another name."""

from __future__ import annotations

from typing import cast

from scroll_tactile.errors import InputError
from scroll_tactile.memory.rows import OBSERVE, RETRACT, Added, spans, unspanned
from scroll_tactile.memory.state import Memory
from store import Record, Store

__all__ = ["apply_appended", "relabel"]


def apply_appended(memory: Memory, store: Store, records: list[Record]) -> list[Added] | None:
    """Apply the rows that a writer appended, and take a tuned model that it made; what changed, see `Memory.replay`."""
    changed = [memory.replay(record, store) for record in records]
    memory.refill(store)
    newest = store.latest() if store.newest != memory.checkpoint else None
    if newest is not None and newest.upto <= memory.sequence:
        memory.checkpoint = newest.number
        retractions = (head for head in store.heads(newest.upto, kind=RETRACT) if head.sequence <= memory.sequence)
        gone = min((row for head in retractions for row in unspanned(head.attributes["sequences"])), default=None)
        if gone is None or gone > cast(int, newest.attributes["tuned_upto"]):
            memory.take_tuned(newest)
    return None if None in changed else [each for added in changed for each in added or ()]


def relabel(memory: Memory, store: Store, record: Record, material: str) -> list[Added]:
    """Retract the observation in this row and append it under another material's name, with the same arrays.

    The caller opens a batch around it. What changed, see `Memory.replay`.
    Raises InputError where it has that name already.
    """
    if record.label == material:
        raise InputError(f"observation {record.sequence} of {store.path} is called {material!r} already")
    store.base()  # a damaged one has what the retraction needs
    removed = memory.retract(record)
    memory.refill(store)
    memory.sequence = store.append(RETRACT, "", b"", attributes={"sequences": spans([record.sequence])}).sequence
    attributes, arrays, time = record.attributes, dict(record.arrays), record.time
    head = store.append(OBSERVE, material, record.key, attributes=attributes, arrays=arrays, time=time)
    return [removed, *(memory.replay(Record(**vars(head), arrays=record.arrays), store) or ())]
