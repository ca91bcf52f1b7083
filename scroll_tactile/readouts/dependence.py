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

from scroll_tactile.readouts.calibration import fit_weights
from scroll_tactile.readouts.novelty import FEWEST, TINY

__all__ = ["Dependence", "dependence_of"]

FloatArray = npt.NDArray[np.float64]

DEFAULT = 0.25  # ρ and ρ' where nothing is measured: about that of prefixes of BioTac's touches
PRIOR_TOUCHES = 2.0  # the prior of ρ counts as so many pairs


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


def dependence_of(
    keys: Sequence[bytes], targets: npt.NDArray[np.intp], logs: FloatArray, novelties: FloatArray
) -> Dependence:
    """Fit both to N held-out touches: their content hashes, materials, log-probabilities, (N, C), and novelties, (N,).

    Where these are too few they may be without novelties.
    """
    order = np.array(sorted(range(len(keys)), key=keys.__getitem__), dtype=np.intp)
    groups = [order[targets[order] == target] for target in np.unique(targets)]
    several = [group for group in groups if len(group) > 1]
    pairs = np.array([pair for group in several for pair in zip(group[::2], group[1::2], strict=False)], dtype=np.intp)
    if len(pairs) < FEWEST or len(groups) < 2:
        return Dependence()
    prior = np.array([1 / (1 + DEFAULT)])
    weight = float(fit_weights(logs[pairs].sum(axis=1)[:, None], targets[pairs[:, 0]], prior, PRIOR_TOUCHES)[0])
    rho = float(np.clip(1 / max(weight, TINY) - 1, 0.0, 1.0))
    return Dependence(rho, _correlation([novelties[group] for group in several]))


def _correlation(groups: Sequence[FloatArray]) -> float:
    """The intraclass correlation of groups, two values or more in each (Fisher 1925), from 0 to 1."""
    if len(groups) < 2:
        return DEFAULT
    counts, values = np.array([len(group) for group in groups]), np.concatenate(groups)
    means, total, others = np.array([group.mean() for group in groups]), len(values), len(groups) - 1
    within = float(np.square(values - np.repeat(means, counts)).sum()) / (total - len(groups))
    between = float((counts * np.square(means - values.mean())).sum()) / others
    size = (total - float(np.square(counts).sum()) / total) / others
    share = (between - within) / (between + (size - 1) * within) if between + within > 0 else 0.0
    return float(np.clip(share, 0.0, 1.0))
