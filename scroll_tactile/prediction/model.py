"""The model: everything that predictions need of a memory, fitted to it alone, and followed as it changes."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import CapacityError, InputError, ScrollTactileError
from scroll_tactile.memory.rows import Added
from scroll_tactile.memory.state import Memory, give_back_scratch
from scroll_tactile.prediction.measurement import Measurement
from scroll_tactile.readouts.calibration import (
    PRIOR_WEIGHT,
    Calibration,
    calibrate,
    calibrate_stage,
    common_names,
    judged_touches,
)
from scroll_tactile.readouts.conformal import Conformal
from scroll_tactile.readouts.dependence import Dependence, dependence_of
from scroll_tactile.readouts.deviation import recall_of
from scroll_tactile.readouts.early import Early
from scroll_tactile.readouts.leave_one_out import LeftOut, left_out
from scroll_tactile.readouts.pooled import Apart, Pooled, pool
from scroll_tactile.readouts.readout import EAGER, Change, Readout, ReadoutName, Task
from scroll_tactile.readouts.recollection import Kept
from scroll_tactile.signals.windows import Scale, WindowPlan
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.sample import SampledTouch
from scroll_tactile.statistics.statistics import Snapshot, Statistics

__all__ = ["Draft", "Judgement", "Measures", "Model", "enough_memory"]

FloatArray = npt.NDArray[np.float64]
Measures = Callable[["Model"], Early | None]


# Of a logit: materials so far behind have less than 2e-8 of the probability each, and single precision is off by far
# less than that part of it. At 40 up to a thousand were solved for, and a touch took three to ten times as long.
NEGLIGIBLE = 18.0

# A touch shorter than those learned may be the beginning of one, or a whole one made faster. Of beginnings the views
# look strange, and are doubted by more than in proportion: of halves of BioTac's touches 97 % are right so and 96 in
# proportion, of touches at twice the speed 94 and 95; without views 97.5 and 83.
DOUBT = 1.5


@contextmanager
def enough_memory() -> Iterator[None]:
    """Raise CapacityError where the system has no memory left for the readouts; what was observed is kept.

    Raises ScrollTactileError where sums that came from elsewhere have no readout: see `memory.gate`.
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
    """probability: of each candidate, shape (C,). novelty: see Prediction. calibration: of the stage judged at.

    strange: the least strangeness of any scale that was asked, beside the usual; 0 where none is measured.
    """

    probability: FloatArray
    novelty: float
    calibration: Calibration
    strange: float = 0.0


