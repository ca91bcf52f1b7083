"""The readouts of many λ from one factorisation.

With Σ = Q T Qᵀ, T tridiagonal (Householder's reduction, LAPACK's dsytrd), (Σ + λ I)⁻¹ Mᵀ = Q (T + λ I)⁻¹ Qᵀ Mᵀ for
every λ (Eldén 1977, BIT 17): after the reduction, which takes as long as four Cholesky factorisations, a λ costs
O(d C), and turning all solutions back O(d² C) for each.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.linalg.lapack import dormqr, dptsv, dsytrd

from scroll_tactile.readouts.readout import Readout, Task, fit_readout, require_definite
from scroll_tactile.statistics.moments import one_thread

__all__ = ["fit_path"]

FloatArray = npt.NDArray[np.float64]

BLOCK = 32  # columns that LAPACK reduces at once


def fit_path(task: Task, penalties: Sequence[float]) -> list[Readout]:
    """Fit a readout with each λ, all above 0: what `fit_readout` gives, to rounding. The task is left as it was.

    Raises numpy.linalg.LinAlgError where Σ + λ I is not positive definite to working precision: λ is too small.
    """
    dimension, classes = task.means.shape[1], len(task.means)
    if dimension == 1:  # of which LAPACK makes no tridiagonal matrix
        return [fit_readout(task, penalty) for penalty in penalties]
    # From the last feature to the first: the triangle that is there becomes the lower one, of which dormqr can apply Q.
    system = np.array(task.covariance[::-1, ::-1], order="F")
    turned = np.asfortranarray(task.means[:, ::-1].T)
    with one_thread():
        reduced, diagonal, beside, tau, _ = dsytrd(system, lower=1, lwork=BLOCK * dimension, overwrite_a=1)
        # Q leaves the first coordinate alone.
        reflectors = np.asfortranarray(reduced[1:, :-1])
        _turn(reflectors, tau, turned, "T")
        solved = np.empty((dimension, len(penalties) * classes), order="F")
        for at, penalty in enumerate(penalties):
            *_, part, failed = dptsv(diagonal + penalty, beside, turned)
            require_definite(penalty, failed)
            solved[:, at * classes : (at + 1) * classes] = part
        _turn(reflectors, tau, solved, "N")
        solved = solved[::-1]
        return [
            Readout.of(task, penalty, solved[:, at * classes : (at + 1) * classes])
            for at, penalty in enumerate(penalties)
        ]


def _turn(reflectors: FloatArray, tau: FloatArray, columns: FloatArray, way: str) -> None:
    """Put Q times the columns in their place, or with way "T" Qᵀ times them."""
    columns[1:], _, _ = dormqr("L", way, reflectors, tau, columns[1:], BLOCK * max(BLOCK, columns.shape[1]))
