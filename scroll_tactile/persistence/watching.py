"""Health as it is read from a journal: in pieces, so that who changes the memory does not wait; and kept beside it."""

from __future__ import annotations

import logging
from typing import cast

from scroll_tactile.health.channel_numbers import from_text
from scroll_tactile.health.watch import Watch
from scroll_tactile.health.watched_rows import WatchedRow, WatchedRows, WatchRules
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import CHANNELS, OBSERVE, RETRACT, SENSE, SOURCE, retracted_by
from scroll_tactile.persistence.observations import is_from
from scroll_tactile.persistence.open_memory import Derived, OpenMemory
from scroll_tactile.results import Health
from scroll_tactile.validation.gate import WRONG
from scroll_tactile.validation.stored_watch import NAME, watch_to_arrays, watched_from
from store import Head, Store, StoreError

__all__ = ["health_of", "health_to_store"]

logger = logging.getLogger(__name__)

PIECE = 64  # rows that are read while the memory is locked


def health_of(ledger: OpenMemory, channels: int, rules: WatchRules) -> Health:
    """The health that the rows chosen by rules tell, in the journal's order; retracted ones are not there.

    It goes on from the rows that were read last by the same rules, here or before the memory was closed. Two threads
    that ask at once read them both.
    """
    with ledger.lock:
        ledger.require_store("tell how its sensor is")
        watched, ledger.watched = ledger.watched, None
        if watched is None or watched.rules != rules or watched.lost != ledger.lost:
            watched = _stored(ledger, channels, rules) or WatchedRows(
                rules, Watch(channels, rules.bound), last=rules.after, known=0, lost=ledger.lost
            )
    try:
        while piece := _piece(ledger, watched):
            for row in piece:
                watched.take(row)
    except StoreError:  # of a damaged row: those before it need not be read again
        ledger.watched = watched
        raise
    ledger.watched = watched
    with ledger.lock:
        store = ledger.require_store("tell how its sensor is")
        return watched.health(lambda row: next((head.time for head in store.heads(row - 1)), None))


def _piece(ledger: OpenMemory, watched: WatchedRows) -> list[WatchedRow]:
    """The next rows to be taken, none at the end, and after an alarm; those retracted meanwhile are taken back."""
    with ledger.lock:
        store, memory = ledger.require_store("tell how its sensor is"), ledger.memory
        _take_back(store, memory, watched)
        if watched.watch.alarmed is not None:
            return []
        until, rows = watched.rules.until, list[WatchedRow]()
        last = memory.sequence if until is None else min(until, memory.sequence)
        for head in store.heads(watched.last):
            if head.sequence > last or len(rows) == PIECE:
                break
            rows.append(_row(head, memory, watched))
        return rows


def _take_back(store: Store, memory: Memory, watched: WatchedRows) -> None:
    """Have what was retracted since it was last read go."""
    if memory.sequence > watched.known:
        new = [head for head in store.heads(watched.known, kind=RETRACT) if head.sequence <= memory.sequence]
        for gone in sorted(retracted_by(new), reverse=True):
            watched.take_back(gone)
        watched.known = memory.sequence


def _row(head: Head, memory: Memory, watched: WatchedRows) -> WatchedRow:
    own, source = watched.rules.source, cast("str | None", head.attributes.get(SOURCE))
    counts = head.kind in (OBSERVE, SENSE) and not memory.is_gone(head.sequence)
    if not counts or (own is not None and not is_from(source, own)):
        return WatchedRow(head.sequence)
    numbers = from_text(head.attributes.get(CHANNELS), watched.watch.channels)
    return WatchedRow(head.sequence, head.label, cast(int, head.attributes["columns"]), numbers)


def _stored(ledger: OpenMemory, channels: int, rules: WatchRules) -> WatchedRows | None:
    """What was kept beside the checkpoint that the memory was loaded from, by the same rules."""
    try:
        kept = ledger.derived(NAME)
        return None if kept is None else watched_from(kept, channels, rules, ledger.lost)
    except (StoreError, *WRONG) as error:
        logger.info("the health that was kept is not used: %s", error)
        return None


def health_to_store(ledger: OpenMemory) -> Derived | None:
    """What was last read, to be kept beside the newest checkpoint; None where nothing was."""
    store, watched = ledger.store, ledger.watched
    if store is None or watched is None or watched.lost != ledger.lost:
        return None
    _take_back(store, ledger.memory, watched)
    return *watch_to_arrays(watched), ()
