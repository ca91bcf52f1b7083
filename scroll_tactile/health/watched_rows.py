"""The rows of a journal that a watch has taken: how it goes on with later ones, and back to before one that is gone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from scroll_tactile.health.channel_numbers import Numbers
from scroll_tactile.health.watch import Watch
from scroll_tactile.results import Health

__all__ = ["WatchRules", "WatchedRow", "WatchedRows"]

EVERY = 64  # rows that count, between two copies of a watch


@dataclass(frozen=True)
class WatchRules:
    """Which rows of a journal are watched: behind `after`, up to `until`, from `source`; bound: of false alarms."""

    bound: float
    after: int = 0
    until: int | None = None
    source: str | None = None


class WatchedRow(NamedTuple):
    """A row of the journal. material: "" at rest. steps: readings. numbers: None for a row that does not count."""

    sequence: int
    material: str = ""
    steps: int = 0
    numbers: Numbers | None = None


class _Earlier(NamedTuple):
    """A watch as it was after the row `last`; grown: how long its list of what grew was."""

    last: int
    watch: Watch
    grown: int


class WatchedRows:
    """A watch, by which rules it was made, and copies of it as it was before.

    last: the row up to which it has taken them. known: the row up to which retractions are known. lost: how often the
    memory had lost rows when it began.

    The copies lie apart by at most 64 rows, or by as many as have come since: one goes back by few rows where the last
    is retracted, and n rows have some 2 log₂(n / 64) of them, of 35 kB (19 channels) or 300 kB (60) each, beside the
    cells as they were: 0.7 MB each after 4000 rows of 19 channels.
    """

    def __init__(self, rules: WatchRules, watch: Watch, *, last: int, known: int, lost: int) -> None:
        self.rules, self.watch, self.last, self.known, self.lost = rules, watch, last, known, lost
        self._earlier: list[_Earlier] = []
        self._health: Health | None = None

    def take(self, row: WatchedRow) -> None:
        """Take the next row."""
        watch = self.watch
        if row.numbers is not None and watch.alarmed is None:
            if not self._earlier or watch.taken >= self._earlier[-1].watch.taken + EVERY:
                self._keep_copy()
            watch.take(row.sequence, row.material, row.steps, row.numbers)
            self._health = None
        self.last = row.sequence

    def _keep_copy(self) -> None:
        earlier, now = self._earlier, self.watch.taken
        earlier.append(_Earlier(self.last, self.watch.copy(), len(self.watch.grew)))
        for place in range(len(earlier) - 2, 0, -1):
            before, after = (earlier[there].watch.taken for there in (place - 1, place + 1))
            if after - before <= now - after:
                del earlier[place]

    def take_back(self, sequence: int) -> None:
        """Be as before this row was taken; the rows between are to be taken again."""
        if sequence > self.last or (self.watch.alarmed is not None and sequence > self.watch.alarmed):
            return
        while self._earlier and self._earlier[-1].last >= sequence:
            self._earlier.pop()
        if not self._earlier:
            self.watch, self.last = Watch(self.watch.channels, self.rules.bound), self.rules.after
        else:
            self.last, watch, grown = self._earlier[-1]
            self.watch = watch.copy()
            del self.watch.grew[grown:]
        self._health = None

    def health(self, time_of: Callable[[int], float | None]) -> Health:
        """What it says, made anew where a row came that counts. time_of: a row's, in seconds since 1970."""
        if self._health is None:
            self._health = self._made(time_of)
        return self._health

    def _made(self, time_of: Callable[[int], float | None]) -> Health:
        watch, change = self.watch, self.watch.change
        grew, evidence = tuple(watch.grew), math.exp(min(watch.evidence, 700.0))
        if change is None:
            return Health(None, None, (), "", evidence, watch.bound, watch.taken, None, (), grew)
        found = (change.since, time_of(change.since), change.channels, change.kind)
        return Health(*found, evidence, watch.bound, watch.taken, watch.alarmed, change.materials, grew)
