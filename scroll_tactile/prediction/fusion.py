"""Fusion: weights of the readouts and the kept touches beside each other, fitted at each moment of a touch.

Which of them is right depends on how much was felt: kept touches classify 81 % of BioTac's touches after 0.1 s and 83 %
after 0.5 s, readouts 54 % and 94 %. So at each moment m, the last of them "complete",

    p_y = (1 − ε_m) q_y + ε_m / C,    q_y ∝ exp(g_m log d_y + β_m S_y),

d the readouts' probabilities, S the log-likelihoods of the kept touches. (g_m, β_m) ≥ 0 have least log loss on touches
held out of both. They are drawn to the weights fitted to this moment and its neighbours together. Those are drawn to
g = 1, and to half of the β at which the kept touches alone put their best material AHEAD logits ahead of the next. ε_m
is the share of touches that are unlike all others of their material; n held-out touches keep it above 0.5 / (n + 1).
One set of held-out touches serves all moments and paces; for complete touches the least sure ones join it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.likelihood import CLEAN
from scroll_tactile.matching.match import Match
from scroll_tactile.matching.matcher import TouchMatcher
from scroll_tactile.prediction.moment_table import (
    APART,
    LEAST_SPREAD,
    WITHIN,
    Fusion,
    Moment,
    Trajectories,
    match_scores,
    match_weight,
    tempered,
)
from scroll_tactile.readouts.calibration import (
    AHEAD,
    FEWEST,
    UNMEASURED,
    Calibration,
    HeldOutProbabilities,
    fit_weights,
)

__all__ = ["HeldOutMoment", "chosen_of", "full_match_weight", "fuse", "moments_of"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.intp]

MOST_HELD_OUT = 192  # touches, each compared with all kept ones at every moment
# How many touches a prior counts as: of the weights of neighbouring moments together (g = 1, half of the lone β), of
# the kept touches by themselves, and of the weights of one moment, drawn to those of its neighbours.
PRIOR_TOUCHES, ALONE_TOUCHES, SHARED_TOUCHES = 0.5, 2.0, 10.0
LEAST_PRIOR = 1e-3
PRIOR_OUTLIERS = 0.5  # of one more touch than the held-out ones
LEAST_INFORMATION, LEAST_WEIGHT = 1e-3, 1e-9
STEPS = 100  # of EM


def moments_of(milestones: Sequence[int], least: int, *, matched: bool) -> tuple[int, ...]:
    """The moments before a touch is complete, in steps: below `least`.

    milestones: lengths at which other readouts judge. matched: whether there are kept touches, of which any prefix
    can be seen: then there are two moments before the first milestone, and one between any two.
    """
    found = {steps for steps in milestones if steps < least}
    if matched:
        between = [round(math.sqrt(low * high)) for low, high in pairwise([*sorted(found), least])] if found else []
        for steps in [milestones[0] // 3, 2 * milestones[0] // 3, *between]:
            if 2 <= steps < least and all(max(steps, at) >= APART * min(steps, at) for at in found):
                found.add(steps)
    return tuple(sorted(found))


@dataclass(frozen=True)
class HeldOutMoment:
    """The results of readouts and kept touches on held-out touches at one moment, from `steps` on.

    stage, calibration: of the readouts. held_out: their probabilities. matches: of the kept touches, by key.
    """

    steps: int
    stage: int
    calibration: Calibration
    held_out: HeldOutProbabilities
    matches: Mapping[bytes, Match]


@dataclass(frozen=True)
class _FusionInputs:
    """The inputs of a fit at one moment, of the touches `reached`, that reached it; see `Trajectories`.

    logs: the term that g multiplies. scores: the term that β multiplies, for the common `information`; both (n, C).
    """

    reached: IntArray
    targets: IntArray
    counts: FloatArray
    logs: FloatArray
    scores: FloatArray
    information: float
    novelty: FloatArray
    excess_loss: FloatArray


def fuse(
    matcher: TouchMatcher | None,
    judged: Sequence[HeldOutMoment],
    paced: Sequence[HeldOutMoment],
    chosen: Sequence[bytes],
    counts: Mapping[bytes, float],
    prior_weight: float,
) -> Fusion:
    """Fit the table to held-out touches.

    judged: results by moment, ascending, the last of complete touches. paced: of complete touches at other paces,
    ascending by steps. chosen: the keys of the touches that are judged at all moments. counts: key → how many touches
    each complete one stands for. prior_weight: of the readouts' scores, without calibration.
    """
    names, even = judged[-1].held_out.names, dict.fromkeys(chosen, 1.0)
    inputs = [_at(matcher, one, names, even) for one in judged[:-1]]
    inputs.append(_at(matcher, judged[-1], names, counts))
    others = [_at(matcher, one, names, even) for one in paced]
    moments = _rows(matcher, judged, inputs, judged[-1], prior_weight)
    of_paced = _rows(matcher, paced, others, None, prior_weight)
    return Fusion(
        tuple(moments), tuple(of_paced), matcher, _trajectories(moments[:-1], inputs[:-1], len(chosen), len(names))
    )


def _rows(
    matcher: TouchMatcher | None,
    judged: Sequence[HeldOutMoment],
    inputs: Sequence[_FusionInputs],
    complete: HeldOutMoment | None,
    prior_weight: float,
) -> list[Moment]:
    """Rows of the table, each drawn to its neighbours."""
    rows = []
    for i, one in enumerate(judged):
        near = [other for other in inputs[max(0, i - 1) : i + 2] if len(other.targets) >= FEWEST]
        rows.append(_fitted(one, inputs[i], near, matcher, prior_weight, complete=one is complete))
    return rows


def chosen_of(complete: HeldOutProbabilities, matcher: TouchMatcher | None) -> tuple[list[bytes], dict[bytes, float]]:
    """The held-out touches that are judged at all moments, and how many touches each complete one stands for.

    First: at most MOST_HELD_OUT kept touches, evenly spaced by key. Second, by key: 1 for each of the least sure, where
    the weights matter most; the others share the count of all remaining touches.
    """
    kept = set() if matcher is None else matcher.kept.rows().keys()
    ranked = [key for _, key in sorted(zip(complete.margins.tolist(), complete.keys, strict=True)) if key in kept]
    keys, unsure = sorted(ranked), ranked[: MOST_HELD_OUT // 4]
    places = np.linspace(0, len(keys) - 1, min(MOST_HELD_OUT, len(keys))).round().astype(int)
    chosen = [keys[i] for i in places]
    surer = [key for key in chosen if key not in set(unsure)]
    each = (len(keys) - len(unsure)) / max(len(surer), 1)
    return chosen, dict.fromkeys(unsure, 1.0) | dict.fromkeys(surer, each)


def _at(
    matcher: TouchMatcher | None, judged: HeldOutMoment, names: Sequence[str], counts: Mapping[bytes, float]
) -> _FusionInputs:
    """The inputs at one moment of some touches, and how many each stands for."""
    chosen = list(counts)
    held = judged.held_out
    among, own = {key: i for i, key in enumerate(held.keys)}, {name: i for i, name in enumerate(held.names)}
    places = [own[name] for name in names if name in own]
    at = [number for number, key in enumerate(chosen) if key in among and key in judged.matches]
    if len(places) < len(names):
        at = []
    found = [among[chosen[number]] for number in at]
    matches = [judged.matches[chosen[number]] for number in at]
    matched = [] if matcher is None else [match_scores(matcher, names, match) for match in matches]
    scores = np.array(matched).reshape(len(matches), len(names))
    information = np.maximum([match.information for match in matches], LEAST_INFORMATION)
    median = float(np.median(information)) if matches else 1.0
    return _FusionInputs(
        np.array(at, dtype=np.intp),
        np.array([names.index(held.names[held.targets[i]]) for i in found], dtype=np.intp),
        np.array([counts[chosen[number]] for number in at]),
        held.logs[np.ix_(found, places)] if found else np.zeros((0, len(names))),
        scores * (median / information)[:, None],
        median,
        held.novelty[found],
        np.array([match.excess_loss for match in matches]),
    )


def _fitted(
    judged: HeldOutMoment,
    inputs: _FusionInputs,
    near: Sequence[_FusionInputs],
    matcher: TouchMatcher | None,
    prior_weight: float,
    *,
    complete: bool,
) -> Moment:
    """A moment; near: the inputs at the moments near it, this one among them, where that is enough."""
    held, steps, stage, calibration = judged.held_out, judged.steps, judged.stage, judged.calibration
    own = np.exp(held.logs[np.arange(len(held.targets)), held.targets])
    model_rate = _outlier_rate(own, len(held.names), np.ones(len(own))) if len(own) else 0.0
    distance_limit = float(np.quantile(held.distance, WITHIN)) if complete and len(held.keys) else np.inf
    if matcher is None or len(inputs.targets) < FEWEST or inputs.logs.shape[1] < 2:
        # With too few held-out touches or materials the kept touches decide only where the readouts do not.
        power = float(calibration.weights.sum()) / prior_weight
        weight = 0.5
        if matcher is not None:
            weight = full_match_weight(power * UNMATCHED, matcher.deviation.likelihood.table(CLEAN).information)
        rates = model_rate, model_rate
        return Moment(steps, stage, calibration, 1.0, weight, weight, *rates, np.inf, 0.0, 1.0 / UNMEASURED)
    together = _joined(near)
    prior = np.array([1.0, _worth(together) / 2])
    shared = np.maximum(_weights(together, prior, PRIOR_TOUCHES), LEAST_PRIOR * prior)
    weights = _weights(inputs, shared, SHARED_TOUCHES)
    by_itself = fit_weights(
        inputs.scores[:, None], inputs.targets.tolist(), prior[1:] * 2, ALONE_TOUCHES, inputs.counts
    )
    match, lone = (full_match_weight(float(value), inputs.information) for value in (weights[1], by_itself[0]))
    excess_loss = float(np.average(inputs.excess_loss, weights=inputs.counts))
    spread = max(float(np.average((inputs.excess_loss - excess_loss) ** 2, weights=inputs.counts)) ** 0.5, LEAST_SPREAD)
    weighted = float(weights[0]), match, lone
    moment = Moment(steps, stage, calibration, *weighted, 0.0, model_rate, distance_limit, excess_loss, spread)
    own = _chances(moment, inputs)[np.arange(len(inputs.targets)), inputs.targets]
    return replace(moment, outlier_rate=_outlier_rate(own, inputs.logs.shape[1], inputs.counts))


UNMATCHED = 1 / 16_000  # β where nothing can be held out: a larger one misclassifies prefixes, with one touch of each


def _worth(inputs: _FusionInputs) -> float:
    """The β at which the best material of the kept touches alone leads the next by AHEAD logits, in the median."""
    best = np.sort(inputs.scores, axis=1)[:, -2:]
    gap = float(np.median(best[:, 1] - best[:, 0]))
    return AHEAD / max(gap, AHEAD)


def _joined(inputs: Sequence[_FusionInputs]) -> _FusionInputs:
    """The inputs at some moments as those at one; of one median information."""
    parts = [np.concatenate([getattr(one, name) for one in inputs]) for name in ("targets", "counts", "logs", "scores")]
    none = np.zeros(0)
    return _FusionInputs(np.zeros(0, np.intp), parts[0], parts[1], parts[2], parts[3], 1.0, none, none)


def _weights(inputs: _FusionInputs, prior: FloatArray, touches: float) -> FloatArray:
    """g and β."""
    return fit_weights(
        np.stack([inputs.logs, inputs.scores], axis=1), inputs.targets.tolist(), prior, touches, inputs.counts
    )


def _chances(moment: Moment, inputs: _FusionInputs) -> FloatArray:
    """The probability of the materials at a moment, (n, C), before outliers."""
    logits = moment.model_weight * inputs.logs + match_weight(moment.match_weight, inputs.information) * inputs.scores
    chances = np.exp(logits - logits.max(axis=1, keepdims=True))
    return np.asarray(chances / chances.sum(axis=1, keepdims=True))


def _outlier_rate(own: FloatArray, materials: int, counts: FloatArray) -> float:
    """ε of least log loss (EM). own: the probabilities of the touches' own materials without ε."""
    total = float(counts.sum())
    rate = PRIOR_OUTLIERS / (total + 1)
    for _ in range(STEPS):
        drawn = rate / materials
        outliers = float((counts * drawn / ((1 - rate) * own + drawn)).sum())
        rate = (outliers + PRIOR_OUTLIERS) / (total + 1)
    return rate


def full_match_weight(weight: float, information: float) -> float:
    """The r for which `match_weight(r, information)` is the fitted β; information: of the touches it was fitted to."""
    return 1 / (1 + max(1 / max(weight, LEAST_WEIGHT) - 1, 0.0) / max(information, LEAST_INFORMATION))


def _trajectories(
    moments: Sequence[Moment], inputs: Sequence[_FusionInputs], touches: int, materials: int
) -> Trajectories:
    chances = np.full((touches, len(moments), materials), np.nan)
    novelty, targets = np.full((touches, len(moments)), np.nan), np.zeros(touches, np.intp)
    for i, (moment, one) in enumerate(zip(moments, inputs, strict=True)):
        if not len(one.reached):
            continue
        chances[one.reached, i] = tempered(_chances(moment, one), moment.outlier_rate)
        novelty[one.reached, i], targets[one.reached] = one.novelty, one.targets
    reached = np.isfinite(novelty).any(axis=1)
    return Trajectories(chances[reached], novelty[reached], targets[reached])
