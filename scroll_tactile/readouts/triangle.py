"""The inverse of a lower triangle L of K = L Lᵀ, by which K⁻¹ = L⁻ᵀ L⁻¹ solves; and Helmert's contrasts."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt

__all__ = ["InverseTriangle", "contrasts"]

FloatArray = npt.NDArray[np.float64]

BLOCKS = 8  # of rows of a triangle: then seven sixteenths of the square are left out


@lru_cache(maxsize=64)
def contrasts(count: int) -> FloatArray:
    """Helmert's orthonormal contrasts of so many rows, shape (count − 1, count): their Gram matrix is the centring."""
    i = np.arange(1.0, count)[:, None]
    return np.asarray((np.tril(np.ones((count - 1, count))) - i * np.eye(count - 1, count, 1)) / np.sqrt(i * (i + 1)))


class InverseTriangle:
    """L⁻¹ of K = L Lᵀ, shape (d, d), of which the lower triangle is read: in blocks of rows, without what is zero.

    A block stays in the processor's cache for all rows that it is multiplied by; no second (d, d) array is made. Scipy,
    which could do it too, takes 40 MB and a fifth of a second to import. The caller has set BLAS to one thread.

    Raises numpy.linalg.LinAlgError where K is not positive definite to working precision.
    """

    def __init__(self, matrix: FloatArray) -> None:
        self._blocks: list[tuple[int, int, FloatArray]] = []
        edges = np.linspace(0, len(matrix), min(len(matrix), BLOCKS) + 1).astype(int).tolist()
        for first, last in pairwise(edges):
            # Rows of L before the diagonal: those of K times the transposed L⁻¹ of all above. Bordering then gives L⁻¹.
            above = self.times(matrix[first:last, :first])
            own = np.tril(np.linalg.inv(np.linalg.cholesky(matrix[first:last, first:last] - above @ above.T)))
            self._blocks.append((first, last, np.hstack([-own @ self.transposed_times(above), own])))

    def times(self, rows: FloatArray) -> FloatArray:
        """L⁻¹ times each of the rows, shape (k, d)."""
        product = np.empty_like(rows)
        for first, last, block in self._blocks:
            product[:, first:last] = rows[:, :last] @ block.T
        return product

    def transposed_times(self, rows: FloatArray) -> FloatArray:
        """L⁻ᵀ times each of the rows, shape (k, d)."""
        product = np.zeros_like(rows)
        for first, last, block in self._blocks:
            product[:, :last] += rows[:, first:last] @ block
        return product

    def solve(self, rows: FloatArray) -> FloatArray:
        """K⁻¹ times each of the rows, shape (k, d)."""
        return self.transposed_times(self.times(rows))
