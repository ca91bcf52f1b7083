"""The model: everything that predictions need of a memory, fitted to it alone, and followed as it changes."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import CapacityError, InputError, ScrollTactileError
from scroll_tactile.memory.rows import Added
from scroll_tactile.memory.state import Memory, give_back_scratch
from scroll_tactile.prediction.features import FeatureExtractor, WindowCache, stream_of
from scroll_tactile.prediction.fusion import Fusion, Judged, Moment, chosen_of, fuse, moments_of
from scroll_tactile.readouts.calibration import Calibration, calibrate_stage
from scroll_tactile.readouts.conformal import Conformal
from scroll_tactile.readouts.dependence import Dependence, dependence_of
from scroll_tactile.readouts.deviation import recall_of
from scroll_tactile.readouts.held_out import HeldOut, held_out
from scroll_tactile.readouts.leave_one_out import LeftOut, left_out
from scroll_tactile.readouts.readout import EAGER, Change, Readout, ReadoutName, Task
from scroll_tactile.readouts.recall import Recall
from scroll_tactile.readouts.likelihood import MISSING, LevelArray
from scroll_tactile.readouts.recollection import Kept, Recollection
from scroll_tactile.signals.windows import Scale, WindowPlan
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.sample import SampledTouch
from scroll_tactile.statistics.statistics import Snapshot, Statistics

__all__ = ["Draft", "Hypothesis", "Judgement", "Model", "enough_memory"]

FloatArray = npt.NDArray[np.float64]
Hypothesis = Literal["beginning", "complete", "paced"]
"""What a touch may be: the beginning of a usual one, a complete one, or a complete one at another pace."""


# Of a logit: materials so far behind have less than 2e-8 of the probability each, and single precision is off by far
# less than that part of it. At 40 up to a thousand were solved for, and a touch took three to ten times as long.
NEGLIGIBLE = 18.0

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
    """What is said of a touch by the readouts alone, or with the kept touches.

    probability: of each candidate, shape (C,). novelty: see Prediction. moment: whose threshold the novelty has.
    distance: the least squared distance from a material at any scale that was asked, beside that of a usual touch; 0
    where none is measured.
    """

    probability: FloatArray
    novelty: float
    moment: Moment
    distance: float = 0.0


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
        views = [view for view in memory.plan.views if view in tasks]
        kept = memory.kept.touches() if memory.kept is not None and views else []
        lengths = statistics.longest, statistics.usual_least
        return cls(kind, memory, names, stages, views, tasks, sample, kept, *lengths, statistics.touches)

    def fit(self, extractor: FeatureExtractor) -> Model:
        """Solve the readouts and calibrate them, once: the tasks are let go. extractor: reads kept touches' beginnings."""
        with one_thread():
            # One after the other, each task let go: of all at once the memory would be twice a model's.
            readouts = {scale: Readout(self.tasks.pop(scale), self.memory.statistics) for scale in sorted(self.tasks)}
            asked = [[*stage, *self.views] for stage in self.stages]
            apart = {scale: left_out(readouts[scale], self.sample, asked, self.kind) for scale in readouts}
            reached = [scales for scales in self.stages if all(scale in readouts for scale in scales)]
            calibrations = [
                self._calibrated(stage, scales, readouts, apart) for stage, scales in enumerate(reached)
            ]
            whole, fusion = self._fused(readouts, calibrations, apart, extractor) if reached else (None, None)
        give_back_scratch()
        return Model(self, readouts, calibrations, apart, whole, fusion)

    def _calibrated(
        self, stage: int, scales: Sequence[Scale], readouts: Mapping[Scale, Readout], apart: Mapping[Scale, LeftOut]
    ) -> Calibration:
        """How scores are read at a stage; of a beginning, stage is any number that `apart` has it by."""
        materials = [material for material, *_ in self.sample]
        own = [(readouts[scale], apart[scale]) for scale in scales]
        return calibrate_stage(stage, materials, own, self.kind, viewed=bool(self.views))

    def _fused(
        self,
        readouts: Mapping[Scale, Readout],
        calibrations: Sequence[Calibration],
        apart: Mapping[Scale, LeftOut],
        extractor: FeatureExtractor,
    ) -> tuple[HeldOut, Fusion]:
        """How far readouts and kept touches are believed, by the sampled touches that were held out."""
        last, milestones = len(calibrations) - 1, self.memory.plan.milestones()
        recall = recall_of(self.kept) if self.kept else None
        both = [*self.stages[last], *self.views]
        complete = self._calibrated(last, both, readouts, apart)
        whole = held_out(last, both, self.sample, apart, complete)
        least = max(1, min(self.least, self.longest))
        columns = moments_of(milestones[: last + 1], least, 1, matched=recall is not None)
        chosen, counts = chosen_of(whole, recall)
        stages = [max(0, sum(length <= at for length in milestones[: last + 1]) - 1) for at in columns]
        rows = {} if recall is None else recall.rows()
        seen = self._beginnings(readouts, recall, chosen, columns, stages, extractor) if recall is not None else apart
        # What came over a touch is looked for once, in all of it: that is most of what a comparison costs.
        matches = {}
        if recall is not None:
            matches = {key: recall.recollect(recall.levels(rows[key]), left_out=rows[key]) for key in sorted({*chosen, *counts})}
        judged = []
        for i, (at, stage) in enumerate(zip(columns, stages, strict=True)):
            scales, number = self.stages[stage], stage if recall is None else i
            calibration = self._calibrated(number, scales, readouts, seen)
            said, begun = held_out(number, scales, self.sample, seen, calibration), dict[bytes, Recollection]()
            for key in chosen if recall is not None else ():
                if (levels := recall.levels(rows[key])).shape[1] >= at:
                    begun[key] = recall.recollect(levels[:, :at], left_out=rows[key], noise=matches[key].noise)
            judged.append(Judged(at, stage, calibration, said, begun))
        judged.append(Judged(least, last, complete, whole, matches))
        if recall is None or not chosen:
            return whole, fuse(recall, judged, judged[-1:], chosen, counts)
        paced = [
            self._paced(pace, readouts, recall, {key: matches[key] for key in chosen[i :: len(PACES)]}, last, extractor)
            for i, pace in enumerate(PACES)
        ]
        return whole, fuse(recall, judged, paced, chosen, counts)

    def _paced(
        self,
        pace: float,
        readouts: Mapping[Scale, Readout],
        recall: Recall,
        chosen: Mapping[bytes, Recollection],
        last: int,
        extractor: FeatureExtractor,
    ) -> Judged:
        """What is said of some kept touches, each held out, had they been made at another pace."""
        places, rows = {key: place for place, (_, key, _) in enumerate(self.sample)}, recall.rows()
        asked: dict[Scale, dict[int, dict[int, FloatArray]]] = {scale: {} for scale in self.views}
        matches = {}
        for key, match in chosen.items():
            levels = at_pace(recall.levels(rows[key]), pace)
            matches[key] = recall.recollect(levels, left_out=rows[key], whole=True, noise=match.noise)
            image = extractor.image(stream_of(levels, extractor.sensor))
            for scale, mean in extractor.means(image, self.views).items():
                asked[scale][places[key]] = {0: mean}
        own = [[*stage, *self.views] for stage in self.stages]
        said = {scale: left_out(readouts[scale], self.sample, own, self.kind, asked[scale]) for scale in self.views}
        calibration = self._calibrated(0, self.views, readouts, said)
        lengths = [recall.levels(rows[key]).shape[1] / pace for key in chosen]
        columns = max(1, round(float(np.median(lengths)))) if lengths else 1
        return Judged(columns, last, calibration, held_out(0, self.views, self.sample, said, calibration), matches)

    def _beginnings(
        self,
        readouts: Mapping[Scale, Readout],
        recall: Recall,
        chosen: Sequence[bytes],
        columns: Sequence[int],
        stages: Sequence[int],
        extractor: FeatureExtractor,
    ) -> dict[Scale, LeftOut]:
        """What the windows say of the beginnings of some kept touches, each held out; by the moment's number."""
        places, rows = {key: place for place, (_, key, _) in enumerate(self.sample)}, recall.rows()
        asked: dict[Scale, dict[int, dict[int, FloatArray]]] = {scale: {} for scale in readouts}
        for key in chosen:
            levels, cache = recall.levels(rows[key]), WindowCache()
            touch = stream_of(levels, extractor.sensor)
            for i, (at, stage) in enumerate(zip(columns, stages, strict=True)):
                if at > levels.shape[1]:
                    break
                image = extractor.image(touch.first(at / touch.sensor.rate))
                for scale, mean in extractor.means(image, self.stages[stage], cache=cache).items():
                    asked[scale].setdefault(places[key], {})[i] = mean
        own = [[*stage, *self.views] for stage in self.stages]
        return {
            scale: left_out(readout, self.sample, own, self.kind, asked[scale])
            for scale, readout in readouts.items()
            if scale not in self.views
        }


