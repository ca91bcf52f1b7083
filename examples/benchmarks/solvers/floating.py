"""Solvers of the ridge regression in floating point: what exact sums are compared with.

All find W = argmin Σ ‖y − Wᵀ x‖² + λ ‖W‖² of rows that come in batches, through one interface (`RidgeBase`). With A =
Σ x xᵀ and B = Σ x yᵀ:

================= ==================================================================================
recursion         P ← P − P Xᵀ (I + X P Xᵀ)⁻¹ X P,  W ← W + P Xᵀ (Y − X W): the paper's
square root       R'R = A + λ I by orthogonal updates of R, Q'Y carried along:  W = R⁻¹ Q'Y
plain sums        A and B in float64, then Cholesky:  W = (A + λ I)⁻¹ B
pseudo-inverse    the same sums:  W = (A + λ I)⁺ B
================= ==================================================================================
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.linalg import pinvh, solve_triangular
from scipy.linalg.blas import dgemm, dger, dsyrk
from scipy.linalg.lapack import dpotrf, dpotrs, dtpqrt

from examples.benchmarks.solvers.solver_protocol import RidgeBase, SingularError
from scroll_tactile.errors import InputError
from scroll_tactile.statistics.moments import one_thread

__all__ = ["Gram64", "PseudoInverseGram", "RecursiveLeastSquares", "SquareRoot"]

FloatArray = npt.NDArray[np.float64]

WAITING = 512  # rows that a plain sum lets wait, as the exact one does: a fair comparison of their speed
BLOCK = 32  # columns that dtpqrt works on at once


class RecursiveLeastSquares(RidgeBase):
    """The paper's recursive least squares, carrying P = (A + λ I)⁻¹ (Sherman & Morrison 1950, Woodbury 1950); λ > 0.

    K = P Xᵀ (I + X P Xᵀ)⁻¹,  W ← W + K (Y − X W),  P ← P − K X P, from P = I / λ and W = 0.
    """

    def _begin(self) -> None:
        if not self.penalty:
            raise InputError("expected λ > 0: the covariance form begins with P = I / λ. Take the exact or the QR form")
        self._covariance: FloatArray = np.asfortranarray(np.eye(self.dimension) / self.penalty)
        self._weights = np.zeros((self.dimension, self.outputs))

    def _take(self, x: FloatArray, y: FloatArray) -> None:
        # Where P has lost its definiteness numbers grow without bound: the diagnosis says so, not a warning.
        with np.errstate(all="ignore"):
            projected = x @ self._covariance
            gain = _gain(x, projected)
            self._weights += gain @ (y - x @ self._weights)
            # In place: a product that is subtracted afterwards goes over P three times.
            if len(x) == 1:
                self._covariance = dger(-1.0, gain[:, 0], projected[0], a=self._covariance, overwrite_a=1)
            else:
                self._covariance = dgemm(-1.0, gain, projected, beta=1.0, c=self._covariance, overwrite_c=1)

    def weights(self) -> FloatArray:
        """W of shape (d, C), as the recursion left it."""
        self._require_start()
        self.diagnosis = _definiteness(self._covariance)
        return self._weights.copy()


def _gain(x: FloatArray, projected: FloatArray) -> FloatArray:
    """K = P Xᵀ (I + X P Xᵀ)⁻¹, shape (d, n), from X P; of one row a division. NaN where there is no inverse."""
    inner = projected @ x.T
    inner[np.diag_indices_from(inner)] += 1.0
    if len(x) == 1:
        return projected.T / inner
    try:
        return np.asarray(np.linalg.solve(inner, projected).T, dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.full(projected.T.shape, np.nan)


def _definiteness(matrix: FloatArray) -> str:
    if not np.isfinite(matrix).all():
        return "P is not finite"
    with one_thread():
        least = float(np.linalg.eigvalsh((matrix + matrix.T) / 2)[0])
    return "" if least > 0 else f"P is not positive definite: eigenvalue {least:.1e}"


class SquareRoot(RidgeBase):
    """Square-root information form (Peterka 1975, Kybernetika 11): the triangle of a QR factorisation, updated.

    [R Z; X Y] = Q [R' Z'; 0 E] by LAPACK's dtpqrt, from R = √λ I and Z = 0; W solves R W = Z.
    """

    def _begin(self) -> None:
        width = self.dimension + self.outputs
        self._triangle = np.zeros((width, width), order="F")
        self._triangle[np.arange(self.dimension), np.arange(self.dimension)] = np.sqrt(self.penalty)

    def _take(self, x: FloatArray, y: FloatArray) -> None:
        rows = np.asfortranarray(np.concatenate([x, y], axis=1))
        with one_thread():
            self._triangle, *_ = dtpqrt(
                0, min(BLOCK, len(self._triangle)), self._triangle, rows, overwrite_a=1, overwrite_b=1
            )

    def weights(self) -> FloatArray:
        """W of shape (d, C). Raises SingularError where R has a zero on its diagonal."""
        self._require_start()
        d = self.dimension
        triangle = self._triangle[:d, :d]
        zeros = np.flatnonzero(np.diagonal(triangle) == 0)
        if len(zeros):
            raise SingularError(
                f"expected rows that determine the weights, or λ > 0; column {zeros[0]} depends on the others "
                "and λ is 0. Give λ > 0"
            )
        self.diagnosis = ""
        with np.errstate(all="ignore"), one_thread():
            found: FloatArray = solve_triangular(triangle, self._triangle[:d, d:], check_finite=False)
        return found


class Gram64(RidgeBase):
    """Sums A and B in floating point, then Cholesky: the normal equations, as they are usually solved."""

    def _begin(self) -> None:
        width = self.dimension + self.outputs
        self._sums = np.zeros((width, width), order="F")
        self._waiting = np.empty((WAITING, width))
        self._count = 0

    def _take(self, x: FloatArray, y: FloatArray) -> None:
        rows = np.concatenate([x, y], axis=1)
        for first in range(0, len(rows), WAITING):
            part = rows[first : first + WAITING]
            if self._count + len(part) > WAITING:
                self.settle()
            self._waiting[self._count : self._count + len(part)] = part
            self._count += len(part)

    def settle(self) -> None:
        """Bring rows that wait into the sums."""
        if self._count:
            block = self._waiting[: self._count].T
            with np.errstate(all="ignore"):
                self._sums = dsyrk(1.0, block, beta=1.0, c=self._sums, lower=0, overwrite_c=1)
            self._count = 0

    def weights(self) -> FloatArray:
        """W of shape (d, C). Raises SingularError where A + λ I is not positive definite in this arithmetic."""
        self._require_start()
        self.settle()
        d = self.dimension
        system = np.array(self._sums[:d, :d], order="F")
        system[np.diag_indices(d)] += self.penalty
        self.diagnosis = ""
        with np.errstate(all="ignore"), one_thread():
            return self._solved(system, self._sums[:d, d:])

    def _solved(self, system: FloatArray, right: FloatArray) -> FloatArray:
        """The solution of a system of which the upper triangle is given."""
        factor, failed = dpotrf(system, lower=0, overwrite_a=1)
        if failed or not np.isfinite(np.diagonal(factor)).all():
            raise SingularError(
                f"expected A + λ I to be positive definite in float64; with λ = {self.penalty:g} it is not at column "
                f"{max(failed - 1, 0)}. Give a larger λ, or take the exact or the QR form"
            )
        return np.asarray(dpotrs(factor, right, lower=0)[0], dtype=np.float64)


class PseudoInverseGram(Gram64):
    """The same sums, solved by a pseudo-inverse, as streaming discriminant analysis does (Hayes & Kanan 2020)."""

    def _solved(self, system: FloatArray, right: FloatArray) -> FloatArray:
        if not np.isfinite(system).all():
            raise SingularError("expected finite sums: rows of this size overflow float64. Give them in another unit")
        inverse, rank = pinvh(system, lower=False, check_finite=False, return_rank=True)
        if rank < len(system):
            self.diagnosis = f"taken for singular: rank {rank} of {len(system)}"
        return np.asarray(inverse @ right, dtype=np.float64)
