"""The sensor at rest: its level, its noise, and how far from it a reading may lie before something touches.

Readings are whole numbers of 2⁻¹⁶ of each channel's range; level and scatter are exact sums of them, block by block,
so that nothing depends on how the readings were dealt out to calls. A reading x lies

    d² = |(x − m) V|²,    V Vᵀ = Σ⁻¹,

from the level m, Σ the mean scatter within blocks of a quarter of a second, pulled to its diagonal as far as there are
channels for its readings, and no smaller than half a step of the sensor. V is rounded, so that d² is an exact sum, too.

Noise is not normal, nor are readings independent: d² is taken to be c χ²_ν, with its mean as it was measured at rest
and its variance from that of sums over blocks. A sum of max(0, d² − κ) is then beyond h at a rate of exp(−θ h) readings,
where E exp(θ (d² − κ)) = 1 (Lorden 1971; Page's CUSUM), so that h follows from how many false contacts an hour may have.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import numpy.typing as npt

from scroll_tactile.sensors import Sensor

__all__ = ["Rest"]

Whole = npt.NDArray[np.float64]  # whole numbers, exact

LEVELS = 2.0**16  # of a channel's range
UNITS = 2.0**6  # of a standard deviation
FINE = 2.0**20  # of an entry of V
FARTHEST = 2.0**22  # units of one channel: 60 squares of it are exact
BLOCK = 0.25  # seconds
FEWEST = 8  # readings in a block
LEARNED = 1.0  # seconds, and no fewer readings than channels
FOLLOWED = 8  # blocks whose mean is the level
UNMEASURED = 8  # blocks that the noise as it should be counts for, beside what is measured
MOST_BLOCKS = 2**11  # then all sums are halved: noise changes in days
APART = 3.0  # standard deviations of d² that κ lies beyond its mean


class Rest:
    """What was learned of a sensor at rest. sensor: with channels. false_contacts: an hour that may be."""

    def __init__(self, sensor: Sensor, false_contacts: float) -> None:
        low, high = (np.broadcast_to(limit, sensor.shape).astype(np.float64) for limit in sensor.limits)
        self._low, self._scale = low, LEVELS / (high - low)
        self._log_run = math.log(max(2.0, sensor.rate * 3600 / false_contacts))
        self.channels = sensor.channels
        self.block = max(FEWEST, round(BLOCK * sensor.rate))
        self.needed = -(-max(round(LEARNED * sensor.rate), sensor.channels) // self.block) * self.block
        self.level: Whole = np.zeros(sensor.channels)
        self._levels: deque[tuple[Whole, int]] = deque(maxlen=FOLLOWED)
        self._scatter: npt.NDArray[np.int64] = np.zeros((sensor.channels, sensor.channels), np.int64)
        self._floor: Whole = np.ones(sensor.channels)
        self._whiten: Whole = np.empty((0, 0))
        self._blocks = self._due = 0
        self._sum = self._squares = 0.0  # of d² over blocks
        self.mean = self.kappa = self.alarm = self.inner = math.inf

    def whole(self, rows: npt.NDArray[np.float64]) -> Whole:
        """Readings (k, n) as whole numbers within the range; what is missing is where the level is."""
        numbers = rows - self._low
        numbers *= self._scale
        np.rint(numbers, out=numbers)
        if not math.isfinite(numbers.sum()):
            numbers = np.where(np.isnan(numbers) | np.isinf(numbers), self.level, numbers)
        return np.clip(numbers, 0.0, LEVELS, out=numbers)

    def distances(self, numbers: Whole) -> tuple[Whole, list[float]]:
        """How far readings (k, n) lie from the level: in whitened channels, (k, n) in `UNITS`, and d² of each."""
        away = (numbers - self.level) @ self._whiten
        away *= UNITS / FINE
        np.rint(away, out=away)
        np.clip(away, -FARTHEST, FARTHEST, out=away)
        return away, (np.einsum("ij,ij->i", away, away) / UNITS**2).tolist()

    def apart(self, away: Whole, distances: list[float]) -> tuple[float, float]:
        """Of some readings, in whitened channels: d² of their mean, and their own mean d² about it."""
        total, count = away.sum(axis=0), len(away)
        far = float(total @ total) / (count * UNITS) ** 2
        return far, (math.fsum(distances) / count - far) * count / (count - 1)

    def learn(self, numbers: Whole) -> None:
        """Begin with readings at rest, a whole number of blocks of them: what was learned before is gone."""
        steps = np.abs(np.diff(numbers, axis=0))
        step = np.where(steps > 0, steps, np.inf).min(axis=0)
        moving = step[np.isfinite(step)]
        step[~np.isfinite(step)] = np.median(moving) if len(moving) else LEVELS / 1024
        self._floor = np.maximum(np.square(step / 2), 1.0)
        self._scatter[:] = 0
        self._levels.clear()
        self._blocks, self._sum, self._squares = 0, 0.0, 0.0
        for first in range(0, len(numbers), self.block):
            self._take(numbers[first : first + self.block])
            self._blocks += 1
        self._solve(measured=0)
        self._due = 2 * self._blocks

    def follow(self, numbers: Whole, distances: list[float]) -> None:
        """Take in one more block of readings at rest, with their d²."""
        self._take(numbers)
        total = math.fsum(distances)
        self._blocks, self._sum, self._squares = self._blocks + 1, self._sum + total, self._squares + total**2
        if self._blocks >= self._due:
            measured = self._blocks - self.needed // self.block
            self._solve(measured)
            if self._blocks >= MOST_BLOCKS:
                self._scatter //= 2
                self._blocks, self._sum, self._squares = self._blocks // 2, self._sum / 2, self._squares / 2
            self._due = max(self._blocks + 4, self._blocks * 5 // 4)

    def resume(self, numbers: Whole) -> None:
        """Follow the level from readings after a contact: it may have moved. The noise stays as it was learned."""
        self._levels.clear()
        self._levels.append((numbers.sum(axis=0), len(numbers)))
        self._relevel()

    def _take(self, numbers: Whole) -> None:
        away = numbers - self.level
        total = away.sum(axis=0)
        # Whole numbers below 2⁵³ times 2: exact in whatever order.
        self._scatter += (len(numbers) * (away.T @ away) - np.outer(total, total)).astype(np.int64)
        self._levels.append((numbers.sum(axis=0), len(numbers)))
        self._relevel()

    def _relevel(self) -> None:
        count = sum(count for _, count in self._levels)
        self.level = np.floor(sum(total for total, _ in self._levels) / count + 0.5)

    def _solve(self, measured: int) -> None:
        """Whiten by the scatter as it is now, and set the thresholds by the d² of so many blocks."""
        block, channels = self.block, self.channels
        free = self._blocks * (block - 1)
        covariance = self._scatter / (free * block)
        variance = np.diagonal(covariance) + self._floor
        pulled = covariance * (free / (free + channels))
        pulled[np.diag_indices(channels)] = variance
        factor = np.linalg.cholesky(pulled)
        self._whiten = np.rint(np.linalg.inv(factor).T * FINE)
        usual, spread = float(channels), 2.0 * channels * block  # of d², and of its sum over a block
        count = measured + UNMEASURED
        self.mean = mean = (self._sum / block + UNMEASURED * usual) / count if measured else usual
        if measured:
            own = self._sum / measured
            among = max(self._squares / measured - own**2, 0.0)
            spread = (measured * among + UNMEASURED * 2 * spread) / count
        variance_of_one = max(spread / block, 1e-3 * mean**2)
        self.kappa = mean + APART * math.sqrt(variance_of_one)
        self.alarm = self._log_run / _rate(mean, variance_of_one, self.kappa)
        self.inner = mean + 5 * math.sqrt(variance_of_one / block)


def _rate(mean: float, variance: float, kappa: float) -> float:
    """θ > 0 with E exp(θ (d² − κ)) = 1, d² = c χ²_ν of this mean and variance: by halving, to 2⁻⁴⁰."""
    scale, freedom = variance / (2 * mean), 2 * mean**2 / variance
    low, high = 0.0, 1 / (2 * scale)
    for _ in range(40):
        middle = (low + high) / 2
        if -freedom / 2 * math.log1p(-2 * scale * middle) < middle * kappa:
            low = middle
        else:
            high = middle
    return low