PACES = (2.0, 1.41, 0.71, 0.5)  # times the usual one, at which touches are resampled: twice to half


def at_pace(levels: LevelArray, pace: float) -> LevelArray:
    """A touch as if it had been made so many times as fast, by linear interpolation: (C, T) to (C, T / pace)."""
    columns = max(2, round(levels.shape[1] / pace))
    places = np.linspace(0, levels.shape[1] - 1, columns)
    first = places.astype(np.intp)
    after, part = np.minimum(first + 1, levels.shape[1] - 1), places - first
    low, high = levels[:, first], levels[:, after]
    blended = np.rint(low * (1 - part) + high * part).astype(np.uint8)
    return np.where((low == MISSING) | (high == MISSING), np.uint8(MISSING), blended)


def scales_of(hypothesis: Hypothesis, windows: Sequence[Scale], views: Sequence[Scale]) -> list[Scale]:
    """The scales that judge: of the beginning of a touch windows, of one at another pace the views, of others both."""
    if hypothesis == "beginning" or not views:
        return list(windows)
    return list(views) if hypothesis == "paced" else [*windows, *views]


class Model:
    """Everything that predictions need of one state of a memory.

    names: the materials, in alphabetical order; known: the same. stages: for each, the windows that judge there.
    views: the views that judge beside them. readouts: scale → its readout. calibrations: how the scores of a stage are
    read, as far as any touch reached it. fusion: how far readouts and kept touches are believed; None where nothing
    was learned. conformal: how typical others are of the kept touches. apart: scale → the sampled touches held out;
    sample: these. dependence: how far touches of one thing say the same. least: the columns of all but the shortest
    touches that were learned, longest: those of the longest. fitted_to: the touches that it was fitted to.

    Any number of threads may ask at once; where it `reads_memory` only one, which holds the memory's lock. It follows
    where nobody asks: otherwise a copy does.
    """

    def __init__(
        self,
        draft: Draft,
        readouts: dict[Scale, Readout],
        calibrations: list[Calibration],
        apart: dict[Scale, LeftOut],
        whole: HeldOut | None,
        fusion: Fusion | None,
    ) -> None:
        self.kind: ReadoutName = draft.kind
        self.plan: WindowPlan = draft.memory.plan
        self.names, self.longest, self.fitted_to = draft.names, draft.longest, draft.touches
        self.known = frozenset(self.names)
        self.readouts, self.apart = readouts, apart
        self._of_all: dict[Scale, npt.NDArray[np.intp]] = {}
        self.calibrations = calibrations
        self.stages, self.views = draft.stages, draft.views
        self.fusion, self.held_out = fusion, whole
        self.dependence = Dependence() if whole is None else dependence_of(whole)
        self.conformal = Conformal(draft.kept) if fusion is not None and fusion.recall is not None else None
        self.least = draft.least
        self.sample = draft.sample

    @property
    def recall(self) -> Recall | None:
        """The kept touches."""
        return None if self.fusion is None else self.fusion.recall

    @property
    def reads_memory(self) -> bool:
        """Whether it has so many materials that it reads those that are asked for from the memory."""
        return len(self.names) > EAGER

    def copy(self) -> Model:
        """Another model of the same state, for one of the two to follow; what following never changes, they share."""
        other = copy.copy(self)
        other.readouts = {scale: readout.copy() for scale, readout in self.readouts.items()}
        other._of_all = {}
        if self.fusion is not None and self.fusion.recall is not None and self.conformal is not None:
            other.fusion = replace(self.fusion, recall=self.fusion.recall.copy())
            other.conformal = self.conformal.copy()
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
        if self.recall is not None and not self._recalls(memory, self.recall):
            return False
        self.names, self.longest = list(memory.statistics.materials), memory.statistics.longest
        self.known = frozenset(self.names)
        self._of_all = {}
        return True

    def _recalls(self, memory: Memory, recall: Recall) -> bool:
        """Take in what is kept in the memory now."""
        assert self.conformal is not None and memory.kept is not None
        kept, held = {(material, key) for material, key, _ in memory.kept}, recall.held
        added = [touch for touch in memory.kept.touches() if (touch.material, touch.key) not in held]
        followed = recall.follow(added, held - kept)
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

    def scales(self, hypothesis: Hypothesis, stage: int) -> list[Scale]:
        """The scales that judge a touch at a stage, ascending."""
        kind = hypothesis if stage == len(self.calibrations) - 1 else "beginning"
        return scales_of(kind, self.stages[stage], self.views)

    def moment(self, hypothesis: Hypothesis, columns: int) -> Moment:
        """The row of the table by which a touch of so many columns is judged."""
        assert self.fusion is not None
        if hypothesis == "beginning":
            return self.fusion.at(columns)
        if hypothesis == "complete":
            return self.fusion.complete
        return self.fusion.at_pace(columns)

    def needed(self, candidates: Sequence[str], columns: int) -> list[Scale]:
        """The scales that are read to judge these candidates for a touch of so many columns."""
        decided = self._decided(candidates, len(self.plan.stages(columns)))
        return sorted({scale for stage, _ in decided for scale in self.stages[stage]} | set(self.views))

    def judge(
        self,
        candidates: Sequence[str],
        means: Mapping[Scale, FloatArray],
        columns: int,
        hypothesis: Hypothesis,
        tuned: Mapping[str, float] | None = None,
    ) -> Judgement:
        """Weigh the candidates for a touch by the readouts alone.

        means: for each scale that is `needed`, its mean features in the codes' unit, (d,). columns: observed so far.
        hypothesis: what the touch is taken for. tuned: logits of f*, by material, in place of the last stage's scores.

        A material that was observed at fewer scales is weighed at the last stage that it reached, against all others;
        the probability that is left goes to the others, which later stages weigh again.
        """
        moment = self.moment(hypothesis, columns)
        if hypothesis == "paced":  # every touch has views, of all of it
            decided: list[tuple[int, Sequence[int]]] = [(len(self.calibrations) - 1, range(len(candidates)))]
        else:
            decided = self._decided(candidates, len(self.plan.stages(columns)))
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
        """(stage, places of the candidates weighed there), for each stage that weighs any against each other."""
        groups = [self._observed_at(scales, candidates) for scales in self.stages[: min(reached, len(self.calibrations))]]
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
        scales, calibration = self.scales(hypothesis, stage), self._read_by(moment, stage)
        places = {scale: self._places(scale, names) for scale in scales}
        chosen, logits = np.arange(len(names)), np.zeros(len(names))
        if len(names) > EAGER:
            coarse = [[part[places[scale]] for part in self.readouts[scale].coarse(means[scale])] for scale in scales]
            weights, distance = self._believed(calibration, scales, means, places, [rough for rough, _ in coarse])
            bounds = np.zeros(len(names))
            for weight, (rough, bound) in zip(weights, coarse, strict=True):
                logits += weight * rough
                bounds += weight * bound
            chosen = np.flatnonzero(logits + bounds >= (logits - bounds).max() - NEGLIGIBLE)
            chosen = chosen[np.argsort(-logits[chosen], kind="stable")[:EAGER]]
            logits[chosen] = 0.0
        exact = [self.readouts[scale].scores(means[scale], places[scale][chosen], self.kind) for scale in scales]
        if len(names) <= EAGER:
            weights, distance = self._believed(calibration, scales, means, places, exact)
        for weight, scores in zip(weights, exact, strict=True):
            logits[chosen] += weight * scores
        return logits, distance

    def _believed(
        self,
        calibration: Calibration,
        scales: Sequence[Scale],
        means: Mapping[Scale, FloatArray],
        places: Mapping[Scale, npt.NDArray[np.intp]],
        scores: Sequence[FloatArray],
    ) -> tuple[FloatArray, float]:
        """How far each scale is believed of this touch, (S,), and the distance of `Judgement`."""
        if not np.isfinite(calibration.usual).all():
            return calibration.weights, 0.0
        best = [int(places[scale][int(own.argmax())]) for scale, own in zip(scales, scores, strict=True)]
        distances = np.array(
            [self.readouts[scale].strangeness(means[scale], place) for scale, place in zip(scales, best, strict=True)]
        )
        return calibration.believed(distances), float(calibration.relative(distances).min())

    def _read_by(self, moment: Moment, stage: int) -> Calibration:
        """How scores are read at a stage: of the moment's, or of materials that were never felt for so long."""
        return moment.calibration if stage == moment.stage else self.calibrations[stage]

    def _novelty(
        self,
        hypothesis: Hypothesis,
        moment: Moment,
        stage: int,
        means: Mapping[Scale, FloatArray],
        names: Sequence[str],
    ) -> float:
        """The standardised novelty of a touch judged at a stage, if it is one of these materials that it may be."""
        scales = self.scales(hypothesis, stage)
        distances = [self.readouts[scale].novelty(means[scale], self._places(scale, names)) for scale in scales]
        return float(self._read_by(moment, stage).novelty(np.array(distances)))

    def novelty(self, stage: int, means: Mapping[Scale, FloatArray], names: Sequence[str]) -> float:
        """The standardised novelty of a touch by the windows of a stage alone."""
        distances = [self.readouts[scale].novelty(means[scale], self._places(scale, names)) for scale in self.stages[stage]]
        return float(self.calibrations[stage].novelty(np.array(distances)))


def _changes(scale: Scale, added: Sequence[Added]) -> list[Change]:
    """What of touches that came and went is of a scale."""
    return [(name, codes[scale], sign) for name, codes, sign in added if len(codes.get(scale, ()))]


def _chances(logits: FloatArray) -> FloatArray:
    chances = np.exp(logits - logits.max())
    return np.asarray(chances / chances.sum())
