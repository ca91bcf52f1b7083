"""The model: all that predictions need of a memory; `prediction.fitting` fits it, `Model.follow` updates it."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import CapacityError, ScrollTactileError
from scroll_tactile.matching.conformal import Conformal
from scroll_tactile.matching.kept_arrays import KeptArrays
from scroll_tactile.matching.matcher import TouchMatcher
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import Added
from scroll_tactile.prediction.moment_table import Fusion, Moment
from scroll_tactile.readouts.calibration import Calibration
from scroll_tactile.readouts.dependence import Dependence
from scroll_tactile.readouts.leave_one_out import HeldOutScores
from scroll_tactile.readouts.readout import Change, Readout, ReadoutName
from scroll_tactile.results import Unusual
from scroll_tactile.signals.windows import Scale, WindowPlan, measuring
from scroll_tactile.statistics.sample import SampledTouch

__all__ = ["Hypothesis", "Judgement", "Model", "enough_memory"]

FloatArray = npt.NDArray[np.float64]
Hypothesis = Literal["prefix", "complete", "paced"]
"""What a touch may be: the prefix of a complete one, a complete one, or a complete one at another pace."""


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
class Judgement:
    """The judgement of a touch by the readouts alone, or with the kept touches.

    probability: of each candidate, shape (C,). novelty: see Prediction. moment: the row of the table whose threshold
    the novelty is compared with.
    distance: the diagonal distance to the best-scoring material, divided by its median over held-out touches; the
    smallest over the scales that measure novelty, 0 where none was measured. unusual: see Prediction.
    """

    probability: FloatArray
    novelty: float
    moment: Moment
    distance: float = 0.0
    unusual: tuple[Unusual, ...] = ()


@dataclass(eq=False)
class Model:
    """Everything that predictions need of one state of a memory.

    names: the materials, in alphabetical order; known: the same names, as a set. stages: for each, the windows that
    judge there. views:
    the views that judge beside them. readouts: scale → its readout. calibrations: how the scores of a stage are read,
    as far as any touch reached it. fusion: the weights of readouts and kept touches; None where nothing was learned.
    conformal: conformal p-values by the kept touches. held_out: scale → scores of the sampled touches, each held out;
    sample: these touches. dependence: the correlations of touches of one thing. least: the 5th percentile of the
    learned touches' lengths in steps, longest: the maximum. fitted_to: the touches that it was fitted to.

    Several threads may use it at once. `follow` changes it in place: update a copy while another thread uses it.
    """

    kind: ReadoutName
    plan: WindowPlan
    names: list[str]
    stages: list[list[Scale]]
    views: list[Scale]
    readouts: dict[Scale, Readout]
    calibrations: list[Calibration]
    held_out: dict[Scale, HeldOutScores]
    sample: list[tuple[str, bytes, SampledTouch]]
    fusion: Fusion | None
    dependence: Dependence
    conformal: Conformal | None
    least: int
    longest: int
    fitted_to: int

    def __post_init__(self) -> None:
        self.known = frozenset(self.names)
        self._of_all: dict[Scale, npt.NDArray[np.intp]] = {}

    @property
    def matcher(self) -> TouchMatcher | None:
        """The kept touches."""
        return None if self.fusion is None else self.fusion.matcher

    def copy(self, readouts: dict[Scale, Readout] | None = None) -> Model:
        """A copy that follows independently; both share the parts that `follow` never changes.

        readouts: in place of copies of its own.
        """
        other = copy.copy(self)
        if readouts is None:
            readouts = {scale: readout.copy() for scale, readout in self.readouts.items()}
        other.readouts, other._of_all = readouts, {}
        if self.fusion is not None and self.fusion.matcher is not None and self.conformal is not None:
            other.fusion = replace(self.fusion, matcher=self.fusion.matcher.copy())
            other.conformal = self.conformal.copy()
        return other

    def follow(self, memory: Memory, added: Sequence[Added]) -> bool:
        """Update by touches that were observed or retracted, which the memory has already; False where it cannot.

        The readouts then rest on all observations; calibration and shrinkage stay as they were fitted.
        """
        for scale in memory.statistics.scales:
            changes = _changes(scale, added)
            if not changes or (scale in memory.plan.views and scale not in self.views):
                continue
            if scale not in self.readouts or not self.readouts[scale].follow(changes):
                return False
        if self.matcher is not None and not self._follow_kept(memory, self.matcher):
            return False
        self.names, self.longest = list(memory.statistics.materials), memory.statistics.longest
        self.known = frozenset(self.names)
        self._of_all = {}
        return True

    def _follow_kept(self, memory: Memory, matcher: TouchMatcher) -> bool:
        """Update the kept touches to those of the memory; False where none are left."""
        assert self.conformal is not None and self.fusion is not None and memory.kept is not None
        kept, held = {(material, key) for material, key, _ in memory.kept}, matcher.kept.held
        added = [touch for touch in memory.kept.touches() if (touch.material, touch.key) not in held]
        if not kept:
            return False
        if matcher.kept.follow(added, held - kept):
            self.conformal.follow(added, held - kept)
        else:  # one is longer than all before: the arrays are made anew, their natural deviation stays
            touches = memory.kept.touches()
            self.fusion = replace(self.fusion, matcher=TouchMatcher(KeptArrays.of(touches), matcher.deviation))
            self.conformal = Conformal.of(touches)
        return True

    def needs_renewal(self, behind: Sequence[Added]) -> bool:
        """Whether a readout, with the touches still to be taken in, has used five eighths of its room for columns."""
        for scale, readout in self.readouts.items():
            columns = sum(len(codes[scale]) for _, codes, *_ in behind if scale in codes)
            if 3 * (readout.system.rank + columns) > 5 * (readout.system.room - columns):
                return True
        return False

    def is_last(self, steps: int) -> bool:
        """Whether a touch of so many steps is judged at the last stage, whose scores f* gives."""
        return min(len(self.plan.stages(steps)), len(self.calibrations)) == len(self.stages)

    def scales(self, hypothesis: Hypothesis, stage: int) -> list[Scale]:
        """The scales that judge a touch at a stage.

        Windows judge a prefix, views judge a touch at another pace, and both judge a complete one. Before the last
        stage, and without views, windows alone judge.
        """
        if hypothesis == "prefix" or not self.views or stage < len(self.calibrations) - 1:
            return list(self.stages[stage])
        return list(self.views) if hypothesis == "paced" else [*self.stages[stage], *self.views]

    def moment(self, hypothesis: Hypothesis, steps: int) -> Moment:
        """The row of the table by which a touch of so many steps is judged."""
        assert self.fusion is not None
        if hypothesis == "prefix":
            return self.fusion.at(steps)
        if hypothesis == "complete":
            return self.fusion.complete
        return self.fusion.at_pace(steps)

    def scales_for(self, candidates: Sequence[str], steps: int) -> list[Scale]:
        """The scales that are read to judge these candidates for a touch of so many steps."""
        decided = self._decided(candidates, len(self.plan.stages(steps)))
        return sorted({scale for stage, _ in decided for scale in self.stages[stage]} | set(self.views))

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
        at a later stage keep their
        probability; the later stages divide the remaining probability among the others.
        """
        moment = self.moment(hypothesis, steps)
        if hypothesis == "paced":  # every touch has views, of all of it
            decided: list[tuple[int, Sequence[int]]] = [(len(self.calibrations) - 1, range(len(candidates)))]
        else:
            decided = self._decided(candidates, len(self.plan.stages(steps)))
        probability, mass, distance = np.ones(len(candidates)), 1.0, 0.0
        for i, (stage, members) in enumerate(decided):
            names = candidates if len(members) == len(candidates) else [candidates[place] for place in members]
            if tuned is not None and stage == len(self.stages) - 1:
                logits = np.array([tuned[name] for name in names])
            else:
                logits, distance = self._weighted(hypothesis, moment, stage, means, names)
            probability[np.asarray(members)] = _chances(logits) * mass
            later = np.asarray(decided[i + 1][1] if i + 1 < len(decided) else [], dtype=np.intp)
            mass = float(probability[later].sum())
        best = int(np.argmax(probability))
        stage = max(stage for stage, members in decided if best in members)
        novelty = self._novelty(hypothesis, moment, stage, means, candidates)
        return Judgement(probability, novelty, moment, distance)

    def _decided(self, candidates: Sequence[str], reached: int) -> list[tuple[int, Sequence[int]]]:
        """(stage, places of the candidates weighed there), for each stage that is the last one of any candidate."""
        groups = [
            self._observed_at(scales, candidates) for scales in self.stages[: min(reached, len(self.calibrations))]
        ]
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
        self,
        hypothesis: Hypothesis,
        moment: Moment,
        stage: int,
        means: Mapping[Scale, FloatArray],
        names: Sequence[str],
    ) -> tuple[FloatArray, float]:
        """The logits of some materials, weighed as they are calibrated, and the distance of `Judgement`."""
        scales, calibration = self.scales(hypothesis, stage), self.calibration(hypothesis, moment, stage)
        readouts, features = [self.readouts[scale] for scale in scales], [means[scale] for scale in scales]
        places = [self._places(scale, names) for scale in scales]
        found = [
            readout.scores(own, among, self.kind)
            for readout, own, among in zip(readouts, features, places, strict=True)
        ]
        weights, distance = calibration.weights, 0.0
        if np.isfinite(calibration.median_distances).all():
            nearest = [int(among[int(scores.argmax())]) for among, scores in zip(places, found, strict=True)]
            away = [
                readout.diagonal_distance(own, place)
                for readout, own, place in zip(readouts, features, nearest, strict=True)
            ]
            weights = calibration.weights_at(np.array(away))
            distance = float(calibration.relative(np.array(away))[measuring(scales)].min())
        return np.asarray(sum(weight * scores for weight, scores in zip(weights, found, strict=True))), distance

    def calibration(self, hypothesis: Hypothesis, moment: Moment, stage: int) -> Calibration:
        """The calibration by which scores are read at a stage: the moment's, if it is of this stage.

        Otherwise the stage's own: for materials whose touches ended at an earlier stage, and for a prefix where
        "complete" is the only row.
        """
        assert self.fusion is not None
        begun = hypothesis == "prefix" and moment is self.fusion.complete
        return self.calibrations[stage] if begun or stage != moment.stage else moment.calibration

    def _novelty(
        self,
        hypothesis: Hypothesis,
        moment: Moment,
        stage: int,
        means: Mapping[Scale, FloatArray],
        names: Sequence[str],
    ) -> float:
        """The standardised novelty of a touch judged at a stage, among these materials."""
        distances = self._distances(self.scales(hypothesis, stage), means, names)
        return float(self.calibration(hypothesis, moment, stage).novelty(distances))

    def novelty(self, stage: int, means: Mapping[Scale, FloatArray], names: Sequence[str]) -> float:
        """The standardised novelty of a touch by the windows of a stage alone."""
        return float(self.calibrations[stage].novelty(self._distances(self.stages[stage], means, names)))

    def _distances(
        self, scales: Sequence[Scale], means: Mapping[Scale, FloatArray], names: Sequence[str]
    ) -> FloatArray:
        """The relative Mahalanobis distance at each scale that measures novelty, (S',)."""
        novel = [scales[place] for place in measuring(scales)]
        return np.array([self.readouts[scale].novelty(means[scale], self._places(scale, names)) for scale in novel])


def _changes(scale: Scale, added: Sequence[Added]) -> list[Change]:
    """The changes at one scale by touches that came and went."""
    return [(name, codes[scale], sign) for name, codes, sign, _ in added if len(codes.get(scale, ()))]


def _chances(logits: FloatArray) -> FloatArray:
    chances = np.exp(logits - logits.max())
    return np.asarray(chances / chances.sum())
