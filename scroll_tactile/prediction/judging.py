"""The prediction for a touch, or for several of one thing: readouts and kept touches judge each of them.

If the readouts are sure of a touch of a learned length, they alone judge it. If they are unsure, or the touch lies far
from all learned ones or is shorter or longer than these, it is matched with kept touches as well (see
`matching.matcher`): as the prefix of such a touch, and, if its length lies outside the learned ones, also as a whole
one at another pace. Each hypothesis is judged by its own `Row` and weighs exp(COUNTED e), e the log-likelihood gain per
value. Noise is sought where the touch is unlikely without any. Channels that never change are filled in with what the
kept touches have there, and the touch is judged again.

The readouts weigh less the further the touch lies from what was learned (w), and the larger the share t of its
deviation from kept touches that is noise (`Match.noise_share`). With d their probabilities, S the log-likelihoods by
the kept touches, c the information of these values and h = (1 − t) w:

    q_y ∝ exp(h log d_y + (b h + 1 − h) β S_y),    β = 1 / (1 + (1/τ − 1) c),    p_y = (1 − ε) q_y + ε / C.

b is BESIDE. A log-likelihood counts by its share of a whole touch's information: one τ serves all lengths and noises.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.likelihood import CLEAN
from scroll_tactile.matching.matcher import Match
from scroll_tactile.prediction.features import Encoded, FeatureExtractor
from scroll_tactile.prediction.fitting import paces_of
from scroll_tactile.prediction.model import WITHIN, Hypothesis, Judgement, Model
from scroll_tactile.readouts.calibration import softmax, tempered
from scroll_tactile.readouts.estimation import Estimator
from scroll_tactile.readouts.novelty import NoveltyThresholds
from scroll_tactile.results import Estimate, Prediction, Unusual
from scroll_tactile.signals.levels import LevelArray, levels_of, stream_of
from scroll_tactile.signals.stream import Stream
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import one_thread

__all__ = ["HeldOutTouch", "answer", "estimates_of", "held_out_touches", "judged", "prediction_of"]

FloatArray = npt.NDArray[np.float64]
Names = Sequence[str]
Matched = tuple[Hypothesis, Match, float]
"""A touch beside kept ones under a hypothesis, and its excess loss where no noise came over it."""

COUNTED = 30.0  # the effective number of independent values in a touch: neighbouring values are correlated
LEAST_SHARE = 1e-5  # a hypothesis of less weight is not judged
LIKELY = 2.0  # spreads of the excess loss of known touches up to which no noise is sought
PACES = 0.4, 2.5  # times the median length of kept touches: what another pace can explain


def answer(
    model: Model,
    extractor: FeatureExtractor,
    candidates: Names,
    touches: Sequence[Encoded],
    false_alarms: float,
) -> Prediction:
    """The prediction for touches of one thing, which is one of the candidates. false_alarms: as in `Settings`.

    Probabilities and novelties of several touches add up as far as the touches are independent (see `Dependence`), in
    any order to the same bits; a touch that comes twice counts once. The p of their typicality is twice the mean of
    theirs, a bound that holds whatever the dependence between them (Vovk and Wang 2020).
    """
    once = {touch.stream.key if len(touches) > 1 else b"": touch for touch in touches}  # one alone needs no hash
    own = [once[key] for key in sorted(once)]
    with one_thread():
        judgements = [judged(model, extractor, candidates, touch) for touch in own]
        typical = _typicality(model, candidates, own)
    probability, novelty = judgements[0].probability, judgements[0].novelty
    if len(judgements) > 1:
        probability = model.fitted.dependence.probability([judgement.probability for judgement in judgements])
        novelty = model.fitted.dependence.standard([judgement.novelty for judgement in judgements])
    thresholds = [judgement.row.calibration.thresholds for judgement in judgements]
    found = prediction_of(candidates, probability, novelty, thresholds, false_alarms)
    unusual = {way for judgement in judgements for way in judgement.unusual}
    places = {name: place for place, name in enumerate(candidates)}
    own_share, own_least, all_share, all_least = typical[[places[name] for name, _ in found.ranking]].T.tolist()
    return replace(
        found,
        known=None if found.known and "noisy" in unusual else found.known,
        seconds=math.fsum(touch.seconds for touch in own),
        tuned=all(touch.logits is not None for touch in own),
        typicality=tuple(own_share),
        typicality_of_all=tuple(all_share),
        least_typicality=(*own_least, max(all_least)),
        unusual=tuple(sorted(unusual)),
    )


def prediction_of(
    names: Names, probability: FloatArray, novelty: float, thresholds: Sequence[NoveltyThresholds], false_alarms: float
) -> Prediction:
    """What is said of touches of one thing. names: in alphabetical order. thresholds: of each touch."""
    order = np.argsort(-probability, kind="stable").tolist()
    ranking = tuple((names[place], float(probability[place])) for place in order)
    above = [each.above(ranking[0][0], false_alarms) for each in thresholds]
    below = [each.below(false_alarms) for each in thresholds]
    known = True if novelty < math.fsum(below) / len(below) else None
    if novelty > math.fsum(above) / len(above):
        known = False
    return Prediction(*ranking[0], ranking, novelty, known, seconds=0.0)


def judged(model: Model, extractor: FeatureExtractor, candidates: Names, encoded: Encoded) -> Judgement:
    """The judgement of a touch by a model, or by the logits of f*."""
    if (logits := encoded.logits) is not None:
        row = model.fitted.row("complete", len(model.fitted.rows) - 1)
        chances = softmax(np.array([logits[name] for name in candidates]))
        return Judgement(chances, model.novelty(row, encoded.means, candidates), row)
    weighing = model.fitted
    own: Hypothesis = "complete" if encoded.steps >= weighing.least else "prefix"
    alone = _alone(model, extractor, candidates, encoded)
    length, matcher = len(encoded.stream), model.matcher
    learned = weighing.least <= length <= model.longest
    if matcher is None or (learned and alone.row.suffices(float(alone.probability.max()), alone.distance)):
        return _by_readouts(model, encoded, alone)
    hypotheses = [own]
    shortest, longest = (part * float(np.median(matcher.kept.columns)) for part in PACES)
    if model.views and not learned and shortest <= length <= longest:
        hypotheses.append("paced")
    matches = _matches(model, encoded.levels, hypotheses, alone)
    gains = np.array([match.log_likelihood_gain for _, match, _ in matches])
    likeliest, best, _ = matches[int(gains.argmax())]
    filled = encoded if likeliest != own else _filled(model, extractor, encoded, best)
    answers = []
    for hypothesis, match, clean in matches:
        if hypothesis == "paced":
            judgement = _paced(model, extractor, candidates, filled, clean)
        else:
            judgement = alone if filled is encoded else _alone(model, extractor, candidates, filled)
        answers.append(_fused(model, candidates, judgement, hypothesis, match))
    weights = np.exp(COUNTED * (gains - gains.max()))
    probability = weights @ np.array([answer.probability for answer in answers])
    unusual = _unusual(model, encoded, best, likeliest)
    return replace(answers[int(weights.argmax())], probability=probability / probability.sum(), unusual=unusual)


def _alone(model: Model, extractor: FeatureExtractor, candidates: Names, encoded: Encoded) -> Judgement:
    """The judgement by the readouts. How new a beginning is, is told by its last milestone: sampled touches went on."""
    (*earlier, last), complete = model.fitted.rows, encoded.steps >= model.fitted.least
    found = model.judge(candidates, encoded.means, encoded.steps, "complete" if complete else "prefix")
    if complete or found.row is not last or not earlier:
        return found
    means = extractor.means(encoded.image[:, : earlier[-1].steps], earlier[-1].scales)
    calibration = replace(last.calibration, thresholds=earlier[-1].calibration.thresholds)
    novelty = model.novelty(earlier[-1], means, candidates)
    return replace(found, novelty=novelty, row=replace(last, calibration=calibration))


def _matches(
    model: Model, levels: LevelArray, hypotheses: Sequence[Hypothesis], alone: Judgement, held_out: int | None = None
) -> list[Matched]:
    """The matches of a touch by each hypothesis that is likely enough to be judged.

    held_out: the row of the kept touch that it is, if it is one.
    """
    matcher = model.matcher
    assert matcher is not None
    queries = [matcher.query(levels, whole=hypothesis == "paced", held_out=held_out) for hypothesis in hypotheses]
    clean = found = [matcher.beside(query, CLEAN) for query in queries]
    likeliest = max(range(len(found)), key=lambda i: found[i].gain)
    row = alone.row if hypotheses[likeliest] != "paced" else model.fitted.paced
    if found[likeliest].excess > row.excess[0] + LIKELY * row.excess[1]:
        found = [matcher.beside(query, None) for query in queries]
    most, span = max(each.gain for each in found), -math.log(LEAST_SHARE) / COUNTED
    return [
        (hypothesis, matcher.result(each), without.excess)
        for hypothesis, each, without in zip(hypotheses, found, clean, strict=True)
        if each.gain > most - span
    ]


def _paced(model: Model, extractor: FeatureExtractor, candidates: Names, encoded: Encoded, clean: float) -> Judgement:
    """The judgement by the readouts of a touch as a whole one at another pace. clean: see `Matched`."""
    means = extractor.means(extractor.image(stream_of(encoded.levels, extractor.sensor)), model.views)
    judgement, kept = model.judge(candidates, means, len(encoded.stream), "paced"), model.matcher
    assert kept is not None
    if (paces := paces_of(model, extractor)) is None:
        return judgement
    values = np.append(model.distances(judgement.row.scales, means, candidates), clean)
    pace = float(np.median(kept.kept.columns)) / len(encoded.stream)
    return replace(judgement, novelty=paces.novelty(values, pace))


def _typicality(model: Model, candidates: Names, touches: Sequence[Encoded]) -> FloatArray:
    """How typical touches are of each candidate, shape (C, 4); see `Conformal.p_rows`."""
    if model.matcher is None:
        return np.ones((len(candidates), 4))
    shares = [model.matcher.conformal.p_rows(touch.levels, candidates) for touch in touches]
    if len(shares) == 1:
        return shares[0]
    sums = [[math.fsum(column) for column in of.T] for of in np.stack(shares, axis=1)]
    return np.minimum(1.0, 2 * np.array(sums) / len(shares))


def _by_readouts(model: Model, encoded: Encoded, alone: Judgement) -> Judgement:
    """The judgement by the readouts. For a novel touch its match names how it differs."""
    unusual = _unusual(model, encoded)
    if model.matcher is not None and alone.novelty > alone.row.calibration.thresholds.above("", 1 - WITHIN):
        match = model.matcher.match(encoded.levels, noise=None)
        unusual = _unusual(model, encoded, match)
    return replace(alone, probability=tempered(alone.probability, alone.row.readout_outliers), unusual=unusual)


def _fused(model: Model, candidates: Names, alone: Judgement, hypothesis: Hypothesis, match: Match) -> Judgement:
    """The judgement of a touch by the readouts and the kept touches together. alone: that by the readouts."""
    assert model.matcher is not None
    scores = model.matcher.scores_of(candidates, match)
    logits = model.fitted.logits(hypothesis, alone.probability, match, scores, alone.distance)
    share, (mean, spread) = match.noise_share, alone.row.excess  # of touches without noise: it hides how new one is
    novelty = (1 - share) * alone.novelty + share * (match.excess_loss - mean) / spread
    return replace(alone, probability=tempered(softmax(logits), alone.row.outliers), novelty=float(novelty))


def _unusual(
    model: Model, encoded: Encoded, match: Match | None = None, hypothesis: Hypothesis = "complete"
) -> tuple[Unusual, ...]:
    """How a touch differs from the learned ones, by its length and, where it was matched, by its kept neighbours."""
    short, long = encoded.steps < model.fitted.least, encoded.seconds < encoded.stream.seconds
    paced = hypothesis == "paced"
    marks: list[tuple[Unusual, bool]] = [("faster" if paced else "shorter", short)]
    marks.append(("slower" if paced else "longer", long and not short))
    if match is not None:
        marks += [("noisy", match.noise_share > 0.5), ("zero moved", match.moved)]
        marks.append(("channels dead", bool(match.stuck.any())))
    return tuple(mark for mark, holds in marks if holds)


def _filled(model: Model, extractor: FeatureExtractor, encoded: Encoded, match: Match) -> Encoded:
    """The touch with its stuck channels as kept touches have them, where that changes any of its levels."""
    stream = encoded.stream
    readings = match.filled(stream.readings, stream.sensor)
    if np.array_equal(levels_of(readings, stream.sensor), levels_of(stream.readings, stream.sensor)):
        return encoded
    readings.setflags(write=False)
    return extractor.encode(Stream(stream.sensor, readings), model.longest, lambda steps: [*encoded.means])


class HeldOutTouch(NamedTuple):
    """A sampled touch of a material, and what a model without it says, among materials with a sampled touch."""

    material: str
    key: bytes
    said: Prediction


def held_out_touches(model: Model, false_alarms: float) -> list[HeldOutTouch]:
    """Answers of a model, just fitted, to the sampled touches, each held out of readouts and kept touches.

    A touch that is its material's only one is omitted. The calibration was fitted to all of them, each one included; no
    other pace is tried, no dead channel filled in. false_alarms: as in `Settings`.
    """
    weighing, matcher, answers = model.weighing, model.matcher, dict[int, HeldOutTouch]()
    if weighing is None:
        return []
    rows = {} if matcher is None else matcher.kept.rows()
    for stage in range(len(weighing.rows) - 1, -1, -1):
        row = weighing.row("complete", stage)
        found, logs, distances, novelties = model.held_out.by(row)
        for i, place in enumerate(found.places):
            if place in answers:
                continue
            material, key, _ = model.held_out.sample[place]
            chances = np.exp(logs[i])
            alone = Judgement(chances, float(novelties[i]), row, float(distances[i]))
            if matcher is not None and key in rows and not row.suffices(float(chances.max()), alone.distance):
                [(_, match, _)] = _matches(model, matcher.kept.levels[rows[key]], ["complete"], alone, rows[key])
                result = _fused(model, found.names, alone, "complete", match)
            else:
                result = replace(alone, probability=tempered(chances, row.readout_outliers))
            thresholds = [row.calibration.thresholds]
            said = prediction_of(found.names, result.probability, result.novelty, thresholds, false_alarms)
            answers[place] = HeldOutTouch(material, key, said)
    return list(answers.values())


def estimates_of(
    estimator: Estimator,
    wanted: Names,
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
    steps, means, unusual = 0, dict[Scale, FloatArray](), set(prediction.unusual)
    if encoded is not None:
        steps, means = encoded.steps, encoded.means
        if estimator.stage(steps) < estimator.last:
            unusual.discard("shorter")  # than complete ones: earlier heads are of touches cut at a milestone
        if (length := estimator.length(steps)) < steps:
            means = extractor.means(encoded.image[:, :length], estimator.scales_for(steps))
    found = estimator.estimate(wanted, means, steps, risk, known=as_known)
    inside = prediction.known is not False and not unusual
    return {name: replace(own, inside=inside, seconds=prediction.seconds) for name, own in found.items()}
