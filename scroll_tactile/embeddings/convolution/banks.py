"""What `Kernels` is made of: banks of random convolution kernels, and triangle features of the channels' levels.

After MiniRocket (Dempster, Schmidt and Webb 2021, arXiv 2012.08791): nine taps, six of weight −1 and three of
weight 2, on sums of randomly chosen channels, dilated; a feature is the proportion of positions at which the
response exceeds a threshold. MiniRocket takes its thresholds from the training data, which would make a
memory depend on what came first; here they are quantiles of responses to simulated streams.

Triangle features are random Fourier features (Rahimi and Recht 2007) with a triangle wave in the cosine's place, on
integers, and so exact too. They carry what proportions cannot see in a few readings, each channel's level, spread,
roughness and trend: with them the first 0.3 s of BioTac's touches are recognised in 87 %, without in 64 %.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.convolution.responses import HEAVY, ROUND, TAPS, Bank, Floats, workspace

__all__ = [
    "LEVELS",
    "MOST_CHANNELS",
    "PERIOD",
    "THRESHOLDS",
    "TriangleFeatures",
    "bank",
    "bank_size",
    "to_levels",
    "triangle_features",
    "window_statistics",
]

LEVELS = 2**11  # integer readings lie in ±2¹¹: finer than a 12-bit converter over the sensor's range
MOST_CHANNELS = 64  # to a kernel: 64 channels × Σ|w| = 12 × 2¹¹ < 2²⁴, so that responses are exact in float32
THRESHOLDS = 24  # kept for each kernel; the last are needed only where a single dilation fits a window

# Most kernels lie at the short dilations: they are the only ones that fit the shortest windows, and a sensor of
# many channels needs many different sums of them (RoboSkin, longest window, four seeds: 97.7 % with the small
# banks, 98.1 with the large; BioTac the same with both, at 0.7 of the time with the small).
FEW, MANY = {1: 378, 2: 168}, {1: 504, 2: 336}
MANY_CHANNELS = 32
SIZE_OF_OTHERS = ROUND

SIMULATED = 48  # streams for the thresholds
GOLDEN = (5**0.5 + 1) / 2

# Of triangle features:
STEPS = 64  # a feature takes the values 0, 1/64 … 1: enough, and a window's codes stay small on disk
STATISTICS = 4
FINE = 4  # statistics are kept to 2⁻⁴ of a level
PERIOD = 2**23  # of the triangle wave, in statistics × weights
WEIGHT = 2**8  # a weight of 1 turns half the sensor's range (2¹¹ levels · 2⁴) into one period
MOST_TERMS = 16
LOWEST, HIGHEST = 0.5, 8.0  # how many periods lie in half the range: from slow to fast, log-uniform


def bank_size(channels: int, dilation: int) -> int:
    """The number of kernels of a dilation, for images of `channels` rows."""
    return (MANY if channels > MANY_CHANNELS else FEW).get(dilation, SIZE_OF_OTHERS)


def to_levels(image: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
    """Round a tactile image in [-1, 1] to integers in ±LEVELS, held as float32; same shape."""
    levels: npt.NDArray[np.float32] = np.rint(image * np.float32(LEVELS)).astype(np.float32, copy=False)
    return levels


@lru_cache(maxsize=64)
def bank(seed: int, channels: int, dilation: int) -> Bank:
    """Make the bank of a dilation for images of `channels` rows; the same arguments give the same bank."""
    rng = np.random.default_rng([seed, channels, dilation])
    count = bank_size(channels, dilation)
    rows = _rows(rng, count)
    summed = np.zeros((-(-count // ROUND) * ROUND, channels), dtype=np.float32)
    most = min(channels, MOST_CHANNELS)
    for row in rows:
        chosen = min(most, int((most + 1) ** rng.random()))
        summed[row, rng.permutation(channels)[:chosen]] = 1
    without = Bank(dilation, summed, rows, np.empty((0, count), dtype=np.float32))
    return replace(without, thresholds=_thresholds(rng, without, channels))


def _rows(rng: np.random.Generator, count: int) -> npt.NDArray[np.intp]:
    """The row of each kernel: in each round of 84 all positions of the heavy taps, shuffled."""
    row = {heavy: i for i, heavy in enumerate(HEAVY)}
    rows = np.array([row[heavy] for heavy in combinations(range(TAPS), 3)], dtype=np.intp)
    rounds = -(-count // ROUND)
    return np.concatenate([ROUND * i + rows[rng.permutation(ROUND)] for i in range(rounds)])[:count]


def _thresholds(rng: np.random.Generator, kernels: Bank, channels: int) -> Floats:
    streams = _simulated(channels, (TAPS - 1) * kernels.dilation + 128)
    count = len(kernels)
    # Quantiles in a golden-ratio sequence: any number of a kernel's thresholds, from the first on, is well spread.
    quantiles = (rng.random(count) + np.arange(THRESHOLDS)[:, None] * GOLDEN) % 1
    chosen = rng.integers(0, SIMULATED, size=(THRESHOLDS, count))
    thresholds = np.empty((THRESHOLDS, count), dtype=np.float32)
    for i, stream in enumerate(streams):  # one by one: the responses to all would fill ten times the memory
        round_, kernel = np.nonzero(chosen == i)
        used, place_of = np.unique(kernel, return_inverse=True)
        np.matmul(kernels.channels, stream, out=workspace.array("sums", len(kernels.channels), stream.shape[1]))
        responses = workspace.respond(slice(0, len(kernels.channels)), stream.shape[1], kernels.dilation)
        responses = np.sort(responses[kernels.rows[used]], axis=-1)
        place = (quantiles[round_, kernel] * responses.shape[-1]).astype(np.int64)
        thresholds[round_, kernel] = responses[place_of, place] + np.float32(0.5)
    return thresholds


def _simulated(channels: int, readings: int) -> Iterator[Floats]:
    """Autoregressive noise of many amplitudes and offsets over the whole range, as integer levels.

    Amplitudes are log-uniform from 0.6 % to 50 % of half the range; channels differ and partly move together.
    """
    rng = np.random.default_rng([channels, readings])
    noise = np.empty((SIMULATED, readings + 64, channels))
    memory, amplitude, offset = (np.empty((SIMULATED, channels)) for _ in range(3))
    for i in range(SIMULATED):
        own = rng.standard_normal((channels, readings + 64))
        own += rng.random() * rng.standard_normal(readings + 64)
        noise[i] = own.T
        memory[i] = rng.choice([0.0, 0.5, 0.9, 0.97, 0.99], size=channels)
        amplitude[i] = 10.0 ** (rng.uniform(-2.2, -0.3) + rng.uniform(-0.5, 0.5, size=channels))
        offset[i] = rng.uniform(-1, 1, size=channels)
    fresh = np.sqrt(1 - np.square(memory))
    for column in range(1, noise.shape[1]):  # all streams at once: a quarter of a second before the first touch
        noise[:, column] = memory * noise[:, column - 1] + fresh * noise[:, column]
    noise = noise[:, 64:]
    noise *= amplitude[:, None]  # in place: one array more is 5 MB
    noise += offset[:, None]
    for stream in noise:
        yield np.ascontiguousarray(to_levels(np.clip(stream, -1, 1)).T)


@dataclass(frozen=True)
class TriangleFeatures:
    """weights: integers held as float64, shape (4·C, count); phases: likewise, shape (count,)."""

    weights: npt.NDArray[np.float64]
    phases: npt.NDArray[np.float64]

    def __call__(self, statistics: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
        """Features in [0, 1], shape (windows, count), of window statistics of shape (windows, 4·C)."""
        # Below 2⁵³ throughout, so exact: |weights| < 2¹⁴, statistics < 2¹⁷, sixteen terms.
        turned = (statistics @ self.weights + self.phases).astype(np.int64) % PERIOD
        triangle: npt.NDArray[np.float64] = np.rint(np.abs(turned - PERIOD / 2) * (2 * STEPS / PERIOD)) / STEPS
        return triangle.astype(np.float32)


@lru_cache(maxsize=16)
def triangle_features(seed: int, channels: int, count: int) -> TriangleFeatures:
    """Make `count` features for windows of `channels` channels; the same arguments give the same features."""
    rng = np.random.default_rng([seed, channels, count, 1])
    inputs = STATISTICS * channels
    weights = np.zeros((count, inputs))
    for feature in range(count):
        terms = min(inputs, int(2 ** (rng.random() * (np.log2(MOST_TERMS) + 1))))
        pace = np.exp(rng.uniform(np.log(LOWEST), np.log(HIGHEST)))
        weights[feature, rng.permutation(inputs)[:terms]] = rng.standard_normal(terms) * pace
    limit = 2.0**14 - 1
    rounded = np.clip(np.rint(weights.T * WEIGHT), -limit, limit)
    phases = np.floor(rng.random(count) * PERIOD)
    return TriangleFeatures(np.ascontiguousarray(rounded), phases)


def window_statistics(windows: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Level, spread, roughness and trend of each channel, as integers in 2⁻⁴ levels.

    windows: integers of shape (W, C, L). Returns shape (W, 4·C): mean; standard deviation; mean step between
    neighbours; mean of the last third less mean of the first. Sums of integers and IEEE's exactly rounded square
    root only, so the same on any machine.
    """
    values = windows.astype(np.float64)
    length = values.shape[-1]
    fine = 2.0**FINE
    total = values.sum(axis=-1)
    level = np.floor(total * fine / length)
    # Cauchy–Schwarz keeps this non-negative, and it is an exact integer.
    spread = np.sqrt(length * np.square(values).sum(axis=-1) - np.square(total))
    steps = np.abs(np.diff(values, axis=-1)).sum(axis=-1)
    third = max(1, length // 3)
    trend = values[..., -third:].sum(axis=-1) - values[..., :third].sum(axis=-1)
    return np.concatenate(
        [
            level,
            np.floor(spread * fine / length),
            np.floor(steps * fine / max(1, length - 1)),
            np.floor(trend * fine / third),
        ],
        axis=-1,
    )
