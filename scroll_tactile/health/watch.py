"""The watch over a sensor: takes rows of the journal in their order, and says whether they are still exchangeable."""

from __future__ import annotations

import math
from collections import deque
from copy import copy
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.health.betting import (
    LEVELS,
    SCORES,
    Bets,
    Floats,
    Rows,
    Scatter,
    Whole,
    beside_level,
    coarse,
    own_scores,
    ranks,
    resting_scores,
    tie_break,
)
from scroll_tactile.health.channel_numbers import KINDS, UNIT, Numbers
from scroll_tactile.health.diagnosis import Deviation, SensorChange, diagnose, diagnose_rest

__all__ = ["AT_REST", "MOST_ROWS", "RECENT", "Cell", "Place", "Watch"]

MOST_ROWS = 256  # rows of a cell; a fuller cell drops its older half, or ranks would be learned
RECENT = 128  # touches, and rows at rest, from which a change is told

Place = tuple[str, int, int]
"""The place of a cell: material, length and level."""
AT_REST: Place = ("", 0, 0)


class Cell(NamedTuple):
    """The rows (k, size) of one cell, those scores of each that nothing else changes, (k, 2 n), and the rows' sum.

    None of it changes: a copy of a watch has the same cells.
    """

    rows: Rows
    scores: Whole
    total: npt.NDArray[np.int64]

    @classmethod
    def of(cls, place: Place, rows: Rows) -> Cell:
        """The cell of a place, with these rows."""
        scores = resting_scores(rows) if place == AT_REST else own_scores(rows)
        return cls(rows, scores, rows.sum(axis=0, dtype=np.int64))

    def joined(self, other: Cell) -> Cell:
        """The cell with the rows of another behind its own."""
        rows, scores = np.concatenate([self.rows, other.rows]), np.concatenate([self.scores, other.scores])
        return Cell(rows, scores, self.total + other.total)

    def bounded(self) -> Cell:
        """The cell, without its older half where it is full, so that later rows are ranked among others."""
        if len(self.rows) <= MOST_ROWS:
            return self
        rows = self.rows[MOST_ROWS // 2 :].copy()
        return Cell(rows, self.scores[MOST_ROWS // 2 :].copy(), rows.sum(axis=0, dtype=np.int64))


class Watch:
    """All that health is told from; it depends on the rows, and on their order. channels: of the sensor.

    bound: of the probability that it ever alarms where all rows are exchangeable within their cells: a material, a
    length, a level. alarmed: the row that raised the alarm; None as long as there is none. evidence: the logarithm of
    the mean martingale after the last row; grew: after each, to base ten, in a list that copies share. taken: how many
    rows counted. The rest is what a copy on disk needs: see `validation.stored_watch`.
    """

    def __init__(self, channels: int, bound: float) -> None:
        self.channels, self.bound = channels, bound
        self.bets = Bets((SCORES + 2) * channels)
        self.scatter = Scatter(channels)
        self.cells: dict[Place, Cell] = {}
        self.least = np.zeros((SCORES + 2) * channels)
        self.since = np.zeros(len(self.least), np.int64)
        self.touched: deque[Deviation] = deque(maxlen=RECENT)
        self.rested: deque[Deviation] = deque(maxlen=RECENT)
        self.evidence = 0.0
        self.grew: list[tuple[int, float]] = []
        self.taken = 0
        self.alarmed: int | None = None
        self.change: SensorChange | None = None

    def copy(self) -> Watch:
        """One that goes on independently, but for the list of what grew."""
        twin = copy(self)
        twin.bets, twin.scatter = self.bets.copy(), self.scatter.copy()
        twin.least, twin.since = self.least.copy(), self.since.copy()
        twin.cells, twin.touched, twin.rested = dict(self.cells), self.touched.copy(), self.rested.copy()
        return twin

    def take(self, sequence: int, material: str, steps: int, numbers: Numbers) -> None:
        """Take a touch of a material, of so many readings; material "": the sensor at rest. Nothing after the alarm."""
        if self.alarmed is not None:
            return
        level = math.floor(int(numbers[-1]) * UNIT / LEVELS)
        place = (material, steps.bit_length(), level) if material else AT_REST
        before, cell = self.cells.get(place), Cell.of(place, numbers[None])
        if before is not None:
            cell = before.joined(cell)
            self._bet(sequence, material, (numbers - before.total / len(before.rows)) * UNIT, cell)
            self._judge(sequence)
        self.cells[place] = cell.bounded()
        self.taken += 1

    def _bet(self, sequence: int, material: str, away: Floats, cell: Cell) -> None:
        """Bet on the ranks of the last row of a cell, which lies so far from the mean of the others, in logarithms."""
        n, random, among = self.channels, tie_break(sequence), len(cell.rows) - 1
        if material:
            self.scatter.take(away, among)
            scores = np.concatenate([self.scatter.scores(cell.rows), cell.scores], axis=1)
            scores = beside_level(scores, cell.rows[:, -1])
            scores[:, KINDS * n :] = coarse(scores[:, KINDS * n :])
            self.bets.take(ranks(scores, random), 0)
        else:
            self.bets.take(ranks(cell.scores, random), SCORES * n)
        (self.touched if material else self.rested).append(Deviation(sequence, material, away, among))

    def _judge(self, sequence: int) -> None:
        logs = self.bets.log
        self.since[logs <= self.least] = sequence
        np.minimum(logs, self.least, out=self.least)
        most = float(logs.max())
        self.evidence = most + math.log(float(np.add.reduce(np.exp(logs - most))) / len(logs))
        self.grew.append((sequence, self.evidence / math.log(10)))
        if self.evidence < -math.log(self.bound):
            return
        self.alarmed, top = sequence, int(logs.argmax())
        n, resting = self.channels, top >= SCORES * self.channels
        recent = self.rested if resting else self.touched
        if resting:
            levels = float(logs[SCORES * n : (SCORES + 1) * n].max()) >= most / 2
            self.change = diagnose_rest(recent, self.cells[AT_REST].rows, n, levels=levels)
        else:
            behind = [each.row > self.since[top] for each in recent]
            behind[-1] = True  # as it is, unless somebody else wrote what was kept
            self.change = diagnose(recent, behind, self.scatter, top, self.bound)
