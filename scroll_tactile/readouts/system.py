"""The system that a readout solves: inverted once from the exact statistics, and followed by Woodbury's identity.

A touch of k rows with mean x̄, of a class of n rows with mean m, adds to the scatter within classes its rows about
their mean and its way √(n k / (n + k)) (x̄ − m). With U all such columns since K was inverted and D their signs, −1 for
what was retracted (Woodbury 1950):

    (K + Uᵀ D U)⁻¹ = K⁻¹ − Vᵀ E V,    V = U K⁻¹,    E = (D + U K⁻¹ Uᵀ)⁻¹,

at 2 d² operations a column. Nothing drifts: U grows to a part of d, and then K is inverted again from the integers.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

__all__ = ["System", "columns_of", "contrasts"]

FloatArray = npt.NDArray[np.float64]

LARGEST_RANK = 3  # d over this: so many columns may come before K is inverted again
LEAST_RANK = 32
# Of the condition of D + U K⁻¹ Uᵀ, by largest entries. What is lost of the digits goes with its square: touches much
# louder than all before, or one retracted on which the scatter rests, have K inverted again: scores keep their 1e-9.
LARGEST_CONDITION = 256.0
SMALL = 64  # rows of a triangle
FEW = 8  # rows that are solved for one by one: a fifth of the time of a product of matrices


@lru_cache(maxsize=64)
def contrasts(count: int) -> FloatArray:
    """Helmert's orthonormal contrasts of so many rows, shape (count − 1, count): their Gram matrix is the centring."""
    contrasts = np.zeros((count - 1, count))
    for i in range(1, count):
        contrasts[i - 1, :i], contrasts[i - 1, i] = 1.0, -float(i)
        contrasts[i - 1] /= np.sqrt(i * (i + 1.0))
    return contrasts


def columns_of(rows: FloatArray, way: FloatArray | None) -> FloatArray:
    """What rows, shape (k, d), add to the scatter: their contrasts, and the way of the class mean if there is one."""
    own = contrasts(len(rows)) @ rows if len(rows) > 1 else rows[:0]
    return own if way is None else np.vstack([own, way])


class System:
    """K⁻¹ = L⁻ᵀ L⁻¹, and what came since. Whoever calls has BLAS on one thread.

    matrix: K, shape (d, d), of which the lower triangle is read. rank: the columns that came since.

    Raises numpy.linalg.LinAlgError where K is not positive definite to working precision.
    """

    def __init__(self, matrix: FloatArray) -> None:
        dimension = len(matrix)
        # numpy alone: scipy's LAPACK, a second time beside numpy's, is 40 MB and a fifth of a second to import.
        self._whitening = _inverse_of_triangle(np.asarray(np.linalg.cholesky(matrix), dtype=np.float64))
        room = max(LEAST_RANK, dimension // LARGEST_RANK)
        self._u, self._v = np.empty((room, dimension)), np.empty((room, dimension))
        self._e = np.empty((room, room))
        self._largest = 1.0  # entry of what E is the inverse of
        self.rank = 0

    @property
    def sound(self) -> bool:
        """Whether what came does not outweigh what K was made of."""
        largest = float(np.abs(self._e[: self.rank, : self.rank]).max(initial=0.0))
        return self._largest * largest <= LARGEST_CONDITION

    @property
    def room(self) -> int:
        """How many columns more can come."""
        return len(self._u) - self.rank

    def solve(self, rows: FloatArray) -> FloatArray:
        """(K + Uᵀ D U)⁻¹ times each of the rows, shape (k, d)."""
        solved = self._first(rows)
        if self.rank:
            u, v, e = self._u[: self.rank], self._v[: self.rank], self._e[: self.rank, : self.rank]
            solved -= (solved @ u.T) @ e @ v
        return solved

    def whiten(self, rows: FloatArray) -> FloatArray:
        """L⁻¹ times each of the rows, shape (k, d), not regarding what came since: their products are those of K⁻¹."""
        if len(rows) <= FEW:
            return _product(rows, self._whitening.T)
        half, whitened = rows.shape[1] // 2, np.empty_like(rows)  # of the triangle a quarter is not there
        whitened[:, :half] = rows[:, :half] @ self._whitening[:half, :half].T
        whitened[:, half:] = rows @ self._whitening[half:].T
        return whitened

    def _first(self, rows: FloatArray) -> FloatArray:
        return _product(self.whiten(rows), self._whitening)

    def border(self, columns: FloatArray, sign: int) -> tuple[FloatArray, FloatArray]:
        """Take in columns, shape (k, d), of one sign; gives W, (k, d), and C, (k, k): Wᵀ C W leaves the inverse."""
        first, last = self.rank, self.rank + len(columns)
        solved = self._first(columns)
        self._u[first:last], self._v[first:last] = columns, solved
        cross = self._u[:last] @ solved.T
        self._largest = max(self._largest, float(np.abs(cross).max(initial=0.0)))
        e, above = self._e[:first, :first], cross[:first]
        onto = e @ above
        corner = np.linalg.inv(cross[first:] + sign * np.eye(last - first) - above.T @ onto)
        corner = (corner + corner.T) / 2
        beside = -onto @ corner
        e -= beside @ onto.T
        self._e[:first, first:last], self._e[first:last, :first] = beside, beside.T
        self._e[first:last, first:last] = corner
        self.rank = last
        return solved - onto.T @ self._v[:first], corner


def _product(rows: FloatArray, matrix: FloatArray) -> FloatArray:
    if len(rows) > FEW:
        return np.asarray(rows @ matrix)
    return np.array([row @ matrix for row in rows]).reshape(rows.shape)


def _inverse_of_triangle(lower: FloatArray) -> FloatArray:
    """The inverse of a lower triangle, by halves: nearly all of it is products of matrices."""
    count = len(lower)
    if count <= SMALL:
        return np.tril(np.linalg.inv(lower))
    half = count // 2
    first, last = _inverse_of_triangle(lower[:half, :half]), _inverse_of_triangle(lower[half:, half:])
    inverse = np.zeros_like(lower)
    inverse[:half, :half], inverse[half:, half:] = first, last
    inverse[half:, :half] = -last @ (lower[half:, :half] @ first)
    return inverse