@dataclass(frozen=True)
class Draft:
    """All that a model is fitted to, taken of a memory at one moment, so that fitting waits for nobody.

    Raises InputError, from `of`, for the ridge of more materials than it can weigh.
    """

    kind: ReadoutName
    memory: Memory
    names: list[str]
    stages: list[list[Scale]]
    views: list[Scale]
    tasks: dict[Scale, Task]
    sample: list[tuple[str, bytes, SampledTouch]]
    kept: list[Kept]
    longest: int
    least: int
    touches: int

    @classmethod
    def of(cls, memory: Memory, kind: ReadoutName) -> Draft:
        """The draft of a memory as it is now."""
        statistics, sample = memory.statistics, list(memory.sample)
        names = list(statistics.materials)
        if kind == "ridge" and len(names) > EAGER:
            raise InputError(
                f'the readout "ridge" weighs {EAGER} materials at most; there are {len(names)}: take "lda"'
            )
        # All materials where they are few: then novelty rests on all, and the ridge is the paper's.
        reference = names if kind == "ridge" else sorted({material for material, *_ in sample})
        judging = [scale for scale in statistics.scales if statistics.second(scale).rows]
        tasks = {scale: Task.of(statistics, scale, reference, memory.plan.shrinkage) for scale in judging}
        stages = [memory.plan.judging(length) for length in memory.plan.milestones()]
        views = list(memory.plan.views)
        kept = memory.kept.touches() if memory.kept is not None and views else []
        lengths = statistics.longest, statistics.usual_least
        return cls(kind, memory, names, stages, views, tasks, sample, kept, *lengths, statistics.touches)

    def fit(self) -> Model:
        """Solve the readouts and calibrate them, once: the tasks are let go."""
        with one_thread():
            # One after the other, each task let go: of all at once the memory would be twice a model's.
            readouts = {scale: Readout(self.tasks.pop(scale), self.memory.statistics) for scale in sorted(self.tasks)}
            asked = [[*stage, *self.memory.plan.views] for stage in self.stages]
            apart = {scale: left_out(readouts[scale], self.sample, asked, self.kind) for scale in readouts}
            calibrations = calibrate(self.sample, self.stages, readouts, apart, self.kind)
            whole, pooled, told, last = None, None, dict[bytes, Apart](), len(calibrations) - 1
            if calibrations and self.views:
                scales = [(readouts[scale], apart[scale]) for scale in [*self.stages[last], *self.views]]
                materials = [material for material, *_ in self.sample]
                whole = calibrate_stage(last, materials, scales, self.kind, viewed=True)
            if calibrations:
                told = self._left_out(apart, last, calibrations[last] if whole is None else whole)
            if whole is not None and self.kept:
                pooled = pool(recall_of(self.kept), told, float(whole.weights.sum()) / PRIOR_WEIGHT[self.kind])
        give_back_scratch()
        return Model(self, readouts, calibrations, apart, whole, pooled, dependence_of(told))

    def _left_out(self, apart: Mapping[Scale, LeftOut], last: int, whole: Calibration) -> dict[bytes, Apart]:
        """What the readouts say of sampled touches that they never observed, by key, at the last stage."""
        scales = [*self.stages[last], *self.views]
        said = [apart[scale] for scale in scales]
        names, found = common_names(said), {}
        places = [[left.names.index(name) for name in names] for left in said]
        for touch in judged_touches(last, said):
            material, key, _ = self.sample[touch]
            rows = [left.rows[touch, last] for left in said]
            strange = np.array([left.strangeness[row] for left, row in zip(said, rows, strict=True)])
            weights = whole.believed(strange)
            logits = sum(
                weight * left.scores[row][own]
                for weight, left, row, own in zip(weights, said, rows, places, strict=True)
            )
            relative = float(whole.relative(strange).min())
            novelty = float(
                whole.novelty(
                    np.array(
                        [left.distances[row][own].min() for left, row, own in zip(said, rows, places, strict=True)]
                    )
                )
            )
            found[key] = Apart(material, dict(zip(names, np.asarray(logits).tolist(), strict=True)), relative, novelty)
        return found


