"""The prediction for a touch, or for several of one thing, from what a model and its kept touches say of each."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.conformal import Typicality
from scroll_tactile.prediction.features import Encoded, FeatureExtractor
from scroll_tactile.prediction.judging import judged, levels_seen
from scroll_tactile.prediction.model import Judgement, Model
from scroll_tactile.results import Prediction
from scroll_tactile.statistics.moments import one_thread

__all__ = ["answer"]

FloatArray = npt.NDArray[np.float64]
Touch = tuple[Encoded, Mapping[str, float] | None]
"""An encoded touch, and the logits of f* where it answers."""


def answer(
    model: Model,
    extractor: FeatureExtractor,
    candidates: Sequence[str],
    touches: Sequence[Touch],
    false_alarms: float,
) -> Prediction:
    """The prediction for touches of one thing, which is one of the candidates; one touch or more.

    false_alarms: as in `Settings`.

    What several say adds up as far as it is not the same (see `readouts.dependence`), in any order to the same bits.
    One that comes twice counts once. Of their novelties and thresholds it is likewise; the p of their typicality is
    twice the mean of theirs, which holds however they depend on each other (Vovk and Wang 2020).
    """
    once = {touch.stream.key: (touch, logits) for touch, logits in touches} if len(touches) > 1 else {b"": touches[0]}
    own = [once[key] for key in sorted(once)]
    with one_thread():
        said = [_judged(model, extractor, candidates, touch, logits) for touch, logits in own]
        typical = _typicality(model, candidates, [touch for touch, _ in own])
    if len(said) == 1:
        probability, novelty = said[0].probability, said[0].novelty
        threshold = said[0].moment.threshold(false_alarms)
    else:
        probability = model.dependence.probability([judgement.probability for judgement in said])
        novelty = model.dependence.standard([judgement.novelty for judgement in said])
        threshold = math.fsum(judgement.moment.threshold(false_alarms) for judgement in said) / len(said)
    order = np.argsort(-probability, kind="stable")  # candidates come in alphabetical order
    names = list(map(candidates.__getitem__, order.tolist()))
    ranking = tuple(zip(names, probability[order].tolist(), strict=True))
    seconds = math.fsum(touch.seconds for touch, _ in own)
    tuned = all(logits is not None for _, logits in own)
    measured = all(judgement.moment.calibration.measures(false_alarms) for judgement in said)
    known = False if novelty > threshold else True if measured and len(model.names) > 1 else None
    share, least, of_all, least_of_all = typical[order].T.tolist()
    unusual = tuple(sorted({way for judgement in said for way in judgement.unusual}))
    return Prediction(
        *ranking[0],
        ranking,
        novelty,
        known,
        seconds,
        tuned,
        tuple(share),
        tuple(of_all),
        (*least, max(least_of_all)),
        unusual,
    )


def _judged(
    model: Model,
    extractor: FeatureExtractor,
    candidates: Sequence[str],
    touch: Encoded,
    logits: Mapping[str, float] | None,
) -> Judgement:
    if logits is None:
        return judged(model, extractor, candidates, touch)
    return model.judge(candidates, touch.means, touch.columns, "complete", logits)


def _typicality(model: Model, candidates: Sequence[str], touches: Sequence[Encoded]) -> FloatArray:
    """How typical touches are of each candidate, shape (C, 4); see `Typicality`."""
    shares = np.ones((len(touches), len(candidates), len(Typicality._fields)))
    if model.conformal is None:
        return np.asarray(shares[0])
    for own, touch in zip(shares, touches, strict=True):
        for name, value in model.conformal.p_values(levels_seen(touch.stream)).items():
            place = bisect_left(candidates, name)  # they come in alphabetical order, and may be many
            if place < len(candidates) and candidates[place] == name:
                own[place] = value
    if len(shares) == 1:
        return np.asarray(shares[0])
    sums = [[math.fsum(column) for column in of.T] for of in shares.transpose(1, 0, 2)]
    return np.minimum(1.0, 2 * np.array(sums) / len(shares))
