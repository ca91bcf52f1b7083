"""What `Kernels` is made of: banks of random convolution kernels, and triangle features of the channels' levels.

After MiniRocket (Dempster, Schmidt and Webb 2021, arXiv 2012.08791): nine taps, six of weight −1 and three of
weight 2, on sums of randomly chosen channels, dilated; a feature is the proportion of positions at which the
response exceeds a threshold. MiniRocket takes its thresholds from the training data, which would make a
memory depend on what came first; here they are quantiles of responses to simulated streams.

Weights and readings are small integers, so a response is an integer below 2²⁴ and float32 arithmetic is exact:
no thread count, batch, instruction set or machine changes a bit of it. It is numpy's, so that a
robot whose embedding is this one loads no torch.

Triangle features are random Fourier features (Rahimi and Recht 2007) with a triangle wave in the cosine's place, on
integers, and so exact too. They carry what proportions cannot see in a few readings, each channel's level, spread,
roughness and trend: with them the first 0.3 s of BioTac's touches are recognised in 87 %, without in 64 %.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations

import numpy as np
import numpy.typing as npt

__all__ = [
    "LEVELS",
    "MOST_CHANNELS",
    "PERIOD",
    "ROUND",
    "TAPS",
    "THRESHOLDS",
    "Bank",
    "TriangleFeatures",
    "bank",
    "bank_size",
    "to_levels",
    "triangle_features",
    "window_statistics",
    "workspace",
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
SIZE_OF_OTHERS = ROUND = 84  # each position of the three heavy taps once

# Those positions, in an order in which kernels that follow each other have them a place later: rows of a matrix that
# follow each other, read with one step more, are then added at once; see `Workspace`.
HEAVY = [(i, i + p, i + q) for q in range(2, TAPS) for p in range(1, q) for i in range(TAPS - q)]
TOGETHER = 2**18  # responses: so many stay in the processor's cache
MOST_STEPS = 64  # of dilations and lengths of images

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


Floats = npt.NDArray[np.float32]
Step = tuple[np.ufunc, Floats, Floats | float, Floats]  # what is done with two arrays, and where to


class Workspace(threading.local):
    """The arrays of a thread that every image is convolved in, and the steps of it.

    To get their pages from the system anew takes as long as to convolve, and to make views of them a tenth of it.
    """

    def __init__(self) -> None:
        self._arrays: dict[str, Floats] = {}
        self._steps: dict[tuple[int, int, int, int], tuple[list[Step], Floats]] = {}

    def array(self, name: str, rows: int, columns: int) -> Floats:
        """The array of a name, shape (rows, columns), of whatever values."""
        size = rows * columns
        if name not in self._arrays or len(self._arrays[name]) < size:
            self._arrays[name] = np.empty(size, dtype=np.float32)
            self._steps.clear()  # they keep those before
        return self._arrays[name][:size].reshape(rows, columns)

    def respond(self, rows: slice, readings: int, dilation: int) -> Floats:
        """Responses of whole rounds of kernels to sums of channels: the array "sums" has these, in so many rows.

        Exact integers of shape (rows, readings − 8·dilation): three times the heavy taps less the sum of all nine.
        The sums are lost, the responses stay until the next are made.
        """
        key = rows.start, rows.stop, readings, dilation
        if key not in self._steps:
            if len(self._steps) >= MOST_STEPS:
                self._steps.clear()
            self._steps[key] = self._planned(rows, readings, dilation)
        steps, responses = self._steps[key]
        for put, left, right, into in steps:
            put(left, right, into)
        return responses

    def _planned(self, rows: slice, readings: int, dilation: int) -> tuple[list[Step], Floats]:
        sums, count = self.array("sums", rows.stop, readings)[rows], rows.stop - rows.start
        responses = self.array("responses", count, readings + dilation)
        block = ROUND * max(1, TOGETHER // (ROUND * readings))
        first, second = (self.array(name, min(block, count), readings) for name in ("first", "second"))
        steps: list[Step] = []
        for i in range(0, count, block):
            some = slice(i, min(i + block, count))
            steps += _steps(sums[some], responses[some], first, second, dilation)
        return steps, responses[:, : readings - (TAPS - 1) * dilation]


workspace = Workspace()


@dataclass(frozen=True, eq=False)
class Bank:
    """The kernels of one dilation.

    dilation: readings between two taps.
    channels: 0 or 1, float32 of shape (rows, C): which channels a kernel sums. Rows come in rounds of 84, each with
        all positions of the heavy taps in the order of HEAVY; in the last round some may belong to no kernel.
    rows: the row of each kernel, shape (K,).
    thresholds: float32 of shape (THRESHOLDS, K), halves of odd integers, so that no response equals one.
    """

    dilation: int
    channels: Floats
    rows: npt.NDArray[np.intp]
    thresholds: Floats

    def __len__(self) -> int:
        return len(self.rows)


def _steps(sums: Floats, responses: Floats, first: Floats, second: Floats, dilation: int) -> Iterator[Step]:
    """How sums of channels become responses; two arrays like the sums are between."""
    (rows, readings), flat = sums.shape, sums.reshape(-1)
    one, two = first.reshape(-1), second.reshape(-1)
    # The sum of nine by doubling, of all rows as one: what runs over into the next lies behind the places of its own.
    size = len(flat) - dilation
    yield np.add, flat[:size], flat[dilation:], one[:size]
    size -= 2 * dilation
    yield np.add, one[:size], one[2 * dilation :][:size], two[:size]
    size -= 4 * dilation
    yield np.add, two[:size], two[4 * dilation :][:size], one[:size]
    size -= dilation
    yield np.add, one[:size], flat[8 * dilation :], one[:size]
    yield np.multiply, flat, 3.0, flat
    yield from _heavy_steps(flat, responses.reshape(-1), readings, dilation)
    places = readings - (TAPS - 1) * dilation
    own = responses[:, :places]
    yield np.subtract, own, first[:rows, :places], own


def _heavy_steps(sums: Floats, responses: Floats, readings: int, dilation: int) -> Iterator[Step]:
    """How the sums at the three heavy taps of each row are added; both flat, a row of sums as long as the readings.

    A row of responses is longer by the dilation: where the taps of the next row lie one place later, the rows of both
    are one run.
    """
    longer, row = readings + dilation, 0
    for outer in range(2, TAPS):  # places between the first tap and the last
        runs, each = outer - 1, TAPS - outer  # one for each place of the tap between; rows in each
        # The responses of the last row end the array: what lies behind them is left out.
        width = each * longer - (TAPS * dilation if each == 1 else 0)
        shape = len(responses) // (ROUND * longer), runs, width
        into = _runs(responses, row * longer, shape, (ROUND * longer, each * longer))
        taps = [
            _runs(sums, row * readings + tap * dilation, shape, (ROUND * readings, each * readings + later * dilation))
            for tap, later in ((0, 0), (1, 1), (outer, 0))
        ]
        yield np.add, taps[0], taps[1], into
        yield np.add, into, taps[2], into
        row += runs * each


def _runs(flat: Floats, first: int, shape: tuple[int, int, int], steps: tuple[int, int]) -> Floats:
    """A view of a flat array, of runs so many places apart."""
    size = flat.itemsize
    return np.ndarray(shape, np.float32, flat, first * size, (steps[0] * size, steps[1] * size, size))


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
