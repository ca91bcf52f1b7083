"""Fitting a model to the present memory: its readouts are solved, then calibrated on held-out touches.

A sampled touch that is kept is taken out of the readouts and out of the kept touches. Its prefixes, and its versions at
other paces, are made from its kept levels. Readouts and kept touches, both without it, judge all of these, as they will
judge a new touch. The calibrations (`readouts.calibration`) and the weights of readouts and kept touches at each moment
(`fusion`) are fitted to these judgements. A prediction fits nothing, and the model is a function of the set of touches.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.matching.conformal import Conformal
from scroll_tactile.matching.kept_arrays import at_places
from scroll_tactile.matching.likelihood import LevelArray
from scroll_tactile.matching.match import KeptTouch, Match
from scroll_tactile.matching.matcher import TouchMatcher, matcher_of
from scroll_tactile.memory.state import Memory
from scroll_tactile.persistence.open_memory import give_back_scratch
from scroll_tactile.prediction.features import FeatureExtractor, WindowCache, stream_of
from scroll_tactile.prediction.fusion import HeldOutMoment, chosen_of, fuse, moments_of
from scroll_tactile.prediction.model import Model
from scroll_tactile.prediction.moment_table import Fusion
from scroll_tactile.readouts.calibration import (
    PRIOR_WEIGHT,
    Calibration,
    HeldOutProbabilities,
    calibrate_stage,
    held_out_probabilities,
)
from scroll_tactile.readouts.dependence import Dependence, dependence_of
from scroll_tactile.readouts.leave_one_out import HeldOutScores, StageScores, held_out_scores
from scroll_tactile.readouts.readout import Readout, ReadoutName
from scroll_tactile.readouts.task import Task
from scroll_tactile.signals.windows import Scale, WindowPlan
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.sample import SampledTouch

__all__ = ["PACES", "Draft", "Renewal", "at_pace", "examined"]

FloatArray = npt.NDArray[np.float64]
Queries = dict[Scale, dict[int, dict[int, FloatArray]]]
"""Scale → a touch's place in the sample → number → mean features in grid units, (d,); see `held_out_scores`."""

MOST_OF_RIDGE = 1024  # materials: it inverts a matrix of all of them
PACES = (2.0, 1.41, 0.71, 0.5)  # relative to a touch's own: it is resampled to be twice to half as fast


@dataclass(frozen=True)
class Renewal:
    """Solves the readouts of a model again, from the memory as it was when this was made; calibration and fusion stay.

    It takes a tenth of the time of a fit: a model can keep up with touches that come too fast for fits.
    """

    model: Model
    readouts: dict[Scale, Readout]
    tasks: dict[Scale, Task]

    @classmethod
    def of(cls, model: Model, memory: Memory) -> Renewal:
        """The renewal of a model whose materials are all in the memory."""
        tasks = {
            scale: Task.of(memory.statistics, scale, readout.reference) for scale, readout in model.readouts.items()
        }
        return cls(model.copy({}), dict(model.readouts), tasks)

    def solve(self) -> Model:
        """Solve the readouts one after the other; each task is freed."""
        with one_thread():
            for scale in sorted(self.tasks):
                task = self.tasks.pop(scale)
                self.model.readouts[scale] = task.solve(like=self.readouts.pop(scale))
        give_back_scratch()
        return self.model


def examined(model: Model, memory: Memory) -> Model:
    """A model as it judges this memory, with the sampled touches and the scores of each held out.

    Neither is stored, and updates leave both behind. The readouts are solved again, so that touches can be held out of
    them; calibration and fusion stay those that answer. It takes a fifth of the time of a fit.
    """
    renewed, sample = Renewal.of(model, memory).solve(), list(memory.sample)
    stages = [[*stage, *renewed.views] for stage in renewed.stages]
    with one_thread():
        held_out = {
            scale: held_out_scores(readout, sample, stages, renewed.kind) for scale, readout in renewed.readouts.items()
        }
    return replace(renewed, sample=sample, held_out=held_out)


