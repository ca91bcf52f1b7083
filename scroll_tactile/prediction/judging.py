"""The prediction for a touch, or for several of one thing: readouts and kept touches judge each of them.

If the readouts are sure of a touch, they alone judge it. If they are unsure, or the touch lies far from all learned
ones or is shorter or longer than these, it is matched with kept touches as well (see `matching.matcher`), under two
hypotheses: it is a prefix of such a touch, or a whole one at another pace. Each hypothesis is judged by its own row of
the `moment_table` and weighs exp(COUNTED e), e the log-likelihood gain per value. Channels that never change are filled
in with what the kept touches have there, and the touch is judged again. The readouts weigh less the further the touch
lies from what was learned (w, `Moment.distance_weight`), and the larger the share t of its deviation from kept touches
that is noise (`Match.noise_share`):

    q_y ∝ exp(w g (1 − t) log d_y + β S_y),    p_y = (1 − ε) q_y + ε / C.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.conformal import Typicality
from scroll_tactile.matching.likelihood import LevelArray, levels_of
from scroll_tactile.matching.match import Match
from scroll_tactile.matching.matcher import TouchMatcher
from scroll_tactile.prediction.features import Encoded, FeatureExtractor, stream_of
from scroll_tactile.prediction.model import Hypothesis, Judgement, Model
from scroll_tactile.prediction.moment_table import WITHIN, match_scores, tempered
from scroll_tactile.readouts.calibration import held_out_probabilities
from scroll_tactile.readouts.estimation import Estimator
from scroll_tactile.readouts.leave_one_out import StageScores
from scroll_tactile.results import Estimate, Prediction, Unusual
from scroll_tactile.signals.stream import Stream
from scroll_tactile.statistics.moments import one_thread

__all__ = ["HeldOutTouch", "Touch", "answer", "estimates_of", "held_out_touches", "judged"]

FloatArray = npt.NDArray[np.float64]
Touch = tuple[Encoded, Mapping[str, float] | None]
"""An encoded touch, and the logits of f* where it answers."""

COUNTED = 30.0  # the effective number of independent values in a touch: neighbouring values are correlated
TINY = 1e-300


def answer(
    model: Model,
    extractor: FeatureExtractor,
    candidates: Sequence[str],
    touches: Sequence[Touch],
    false_alarms: float,
) -> Prediction:
    """The prediction for touches of one thing, which is one of the candidates; one touch or more.

    false_alarms: as in `Settings`.

    Probabilities and novelties of several touches add up as far as the touches are independent (see
    `readouts.dependence`), in any order to the same bits; a touch that comes twice counts once. The p of their
    typicality is twice the mean of theirs, a bound that holds whatever the dependence between them (Vovk and Wang
    2020).
    """
    once = {touch.stream.key: (touch, logits) for touch, logits in touches} if len(touches) > 1 else {b"": touches[0]}
    own = [once[key] for key in sorted(once)]
    with one_thread():
        judgements = [judged(model, extractor, candidates, touch, logits) for touch, logits in own]
        typical = _typicality(model, candidates, [touch for touch, _ in own])
    probability, novelty = judgements[0].probability, judgements[0].novelty
    if len(judgements) > 1:
        probability = model.dependence.probability([judgement.probability for judgement in judgements])
        novelty = model.dependence.standard([judgement.novelty for judgement in judgements])
    thresholds = [judgement.moment.threshold(false_alarms) for judgement in judgements]
    threshold = math.fsum(thresholds) / len(thresholds)
    order = np.argsort(-probability, kind="stable")  # candidates come in alphabetical order
    names = list(map(candidates.__getitem__, order.tolist()))
    ranking = tuple(zip(names, probability[order].tolist(), strict=True))
    seconds = math.fsum(touch.seconds for touch, _ in own)
    tuned = all(logits is not None for _, logits in own)
    calibrations = [judgement.moment.calibration for judgement in judgements]
    measured = all(each.measures(false_alarms) for each in calibrations) and len(model.names) > 1
    detects = measured and any(each.detects(false_alarms) for each in calibrations)
    known = False if novelty > threshold else True if detects else None
    p_own, least_own, p_all, least_all = typical[order].T.tolist()
    unusual = tuple(sorted({way for judgement in judgements for way in judgement.unusual}))
    return Prediction(
        material=ranking[0][0],
        probability=ranking[0][1],
        ranking=ranking,
        novelty=novelty,
        known=known,
        seconds=seconds,
        tuned=tuned,
        typicality=tuple(p_own),
        typicality_of_all=tuple(p_all),
        least_typicality=(*least_own, max(least_all)),
        unusual=unusual,
    )


def judged(
    model: Model,
    extractor: FeatureExtractor,
    candidates: Sequence[str],
    encoded: Encoded,
    logits: Mapping[str, float] | None = None,
) -> Judgement:
    """The judgement of a touch by a model, or by the logits of f*."""
    if logits is not None:
        return model.judge(candidates, encoded.means, encoded.steps, "complete", logits)
    fusion, steps = model.fusion, encoded.steps
    assert fusion is not None
    own: Hypothesis = "complete" if steps >= model.least else "prefix"
    alone = model.judge(candidates, encoded.means, steps, own)
    matcher = fusion.matcher
    learned_length = model.least <= len(encoded.stream) <= model.longest
    if matcher is None or (learned_length and alone.moment.suffices(float(alone.probability.max()), alone.distance)):
        return _by_readouts(model, encoded, alone, own)
    levels = _levels_of(encoded.stream)
    matches: list[tuple[Match, Hypothesis]] = [(matcher.match(levels), own)]
    if levels.shape[1] != matcher.kept.longest and fusion.reaches(levels.shape[1]):
        whole = matcher.match(levels, whole=True)
        if whole.log_likelihood_gain > 0:  # kept touches, resampled to its length, explain it better than chance
            matches.append((whole, "paced"))
    gains = np.array([match.log_likelihood_gain for match, _ in matches])
    filled = _filled(model, extractor, encoded, matches[int(gains.argmax())][0])
    answers = []
    for match, hypothesis in matches:
        judgement = alone
        if hypothesis == "paced":
            complete = stream_of(_levels_of(filled.stream), extractor.sensor)
            means = extractor.means(extractor.image(complete), model.views)
            judgement = model.judge(candidates, means, len(encoded.stream), hypothesis)
        elif filled is not encoded:
            judgement = model.judge(candidates, filled.means, steps, hypothesis)
        answers.append(_fused(matcher, candidates, judgement, match, own_time=hypothesis == own))
    weights = np.exp(COUNTED * (gains - gains.max()))
    probability = weights @ np.array([answer.probability for answer in answers])
    best = int(weights.argmax())
    unusual = _unusual(model, encoded, matches[best][0], matches[best][1])
    return replace(answers[best], probability=probability / probability.sum(), unusual=unusual)


def _typicality(model: Model, candidates: Sequence[str], touches: Sequence[Encoded]) -> FloatArray:
    """How typical touches are of each candidate, shape (C, 4); see `Typicality`."""
    shares = np.ones((len(touches), len(candidates), len(Typicality._fields)))
    if model.conformal is None:
        return np.asarray(shares[0])
    for own, touch in zip(shares, touches, strict=True):
        rows, among = model.conformal.places(candidates)
        own[among] = model.conformal.p_rows(_levels_of(touch.stream))[rows]
    if len(shares) == 1:
        return np.asarray(shares[0])
    sums = [[math.fsum(column) for column in of.T] for of in shares.transpose(1, 0, 2)]
    return np.minimum(1.0, 2 * np.array(sums) / len(shares))


def _by_readouts(model: Model, encoded: Encoded, alone: Judgement, hypothesis: Hypothesis) -> Judgement:
    """The judgement by the readouts. For a novel touch its match names how it differs."""
    unusual = _of_length(model, encoded)
    if model.matcher is not None and alone.novelty > alone.moment.threshold(1 - WITHIN):
        unusual = _unusual(model, encoded, model.matcher.match(_levels_of(encoded.stream)), hypothesis)
    return replace(alone, probability=tempered(alone.probability, alone.moment.model_outlier_rate), unusual=unusual)


def _fused(
    matcher: TouchMatcher,
    candidates: Sequence[str],
    alone: Judgement,
    match: Match,
    *,
    own_time: bool,
) -> Judgement:
    """The judgement of a touch by the readouts and the kept touches together. alone: that by the readouts.

    own_time: whether it was matched with prefixes, and not with whole touches resampled to its length.
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
    """How a touch differs from the learned ones, by its length and its match with kept touches."""
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
    if encoded.steps < model.least:
        return ("shorter",)
    return ("longer",) if encoded.seconds < encoded.stream.seconds else ()


