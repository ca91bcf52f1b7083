"""What is left of a touch under heavy noise: how often and how far each channel rises above the noise.

Convolutions see little then (RoboSkin under uniform noise of half the range: 20 to 30 %). Averages over the whole touch
see more, and the edges of the noise most of all: the range ends the noise at the low end, and noise of bounded
amplitude never lifts a channel at rest beyond its edge, so that a single reading beyond it is evidence. So the noise's
edge is estimated from the touch itself, and each channel is described by how often it passes the edge by some margins,
by its highest readings, its mean, and how often it lies at the low end. Roots of frequencies have a spread that does
not depend on them. Each of these is turned by the edge into what it says of the reading beneath: noise spread evenly in
± e lets a reading s pass e with frequency s / 2e, and leaves it at the low end with (e − s) / 2e. So touches through
little noise and much are alike, and one set of statistics serves all amplitudes (RoboSkin 80 % with copies of 30 to
70 % of the range in it, 77 without the turning). The estimate is a function of the touch alone, and all arithmetic is
exact, as in `levels`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import torch

from scroll_tactile.embeddings.banks import LEVELS, to_levels
from scroll_tactile.embeddings.levels import PERIOD, TriangleFeatures

__all__ = ["SETS", "NoisyFeatures", "is_noisy", "noisy_features", "noisy_statistics"]

NOISY = 0.03  # of the range: the mean step between neighbours in the quieter channels of a noisy touch
QUIET_CHANNELS = 4  # a quarter of the channels: enough of them are at rest
MARGINS = (0.0, 0.02, 0.05, 0.1, 0.18, 0.28)  # of the range, above the noise's edge
MARGINS_OF_PARTS = (0.0, 0.05)
HIGHEST = (0, 1, 3, 7)  # places among a channel's readings, from the top, of a hundred
RANGE = 2 * LEVELS
UNIT = 2**11  # statistics are integers, in 1/UNIT of what they are a share of
# By how much each statistic is multiplied so that noise of half the range spreads all of them alike.
FREQUENCY, LOW, MEAN, TOP = 2, 2, 6, 3
MOST_TERMS = 64
PACE = 1.2  # how many spreads of the noise turn a feature by one radian
# Of each set: how many stretches of time where there is room for them, as for sensors of few channels; and the share
# of features that are the statistics themselves, at most.
SETS = ((4, 0.5), (20, 0.9))


def is_noisy(image: npt.NDArray[np.float32]) -> bool:
    """Whether a touch was felt through noise: a tactile image of shape (C, T) in [-1, 1].

    The mean step between neighbours, in the quarter of the channels where it is smallest, is compared to 3 % of the
    range: clean touches have 0.1 to 2.9 %, uniform noise of a tenth of the range makes 2.9 to 5.4 %.
    """
    if image.shape[1] < 2:
        return False
    steps = np.abs(np.diff(to_levels(image).astype(np.int64), axis=1)).sum(axis=1)
    quiet = int(np.sort(steps)[len(steps) // QUIET_CHANNELS])
    return bool(quiet > NOISY * 2 * LEVELS * (image.shape[1] - 1))


def noisy_statistics(image: npt.NDArray[np.float32], parts: int = 0) -> npt.NDArray[np.float64]:
    """Statistics of each channel about the noise's edge, shape (12 + 4 · parts, C), integers in ± 2¹⁵.

    image: shape (C, T) in [-1, 1]. The noise's edge is how far the highest reading lies above the middle one, in the
    quarter of the channels where that is least. parts: equal stretches of time that a third of the statistics are
    taken of, too.
    """
    above = to_levels(image).astype(np.int64) + LEVELS  # 0 to 2 · LEVELS, the range
    columns = above.shape[1]
    ordered = np.sort(above, axis=1)[:, ::-1]
    edge = int(np.sort(ordered[:, 0] - ordered[:, columns // 2])[len(above) // QUIET_CHANNELS])
    tops = [(ordered[:, place * columns // 100] - edge) * UNIT // RANGE * TOP for place in HIGHEST]
    rows = [*_frequencies(above, edge, MARGINS), *tops]
    for part in range(parts):
        first = min(part * columns // parts, columns - 1)
        stretch = above[:, first : max(first + 1, (part + 1) * columns // parts)]
        rows += _frequencies(stretch, edge, MARGINS_OF_PARTS)
    return np.stack(rows).astype(np.float64)


def _frequencies(above: npt.NDArray[np.int64], edge: int, margins: tuple[float, ...]) -> list[npt.NDArray[np.integer]]:
    """What is told of each channel's readings by how often it passes the edge by each margin, by how often it lies at
    the low end, and by its mean, as shares of the range: roots of the first."""
    columns = above.shape[1]
    passed = [_root(np.count_nonzero(above - edge > margin * RANGE, axis=1) * 2 * edge, columns) for margin in margins]
    low = (columns - 2 * np.count_nonzero(above == 0, axis=1)) * edge * UNIT // (RANGE * columns)
    mean = (4 * above.sum(axis=1) - edge * columns) * UNIT // (4 * RANGE * columns)
    return [*(one * FREQUENCY for one in passed), low * LOW, mean * MEAN]


def _root(sums: npt.NDArray[np.integer], columns: int) -> npt.NDArray[np.int64]:
    roots: npt.NDArray[np.int64] = np.floor(np.sqrt(sums / (RANGE * columns)) * UNIT).astype(np.int64)
    return roots


class NoisyFeatures:
    """`dimension` features of a noisy touch of C channels: statistics as they are, and triangle features of them.

    parts: stretches of time with statistics of their own, where they fit. linear: the largest share of the former.
    """

    def __init__(self, seed: int, channels: int, dimension: int, parts: int, linear: float) -> None:
        room = int(dimension * linear)
        whole, part = (len(MARGINS) + 2 + len(HIGHEST)) * channels, (len(MARGINS_OF_PARTS) + 2) * channels
        self.parts = parts if whole + parts * part <= room else 0
        inputs = whole + self.parts * part
        self.linear = min(inputs, room)
        self.triangles = _triangles(seed, inputs, dimension - self.linear)

    def __call__(self, images: Sequence[npt.NDArray[np.float32]]) -> npt.NDArray[np.float32]:
        """Features in [-1, 1], float32 of shape (N, dimension), of N ≥ 1 images of shape (C, T) in [-1, 1].

        Together, for the weights of the triangles are the larger part of what is read; the bits do not depend on it.
        """
        statistics = np.stack([noisy_statistics(image, self.parts).reshape(-1) for image in images])
        plain = (statistics[:, : self.linear] / (8 * UNIT)).astype(np.float32)
        return np.concatenate([plain, self.triangles(statistics)], axis=1)


@lru_cache(maxsize=16)
def noisy_features(seed: int, channels: int, dimension: int) -> list[NoisyFeatures]:
    """Make the sets of features for touches of `channels` channels; the same arguments give the same features."""
    return [NoisyFeatures(seed + at, channels, dimension, *one) for at, one in enumerate(SETS)]


def _triangles(seed: int, inputs: int, count: int) -> TriangleFeatures:
    rng = np.random.default_rng([seed, inputs, count, 2])
    weights = np.zeros((count, inputs))
    turn = PERIOD / (2 * np.pi * PACE * UNIT / 10)  # statistics are spread by about a tenth of UNIT
    for feature in range(count):
        terms = min(inputs, int(MOST_TERMS ** rng.random() * 2))
        weights[feature, rng.permutation(inputs)[:terms]] = rng.standard_normal(terms) * turn / np.sqrt(terms)
    rounded = np.clip(np.rint(weights.T), -(2.0**20), 2.0**20)
    phases = np.floor(rng.random(count) * PERIOD)
    return TriangleFeatures(torch.from_numpy(np.ascontiguousarray(rounded)), torch.from_numpy(phases))
