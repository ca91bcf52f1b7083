"""All materials in single precision: finds the few among which exact scores decide.

Of ten thousand materials the means take 40 MB a scale so, and a touch is compared with all of them in a millisecond.
Each score comes with a bound of its error; whoever asks takes all that the bounds do not exclude, and the answer is
that of exact scores alone.
"""

from __future__ import annotations

import copy

import numpy as np
import numpy.typing as npt

__all__ = ["Coarse"]

FloatArray = npt.NDArray[np.float64]

UNIT = 2.0**-24  # of a rounding in single precision


class Coarse:
    """The materials of one readout, by place.

    means: about the origin, in float32, shape (C, d). sizes: m_yᵀ K⁻¹ m_y, shape (C,).
    """

    def __init__(self, means: npt.NDArray[np.float32], sizes: FloatArray) -> None:
        self._means, self._sizes = means, sizes
        self._lengths = _lengths(means)
        self._slack = np.zeros(len(sizes))

    def copy(self) -> Coarse:
        """Another of the same materials: what is put there is not put here."""
        other = copy.copy(self)
        other._means, other._sizes = self._means.copy(), self._sizes.copy()
        other._lengths, other._slack = self._lengths.copy(), self._slack.copy()
        return other

    def put(self, place: int, mean: FloatArray, size: float) -> None:
        """The material at a place has another mean, or is new there."""
        if place == len(self._sizes):
            room = np.zeros((1, self._means.shape[1]), np.float32)
            self._means = np.concatenate([self._means, room])
            self._sizes, self._slack, self._lengths = (
                np.append(array, 0.0) for array in (self._sizes, self._slack, self._lengths)
            )
        self._means[place] = mean
        self._sizes[place], self._slack[place] = size, 0.0
        self._lengths[place] = _lengths(self._means[place : place + 1])[0]

    def border(self, columns: FloatArray, corner: FloatArray) -> None:
        """K⁻¹ has lost columnsᵀ corner columns, of shapes (k, d) and (k, k)."""
        onto = (self._means @ columns.astype(np.float32).T).astype(np.float64)
        error = self._error(columns).T
        self._sizes -= ((onto @ corner) * onto).sum(axis=1)
        weights = np.abs(corner).sum(axis=1)
        self._slack += (2 * np.abs(onto) + error) * error @ weights

    def scores(self, solved: FloatArray) -> tuple[FloatArray, FloatArray]:
        """m_yᵀ K⁻¹ x less half of the size, of K⁻¹ x of shape (d,), and a bound of the error, each of shape (C,)."""
        z = (self._means @ solved.astype(np.float32)).astype(np.float64)
        return z - self._sizes / 2, self._error(solved[None])[0] + self._slack / 2

    def _error(self, vectors: FloatArray) -> FloatArray:
        """How far products with vectors (k, d) may be off, shape (k, C): both are rounded, and their sum is."""
        lengths = np.sqrt(np.square(vectors).sum(axis=1))
        return np.asarray((vectors.shape[1] + 3) * UNIT * lengths[:, None] * self._lengths)


def _lengths(means: npt.NDArray[np.float32]) -> FloatArray:
    lengths: FloatArray = np.sqrt(np.einsum("cd,cd->c", means, means, dtype=np.float64))
    return lengths
