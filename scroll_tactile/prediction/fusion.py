"""Fusion: how far the readouts and the kept touches are believed beside each other, at each moment of a touch.

Which of them is right depends on how much was felt: of BioTac's touches the kept ones are after 0.1 s in 81 % and the
readouts in 54, after 0.5 s in 83 and 94. So at each moment m, the last of them "complete",

    p_y = (1 − ε_m) q_y + ε_m / C,    q_y ∝ exp(g_m log d_y + β_m S_y),

d the readouts' probabilities, S the log-likelihoods of the kept touches. (g_m, β_m) ≥ 0 have least log loss on touches
held out of both; they are drawn to those of this moment and its neighbours together, and these to what each of the two
is worth by itself: half. ε_m is the share of touches that are unlike all others of their material, no less than n of
them can rule out. All is fitted to one set of held-out touches, seen at all moments.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.likelihood import CLEAN
from scroll_tactile.matching.match import Match
from scroll_tactile.matching.matcher import TouchMatcher
from scroll_tactile.readouts.calibration import AHEAD, FEWEST, UNMEASURED, Calibration, fit_weights
from scroll_tactile.readouts.held_out import HeldOut

__all__ = [
    "USUAL",
    "Fusion",
    "Judged",
    "Moment",
    "Trajectories",
    "chosen_of",
    "fuse",
    "match_scores",
    "moments_of",
    "tempered",
]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.intp]

MOST_HELD_OUT = 96  # touches, each compared with all kept ones at every moment
SURE = 0.99  # of the readouts' probability: a touch with less is compared with kept ones
USUAL = 0.95  # of held-out touches are familiar
PRIOR_TOUCHES = 0.5  # that half of what each is worth by itself counts as
ALONE_TOUCHES = 2.0  # that what the kept touches are worth by themselves counts as
SHARED_TOUCHES = 10.0  # that the weights of a moment and its neighbours count as
LEAST_PRIOR = 1e-3
ODD = 0.5  # touches more than those held out that are outliers
APART = 1.25  # times a moment: the next is no nearer
LEAST_SPREAD, LEAST_INFORMATION, LEAST_STEEPNESS = 1e-9, 1e-3, 1e-9
LEAST_DISTANCE_WEIGHT = 0.5  # times the weight at the limit: of a touch beyond it that is compared at another pace
STEPS = 100  # of EM


@dataclass(frozen=True)
class Moment:
    """How a touch is judged from so many columns on.

    columns: from how many on; of the last moment, those of a complete touch. stage: of the readouts that judge.
    calibration: how their scores are read. model, match: g, and r that gives β (see `steepness`). alone: r where noise,
    or how unlike all others the touch is, leaves the readouts nothing to say. odd: ε. odd_model: ε of the readouts' own
    probabilities. distance_limit: the relative distance that 19 of 20 stay below. mean_excess_loss, loss_spread: mean
    and standard deviation of the excess loss of known touches beside the kept ones.
    """

    columns: int
    stage: int
    calibration: Calibration
    model: float
    match: float
    alone: float
    odd: float
    odd_model: float
    distance_limit: float
    mean_excess_loss: float
    loss_spread: float

    def steepness(self, match: Match, distance_weight: float) -> float:
        """β = 1 / (1 + (1/r − 1) c) of a touch for which the readouts have this weight, c its information."""
        beside, alone = (_steepness(r, match.information) for r in (self.match, self.alone))
        share = (1 - match.noise_share) * distance_weight
        return share * beside + (1 - share) * alone

    def distance_weight(self, distance: float, own_time: bool) -> float:
        """The weight of the readouts for a touch at a relative distance, in (0, 1]: less, the further it is off.

        own_time: whether it is compared with beginnings: then no less than at the limit.
        """
        if not (np.isfinite(self.distance_limit) and np.isfinite(distance)):
            return 1.0
        least = (1.0 if own_time else LEAST_DISTANCE_WEIGHT) / max(self.distance_limit, 1.0)
        return float(np.clip(1.0 / max(distance, LEAST_SPREAD), least, 1.0))

    def suffices(self, probability: float, distance: float) -> bool:
        """Whether the readouts' word is enough: their highest probability, and how far off the touch is.

        With one touch of each, any other looks as if noise came over it: then no probability is too low.
        """
        return probability >= (SURE if self.odd_model else 0.0) and distance <= self.distance_limit

    def matched_novelty(self, match: Match) -> float:
        """The excess loss beside the kept touches, in units of its spread over known touches, as novelty is."""
        return (match.excess_loss - self.mean_excess_loss) / self.loss_spread

    def threshold(self, false_alarms: float) -> float:
        """The novelty that a share `false_alarms` of known touches exceeds; see `Calibration.threshold`."""
        return self.calibration.threshold(false_alarms)

    @property
    def novelties(self) -> FloatArray:
        """Those of the held-out touches that it was calibrated on, ascending."""
        return self.calibration.novelties


@dataclass(frozen=True)
class Trajectories:
    """What is said of N held-out touches at each of m moments, the last not among them; NaN where one did not reach it.

    chances: probability of the C materials, (N, m, C). novelty: (N, m). targets: the material of each, (N,).
    """

    chances: FloatArray
    novelty: FloatArray
    targets: IntArray


@dataclass(frozen=True)
class Fusion:
    """The table of all moments, ascending, the last "complete"; matcher: the kept touches, None where there are none.

    paced: how complete touches are judged that were made at other paces, ascending by columns. trajectories: of the
    touches that it was fitted to, at all moments before the last.
    """

    moments: tuple[Moment, ...]
    paced: tuple[Moment, ...]
    matcher: TouchMatcher | None
    trajectories: Trajectories

    @property
    def complete(self) -> Moment:
        """How a complete touch is judged."""
        return self.moments[-1]

    def reaches(self, columns: int) -> bool:
        """Whether a complete touch may be so long by its pace alone: about half to twice as long as usual."""
        return self.paced[0].columns <= APART * columns and columns <= APART * self.paced[-1].columns

    def at_pace(self, columns: int) -> Moment:
        """How a complete touch is judged of which the pace, not the end, makes it so many columns long."""
        return min(self.paced, key=lambda row: abs(math.log(row.columns / columns)))

    def at(self, columns: int) -> Moment:
        """The latest moment that so many columns reached; the first, where they reached none."""
        return self.moments[max(0, bisect_right([moment.columns for moment in self.moments], columns) - 1)]


def moments_of(milestones: Sequence[int], least: int, *, matched: bool) -> tuple[int, ...]:
    """The moments before a touch is complete, in columns: below `least`.

    milestones: lengths at which other readouts judge. matched: whether there are kept touches, of which any beginning
    can be seen: then there are two moments before the first milestone, and one between any two.
    """
    found = {columns for columns in milestones if columns < least}
    if matched:
        between = [round(math.sqrt(low * high)) for low, high in pairwise([*sorted(found), least])] if found else []
        for columns in [milestones[0] // 3, 2 * milestones[0] // 3, *between]:
            if 2 <= columns < least and all(max(columns, at) >= APART * min(columns, at) for at in found):
                found.add(columns)
    return tuple(sorted(found))


@dataclass(frozen=True)
class Judged:
    """What is said at one moment, from `columns` on, of held-out touches.

    stage, calibration: of the readouts. held_out: what they say. matches: what the kept touches say, by key.
    """

    columns: int
    stage: int
    calibration: Calibration
    held_out: HeldOut
    matches: Mapping[bytes, Match]


@dataclass(frozen=True)
class _Said:
    """What is said at one moment of those of the touches, `reached`, that reached it; see `HeldOut` and `Trajectories`.

    logs: g's part, scores: β's for a information of `information`, both (n, C).
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
    judged: Sequence[Judged],
    paced: Sequence[Judged],
    chosen: Sequence[bytes],
    counts: Mapping[bytes, float],
    prior_weight: float,
) -> Fusion:
    """Fit the table to held-out touches.

    judged: what is said by moment, ascending, the last of complete touches. paced: of complete ones at other paces,
    ascending by columns. chosen: the keys of the touches that are seen at all moments. counts: of those that are seen
    as complete ones, and how many touches each stands for. prior_weight: of the readouts' scores, where they are
    believed as they are.
    """
    names, even = judged[-1].held_out.names, dict.fromkeys(chosen, 1.0)
    said = [_at(matcher, one, names, even) for one in judged[:-1]]
    said.append(_at(matcher, judged[-1], names, counts))
    others = [_at(matcher, one, names, even) for one in paced]
    moments = _rows(matcher, judged, said, judged[-1], prior_weight)
    of_paced = _rows(matcher, paced, others, None, prior_weight)
    return Fusion(
        tuple(moments), tuple(of_paced), matcher, _trajectories(moments[:-1], said[:-1], len(chosen), len(names))
    )


