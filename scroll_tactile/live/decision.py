"""When a prediction is made within a touch, and when it is safe to act on.

A touch is decided at the first moment at which it is known (`Prediction.known` is True) and its probability is at
least `sure`, or at which it is called new and its novelty is at least `least_new`. Where nothing can be known, as after
few touches, none is decided to be of a material. Held-out touches, run through all rows (see `fitting.rehearse`), set
both. `least_new` is a novelty that none of them comes near. `sure` is the least probability for which, as for every
higher one, few enough of the n held-out touches are decided wrongly:

    (W + M) / 2 n + √(risk (1 − risk) / n) ≤ risk,

W the wrong decisions, M how many there should be by their probabilities. The probabilities are calibrated at each
moment, and a posterior keeps its meaning wherever one stops; but they do not show how touches err together, and the
count alone is as coarse as 1 / n. The held-out touches are a sample: hence one standard error. So few cannot vouch for
a risk of 0.01; most touches are then decided when they are complete, at a probability of 1 − risk.

A touch of a thing that was touched before begins with the probabilities of the earlier touch. `together` is the least
probability for it: found in the same way from each held-out touch behind another of its material, and at least `sure`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.prediction.model import Model, Trajectories
from scroll_tactile.readouts.calibration import Dependence
from scroll_tactile.readouts.novelty import FEWEST, UNMEASURED
from scroll_tactile.results import Prediction

__all__ = ["DecisionRule", "decision_rule"]

FloatArray = npt.NDArray[np.float64]

LEAST, MOST = 0.5, 0.999  # of `sure`: what is more likely wrong than right is acted on by nobody
STEP = 0.005
KNOWN = 0.95  # of held-out touches: no touch of larger novelty is acted on
BEYOND = 2.0  # times the largest novelty of held-out touches


@dataclass(frozen=True)
class DecisionRule:
    """When to predict, and when to act.

    moments: at which a prediction is made, in steps, ascending; after the last only at the touch's end. risk: the
    share of wrong answers among those decided. sure: the probability at which a known touch is decided; together: that
    of several of one thing. least_new: the novelty at which a touch is decided to be of nothing that was observed.
    """

    moments: tuple[int, ...]
    risk: float
    sure: float
    together: float
    least_new: float

    def decided(self, prediction: Prediction, steps: int, *, several: bool = False) -> bool:
        """Whether it is safe to act on the prediction for the first `steps` of a touch, or for all of it.

        On `prediction.material` where that is known, and on its being new where it is far from all that is. several:
        whether the prediction weighs other touches of the same thing with it.
        """
        if prediction.known is False:
            return steps >= self.moments[0] and prediction.novelty >= self.least_new
        return prediction.known is True and self.likely(prediction, steps, several=several)

    def likely(self, prediction: Prediction, steps: int, *, several: bool = False) -> bool:
        """Whether it would be decided to be of `prediction.material` if that were known; not of what is called new."""
        if prediction.known is False or steps < self.moments[0]:
            return False
        sure, whole = self.together if several else self.sure, steps >= self.moments[-1]
        return prediction.probability >= (min(sure, 1 - self.risk) if whole else sure)


def decision_rule(model: Model, risk: float) -> DecisionRule:
    """The rule of a model at a risk: a function of what was observed, measured on touches held out.

    Of a memory of which too few touches can be held out, the probabilities are taken as they are, of whole touches
    alone. Raises InputError for a risk that is no share between 0 and 1.
    """
    if not 0 < risk < 1:
        raise InputError(f"expected risk as a share of wrong answers between 0 and 1; came {risk!r}")
    weighing = model.weighing
    least = 1 if weighing is None else weighing.least
    held_out = model.held_out.trajectories
    if weighing is None or held_out is None or len(held_out.targets) < FEWEST or not held_out.novelty.size:
        return DecisionRule((least,), risk, sure=1 - risk, together=1 - risk, least_new=2 * UNMEASURED)
    rows = weighing.early
    novelties = (row.calibration.thresholds.novelties for row in rows)
    thresholds = np.array([np.quantile(own, KNOWN) if len(own) else np.inf for own in novelties])
    sure = _least_sure_of(held_out, held_out.novelty <= thresholds, risk)
    pairs, known = in_pairs(held_out, thresholds, weighing.dependence)
    together = _least_sure_of(pairs, known, risk) if len(pairs.targets) >= FEWEST else 1 - risk
    return DecisionRule(
        moments=(*(row.steps for row in rows), least),
        risk=risk,
        sure=sure,
        together=max(sure, together),
        least_new=max(BEYOND * float(np.nanmax(held_out.novelty)), UNMEASURED),
    )


def _least_sure_of(trajectories: Trajectories, known: npt.NDArray[np.bool_], risk: float) -> float:
    chances = trajectories.chances
    right = chances.argmax(axis=2) == trajectories.targets[:, None]
    return least_sure(np.where(known, chances.max(axis=2), np.nan), right, risk)


def in_pairs(
    of: Trajectories, thresholds: FloatArray, dependence: Dependence
) -> tuple[Trajectories, npt.NDArray[np.bool_]]:
    """The probabilities and novelties of held-out touches behind another of their material, and whether each is known.

    thresholds: the largest novelty of a known touch at each moment. The first touch counts as at its last moment.
    """
    reached = [np.flatnonzero(~np.isnan(novelty)).tolist() for novelty in of.novelty]
    pairs: list[tuple[int, int]] = []
    for target in sorted(set(of.targets.tolist())):
        own = [i for i in np.flatnonzero(of.targets == target).tolist() if reached[i]]
        pairs += zip(own, [*own[1:], *own[:1]], strict=True) if len(own) > 1 else ()
    chances = np.full((len(pairs), *of.chances.shape[1:]), np.nan)
    novelty = np.full((len(pairs), of.novelty.shape[1]), np.nan)
    known = np.zeros(novelty.shape, dtype=np.bool_)
    for row, (first, second) in enumerate(pairs):
        last = reached[first][-1]
        for moment in reached[second]:
            chances[row, moment] = dependence.probability([of.chances[first, last], of.chances[second, moment]])
            novelty[row, moment] = dependence.standard([of.novelty[first, last], of.novelty[second, moment]])
            known[row, moment] = novelty[row, moment] <= (thresholds[last] + thresholds[moment]) / 2
    return Trajectories(chances, novelty, of.targets[[second for _, second in pairs]]), known


def least_sure(chances: FloatArray, right: npt.NDArray[np.bool_], risk: float) -> float:
    """The least probability at which touches can be decided, from how sure each is at each moment.

    chances: of the likeliest material, (touches, moments), NaN where it is not to be acted on. right: whether it is the
    true one.
    """
    allowed = risk - float(np.sqrt(risk * (1 - risk) / len(chances)))
    sure = MOST
    for bound in np.arange(MOST, LEAST, -STEP):
        reached = np.nan_to_num(chances) >= bound
        decided = reached.any(axis=1)
        first = reached.argmax(axis=1)[decided]
        wrong, doubt = ~right[decided, first], 1 - chances[decided, first]
        if (wrong.sum() + doubt.sum()) / 2 > allowed * len(chances):
            break
        sure = float(bound)
    return sure
