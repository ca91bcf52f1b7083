"""How far a model and the kept touches are believed beside each other, by touches left out of both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.calibration import FEWEST, UNMEASURED, fit_weights
from scroll_tactile.readouts.deviation import spaced
from scroll_tactile.readouts.recall import Recall
from scroll_tactile.readouts.recollection import Recollection

__all__ = ["Apart", "Pooled", "pool"]

FloatArray = npt.NDArray[np.float64]

LEFT_OUT = 48  # kept touches that are left out, each compared with all others
PRIOR = np.array([1.0, 1 / 600])  # of the model's logits, and of values that say the same as their neighbours
PRIOR_TOUCHES = 5.0
UNSEEN = 1 / 20_000  # r where nothing can be left out: after one touch of each, beginnings are lost to a larger one
USUAL = 0.95  # of touches left out are familiar
MOST_SPREAD = 1e-9
LEAST_FAMILIAR, MOST_FAMILIAR = 0.5, 4.0  # and 1 at least in the time of those that were learned


@dataclass(frozen=True)
class Apart:
    """What a model says of a touch left out: logits by material, its strangeness beside the usual, its novelty."""

    material: str
    logits: Mapping[str, float]
    strange: float
    novelty: float = 0.0

    @property
    def margin(self) -> float:
        """How far its own material is ahead of the next, below 0 where it is behind."""
        return self.logits[self.material] - max(
            (value for name, value in self.logits.items() if name != self.material), default=-np.inf
        )


@dataclass(frozen=True)
class Pooled:
    """Kept touches beside a model.

    recall: the kept touches. trusted, recalled: g and r, see `prediction.recalling`. familiar: the strangeness that 19
    of 20 touches left out do not exceed. usual, spread: of the surprise of touches left out.
    """

    recall: Recall
    trusted: float
    recalled: float
    familiar: float
    usual: float
    spread: float

    def steepness(self, recollection: Recollection) -> float:
        """β, see `prediction.recalling`."""
        return 1 / (1 + (1 / self.recalled - 1) * recollection.certainty)

    def familiarity(self, strange: float, own_time: bool) -> float:
        """How many times as much the model is believed of a touch, the more familiar it is.

        own_time: whether it is compared with beginnings: a strange one of those is believed as a usual one.
        """
        least = 1.0 if own_time else LEAST_FAMILIAR
        if not (np.isfinite(self.familiar) and np.isfinite(strange)):
            return 1.0
        return float(np.clip(self.familiar / max(strange, MOST_SPREAD), least, MOST_FAMILIAR))

    def novelty(self, recollection: Recollection) -> float:
        """The surprise of a touch, in units of its spread in known ones, as novelty is."""
        return (recollection.surprise - self.usual) / self.spread


def pool(recall: Recall, apart: Mapping[bytes, Apart]) -> Pooled:
    """Fit g and r to kept touches that were left out of both. apart: by key, what the model says of those."""
    keys = {row: key for key, row in sorted(recall.rows().items()) if key in apart}
    rows = list(keys)
    # Of the least sure half of them, where it matters which of the two is believed; the others at random.
    unsure = sorted(rows, key=lambda row: apart[keys[row]].margin)[: LEFT_OUT // 2]
    others = [row for row in rows if row not in unsure]
    rows = sorted(unsure + [others[i] for i in spaced(others, LEFT_OUT // 2)])
    names = recall.materials
    if len(rows) < FEWEST or len(names) < 2:
        return Pooled(recall, float(PRIOR[0]), UNSEEN, np.inf, 0.0, 1.0 / UNMEASURED)
    told = [apart[keys[row]] for row in rows]
    found = [recall.recollect(recall.levels(row), left_out=row) for row in rows]
    common = [i for i, name in enumerate(names) if all(name in touch.logits for touch in told)]
    targets = [[names[i] for i in common].index(touch.material) for touch in told]
    scores = np.array(
        [
            [[touch.logits[names[i]] for i in common], recollection.scores[common]]
            for touch, recollection in zip(told, found, strict=True)
        ]
    )
    trusted, recalled = fit_weights(scores, targets, PRIOR, PRIOR_TOUCHES).tolist()
    surprise = np.array([recollection.surprise for recollection in found])
    familiar = float(np.quantile([touch.strange for touch in apart.values()], USUAL))
    spread = max(float(surprise.std()), MOST_SPREAD)
    return Pooled(recall, trusted, max(recalled, 1e-6), familiar, float(surprise.mean()), spread)
