"""How likely a reading is, given the reading of a kept touch and the noise that came over it.

A level is a reading in 255 steps of its channel's range. A touch of the same material reads x + v where a kept one
reads x: v is normal, with the spread that touches of the set have among themselves. Noise is added to that, and what
leaves the range is clipped to it:

    L[y, x] = log((1 − ε) P(clip(x + v + u) = y) + ε / 255),    u uniform in ± a, or normal with a's energy.

Rounded to 2⁻¹⁰ the logarithms are integers: sums of them are the same bytes in any order.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.sensors import Sensor

__all__ = ["CLEAN", "LEVELS", "MISSING", "UNIT", "Likelihood", "Noise", "Table", "levels_of"]

LEVELS = 255
MISSING = 255  # the level of a value that was not read; it has a likelihood of 1 beside any other
UNIT = 1024  # of the tables, in a natural logarithm's 1

FLOOR = 1e-3  # ε: a share of readings that nothing explains, such as glitches
NARROWEST = 1.0  # levels: rounding alone spreads by 0.3, and a touch has to be near more than itself
BLUR = 0.006  # of an amplitude: what a step of the amplitudes leaves unsaid of where the noise ends
LEAST = 0.01  # of the range: less noise cannot be told from touch to touch
UNIFORM_STEP, NORMAL_STEP = 1.005, 1.12  # uniform noise ends sharply, and five per cent beside it nothing is explained
MOST_TABLES = 96  # of 128 kB; the rough and coarse noises are 50

LevelArray = npt.NDArray[np.uint8]
FloatArray = npt.NDArray[np.float64]

_LEVELS = np.arange(float(LEVELS))
_DISTANCE = _LEVELS[None, :] + 0.5 - _LEVELS[:, None]  # of the upper end of level y from x, [x, y]


def levels_of(readings: npt.NDArray[np.floating], sensor: Sensor) -> LevelArray:
    """Readings in the sensor's unit, shape (T, C), as levels, shape (C, T); NaN is MISSING, the rest is clipped."""
    low, high = (limit.astype(np.float64) for limit in sensor.limits)
    share = (np.asarray(readings, dtype=np.float64) - low) / (high - low)
    unread = np.isnan(share)
    levels = np.rint(np.clip(np.where(unread, 0.0, share), 0.0, 1.0) * (LEVELS - 1)).astype(np.uint8)
    levels[unread] = MISSING
    return np.ascontiguousarray(levels.T)


@dataclass(frozen=True)
class Noise:
    """What came over a touch: independent noise on every value.

    step: of the amplitude, from LEAST on; −1 is no noise. normal: whether it is normal, and not uniform.
    """

    step: int = -1
    normal: bool = False

    @property
    def amplitude(self) -> float:
        """A share of the range: uniform noise reaches ± this far; normal noise has this / √3 as standard deviation."""
        return 0.0 if self.step < 0 else LEAST * (NORMAL_STEP if self.normal else UNIFORM_STEP) ** self.step

    def near(self, stride: int) -> list[Noise]:
        """This noise and two weaker and two stronger ones, `stride` steps apart, of those up to the whole range."""
        if self.step < 0:
            return [self]
        last = round(math.log(1 / LEAST) / math.log(NORMAL_STEP if self.normal else UNIFORM_STEP))
        steps = (self.step + i * stride for i in range(-2, 3))
        return [Noise(step, self.normal) for step in steps if 0 <= step <= last]


CLEAN = Noise()


@dataclass(frozen=True)
class Table:
    """What one kind of noise makes of each level.

    logs: L in UNIT, int16, at 256 · y + x; 0 where either is MISSING. offset, slope: of the straight line that comes
    nearest to the mean of y over x. mean: of y for each x, shape (255,). expected: of L for each x, shape (255,).
    information: Fisher's on x in units of the natural spread; near 1 without noise, and 0 where noise hides
    how touches differ.
    """

    logs: npt.NDArray[np.int16]
    offset: float
    slope: float
    mean: FloatArray
    expected: FloatArray
    information: float


