"""Kept touches asked beside the model, where a touch is not as those that were learned.

A touch that the model knows well is its alone. One that looks strange to it, that it is not sure of, or that has
another length than those learned, is compared with kept touches as well (see `readouts.recall`): with their beginnings,
and with the whole of each, as one made at another speed. Channels that never change are filled in with what the kept
touches have there, and the touch is judged again. Then, for each way to compare it,

    p_y ∝ exp(g (1 − t) log d_y + β S_y),    β = 1 / (1 + (1/r − 1) c),

d the model's probabilities, S the log-likelihoods of the kept touches, t which part of how the touch differs from them
is noise (`Recollection.trust`), c how far noise leaves it to be seen that neighbouring values deviate together. g and r
are fitted to touches left out. The two ways weigh exp(COUNTED e), e the evidence for each, per value.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from scroll_tactile.prediction.features import Encoded, FeatureExtractor
from scroll_tactile.prediction.model import Judgement, Model
from scroll_tactile.readouts.likelihood import levels_of
from scroll_tactile.readouts.pooled import Pooled
from scroll_tactile.readouts.recollection import Recollection
from scroll_tactile.signals.stream import Stream

__all__ = ["judged"]

FloatArray = npt.NDArray[np.float64]

SURE = 0.99  # of the probability: less than that is looked up
COUNTED = 30.0  # values, as which the evidence for a way to compare a touch counts: neighbours say the same
TINY = 1e-300


def judged(model: Model, extractor: FeatureExtractor, candidates: Sequence[str], encoded: Encoded) -> Judgement:
    """What a model says of an encoded touch, and what kept touches add to it where it is not sure."""
    judgement = model.judge(candidates, encoded.means, encoded.columns)
    pooled = model.pooled
    if pooled is None or (
        judgement.probability.max() >= SURE
        and judgement.strange <= pooled.familiar
        and model.least <= len(encoded.stream) <= model.longest
    ):
        return judgement
    levels = levels_of(_seen(encoded.stream), encoded.stream.sensor)
    own_time = pooled.recall.recollect(levels)
    ways = [(own_time, True)]
    if levels.shape[1] != pooled.recall.longest and levels.shape[1] > 1:
        ways.append((pooled.recall.recollect(levels, whole=True), False))
    filled = _filled(model, extractor, encoded, max((way for way, _ in ways), key=lambda way: way.evidence))
    usual = encoded.columns >= model.least
    said = {usual: judgement} if filled is encoded else {}  # by the model, by whether the touch counts as a whole one
    for whole in {usual or not own_time for _, own_time in ways} - set(said):
        said[whole] = model.judge(candidates, filled.means, filled.columns, whole=whole)
    answers = [_answer(pooled, candidates, said[usual or not own_time], way, own_time) for way, own_time in ways]
    evidence = np.array([way.evidence for way, _ in ways])
    weights = np.exp(COUNTED * (evidence - evidence.max()))
    probability = weights @ np.array([answer.probability for answer in answers])
    best = answers[int(weights.argmax())]
    return Judgement(probability / probability.sum(), best.novelty, best.calibration, best.strange)


def _seen(stream: Stream) -> npt.NDArray[np.floating]:
    """The readings (T, C), NaN where one was missing."""
    return stream.readings if stream.mask is None else np.where(stream.mask, np.nan, stream.readings)


def _filled(model: Model, extractor: FeatureExtractor, encoded: Encoded, recollection: Recollection) -> Encoded:
    """The touch with its stuck channels as kept touches have them, where that changes any of its levels."""
    stream = encoded.stream
    readings = recollection.filled(stream.readings, stream.sensor)
    if np.array_equal(levels_of(readings, stream.sensor), levels_of(stream.readings, stream.sensor)):
        return encoded
    readings.setflags(write=False)
    needed = [*encoded.means]
    return extractor.encode(Stream(stream.sensor, readings), model.longest, lambda columns: needed)


def _answer(
    pooled: Pooled, candidates: Sequence[str], judgement: Judgement, recollection: Recollection, own_time: bool
) -> Judgement:
    """What the model and the kept touches say together, compared in one way."""
    places = {name: i for i, name in enumerate(pooled.recall.materials)}
    least = float(recollection.scores.min())
    scores = np.array([recollection.scores[places[name]] if name in places else least for name in candidates])
    heard = (
        pooled.familiarity(judgement.strange, own_time)
        * pooled.trusted
        * (1 - recollection.trust)
        * np.log(np.maximum(judgement.probability, TINY))
    )
    logits = heard + scores * pooled.steepness(recollection)
    chances = np.exp(logits - logits.max())
    novelty = (1 - recollection.trust) * judgement.novelty + recollection.trust * pooled.novelty(recollection)
    return Judgement(chances / chances.sum(), float(novelty), judgement.calibration, judgement.strange)
