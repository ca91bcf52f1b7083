"""A bet against exchangeability: conformal p-values, and martingales that grow where these are not uniform.

Of each channel three scores are ranked, by what a change of it would do: the linear statistics dᵀ P x that tell a
gain, an offset and noise from what else moves, P the inverse of the scatter of touches within materials. P contains
the touch itself and treats it as the others, so that its rank among the touches of its own cell (material, length and
level) is uniform and independent of all before it, whatever mixture of materials comes (transductive, Mondrian: Vovk,
Gammerman,
Shafer, Algorithmic Learning in a Random World, 2005). A simple jumper bets on each score (Volkhonskiy and others,
COPA 2017): factors 1 + ε (p − 1/2), capital moved between the ε at a rate J. The mean of all martingales is one, too,
and reaches 1/bound with a probability of at most the bound, ever (Ville).
"""

from __future__ import annotations

import math
from copy import copy

import numpy as np
import numpy.typing as npt

from scroll_tactile.health.channel_numbers import KINDS, UNIT

__all__ = [
    "LEVELS",
    "SCORES",
    "Bets",
    "Floats",
    "Rows",
    "Scatter",
    "Whole",
    "beside_level",
    "coarse",
    "own_scores",
    "ranks",
    "resting_scores",
    "tie_break",
]

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int16]
Whole = npt.NDArray[np.int32]

STAKES = np.array([-1.9, -0.95, 0.0, 0.95, 1.9])[:, None]  # below 2: a factor stays above 0
JUMP = 0.01
PRIOR = 0.02  # of a logarithm: the assumed deviation of a number, which counts as one touch for each number
COARSE = 0.7  # of a logarithm, a factor of two: changes of a mixture are smaller
SCORES = 5  # of a channel
LEVELS = 1 / 3  # of a logarithm: the width of a cell of the level of a touch
FLAT = 8 * (LEVELS / UNIT) ** 2 / 12  # squares of the levels of eight touches about their mean, uniform in a cell


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

    def copy(self) -> Bets:
        """One that goes on independently."""
        twin = copy(self)
        twin.shares, twin.log = self.shares.copy(), self.log.copy()
        return twin


class Scatter:
    """The inverse of the prior plus the scatter of touches about the means of their cells, updated by each touch
    (Sherman, Morrison 1950)."""

    def __init__(self, channels: int) -> None:
        self.channels, size = channels, KINDS * channels + 1
        self.inverse: Floats = np.eye(size) / (size * PRIOR**2)
        self.count = 0
        self._room: Floats = np.empty((size, size))
        self._signed: Floats = np.empty((size, KINDS * channels))

    def take(self, away: Floats, among: int) -> None:
        """Add a touch that lies so far from the mean of the others of its cell, (size,) in logarithms, so many."""
        self.count += 1
        taken = away * math.sqrt(among / (among + 1))
        moved = self.inverse @ taken
        # A product of matrices takes half the time of one with broadcasting, and is the same to the bit.
        np.dot(moved[:, None], (moved / (1 + taken @ moved))[None], out=self._room)
        self.inverse -= self._room

    def copy(self) -> Scatter:
        """One that goes on independently."""
        twin = copy(self)
        twin.inverse = self.inverse.copy()
        return twin

    def without(self, away: Floats, among: npt.NDArray[np.int64]) -> Scatter:
        """That of the other touches: away and among are those of some that were taken, (k, size) and (k,)."""
        taken = away * np.sqrt(among / (among + 1))[:, None]
        other = Scatter(self.channels)
        other.count = self.count - len(away)
        # I − A P Aᵀ is positive but for rounding (Woodbury).
        inside = np.eye(len(away)) - taken @ self.inverse @ taken.T
        moved = self.inverse @ taken.T
        other.inverse = self.inverse + moved @ np.linalg.solve(inside, moved.T)
        return other

    def signatures(self) -> Floats:
        """How a gain, an offset and noise of each channel move the numbers, (size, 3 n).

        A louder channel raises the mean over channels, too, from which the levels are counted.
        """
        n, one = self.channels, np.eye(self.channels)
        level = np.zeros((KINDS * n + 1, n))
        level[:n], level[-1] = one - 1 / n, 1 / n
        gain, noise = level.copy(), np.zeros_like(level)
        gain[n : 2 * n] = gain[2 * n : 3 * n] = noise[2 * n : 3 * n] = one
        return np.concatenate([gain, level, noise], axis=1)

    def scores(self, rows: Rows) -> Floats:
        """Of rows (k, size) the scores of each channel, (k, 3 n): gain, offset and noise told from what else moves."""
        n = self.channels
        level, spread, noise = (self.inverse[:, at : at + n] for at in (0, n, 2 * n))
        gain, offset = self._signed[:, :n], self._signed[:, n : 2 * n]
        np.subtract(level, np.add.reduce(level, axis=1, keepdims=True) / n, out=offset)
        offset += self.inverse[:, -1:] / n
        np.add(offset, spread, out=gain)
        gain += noise
        self._signed[:, 2 * n :] = noise
        return np.asarray((rows * UNIT) @ self._signed)


def own_scores(rows: Rows) -> Whole:
    """Of rows (k, size) the level of each channel, and how lively it is beside the others, in `UNIT`, (k, 2 n).

    A large change widens the scatter, in which the linear scores hide it; these scores show it.
    """
    n, whole = rows.shape[1] // KINDS, rows.astype(np.int32)
    lively = whole[:, n : 2 * n] + whole[:, 2 * n : 3 * n]
    ordered = np.sort(lively, axis=1)
    lively -= np.rint((ordered[:, (n - 1) // 2] + ordered[:, n // 2]) / 2).astype(np.int32)[:, None]
    return np.concatenate([whole[:, :n], lively], axis=1)


def resting_scores(rows: Rows) -> Whole:
    """Of a resting sensor's rows (k, size): the level of each channel by itself, and its noise, (k, 2 n)."""
    n, whole = rows.shape[1] // KINDS, rows.astype(np.int32)
    return np.concatenate([whole[:, :n] + whole[:, -1:], whole[:, 2 * n : 3 * n]], axis=1)


def beside_level(scores: Floats, levels: Rows) -> Floats:
    """What the level of a touch does not explain of its scores (k, count), by the line through the rows of a cell.

    levels: (k,). Rows are treated alike, so that they stay exchangeable: the line is drawn with the touch itself. It is
    pulled to none as far as eight touches spread over a cell would: through two touches a line explains all.
    """
    away = levels - np.add.reduce(levels, dtype=np.float64) / len(levels)
    slope = (away @ scores) / (float(away @ away) + FLAT)
    explained = np.dot(away[:, None], slope[None])
    return np.asarray(np.subtract(scores, explained, out=explained))


def coarse(scores: Floats) -> Floats:
    """Scores in `UNIT` rounded to factors of two."""
    return np.rint(scores * (UNIT / COARSE))


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