@dataclass(frozen=True)
class Draft:
    """The input of a fit, copied from a memory at one moment, so that fitting needs no lock.

    Raises InputError, from `of`, for the ridge of more materials than it can weigh.
    """

    kind: ReadoutName
    plan: WindowPlan
    names: list[str]
    stages: list[list[Scale]]
    views: list[Scale]
    tasks: dict[Scale, Task]
    sample: list[tuple[str, bytes, SampledTouch]]
    kept: list[KeptTouch]
    longest: int
    least: int
    touches: int

    @classmethod
    def of(cls, memory: Memory, kind: ReadoutName) -> Draft:
        """The draft of a memory as it is now."""
        statistics, sample = memory.statistics, list(memory.sample)
        names = list(statistics.materials)
        if kind == "ridge" and len(names) > MOST_OF_RIDGE:
            raise InputError(
                f'the readout "ridge" weighs {MOST_OF_RIDGE} materials at most; there are {len(names)}: take "lda"'
            )
        # The ridge's reference materials are all, as in the paper; LDA's are those with a sampled touch.
        reference = names if kind == "ridge" else sorted({material for material, *_ in sample})
        judging = [scale for scale in statistics.scales if statistics.second(scale).rows]
        tasks = {scale: Task.of(statistics, scale, reference, memory.plan.shrinkage) for scale in judging}
        stages = [memory.plan.judging(length) for length in memory.plan.milestones()]
        views = [view for view in memory.plan.views if view in tasks]
        kept = memory.kept.touches() if memory.kept is not None and views else []
        lengths = statistics.longest, statistics.fifth_percentile_length
        return cls(kind, memory.plan, names, stages, views, tasks, sample, kept, *lengths, statistics.touches)

    def fit(self, extractor: FeatureExtractor | None) -> Model:
        """Solve the readouts and fit calibration and weights. Can be called once: it frees the tasks.

        extractor: reads kept touches; without it nothing is fitted to their prefixes and other paces.
        """
        with one_thread():
            # One after the other, each task freed: all at once would take twice the memory of a model.
            readouts = {scale: self.tasks.pop(scale).solve() for scale in sorted(self.tasks)}
            fit = _Fit(self, readouts, extractor)
            held_out = {scale: fit.held_out_scores(scale) for scale in readouts}
            reached = [scales for scales in self.stages if all(scale in readouts for scale in scales)]
            calibrations = [fit.calibrated(stage, scales, held_out)[0] for stage, scales in enumerate(reached)]
            whole, fusion = fit.fused(len(reached) - 1, held_out) if reached else (None, None)
        give_back_scratch()
        return Model(
            kind=self.kind,
            plan=self.plan,
            names=self.names,
            stages=self.stages,
            views=self.views,
            readouts=readouts,
            calibrations=calibrations,
            held_out=held_out,
            sample=self.sample,
            fusion=fusion,
            dependence=Dependence() if whole is None else dependence_of(whole),
            conformal=Conformal.of(self.kept) if fusion is not None and fusion.matcher is not None else None,
            least=self.least,
            longest=self.longest,
            fitted_to=self.touches,
        )


@dataclass(frozen=True)
class _Fit:
    """One fit: a draft, its solved readouts, and the extractor for prefixes of kept touches."""

    draft: Draft
    readouts: Mapping[Scale, Readout]
    extractor: FeatureExtractor | None

    def held_out_scores(self, scale: Scale, queries: Queries | None = None) -> HeldOutScores:
        """A scale's scores of the sampled touches, each held out. queries: features scored in place of their rows."""
        draft = self.draft
        stages = [[*stage, *draft.views] for stage in draft.stages]
        own = None if queries is None else queries[scale]
        return held_out_scores(self.readouts[scale], draft.sample, stages, draft.kind, own)

    def calibrated(
        self, number: int, scales: Sequence[Scale], held_out: Mapping[Scale, HeldOutScores]
    ) -> tuple[Calibration, HeldOutProbabilities]:
        """The calibration of some scales, and the calibrated probabilities of the held-out touches.

        number: the stage of the scores in `held_out`, or the number of their query.
        """
        found = StageScores(number, self.draft.sample, [held_out[scale] for scale in scales])
        readouts = [self.readouts[scale] for scale in scales]
        calibration = calibrate_stage(found, readouts, self.draft.kind, viewed=bool(self.draft.views))
        return calibration, held_out_probabilities(found, scales, calibration)

    def judged(
        self,
        moment: tuple[int, int],
        number: int,
        scales: Sequence[Scale],
        held_out: Mapping[Scale, HeldOutScores],
        matches: Mapping[bytes, Match],
    ) -> HeldOutMoment:
        """Some scales and the kept touches at a moment, given as its steps and stage."""
        return HeldOutMoment(*moment, *self.calibrated(number, scales, held_out), matches)

    def fused(self, last: int, held_out: Mapping[Scale, HeldOutScores]) -> tuple[HeldOutProbabilities, Fusion]:
        """The readouts' probabilities of complete held-out touches, and the table of all weights.

        last: the last stage that any touch reached. held_out: each scale's scores of the sampled touches.
        """
        draft, milestones = self.draft, self.draft.plan.milestones()[: last + 1]
        matcher = matcher_of(draft.kept) if draft.kept else None
        least = max(1, min(draft.least, draft.longest))
        complete = self.judged((least, last), last, [*draft.stages[last], *draft.views], held_out, {})
        steps = moments_of(milestones, least, matched=matcher is not None)
        moments = [(at, max(0, sum(length <= at for length in milestones) - 1)) for at in steps]
        chosen, counts = chosen_of(complete.held_out, matcher)
        weight = PRIOR_WEIGHT[draft.kind]
        if matcher is None:
            judged = [self.judged(moment, moment[1], draft.stages[moment[1]], held_out, {}) for moment in moments]
            return complete.held_out, fuse(None, [*judged, complete], [complete], chosen, counts, weight)
        if self.extractor is None:
            moments = []
        kept = _KeptTouches.held_out(self, matcher, chosen, {*chosen, *counts})
        complete = replace(complete, matches=kept.matches)
        if not chosen or self.extractor is None:
            alone = self.judged((least, last), last, draft.views, held_out, {})
            return complete.held_out, fuse(
                matcher, [*kept.prefixes(moments), complete], [alone], chosen, counts, weight
            )
        # Every second touch is enough: early decisions use the moments alone, not the paces.
        paced = [kept.paced(pace, chosen[::2], last) for pace in PACES]
        return complete.held_out, fuse(matcher, [*kept.prefixes(moments), complete], paced, chosen, counts, weight)


