"""How far a model and the kept touches are believed beside each other, by touches left out of both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.calibration import FEWEST, UNMEASURED, fit_weights
from scroll_tactile.readouts.deviation import spaced
from scroll_tactile.readouts.likelihood import CLEAN
from scroll_tactile.readouts.recall import Recall
from scroll_tactile.readouts.recollection import Recollection

__all__ = ["Apart", "Pooled", "pool", "recalled_of"]

FloatArray = npt.NDArray[np.float64]

LEFT_OUT = 48  # kept touches that are left out, each compared with all others
PRIOR = np.array([1.0, 1 / 600])  # of the model's logits, and of values that say the same as their neighbours
PRIOR_TOUCHES = 5.0
UNSEEN = 1 / 16_000  # β where nothing can be left out: after one touch of each, beginnings are lost to a larger one
SURE = 0.99  # of the model's probability: a touch with less is compared with kept ones
USUAL = 0.95  # of touches left out are familiar
MOST_SPREAD = 1e-9
LEAST_STEEPNESS, LEAST_CERTAINTY = 1e-9, 1e-3
LEAST_FAMILIAR = 0.5  # of a touch that is just familiar: of a strange one that is compared at another speed


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

    recall: the kept touches. trusted, recalled: g and r, see `prediction.recalling`; alone: r where noise, or how
    strange the touch is, leaves the model nothing to say. familiar: the strangeness that 19
    of 20 touches left out do not exceed. usual, spread: of the surprise of touches left out. sure: the probability from
    which on the model answers for a familiar touch alone.
    """

    recall: Recall
    trusted: float
    recalled: float
    alone: float
    familiar: float
    usual: float
    spread: float
    sure: float = SURE

    def steepness(self, recollection: Recollection, familiarity: float) -> float:
        """β, see `prediction.recalling`, of a touch for which the model is believed by so much."""
        beside, alone = (1 / (1 + (1 / r - 1) * recollection.certainty) for r in (self.recalled, self.alone))
        share = (1 - recollection.trust) * familiarity
        return share * beside + (1 - share) * alone

    def familiarity(self, strange: float, own_time: bool) -> float:
        """As `familiarity_of`."""
        return familiarity_of(self.familiar, strange, own_time)

    def novelty(self, recollection: Recollection) -> float:
        """The surprise of a touch, in units of its spread in known ones, as novelty is."""
        return (recollection.surprise - self.usual) / self.spread


def pool(recall: Recall, apart: Mapping[bytes, Apart], power: float = 1.0) -> Pooled:
    """Fit g and r to kept touches that were left out of both.

    apart: by key, what the model says of those. power: of the probabilities of a model whose weights are the prior, to
    which its own are beside them; where nothing can be left out, those of the kept touches are as well.
    """
    keys = {row: key for key, row in sorted(recall.rows().items()) if key in apart}
    stands_for = _left_out({row: apart[key].margin for row, key in keys.items()})
    rows, names = sorted(stands_for), recall.materials
    if len(rows) < FEWEST or len(names) < 2:
        recalled = recalled_of(power * UNSEEN, recall.measured.likelihood.table(CLEAN).certainty)
        sure = SURE if apart else 0.0  # with one touch of each, any other looks as if noise had come over it
        return Pooled(recall, float(PRIOR[0]), recalled, recalled, np.inf, 0.0, 1.0 / UNMEASURED, sure)
    told = [apart[keys[row]] for row in rows]
    found = [recall.recollect(recall.levels(row), left_out=row) for row in rows]
    common = [i for i, name in enumerate(names) if all(name in touch.logits for touch in told)]
    targets = [[names[i] for i in common].index(touch.material) for touch in told]
    familiar = float(np.quantile([touch.strange for touch in apart.values()], USUAL))
    certainty = np.maximum([recollection.certainty for recollection in found], LEAST_CERTAINTY)
    usual = float(np.median(certainty))
    # Both as they are weighed where they are asked, see `prediction.recalling`: β is nearly r / c.
    parts = [
        familiarity_of(familiar, touch.strange, own_time=True) * (1 - recollection.trust)
        for touch, recollection in zip(told, found, strict=True)
    ]
    heard = np.array([[touch.logits[names[i]] for i in common] for touch in told]) * np.array(parts)[:, None]
    kept = np.array([recollection.scores[common] for recollection in found]) * (usual / certainty)[:, None]
    counts = np.array([stands_for[row] for row in rows])
    trusted, steepness = fit_weights(np.stack([heard, kept], axis=1), targets, PRIOR, PRIOR_TOUCHES, counts).tolist()
    by_itself = float(fit_weights(kept[:, None], targets, PRIOR[1:], PRIOR_TOUCHES, counts)[0])
    recalled, alone = (recalled_of(value, usual) for value in (steepness, by_itself))
    surprise = np.array([recollection.surprise for recollection in found])
    spread = max(float(surprise.std()), MOST_SPREAD)
    return Pooled(recall, trusted, recalled, alone, familiar, float(surprise.mean()), spread)


def _left_out(margins: Mapping[int, float]) -> dict[int, float]:
    """The rows that are left out, of those with these margins, and how many touches each stands for.

    Half of them are the least sure, where it matters which of the two is believed. Each of the others, taken at random,
    stands for many: else the weights were too small for all but those that are taken for another material.
    """
    unsure = sorted(margins, key=lambda row: margins[row])[: LEFT_OUT // 2]
    others = [row for row in margins if row not in unsure]
    chosen = [others[i] for i in spaced(others, LEFT_OUT // 2)]
    return dict.fromkeys(unsure, 1.0) | dict.fromkeys(chosen, len(others) / max(len(chosen), 1))


def familiarity_of(familiar: float, strange: float, own_time: bool) -> float:
    """How far the model is believed of a touch beside a usual one, in (0, 1]: less, the stranger it is.

    own_time: whether it is compared with beginnings: then no less than one that is just familiar.
    """
    if not (np.isfinite(familiar) and np.isfinite(strange)):
        return 1.0
    least = (1.0 if own_time else LEAST_FAMILIAR) / max(familiar, 1.0)
    return float(np.clip(1.0 / max(strange, MOST_SPREAD), least, 1.0))


def recalled_of(steepness: float, certainty: float) -> float:
    """r, of which β is the steepness that was fitted, where the certainty is that of the touches it was fitted to."""
    return 1 / (1 + max(1 / max(steepness, LEAST_STEEPNESS) - 1, 0.0) / max(certainty, LEAST_CERTAINTY))
