"""Kept touches asked beside the model, where a touch is not as those that were learned.

A touch that the model knows well is its alone. One that looks strange to it, that it is not sure of, or that has
another length than those learned, is compared with kept touches as well (see `readouts.recall`): with their beginnings,
and with the whole of each, as one made at another speed. Channels that never change are filled in with what the kept
touches have there, and the touch is judged again. Then, for each way to compare it,

    p_y ∝ exp(g (1 − t) log d_y + β S_y),    β = 1 / (1 + (1/r − 1) c),

d the model's probabilities, S the log-likelihoods of the kept touches, t which part of how the touch differs from them
is noise (`Recollection.trust`), c how far noise leaves it to be seen that neighbouring values deviate together. g and r
are fitted to touches left out, for the beginnings of touches at each of some moments (see `readouts.early`). As noise
and strangeness take the model's word, β goes to that of the kept touches alone. The two ways weigh exp(COUNTED e), e
the evidence for each, per value.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scroll_tactile.prediction.beginnings import early_answers
from scroll_tactile.prediction.comparing import Compared, compared
from scroll_tactile.prediction.features import Encoded, FeatureExtractor
from scroll_tactile.prediction.model import Judgement, Model
from scroll_tactile.readouts.early import Moment
from scroll_tactile.readouts.pooled import Pooled

__all__ = ["judged", "together"]

COUNTED = 30.0  # values, as which the evidence for a way to compare a touch counts: neighbours say the same


def judged(model: Model, extractor: FeatureExtractor, candidates: Sequence[str], encoded: Encoded) -> Judgement:
    """What a model says of an encoded touch, and what kept touches add to it where it is not sure."""
    judgement = model.judge(candidates, encoded.means, encoded.columns)
    pooled = model.pooled
    if pooled is None or (
        judgement.probability.max() >= pooled.sure
        and judgement.strange <= pooled.familiar
        and model.least <= len(encoded.stream) <= model.longest
    ):
        return judgement
    early = early_answers(model, extractor) if encoded.columns < model.least else None
    moment = None if early is None else early.at(encoded.columns)
    ways = compared(model, extractor, candidates, encoded, judgement, pooled)
    answers = [together(pooled, candidates, way, moment if way.own_time else None) for way in ways]
    evidence = np.array([way.recollection.evidence for way in ways])
    weights = np.exp(COUNTED * (evidence - evidence.max()))
    probability = weights @ np.array([answer.probability for answer in answers])
    best = answers[int(weights.argmax())]
    return Judgement(probability / probability.sum(), best.novelty, best.calibration, best.strange)


def together(pooled: Pooled, candidates: Sequence[str], way: Compared, moment: Moment | None) -> Judgement:
    """What the model and the kept touches say of a touch, compared in one way; moment: of a beginning."""
    judgement, recollection = way.judgement, way.recollection
    beside = pooled if moment is None else moment.believed(pooled)
    familiarity = beside.familiarity(judgement.strange, way.own_time)
    heard = familiarity * beside.trusted * way.logs
    logits = heard + way.scores(pooled, candidates) * beside.steepness(recollection, familiarity)
    chances = np.exp(logits - logits.max())
    chances /= chances.sum()
    novelty, calibration = way.novelty(pooled), judgement.calibration
    if moment is not None:
        chances = moment.tempered(chances)
        novelty, calibration = moment.novelty(novelty), moment.calibrated(calibration)
    return Judgement(chances, novelty, calibration, judgement.strange)
