"""What the rows of a journal say of the sensor: its health, and a correction by touches with a changed skin.

Health is read in pieces, so that whoever changes the memory does not wait. A correction rests on what the rows say of
the touches before the change; it is a row itself.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import islice, takewhile
from typing import Any, cast

import numpy as np
from scroll_tactile_store import Head

from scroll_tactile.errors import InputError, UnknownMaterialError
from scroll_tactile.health.channel_numbers import MOST_CHANNELS, from_text, has_numbers
from scroll_tactile.health.skin_fit import Fitted, Reference, fitted, guess_of_lost
from scroll_tactile.health.watch import WatchedRow, WatchedRows, WatchRules
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import Kind, retracted_by
from scroll_tactile.persistence.ledger import Ledger
from scroll_tactile.persistence.observations import is_from
from scroll_tactile.persistence.ram_store import AnyStore
from scroll_tactile.results import Adaptation, Health
from scroll_tactile.sensors import Sensor
from scroll_tactile.settings import require_name
from scroll_tactile.signals.correction import Correction, corrected_stream
from scroll_tactile.signals.levels import LEVELS, MISSING
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["adapt_to", "health_of", "known_touches"]

PIECE = 64  # rows that are read while the memory is locked
MOST_WATCHED = 4  # rules: of the page, of diagnostics, of a live session
FEWEST, FEWEST_MATERIALS = 3, 2  # touches, and materials among them: one may have changed itself
LIKELIER = math.log(100)  # that the touches have to be, each by the correction of the others, than without any
FEWEST_SPREAD = 8  # touches of materials that were touched before, by which it is known how touches differ


def health_of(ledger: Ledger, channels: int, rules: WatchRules) -> Health:
    """The health that the rows chosen by rules tell, in the journal's order; retracted ones are not there.

    It goes on from the rows that were read last by the same rules. Two threads that ask at once read them both.
    """
    with ledger.lock:
        _ = ledger.memory  # which may have lost rows, and says so as it is read
        kept = ledger.watched
        watched = kept.pop(rules, None) or WatchedRows(rules, channels)
    while piece := _piece(ledger, watched):
        for row in piece:
            watched.take(row)
    with ledger.lock:
        store = ledger.require_open()
        found = watched.health(lambda row: next((head.time for head in store.heads(row - 1)), None))
        kept[rules] = watched  # from here on another thread may take it further
        while len(kept) > MOST_WATCHED:
            del kept[next(iter(kept))]
        return found


def _piece(ledger: Ledger, watched: WatchedRows) -> list[WatchedRow]:
    """The next rows to be taken, none at the end, and after an alarm; those retracted meanwhile are taken back."""
    with ledger.lock:
        store, memory, rules = ledger.require_open(), ledger.memory, watched.rules
        if memory.sequence > watched.known:
            new = _heads(store, memory, None, watched.known)
            for gone in sorted(retracted_by(new), reverse=True):
                watched.take_back(gone)
            watched.known = memory.sequence
        if watched.watch.alarmed is not None:
            return []

        def row(head: Head) -> WatchedRow:
            source = cast("str | None", head.attributes.get("source"))
            counts = head.kind in (Kind.OBSERVE, Kind.SENSE) and head.sequence not in memory.retracted
            if not counts or not (rules.source is None or is_from(source, rules.source)):
                return WatchedRow(head.sequence)
            numbers = from_text(head.attributes.get("channels"), watched.watch.channels)
            return WatchedRow(head.sequence, head.label, cast(int, head.attributes["columns"]), numbers)

        return [row(head) for head in islice(_heads(store, memory, rules.until, watched.last), PIECE)]


def _heads(store: AnyStore, memory: Memory, until: int | None, after: int = 0) -> Iterator[Head]:
    last = memory.sequence if until is None else min(until, memory.sequence)
    return takewhile(lambda head: head.sequence <= last, store.heads(after))


def known_touches(touches: Mapping[str, Any] | Iterable[tuple[str, Any]], sensor: Sensor) -> dict[Stream, str]:
    """Touches as the sensor gave them, each once, with their materials.

    Raises InputError for what is no pairs of a material and readings, or of too few touches or materials; StreamError,
    SensorMismatchError, MaterialError.
    """
    if not has_numbers(sensor):
        raise InputError(
            f"a memory is adapted channel by channel, and sensor {sensor.name!r} has "
            + ("pixels" if sensor.camera else f"{sensor.channels}; at most {MOST_CHANNELS} can be told apart")
        )
    found: dict[Stream, str] = {}
    given = touches.items() if isinstance(touches, Mapping) else touches
    try:
        pairs = [(material, readings) for material, readings in given]
    except (TypeError, ValueError):
        raise InputError(
            "expected touches as pairs of a material and its readings, or a mapping from materials to readings; came "
            f"{type(touches).__name__} {touches!r:.60}"
        ) from None
    for material, readings in pairs:
        stream = validate(readings, sensor)
        stream = stream if stream.raw is None else stream.raw
        if len(stream) < 3:
            raise InputError(f"expected touches of three readings or more; came {len(stream)} of {material!r}")
        if found.setdefault(stream, require_name(material)) != material:
            raise InputError(f"one touch came as {found[stream]!r} and as {material!r}")
    if len(found) < FEWEST or len(set(found.values())) < FEWEST_MATERIALS:
        raise InputError(
            f"expected {FEWEST} different touches or more, five are better, of {FEWEST_MATERIALS} materials or more, "
            f"so that a changed skin is told from a changed material; came {dict(Counter(found.values()))}"
        )
    return found


def adapt_to(
    ledger: Ledger,
    touches: Mapping[Stream, str],
    sensor: Sensor,
    until: int | None,
    unknown_of: Callable[[Iterable[Stream]], int],
) -> Adaptation:
    """As `TactileLearner.adapt`, for touches that `known_touches` gave. unknown_of: how many are called unknown."""
    with ledger.lock:
        store, memory = ledger.require_open(to_write=True), ledger.memory
        if unknown := sorted(set(touches.values()) - set(memory.statistics.materials)):
            raise UnknownMaterialError(f"expected touches of materials that were observed; never were {unknown[:5]}")
        own = {of.key for touch in touches for of in (touch, corrected_stream(touch, memory.correction))}
        out = own if until is None else own | {head.key for head in store.heads(until)}
        kept = [] if memory.kept is None else [each.levels for each in memory.kept.touches() if each.key not in out]
        reference = Reference(sensor.channels)
        for head in _heads(store, memory, until):
            counts = head.kind == Kind.OBSERVE and head.sequence not in memory.retracted and head.key not in own
            numbers = from_text(head.attributes.get("channels") if counts else None, sensor.channels)
            if numbers is not None:
                reference.take(head.label, numbers)
        missing = [name for name in sorted(set(touches.values())) if not reference.counts.get(name)]
        if missing or reference.total - len(reference.counts) < FEWEST_SPREAD:
            raise InputError(
                f"the journal of {store.path} has too few numbers of the channels of earlier touches, of "
                f"{reference.total} of {len(reference.counts)} materials, and none of {missing[:5]}: those by which it "
                "is to be adapted do not count, nor do those behind `until`, or that came in with a compacted memory. "
                "Observe more before the skin is changed, or take touches of other materials"
            )
    at_ends = [((levels == 0) | (levels == LEVELS - 1)).mean(axis=1) for levels in kept]  # of levels (n, T)
    ends = np.asarray(np.mean(at_ends, axis=0) if kept else np.ones(sensor.channels))
    low, high = (np.asarray(limit, np.float64) for limit in sensor.limits)
    shares = [(touch.readings - low) / (high - low) for touch in touches]
    found = fitted(reference, shares, list(touches.values()), ends)
    span = np.broadcast_to(high - low, (sensor.channels,))
    earlier = ((of[:, (of != MISSING).all(axis=0)] / (LEVELS - 1)).T for of in kept)  # one by one: levels are bytes
    correction = Correction(
        found.gains.astype(np.float32),
        (found.offsets * span).astype(np.float32),
        found.lost.astype(np.bool_),
        guess_of_lost(earlier, found.lost, 1 / (LEVELS - 1)),
    )
    why = _refusal(found, touches, correction, unknown_of)
    sequence = None if why else ledger.adapt(correction)
    lost = np.flatnonzero(correction.lost).tolist()
    left_out = f"; channels {lost} are left out" if lost else ""
    return Adaptation(
        kept=not why,
        why=why or f"later touches are read through it{left_out}",
        sequence=sequence,
        gains=tuple(correction.gains.tolist()),
        offsets=tuple(correction.offsets.tolist()),
        left_out=tuple(lost),
        before=found.before,
        after=found.after,
    )


def _refusal(
    found: Fitted, touches: Mapping[Stream, str], correction: Correction, unknown_of: Callable[[Iterable[Stream]], int]
) -> str:
    """Why a correction is not kept; "" where it is: most of its touches are known with it, or more than without."""
    if found.gained < LIKELIER:
        return "the touches are explained no better with any correction: the skin reads as it did, or changed otherwise"
    after = unknown_of(corrected_stream(touch, correction) for touch in touches)
    if 2 * after > len(touches) and after >= unknown_of(touches):
        return f"{after} of {len(touches)} touches are unknown even so: gains and offsets do not explain the change"
    return ""