def _levels_of(stream: Stream) -> LevelArray:
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
    return extractor.encode(Stream(stream.sensor, readings), model.longest, lambda steps: scales)


@dataclass(frozen=True)
class HeldOutTouch:
    """The answer to a touch by a model without it.

    material, key: its own. names: the materials it was weighed among, in alphabetical order. probability: of each,
    shape (C,). novelty: see `Prediction`. threshold: a novelty above it is called unknown.
    """

    material: str
    key: bytes
    names: tuple[str, ...]
    probability: FloatArray
    novelty: float
    threshold: float

    @property
    def answer(self) -> str:
        """The likeliest material."""
        return self.names[int(self.probability.argmax())]

    @property
    def confidence(self) -> float:
        """Its probability."""
        return float(self.probability.max())

    @property
    def known(self) -> bool:
        """Whether it is not called unknown."""
        return self.novelty <= self.threshold


def held_out_touches(model: Model, false_alarms: float) -> list[HeldOutTouch]:
    """Answers of a model, just fitted, to the sampled touches, each held out of readouts and kept touches.

    They are weighed among the materials that have a sampled touch. A touch that is its material's only one is omitted.
    The calibration was fitted to all of them, each one included; no other pace is tried, no dead channel filled in.
    false_alarms: as in `Settings`.
    """
    fusion, answers = model.fusion, dict[int, HeldOutTouch]()
    if fusion is None:
        return []
    matcher = fusion.matcher
    rows = {} if matcher is None else matcher.kept.rows()
    for stage in range(len(model.calibrations) - 1, -1, -1):
        calibration = model.calibration("complete", fusion.complete, stage)
        scales, moment = model.scales("complete", stage), fusion.latest(stage)
        found = StageScores(stage, model.sample, [model.held_out[scale] for scale in scales])
        held = held_out_probabilities(found, scales, calibration)
        for i, place in enumerate(held.places):
            if place in answers:
                continue
            material, key, _ = model.sample[place]
            chances = np.exp(held.logs[i])
            alone = Judgement(chances, float(held.novelty[i]), moment, float(held.distance[i]))
            if matcher is not None and key in rows and not moment.suffices(float(chances.max()), alone.distance):
                match = matcher.match(matcher.kept.levels(rows[key]), held_out=rows[key])
                result = _fused(matcher, held.names, alone, match, own_time=True)
            else:
                result = replace(alone, probability=tempered(chances, moment.model_outlier_rate))
            threshold = moment.threshold(false_alarms)
            names = tuple(held.names)
            answers[place] = HeldOutTouch(material, key, names, result.probability, result.novelty, threshold)
    return list(answers.values())


def estimates_of(
    estimator: Estimator,
    wanted: Sequence[str],
    encoded: Encoded | None,
    extractor: FeatureExtractor,
    prediction: Prediction,
    risk: float,
    known: bool | None,
) -> dict[str, Estimate]:
    """Estimate quantities of a touch with a prediction. encoded: None where the memory has observed nothing.

    known: whether the intervals are those for a learned material; None: the prediction's `known` decides, and where
    that is None they are those for a new one.
    """
    as_known = prediction.known is True if known is None else known
    unusual = set(prediction.unusual)
    if encoded is not None and estimator.stage(encoded.steps) < estimator.last:
        unusual.discard("shorter")  # than complete ones: earlier heads are of touches cut at a milestone
    inside = prediction.known is not False and not unusual
    if encoded is None:
        found = estimator.estimate(wanted, {}, 0, risk, known=as_known)
    else:
        length, means = estimator.length(encoded.steps), encoded.means
        if length < encoded.steps:
            means = extractor.means(encoded.image[:, :length], estimator.scales_for(encoded.steps))
        found = estimator.estimate(wanted, means, encoded.steps, risk, known=as_known)
    return {name: replace(own, inside=inside, seconds=prediction.seconds) for name, own in found.items()}
