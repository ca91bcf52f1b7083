"""When a prediction is made, and when it is safe to act on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.model import Model
from scroll_tactile.results import Prediction

__all__ = ["DecisionRule", "decision_rule"]


@dataclass(frozen=True)
class DecisionRule:
    """A stand-in, to be replaced: fixed moments, and the probability as it is."""

    moments: tuple[int, ...]
    risk: float

    def decided(self, prediction: Prediction, columns: int) -> bool:
        """Whether it is safe to act on a prediction."""
        return prediction.known and prediction.probability >= 1 - self.risk


def decision_rule(model: Model, extractor: FeatureExtractor, risk: float) -> DecisionRule:
    """The rule of a model."""
    first, last = model.plan.widths[0] // 3, max(model.longest, 3)
    return DecisionRule(tuple(np.unique(np.geomspace(max(first, 2), last, 7).astype(int)).tolist()), risk)
