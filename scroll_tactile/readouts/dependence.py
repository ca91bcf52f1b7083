"""Several touches of one thing: how far they are correlated, by held-out touches of one material.

Touches of one material err alike, so k of them are not k independent witnesses. With ρ the correlation of two, the
log-probabilities of k count as those of k / (1 + (k − 1) ρ) (the design effect; Kish 1965), and the mean of k
novelties has √((1 + (k − 1) ρ') / k) times the standard deviation of one:

    log p = Σ_i log p_i / (1 + (k − 1) ρ) + constant,    novelty = Σ_i novelty_i / √(k (1 + (k − 1) ρ')).

ρ is fitted to pairs of held-out touches, by least log loss, and ρ' is their intraclass correlation. For one touch both
formulas leave its own values.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.calibration import FEWEST, HeldOutProbabilities, fit_weights

__all__ = ["Dependence", "dependence_of"]

FloatArray = npt.NDArray[np.float64]

DEFAULT = 0.25  # ρ and ρ' where nothing is measured: about that of prefixes of BioTac's touches
PRIOR_TOUCHES = 2.0  # the prior of ρ counts as so many pairs
TINY = 1e-300


@dataclass(frozen=True)
class Dependence:
    """Correlations of two touches of one material, from 0 to 1: ρ of their log-probabilities, ρ' of their novelties."""

    log_probability: float = DEFAULT
    novelty: float = DEFAULT

    def probability(self, chances: Sequence[FloatArray]) -> FloatArray:
        """The probability of the candidates, (C,), from those by each touch."""
        # math.fsum is exact before it rounds: any order of the touches gives the same bits.
        logs = np.log(np.maximum(np.array(chances), TINY))
        logits = np.array([math.fsum(column) for column in logs.T]) / (1 + (len(logs) - 1) * self.log_probability)
        together = np.exp(logits - logits.max())
        return np.asarray(together / together.sum())

    def standard(self, novelties: Sequence[float]) -> float:
        """The novelty of all together, in standard deviations of that of known materials' touches."""
        count = len(novelties)
        return math.fsum(novelties) / math.sqrt(count * (1 + (count - 1) * self.novelty))


def dependence_of(held: HeldOutProbabilities) -> Dependence:
    """Fit both to held-out touches."""
    groups: dict[int, list[int]] = {}
    for row in sorted(range(len(held.keys)), key=held.keys.__getitem__):
        groups.setdefault(int(held.targets[row]), []).append(row)
    several = [rows for _, rows in sorted(groups.items()) if len(rows) > 1]
    pairs = [pair for rows in several for pair in zip(rows[::2], rows[1::2], strict=False)]
    if len(pairs) < FEWEST or len(groups) < 2:
        return Dependence()
    scores = np.array([[held.logs[first] + held.logs[second]] for first, second in pairs])
    prior = np.array([1 / (1 + DEFAULT)])
    weight = float(fit_weights(scores, [int(held.targets[first]) for first, _ in pairs], prior, PRIOR_TOUCHES)[0])
    rho = float(np.clip(1 / max(weight, TINY) - 1, 0.0, 1.0))
    return Dependence(rho, _correlation([held.novelty[rows].tolist() for rows in several]))


def _correlation(groups: Sequence[Sequence[float]]) -> float:
    """The intraclass correlation of groups, two values or more in each (Fisher 1925), from 0 to 1."""
    counts = np.array([len(group) for group in groups])
    means = np.array([np.mean(group) for group in groups])
    total, mean = int(counts.sum()), float(np.concatenate([np.array(group) for group in groups]).mean())
    if len(groups) < 2 or total <= len(groups):
        return DEFAULT
    within = sum(float(np.square(np.array(group) - own).sum()) for group, own in zip(groups, means, strict=True))
    within /= total - len(groups)
    between = float((counts * np.square(means - mean)).sum()) / (len(groups) - 1)
    size = (total - float(np.square(counts).sum()) / total) / (len(groups) - 1)
    share = (between - within) / (between + (size - 1) * within) if between + within > 0 else 0.0
    return float(np.clip(share, 0.0, 1.0))
