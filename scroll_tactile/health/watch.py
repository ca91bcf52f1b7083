"""The watch over a sensor: takes rows of the journal in their order, and says whether they are still exchangeable.

A bet against exchangeability: conformal p-values, and martingales that grow where these are not uniform.

Of each channel three scores are ranked, by what a change of it would do: the linear statistics dᵀ P x that tell a
gain, an offset and noise from what else moves, P the inverse of the scatter of touches within materials. P contains
the touch itself and treats it as the others, so that its rank among the touches of its own cell (material, length and
level) is uniform and independent of all before it, whatever mixture of materials comes (transductive, Mondrian: Vovk,
Gammerman, Shafer, Algorithmic Learning in a Random World, 2005). A simple jumper bets on each score (Volkhonskiy and
others, COPA 2017): factors 1 + ε (p − 1/2), capital moved between the ε at a rate J. The mean of all martingales is
one, too, and reaches 1/bound with a probability of at most the bound, ever (Ville).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from copy import copy, deepcopy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.health.channel_numbers import KINDS, UNIT, Numbers
from scroll_tactile.health.diagnosis import Deviation, Floats, Rows, Scatter, SensorChange, diagnose, diagnose_rest
from scroll_tactile.results import Health

__all__ = ["STAKES", "Watch", "WatchRules", "WatchedRow", "WatchedRows"]

Whole = npt.NDArray[np.int32]

STAKES = np.array([-1.9, -0.95, 0.0, 0.95, 1.9])[:, None]  # below 2: a factor stays above 0
JUMP = 0.01
COARSE = 0.7  # of a logarithm, a factor of two: changes of a mixture are smaller
SCORES = 5  # of a channel
LEVELS = 1 / 3  # of a logarithm: the width of a cell of the level of a touch
FLAT = 8 * (LEVELS / UNIT) ** 2 / 12  # squares of the levels of eight touches about their mean, uniform in a cell
MOST_ROWS = 256  # rows of a cell; a fuller cell drops its older half, or ranks would be learned
RECENT = 128  # touches, and rows at rest, from which a change is told
EVERY = 64  # rows that count, between two copies of a watch

Place = tuple[str, int, int]
"""The place of a cell: material, length and level."""
AT_REST: Place = ("", 0, 0)


class Bets:
    """One martingale for each of `count` scores. log: the natural logarithm of each, shape (count,).

    shares: of a martingale's capital on each stake, (5, count).
    """

    def __init__(self, count: int) -> None:
        self.shares: Floats = np.full((len(STAKES), count), 1 / len(STAKES))
        self.log: Floats = np.zeros(count)

    def take(self, ranks: Floats, first: int) -> None:
        """Bet on p-values (k,) of the scores from the first on."""
        shares = self.shares[:, first : first + len(ranks)]
        shares *= 1 - JUMP
        shares += JUMP / len(STAKES)
        shares *= 1 + STAKES * (ranks - 0.5)
        total = shares.sum(axis=0)
        shares /= total
        self.log[first : first + len(ranks)] += np.log(total)


def beside_level(scores: Floats, levels: Rows) -> Floats:
    """What the level of a touch does not explain of its scores (k, count), by the line through the rows of a cell.

    levels: (k,). Rows are treated alike, so that they stay exchangeable: the line is drawn with the touch itself. It is
    pulled to none as far as eight touches spread over a cell would: through two touches a line explains all.
    """
    away = levels - np.add.reduce(levels, dtype=np.float64) / len(levels)
    slope = (away @ scores) / (float(away @ away) + FLAT)
    explained = np.dot(away[:, None], slope[None])
    return np.asarray(np.subtract(scores, explained, out=explained))


def ranks(scores: Floats | Whole, random: float) -> Floats:
    """The smoothed p-value of the last of scores (k, count) among all, (count,); random in [0, 1) breaks ties."""
    last = scores[-1]
    below, same = (np.add.reduce(which, axis=0, dtype=np.uint16) for which in (scores < last, scores == last))
    return np.asarray((below + random * same) / len(scores))


def tie_break(sequence: int) -> float:
    """A number in [0, 1) for a row of the journal, by which ties are broken: SplitMix64 of its place (Steele 2014)."""
    mixed = (sequence * 0x9E3779B97F4A7C15) % 2**64
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ (mixed >> shift)) * factor % 2**64
    return float((mixed ^ (mixed >> 31)) >> 11) * 2.0**-53


class Cell(NamedTuple):
    """The rows (k, size) of one cell, and those scores of each that nothing else changes, (k, 2 n).

    None of it changes: a copy of a watch has the same cells.
    """

    rows: Rows
    scores: Whole

    @classmethod
    def of(cls, place: Place, rows: Rows) -> Cell:
        """The cell of a place, with these rows.

        The scores are the level of each channel, and how lively it is beside the others: a large change widens the
        scatter, in which the linear scores hide it, and these show it. At rest they are each channel's level by itself,
        and its noise. All in `UNIT`.
        """
        n, whole = rows.shape[1] // KINDS, rows.astype(np.int32)
        level, noise = whole[:, :n], whole[:, 2 * n : 3 * n]
        if place == AT_REST:
            return cls(rows, np.concatenate([level + whole[:, -1:], noise], axis=1))
        lively = whole[:, n : 2 * n] + noise
        ordered = np.sort(lively, axis=1)
        lively -= np.rint((ordered[:, (n - 1) // 2] + ordered[:, n // 2]) / 2).astype(np.int32)[:, None]
        return cls(rows, np.concatenate([level, lively], axis=1))

    def joined(self, other: Cell) -> Cell:
        """The cell with the rows of another behind its own."""
        return Cell(np.concatenate([self.rows, other.rows]), np.concatenate([self.scores, other.scores]))


class Watch:
    """All that health is told from; it depends on the rows, and on their order. channels: of the sensor.

    bound: of the probability that it ever alarms where all rows are exchangeable within their cells: a material, a
    length, a level. alarmed: the row that raised the alarm; None as long as there is none. evidence: the logarithm of
    the mean martingale after the last row; grew: after each, to base ten, in a list that copies share. taken: how many
    rows counted.
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
        twin.bets, twin.scatter = deepcopy(self.bets), deepcopy(self.scatter)
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
            self._bet(sequence, material, (numbers - before.rows.mean(axis=0)) * UNIT, cell)
            self._judge(sequence)
        if len(cell.rows) > MOST_ROWS:  # its older half goes, so that later rows are ranked among others
            cell = Cell.of(place, cell.rows[MOST_ROWS // 2 :].copy())
        self.cells[place] = cell
        self.taken += 1

    def _bet(self, sequence: int, material: str, away: Floats, cell: Cell) -> None:
        """Bet on the ranks of the last row of a cell, which lies so far from the mean of the others, in logarithms."""
        n, random, among = self.channels, tie_break(sequence), len(cell.rows) - 1
        if material:
            self.scatter.take(away, among)
            scores = np.concatenate([self.scatter.scores(cell.rows), cell.scores], axis=1)
            scores = beside_level(scores, cell.rows[:, -1])
            scores[:, KINDS * n :] = np.rint(scores[:, KINDS * n :] * (UNIT / COARSE))
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
            self.change = diagnose(recent, behind, self.scatter, top, self.bound)


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

    last: the row up to which it has taken them. known: the row up to which retractions are known.

    The copies lie apart by at most 64 rows, or by as many as have come since: one goes back by few rows where the last
    is retracted, and n rows have some 2 log₂(n / 64) of them, of 35 kB (19 channels) or 300 kB (60) each, beside the
    cells as they were: 0.7 MB each after 4000 rows of 19 channels.
    """

    def __init__(self, rules: WatchRules, channels: int) -> None:
        self.rules, self.watch = rules, Watch(channels, rules.bound)
        self.last, self.known = rules.after, 0
        self._earlier = [_Earlier(rules.after, self.watch.copy(), 0)]  # the first is before all rows

    def take(self, row: WatchedRow) -> None:
        """Take the next row."""
        watch = self.watch
        if row.numbers is not None and watch.alarmed is None:
            if watch.taken >= self._earlier[-1].watch.taken + EVERY:
                self._keep_copy()
            watch.take(row.sequence, row.material, row.steps, row.numbers)
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
        while len(self._earlier) > 1 and self._earlier[-1].last >= sequence:
            self._earlier.pop()
        self.last, watch, grown = self._earlier[-1]
        self.watch = watch.copy()
        del self.watch.grew[grown:]

    def health(self, time_of: Callable[[int], float | None]) -> Health:
        """What it says. time_of: a row's, in seconds since 1970."""
        watch, change = self.watch, self.watch.change
        return Health(
            since=None if change is None else change.since,
            time=None if change is None else time_of(change.since),
            channels=() if change is None else change.channels,
            kind="" if change is None else change.kind,
            evidence=math.exp(min(watch.evidence, 700.0)),
            bound=watch.bound,
            touches=watch.taken,
            alarmed=watch.alarmed,
            materials=() if change is None else change.materials,
            grew=tuple(watch.grew),
        )
