"""Heads for attributes of materials: ridge regression over the classes of a readout, from its C × C matrices alone.

Let z = Wᵀ(x − c) be a readout's projection and G that of its class means. A head that knows the materials K is
f(x) = b + Σ_K α_y z_y(x), ridge regression of the targets on the class means in the space where the scatter within
classes is white, each material counting as one row:

    [G_KK + γ I   1] [α]   [t]
    [1ᵀ           0] [b] = [0].

A material whose target is unknown enters only the scatter within classes. With B the inverse of that matrix, the head
without material i follows from it (Allen 1974, PRESS): α − B_{·i} α_i / B_ii. So γ is chosen by touches whose materials
are left out of the head.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.calibration import fit_weights

__all__ = ["GAMMAS", "Curve", "fit_curve", "heads_without", "solve"]

FloatArray = npt.NDArray[np.float64]

GAMMAS = (10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01, 0.001)  # shares of the mean of G's diagonal, centred; ties: the first


def solve(gram: FloatArray, gamma: float) -> FloatArray:
    """B, (K + 1, K + 1), the intercept last: B[:, :K] t are the (α, b) of targets t of the known materials.

    gram: G_KK, (K, K), K ≥ 2. gamma: γ, a share of G's diagonal.
    """
    count = len(gram)
    # Of G centred. Materials with equal means have G = 0: then any γ predicts the mean of the targets.
    size = max(float(np.trace(gram)) / count - float(gram.mean()), 1e-12)
    system = np.ones((count + 1, count + 1))
    system[:count, :count] = (gram + gram.T) / 2 + gamma * size * np.eye(count)
    system[count, count] = 0.0
    return np.asarray(np.linalg.inv(system))


def heads_without(inverse: FloatArray, targets: FloatArray) -> FloatArray:
    """(α, b) had each of the materials never been observed, its own α then 0: a column each, (K + 1, K)."""
    own, known = inverse[:, :-1], np.arange(len(targets))
    weights = own @ targets
    heads = weights[:, None] - own * (weights[:-1] / np.diagonal(own))
    heads[known, known] = 0.0
    return np.asarray(heads)


@dataclass(frozen=True)
class Curve:
    """A logistic curve: the probability at x is 1 / (1 + exp(−(slope·x + offset)))."""

    slope: float
    offset: float

    def __call__(self, values: npt.ArrayLike) -> FloatArray:
        """Probabilities, of the same shape."""
        return np.asarray(np.exp(-np.logaddexp(0.0, -(self.slope * np.asarray(values, np.float64) + self.offset))))


def fit_curve(values: npt.ArrayLike, targets: npt.ArrayLike, prior: Curve, *, turning: bool = True) -> Curve:
    """The logistic curve of least log loss (Platt 1999), its slope not below 0, drawn to `prior` where touches are few.

    values, targets: shape (N,), N ≥ 0; targets are 0 or 1. The prior counts as one touch. turning: whether the value at
    which it passes a half may differ from the prior's.
    """
    half, count = -prior.offset / prior.slope, 1 + turning  # of weights: the slope, and the height at the prior's half
    features = np.stack([np.asarray(values, np.float64) - half, np.ones(np.size(values))], axis=1)[:, :count]
    start, least = np.array([1.0, 0.0])[:count], np.array([0.0, -np.inf])[:count]
    scores = np.stack([np.zeros_like(features), features], axis=2)  # of absence and presence
    slope, *height = fit_weights(scores, targets, np.full(count, prior.slope), 1.0, start, least).tolist()
    return Curve(slope, sum(height) - slope * half)