@dataclass(frozen=True)
class _KeptTouches:
    """Kept touches, each judged as if it were new: by readouts and kept touches without it.

    chosen: the keys of the touches that are judged at all moments. levels, rows: by key, the levels (C, T) and the row
    among the kept. places: by key, in the sample. matches: of each with the other kept touches.
    """

    fit: _Fit
    matcher: TouchMatcher
    chosen: Sequence[bytes]
    rows: Mapping[bytes, int]
    levels: Mapping[bytes, LevelArray]
    places: Mapping[bytes, int]
    matches: Mapping[bytes, Match]

    @classmethod
    def held_out(cls, fit: _Fit, matcher: TouchMatcher, chosen: Sequence[bytes], keys: Iterable[bytes]) -> _KeptTouches:
        """The kept touches with some keys."""
        kept = matcher.kept.rows()
        rows = {key: kept[key] for key in sorted(keys)}
        levels = {key: matcher.kept.levels(row) for key, row in rows.items()}
        places = {key: place for place, (_, key, _) in enumerate(fit.draft.sample)}
        matches = {key: matcher.match(levels[key], held_out=row) for key, row in rows.items()}
        return cls(fit, matcher, chosen, rows, levels, places, matches)

    def prefixes(self, moments: Sequence[tuple[int, int]]) -> list[HeldOutMoment]:
        """Readouts and kept touches on their prefixes at each moment, given as its steps and stage."""
        held_out, judged = self._read(moments), []
        for number, (steps, stage) in enumerate(moments):
            matches = {}
            for key in self.chosen:
                if (levels := self.levels[key]).shape[1] >= steps:
                    # The noise is estimated once, on the whole touch: that is most of the cost of a match.
                    noise = self.matches[key].noise
                    matches[key] = self.matcher.match(levels[:, :steps], held_out=self.rows[key], noise=noise)
            scales = self.fit.draft.stages[stage]
            judged.append(self.fit.judged((steps, stage), number, scales, held_out, matches))
        return judged

    def _read(self, moments: Sequence[tuple[int, int]]) -> dict[Scale, HeldOutScores]:
        """The scores of their prefixes by each scale of windows, by the moment's number."""
        fit, draft, extractor = self.fit, self.fit.draft, self.fit.extractor
        queries: Queries = {scale: {} for scale in fit.readouts if scale not in draft.views}
        for key in self.chosen if moments else ():
            assert extractor is not None
            touch, cache = stream_of(self.levels[key], extractor.sensor), WindowCache()
            for number, (steps, stage) in enumerate(moments):
                if steps > len(touch):
                    break
                image = extractor.image(touch.first(steps / touch.sensor.rate))
                for scale, mean in extractor.means(image, draft.stages[stage], cache=cache).items():
                    queries[scale].setdefault(self.places[key], {})[number] = mean
        return {scale: fit.held_out_scores(scale, queries) for scale in queries}

    def paced(self, pace: float, keys: Sequence[bytes], last: int) -> HeldOutMoment:
        """Views and kept touches on some of the touches, resampled to be so many times as fast."""
        fit, views, extractor = self.fit, self.fit.draft.views, self.fit.extractor
        assert extractor is not None
        queries: Queries = {scale: {} for scale in views}
        matches = {}
        for key in keys:
            levels, noise = at_pace(self.levels[key], pace), self.matches[key].noise
            matches[key] = self.matcher.match(levels, held_out=self.rows[key], whole=True, noise=noise)
            image = extractor.image(stream_of(levels, extractor.sensor))
            for scale, mean in extractor.means(image, views).items():
                queries[scale][self.places[key]] = {0: mean}
        lengths = [self.levels[key].shape[1] / pace for key in keys]
        steps = max(1, round(float(np.median(lengths)))) if lengths else 1
        held_out = {scale: fit.held_out_scores(scale, queries) for scale in views}
        return fit.judged((steps, last), 0, views, held_out, matches)


def at_pace(levels: LevelArray, pace: float) -> LevelArray:
    """A touch resampled to be so many times as fast: (C, T) to (C, T / pace)."""
    steps = max(2, round(levels.shape[1] / pace))
    return at_places(levels, np.linspace(0, levels.shape[1] - 1, steps))
