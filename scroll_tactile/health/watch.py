"""The watch over a sensor: takes rows of the journal in their order, and says whether they are still exchangeable."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scroll_tactile.health.betting import SCORES, Bets, Rows, Scatter, ranks, resting_scores, tie_break
from scroll_tactile.health.channel_numbers import KINDS, UNIT, Numbers
from scroll_tactile.health.diagnosis import Deviation, SensorChange, diagnose, diagnose_rest
from scroll_tactile.results import Health

__all__ = ["Watch", "WatchRules", "WatchedRows"]

LEVELS = 1 / 3  # of a logarithm: the width of a cell of the level of a touch; of its length, a factor of two
MOST_ROWS = 256  # of a cell, then it is halved: ranks among rows that never change would be learned
RECENT = 128  # touches from which a change is told


@dataclass(frozen=True)
class WatchRules:
    """Which rows of a journal are watched: behind `after`, up to `until`, from `source`; bound: of false alarms."""

    bound: float
    after: int = 0
    until: int | None = None
    source: str | None = None


class Watch:
    """All that health is told from; it depends on the rows, and on their order. channels: of the sensor.

    bound: of the probability that it ever alarms where all rows are exchangeable within their cells: a material, a
    length, a level. alarmed: the row that raised the alarm; None as long as there is none. evidence: the logarithm of
    the mean martingale after the last row; grew: after each. taken: how many rows counted.
    """

    def __init__(self, channels: int, bound: float) -> None:
        self.channels, self.bound = channels, bound
        self._bets, self._rest = Bets(SCORES * channels), Bets(2 * channels)
        self._scatter = Scatter(channels)
        self._cells: dict[tuple[str, int, int], Rows] = {}
        self._least = np.zeros(SCORES * channels + 2 * channels)
        self._since = np.zeros(len(self._least), np.int64)
        self._recent: deque[Deviation] = deque(maxlen=RECENT)
        self.evidence = 0.0
        self.grew: list[tuple[int, float]] = []
        self.taken = 0
        self.alarmed: int | None = None
        self.change: SensorChange | None = None

    def take(self, sequence: int, material: str, steps: int, numbers: Numbers) -> None:
        """Take a touch of a material, of so many readings; material "": the sensor at rest. Nothing after the alarm."""
        if self.alarmed is not None:
            return
        length, level = steps.bit_length(), math.floor(int(numbers[-1]) * UNIT / LEVELS)
        cell = (material, length, level) if material else ("", 0, 0)
        rows = self._cells.get(cell, np.empty((0, KINDS * self.channels + 1), np.int16))
        if len(rows):
            away = (numbers - rows.mean(axis=0)) * UNIT
            if material:
                self._scatter.take(away, len(rows))
            everyone = np.concatenate([rows, numbers[None]])
            scores = self._scatter.scores(everyone) if material else resting_scores(everyone, self.channels)
            (self._bets if material else self._rest).take(ranks(scores, tie_break(sequence)))
            self._recent.append(Deviation(sequence, material, away, len(rows)))
            self._judge(sequence)
        self._cells[cell] = _with(rows, numbers)
        self.taken += 1

    def _judge(self, sequence: int) -> None:
        logs = np.concatenate([self._bets.log, self._rest.log])
        lower = logs <= self._least
        self._least = np.where(lower, logs, self._least)
        self._since[lower] = sequence
        most = float(logs.max())
        self.evidence = most + math.log(float(np.mean(np.exp(logs - most))))
        self.grew.append((sequence, self.evidence))
        if self.evidence < -math.log(self.bound):
            return
        self.alarmed, top = sequence, int(logs.argmax())
        n, resting = self.channels, top >= SCORES * self.channels
        recent = [each for each in self._recent if (not each.material) == resting]
        behind = [each.row > self._since[top] for each in recent]
        if resting:
            self.change = diagnose_rest(recent, behind, self._cells["", 0, 0], n)
        else:
            self.change = diagnose(recent, behind, self._scatter, top, self.bound)


def _with(rows: Rows, numbers: Numbers) -> Rows:
    """The rows of a cell with one more; of a full cell the older half goes, so that those that are left get others."""
    return np.concatenate([rows if len(rows) < MOST_ROWS else rows[MOST_ROWS // 2 :], numbers[None]])


@dataclass
class WatchedRows:
    """A watch, by which rules it was made, the last row that it has seen, and the last that was compacted then."""

    rules: WatchRules
    watch: Watch
    last: int
    compacted: int
    _health: Health | None = None

    def health(self, time_of: Callable[[int], float | None]) -> Health:
        """What it says, made anew where a row came that counts. time_of: a row's, in seconds since 1970."""
        if self._health is None or self._health.touches != self.watch.taken:
            self._health = self._made(time_of)
        return self._health

    def _made(self, time_of: Callable[[int], float | None]) -> Health:
        watch, change = self.watch, self.watch.change
        grew = tuple((sequence, evidence / math.log(10)) for sequence, evidence in watch.grew)
        evidence = math.exp(min(watch.evidence, 700.0))
        if change is None:
            return Health(None, None, (), "", evidence, watch.bound, watch.taken, None, (), grew)
        found = (change.since, time_of(change.since), change.channels, change.kind)
        return Health(*found, evidence, watch.bound, watch.taken, watch.alarmed, change.materials, grew)