class Model:
    """Everything that predictions need of one state of a memory.

    names: the materials, in alphabetical order; known: the same. stages: for each, the windows that judge there.
    views: the views that judge beside them; whole: the calibration of both, for whole touches at the last stage.
    pooled: the kept touches beside it, if any; conformal: how typical others are of them. least: the columns of all but
    the shortest touches that were learned. readouts: scale → its readout. calibrations: of the stages, as far as any
    touch reached them. apart: scale → the sampled touches left out; sample: these. beginnings: how they are judged.
    dependence: how far touches of one thing say the same. longest: the columns of the longest touch that was learned.
    fitted_to: the touches that it was fitted to.

    Any number of threads may ask at once; where it `reads_memory` only one, which holds the memory's lock. It follows
    where nobody asks: otherwise a copy does.
    """

    def __init__(
        self,
        draft: Draft,
        readouts: dict[Scale, Readout],
        calibrations: list[Calibration],
        apart: dict[Scale, LeftOut],
        whole: Calibration | None,
        pooled: Pooled | None,
        dependence: Dependence,
    ) -> None:
        self.kind: ReadoutName = draft.kind
        self.plan: WindowPlan = draft.memory.plan
        self.names, self.longest, self.fitted_to = draft.names, draft.longest, draft.touches
        self.known = frozenset(self.names)
        self.readouts, self.apart = readouts, apart
        self._of_all: dict[Scale, npt.NDArray[np.intp]] = {}
        self.materials = [material for material, *_ in draft.sample]
        self.calibrations = calibrations
        self.stages = draft.stages
        self.views, self.whole = draft.views if whole else [], whole
        self.pooled = pooled
        self.dependence = dependence
        self.conformal = Conformal(draft.kept) if pooled else None
        self.least = draft.least
        self.sample = draft.sample
        self.beginnings: Measurement[Model] = Measurement()

    def early(self, measures: Measures) -> Early | None:
        """How beginnings are judged: as it `measures` when it is first asked for, and the same from then on."""
        return self.beginnings.of(self, self.fitted_to, measures)

    @property
    def reads_memory(self) -> bool:
        """Whether it has so many materials that it reads those that are asked for from the memory."""
        return len(self.names) > EAGER

    def copy(self) -> Model:
        """Another model of the same state, for one of the two to follow; what following never changes, they share."""
        other = copy.copy(self)
        other.readouts = {scale: readout.copy() for scale, readout in self.readouts.items()}
        other._of_all = {}
        if self.pooled is not None and self.conformal is not None:
            other.pooled = replace(self.pooled, recall=self.pooled.recall.copy())
            other.conformal = self.conformal.copy()
        other.beginnings = Measurement(self.beginnings)
        return other

    def read(self, statistics: Statistics | Snapshot) -> None:
        """Read there the materials that are asked for: in statistics that agree with it, or will where it follows."""
        for readout in self.readouts.values():
            readout.statistics = statistics

    def freeze(self, statistics: Statistics) -> None:
        """Stay the model of these statistics as they are now, until it follows what came since."""
        if self.reads_memory:
            self.read(statistics.snapshot())

    def follow(self, memory: Memory, added: Sequence[Added]) -> bool:
        """Take in touches that came and went, which the memory has already; False where it has to be fitted again.

        The readouts are then those of all that was observed; calibration, and how far the scatter is shrunk, stay.
        """
        self.read(memory.statistics)
        for scale in memory.statistics.scales:
            changes = _changes(scale, added)
            if not changes or (scale in memory.plan.views and scale not in self.views):
                continue
            if scale not in self.readouts or not self.readouts[scale].follow(changes):
                return False
        if self.pooled is not None and not self._recalls(memory):
            return False
        self.names, self.longest = list(memory.statistics.materials), memory.statistics.longest
        self.known = frozenset(self.names)
        self._of_all = {}
        return True

    def _recalls(self, memory: Memory) -> bool:
        """Take in what is kept in the memory now."""
        assert self.pooled is not None and self.conformal is not None and memory.kept is not None
        kept, held = {(material, key) for material, key, _ in memory.kept}, self.pooled.recall.held
        added = [touch for touch in memory.kept.touches() if (touch.material, touch.key) not in held]
        followed = self.pooled.recall.follow(added, held - kept)
        if followed:
            self.conformal.follow(added, held - kept)
        return followed

    @property
    def crowded(self) -> bool:
        """Whether five eighths of what the readouts can follow has come."""
        return any(readout.crowded for readout in self.readouts.values())

    def is_last(self, columns: int) -> bool:
        """Whether a touch of so many columns is judged at the last stage, whose scores f* gives."""
        return min(len(self.plan.stages(columns)), len(self.calibrations)) == len(self.stages)

    def needed(self, candidates: Sequence[str], columns: int) -> list[Scale]:
        """The scales that are read to judge these candidates for a touch of so many columns."""
        decided = self._decided(candidates, len(self.plan.stages(columns)))
        return sorted({scale for stage, _ in decided for scale in self.stages[stage]} | set(self.views))

    def judge(
        self,
        candidates: Sequence[str],
        means: Mapping[Scale, FloatArray],
        columns: int,
        tuned: Mapping[str, float] | None = None,
        *,
        whole: bool | None = None,
    ) -> Judgement:
        """Weigh the candidates for a touch.

        means: for each scale that is `needed`, its mean features in the codes' unit, (d,). columns: observed so far.
        tuned: logits of f*, by material, in place of the last stage's scores. whole: whether it is a whole touch, and
        not the beginning of one; by its length unless given.

        A material that was observed at fewer scales is weighed at the last stage that it reached, against all others;
        the probability that is left goes to the others, which later stages weigh again.
        """
        decided = self._decided(candidates, len(self.plan.stages(columns)))
        whole = columns >= self.least if whole is None else whole
        probability, mass, strange = np.ones(len(candidates)), 1.0, 0.0
        for i, (stage, members) in enumerate(decided):
            names = candidates if len(members) == len(candidates) else [candidates[place] for place in members]
            if tuned is not None and stage == len(self.stages) - 1:
                logits = np.array([tuned[name] for name in names])
            else:
                logits, strange = self._weighted(stage, whole, means, names)
            probability[np.asarray(members)] = _chances(logits) * mass
            later = np.asarray(decided[i + 1][1] if i + 1 < len(decided) else [], dtype=np.intp)
            mass = float(probability[later].sum())
        best = int(np.argmax(probability))
        stage = max(stage for stage, members in decided if best in members)
        novelty = self.novelty(stage, whole, means, candidates)
        return Judgement(probability, novelty, self._calibration(stage, whole), strange)

    def _decided(self, candidates: Sequence[str], reached: int) -> list[tuple[int, Sequence[int]]]:
        """(stage, places of the candidates weighed there), for each stage that weighs any against each other."""
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
        self, stage: int, whole: bool, means: Mapping[Scale, FloatArray], names: Sequence[str]
    ) -> tuple[FloatArray, float]:
        """The logits of some materials, weighed as the stage is calibrated, and the strangeness of `Judgement`."""
        scales = [*self.stages[stage], *self.views]
        places = {scale: self._places(scale, names) for scale in scales}
        chosen, logits = np.arange(len(names)), np.zeros(len(names))
        if len(names) > EAGER:
            coarse = {
                scale: [part[places[scale]] for part in self.readouts[scale].coarse(means[scale])] for scale in scales
            }
            rough = {scale: scores for scale, (scores, _) in coarse.items()}
            weights, strange = self._believed(stage, whole, means, places, rough)
            bounds = np.zeros(len(names))
            for scale, weight in weights.items():
                logits += weight * coarse[scale][0]
                bounds += weight * coarse[scale][1]
            chosen = np.flatnonzero(logits + bounds >= (logits - bounds).max() - NEGLIGIBLE)
            chosen = chosen[np.argsort(-logits[chosen], kind="stable")[:EAGER]]
            logits[chosen] = 0.0
        exact = {scale: self.readouts[scale].scores(means[scale], places[scale][chosen], self.kind) for scale in scales}
        if len(names) <= EAGER:
            weights, strange = self._believed(stage, whole, means, places, exact)
        for scale, weight in weights.items():
            logits[chosen] += weight * exact[scale]
        return logits, strange

    def _believed(
        self,
        stage: int,
        whole: bool,
        means: Mapping[Scale, FloatArray],
        places: Mapping[Scale, npt.NDArray[np.intp]],
        scores: Mapping[Scale, FloatArray],
    ) -> tuple[dict[Scale, float], float]:
        """How far each scale is believed of this touch, judged at a stage, and the strangeness of `Judgement`."""
        own = self.stages[stage]
        weights = dict(zip(own, self.calibrations[stage].weights.tolist(), strict=True))
        joint = [*self.stages[len(self.calibrations) - 1], *self.views]
        judging = joint if self._is_whole(stage, whole) else self.views
        # Where no touch could be left out, how strange a beginning looks is not known, and the views cannot be doubted.
        if self.whole is None or not (judging is joint or np.isfinite(self.whole.usual).all()):
            return weights, 0.0
        strange = np.zeros(len(joint))
        for i, scale in enumerate(joint):
            if scale in scores:
                best = int(places[scale][int(scores[scale].argmax())])
                strange[i] = self.readouts[scale].strangeness(means[scale], best)
        believed = self.whole.believed(strange, 1.0 if whole else DOUBT)
        least = float(self.whole.relative(strange)[[scale in scores for scale in joint]].min())
        return weights | {scale: believed[i] for i, scale in enumerate(joint) if scale in judging}, least

    def _is_whole(self, stage: int, whole: bool) -> bool:
        """Whether a touch is judged as those that the calibration of the whole was measured on."""
        return self.whole is not None and whole and stage == len(self.calibrations) - 1

    def novelty(self, stage: int, whole: bool, means: Mapping[Scale, FloatArray], names: Sequence[str]) -> float:
        """The standardised novelty of a touch judged at a stage, if it is one of these materials that it may be."""
        viewed = self.views if self._is_whole(stage, whole) else []
        scales = [*self.stages[stage], *viewed]
        distances = [self.readouts[scale].novelty(means[scale], self._places(scale, names)) for scale in scales]
        return float(self._calibration(stage, whole).novelty(np.array(distances)))

    def _calibration(self, stage: int, whole: bool) -> Calibration:
        return self.whole if self.whole is not None and self._is_whole(stage, whole) else self.calibrations[stage]


def _changes(scale: Scale, added: Sequence[Added]) -> list[Change]:
    """What of touches that came and went is of a scale."""
    return [(name, codes[scale], sign) for name, codes, sign in added if len(codes.get(scale, ()))]


def _chances(logits: FloatArray) -> FloatArray:
    chances = np.exp(logits - logits.max())
    return np.asarray(chances / chances.sum())
