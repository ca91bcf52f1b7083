"""What `Kernels` is made of: banks of random convolution kernels, and triangle features of the channels' levels.

After MiniRocket (Dempster, Schmidt and Webb 2021, arXiv 2012.08791): nine taps, six of weight −1 and three of
weight 2, on sums of randomly chosen channels, dilated; a feature is the proportion of positions at which the
response exceeds a threshold. MiniRocket takes its thresholds from the training data, which would make a
memory depend on what came first; here they are quantiles of responses to simulated streams.

Weights and readings are small integers, so a response is an integer below 2²⁴ and float32 arithmetic is exact:
no thread count, batch, instruction set or machine changes a bit of it.

Triangle features are random Fourier features (Rahimi and Recht 2007) with a triangle wave in the cosine's place, on
integers, and so exact too. They carry what proportions cannot see in a few readings, each channel's level, spread,
roughness and trend: with them the first 0.3 s of BioTac's touches are recognised in 87 %, without in 64 %.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import torch

__all__ = [
    "LEVELS",
    "PERIOD",
    "TAPS",
    "Bank",
    "TriangleFeatures",
    "bank",
    "bank_size",
    "to_levels",
    "triangle_features",
    "window_statistics",
]

TAPS = 9
LEVELS = 2**11  # integer readings lie in ±2¹¹: finer than a 12-bit converter over the sensor's range
MOST_CHANNELS = 64  # to a kernel: 64 channels × Σ|w| = 12 × 2¹¹ < 2²⁴, so that responses are exact in float32
THRESHOLDS = 24  # kept for each kernel; the last are needed only where a single dilation fits a window

# Most kernels lie at the short dilations: they are the only ones that fit the shortest windows, and a sensor of
# many channels needs many different sums of them (RoboSkin, longest window, four seeds: 97.7 % with the small
# banks, 98.1 with the large; BioTac the same with both, at 0.7 of the time with the small).
FEW, MANY = {1: 378, 2: 168}, {1: 504, 2: 336}
MANY_CHANNELS = 32
SIZE_OF_OTHERS = 84  # each position of the three heavy taps once

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


@dataclass(frozen=True)
class Bank:
    """The kernels of one dilation.

    dilation: readings between two taps.
    channels: 0 or 1, float32 of shape (K, C): which channels a kernel sums.
    taps: −1 or 2, float32 of shape (9, K, 1): the weights along time.
    thresholds: float32 of shape (THRESHOLDS, K), halves of odd integers, so that no response equals one.
    """

    dilation: int
    channels: torch.Tensor
    taps: torch.Tensor
    thresholds: torch.Tensor

    def __len__(self) -> int:
        return len(self.channels)

    def respond(self, count: int, image: torch.Tensor) -> torch.Tensor:
        """Responses of the first `count` kernels to an integer image (C, T): exact integers (count, T − 8·dilation).

        Channels first, then taps: a fourteenth of the multiplications of one product with all 9·C weights.
        """
        import torch

        places = image.shape[1] - (TAPS - 1) * self.dilation
        if torch.get_float32_matmul_precision() == "highest":
            sums = self.channels[:count] @ image
        else:  # the caller's program allows shortened float32 products, which would round our integers
            sums = (self.channels[:count].double() @ image.double()).float()
        responses = self.taps[0, :count] * sums[:, :places]
        for tap in range(1, TAPS):
            first = tap * self.dilation
            responses.addcmul_(self.taps[tap, :count], sums[:, first : first + places])
        return responses


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
    import torch

    rng = np.random.default_rng([seed, channels, dilation])
    count = bank_size(channels, dilation)
    taps = _taps(rng, count)
    summed = np.zeros((count, channels), dtype=np.float32)
    most = min(channels, MOST_CHANNELS)
    for kernel in range(count):
        chosen = min(most, int((most + 1) ** rng.random()))
        summed[kernel, rng.permutation(channels)[:chosen]] = 1
    columns = torch.from_numpy(np.ascontiguousarray(taps.T[:, :, None]))
    without = Bank(dilation, torch.from_numpy(summed), columns, torch.empty(0))
    return replace(without, thresholds=_thresholds(rng, without, channels))


def _taps(rng: np.random.Generator, count: int) -> npt.NDArray[np.float32]:
    shapes = np.full((84, TAPS), -1, dtype=np.float32)
    for i, heavy in enumerate(combinations(range(TAPS), 3)):
        shapes[i, list(heavy)] = 2
    rounds = -(-count // len(shapes))
    order = np.concatenate([rng.permutation(len(shapes)) for _ in range(rounds)])
    taps: npt.NDArray[np.float32] = shapes[order[:count]]
    return taps


def _thresholds(rng: np.random.Generator, kernels: Bank, channels: int) -> torch.Tensor:
    import torch

    streams = _simulated(channels, (TAPS - 1) * kernels.dilation + 128)
    count = len(kernels)
    # Quantiles in a golden-ratio sequence: any number of a kernel's thresholds, from the first on, is well spread.
    quantiles = (rng.random(count) + np.arange(THRESHOLDS)[:, None] * GOLDEN) % 1
    chosen = rng.integers(0, len(streams), size=(THRESHOLDS, count))
    thresholds = np.empty((THRESHOLDS, count), dtype=np.float32)
    for i, stream in enumerate(streams):  # one by one: the responses to all would fill ten times the memory
        responses = np.sort(kernels.respond(count, torch.from_numpy(stream)).numpy(), axis=-1)
        round_, kernel = np.nonzero(chosen == i)
        place = (quantiles[round_, kernel] * responses.shape[-1]).astype(np.int64)
        thresholds[round_, kernel] = responses[kernel, place] + np.float32(0.5)
    return torch.from_numpy(thresholds)


@lru_cache(maxsize=4)
def _simulated(channels: int, readings: int) -> list[npt.NDArray[np.float32]]:
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
    levels = to_levels(np.clip(noise[:, 64:] * amplitude[:, None] + offset[:, None], -1, 1))
    return [np.ascontiguousarray(stream.T) for stream in levels]


@dataclass(frozen=True)
class TriangleFeatures:
    """weights: integers held as float64, shape (4·C, count); phases: likewise, shape (count,)."""

    weights: torch.Tensor
    phases: torch.Tensor

    def __call__(self, statistics: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
        """Features in [0, 1], shape (windows, count), of window statistics of shape (windows, 4·C)."""
        import torch

        # Below 2⁵³ throughout, so exact: |weights| < 2¹⁴, statistics < 2¹⁷, sixteen terms.
        # In torch: numpy's own threads beside torch's spin against each other on a robot's few cores.
        turned = torch.addmm(self.phases, torch.from_numpy(statistics), self.weights).remainder_(PERIOD)
        triangle = turned.sub_(PERIOD / 2).abs_().mul_(2 * STEPS / PERIOD).round_().div_(STEPS)
        return triangle.float().numpy()


@lru_cache(maxsize=16)
def triangle_features(seed: int, channels: int, count: int) -> TriangleFeatures:
    """Make `count` features for windows of `channels` channels; the same arguments give the same features."""
    import torch

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
    return TriangleFeatures(torch.from_numpy(np.ascontiguousarray(rounded)), torch.from_numpy(phases))


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
