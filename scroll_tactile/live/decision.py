"""When a prediction is made within a touch, and when it is safe to act on.

A touch is decided at the first moment at which its prediction is known and as probable as `sure`, or as strange as
`strange`. Both are set by touches left out, run through all moments (see `prediction.moment_table`): the novelty that
none of them comes near, and the least probability above which, with every higher one, so few of n are
decided wrongly that

    (W + M) / 2 n + √(risk (1 − risk) / n) ≤ risk,

W those that are, M how many it should be by their probabilities. These are calibrated at each moment, and a posterior
keeps what it says wherever one stops; but they do not see how touches err together, and the count alone is as coarse as
1 / n. Touches left out are not all there are: hence one standard error. So few cannot vouch for a risk of 0.01, and
then most are decided as whole touches, of which a probability of 1 − risk is enough.

A touch of a thing that was touched before begins with what that said, and `together` is the least probability for it:
the same, of each touch left out behind another of its material, and no less than `sure`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.prediction.model import Model
from scroll_tactile.prediction.moment_table import Trajectories
from scroll_tactile.readouts.calibration import FEWEST, UNMEASURED
from scroll_tactile.readouts.dependence import Dependence
from scroll_tactile.results import Prediction

__all__ = ["DecisionRule", "decision_rule"]

FloatArray = npt.NDArray[np.float64]

LEAST, MOST = 0.5, 0.999  # of `sure`: what is more likely wrong than right is acted on by nobody
STEP = 0.005
KNOWN = 0.95  # of touches left out: what is stranger is not acted on
BEYOND = 2.0  # times the most novelty of touches left out


@dataclass(frozen=True)
class DecisionRule:
    """When to predict, and when to act.

    moments: at which a prediction is made, in columns, ascending; after the last only at the touch's end. risk: the
    share of wrong answers among those decided. sure: the probability at which a known touch is decided; together: that
    of several of one thing. strange: the novelty at which a touch is decided to be of nothing that was observed.
    """

    moments: tuple[int, ...]
    risk: float
    sure: float
    together: float
    strange: float

    def decided(self, prediction: Prediction, columns: int, *, several: bool = False) -> bool:
        """Whether it is safe to act on the prediction for the first `columns` of a touch, or for all of it.

        On `prediction.material`, but where it is not known on its being new. several: whether the
        prediction weighs other touches of the same thing with it.
        """
        if columns < self.moments[0]:
            return False
        if prediction.known is not False:
            sure, whole = self.together if several else self.sure, columns >= self.moments[-1]
            return prediction.probability >= (min(sure, 1 - self.risk) if whole else sure)
        return prediction.novelty >= self.strange


def decision_rule(model: Model, risk: float) -> DecisionRule:
    """The rule of a model at a risk: a function of what was observed, measured on touches held out.

    Of a memory of which too few touches can be held out, the probabilities are taken as they are, of whole touches
    alone. Raises InputError for a risk that is no share between 0 and 1.
    """
    if not 0 < risk < 1:
        raise InputError(f"expected risk as a share of wrong answers between 0 and 1; came {risk!r}")
    least = max(1, min(model.least, model.longest))
    said = None if model.fusion is None else model.fusion.trajectories
    if model.fusion is None or said is None or len(said.targets) < FEWEST or not said.novelty.size:
        return DecisionRule((least,), risk, 1 - risk, 1 - risk, 2 * UNMEASURED)
    moments = model.fusion.moments[:-1]
    usual = np.array([np.quantile(m.novelties, KNOWN) if len(m.novelties) else np.inf for m in moments])
    sure = _least_sure_of(said, said.novelty <= usual, risk)
    pairs, known = in_pairs(said, usual, model.dependence)
    together = _least_sure_of(pairs, known, risk) if len(pairs.targets) >= FEWEST else 1 - risk
    strange = max(BEYOND * float(np.nanmax(said.novelty)), UNMEASURED)
    return DecisionRule((*(moment.steps for moment in moments), least), risk, sure, max(sure, together), strange)


def _least_sure_of(said: Trajectories, known: npt.NDArray[np.bool_], risk: float) -> float:
    chances = said.chances
    right = chances.argmax(axis=2) == said.targets[:, None]
    return least_sure(np.where(known, chances.max(axis=2), np.nan), right, risk)


def in_pairs(
    said: Trajectories, usual: FloatArray, dependence: Dependence
) -> tuple[Trajectories, npt.NDArray[np.bool_]]:
    """What is said of touches left out behind another of their material, at each moment, and whether it is known.

    usual: the most novelty of a known touch at each moment. What comes first counts as at its last moment.
    """
    reached = [np.flatnonzero(~np.isnan(of)).tolist() for of in said.novelty]
    pairs: list[tuple[int, int]] = []
    for target in sorted(set(said.targets.tolist())):
        own = [i for i in np.flatnonzero(said.targets == target).tolist() if reached[i]]
        pairs += zip(own, [*own[1:], *own[:1]], strict=True) if len(own) > 1 else ()
    chances = np.full((len(pairs), *said.chances.shape[1:]), np.nan)
    novelty = np.full((len(pairs), said.novelty.shape[1]), np.nan)
    known = np.zeros(novelty.shape, dtype=np.bool_)
    for row, (first, second) in enumerate(pairs):
        last = reached[first][-1]
        for moment in reached[second]:
            both = (first, last), (second, moment)
            chances[row, moment] = dependence.probability([said.chances[at] for at in both])
            novelty[row, moment] = dependence.standard([said.novelty[at] for at in both])
            known[row, moment] = novelty[row, moment] <= (usual[last] + usual[moment]) / 2
    return Trajectories(chances, novelty, said.targets[[second for _, second in pairs]]), known


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
        wrong = float((~right[decided, first]).sum())
        doubt = float((1 - chances[decided, first]).sum())
        if (wrong + doubt) / 2 > allowed * len(chances):
            break
        sure = float(bound)
    return sure
