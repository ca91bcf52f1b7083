"""Heads for attributes of materials: ridge regression over the classes of a readout, from its C × C matrices alone.

Let z = Wᵀ(x − c) be a readout's projection and G that of its class means. A head that knows the materials K is
f(x) = b + Σ_K α_y z_y(x), ridge regression of the targets on the class means in the space where the scatter within
classes is white, each material counting as one row:

    [G_KK + γ I   1] [α]   [t]
    [1ᵀ           0] [b] = [0].

The weights in feature space are W α = (S_w/N + λI)⁻¹ Mᵀ α. Mᵀ α takes the place of Σ_y c_y t_yᵀ in the paper's readout,
and the scatter between materials that of the scatter between touches. A material whose target is unknown enters only
the scatter within classes. With B the inverse of that matrix, the head without material i follows from it (Allen 1974,
PRESS): α − B_{·i} α_i / B_ii. So γ is chosen by touches whose materials are left out of the head.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["GAMMAS", "Curve", "RidgeSystem", "fit_curve", "solve"]

FloatArray = npt.NDArray[np.float64]

GAMMAS = (1e-3, 1e-2, 3e-2, 1e-1, 3e-1, 1.0, 3.0, 10.0)  # as shares of the mean of G's diagonal, centred


@dataclass(frozen=True)
class RidgeSystem:
    """A factorised system of one set of known materials and one γ.

    inverse: B, shape (K + 1, K + 1), the intercept last.
    """

    inverse: FloatArray

    def weights(self, targets: FloatArray) -> FloatArray:
        """(α, b), shape (K + 1,), of targets of the known materials, shape (K,)."""
        weights: FloatArray = self.inverse[:, :-1] @ targets
        return weights

    def weights_without(self, weights: FloatArray, place: int) -> FloatArray:
        """(α, b), shape (K + 1,), had material `place` never been observed; its own α is 0."""
        others: FloatArray = weights - self.inverse[:, place] * (weights[place] / self.inverse[place, place])
        others[place] = 0.0
        return others


def solve(gram: FloatArray, gamma: float) -> RidgeSystem:
    """Factorise the system of known materials with G_KK, shape (K, K), K ≥ 2, and γ, a share of G's diagonal."""
    count = len(gram)
    centred = gram - gram.mean(axis=0) - gram.mean(axis=1)[:, None] + gram.mean()
    # Materials with equal means have G = 0: then any γ predicts the mean of the targets.
    size = max(float(np.trace(centred)) / count, 1e-12)
    system = np.zeros((count + 1, count + 1))
    system[:count, :count] = (gram + gram.T) / 2 + gamma * size * np.eye(count)
    system[count, :count] = system[:count, count] = 1.0
    return RidgeSystem(np.asarray(np.linalg.inv(system), dtype=np.float64))


@dataclass(frozen=True)
class Curve:
    """A logistic curve: the probability at x is 1 / (1 + exp(−(slope·x + offset)))."""

    slope: float
    offset: float

    def __call__(self, values: npt.ArrayLike) -> FloatArray:
        """Probabilities, of the same shape."""
        from scipy.special import expit

        probabilities: FloatArray = expit(self.slope * np.asarray(values, dtype=np.float64) + self.offset)
        return probabilities


def fit_curve(
    values: npt.ArrayLike, targets: npt.ArrayLike, prior: Curve, *, rows: float = 1.0, turning: bool = True
) -> Curve:
    """The logistic curve of least log loss (Platt 1999), its slope not below 0, drawn to `prior` where touches are few.

    values, targets: shape (N,), N ≥ 0; targets are 0 or 1. rows: how many touches the prior counts
    as. turning: whether the value at which it passes a half may differ from the prior's.
    """
    from scipy.special import expit

    truth = np.asarray(targets, dtype=np.float64)
    if not len(truth):
        return prior
    half = -prior.offset / prior.slope
    from_half = np.asarray(values, dtype=np.float64) - half

    def loss(point: FloatArray) -> tuple[float, FloatArray]:
        logits = point[0] * from_half + point[1]
        miss = expit(logits) - truth
        pull = (point - start) / prior.slope
        value = float(np.sum(np.logaddexp(0.0, logits) - truth * logits)) + rows * float(pull @ pull) / 2
        return value, np.array([miss @ from_half, miss.sum()]) + rows * pull / prior.slope

    start = np.array([prior.slope, 0.0])
    bounds = [(0.0, None), (None, None) if turning else (0.0, 0.0)]
    from scipy.optimize import minimize  # late, as in `calibration`

    slope, above = minimize(loss, start, jac=True, bounds=bounds, method="L-BFGS-B").x.tolist()
    return Curve(slope, above - slope * half)
