"""The model: all that answers need of a memory. `prediction.fitting` fits it; its means follow each touch.

What was fitted is a `Weighing`: how far readouts and kept touches are to be believed at each length of a touch. Models
of later states share it: their class means, kept touches and materials are those of now, scatter and weighing those of
the last fit. A model never changes, so any thread may use it as long as it likes.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import CapacityError, ScrollTactileError
from scroll_tactile.matching.matcher import Match, TouchMatcher
from scroll_tactile.memory.state import Memory
from scroll_tactile.readouts.calibration import Calibration, Dependence, softmax
from scroll_tactile.readouts.leave_one_out import HeldOutScores, StageScores, held_out_scores
from scroll_tactile.readouts.novelty import TINY, Neighbours, novelty_measures
from scroll_tactile.readouts.readout import Readout, ReadoutName
from scroll_tactile.results import Unusual
from scroll_tactile.signals.windows import Scale, WindowPlan, measuring
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.sample import SampledTouch

__all__ = ["HeldOut", "Hypothesis", "Judgement", "Model", "Paces", "Row", "Trajectories", "Weighing", "enough_memory"]

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
    """Raise CapacityError where the system has no memory left for the readouts; what was observed is kept."""
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
    of their scores. readout_outliers: ε of the readouts alone, the share of touches unlike all others of their
    material; outliers: ε where kept touches judge beside them. distance_limit: the relative distance that 19 of 20
    complete touches stay below, infinite for prefixes. excess: mean and spread of known touches' excess loss.
    """

    steps: int
    stage: int
    scales: tuple[Scale, ...]
    calibration: Calibration
    readout_outliers: float = 0.0
    outliers: float = 0.0
    distance_limit: float = np.inf
    excess: tuple[float, float] = (0.0, 1.0)

    def suffices(self, probability: float, distance: float) -> bool:
        """Whether the readouts are enough, by their highest probability and by how far off the touch is.

        If no touch could be held out, any probability suffices: every new touch would look noisy to the kept ones.
        """
        return probability >= (SURE if self.readout_outliers else 0.0) and distance <= self.distance_limit


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
    """How readouts and kept touches are to be weighed, as a fit found by held-out touches.

    rows: by stage, as far as any touch reached them. complete, paced: of complete touches, in their own time and at
    another pace. tau: τ, the weight of kept touches' log-likelihoods by themselves, at an information of 1. dependence:
    of touches of one thing. least: the 5th percentile of lengths, in steps. touches: that it was fitted to. paces: see
    `fitting.paces_of`.
    """

    rows: tuple[Row, ...]
    complete: Row
    paced: Row
    tau: float
    dependence: Dependence
    least: int
    touches: int
    paces: Paces | None = None

    def row(self, hypothesis: Hypothesis, stage: int) -> Row:
        """How a touch is judged at a stage."""
        if hypothesis == "paced":
            return self.paced
        return self.complete if hypothesis == "complete" and stage == len(self.rows) - 1 else self.rows[stage]

    @property
    def early(self) -> list[Row]:
        """The rows of prefixes alone, which are shorter than complete touches."""
        return [row for row in self.rows if row.steps < self.least]

    def logits(
        self, hypothesis: Hypothesis, chances: FloatArray, match: Match, scores: FloatArray, distance: float
    ) -> FloatArray:
        """The logits by readouts and kept touches together, before outliers, (C,); see `prediction.judging`.

        chances: probabilities by the readouts; scores: log-likelihoods by the kept touches; both (C,).
        """
        power = self.paces.power if hypothesis == "paced" and self.paces is not None else 1.0
        sure, limit = 1 - match.noise_share, self.complete.distance_limit
        if hypothesis != "prefix" and np.isfinite(limit):  # readouts weigh less, the further off the touch is
            least = (1.0 if hypothesis == "complete" else LEAST_DISTANCE_WEIGHT) / max(limit, 1.0)
            sure *= float(np.clip(1.0 / max(distance, 1e-9), least, 1.0))
        beta = (BESIDE * sure + (1 - sure)) / (1 + (1 / self.tau - 1) * match.information)
        return np.asarray(power * (sure * np.log(np.maximum(chances, TINY)) + beta * scores))


