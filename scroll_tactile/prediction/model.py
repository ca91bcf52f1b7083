"""The model: all that answers need of a memory. `prediction.fitting` fits it; its means follow each touch.

What was fitted is a `Weighing`: how far readouts and kept touches are to be believed at each length of a touch. Models
of later states of the memory share it: their class means, kept touches and materials are those of now, the scatter and
the weighing those of the last fit. Nothing of a model changes, so any thread may use it as long as it likes.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import CapacityError, ScrollTactileError
from scroll_tactile.matching.conformal import Conformal
from scroll_tactile.matching.kept_arrays import KeptArrays
from scroll_tactile.matching.match import KeptTouch, Match
from scroll_tactile.matching.matcher import TouchMatcher
from scroll_tactile.memory.state import Memory
from scroll_tactile.readouts.calibration import Calibration, Dependence
from scroll_tactile.readouts.leave_one_out import HeldOutScores, Sampled, held_out_scores
from scroll_tactile.readouts.novelty import TINY, Neighbours
from scroll_tactile.readouts.readout import Readout, ReadoutName
from scroll_tactile.results import Unusual
from scroll_tactile.signals.windows import Scale, WindowPlan, measuring
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.sample import SampledTouch

__all__ = [
    "BESIDE",
    "Hypothesis",
    "Judgement",
    "Model",
    "Paces",
    "Row",
    "Trajectories",
    "Weighing",
    "enough_memory",
    "followed_to",
    "held_out_of",
    "match_scores",
    "neighbours_of",
    "softmax",
    "tempered",
]

FloatArray = npt.NDArray[np.float64]
Hypothesis = Literal["prefix", "complete", "paced"]
"""What a touch may be: the prefix of a complete one, a complete one, or a complete one at another pace."""

WITHIN = 0.95  # the share of held-out touches within the limits
SURE = 0.99  # a touch whose highest probability by the readouts is less is matched with kept ones
BESIDE = 0.1  # the weight of kept touches beside sure readouts, of that by themselves: fitted ones were 0.03 to 0.28
MOST_OCTAVES = 1.5  # to which what was measured an octave off is continued
LEAST_DISTANCE_WEIGHT = 0.5  # the least weight at another pace, as a share of that at the distance limit


@contextmanager
def enough_memory() -> Iterator[None]:
    """Raise CapacityError where the system has no memory left for the readouts; what was observed is kept.

    Raises ScrollTactileError where sums that came from elsewhere have no readout: see `validation.gate`.
    """
    try:
        yield
    except MemoryError as error:
        raise CapacityError(
            f"the system has no memory left for the readouts ({error}); what was observed is kept. Name fewer "
            "materials in a scene, or give the process more"
        ) from error
    except np.linalg.LinAlgError as error:  # never of sums of rows: the shrunk scatter is positive definite
        raise ScrollTactileError(
            f"the sums of this memory have no readout ({error}): they are of no touches that were observed. Look at "
            "where it came from (scroll-tactile memory check), and go back to a copy from before"
        ) from error


@dataclass(frozen=True)
class Row:
    """How touches are judged from a length on, by readouts and kept touches.

    steps: that length; of a complete touch, that of most. stage: that it belongs to. scales: that judge. calibration:
    of their scores. readout_outliers: ε of the readouts' own probabilities, the share of touches unlike all others of
    their material; outliers: ε where kept touches judge beside them. distance_limit: the relative distance that 19 of
    20 complete touches stay below; infinite in the rows of prefixes. excess: mean and spread of the excess loss of
    known touches beside the kept ones.
    """

    steps: int
    stage: int
    scales: tuple[Scale, ...]
    calibration: Calibration
    readout_outliers: float
    outliers: float
    distance_limit: float = np.inf
    excess: tuple[float, float] = (0.0, 1.0)

    def suffices(self, probability: float, distance: float) -> bool:
        """Whether the readouts are enough, by their highest probability and by how far off the touch is.

        If no touch could be held out, any probability suffices: every new touch would look noisy to the kept ones.
        """
        return probability >= (SURE if self.readout_outliers else 0.0) and distance <= self.distance_limit

    def unlikely(self, excess: float, spreads: float) -> bool:
        """Whether an excess loss is so many spreads above that of known touches."""
        return excess > self.excess[0] + spreads * self.excess[1]


@dataclass(frozen=True)
class Trajectories:
    """Answers to N held-out touches at each of m lengths before they were complete; NaN where a touch ended before.

    chances: probability of the C materials, (N, m, C). novelty: (N, m). targets: the material of each, (N,).
    """

    chances: FloatArray
    novelty: FloatArray
    targets: npt.NDArray[np.intp]


@dataclass(frozen=True)
class Paces:
    """How known touches look at other paces: mean and spread of each view's distance, and of the excess loss, last.

    own: at their own pace, (S' + 1, 2). others: at twice and at half of it, (2, S' + 1, 2). power: of the
    probabilities of touches at another pace, with least log loss.
    """

    own: FloatArray
    others: FloatArray
    power: float

    def novelty(self, values: FloatArray, pace: float) -> float:
        """The standardised novelty of distances and excess loss, (S' + 1,), of a touch so many times as fast."""
        octaves = math.log2(pace)
        moved = min(abs(octaves), MOST_OCTAVES) * (self.others[0 if octaves > 0 else 1] - self.own)
        mean, spread = (self.own + moved).T
        return float(((values - mean) / np.maximum(spread, self.own[:, 1] / 2)).mean())


@dataclass(eq=False)
class Weighing:
    """What a fit found out of held-out touches: how readouts and kept touches are to be weighed.

    rows: by stage, as far as any touch reached them. complete, paced: of complete touches, in their own time and at
    another pace. tau: τ, the weight of kept touches' log-likelihoods by themselves, at an information of 1. dependence:
    of touches of one thing. least: the 5th percentile of the lengths of touches, in steps. touches: that it was fitted
    to. sample: those that were held out. held_out, neighbours, trajectories, paces, noisy_excess: see `Model`,
    `fitting.rehearse`, `fitting.paces_of` and `fitting.noisy_excess_of`; made when they are first asked for.
    """

    rows: tuple[Row, ...]
    complete: Row
    paced: Row
    tau: float
    dependence: Dependence
    least: int
    touches: int
    sample: list[tuple[str, bytes, SampledTouch]] = field(default_factory=list)
    held_out: dict[Scale, HeldOutScores] | None = None
    trajectories: Trajectories | None = None
    neighbours: dict[tuple[int, Scale], Neighbours] = field(default_factory=dict)
    paces: Paces | None = None
    noisy_excess: tuple[float, float] | None = None

    def row(self, hypothesis: Hypothesis, stage: int) -> Row:
        """How a touch is judged at a stage."""
        if hypothesis == "paced":
            return self.paced
        return self.complete if hypothesis == "complete" and stage == len(self.rows) - 1 else self.rows[stage]

    @property
    def early(self) -> list[Row]:
        """The rows of prefixes alone, which are shorter than complete touches."""
        return [row for row in self.rows if row.steps < self.least]

    def distance_weight(self, hypothesis: Hypothesis, distance: float) -> float:
        """The weight of the readouts for a touch at a relative distance, in (0, 1]: less, the further it is off.

        Of a complete touch at least 1 / limit, at another pace half of that; of a prefix it is 1.
        """
        limit = self.complete.distance_limit
        if hypothesis == "prefix" or not np.isfinite(limit):
            return 1.0
        least = (1.0 if hypothesis == "complete" else LEAST_DISTANCE_WEIGHT) / max(limit, 1.0)
        return float(np.clip(1.0 / max(distance, 1e-9), least, 1.0))

    def fused(
        self, hypothesis: Hypothesis, chances: FloatArray, match: Match, scores: FloatArray, distance: float
    ) -> FloatArray:
        """The probabilities by readouts and kept touches together, before outliers, (C,).

        chances: by the readouts; scores: log-likelihoods by the kept touches; both (C,).
        """
        power = self.paces.power if hypothesis == "paced" and self.paces is not None else 1.0
        sure = (1 - match.noise_share) * self.distance_weight(hypothesis, distance)
        beta = (BESIDE * sure + (1 - sure)) / (1 + (1 / self.tau - 1) * match.information)
        return softmax(power * (sure * np.log(np.maximum(chances, TINY)) + beta * scores))


@dataclass(frozen=True)
class Judgement:
    """The judgement of a touch by the readouts alone, or with the kept touches.

    probability: of each candidate, shape (C,). novelty: see Prediction. row: whose threshold it is compared with.
    distance: the diagonal distance to the best-scoring material, divided by its median over held-out touches; the
    smallest over the scales that measure novelty, 0 where none was measured. unusual: see Prediction.
    """

    probability: FloatArray
    novelty: float
    row: Row
    distance: float = 0.0
    unusual: tuple[Unusual, ...] = ()


@dataclass(frozen=True, eq=False)
class Model:
    """Everything that predictions need of one state of a memory; it never changes.

    names: the materials, in alphabetical order; known: the same names, as a set; sampled: those with a sampled touch.
    stages: for each, the windows that judge there. views: the views that judge beside them. readouts: scale → its
    readout. weighing: None where nothing was learned. matcher, conformal: of the kept touches. longest: the longest
    learned touch, in steps. since: the touches that were sampled since the fit.
    """

    kind: ReadoutName
    plan: WindowPlan
    names: list[str]
    stages: list[list[Scale]]
    views: list[Scale]
    readouts: dict[Scale, Readout]
    weighing: Weighing | None
    matcher: TouchMatcher | None
    conformal: Conformal | None
    longest: int
    since: list[tuple[str, bytes, SampledTouch]] = field(default_factory=list)
    known: frozenset[str] = field(init=False)
    sampled: frozenset[str] = field(init=False)
    _of_all: dict[Scale, npt.NDArray[np.intp]] = field(init=False, default_factory=dict)
    _extended: dict[int, list[Neighbours]] = field(init=False, default_factory=dict)  # by stage

    def __post_init__(self) -> None:
        object.__setattr__(self, "known", frozenset(self.names))
        sample = [] if self.weighing is None else self.weighing.sample
        object.__setattr__(self, "sampled", frozenset(material for material, *_ in sample))

    @property
    def fitted(self) -> Weighing:
        """The weighing, where something was learned."""
        assert self.weighing is not None
        return self.weighing

    @property
    def viewed(self) -> list[list[Scale]]:
        """The scales of each stage and the views: in their order stand the rows of a sampled touch."""
        return [[*stage, *self.views] for stage in self.stages]

    @property
    def held_out(self) -> dict[Scale, HeldOutScores]:
        """Each scale's scores of the sampled touches, each held out of its readout."""
        weighing = self.fitted
        if weighing.held_out is None:
            with one_thread():
                weighing.held_out = held_out_of(self, weighing.sample)
        return weighing.held_out

    @property
    def touches(self) -> int:
        """The touches that it was fitted to."""
        return 0 if self.weighing is None else self.weighing.touches

    def followed(self, memory: Memory, changed: Collection[str]) -> Model | None:
        """The model of the memory as it is now, some materials of which have changed; None where one must be fitted.

        The class means are those of all observations, the scatter and the weighing stay as they were fitted.
        """
        readouts = {}
        for scale, readout in self.readouts.items():
            if (own := readout.followed(memory.statistics, changed)) is None:
                return None
            readouts[scale] = own
        matcher, conformal = self.matcher, self.conformal
        if matcher is not None and conformal is not None and memory.kept is not None:
            if (kept := followed_to(matcher.kept, conformal, memory.kept.touches())) is None:
                return None
            matcher, conformal = matcher.followed(kept[0]), kept[1]
        statistics, there = memory.statistics, {(material, key) for material, key, _ in self.fitted.sample}
        return replace(
            self,
            names=list(statistics.materials),
            readouts=readouts,
            matcher=matcher,
            conformal=conformal,
            longest=statistics.longest,
            since=[(material, key, touch) for material, key, touch in memory.sample if (material, key) not in there],
        )

    def is_last(self, steps: int) -> bool:
        """Whether a touch of so many steps is judged at the last stage, whose scores f* gives."""
        return min(len(self.plan.stages(steps)), len(self.fitted.rows)) == len(self.stages)

    def scales_for(self, candidates: Sequence[str], steps: int) -> list[Scale]:
        """The scales that are read to judge these candidates for a touch of so many steps."""
        decided = self._decided(candidates, len(self.plan.stages(steps)))
        views = self.views if steps >= self.fitted.least else ()
        return sorted({scale for stage, _ in decided for scale in self.stages[stage]}.union(views))

    def judge(
        self,
        candidates: Sequence[str],
        means: Mapping[Scale, FloatArray],
        steps: int,
        hypothesis: Hypothesis,
        tuned: Mapping[str, float] | None = None,
    ) -> Judgement:
        """Weigh the candidates for a touch by the readouts alone.

        means: for each of the scales of `scales_for`, mean features in grid units, (d,). steps: observed so far.
        hypothesis: what the touch is taken for. tuned: logits of f*, by material, in place of the last stage's scores.

        Each stage that is the last one of some candidate weighs the candidates that have rows there. Those without rows
        at a later stage keep their probability; the later stages divide the remaining probability among the others.
        """
        if hypothesis == "paced":  # every touch has views, of all of it
            decided: list[tuple[int, Sequence[int]]] = [(len(self.fitted.rows) - 1, range(len(candidates)))]
        else:
            decided = self._decided(candidates, len(self.plan.stages(steps)))
        probability, mass, distance = np.ones(len(candidates)), 1.0, 0.0
        for i, (stage, members) in enumerate(decided):
            names = candidates if len(members) == len(candidates) else [candidates[place] for place in members]
            if tuned is not None and stage == len(self.stages) - 1:
                logits = np.array([tuned[name] for name in names])
            else:
                logits, distance = self._weighted(self.fitted.row(hypothesis, stage), means, names, steps)
            probability[np.asarray(members)] = softmax(logits) * mass
            later = np.asarray(decided[i + 1][1] if i + 1 < len(decided) else [], dtype=np.intp)
            mass = float(probability[later].sum())
        best = int(np.argmax(probability))
        row = self.fitted.row(hypothesis, max(stage for stage, members in decided if best in members))
        return Judgement(probability, self.novelty(row, means, candidates), row, distance)

    def _decided(self, candidates: Sequence[str], reached: int) -> list[tuple[int, Sequence[int]]]:
        """(stage, places of the candidates weighed there), for each stage that is the last one of any candidate."""
        stages = self.stages[: min(reached, len(self.fitted.rows))]
        groups = [self._observed_at(scales, candidates) for scales in stages]
        return [
            (stage, members)
            for stage, members in enumerate(groups)
            if members and (stage + 1 == len(groups) or len(groups[stage + 1]) < len(members))
        ]

    def _observed_at(self, scales: Sequence[Scale], candidates: Sequence[str]) -> Sequence[int]:
        """The places of the candidates that were observed at all of these scales."""
        known = [self.readouts[scale].places for scale in scales]
        if all(len(places) == len(self.names) for places in known):
            return range(len(candidates))
        return [i for i, name in enumerate(candidates) if all(name in places for places in known)]

    def _places(self, scale: Scale, names: Sequence[str]) -> npt.NDArray[np.intp]:
        """The places of those materials that a scale knows."""
        places = self.readouts[scale].places
        if names is not self.names:
            return np.array([places[name] for name in names if name in places], dtype=np.intp)
        if scale not in self._of_all:
            self._of_all[scale] = self._places(scale, list(names))
        return self._of_all[scale]

    def _weighted(
        self, row: Row, means: Mapping[Scale, FloatArray], names: Sequence[str], steps: int
    ) -> tuple[FloatArray, float]:
        """The logits of some materials, weighed as they are calibrated, and the distance of `Judgement`."""
        readouts, features = [self.readouts[scale] for scale in row.scales], [means[scale] for scale in row.scales]
        places = [self._places(scale, names) for scale in row.scales]
        found = [
            readout.scores(own, among, self.kind)
            for readout, own, among in zip(readouts, features, places, strict=True)
        ]
        weights, distance = row.calibration.weights, 0.0
        if np.isfinite(row.calibration.median_distances).all():
            nearest = [int(among[int(scores.argmax())]) for among, scores in zip(places, found, strict=True)]
            away = [
                readout.diagonal_distance(own, place)
                for readout, own, place in zip(readouts, features, nearest, strict=True)
            ]
            weights = row.calibration.weights_at(np.array(away))
            distance = float(row.calibration.relative(np.array(away))[measuring(row.scales)].min())
        # A beginning shorter than the first stage is read by fewer readings than the scores are calibrated for.
        begun = min(1.0, steps / row.steps) ** 2
        return begun * np.asarray(sum(weight * scores for weight, scores in zip(weights, found, strict=True))), distance

    def neighbours(self, row: Row) -> list[Neighbours]:
        """The sampled touches that a row's windows lie among; none where too few were held out to measure that."""
        if not len(row.calibration.thresholds.novelties):
            return []
        return neighbours_of(self, self.fitted.sample, row.stage, row.scales, self.fitted.neighbours)

    def novelty(self, row: Row, means: Mapping[Scale, FloatArray], names: Sequence[str]) -> float:
        """The standardised novelty of a touch judged by a row, among these materials."""
        among = None if len(names) == len(self.names) and self.sampled <= self.known else set(names)
        windows = (scale for scale in row.scales if scale.width)
        near = self.neighbours(row)
        if self.since and near:
            near = self._extended.get(row.stage) or [own.extended(self.since) for own in near]
            self._extended[row.stage] = near
        local = [own.novelty(means[scale], among) for own, scale in zip(near, windows, strict=False)]
        return float(row.calibration.novelty(np.array([*self.distances(row.scales, means, names), *local])))

    def distances(self, scales: Sequence[Scale], means: Mapping[Scale, FloatArray], names: Sequence[str]) -> FloatArray:
        """The relative Mahalanobis distance at each scale that measures novelty, (S',)."""
        novel = [scales[place] for place in measuring(scales)]
        return np.array([self.readouts[scale].novelty(means[scale], self._places(scale, names)) for scale in novel])


def followed_to(
    arrays: KeptArrays, conformal: Conformal, kept: Sequence[KeptTouch]
) -> tuple[KeptArrays, Conformal] | None:
    """What is made of kept touches, for those that are kept now; None where there are none."""
    there, now = set(arrays.touches), {(touch.material, touch.key) for touch in kept}
    if there == now:
        return arrays, conformal
    added, removed = [touch for touch in kept if (touch.material, touch.key) not in there], there - now
    if (followed := arrays.followed(added, removed)) is None:
        return None
    if followed.longest != arrays.longest:
        return followed, Conformal.of(kept)
    return followed, conformal.followed(added, removed)


def held_out_of(model: Model, sample: Sampled) -> dict[Scale, HeldOutScores]:
    """Each scale's scores of sampled touches, each held out of its readout."""
    return {scale: held_out_scores(own, sample, model.viewed, model.kind) for scale, own in model.readouts.items()}


def neighbours_of(
    model: Model, sample: Sampled, stage: int, scales: Sequence[Scale], made: dict[tuple[int, Scale], Neighbours]
) -> list[Neighbours]:
    """The sampled touches that a touch lies among at a stage, for each window of these scales.

    made: those of other calls, (stage, scale) → which; it is added to.
    """
    windows = [scale for scale in scales if scale.width]
    for scale in windows:
        if (stage, scale) not in made:
            made[stage, scale] = Neighbours(model.readouts[scale], sample, model.viewed, stage)
    return [made[stage, scale] for scale in windows]


def match_scores(matcher: TouchMatcher, names: Sequence[str], match: Match) -> FloatArray:
    """The kept touches' scores of some materials, (C,); the least of all for materials of which none is kept."""
    places, least = {name: i for i, name in enumerate(matcher.kept.materials)}, float(match.scores.min())
    return np.array([match.scores[places[name]] if name in places else least for name in names])


def tempered(chances: FloatArray, outliers: float) -> FloatArray:
    """Probabilities (…, C) mixed with a uniform share, the rate of outliers."""
    return np.asarray((1 - outliers) * chances + outliers / chances.shape[-1])


def softmax(logits: FloatArray) -> FloatArray:
    """Probabilities (…, C) of logits."""
    chances = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return np.asarray(chances / chances.sum(axis=-1, keepdims=True))
