"""What the default embedding counts: banks of random kernels, their responses to an image, and the counts of these.

After MiniRocket (Dempster, Schmidt and Webb 2021, arXiv 2012.08791): nine taps, six of weight −1 and three of
weight 2, on sums of randomly chosen channels, dilated; a feature is the proportion of positions at which the
response exceeds a threshold. MiniRocket takes its thresholds from the training data, which would make a
memory depend on what came first; here they are quantiles of responses to simulated streams.

Weights and readings are small integers, so a response is an integer below 2²⁴ and float32 arithmetic is exact:
no thread count, batch, instruction set or machine changes a bit of it. Responses are counted by C where that was built
(`native`), else by numpy's whole passes over all kernels; both give the same numbers.

Competing kernels are Hydra's (Dempster, Schmidt and Webb 2023, arXiv 2203.13652), with counts for both of its pools and
with the kernels of these banks in place of Gaussian ones: a response is made once, and counted against a threshold and
against the others of its group.

Triangle features are random Fourier features (Rahimi and Recht 2007) with a triangle wave in the cosine's place, on
integers, and so exact too. They carry what proportions cannot see in a few readings, each channel's level, spread,
roughness and trend: with them the first 0.3 s of BioTac's touches are recognised in 87 %, without in 64 %.
"""

from __future__ import annotations

import hashlib
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import accumulate, combinations, pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from scroll_tactile import native
from scroll_tactile.blas import one_thread
from scroll_tactile.embeddings.protocol import cache_folder

__all__ = [
    "GROUP",
    "LEVELS",
    "MOST_CHANNELS",
    "PERIOD",
    "ROUND",
    "TAPS",
    "THRESHOLDS",
    "Bank",
    "CountRequest",
    "Counts",
    "Groups",
    "TriangleFeatures",
    "bank",
    "bank_size",
    "competing_groups",
    "compiled_bank",
    "count",
    "to_levels",
    "triangle_features",
    "window_statistics",
]

TAPS = 9
ROUND = 84  # each position of the three heavy taps once

# Those positions, in an order in which kernels that follow each other have them a place later: rows of a matrix that
# follow each other, read with one step more, are then added at once; see `_add_heavy`.
HEAVY = [(i, i + p, i + q) for q in range(2, TAPS) for p in range(1, q) for i in range(TAPS - q)]
TOGETHER = 2**18  # responses: so many stay in the processor's cache

Floats = npt.NDArray[np.float32]

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
MADE = 1  # in the names of kept thresholds: of how they are made
DIGEST_BYTES = 32
SHIPPED = Path(__file__).with_name("banks.npz")
GOLDEN = (5**0.5 + 1) / 2

# Of triangle features:
STEPS = 64  # a feature takes the values 0, 1/64 … 1: enough, and a window's codes stay small on disk
STATISTICS = 4
FINE = 4  # statistics are kept to 2⁻⁴ of a level
PERIOD = 2**23  # of the triangle wave, in statistics × weights
LEVEL_WEIGHT = 2**8  # a weight of 1 turns half the sensor's range (2¹¹ levels · 2⁴) into one period
MOST_TERMS = 16
LOWEST, HIGHEST = 0.5, 8.0  # how many periods lie in half the range: from slow to fast, log-uniform

GROUP = 8  # kernels that compete; four and sixteen were no better
WEIGHT = 64  # of a kernel of one channel: 64 channels · 12 · 2¹¹ · 64 / √64 < 2²⁴, exact in float32

Integers = npt.NDArray[np.integer]
Places = tuple[tuple[int, int], ...]  # of each window the first place of the convolution, and the one behind its last


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


class Workspace(threading.local):
    """The arrays of a thread that every image is convolved in: to get their pages anew takes as long as to convolve."""

    def __init__(self) -> None:
        self._arrays: dict[str, Floats] = {}

    def array(self, name: str, rows: int, columns: int) -> Floats:
        """The array of a name, shape (rows, columns), of whatever values."""
        size = rows * columns
        if name not in self._arrays or len(self._arrays[name]) < size:
            self._arrays[name] = np.empty(size, dtype=np.float32)
        return self._arrays[name][:size].reshape(rows, columns)


workspace = Workspace()