@dataclass(eq=False)
class HeldOut:
    """The sampled touches of a fit, each held out of the readouts as they were solved; scored when first asked for.

    sample: material, key and rows of each. stages: the scales of each stage and the views, in whose order stand the
    rows of a sampled touch. trajectories: see `fitting.rehearse`.
    """

    kind: ReadoutName
    sample: list[tuple[str, bytes, SampledTouch]]
    readouts: dict[Scale, Readout]
    stages: list[list[Scale]]
    trajectories: Trajectories | None = None
    _neighbours: dict[tuple[int, Scale], Neighbours] = field(default_factory=dict)

    @cached_property
    def scores(self) -> dict[Scale, HeldOutScores]:
        """Each scale's scores of these touches."""
        with one_thread():
            return {
                scale: held_out_scores(readout, self.sample, self.stages, self.kind)
                for scale, readout in self.readouts.items()
            }

    def at(self, stage: int, scales: Sequence[Scale]) -> StageScores:
        """Their scores at a stage by some scales."""
        return StageScores(stage, self.sample, [self.scores[scale] for scale in scales])

    def by(self, row: Row) -> tuple[StageScores, FloatArray, FloatArray, FloatArray]:
        """Their scores, and by these as a row weighs them `Calibration.held_out` and their novelties, (N,)."""
        found = self.at(row.stage, row.scales)
        novelties = row.calibration.novelty(novelty_measures(found, self.around(row))[0])
        return found, *row.calibration.held_out(found, row.scales), novelties

    def around(self, row: Row) -> list[Neighbours]:
        """Those among which a touch lies in a row's windows; none where too few were held out to measure that."""
        return self.neighbours(row.stage, row.scales) if len(row.calibration.thresholds.novelties) else []

    def neighbours(self, stage: int, scales: Sequence[Scale]) -> list[Neighbours]:
        """Those among which a touch lies at a stage, for each window among the scales."""
        windows = [scale for scale in scales if scale.width]
        for scale in windows:
            if (stage, scale) not in self._neighbours:
                made = Neighbours(self.readouts[scale], self.sample, self.stages, stage)
                self._neighbours[stage, scale] = made
        return [self._neighbours[stage, scale] for scale in windows]


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

    names: the materials, in alphabetical order. stages: for each, the windows that judge there. views: the views that
    judge beside them. longest: the longest learned touch, in steps. readouts: scale → its readout. matcher: of the kept
    touches. held_out: the touches that it was weighed by, weighing: how; None where nothing was learned. since: the
    touches that were sampled since the fit.
    """

    kind: ReadoutName
    plan: WindowPlan
    names: list[str]
    stages: list[list[Scale]]
    views: list[Scale]
    longest: int
    held_out: HeldOut
    weighing: Weighing | None = None
    matcher: TouchMatcher | None = None
    readouts: dict[Scale, Readout] = field(default_factory=dict)
    since: list[tuple[str, bytes, SampledTouch]] = field(default_factory=list)
    _extended: dict[int, list[Neighbours]] = field(init=False, default_factory=dict)  # by stage

    @property
    def fitted(self) -> Weighing:
        """The weighing, where something was learned."""
        assert self.weighing is not None
        return self.weighing

    @cached_property
    def known(self) -> frozenset[str]:
        """The materials, as a set."""
        return frozenset(self.names)

    @cached_property
    def knows_sample(self) -> bool:
        """Whether all materials that it was weighed by are still there."""
        return {material for material, *_ in self.held_out.sample} <= self.known

    def followed(self, memory: Memory, changed: Collection[str]) -> Model | None:
        """The model of the memory as it is now, some materials of which have changed; None where one must be fitted.

        The class means are those of all observations, the scatter and the weighing stay as they were fitted.
        """
        if not changed:
            return self
        readouts = {}
        for scale, readout in self.readouts.items():
            if (own := readout.followed(memory.statistics, changed)) is None:
                return None
            readouts[scale] = own
        matcher = self.matcher
        if matcher is not None and memory.kept is not None:
            if not (kept := memory.kept.touches()):
                return None
            matcher = matcher.followed(kept)
        there = {(material, key) for material, key, _ in self.held_out.sample}
        return replace(
            self,
            names=list(memory.statistics.materials),
            readouts=readouts,
            matcher=matcher,
            longest=memory.statistics.longest,
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
        self, candidates: Sequence[str], means: Mapping[Scale, FloatArray], steps: int, hypothesis: Hypothesis
    ) -> Judgement:
        """Weigh the candidates for a touch by the readouts alone.

        means: for each of the scales of `scales_for`, mean features in grid units, (d,). steps: observed so far.
        hypothesis: what the touch is taken for.

        Each stage that is the last one of some candidate weighs the candidates that have rows there. Those without rows
        at a later stage keep their probability; the later stages divide the remaining probability among the others.
        """
        weighing = self.fitted
        decided = self._decided(candidates, len(self.plan.stages(steps)))
        if hypothesis == "paced":  # every touch has views, of all of it
            decided = [(len(weighing.rows) - 1, [*range(len(candidates))])]
        probability, distance = np.ones(len(candidates)), 0.0
        for i, (stage, members) in enumerate(decided):
            mass, names = float(probability[members].sum()) if i else 1.0, [candidates[place] for place in members]
            logits, distance = self._weighted(weighing.row(hypothesis, stage), means, names, steps)
            probability[members] = softmax(logits) * mass
        best = int(np.argmax(probability))
        row = weighing.row(hypothesis, max(stage for stage, members in decided if best in members))
        return Judgement(probability, self.novelty(row, means, candidates), row, distance)

    def _decided(self, candidates: Sequence[str], reached: int) -> list[tuple[int, list[int]]]:
        """(stage, places of the candidates weighed there), for each stage that is the last one of any candidate."""
        groups = []
        for scales in self.stages[: min(reached, len(self.fitted.rows))]:
            known = [self.readouts[scale].places for scale in scales]
            groups.append([i for i, name in enumerate(candidates) if all(name in places for places in known)])
        return [
            (stage, members)
            for stage, members in enumerate(groups)
            if members and (stage + 1 == len(groups) or len(groups[stage + 1]) < len(members))
        ]

    def _places(self, scale: Scale, names: Sequence[str]) -> npt.NDArray[np.intp]:
        """The places of those materials that a scale knows."""
        places = self.readouts[scale].places
        return np.array([places[name] for name in names if name in places], dtype=np.intp)

    def _weighted(
        self, row: Row, means: Mapping[Scale, FloatArray], names: Sequence[str], steps: int
    ) -> tuple[FloatArray, float]:
        """The logits of some materials, weighed as they are calibrated, and the distance of `Judgement`."""
        logits, away = [], []
        for scale in row.scales:
            readout, places = self.readouts[scale], self._places(scale, names)
            logits.append(readout.scores(means[scale], places, self.kind))
            away.append(readout.diagonal_distance(means[scale], int(places[int(logits[-1].argmax())])))
        weights = row.calibration.weights_at(np.array(away))
        distance = float(row.calibration.relative(np.array(away))[measuring(row.scales)].min())
        # A beginning shorter than the first stage is read by fewer readings than the scores are calibrated for.
        begun = min(1.0, steps / row.steps) ** 2
        return begun * np.asarray(sum(weight * own for weight, own in zip(weights, logits, strict=True))), distance

    def novelty(self, row: Row, means: Mapping[Scale, FloatArray], names: Sequence[str]) -> float:
        """The standardised novelty of a touch judged by a row, among these materials."""
        among = None if len(names) == len(self.names) and self.knows_sample else set(names)
        windows = (scale for scale in row.scales if scale.width)
        local = [own.novelty(means[scale], among) for own, scale in zip(self._near(row), windows, strict=False)]
        return float(row.calibration.novelty(np.array([*self.distances(row.scales, means, names), *local])))

    def _near(self, row: Row) -> list[Neighbours]:
        """The sampled touches, also those sampled since the fit, among which a touch lies in a row's windows."""
        near = self.held_out.around(row)
        if not (near and self.since):
            return near
        if row.stage not in self._extended:
            self._extended[row.stage] = [own.extended(self.since) for own in near]
        return self._extended[row.stage]

    def distances(self, scales: Sequence[Scale], means: Mapping[Scale, FloatArray], names: Sequence[str]) -> FloatArray:
        """The relative Mahalanobis distance at each scale that measures novelty, (S',)."""
        novel = [scales[place] for place in measuring(scales)]
        return np.array([self.readouts[scale].novelty(means[scale], self._places(scale, names)) for scale in novel])
