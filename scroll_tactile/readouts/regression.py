"""Regression of a quantity on the features of some touches, with every touch and every material held out exactly.

A head is ridge regression in its dual form (Saunders, Gammerman and Vovk 1998): with X the features of n touches at one
scale, each in units of its standard deviation, G = X Xᵀ / s, t the targets and C the projection across 1,

    B = C (C G C + λ I)⁻¹ C,    α = B t,    f(x) = mean(t) + α · X x / s.

The residuals of a group of touches under the head that never had them follow from B alone (Allen 1974, PRESS, for a
group): r_g = B_gg⁻¹ α_g. Groups are touches for a head that answers for known materials, and materials for one that
answers for new ones; λ is the one of least r². The features' units alone rest on all touches.

Each scale has a head of its own, and a quantity is Σ_s w_s f_s with w ≥ 0, Σ w = 1, of least squared residual (stacked
regression, Breiman 1996). A residual that calibrates is taken at the λ and w that are best for other touches. Intervals
are f ± a quantile of |r| (split conformal: Vovk, Gammerman and Shafer 2005); over materials, of the mean of their
distributions (pooled CDFs: Dunn, Wasserman and Ramdas 2022), which holds for few as far as these are like the next.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.triangle import contrasts

__all__ = ["RegressionHead", "Spectrum", "fit_head"]

FloatArray = npt.NDArray[np.float64]
Groups = npt.NDArray[np.intp]

LAMBDAS = tuple(2.0**power for power in range(5, -17, -1))  # in units of G's mean diagonal; ties go to the larger
LEAST_VARIANCE = 1e-3  # of a feature, as a share of their mean: what hardly varies is not blown up
FOLDS = 10  # parts of the groups: for the residuals of each, λ and the weights of scales are chosen by the others
PRIOR = 2.0  # touches: with fewer, the weights of scales are drawn to those of independent residuals
TINY = 1e-300


@dataclass(frozen=True)
class Spectrum:
    """The features of n touches at one scale, and the eigenvectors of their Gram matrix; of any number of quantities.

    rows: X / √s, (n, d). center, unit: (d,), as rows are made: (features − center) · unit. vectors: of C G C across 1,
    (n, n − 1). values: its eigenvalues, (n − 1,).
    """

    rows: FloatArray
    center: FloatArray
    unit: FloatArray
    vectors: FloatArray
    values: FloatArray

    @classmethod
    def of(cls, rows: npt.NDArray[np.number]) -> Spectrum:
        """The spectrum of features, (n, d), n ≥ 2. The caller has set BLAS to one thread: then it is the same bits."""
        center, variance = rows.mean(axis=0), rows.var(axis=0)
        floor = LEAST_VARIANCE * float(variance.mean())
        unit = 1.0 / np.sqrt(variance + floor) if floor > 0 else np.ones_like(variance)
        unit /= math.sqrt(float((variance * np.square(unit)).sum())) or 1.0  # rows that are all equal say nothing
        scaled, across = (rows - center) * unit, contrasts(len(rows))
        onto = across @ scaled
        values, vectors = np.linalg.eigh(onto @ onto.T)
        return cls(scaled, center, unit, across.T @ vectors, np.maximum(values, 0.0))

    def held_out(self, targets: FloatArray, numbers: Groups) -> FloatArray:
        """The residuals of each group held out, at each of LAMBDAS, (penalties, n).

        targets: (n,). numbers: the group of each touch, (n,); no group has them all.
        """
        filters = 1.0 / (self.values + np.array(LAMBDAS)[:, None])  # the eigenvalues of B
        alpha = (filters * (self.vectors.T @ targets)) @ self.vectors.T
        if len(np.unique(numbers)) == len(targets):
            return np.asarray(alpha / (filters @ np.square(self.vectors).T))
        for number in np.unique(numbers):
            own = self.vectors[numbers == number]
            within = (own * filters[:, None]) @ own.T
            alpha[:, numbers == number] = np.linalg.solve(within, alpha[:, numbers == number, None])[:, :, 0]
        return np.asarray(alpha)

    def solve(self, targets: FloatArray, penalty: float) -> tuple[FloatArray, float]:
        """(weights (d,), intercept) of the head over features that are not standardised."""
        alpha = self.vectors @ (self.vectors.T @ targets / (self.values + penalty))
        weights = self.unit * (alpha @ self.rows)
        return weights, float(targets.mean() - weights @ self.center)


@dataclass(frozen=True)
class RegressionHead:
    """Predicts a quantity from a touch's features at some scales, and how far it may be off.

    weights: for each scale, (S, d). intercept: in the unit of the targets. residuals: target less prediction of each
    touch, held out with its group, (n,). mass: the weight of each residual, all one in sum, each group's alike, (n,).
    """

    weights: FloatArray
    intercept: float
    residuals: FloatArray
    mass: FloatArray

    def __call__(self, features: Sequence[FloatArray]) -> float:
        """The quantity, of mean features (d,) at each scale."""
        return math.fsum((self.intercept, *(float(w @ x) for w, x in zip(self.weights, features, strict=True))))

    def half_width(self, risk: float) -> float:
        """What |error| exceeds with a probability of `risk` or less; infinite where the touches are too few to say.

        The ⌈(n + 1)(1 − risk)⌉-th smallest |r|: n + 1 touches, the new one among them, have every rank alike.
        """
        count, off = len(self.residuals), np.abs(self.residuals)
        # Exact products such as 20 · 0.95 are not to be pushed over by rounding.
        rank = math.ceil((count + 1) * (1 - risk) - 1e-9)
        order = np.argsort(off, kind="stable")
        reached = np.cumsum(self.mass[order]) * count >= rank - 1e-6
        return float(off[order][reached][0]) if rank <= count else math.inf


def fit_head(spectra: Sequence[Spectrum], targets: FloatArray, groups: Groups | None = None) -> RegressionHead:
    """The head of some touches, read at each of the scales.

    spectra: of the same n touches in the same order. targets: (n,), of any unit. groups: the material of each touch,
    numbered from 0, (n,), two or more; None: each touch by itself is held out.
    """
    numbers = np.arange(len(targets)) if groups is None else groups
    paths = np.stack([spectrum.held_out(targets, numbers) for spectrum in spectra])
    counts, residuals = np.bincount(numbers), np.empty(len(targets))
    for part in range(min(FOLDS, len(counts))):
        fold = numbers % FOLDS == part
        _, shares, all_ = _chosen(paths, ~fold)
        residuals[fold] = all_[fold] @ shares
    best, shares, _ = _chosen(paths, np.ones(len(targets), bool))
    solved = [spectrum.solve(targets, LAMBDAS[at]) for spectrum, at in zip(spectra, best, strict=True)]
    weights = shares[:, None] * np.stack([own for own, _ in solved])
    intercept = math.fsum(float(share) * own for share, (_, own) in zip(shares, solved, strict=True))
    return RegressionHead(weights, intercept, residuals, 1.0 / (len(counts) * counts[numbers]))


def _chosen(paths: FloatArray, among: npt.NDArray[np.bool_]) -> tuple[Groups, FloatArray, FloatArray]:
    """The places of λ and the weights of the scales, (S,) each, of least r² among some touches; all residuals there.

    paths: residuals of all touches, (S, penalties, n).
    """
    best = np.square(paths[:, :, among]).sum(axis=2).argmin(axis=1)  # ties go to the larger, which come first
    residuals = paths[np.arange(len(best)), best].T
    return best, stacked(residuals[among]), residuals


def stacked(residuals: FloatArray) -> FloatArray:
    """The weights w ≥ 0, Σ w = 1, (S,), of least |R w|², of residuals R, (n, S).

    Exact: the best subset of the five scales whose weights are all positive. Of few touches the products between scales
    count for less, n / (n + PRIOR).
    """
    products = residuals.T @ residuals
    every = range(len(products))
    products[every, every] = products.diagonal() * (1.0 + PRIOR / len(residuals)) + TINY
    best = np.zeros(len(products))
    for chosen in (list(one) for size in every for one in combinations(every, size + 1)):
        own = np.linalg.solve(products[np.ix_(chosen, chosen)], np.ones(len(chosen)))
        if own.min() > 0 and own.sum() > best.sum():  # of w = own / Σ own, |R w|² is 1 / Σ own
            best = np.zeros(len(products))
            best[chosen] = own
    return np.asarray(best / best.sum())
