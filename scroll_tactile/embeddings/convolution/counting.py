"""How often responses of a bank's kernels exceed their thresholds, and which of a group is greatest: whole numbers.

Counted by C where that was built (`native`), else by numpy; both give the same numbers. Competing kernels are Hydra's
(Dempster, Schmidt and Webb 2023, arXiv 2203.13652), with counts for both of its pools and with the kernels of `banks`
in place of Gaussian ones: a response is made once, and counted against a threshold and against the others of its group.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from scroll_tactile import native
from scroll_tactile.blas import one_thread
from scroll_tactile.embeddings.convolution.banks import LEVELS, MOST_CHANNELS
from scroll_tactile.embeddings.convolution.responses import HEAVY, ROUND, Bank, Floats, workspace

__all__ = [
    "GROUP",
    "CountRequest",
    "Counts",
    "Groups",
    "competing_counts",
    "competing_groups",
    "compiled_bank",
    "count",
    "count_by_c",
    "count_by_numpy",
]

GROUP = 8  # kernels that compete; four and sixteen were no better
WEIGHT = 64  # of a kernel of one channel: 64 channels · 12 · 2¹¹ · 64 / √64 < 2²⁴, exact in float32

Integers = npt.NDArray[np.integer]
Places = tuple[tuple[int, int], ...]  # of each window the first place of the convolution, and the one behind its last


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
    whole = np.ascontiguousarray(levels, np.int16)  # a stretched image comes in the other order
    return [_counted(whole, request) for request in requests]


def _counted(levels: npt.NDArray[np.int16], request: CountRequest) -> Counts:
    bank, (edges, spans), groups = compiled_bank(request.bank), _segments(request.windows), request.groups
    competing = 0 if groups is None else len(groups.members)
    counted = np.empty((len(spans), request.features), np.int32)
    contests = np.empty((2, competing, GROUP), np.int32)
    members, weights = (b"", b"") if groups is None else (groups.members, groups.weights)
    native.count(
        levels.shape[1], request.bank.dilation, request.features, levels, *bank, edges, spans, members, weights,
        counted, contests,
    )  # fmt: skip
    return Counts(counted, contests)


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
    banks = _banks(tuple(of.bank for of in requests), tuple(needed))
    readings, found = levels.shape[1], []
    with one_thread():
        np.matmul(banks.channels, levels, out=workspace.array("sums", len(banks.channels), readings))
        for of, rows in zip(requests, banks.rows, strict=True):
            responses = workspace.respond(rows, readings, of.bank.dilation)
            none = np.zeros((2, 0, GROUP), np.int64)
            competing = none if of.groups is None else competing_counts(responses, of.bank, of.groups)
            found.append(Counts(_exceeding(of, responses), competing))
    return found


@dataclass(frozen=True)
class Banks:
    """The channels of several banks below each other, for one product with an image, and the rows of each."""

    channels: Floats
    rows: list[slice]


@lru_cache(maxsize=16)  # of at most 0.3 MB each
def _banks(banks: tuple[Bank, ...], counts: tuple[int, ...]) -> Banks:
    """Of each dilation's bank the rounds that so many features need."""
    parts, rows, last = [], [], 0
    for part, count in zip(banks, counts, strict=True):
        parts.append(part.channels[: -(-min(count, len(part)) // ROUND) * ROUND])
        first, last = last, last + len(parts[-1])
        rows.append(slice(first, last))
    return Banks(np.concatenate(parts), rows)


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
    counted: Integers = (exceeded @ _pooling(responses.shape[1], request.windows)).T.astype(np.int64)
    return counted


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
