"""Shrinkage: λ by cross-validation on the statistics alone; each fold is tried on a readout of the others.

A fold's statistics say exactly how a readout's projections z = Wᵀ x of the held-out rows are spread: their class
means and their scatter within classes. What follows from these is a function of the statistics, so the choice
does not depend on the order in which anything was observed.

The readouts of all λ come from one factorisation. With Σ = Q T Qᵀ, T tridiagonal (Householder's reduction, LAPACK's
dsytrd), (Σ + λ I)⁻¹ Mᵀ = Q (T + λ I)⁻¹ Qᵀ Mᵀ for every λ (Eldén 1977, BIT 17): after the reduction, which takes as long
as four Cholesky factorisations, a λ costs O(d C), and turning all solutions back O(d² C) for each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.readout import Readout, ReadoutName, Task, fit_readout, require_definite
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import one_thread, within_scatter
from scroll_tactile.statistics.statistics import FOLDS, Statistics

__all__ = ["DEFAULT", "PENALTIES", "Selection", "fit_readouts", "select", "task_of"]

FloatArray = npt.NDArray[np.float64]

# As shares of a scaled feature's variance. The held-out loss of windows keeps falling to 0.1, where touches are told
# apart less well than at 0.03 (RoboSkin 97.2 against 97.6 %), so the grid ends there. Ten between the same ends told
# no touch better apart, in five folds of both sets.
PENALTIES = (1e-3, 3e-3, 1e-2, 3e-2)
DEFAULT = 1e-2  # where nothing can be held out: a first touch, or every touch in one fold
REDUCED = 32  # columns that LAPACK reduces at once


@dataclass(frozen=True)
class Selection:
    """The readout of a scale and how it was chosen.

    names: the materials, in the order of the readout's classes.
    readout: of all the statistics, at the chosen λ.
    held_out: fold → (places of the materials that the other folds know, the readout of these folds).
    losses: λ → held-out loss; empty where nothing could be held out.
    """

    names: list[str]
    readout: Readout
    held_out: dict[int, tuple[npt.NDArray[np.intp], Readout]]
    losses: dict[float, float]

    @cached_property
    def places(self) -> dict[str, int]:
        """Material → its place among the readout's classes."""
        return {name: place for place, name in enumerate(self.names)}


@dataclass(frozen=True)
class _FoldTask:
    """One fold: the others' task, and the fold's own rows of the materials that the others know."""

    known: npt.NDArray[np.intp]
    task: Task
    counts: npt.NDArray[np.int64]
    means: FloatArray  # held-out class means, about the task's center, in codes
    scatter: FloatArray  # held-out scatter within classes, upper triangle, in codes²


def select(
    statistics: Statistics, scale: Scale, kind: ReadoutName, penalties: Sequence[float] = PENALTIES
) -> Selection | None:
    """Choose λ among the penalties and fit the readout of a scale; None where it has no rows."""
    names = statistics.names(scale)
    if not names:
        return None
    counts, sums = statistics.counts(scale, names), statistics.sums(scale, names)
    total = statistics.total_second(scale)
    folds = {fold: held for fold in range(FOLDS) if (held := _fold_task(statistics, scale, fold, counts, sums, total))}
    fitted = {fold: fit_readouts(held.task, penalties) for fold, held in folds.items()}
    lost = [_losses(held, fitted[fold], kind) for fold, held in folds.items()]
    # Where nothing overlaps the logs are of the order of -1e308, and their sum may be -∞: that is no reason to warn.
    of_each = [sum(parts, 0.0) for parts in zip(*lost, strict=True)]
    losses = dict(zip(penalties, of_each, strict=True)) if lost else {}
    # Ties go to the larger λ, the tamer readout.
    chosen = min(sorted(losses, reverse=True), key=losses.__getitem__) if losses else DEFAULT
    readout = fit_readout(task_of(statistics, scale), chosen)
    held_out = {fold: (held.known, fitted[fold][penalties.index(chosen)]) for fold, held in folds.items()}
    return Selection(names, readout, held_out, losses)


def task_of(statistics: Statistics, scale: Scale) -> Task:
    """The task of all rows at a scale."""
    counts, sums = statistics.totals(scale)
    return Task.of(within_scatter(statistics.total_second(scale), counts, sums), counts, sums)


