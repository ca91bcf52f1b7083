"""Changes of several rows: what another process appended is taken in, and an observation gets another name."""

from __future__ import annotations

from itertools import takewhile
from typing import cast

from scroll_tactile.errors import InputError
from scroll_tactile.memory.rows import OBSERVE, RETRACT, Added, retracted_by, spans
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
        # Of all kinds: a damaged row that is passed over may be a retraction.
        behind = takewhile(lambda head: head.sequence <= memory.sequence, store.heads(newest.upto))
        gone = min(retracted_by(behind), default=None)
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
