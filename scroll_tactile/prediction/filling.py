"""Dead channels: a channel that reads the low end throughout is filled in from the others.

Beside the features of its windows, a few readings of each touch are sampled. Their counts, sums and second moment are
kept like those of any scale, and are as exact. They give the mean μ and the covariance S of a reading over all
materials. Where the channels s of a touch are dead and the channels a alive, the conditional mean of a normal
distribution replaces the dead ones: x_s = μ_s + S_sa S_aa⁻¹ (x_a − μ_a).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.banks import LEVELS, to_levels
from scroll_tactile.signals.windows import CHANNELS
from scroll_tactile.statistics.grid import in_units
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["Filling", "sampled_readings"]

FloatArray = npt.NDArray[np.float64]

SAMPLED = 32  # readings of a touch: 800 touches give 25600 for the covariance of 60 channels
FLOOR = 1 / LEVELS**2  # of a channel's variance: less is rounding


def sampled_readings(image: npt.NDArray[np.float32], dimension: int) -> npt.NDArray[np.float32]:
    """At most 32 readings of a touch, evenly spread, float32 of shape (readings, dimension); zeros behind the channels.

    image: (C, T) in [-1, 1], C ≤ dimension.
    """
    columns = image.shape[1]
    count = min(SAMPLED, columns)
    places = np.arange(count) * (columns - 1) // max(1, count - 1)
    rows = np.zeros((count, dimension), dtype=np.float32)
    rows[:, : len(image)] = to_levels(image[:, places]).T / np.float32(LEVELS)
    return rows


@dataclass(frozen=True)
class Filling:
    """What fills in dead channels. mean: of a reading, in [-1, 1], shape (C,). covariance: shape (C, C)."""

    mean: FloatArray
    covariance: FloatArray

    @classmethod
    def of(cls, statistics: Statistics, channels: int, bound: float) -> Filling | None:
        """From the readings that a memory has sampled; None where there are none."""
        counts, sums = statistics.totals(CHANNELS)
        rows = int(counts.sum())
        if not rows:
            return None
        lower = np.tril_indices(channels)
        second = np.zeros((channels, channels))
        # The triangle is packed row by row: the channels' rows are its beginning.
        second[lower] = statistics.second(CHANNELS).packed()[: len(lower[0])] / rows
        second += np.tril(second, -1).T
        mean = sums.sum(axis=0)[:channels] / rows
        unit = float(in_units(np.ones(1), bound)[0])  # a reading of 1, in codes
        covariance = (second - np.outer(mean, mean)) / unit**2
        covariance[np.diag_indices(channels)] += FLOOR
        return cls(mean / unit, covariance)

    def fill(self, image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """The image with its dead channels filled in, shape (C, T) in [-1, 1]; itself where none or all are dead."""
        dead = (image == -1).all(axis=1)
        if not dead.any() or dead.all():
            return image
        alive = ~dead
        with one_thread():
            weights = np.linalg.solve(self.covariance[np.ix_(alive, alive)], self.covariance[np.ix_(alive, dead)])
            expected = self.mean[dead, None] + weights.T @ (image[alive] - self.mean[alive, None])
        filled = image.copy()
        filled[dead] = np.clip(expected, -1, 1)
        return filled
