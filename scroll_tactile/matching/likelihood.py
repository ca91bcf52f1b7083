"""How likely a reading is, given the reading of a kept touch and the noise that came over it.

A touch of the same material reads the level x + v where a kept one reads x (see `signals.levels`): v is normal, with
the spread that touches of the set have among themselves. Noise is added to that, and what leaves the range is clipped:

    L[y, x] = log((1 − ε) P(clip(x + v + u) = y) + ε / 255),    u uniform in ± a, or normal with a's energy.

Rounded to 2⁻¹⁰ the logarithms are integers: sums of them are the same bytes in any order, by C or by numpy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np
import numpy.typing as npt

from scroll_tactile import native
from scroll_tactile.signals.levels import LEVELS, MISSING, LevelArray

__all__ = ["CLEAN", "NOISES", "UNIT", "Likelihood", "Noise", "Table"]

UNIT = 1024  # of the tables, in a natural logarithm's 1

FLOOR = 1e-3  # ε: a share of readings that nothing explains, such as glitches
NARROWEST = 1.0  # levels: rounding alone spreads by 0.3, and a touch has to be near more than itself
LEAST, STEP, AMPLITUDES = 0.01, 1.01, 464  # amplitudes from LEAST, below which none is told from touch to touch, to 1
BLUR = 0.006  # of an amplitude: what a step of the amplitudes leaves unsaid of where the noise ends
MOST_TABLES = 96  # of 128 kB

FloatArray = npt.NDArray[np.float64]

_LEVELS = np.arange(float(LEVELS))
_DISTANCE = _LEVELS[None, :] + 0.5 - _LEVELS[:, None]  # of the upper end of level y from x, [x, y]


@dataclass(frozen=True)
class Noise:
    """Independent noise on every value. step: of its amplitude; −1 is no noise. normal: and not uniform."""

    step: int = -1
    normal: bool = False

    @property
    def amplitude(self) -> float:
        """A share of the range: uniform noise reaches ± this far; normal noise has this / √3 as standard deviation."""
        return 0.0 if self.step < 0 else LEAST * STEP**self.step


CLEAN = Noise()
NOISES = [Noise(step, normal) for normal in (False, True) for step in range(AMPLITUDES)]


@dataclass(frozen=True)
class Table:
    """What one kind of noise makes of each level.

    logs: L in UNIT, int16, at 256 · y + x; 0 where either is MISSING. offset, slope: of the straight line that comes
    nearest to the mean of y over x. mean: of y for each x, shape (255,). expected: of L for each x, shape (255,).
    information: Fisher's on x in units of the natural spread; near 1 without noise, and 0 where noise hides
    how touches differ.
    """

    noise: Noise
    logs: npt.NDArray[np.int16]
    offset: float
    slope: float
    mean: FloatArray
    expected: FloatArray
    information: float

    def log_sums(self, own: LevelArray, others: LevelArray) -> FloatArray:
        """Sums of L, (others,), over the levels of a touch (C, T) beside each of others (others, C, T)."""
        own, others = own.ravel(), others.reshape(len(others), own.size)
        if not native.available:
            return np.asarray(self.logs.take((own.astype(np.intp) << 8) | others).sum(axis=1, dtype=np.int64) / UNIT)
        sums = np.empty(len(others), np.int64)
        native.sum_logs(np.ascontiguousarray(own), np.ascontiguousarray(others), self.logs, sums)
        return sums / UNIT

    def log_likelihoods(self, own: LevelArray, others: LevelArray) -> FloatArray:
        """The same, scaled up where some of the others lack values that the touch has."""
        sums, seen, read = self.log_sums(own, others), own != MISSING, others != MISSING
        if read.all():
            return sums
        both = np.count_nonzero((read & seen).reshape(len(others), own.size), axis=1)
        return np.asarray(sums * (np.count_nonzero(seen) / np.maximum(both, 1)))


@dataclass(eq=False)
class Likelihood:
    """The tables of one set of touches, for any number of threads.

    spread: standard deviation of a reading among touches of one material, in levels, for each level; shape (255,).
    weights: the share of readings at each level, shape (255,). table: of a kind of noise; the latest are kept.
    """

    spread: FloatArray
    weights: FloatArray

    def __post_init__(self) -> None:
        self.spread = np.maximum(self.spread, NARROWEST)
        self.table = lru_cache(MOST_TABLES)(partial(_table, self.spread, self.weights))

    @cached_property
    def by_amplitude(self) -> npt.NDArray[np.float32]:
        """L by how far a value lies from what was kept, under each of NOISES; of the mean spread, (512, noises).

        Row d: of a value within the range that is d levels away. Row 256 + d: of one at an end of the range, where what
        was kept is d levels within. Rows 255 and 511 are 0: one of the two was not read.
        """
        lower = np.arange(LEVELS + 1, dtype=np.float64)[:, None] - 0.5  # ends of the levels that lie 0, 1, … away
        reach = np.array([noise.amplitude for noise in NOISES[:AMPLITUDES]]) * (LEVELS - 1)
        spread = float(self.weights @ self.spread)
        below = np.hstack([_below_uniform(lower, reach, spread), _below_normal(lower, reach, spread)])
        logs = _logs(np.stack([np.diff(below, axis=0), 1 - below[:LEVELS]]))
        return np.pad(logs.astype(np.float32), ((0, 0), (0, 1), (0, 0))).reshape(512, -1)


def _table(spread: FloatArray, weights: FloatArray, noise: Noise) -> Table:
    below_of, reach = _below_normal if noise.normal else _below_uniform, noise.amplitude * (LEVELS - 1)
    below = below_of(_DISTANCE, reach, spread[:, None])
    below[:, -1] = 1.0  # what lies beyond an end of the range is read as that end
    chances = np.maximum(np.diff(below, axis=1, prepend=0.0), 0.0)  # P(y | x), [x, y]
    logs, mean = _logs(chances), chances @ _LEVELS
    whole = np.pad(np.rint(logs.T * UNIT).astype(np.int16), (0, 1))
    middle, typical = weights @ _LEVELS, weights @ mean
    together, scatter = weights @ ((_LEVELS - middle) * (mean - typical)), weights @ (_LEVELS - middle) ** 2
    slope = max(float(together) / float(scatter), 1e-3)
    slopes = np.gradient(np.sqrt(chances), axis=0)
    information = 4 * np.einsum("xy,xy->x", slopes, slopes) * spread**2  # Fisher's 4 Σ (d√P / dx)²
    offset, expected = float(typical - slope * middle), np.einsum("xy,xy->x", chances, logs)
    return Table(noise, whole.ravel(), offset, slope, mean, expected, float(weights @ information))


def _logs(chances: FloatArray) -> FloatArray:
    """L of P(y | x), or of what rounding left below 0; see above."""
    return np.asarray(np.log((1 - FLOOR) * np.maximum(chances, 0.0) + FLOOR / LEVELS))


def _below_normal(away: FloatArray, reach: FloatArray | float, spread: FloatArray | float) -> FloatArray:
    """The probability of no more than a level whose upper end is so far from x, through normal noise or none."""
    return _normal(away / np.hypot(spread, reach / math.sqrt(3)))[0]


def _below_uniform(away: FloatArray, reach: FloatArray | float, spread: FloatArray | float) -> FloatArray:
    """The same through uniform noise in ± reach, 0 of none."""
    if not np.any(reach):
        return _below_normal(away, 0.0, spread)
    blurred = np.hypot(spread, BLUR * np.asarray(reach))

    least, most = (away - reach) / blurred, (away + reach) / blurred
    (low, at_least), (high, at_most) = _normal(least), _normal(most)  # Φ and φ: the integral of Φ up to z is z Φ + φ
    return np.asarray(((most * high + at_most) - (least * low + at_least)) * blurred / (2 * reach))


def _normal(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Φ(z), to 1e-7, and φ(z): Abramowitz and Stegun 1964, 26.2.17; scipy.special would be imported for this alone."""
    density = np.exp(-0.5 * z * z) * (1 / math.sqrt(2 * math.pi))
    t = 1 / (1 + 0.2316419 * np.abs(z))
    series = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    tail = density * series
    return np.where(z < 0, tail, 1 - tail), density
