"""The sensor at rest: its level, its noise, and how far from it a reading may lie before something touches.

Readings are whole numbers of 2⁻¹⁶ of each channel's range; level and scatter are exact sums of them, block by block,
so that nothing depends on how the readings were dealt out to calls. A reading x lies

    d² = |(x − m) V|²,    V Vᵀ = Σ⁻¹,

from the level m, Σ the mean scatter within blocks of a quarter of a second, pulled to that of a usual channel as far as
there are channels for its readings, and beside it what a usual channel changes by from one reading to the next. V is
rounded, so that d² is an exact sum, too.

Noise is not normal, nor are readings independent: d² is taken to be c χ²_ν, with its mean as it was measured at rest,
and the larger of its variance and that of its sums over blocks. A sum of d² − κ that never falls below 0 passes h at a
rate of exp(−θ h) a reading, where E exp(θ (d² − κ)) = 1 (Page's CUSUM; Lorden 1971), so that h follows from how many
false contacts an hour may have.
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
LEARNED = 2.0  # seconds, and no fewer readings than twice the channels
FOLLOWED = 8  # blocks whose mean is the level
UNMEASURED = 8  # blocks that the noise as it should be counts for, beside what is measured
MOST_BLOCKS = 2**11  # then all sums are halved: noise changes in days
WIDER = 4.0  # times the variance of normal noise's d², that is assumed of it
MOST = 2.0  # times the mean d², that a block counts for
APART = 3.0  # standard deviations of d² that κ lies beyond its mean
LOUDER = 8.0  # times the median block's scatter, that no block of a rest has
JUMP = 64.0  # times what white noise would make of them, that blocks' means may scatter by: noise hums and drifts


class Rest:
    """What was learned of a sensor at rest. sensor: with channels. false_contacts: an hour that may be."""

    def __init__(self, sensor: Sensor, false_contacts: float) -> None:
        low, high = (np.broadcast_to(limit, sensor.shape).astype(np.float64) for limit in sensor.limits)
        self._low, self._scale = low, LEVELS / (high - low)
        self._log_run = math.log(max(2.0, sensor.rate * 3600 / false_contacts))
        self.channels = sensor.channels
        self.block = max(FEWEST, round(BLOCK * sensor.rate))
        least = max(round(LEARNED * sensor.rate), 2 * sensor.channels, 2 * self.block)  # one block has no scatter
        self.needed = -(-least // self.block) * self.block
        self.level: Whole = np.zeros(sensor.channels)
        self._levels: deque[tuple[Whole, int]] = deque(maxlen=FOLLOWED)
        self._scatter: npt.NDArray[np.int64] = np.zeros((sensor.channels, sensor.channels), np.int64)
        self._floor = 1.0
        self._whiten: Whole = np.empty((0, 0))
        self._blocks = self._due = self.measured = 0
        self._sum = self._squares = self._fourths = 0.0  # of d² over blocks, of its square over them and one by one
        self.mean = self.kappa = self.alarm = self.inner = self.near = math.inf

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

    def mean_and_scatter(self, away: Whole, distances: list[float]) -> tuple[float, float]:
        """Of some readings, in whitened channels: d² of their mean, and their own mean d² about it."""
        total, count = away.sum(axis=0), len(away)
        far = float(total @ total) / (count * UNITS) ** 2
        return far, (math.fsum(distances) / count - far) * count / (count - 1)

    def readings(self, numbers: Whole) -> npt.NDArray[np.float64]:
        """Whole numbers (k, n) as the readings that they stand for."""
        return self._low + numbers / self._scale

    def unrest(self, numbers: Whole) -> float:
        """How far from a rest readings are, a whole number of blocks of them; above 1 they are none.

        In a rest no block scatters many times as the median one does, and blocks' means lie where noise brings them;
        both fail where a touch begins or ends, not within one at a steady speed.
        """
        blocks = numbers.reshape(-1, self.block, self.channels)
        own = blocks.var(axis=1, ddof=1) + _floor(numbers)
        usual = np.median(own, axis=0)
        louder = float((own / usual).mean(axis=1).max())
        jump = float((self.block * blocks.mean(axis=1).var(axis=0, ddof=1) / usual).mean())
        return max(louder / LOUDER, jump / JUMP)

    def learn(self, numbers: Whole) -> None:
        """Begin with readings at rest, a whole number of blocks of them: what was learned before is gone."""
        self._floor = _floor(numbers)
        self._scatter[:] = 0
        self._levels.clear()
        self._blocks = self.measured = 0
        self._sum = self._squares = self._fourths = 0.0
        blocks = [numbers[first : first + self.block] for first in range(0, len(numbers), self.block)]
        half = -(-len(blocks) // 2)
        for block in blocks[:half]:
            self._take(block)
        self._solve()
        for block in blocks[half:]:  # by what the others say of it, and so as it will be measured
            self._measure(self.distances(block)[1])
            self._take(block)
        self._solve()
        self._due = 2 * self._blocks

    def follow(self, numbers: Whole, distances: list[float]) -> None:
        """Take in one more block of readings at rest, with their d²."""
        self._take(numbers)
        self._measure(distances)
        if self._blocks >= self._due:
            self._solve()
            if self._blocks >= MOST_BLOCKS:
                self._scatter //= 2
                self._blocks, self.measured = self._blocks // 2, self.measured // 2
                self._sum, self._squares, self._fourths = self._sum / 2, self._squares / 2, self._fourths / 2
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
        self._blocks += 1

    def _measure(self, distances: list[float]) -> None:
        """Note the d² of a block. A touch too light to be noticed must not make the next one harder to notice."""
        total = min(math.fsum(distances), MOST * self.mean * self.block)
        self.measured += 1
        self._sum, self._squares = self._sum + total, self._squares + total**2
        self._fourths += math.fsum(min(distance, self.alarm) ** 2 for distance in distances)

    def _relevel(self) -> None:
        count = sum(count for _, count in self._levels)
        self.level = np.floor(sum(total for total, _ in self._levels) / count + 0.5)

    def _solve(self) -> None:
        """Whiten by the scatter as it is now, and set the thresholds by the d² that were measured."""
        block, channels = self.block, self.channels
        free = self._blocks * (block - 1)
        covariance = self._scatter / (free * block)
        own = np.diagonal(covariance)
        part = channels / (free + channels)
        pulled = covariance * (1 - part)
        pulled[np.diag_indices(channels)] = own * (1 - part) + own.mean() * part + self._floor
        factor = np.linalg.cholesky(pulled)
        self._whiten = np.rint(np.linalg.inv(factor).T * FINE)
        mean, spread = float(channels), 2.0 * channels  # of d², where noise is normal
        if self.measured:
            count = self.measured + UNMEASURED
            of_block = self._sum / self.measured
            among = (self._squares / self.measured - of_block**2) / block
            alone = self._fourths / (self.measured * block) - (of_block / block) ** 2
            mean = (self._sum / block + UNMEASURED * mean) / count
            spread = (self.measured * max(among, alone) + UNMEASURED * WIDER * spread) / count
        spread = max(spread, 1e-3 * mean**2)
        self.mean, self.kappa = mean, mean + APART * math.sqrt(spread)
        self.alarm = self._log_run / _rate(mean, spread, self.kappa)
        self.inner, self.near = mean + 3 * math.sqrt(spread / block), mean / 2


def _floor(numbers: Whole) -> float:
    """The square of what a usual channel changes by from one reading to the next, where it changes."""
    steps = np.abs(np.diff(numbers, axis=0))
    moving = [float(np.median(column[column > 0])) for column in steps.T if column.any()]
    # Of the channels, not of each: one that hardly ever moves at rest is not known for it.
    return max(float(np.median(moving)) if moving else LEVELS / 1024, 1.0) ** 2


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
