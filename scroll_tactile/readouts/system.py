"""The system that a readout solves: inverted once from the exact statistics, and followed by Woodbury's identity.

A touch of k rows with mean x̄, of a class of n rows with mean m, adds to the scatter within classes its rows about
their mean and the scaled shift of the class mean, √(n k / (n + k)) (x̄ − m). Let U be all such columns since K was
inverted, and D their signs, −1 where a touch was retracted (Woodbury 1950):

    (K + Uᵀ D U)⁻¹ = L⁻ᵀ (I − Wᵀ E W) L⁻¹,    K = L Lᵀ,    W = U L⁻ᵀ,    E = (D + W Wᵀ)⁻¹,

at 2 d² operations a column; of the columns only W is stored. Nothing drifts: U grows to a part of d, and then K is
inverted again from the integers.
"""

from __future__ import annotations

import copy
from functools import lru_cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt

__all__ = ["System", "columns_of", "contrasts"]

FloatArray = npt.NDArray[np.float64]

LARGEST_RANK = 3  # d over this: so many columns may come before K is inverted again
LEAST_RANK = 32
MORE = 64  # columns that room is made for at once
# The condition number of D + U K⁻¹ Uᵀ, by largest entries; digits are lost with its square. So touches much larger than
# all before, or the retraction of one that dominates the scatter, have K inverted again: scores stay accurate to 1e-9.
LARGEST_CONDITION = 256.0
BLOCKS = 8  # of rows of a triangle: then seven sixteenths of the square are left out
FEW = 8  # rows that are solved for one by one: a fifth of the time of a product of matrices


@lru_cache(maxsize=64)
def contrasts(count: int) -> FloatArray:
    """Helmert's orthonormal contrasts of so many rows, shape (count − 1, count): their Gram matrix is the centring."""
    contrasts = np.zeros((count - 1, count))
    for i in range(1, count):
        contrasts[i - 1, :i], contrasts[i - 1, i] = 1.0, -float(i)
        contrasts[i - 1] /= np.sqrt(i * (i + 1.0))
    return contrasts


def columns_of(rows: FloatArray, shift: FloatArray | None) -> FloatArray:
    """The columns that rows, (k, d), add to the scatter: their contrasts, and the scaled shift of the class mean."""
    own = contrasts(len(rows)) @ rows if len(rows) > 1 else rows[:0]
    return own if shift is None else np.vstack([own, shift])


class System:
    """K⁻¹ = L⁻ᵀ L⁻¹, and the columns that came since. The caller has set BLAS to one thread.

    matrix: K, shape (d, d), of which the lower triangle is read. rank: the columns that came since.

    Raises numpy.linalg.LinAlgError where K is not positive definite to working precision.
    """

    def __init__(self, matrix: FloatArray) -> None:
        dimension = len(matrix)
        # numpy alone: scipy's LAPACK, a second time beside numpy's, is 40 MB and a fifth of a second to import.
        self._inverse = InverseTriangle(matrix)
        self._most = max(LEAST_RANK, dimension // LARGEST_RANK)
        self._white = np.empty((0, dimension))  # L⁻¹ times the columns, and room for more
        self._e = np.empty((0, 0))
        self._largest = 1.0  # entry of what E is the inverse of
        self.rank = 0

    @classmethod
    def unkept(cls, dimension: int) -> System:
        """A system whose K was not stored: it takes in no columns, and solves nothing."""
        system = cls(np.empty((0, 0)))
        system._most, system._white = 0, np.empty((0, dimension))
        return system

    @property
    def sound(self) -> bool:
        """Whether the system is well-conditioned: the columns that came do not outweigh K."""
        largest = float(np.abs(self._e[: self.rank, : self.rank]).max(initial=0.0))
        return self._largest * largest <= LARGEST_CONDITION

    @property
    def room(self) -> int:
        """How many columns more can come."""
        return self._most - self.rank

    def branch(self) -> System:
        """Another system with the same columns: what comes to it does not come to this one."""
        other = copy.copy(self)
        other._white, other._e = self._white[: self.rank].copy(), self._e[: self.rank, : self.rank].copy()
        return other

    def solve(self, rows: FloatArray) -> FloatArray:
        """(K + Uᵀ D U)⁻¹ times each of the rows, shape (k, d)."""
        white = self.whiten(rows)
        if self.rank:
            came, e = self._white[: self.rank], self._e[: self.rank, : self.rank]
            white -= (white @ came.T) @ e @ came
        return self._inverse.transposed_times(white)

    def whiten(self, rows: FloatArray) -> FloatArray:
        """L⁻¹ times each of the rows, (k, d), without the columns that came since: their products are those of K⁻¹."""
        return self._inverse.times(rows)

    def _grow(self, rank: int) -> None:
        size, held = max(rank, min(self._most, len(self._white) + MORE)), self.rank
        white, e = np.empty((size, self._white.shape[1])), np.empty((size, size))
        white[:held], e[:held, :held] = self._white[:held], self._e[:held, :held]
        self._white, self._e = white, e

    def border(self, columns: FloatArray, sign: int) -> tuple[FloatArray, FloatArray]:
        """Take in columns, (k, d), of one sign. Returns W, (k, d), and C, (k, k): the inverse falls by Wᵀ C W."""
        first, last = self.rank, self.rank + len(columns)
        if last > len(self._white):
            self._grow(last)
        self._white[first:last] = white = self.whiten(columns)
        cross = self._white[:last] @ white.T
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
        return self._inverse.transposed_times(white - onto.T @ self._white[:first]), corner


def _edges(dimension: int) -> list[int]:
    """The first rows of the blocks of a triangle, and the end."""
    edges: list[int] = np.linspace(0, dimension, min(dimension, BLOCKS) + 1).astype(int).tolist()
    return edges


class InverseTriangle:
    """L⁻¹ of K = L Lᵀ, shape (d, d), of which the lower triangle is read: in blocks of rows, without what is zero.

    A block stays in the processor's cache for all rows that are multiplied by it; no second (d, d) array is made.

    Raises numpy.linalg.LinAlgError where K is not positive definite to working precision.
    """

    def __init__(self, matrix: FloatArray) -> None:
        self._blocks: list[tuple[int, int, FloatArray]] = []
        for first, last in pairwise(_edges(len(matrix))):
            # Rows of L before the diagonal: those of K times the transposed L⁻¹ of all above. Bordering then gives L⁻¹.
            above = self.times(matrix[first:last, :first])
            own = np.tril(np.linalg.inv(np.linalg.cholesky(matrix[first:last, first:last] - above @ above.T)))
            self._blocks.append((first, last, np.hstack([-own @ self.transposed_times(above), own])))

    def times(self, rows: FloatArray) -> FloatArray:
        """L⁻¹ times each of the rows, shape (k, d)."""
        product = np.empty_like(rows)
        for first, last, block in self._blocks:
            if len(rows) > FEW:
                product[:, first:last] = rows[:, :last] @ block.T
                continue
            for row, into in zip(rows, product, strict=True):
                into[first:last] = block @ row[:last]
        return product

    def transposed_times(self, rows: FloatArray) -> FloatArray:
        """L⁻ᵀ times each of the rows, shape (k, d)."""
        product = np.zeros_like(rows)
        for first, last, block in self._blocks:
            if len(rows) > FEW:
                product[:, :last] += rows[:, first:last] @ block
                continue
            for row, into in zip(rows, product, strict=True):
                into[:last] += row[first:last] @ block
        return product
