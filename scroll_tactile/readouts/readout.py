"""Readouts: classifiers computed from the statistics of one scale, and what they say of novelty.

With class means m_y (about the mean of all rows, p_y their shares), scaled features and
Σ = S_w / N + λ I, one Cholesky factorisation gives W = Σ⁻¹ Mᵀ and G = M W, and everything else is C × C:

- lda, linear discriminant analysis:      s_y = z_y − G_yy / 2,            z = Wᵀ x;
- ridge on 0/1 targets, the paper's f_t:  s = p + H z,                     H = (P⁻¹ + G)⁻¹,
  since (Σ + Mᵀ P M)⁻¹ Mᵀ P = W H (push-through identity), with M P Mᵀ the scatter between classes;
- relative Mahalanobis distance (Ren et al. 2021, arXiv 2106.09022), the distance to the nearest class under
  Σ less that to the whole under Σ + Mᵀ P M:  −2 max_y s_y(lda) + zᵀ H z  (Woodbury; xᵀ Σ⁻¹ x cancels).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.moments import one_thread

__all__ = ["Readout", "ReadoutName", "Task", "centred_means", "fit_readout", "require_definite"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
ReadoutName = Literal["lda", "ridge"]

UNIT = 2.0**BITS


@dataclass(frozen=True)
class Task:
    """Statistics of one scale made ready to fit: scaled, so that λ means the same for any features.

    covariance: S_w / N of scaled features, shape (d, d), upper triangle in Fortran's order.
    means: class means about the mean of all rows, scaled, shape (C, d).
    center: mean of all rows, shape (d,), and scale: total standard deviation (1 where it is 0), both in codes.
    shares: p_y, shape (C,). rows: N.
    """

    covariance: FloatArray
    means: FloatArray
    center: FloatArray
    scale: FloatArray
    shares: FloatArray
    rows: int

    @classmethod
    def of(cls, scatter: FloatArray, counts: IntArray, sums: IntArray) -> Task:
        """Make the task of a scatter within classes (taken over, see `within_scatter`), n_y and c_y."""
        total = int(counts.sum())
        shares = counts / total
        center, means = centred_means(counts, sums)
        variance = np.diagonal(scatter) / total + shares @ np.square(means)
        # Rows of integers that differ at all differ by more than this: below it is only the means' rounding.
        constant = variance < 0.25 / total
        scale = np.sqrt(np.where(constant, 1.0, variance))
        means[:, constant] = 0.0
        scatter *= (1.0 / (total * scale))[:, None]
        scatter *= 1.0 / scale
        return cls(scatter, means / scale, center, scale, shares, total)


def centred_means(counts: IntArray, sums: IntArray) -> tuple[FloatArray, FloatArray]:
    """The mean of all rows, shape (d,), and the class means about it, shape (C, d), of n_y and c_y."""
    # Long double: a class mean keeps the digits that its distance from the centre needs.
    exact = sums.astype(np.longdouble) / counts[:, None]
    center = (counts / counts.sum()).astype(np.longdouble) @ exact
    return center.astype(np.float64), (exact - center).astype(np.float64)


@dataclass(frozen=True)
class Readout:
    """A classifier of one scale.

    penalty: λ, as a share of a scaled feature's variance.
    center: mean of all rows, in codes, shape (d,).
    weights: W in codes, shape (d, C); z = (x − center) @ weights for codes x.
    gram: G, shape (C, C). ridge: H, shape (C, C). shares: p_y, shape (C,).
    penalties: N λ v, v the features' variances, in codes², shape (d,): what is added to S_w to solve for W.
    """

    penalty: float
    center: FloatArray
    weights: FloatArray
    gram: FloatArray
    ridge: FloatArray
    shares: FloatArray
    penalties: FloatArray

    @classmethod
    def of(cls, task: Task, penalty: float, solved: FloatArray) -> Readout:
        """The readout of a task, from Σ⁻¹ Mᵀ of its scaled features, shape (d, C)."""
        gram = task.means @ solved
        gram = (gram + gram.T) / 2
        ridge = np.linalg.inv(np.diag(1.0 / task.shares) + gram)
        penalties = task.rows * penalty * np.square(task.scale)
        weights = solved / task.scale[:, None]
        return cls(penalty, task.center, weights, gram, (ridge + ridge.T) / 2, task.shares, penalties)

    def project(self, codes: npt.NDArray[np.floating]) -> FloatArray:
        """z of codes of shape (…, d), shape (…, C): all that any answer needs."""
        z: FloatArray = (codes - self.center) @ self.weights
        return z

    def scores(self, z: FloatArray, kind: ReadoutName) -> FloatArray:
        """The scores of the classes, shape (…, C)."""
        if kind == "lda":
            lda: FloatArray = z - np.diagonal(self.gram) / 2
            return lda
        ridge: FloatArray = self.shares + z @ self.ridge
        return ridge

    def novelty(self, z: FloatArray, candidates: npt.NDArray[np.intp] | None = None) -> FloatArray:
        """Relative Mahalanobis distance, shape (…,); `candidates` are the classes that may be the nearest."""
        scores = self.scores(z, "lda")
        nearest = scores.max(axis=-1) if candidates is None else scores[..., candidates].max(axis=-1)
        distance: FloatArray = -2.0 * nearest + np.einsum("...i,ij,...j->...", z, self.ridge, z)
        return distance


def fit_readout(task: Task, penalty: float) -> Readout:
    """Fit a readout with λ = penalty > 0; the task is left as it was.

    Raises numpy.linalg.LinAlgError where Σ is not positive definite to working precision: λ is too small.
    """
    from scipy.linalg.lapack import dpotrf, dpotrs

    system = task.covariance.copy(order="F")
    system[np.diag_indices_from(system)] += penalty
    with one_thread():
        factor, failed = dpotrf(system, lower=0, overwrite_a=1)
        require_definite(penalty, failed)
        solved, _ = dpotrs(factor, task.means.T, lower=0)
        return Readout.of(task, penalty, solved)


def require_definite(penalty: float, failed: int) -> None:
    """Raise numpy.linalg.LinAlgError where a factorisation says at which row Σ + λ I failed; 0 where it did not."""
    if failed:
        raise np.linalg.LinAlgError(
            f"the covariance with λ = {penalty:g} is not positive definite at row {failed}: λ is too small"
        )
