"""What a touch is compared with kept ones by, in whole numbers: sums of log-likelihoods, and distances.

By C where that was built and gives numpy's numbers (`native`), else by numpy.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from scroll_tactile import native
from scroll_tactile.matching.likelihood import MISSING, LevelArray

__all__ = ["QUARTERS", "compiled", "log_sums", "mean_distances"]

AT_ONCE = 128  # kept touches whose means are multiplied at once: more leave the processor's cache
QUARTERS = 4  # steps of a guess in one level
MOST_GUESS = 2048  # steps: C takes guesses of ± so many

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Guesses = npt.NDArray[np.int16]
Known = npt.NDArray[np.bool_]


def compiled() -> bool:
    """Whether C is to compare: it was built, and gives numpy's numbers where a wrong one would not."""
    return native.available and _agrees()


def log_sums(own: LevelArray, others: LevelArray, logs: npt.NDArray[np.int16]) -> IntArray:
    """Sums of `Table.logs`, (others,), over the values of a touch (values,) beside each of others (others, values)."""
    return (_log_sums_by_c if compiled() else _log_sums_by_numpy)(own, others, logs)


def _log_sums_by_c(own: LevelArray, others: LevelArray, logs: npt.NDArray[np.int16]) -> IntArray:
    sums = np.empty(len(others), np.int64)
    native.sum_logs(np.ascontiguousarray(own), np.ascontiguousarray(others), logs, sums)
    return sums


def _log_sums_by_numpy(own: LevelArray, others: LevelArray, logs: npt.NDArray[np.int16]) -> IntArray:
    return np.asarray(logs.take((own.astype(np.intp) << 8) | others).sum(axis=1, dtype=np.int64))


def mean_distances(rows: LevelArray, guesses: Guesses, known: Known) -> FloatArray:
    """Mean squared distances of rows of levels (rows, blocks) from guesses in quarters, (rows, guesses).

    Over the blocks that a row has and that are known, (blocks,); the largest float where there is none.
    """
    sums, seen = (_distances_by_c if compiled() and len(rows) else _distances_by_numpy)(rows, guesses, known)
    return np.where(seen[:, None] > 0, sums / np.maximum(seen, 1)[:, None], np.finfo(np.float64).max)


def _distances_by_c(rows: LevelArray, guesses: Guesses, known: Known) -> tuple[IntArray, IntArray]:
    """Squared distances, (rows, guesses), and over how many blocks, (rows,)."""
    sums, seen = np.empty((len(rows), len(guesses)), np.int64), np.empty(len(rows), np.int64)
    native.distances(np.ascontiguousarray(rows), np.ascontiguousarray(guesses), known, sums, seen)
    return sums, seen


def _distances_by_numpy(rows: LevelArray, guesses: Guesses, known: Known) -> tuple[IntArray, IntArray]:
    sums, seen = np.empty((len(rows), len(guesses)), np.int64), np.empty(len(rows), np.int64)
    exact = guesses.astype(np.float64)
    for first in range(0, len(rows), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        both = (rows[part] != MISSING) & known
        quarters = np.where(both, QUARTERS * rows[part].astype(np.float64), 0.0)
        square = np.square(quarters).sum(axis=1)[:, None] + both @ np.square(exact).T
        sums[part], seen[part] = square - 2 * (quarters @ exact.T), both.sum(axis=1)
    return sums, seen


@lru_cache(maxsize=1)
def _agrees() -> bool:
    """Whether C gives numpy's numbers: of extreme entries and guesses, missing levels, unknown blocks; asked once."""
    rng = np.random.default_rng(0)
    levels = rng.choice([0, 1, 100, MISSING - 1, MISSING], (6, 301)).astype(np.uint8)
    logs = rng.integers(-(2**15), 2**15, 256 * 256).astype(np.int16)
    guesses = rng.choice([-MOST_GUESS, -1, 4, MOST_GUESS], (3, 301)).astype(np.int16)
    known = rng.random(301) < 0.8
    by_c = _log_sums_by_c(levels[0], levels, logs), *_distances_by_c(levels, guesses, known)
    by_numpy = _log_sums_by_numpy(levels[0], levels, logs), *_distances_by_numpy(levels, guesses, known)
    return all(np.array_equal(one, other) for one, other in zip(by_c, by_numpy, strict=True))
