"""Banks of random convolution kernels, with thresholds that no data decides.

After MiniRocket (Dempster, Schmidt and Webb 2021, arXiv 2012.08791): nine taps, six of weight −1 and three of
weight 2, on sums of randomly chosen channels, dilated; a feature is the proportion of positions at which the
response exceeds a threshold. MiniRocket takes its thresholds from the training data, which would make a
memory depend on what came first; here they are quantiles of responses to simulated streams.

Weights and readings are small integers, so a response is an integer below 2²⁴ and float32 arithmetic is exact:
no thread count, batch, instruction set or machine changes a bit of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations

import numpy as np
import numpy.typing as npt
import torch

__all__ = ["LEVELS", "TAPS", "Bank", "bank", "bank_size", "to_levels"]

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
    for at, heavy in enumerate(combinations(range(TAPS), 3)):
        shapes[at, list(heavy)] = 2
    rounds = -(-count // len(shapes))
    order = np.concatenate([rng.permutation(len(shapes)) for _ in range(rounds)])
    taps: npt.NDArray[np.float32] = shapes[order[:count]]
    return taps


def _thresholds(rng: np.random.Generator, kernels: Bank, channels: int) -> torch.Tensor:
    streams = _simulated(channels, (TAPS - 1) * kernels.dilation + 128)
    count = len(kernels)
    # Quantiles in a golden-ratio sequence: any number of a kernel's thresholds, from the first on, is well spread.
    quantiles = (rng.random(count) + np.arange(THRESHOLDS)[:, None] * GOLDEN) % 1
    chosen = rng.integers(0, len(streams), size=(THRESHOLDS, count))
    thresholds = np.empty((THRESHOLDS, count), dtype=np.float32)
    for at, stream in enumerate(streams):  # one by one: the responses to all would fill ten times the memory
        responses = np.sort(kernels.respond(count, torch.from_numpy(stream)).numpy(), axis=-1)
        round_, kernel = np.nonzero(chosen == at)
        place = (quantiles[round_, kernel] * responses.shape[-1]).astype(np.int64)
        thresholds[round_, kernel] = responses[kernel, place] + np.float32(0.5)
    return torch.from_numpy(thresholds)


@lru_cache(maxsize=4)
def _simulated(channels: int, readings: int) -> list[npt.NDArray[np.float32]]:
    """Autoregressive noise of many amplitudes and offsets over the whole range, as integer levels.

    Amplitudes are log-uniform from 0.6 % to 50 % of half the range; channels differ and partly move together.
    """
    rng = np.random.default_rng([channels, readings])
    streams = []
    for _ in range(SIMULATED):
        noise = rng.standard_normal((channels, readings + 64))
        noise += rng.random() * rng.standard_normal(readings + 64)
        memory = rng.choice([0.0, 0.5, 0.9, 0.97, 0.99], size=channels)
        fresh = np.sqrt(1 - np.square(memory))
        for at in range(1, noise.shape[1]):
            noise[:, at] = memory * noise[:, at - 1] + fresh * noise[:, at]
        amplitude = 10.0 ** (rng.uniform(-2.2, -0.3) + rng.uniform(-0.5, 0.5, size=(channels, 1)))
        offset = rng.uniform(-1, 1, size=(channels, 1))
        streams.append(to_levels(np.clip(noise[:, 64:] * amplitude + offset, -1, 1)))
    return streams