class Likelihood:
    """The tables of one set of touches, for any number of threads.

    spread: standard deviation of a reading among touches of one material, in levels, for each level; shape (255,).
    weights: how often each level is read, shape (255,).
    """

    def __init__(self, spread: FloatArray, weights: FloatArray) -> None:
        self.spread = np.maximum(spread, NARROWEST)
        self.weights = weights / weights.sum()
        self._tables: OrderedDict[Noise, Table] = OrderedDict()
        self._lock = threading.Lock()  # of the order of the tables; never held while one is made

    @classmethod
    def of(cls, spread: FloatArray, weights: FloatArray) -> Likelihood:
        """The tables of a spread and of weights as another one has them, to the bit."""
        likelihood = cls(spread, weights)
        likelihood.weights = weights
        return likelihood

    def table(self, noise: Noise) -> Table:
        """The table of a kind of noise; the latest are kept."""
        with self._lock:
            if (found := self._tables.get(noise)) is not None:
                self._tables.move_to_end(noise)
                return found
        found = self._made(noise)
        with self._lock:
            self._tables[noise] = found
            if len(self._tables) > MOST_TABLES:
                self._tables.popitem(last=False)
        return found

    def _made(self, noise: Noise) -> Table:
        chances = self._chances(noise)
        logs = _logs(chances)
        whole = np.zeros((256, 256), dtype=np.int16)
        whole[:LEVELS, :LEVELS] = np.rint(logs.T * UNIT)
        mean = chances @ _LEVELS
        middle, typical = self.weights @ _LEVELS, self.weights @ mean
        scatter = float(self.weights @ (_LEVELS - middle) ** 2)
        slope = float(self.weights @ ((_LEVELS - middle) * (mean - typical))) / scatter if scatter > 0 else 1.0
        slope = max(slope, 1e-3)
        roots = np.sqrt(chances)
        information = 4 * (np.gradient(roots, axis=0) ** 2).sum(axis=1) * self.spread**2
        return Table(
            logs=whole.ravel(),
            offset=float(typical - slope * middle),
            slope=slope,
            mean=mean,
            expected=(chances * logs).sum(axis=1),
            information=float(self.weights @ information),
        )

    def entries(self, noise: Noise, places: npt.NDArray[np.intp]) -> npt.NDArray[np.int64]:
        """`Table.logs` of a noise at some places, without the table."""
        y, x = np.divmod(places, 256)
        read = (y != MISSING) & (x != MISSING)
        away, spread = y + 0.5 - x, self.spread[np.where(read, x, 0)]
        below = np.where(y == LEVELS - 1, 1.0, self._below(noise, away, spread))
        chances = np.maximum(below - np.where(y == 0, 0.0, self._below(noise, away - 1, spread)), 0.0)
        return np.where(read, np.rint(_logs(chances) * UNIT), 0).astype(np.int64)

    def _chances(self, noise: Noise) -> FloatArray:
        """P(y | x), [x, y]; what lies beyond an end of the range is read as that end."""
        below = self._below(noise, _DISTANCE, self.spread[:, None])
        below[:, -1] = 1.0
        return np.maximum(np.diff(below, axis=1, prepend=0.0), 0.0)

    @staticmethod
    def _below(noise: Noise, away: FloatArray, spread: FloatArray) -> FloatArray:
        """The probability of no more than a level whose upper end is so far from x, which is spread so much."""
        reach = noise.amplitude * (LEVELS - 1)
        if noise.normal or not reach:
            return _normal(away / np.hypot(spread, reach / math.sqrt(3)))
        blurred = np.hypot(spread, BLUR * reach)
        return np.asarray((_sloped(away + reach, blurred) - _sloped(away - reach, blurred)) / (2 * reach))


def _logs(chances: FloatArray) -> FloatArray:
    """L of P(y | x); see above."""
    return np.asarray(np.log((1 - FLOOR) * chances + FLOOR / LEVELS))


def _normal(z: FloatArray) -> FloatArray:
    """Φ(z), to 1e-7: Abramowitz and Stegun 1964, 26.2.17; scipy.special would be imported for this alone."""
    size = np.abs(z)
    t = 1 / (1 + 0.2316419 * size)
    series = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    tail = np.exp(-0.5 * size * size) * (1 / math.sqrt(2 * math.pi)) * series
    return np.where(z < 0, tail, 1 - tail)


def _sloped(z: FloatArray, spread: FloatArray) -> FloatArray:
    """∫ Φ(t / spread) dt up to z: zΦ(z / s) + sφ(z / s)."""
    scaled = z / spread
    return np.asarray(z * _normal(scaled) + spread * np.exp(-0.5 * scaled * scaled) / math.sqrt(2 * math.pi))