def _respond(sums: Floats, dilation: int) -> Floats:
    """Responses of whole rounds of kernels to sums of channels, (rows, readings).

    Exact integers of shape (rows, readings − 8·dilation): three times the heavy taps less the sum of all nine.
    The sums are lost, the responses stay until the next are made.
    """
    count, readings = sums.shape
    responses = workspace.array("responses", count, readings + dilation)
    block, places = ROUND * max(1, TOGETHER // (ROUND * readings)), readings - (TAPS - 1) * dilation
    for i in range(0, count, block):
        some, own = sums[i : i + block], responses[i : i + block]
        nine = _nine(some, dilation)
        np.multiply(some, 3.0, some)
        _add_heavy(some.reshape(-1), own.reshape(-1), readings, dilation)
        np.subtract(own[:, :places], nine[:, :places], own[:, :places])
    return responses[:, :places]


def _nine(sums: Floats, dilation: int) -> Floats:
    """The sum of nine taps by doubling, of all rows as one: what runs over into the next lies behind its own places."""
    flat, nine = sums.reshape(-1), workspace.array("first", *sums.shape)
    one, two = nine.reshape(-1), workspace.array("second", *sums.shape).reshape(-1)
    size = len(flat) - dilation
    np.add(flat[:size], flat[dilation:], one[:size])
    size -= 2 * dilation
    np.add(one[:size], one[2 * dilation :][:size], two[:size])
    size -= 4 * dilation
    np.add(two[:size], two[4 * dilation :][:size], one[:size])
    size -= dilation
    np.add(one[:size], flat[8 * dilation :], one[:size])
    return nine


def _add_heavy(sums: Floats, responses: Floats, readings: int, dilation: int) -> None:
    """Add the sums at the three heavy taps of each row; both flat, a row of sums as long as the readings.

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
        np.add(taps[0], taps[1], into)
        np.add(into, taps[2], into)
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
    return np.asarray(np.rint(image * np.float32(LEVELS)), dtype=np.float32)


@lru_cache(maxsize=64)
def bank(seed: int, channels: int, dilation: int) -> Bank:
    """The bank of a dilation for images of `channels` rows; the same arguments give the same bank.

    Its thresholds, half a second's work for all dilations of a touch, come with the package for the sensors that do
    (`banks.npz`, which tests/embeddings/test_banks.py writes); those of others are kept in the user's cache.
    """
    rng = np.random.default_rng([seed, channels, dilation])
    count = bank_size(channels, dilation)
    # In each round of 84 all positions of the heavy taps, shuffled.
    row = {heavy: i for i, heavy in enumerate(HEAVY)}
    places = np.array([row[heavy] for heavy in combinations(range(TAPS), 3)], dtype=np.intp)
    rounds = -(-count // ROUND)
    rows = np.concatenate([ROUND * i + places[rng.permutation(ROUND)] for i in range(rounds)])[:count]
    summed = np.zeros((rounds * ROUND, channels), dtype=np.float32)
    most = min(channels, MOST_CHANNELS)
    for row in rows:
        chosen = min(most, int((most + 1) ** rng.random()))
        summed[row, rng.permutation(channels)[:chosen]] = 1
    without = Bank(dilation, summed, rows, np.empty((0, count), dtype=np.float32))
    name = f"{MADE}-{seed}-{channels}-{dilation}"
    kept = _shipped_thresholds(name)
    if kept is None:
        kept = _kept_thresholds(name, (THRESHOLDS, count))
    if kept is None:
        kept = _thresholds(rng, without, channels)
        _keep(name, kept)
    return replace(without, thresholds=kept)


def _shipped_thresholds(name: str) -> Floats | None:
    """The thresholds that come with the package; a response is whole, so they lie halfway between whole numbers."""
    with np.load(SHIPPED) as shipped:
        return shipped[name].astype(np.float32) + np.float32(0.5) if name in shipped else None


def _kept_thresholds(name: str, shape: tuple[int, int]) -> Floats | None:
    """The thresholds of a file of the cache; None where it is missing or damaged."""
    try:
        data = (cache_folder("banks") / name).read_bytes()
    except (OSError, RuntimeError):
        return None
    digest, kept = data[:DIGEST_BYTES], data[DIGEST_BYTES:]
    whole = hashlib.sha256(kept).digest() == digest and len(kept) == 4 * shape[0] * shape[1]
    return np.frombuffer(kept, "<f4").astype(np.float32).reshape(shape) if whole else None


def _keep(name: str, thresholds: Floats) -> None:
    """Write a file of the cache, whole or not at all; where there is no room for it, none."""
    kept = thresholds.astype("<f4").tobytes()
    with suppress(OSError, RuntimeError):
        path = cache_folder("banks") / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as draft:
            draft.write(hashlib.sha256(kept).digest() + kept)
        Path(draft.name).replace(path)


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
        sums = np.matmul(kernels.channels, stream, out=workspace.array("sums", len(kernels.channels), stream.shape[1]))
        responses = np.sort(_respond(sums, kernels.dilation)[kernels.rows[used]], axis=-1)
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
    rounded = np.clip(np.rint(weights.T * LEVEL_WEIGHT), -limit, limit)
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


@dataclass(frozen=True, eq=False)
class Groups:
    """Groups of one bank's kernels that compete.

    members: the kernels of each, shape (G, GROUP). weights: integers by which the responses of kernels that sum more
    channels become comparable, same shape.
    """

    members: npt.NDArray[np.uint16]
    weights: npt.NDArray[np.uint8]


@dataclass(frozen=True)
class CountRequest:
    """What is counted of one bank's responses to an image: so many features in some windows, and groups, or none."""

    bank: Bank
    features: int
    windows: Places
    groups: Groups | None


@dataclass(frozen=True)
class Counts:
    """What a `CountRequest` asks for.

    features: how often each threshold is exceeded in each window, shape (windows, features). competing: at how many
    places each kernel of a group has the greatest response above 0, and the least below 0, shape (2, G, GROUP); kernels
    that share a place both have it.
    """

    features: Integers
    competing: Integers


def count(levels: Floats, requests: Sequence[CountRequest]) -> list[Counts]:
    """Count, in the responses to an image of whole numbers in ±LEVELS, float32 of shape (C, T), one bank at a time."""
    if not native.available or not (np.abs(levels) <= LEVELS).all() or not _agrees():
        return count_by_numpy(levels, requests)
    return count_by_c(levels, requests)


@lru_cache(maxsize=64)
def competing_groups(bank: Bank, count: int) -> Groups:
    """So many groups of a bank's kernels, in its order, which is random; where all have competed, in another."""
    rng, size = np.random.default_rng([bank.dilation, len(bank)]), len(bank)
    rounds = [np.arange(size), *(rng.permutation(size) for _ in range(GROUP * count // size))]
    members = np.concatenate(rounds)[: GROUP * count].reshape(count, GROUP)
    weights = np.rint(WEIGHT / np.sqrt(bank.channels[bank.rows[members]].sum(axis=2)))
    return Groups(members.astype(np.uint16), weights.astype(np.uint8))


def count_by_c(levels: Floats, requests: Sequence[CountRequest]) -> list[Counts]:
    """What `count` gives, by the compiled module. Raises ValueError for requests that do not fit the image."""
    whole, found = np.ascontiguousarray(levels, np.int16), []  # a stretched image comes in the other order
    for of in requests:
        edges, spans = _segments(of.windows)
        members, weights = (b"", b"") if of.groups is None else (of.groups.members, of.groups.weights)
        counted = np.empty((len(spans), of.features), np.int32)
        contests = np.empty((2, len(members), GROUP), np.int32)
        native.count(
            whole.shape[1], of.bank.dilation, of.features, whole, *compiled_bank(of.bank), edges, spans, members,
            weights, counted, contests,
        )  # fmt: skip
        found.append(Counts(counted, contests))
    return found


@lru_cache(maxsize=64)
def compiled_bank(bank: Bank) -> tuple[Integers, ...]:
    """A bank as C reads it: see `tactile_bank` in kernels.h."""
    summed = bank.channels[bank.rows] != 0
    begins = np.concatenate([[0], np.cumsum(summed.sum(axis=1))])
    heavy = np.array(HEAVY)[bank.rows % ROUND]
    # Halves of odd integers: a whole number exceeds one if it exceeds the whole number below.
    limit = np.iinfo(np.int32).max
    thresholds = np.clip(np.floor(bank.thresholds), -limit, limit)
    kinds = (np.uint8, np.uint16, np.uint16, np.int32)
    arrays = (heavy, begins, np.nonzero(summed)[1], thresholds)
    return tuple(np.ascontiguousarray(array, kind) for array, kind in zip(arrays, kinds, strict=True))


@lru_cache(maxsize=256)
def _segments(windows: Places) -> tuple[Integers, Integers]:
    """Where windows cut the places, ascending, and of each the first piece and the one behind its last."""
    edges = sorted({0, *(place for window in windows for place in window)})
    spans = [[edges.index(first), edges.index(last)] for first, last in windows]
    return np.array(edges, np.int32), np.array(spans, np.int32).reshape(-1, 2)


@lru_cache(maxsize=1)
def _agrees() -> bool:
    """Whether the compiled module gives numpy's numbers where a wrong one would not: asked once, in milliseconds.

    Many channels in the other memory order, several dilations, windows that overlap, a second threshold of each kernel,
    groups that compete in a second order.
    """
    rng = np.random.default_rng(0)
    levels = rng.integers(-LEVELS, LEVELS + 1, (150, 70)).T.astype(np.float32)
    requests = []
    for dilation in (1, 4, 16):
        channels = (rng.random((ROUND, 70)) < rng.random((ROUND, 1))).astype(np.float32)
        channels[:, 0], channels[:, MOST_CHANNELS:] = 1, 0
        thresholds = rng.integers(-4000, 4000, (2, ROUND)) + np.float32(0.5)
        made = Bank(dilation, channels, rng.permutation(ROUND), thresholds.astype(np.float32))
        requests.append(CountRequest(made, ROUND + 9, ((0, 20), (7, 22), (0, 22)), competing_groups(made, 11)))
    by_c, by_numpy = count_by_c(levels, requests), count_by_numpy(levels, requests)
    return all(
        np.array_equal(ours.features, theirs.features) and np.array_equal(ours.competing, theirs.competing)
        for ours, theirs in zip(by_c, by_numpy, strict=True)
    )


def count_by_numpy(levels: Floats, requests: Sequence[CountRequest]) -> list[Counts]:
    """What `count` gives, without a compiled module: the channels of all banks are summed in one product."""
    needed = (max(of.features, 0 if of.groups is None else of.groups.members.size) for of in requests)
    channels, rows = _banks(tuple(of.bank for of in requests), tuple(needed))
    found = []
    with one_thread():
        sums = np.matmul(channels, levels, out=workspace.array("sums", len(channels), levels.shape[1]))
        for of, own in zip(requests, rows, strict=True):
            responses = _respond(sums[own], of.bank.dilation)
            none = np.zeros((2, 0, GROUP), np.int64)
            competing = none if of.groups is None else competing_counts(responses, of.bank, of.groups)
            found.append(Counts(_exceeding(of, responses), competing))
    return found


@lru_cache(maxsize=16)  # of at most 0.3 MB each
def _banks(banks: tuple[Bank, ...], counts: tuple[int, ...]) -> tuple[Floats, list[slice]]:
    """The channels of the rounds that so many features of each bank need, below each other, and the rows of each."""
    parts = [
        part.channels[: -(-min(count, len(part)) // ROUND) * ROUND] for part, count in zip(banks, counts, strict=True)
    ]
    edges = accumulate((len(part) for part in parts), initial=0)
    rows = [slice(first, last) for first, last in pairwise(edges)]
    return np.concatenate(parts), rows


def _exceeding(request: CountRequest, responses: Floats) -> Integers:
    """How often each feature's threshold is exceeded in each window, of responses of shape (rows, places)."""
    kernels, count = request.bank, request.features
    if not count:
        return np.zeros((len(request.windows), 0), np.int64)
    exceeded = workspace.array("second", count, responses.shape[1])  # the responses are made
    for first in range(0, count, len(kernels)):
        size = min(len(kernels), count - first)
        thresholds = kernels.thresholds[first // len(kernels), :size, None]
        np.copyto(exceeded[first : first + size], responses[kernels.rows[:size]] > thresholds)
    return np.asarray((exceeded @ _pooling(responses.shape[1], request.windows)).T, np.int64)


@lru_cache(maxsize=16)  # of at most 1 MB each
def _pooling(places: int, windows: Places) -> Floats:
    """0/1 matrix of shape (places, windows): which places of the convolution lie within a window."""
    place = np.arange(places)
    return np.stack([(place >= first) & (place < last) for first, last in windows], axis=1).astype(np.float32)


def competing_counts(responses: Floats, bank: Bank, of: Groups) -> Integers:
    """How often each kernel of a group responds most, and least; see `Counts`. responses: shape (rows, places)."""
    competing = responses[bank.rows[of.members.T]] * of.weights.T[:, :, None].astype(np.float32)
    most, least = competing.max(axis=0), competing.min(axis=0)
    most[most <= 0] = least[least >= 0] = np.inf  # no response is
    found = [np.bitwise_count(np.packbits(competing == best, axis=2)).sum(axis=2) for best in (most, least)]
    return np.stack(found).transpose(0, 2, 1).astype(np.int64)