def _fold_task(
    statistics: Statistics,
    scale: Scale,
    fold: int,
    counts: npt.NDArray[np.int64],
    sums: npt.NDArray[np.int64],
    total: npt.NDArray[np.int64],
) -> _FoldTask | None:
    theirs = counts.sum(axis=1) - counts[:, fold]
    known = np.flatnonzero(theirs)
    own = known[counts[known, fold] > 0]
    if len(known) < 2 or not len(own):
        return None
    held = statistics.second(scale, fold).packed()
    other_sums = sums.sum(axis=1) - sums[:, fold]
    task = Task.of(within_scatter(total - held, theirs, other_sums), theirs[known], other_sums[known])
    scatter = within_scatter(held, counts[:, fold], sums[:, fold])
    in_fold = counts[known, fold]
    means = sums[known, fold] / np.maximum(in_fold, 1)[:, None] - task.center
    return _FoldTask(known, task, in_fold, means, scatter)


def _losses(held: _FoldTask, readouts: Sequence[Readout], kind: ReadoutName) -> list[float]:
    from scipy.linalg.blas import dsymm

    # The weights of all λ side by side: one product in place of many thin ones.
    weights = np.hstack([readout.weights for readout in readouts])
    spreads = np.split(dsymm(1.0, held.scatter, weights, lower=0), len(readouts), axis=1)
    loss = _squared_error if kind == "ridge" else _pairwise_error
    return [
        loss(held, readout, held.means @ readout.weights, readout.weights.T @ spread)
        for readout, spread in zip(readouts, spreads, strict=True)
    ]


def _squared_error(held: _FoldTask, readout: Readout, z: FloatArray, spread: FloatArray) -> float:
    """Σ over held-out rows of ‖t − s(x)‖²: that of the class means, and the spread about them.

    Exact where the other folds know every material of this one; where not, the spread is that of all its rows.
    """
    missed = np.eye(len(z)) - readout.scores(z, "ridge")
    return float(held.counts @ np.square(missed).sum(axis=1) + np.sum(readout.ridge @ spread * readout.ridge))


def _pairwise_error(held: _FoldTask, readout: Readout, z: FloatArray, spread: FloatArray) -> float:
    """Log of the held-out rows' mean error, class against class, with scores spread as a normal distribution.

    Class y loses to k with probability Φ(−Δ/σ), Δ the difference of its scores' held-out mean and σ² the held-out
    variance of that difference.
    """
    from scipy.special import log_ndtr, logsumexp

    own = np.flatnonzero(held.counts)
    scores = readout.scores(z, "lda")[own]
    margins = scores[np.arange(len(own)), own][:, None] - scores
    spread = spread / held.counts.sum()
    diagonal = np.diagonal(spread)
    variance = diagonal[own][:, None] + diagonal - 2 * spread[own]
    chances = log_ndtr(-margins / np.sqrt(np.maximum(variance, 1e-300)))
    chances[np.arange(len(own)), own] = -np.inf
    weights = np.log(held.counts[own] / held.counts.sum())
    return float(logsumexp(chances + weights[:, None]))


def fit_readouts(task: Task, penalties: Sequence[float]) -> list[Readout]:
    """Fit a readout with each λ, all above 0: what `fit_readout` gives, to rounding. The task is left as it was.

    Raises numpy.linalg.LinAlgError where Σ + λ I is not positive definite to working precision: λ is too small.
    """
    from scipy.linalg.lapack import dptsv, dsytrd

    dimension, classes = task.means.shape[1], len(task.means)
    if dimension == 1:  # of which LAPACK makes no tridiagonal matrix
        return [fit_readout(task, penalty) for penalty in penalties]
    # From the last feature to the first: the triangle that is there becomes the lower one, of which dormqr can apply Q.
    system = np.array(task.covariance[::-1, ::-1], order="F")
    turned = np.asfortranarray(task.means[:, ::-1].T)
    with one_thread():
        reduced, diagonal, beside, tau, _ = dsytrd(system, lower=1, lwork=REDUCED * dimension, overwrite_a=1)
        # Q leaves the first coordinate alone.
        reflectors = np.asfortranarray(reduced[1:, :-1])
        _turn(reflectors, tau, turned, "T")
        solved = np.empty((dimension, len(penalties) * classes), order="F")
        for i, penalty in enumerate(penalties):
            *_, part, failed = dptsv(diagonal + penalty, beside, turned)
            require_definite(penalty, failed)
            solved[:, i * classes : (i + 1) * classes] = part
        _turn(reflectors, tau, solved, "N")
        solved = solved[::-1]
        return [
            Readout.of(task, penalty, solved[:, i * classes : (i + 1) * classes]) for i, penalty in enumerate(penalties)
        ]


def _turn(reflectors: FloatArray, tau: FloatArray, columns: FloatArray, way: str) -> None:
    """Put Q times the columns in their place, or with way "T" Qᵀ times them."""
    from scipy.linalg.lapack import dormqr

    columns[1:], _, _ = dormqr("L", way, reflectors, tau, columns[1:], REDUCED * max(REDUCED, columns.shape[1]))
