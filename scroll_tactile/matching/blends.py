"""Levels between those that were read: between the columns of a touch, over blocks of it, and among several touches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.likelihood import LEVELS, MISSING, LevelArray

__all__ = ["at_places", "blends", "block_means", "unchanging", "weighted_means"]

FloatArray = npt.NDArray[np.float64]


def at_places(
    levels: LevelArray, places: npt.NDArray[np.floating], precision: npt.DTypeLike = np.float64
) -> LevelArray:
    """Levels (…, T) at places between 0 and T − 1, by linear interpolation; MISSING where a neighbour is.

    precision: of the blends before they are rounded to levels. `signals.views.stretched` is another function: an image
    is no level and lacks no value, and its weights are ratios of integers, the same bits on every machine.
    """
    first = places.astype(np.intp)
    part: npt.NDArray[np.floating] = (places - first).astype(precision)
    low, high = levels[..., first], levels[..., np.minimum(first + 1, levels.shape[-1] - 1)]
    blended = np.rint(low * (1 - part) + high * part).astype(np.uint8)
    return np.where((low == MISSING) | (high == MISSING), np.uint8(MISSING), blended)


def unchanging(levels: LevelArray) -> npt.NDArray[np.bool_]:
    """The channels of a touch that read one level throughout, or nothing, (C,)."""
    read = levels != MISSING
    highest, lowest = np.where(read, levels, 0).max(axis=1), np.where(read, levels, LEVELS).min(axis=1)
    return np.asarray(highest <= lowest)


def block_means(levels: LevelArray, edges: npt.NDArray[np.intp]) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Means of the blocks of a touch between edges, (C, B), 0 where nothing was read; and whether anything was.

    A touch may end before the last edge.
    """
    seen, first = levels != MISSING, edges[:-1][edges[:-1] < levels.shape[1]]
    sums, counts = np.zeros((2, len(levels), len(edges) - 1), dtype=np.int64)
    np.add.reduceat(np.where(seen, levels, 0), first, axis=1, dtype=np.int64, out=sums[:, : len(first)])
    np.add.reduceat(seen, first, axis=1, dtype=np.int64, out=counts[:, : len(first)])
    return sums / np.maximum(counts, 1), counts > 0


def blends(levels: LevelArray, logs: FloatArray, warmths: Sequence[float]) -> LevelArray:
    """Weighted means of touches (n, C · T) of some log-likelihoods (n,), one for each warmth, (warmths, C · T).

    warmths: how steeply the weight of a touch falls with its log-likelihood.
    """
    means = weighted_means(levels, np.exp(np.outer(warmths, logs - logs.max())))
    return np.asarray(np.where(np.isnan(means), MISSING, np.rint(means)), dtype=np.uint8)


def weighted_means(levels: LevelArray, weights: FloatArray) -> npt.NDArray[np.floating]:
    """Means of touches (n, C · T) by weights (means, n); NaN where no touch has a value."""
    single, known = weights.astype(np.float32), levels != MISSING
    if known.all():
        return np.asarray((single / single.sum(axis=1, keepdims=True)) @ levels.astype(np.float32))
    total = single @ known.astype(np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(total > 0, single @ (levels * known).astype(np.float32) / total, np.nan))