def _rows(
    matcher: TouchMatcher | None,
    judged: Sequence[Judged],
    said: Sequence[_Said],
    complete: Judged | None,
    prior_weight: float,
) -> list[Moment]:
    """Rows of the table, each drawn to its neighbours."""
    rows = []
    for i, one in enumerate(judged):
        near = [other for other in said[max(0, i - 1) : i + 2] if len(other.targets) >= FEWEST]
        rows.append(_fitted(one, said[i], near, matcher, prior_weight, complete=one is complete))
    return rows


def chosen_of(complete: HeldOut, matcher: TouchMatcher | None) -> tuple[list[bytes], dict[bytes, float]]:
    """The held-out touches that are seen at all moments: of those that are kept, evenly over their keys.

    And those that are compared as complete ones, with how many each stands for: beside them the least sure, where it
    matters what is believed; each of the others stands for many.
    """
    kept = set() if matcher is None else matcher.kept.rows().keys()
    ranked = [key for _, key in sorted(zip(complete.margins.tolist(), complete.keys, strict=True)) if key in kept]
    keys, unsure = sorted(ranked), ranked[: MOST_HELD_OUT // 2]
    places = np.linspace(0, len(keys) - 1, min(MOST_HELD_OUT, len(keys))).round().astype(int)
    chosen = [keys[i] for i in places]
    surer = [key for key in chosen if key not in set(unsure)]
    each = (len(keys) - len(unsure)) / max(len(surer), 1)
    return chosen, dict.fromkeys(unsure, 1.0) | dict.fromkeys(surer, each)


def _at(matcher: TouchMatcher | None, judged: Judged, names: Sequence[str], counts: Mapping[bytes, float]) -> _Said:
    """What is said at one moment of some touches, and how many each stands for."""
    chosen = list(counts)
    held = judged.held_out
    among, own = {key: i for i, key in enumerate(held.keys)}, {name: i for i, name in enumerate(held.names)}
    places = [own[name] for name in names if name in own]
    at = [number for number, key in enumerate(chosen) if key in among and key in judged.matches]
    if len(places) < len(names):
        at = []
    found = [among[chosen[number]] for number in at]
    ways = [judged.matches[chosen[number]] for number in at]
    matched = [] if matcher is None else [match_scores(matcher, names, way) for way in ways]
    scores = np.array(matched).reshape(len(ways), len(names))
    information = np.maximum([way.information for way in ways], LEAST_INFORMATION)
    median = float(np.median(information)) if ways else 1.0
    return _Said(
        np.array(at, dtype=np.intp),
        np.array([names.index(held.names[held.targets[i]]) for i in found], dtype=np.intp),
        np.array([counts[chosen[number]] for number in at]),
        held.logs[np.ix_(found, places)] if found else np.zeros((0, len(names))),
        scores * (median / information)[:, None],
        median,
        held.novelty[found],
        np.array([way.excess_loss for way in ways]),
    )


def match_scores(matcher: TouchMatcher, names: Sequence[str], way: Match) -> FloatArray:
    """What the kept touches say of some materials, (C,); the least of those of which none is kept."""
    places, least = {name: i for i, name in enumerate(matcher.kept.materials)}, float(way.scores.min())
    return np.array([way.scores[places[name]] if name in places else least for name in names])


def _fitted(
    judged: Judged,
    said: _Said,
    near: Sequence[_Said],
    matcher: TouchMatcher | None,
    prior_weight: float,
    *,
    complete: bool,
) -> Moment:
    """A moment; near: what is said at the moments near it, this one among them, where that is enough."""
    held, columns, stage, calibration = judged.held_out, judged.columns, judged.stage, judged.calibration
    own = np.exp(held.logs[np.arange(len(held.targets)), held.targets])
    alone = _odd_share(own, len(held.names), np.ones(len(own))) if len(own) else 0.0
    distance_limit = float(np.quantile(held.distance, USUAL)) if complete and len(held.keys) else np.inf
    if matcher is None or len(said.targets) < FEWEST or said.logs.shape[1] < 2:
        # Where nothing can be held out, the kept touches decide only where the readouts do not.
        power = float(calibration.weights.sum()) / prior_weight
        match = (
            0.5 if matcher is None else match_of(power * UNSEEN, matcher.deviation.likelihood.table(CLEAN).information)
        )
        spread = 1.0 / UNMEASURED
        return Moment(columns, stage, calibration, 1.0, match, match, alone, alone, np.inf, 0.0, spread)
    together = _joined(near)
    prior = np.array([1.0, _worth(together) / 2])
    shared = np.maximum(_weights(together, prior, PRIOR_TOUCHES), LEAST_PRIOR * prior)
    weights = _weights(said, shared, SHARED_TOUCHES)
    by_itself = fit_weights(said.scores[:, None], said.targets.tolist(), prior[1:] * 2, ALONE_TOUCHES, said.counts)
    match, lone = (match_of(float(value), said.information) for value in (weights[1], by_itself[0]))
    excess_loss = float(np.average(said.excess_loss, weights=said.counts))
    spread = max(float(np.average((said.excess_loss - excess_loss) ** 2, weights=said.counts)) ** 0.5, LEAST_SPREAD)
    of_model = float(weights[0])
    moment = Moment(columns, stage, calibration, of_model, match, lone, 0.0, alone, distance_limit, excess_loss, spread)
    own = _chances(moment, said)[np.arange(len(said.targets)), said.targets]
    return replace(moment, odd=_odd_share(own, said.logs.shape[1], said.counts))


UNSEEN = 1 / 16_000  # β where nothing can be held out: after one touch of each, beginnings are lost to a larger one


def _worth(said: _Said) -> float:
    """The β at which the kept touches by themselves put their best material ahead of the next by AHEAD logits."""
    best = np.sort(said.scores, axis=1)[:, -2:]
    gap = float(np.median(best[:, 1] - best[:, 0]))
    return AHEAD / max(gap, AHEAD)


def _joined(said: Sequence[_Said]) -> _Said:
    """What is said at some moments as that at one; of one median information."""
    parts = [np.concatenate([getattr(one, name) for one in said]) for name in ("targets", "counts", "logs", "scores")]
    none = np.zeros(0)
    return _Said(np.zeros(0, np.intp), parts[0], parts[1], parts[2], parts[3], 1.0, none, none)


def _weights(said: _Said, prior: FloatArray, touches: float) -> FloatArray:
    """g and β."""
    return fit_weights(np.stack([said.logs, said.scores], axis=1), said.targets.tolist(), prior, touches, said.counts)


def _chances(moment: Moment, said: _Said) -> FloatArray:
    """The probability of the materials at a moment, (n, C), before outliers."""
    logits = moment.model * said.logs + _steepness(moment.match, said.information) * said.scores
    chances = np.exp(logits - logits.max(axis=1, keepdims=True))
    return np.asarray(chances / chances.sum(axis=1, keepdims=True))


def _odd_share(own: FloatArray, materials: int, counts: FloatArray) -> float:
    """ε of least log loss, where touches have such probabilities for their own material without it (EM)."""
    total = float(counts.sum())
    odd = ODD / (total + 1)
    for _ in range(STEPS):
        drawn = odd / materials
        share = float((counts * drawn / ((1 - odd) * own + drawn)).sum())
        odd = (share + ODD) / (total + 1)
    return odd


def tempered(chances: FloatArray, odd: float) -> FloatArray:
    """Probabilities (…, C) of which a share is left for touches that are unlike all others."""
    return np.asarray((1 - odd) * chances + odd / chances.shape[-1])


def _steepness(match: float, information: float) -> float:
    """β of r at this information."""
    return 1 / (1 + (1 / match - 1) * information)


def match_of(steepness: float, information: float) -> float:
    """r, of which β is the steepness that was fitted, where the information is that of the touches it was fitted to."""
    return 1 / (1 + max(1 / max(steepness, LEAST_STEEPNESS) - 1, 0.0) / max(information, LEAST_INFORMATION))


def _trajectories(moments: Sequence[Moment], said: Sequence[_Said], touches: int, materials: int) -> Trajectories:
    chances = np.full((touches, len(moments), materials), np.nan)
    novelty, targets = np.full((touches, len(moments)), np.nan), np.zeros(touches, np.intp)
    for i, (moment, one) in enumerate(zip(moments, said, strict=True)):
        if not len(one.reached):
            continue
        chances[one.reached, i] = tempered(_chances(moment, one), moment.odd)
        novelty[one.reached, i], targets[one.reached] = one.novelty, one.targets
    reached = np.isfinite(novelty).any(axis=1)
    return Trajectories(chances[reached], novelty[reached], targets[reached])
