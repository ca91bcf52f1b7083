"""The watch over a sensor as arrays beside a checkpoint, so that the next process need not read the journal again.

A file may come from elsewhere. Types, shapes and bounds of its arrays are checked, so that no touch that comes later
fails or takes more memory because of it. Whether its numbers are those of the journal cannot be checked: whoever can
write them can write its rows, too. What another release wrote is not read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, cast, get_args

import numpy as np
import numpy.typing as npt
from scroll_tactile_store import Checkpoint

from scroll_tactile import __version__
from scroll_tactile.health.channel_numbers import KINDS
from scroll_tactile.health.diagnosis import Deviation, SensorChange
from scroll_tactile.health.watch import AT_REST, MOST_ROWS, RECENT, SCORES, STAKES, Cell, Watch, WatchedRows, WatchRules
from scroll_tactile.results import ChangeKind
from scroll_tactile.validation.expected import array, counts, expect, name, whole

__all__ = ["NAME", "watch_to_arrays", "watched_from"]

NAME = "health"
MADE_BY = f"{__version__}, 2"  # the release, in which scores may differ, and the version of these arrays
LARGEST = 2**53  # of a row, and of a count


def watch_to_arrays(watched: WatchedRows) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """Arrays and attributes of a watch."""
    watch, change = watched.watch, watched.watch.change
    recent = [*watch.touched, *watch.rested]
    names = sorted({material for material, _, _ in watch.cells} | {each.material for each in recent})
    places, empty = {name: place for place, name in enumerate(names)}, np.empty((0, KINDS * watch.channels + 1))
    cells = [(places[name], *at, len(cell.rows)) for (name, *at), cell in watch.cells.items()]
    arrays: dict[str, npt.NDArray[Any]] = {
        "inverse": watch.scatter.inverse,
        "shares": watch.bets.shares,
        "log": watch.bets.log,
        "least": watch.least,
        "since": watch.since,
        "cells": np.array(cells, np.int64).reshape(-1, 4),
        "rows": np.concatenate([empty.astype(np.int16), *(cell.rows for cell in watch.cells.values())]),
        "recent": np.array([(each.row, places[each.material], each.among) for each in recent], np.int64).reshape(-1, 3),
        "away": np.concatenate([empty, *(each.away[None] for each in recent)]),
        "grew": np.array([row for row, _ in watch.grew], np.int64),
        "evidence": np.array([evidence for _, evidence in watch.grew]),
    }
    attributes = {"made_by": MADE_BY, "rules": asdict(watched.rules), "names": names, "last": watched.last}
    attributes |= {"taken": watch.taken, "scattered": watch.scatter.count, "evidence": watch.evidence}
    return arrays, attributes | {"change": None if change is None else asdict(change)}


def watched_from(kept: Checkpoint, channels: int, rules: WatchRules, lost: int) -> WatchedRows | None:
    """What was kept, to go on from; None where it was made by other rules. Raises Unexpected for what is no watch."""
    about = kept.attributes
    expect(about.get("made_by") == MADE_BY, "made_by", MADE_BY, about.get("made_by"))
    if about.get("rules") != asdict(rules):
        return None
    last = whole("last", about.get("last"), rules.after, max(rules.after, kept.last_sequence))
    watch = _WatchReader(kept.arrays, about, last).watch(channels, rules.bound)
    return WatchedRows(rules, watch, last=last, known=kept.last_sequence, lost=lost)


class _WatchReader:
    """Reads the parts of a watch that had taken the rows up to `last`; raises Unexpected for invalid ones."""

    def __init__(self, arrays: Mapping[str, npt.NDArray[Any]], about: Mapping[str, Any], last: int) -> None:
        self.arrays, self._about, self._last = arrays, about, last
        names: Any = about.get("names")
        expect(isinstance(names, list) and names == sorted(set(names)), "names", "in order", names)
        self._names = [own and name("names", own) for own in names]  # "" at rest

    def watch(self, channels: int, bound: float) -> Watch:
        """The watch."""
        watch = Watch(channels, bound)
        scores, size = len(watch.least), KINDS * channels + 1
        watch.scatter.inverse = self.floats("inverse", (size, size)).copy()
        watch.scatter.count = whole("scattered", self._about.get("scattered"), 0, LARGEST)
        watch.bets.shares = self.floats("shares", (len(STAKES), scores), 0.0, 1.0).copy()
        watch.bets.log = self.floats("log", (scores,), -LARGEST, LARGEST).copy()
        watch.least = self.floats("least", (scores,), -LARGEST, 0.0).copy()
        watch.since = self.rows_of_journal("since", scores).copy()
        self._cells(watch, size)
        self._recent(watch, size)
        touched, rested = np.split(watch.bets.log, [SCORES * channels])
        for kept, logs in ((watch.touched, touched), (watch.rested, rested)):  # or a change could not be told
            expect(bool(kept) or not logs.any(), "log", "0 where no row was bet on", logs)
        rows = self.rows_of_journal("grew", None)
        evidence = self.floats("evidence", (len(rows),), -LARGEST, LARGEST)
        watch.grew = list(zip(rows.tolist(), evidence.tolist(), strict=True))
        last = self._about.get("evidence")
        expect(isinstance(last, float) and abs(last) < LARGEST, "evidence", "a number", last)
        watch.evidence = cast(float, last)
        watch.taken = whole("taken", self._about.get("taken"), len(rows), LARGEST)
        if watch.grew and watch.evidence >= -math.log(bound):
            watch.alarmed, watch.change = watch.grew[-1][0], self._change(channels)
        expect((watch.change is None) == (self._about.get("change") is None), "change", "at an alarm", "none or one")
        return watch

    def floats(
        self, field: str, shape: tuple[int | None, ...], least: float = -LARGEST, most: float = LARGEST
    ) -> npt.NDArray[np.float64]:
        """Finite numbers within bounds."""
        found = array(self.arrays, field, ("float64",), shape)
        expect(bool(((found >= least) & (found <= most)).all()), field, f"from {least} to {most}", "others")
        return found

    def rows_of_journal(self, field: str, count: int | None) -> npt.NDArray[np.int64]:
        """Rows up to the last."""
        return counts(field, array(self.arrays, field, ("int64",), (count,)), 0, self._last)

    def _cells(self, watch: Watch, size: int) -> None:
        cells, start = array(self.arrays, "cells", ("int64",), (None, 4)), 0
        rows = array(self.arrays, "rows", ("int16",), (None, size))
        for which, length, level, count in cells.tolist():
            expect(0 <= which < len(self._names) and 0 < count <= MOST_ROWS, "cells", "names and counts", cells)
            place = self._names[which], length, level
            expect(bool(place[0]) or place == AT_REST, "cells", f"{AT_REST} at rest", place)
            watch.cells[place] = Cell.of(place, rows[start : start + count].copy())
            start += count
        expect(start == len(rows) and len(watch.cells) == len(cells), "cells", f"{len(rows)} rows", start)

    def _recent(self, watch: Watch, size: int) -> None:
        recent = array(self.arrays, "recent", ("int64",), (None, 3))
        expect(len(recent) <= 2 * RECENT, "recent", f"{2 * RECENT} or fewer", len(recent))
        away = self.floats("away", (len(recent), size), -LARGEST, LARGEST)
        known = {material for material, _, _ in watch.cells}
        for (row, which, among), own in zip(recent.tolist(), away, strict=True):
            fits = 0 <= row <= self._last and 0 <= which < len(self._names) and 0 < among <= MOST_ROWS
            fits = fits and self._names[which] in known
            expect(fits, "recent", "rows, names and counts", (row, which, among))
            kept = watch.touched if self._names[which] else watch.rested
            kept.append(Deviation(row, self._names[which], own.copy(), among))

    def _change(self, channels: int) -> SensorChange:
        change: Any = self._about.get("change")
        expect(
            isinstance(change, dict) and change.keys() == SensorChange.__annotations__.keys(), "change", "one", change
        )
        since, kind = whole("since", change["since"], 0, self._last), change["kind"]
        expect(kind in get_args(ChangeKind), "kind", "of a change", kind)
        own = tuple(whole("channels", each, 0, channels - 1) for each in change["channels"])
        return SensorChange(since, own, kind, tuple(name("materials", each) for each in change["materials"]))
