"""A touch judged: by the readouts, and beside kept touches where it is not as those that were learned.

A touch that the readouts know well is theirs alone. One that lies far from all that was learned, that they are not sure
of, or that has another length than those learned, is compared with kept touches as well (see `matching.matcher`): with
their beginnings, and with the whole of each, as one made at another pace. These are two hypotheses, each judged by its
own row of the table (see `prediction.moments`), and they weigh exp(COUNTED e), e the log-likelihood gain per value.
Channels that never change are filled in with what the kept touches have there, and the touch is judged again. The
readouts weigh less the further the touch lies from what was learned (w, `Moment.distance_weight`), and the larger the
share t of its deviation from kept touches that is noise (`Match.noise_share`):

    q_y ∝ exp(w g (1 − t) log d_y + β S_y),    p_y = (1 − ε) q_y + ε / C.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.likelihood import LevelArray, levels_of
from scroll_tactile.matching.match import Match
from scroll_tactile.matching.matcher import TouchMatcher
from scroll_tactile.prediction.features import Encoded, FeatureExtractor, stream_of
from scroll_tactile.prediction.model import Hypothesis, Judgement, Model
from scroll_tactile.prediction.moments import WITHIN, match_scores, tempered
from scroll_tactile.results import Unusual
from scroll_tactile.signals.stream import Stream

__all__ = ["fused", "judged", "levels_seen"]

FloatArray = npt.NDArray[np.float64]

COUNTED = 30.0  # independent values that the gain per value counts as: neighbouring values are correlated
TINY = 1e-300


def judged(model: Model, extractor: FeatureExtractor, candidates: Sequence[str], encoded: Encoded) -> Judgement:
    """The judgement of an encoded touch by a model; the candidates are what its material may be."""
    fusion, columns = model.fusion, encoded.columns
    assert fusion is not None
    usual: Hypothesis = "complete" if columns >= model.least else "beginning"
    alone = model.judge(candidates, encoded.means, columns, usual)
    matcher = fusion.matcher
    usual_length = model.least <= len(encoded.stream) <= model.longest
    if matcher is None or (usual_length and alone.moment.suffices(float(alone.probability.max()), alone.distance)):
        return _by_readouts(model, encoded, alone, usual)
    levels = levels_seen(encoded.stream)
    matches: list[tuple[Match, Hypothesis, bool]] = [(matcher.match(levels), usual, True)]
    if levels.shape[1] != matcher.kept.longest and fusion.reaches(levels.shape[1]):
        whole = matcher.match(levels, whole=True)
        if whole.log_likelihood_gain > 0:  # kept touches at its length explain it better than chance
            matches.append((whole, "paced", False))
    filled = _filled(
        model, extractor, encoded, max((match for match, *_ in matches), key=lambda match: match.log_likelihood_gain)
    )
    answers = []
    for match, hypothesis, own_time in matches:
        judgement = alone if filled is encoded and hypothesis == usual else None
        means = filled.means
        if hypothesis == "paced":
            kept = stream_of(levels_seen(filled.stream), extractor.sensor)
            means = extractor.means(extractor.image(kept), model.views)
        judgement = judgement or model.judge(
            candidates, means, columns if own_time else len(encoded.stream), hypothesis
        )
        answers.append(fused(matcher, candidates, judgement, match, own_time=own_time))
    gains = np.array([match.log_likelihood_gain for match, *_ in matches])
    weights = np.exp(COUNTED * (gains - gains.max()))
    probability = weights @ np.array([answer.probability for answer in answers])
    best = int(weights.argmax())
    unusual = _unusual(model, encoded, matches[best][0], matches[best][1])
    return replace(answers[best], probability=probability / probability.sum(), unusual=unusual)


def _by_readouts(model: Model, encoded: Encoded, alone: Judgement, hypothesis: Hypothesis) -> Judgement:
    """The judgement by the readouts. The kept touches name what differs in a novel touch."""
    unusual = _of_length(model, encoded)
    if model.matcher is not None and alone.novelty > alone.moment.threshold(1 - WITHIN):
        unusual = _unusual(model, encoded, model.matcher.match(levels_seen(encoded.stream)), hypothesis)
    return replace(alone, probability=tempered(alone.probability, alone.moment.model_outlier_rate), unusual=unusual)


def fused(
    matcher: TouchMatcher,
    candidates: Sequence[str],
    alone: Judgement,
    match: Match,
    *,
    own_time: bool,
) -> Judgement:
    """The judgement of a touch by the readouts and the kept touches together. alone: that by the readouts.

    own_time: whether it was compared with beginnings, and not with whole touches brought to its length.
    """
    moment = alone.moment
    distance_weight = moment.distance_weight(alone.distance, own_time)
    logs = (1 - match.noise_share) * np.log(np.maximum(alone.probability, TINY))
    match_weight = moment.match_weight_at(match, distance_weight)
    logits = distance_weight * moment.model_weight * logs + match_scores(matcher, candidates, match) * match_weight
    chances = np.exp(logits - logits.max())
    chances = tempered(chances / chances.sum(), moment.outlier_rate)
    novelty = (1 - match.noise_share) * alone.novelty + match.noise_share * moment.matched_novelty(match)
    return replace(alone, probability=chances, novelty=float(novelty))


def _unusual(model: Model, encoded: Encoded, match: Match, hypothesis: Hypothesis) -> tuple[Unusual, ...]:
    """What sets a touch apart from those that were learned, if the kept touches explain it so."""
    found: list[Unusual] = list(_of_length(model, encoded))
    if found and hypothesis == "paced":
        found = ["faster" if found == ["shorter"] else "slower"]
    marks: tuple[tuple[Unusual, bool], ...] = (
        ("noisy", match.noise_share > 0.5),
        ("zero moved", match.moved),
        ("channels dead", bool(match.stuck.any())),
    )
    return (*found, *(mark for mark, holds in marks if holds))


def _of_length(model: Model, encoded: Encoded) -> tuple[Unusual, ...]:
    if encoded.columns < model.least:
        return ("shorter",)
    return ("longer",) if encoded.seconds < encoded.stream.seconds else ()


def levels_seen(stream: Stream) -> LevelArray:
    """The levels of a touch, (C, T); MISSING marks each value that was not read (`Stream.mask`)."""
    readings = stream.readings if stream.mask is None else np.where(stream.mask, np.nan, stream.readings)
    return levels_of(readings, stream.sensor)


def _filled(model: Model, extractor: FeatureExtractor, encoded: Encoded, match: Match) -> Encoded:
    """The touch with its stuck channels as kept touches have them, where that changes any of its levels."""
    stream = encoded.stream
    readings = match.filled(stream.readings, stream.sensor)
    if np.array_equal(levels_of(readings, stream.sensor), levels_of(stream.readings, stream.sensor)):
        return encoded
    readings.setflags(write=False)
    scales = [*encoded.means]
    return extractor.encode(Stream(stream.sensor, readings), model.longest, lambda columns: scales)
