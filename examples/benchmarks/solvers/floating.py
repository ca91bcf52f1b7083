"""Solvers of the ridge regression in floating point: what exact sums are compared with.

All find W = argmin Σ ‖y − Wᵀ x‖² + λ ‖W‖² of rows that come in batches, through one interface (`Solver`). With A =
Σ x xᵀ and B = Σ x yᵀ:

====================== ======================================================================================
covariance             P ← P − P Xᵀ (I + X P Xᵀ)⁻¹ X P,  W ← W + P Xᵀ (Y − X W): the conventional recursive form
covariance-symmetric   the same, with P ← (P + Pᵀ) / 2 after each update
qr                     R'R = A + λ I by orthogonal updates of R, Q'Y carried along:  W = R⁻¹ Q'Y
gram64, gram32         A and B in float64 or float32, then Cholesky:  W = (A + λ I)⁻¹ B
====================== ======================================================================================
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_triangular
from scipy.linalg.blas import dgemm, dger, dsyrk, ssyrk
from scipy.linalg.lapack import dpotrf, dpotrs, dtpqrt, spotrf, spotrs

from examples.benchmarks.solvers.solver_protocol import RidgeBase, SingularError
from scroll_tactile.errors import InputError
from scroll_tactile.statistics.moments import one_thread

__all__ = ["Covariance", "CovarianceSymmetric", "Gram32", "Gram64", "SquareRoot"]

FloatArray = npt.NDArray[np.float64]

WAITING = 512  # rows that a plain sum lets wait, as the exact one does: a fair comparison of their speed
BLOCK = 32  # columns that dtpqrt works on at once


class Covariance(RidgeBase):
    """Recursive least squares carrying P = (A + λ I)⁻¹, by Sherman & Morrison 1950 and Woodbury 1950; λ > 0.

    K = P Xᵀ (I + X P Xᵀ)⁻¹,  W ← W + K (Y − X W),  P ← P − K X P, from P = I / λ and W = 0.
    """

    symmetric: ClassVar[bool] = False

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
            if self.symmetric:
                self._covariance = (self._covariance + self._covariance.T) / 2

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


class CovarianceSymmetric(Covariance):
    """`Covariance` whose P is made symmetric after each update."""

    symmetric = True


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

    kind: ClassVar[type[np.floating[Any]]] = np.float64

    def _begin(self) -> None:
        width = self.dimension + self.outputs
        self._sums = np.zeros((width, width), dtype=self.kind, order="F")
        self._waiting = np.empty((WAITING, width), dtype=self.kind)
        self._count = 0

    def _take(self, x: FloatArray, y: FloatArray) -> None:
        with np.errstate(over="ignore", under="ignore"):
            rows = np.concatenate([x, y], axis=1).astype(self.kind)
        for first in range(0, len(rows), WAITING):
            part = rows[first : first + WAITING]
            if self._count + len(part) > WAITING:
                self.settle()
            self._waiting[self._count : self._count + len(part)] = part
            self._count += len(part)

    def settle(self) -> None:
        """Bring rows that wait into the sums."""
        if self._count:
            syrk = dsyrk if self.kind is np.float64 else ssyrk
            block = self._waiting[: self._count].T
            with np.errstate(all="ignore"):
                self._sums = syrk(1.0, block, beta=1.0, c=self._sums, lower=0, overwrite_c=1)
            self._count = 0

    def weights(self) -> FloatArray:
        """W of shape (d, C). Raises SingularError where A + λ I is not positive definite in this arithmetic."""
        self._require_start()
        self.settle()
        d = self.dimension
        factorise, solve = (dpotrf, dpotrs) if self.kind is np.float64 else (spotrf, spotrs)
        system = np.array(self._sums[:d, :d], order="F")
        with np.errstate(over="ignore", under="ignore"), one_thread():
            system[np.diag_indices(d)] += self.kind(self.penalty)
            factor, failed = factorise(system, lower=0, overwrite_a=1)
            if failed or not np.isfinite(np.diagonal(factor)).all():
                raise SingularError(
                    f"expected A + λ I to be positive definite in {np.dtype(self.kind)}; with λ = {self.penalty:g} "
                    f"it is not at column {max(failed - 1, 0)}. Give a larger λ, or take the exact or the QR form"
                )
            found = solve(factor, self._sums[:d, d:], lower=0)[0]
        self.diagnosis = ""
        return np.asarray(found, dtype=np.float64)


class Gram32(Gram64):
    """`Gram64` in float32."""

    kind = np.float32
