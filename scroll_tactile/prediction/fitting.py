"""Fitting a model to the present memory: its readouts are solved, then weighed by held-out touches.

Each sampled touch is scored by readouts without it, and some kept touches are matched with the others: once each,
complete and without noise. The calibrations, τ and the excess loss of known touches rest on these; those of prefixes on
the same neighbours. The model is a function of the set of touches.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.matching.kept_arrays import KeptTouch, at_places
from scroll_tactile.matching.likelihood import CLEAN
from scroll_tactile.matching.matcher import Match, TouchMatcher, independent
from scroll_tactile.memory.state import Memory
from scroll_tactile.persistence.ledger import give_back_scratch
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.model import WITHIN, HeldOut, Model, Paces, Row, Trajectories, Weighing
from scroll_tactile.readouts.calibration import AHEAD, calibrate_stage, dependence_of, fit_weights, softmax, tempered
from scroll_tactile.readouts.leave_one_out import StageScores, held_out_scores
from scroll_tactile.readouts.novelty import FEWEST
from scroll_tactile.readouts.readout import ReadoutName
from scroll_tactile.readouts.task import Task
from scroll_tactile.signals.levels import stream_of
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.sample import SampledTouch

__all__ = ["Draft", "paces_of", "rehearse"]

FloatArray = npt.NDArray[np.float64]

MOST_OF_RIDGE = 1024  # materials: it inverts a matrix of all of them
MOST_HELD_OUT = 96  # kept touches that are matched with the others: τ is a third too low by 32
SURER = 0.75  # the power was best on sixteen sets
ALONE_TOUCHES = 2.0  # how many touches the prior of τ counts as
UNMATCHED = 1 / 16_000  # τ where nothing can be held out: a larger one misclassifies prefixes, with one touch of each
PRIOR_OUTLIERS = 0.5  # of one more touch than the held-out ones
STEPS = 100  # of EM
PACES = 2.0, 0.5  # times a touch's own, at which it is judged as others made faster or slower
EVEN = 4.0  # times the energy of noise that those stay below: there the share of noise is a half
ROUNDING = 1 / 12  # squared levels: the noise of rounding to levels
POWER_TOUCHES = 2.0  # how many touches the prior of a power, 1, counts as
LEAST_SPREAD, LEAST_INFORMATION, LEAST_WEIGHT = 1e-9, 1e-3, 1e-9


@dataclass(frozen=True)
class Draft:
    """The input of a fit, copied from a memory at one moment, so that fitting needs no lock.

    bare: the model without readouts. tasks: of these. kept: the kept touches. before: an earlier model, which has
    arrays of most of them. least: the 5th percentile of the lengths of touches, in steps. counts: of the materials.
    """

    bare: Model
    tasks: dict[Scale, Task]
    sample: list[tuple[str, bytes, SampledTouch]]
    kept: list[KeptTouch]
    before: Model | None
    least: int
    counts: list[int]

    @classmethod
    def of(cls, memory: Memory, kind: ReadoutName, before: Model | None = None) -> Draft:
        """The draft of a memory as it is now. Raises InputError for the ridge of more materials than it can weigh."""
        statistics, sample, plan = memory.statistics, list(memory.sample), memory.plan
        names = list(statistics.materials)
        if kind == "ridge" and len(names) > MOST_OF_RIDGE:
            raise InputError(
                f'the readout "ridge" weighs {MOST_OF_RIDGE} materials at most; there are {len(names)}: take "lda"'
            )
        # The ridge's reference materials are all, as in the paper; LDA's are those with a sampled touch.
        reference = names if kind == "ridge" else sorted({material for material, *_ in sample})
        judging = [scale for scale in statistics.scales if statistics.second(scale).rows]
        tasks = {scale: Task.of(statistics, scale, reference, plan.shrinkage) for scale in judging}
        stages = [plan.judging(length) for length in plan.milestones()]
        views = [view for view in plan.views if view in tasks]
        bare = Model(kind, plan, names, stages, views, statistics.longest, HeldOut(kind, [], {}, []))
        least = max(1, min(statistics.fifth_percentile_length, statistics.longest))
        kept = memory.kept.touches() if memory.kept is not None and views else []
        return cls(bare, tasks, sample, kept, before, least, list(statistics.materials.values()))

    def fit(self) -> Model:
        """Solve the readouts and weigh them. Can be called once: it frees the tasks."""
        model = self.solved()
        with one_thread():
            if (weighing := _weighed(model, self.least, self.counts)) is not None:
                model = replace(model, weighing=weighing)
                if model.matcher is not None:
                    model = _by_kept_touches(model, model.matcher)
        if self.before is not None and self.before.held_out.trajectories is not None:
            rehearse(model)  # else a live session would wait for it
        give_back_scratch()
        return model

    def solved(self) -> Model:
        """A model without a weighing. Can be called once: it frees the tasks."""
        bare = self.bare
        with one_thread():
            # One after the other, each task freed: all at once would take twice the memory of a model.
            readouts = {scale: self.tasks.pop(scale).solve() for scale in sorted(self.tasks)}
            # What an earlier model made of kept touches is not made again.
            before = None if self.before is None else self.before.matcher
            matcher = TouchMatcher.of(self.kept, before) if self.kept else None
        give_back_scratch()
        held_out = HeldOut(bare.kind, self.sample, readouts, [[*stage, *bare.views] for stage in bare.stages])
        return replace(bare, readouts=readouts, held_out=held_out, matcher=matcher)


def _weighed(model: Model, least: int, counts: Sequence[int]) -> Weighing | None:
    """How the readouts are to be believed; None where no touch reached a stage. least, counts: see `Draft`."""
    reached = [scales for scales in model.stages if all(scale in model.readouts for scale in scales)]
    if not reached:
        return None
    last, milestones, held_out = len(reached) - 1, model.plan.milestones(), model.held_out
    # Touches to come are scored by means of one touch more than held-out ones are, and more surely.
    several = [count for count in counts if count > 1]
    surer = (1 - 1 / float(np.median(several))) ** -SURER if several else 1.0

    def row(stage: int, scales: Sequence[Scale], steps: int) -> tuple[Row, StageScores, FloatArray, FloatArray]:
        """How touches are judged by some scales at a stage, held-out ones, and what `Calibration.held_out` says."""
        found, readouts = held_out.at(stage, scales), [model.readouts[scale] for scale in scales]
        near = held_out.neighbours(stage, scales) if len(found.places) >= FEWEST else []
        calibration = calibrate_stage(found, readouts, model.kind, viewed=bool(model.views), neighbours=near)
        logs, distance = calibration.held_out(found, scales)
        own = np.exp(logs[np.arange(len(logs)), found.targets])
        rate = _outlier_rate(own, len(found.names)) if len(own) else 0.0
        calibration = replace(calibration, weights=surer * calibration.weights)
        return Row(steps, stage, tuple(scales), calibration, rate, rate), found, logs, distance

    rows = [row(stage, scales, milestones[stage])[0] for stage, scales in enumerate(reached)]
    complete, found, logs, distance = row(last, [*reached[last], *model.views], least)
    if len(distance):
        complete = replace(complete, distance_limit=float(np.quantile(distance, WITHIN)))
    return Weighing(
        rows=tuple(rows),
        complete=complete,
        paced=row(last, model.views, 1)[0] if model.views else complete,
        tau=UNMATCHED,
        dependence=dependence_of(found.keys, found.targets, logs, complete.calibration.thresholds.novelties),
        least=least,
        touches=sum(counts),
    )


def _outlier_rate(own: FloatArray, materials: int) -> float:
    """ε of least log loss (EM). own: the probabilities of the touches' own materials without ε."""
    rate = PRIOR_OUTLIERS / (len(own) + 1)
    for _ in range(STEPS):
        drawn = rate / materials
        rate = (float((drawn / ((1 - rate) * own + drawn)).sum()) + PRIOR_OUTLIERS) / (len(own) + 1)
    return rate


def _chosen(model: Model, matcher: TouchMatcher) -> dict[int, int]:
    """Row among the kept touches → place in the sample, of at most MOST_HELD_OUT held-out touches, evenly by key.

    Of a material of which none but itself is kept, a touch says nothing.
    """
    complete, labels = model.fitted.complete, matcher.kept.labels
    found = model.held_out.at(complete.stage, complete.scales)
    places, counts = dict(zip(found.keys, found.places, strict=True)), np.bincount(labels)
    keys = [(key, row) for key, row in sorted(matcher.kept.rows().items()) if key in places and counts[labels[row]] > 1]
    spread = np.linspace(0, len(keys) - 1, min(MOST_HELD_OUT, len(keys))).round().astype(int).tolist()
    return {keys[i][1]: places[keys[i][0]] for i in spread}


def _by_kept_touches(model: Model, matcher: TouchMatcher) -> Model:
    """The model with τ, and what is natural among kept touches, by some of them matched with the others."""
    kept, chosen, weighing = matcher.kept, _chosen(model, matcher), model.fitted
    if len(chosen) < FEWEST or len(kept.materials) < 2:
        return model
    early, matches = [row.steps for row in weighing.early], list[Match]()
    losses = np.full((len(chosen), len(early)), np.nan)
    for loss, row in zip(losses, chosen, strict=True):
        beside = matcher.beside(matcher.query(kept.levels[row], held_out=row), CLEAN)
        reached = [steps for steps in early if steps < beside.query.columns]
        loss[: len(reached)] = beside.excess_at(reached)
        matches.append(matcher.result(beside))
    whole = np.array([match.excess_loss for match in matches])

    def weighed(row: Row, loss: FloatArray) -> Row:
        loss = loss[np.isfinite(loss)]
        row = replace(row, outliers=max(row.readout_outliers, PRIOR_OUTLIERS / (len(chosen) + 1)))
        if len(loss) < FEWEST:
            return row
        return replace(row, excess=(float(loss.mean()), max(float(loss.std()), LEAST_SPREAD)))

    rows = [weighed(row, losses[:, i] if i < len(early) else whole) for i, row in enumerate(weighing.rows)]
    fitted = replace(
        weighing,
        rows=tuple(rows),
        complete=weighed(weighing.complete, whole),
        paced=weighed(weighing.paced, whole),
        tau=_tau(matches, kept.labels[list(chosen)].tolist()),
    )
    return replace(model, weighing=fitted, matcher=_natural(matcher, matches))


def _tau(matches: Sequence[Match], targets: Sequence[int]) -> float:
    """τ: the weight at which kept touches by themselves have least log loss, at an information of 1.

    It is drawn to the weight at which the best material leads the next by AHEAD logits, in the median.
    """
    information = np.maximum([match.information for match in matches], LEAST_INFORMATION)
    median = float(np.median(information))
    scores = np.stack([match.scores for match in matches]) * (median / information)[:, None]
    best = np.sort(scores, axis=1)[:, -2:]
    prior = AHEAD / max(float(np.median(best[:, 1] - best[:, 0])), AHEAD)
    weight = float(fit_weights(scores[:, None], targets, np.array([prior]), ALONE_TOUCHES)[0])
    return 1 / (1 + max(1 / max(weight, LEAST_WEIGHT) - 1, 0.0) / median)


def _natural(matcher: TouchMatcher, matches: Sequence[Match]) -> TouchMatcher:
    """The matcher with what is natural among its touches: how they deviate from the nearest others."""
    energies = np.array([match.energy for match in matches])
    coherence = float(np.median([match.coherence for match in matches]))
    noise = [independent(match.energy, match.coherence, coherence) for match in matches]
    even = EVEN * float(np.quantile(noise, WITHIN))
    return matcher.measured(coherence, max(even, ROUNDING), max(float(np.quantile(energies, WITHIN)), ROUNDING))


def rehearse(model: Model) -> Model:
    """The model, which knows then how held-out touches are answered at each row's length before they were complete.

    Prefixes are matched with those of the other kept touches; where none are kept the readouts answer alone.
    """
    weighing, held_out, matcher = model.weighing, model.held_out, model.matcher
    if weighing is None or held_out.trajectories is not None:
        return model
    chosen = None if matcher is None else {place: row for row, place in _chosen(model, matcher).items()}
    names = held_out.at(0, weighing.rows[0].scales).names
    shape = len(held_out.sample), len(weighing.early)
    chances, novelty = np.full((*shape, len(names)), np.nan), np.full(shape, np.nan)
    targets = np.zeros(shape[0], np.intp)
    with one_thread():
        for stage, row in enumerate(weighing.early):
            found, logs, _, novelties = held_out.by(row)
            for i, place in enumerate(found.places if found.names == names else ()):
                own = np.exp(logs[i])
                if matcher is None or chosen is None:
                    answered = tempered(own, row.readout_outliers)
                elif place in chosen:
                    kept = chosen[place]
                    match = matcher.match(matcher.kept.levels[kept][:, : row.steps], held_out=kept, noise=CLEAN)
                    logits = weighing.logits("prefix", own, match, matcher.scores_of(names, match), 0.0)
                    answered = tempered(softmax(logits), row.outliers)
                else:
                    continue
                chances[place, stage], novelty[place, stage] = answered, novelties[i]
                targets[place] = found.targets[i]
    reached = np.isfinite(novelty).any(axis=1)
    held_out.trajectories = Trajectories(chances[reached], novelty[reached], targets[reached])
    return model


def paces_of(model: Model, extractor: FeatureExtractor) -> Paces | None:
    """How known touches look at twice and half their pace; None where too few can be held out.

    Half of the kept touches that a fit matches are resampled, and judged by the views and the kept touches without
    them. The first touch of another length has it measured, and later ones find it in the weighing.
    """
    weighing, matcher = model.fitted, model.matcher
    if weighing.paces is None and matcher is not None:
        chosen = dict(list(_chosen(model, matcher).items())[::2])
        if len(chosen) >= FEWEST:
            with one_thread():
                weighing.paces = _measured_paces(model, extractor, matcher, chosen)
    return weighing.paces


def _measured_paces(
    model: Model, extractor: FeatureExtractor, matcher: TouchMatcher, chosen: Mapping[int, int]
) -> Paces:
    """As `paces_of`. chosen: row among the kept touches → place in the sample."""
    weighing, row, held_out = model.fitted, model.fitted.paced, model.held_out
    queries: dict[Scale, dict[int, dict[int, FloatArray]]] = {view: {} for view in model.views}
    matches: dict[tuple[int, int], Match] = {}
    for kept, place in chosen.items():
        levels = matcher.kept.levels[kept]
        for number, pace in enumerate(PACES):
            columns = max(2, round(levels.shape[1] / pace))
            other = at_places(levels, np.linspace(0, levels.shape[1] - 1, columns))
            matches[number, place] = matcher.match(other, whole=True, held_out=kept, noise=CLEAN)
            image = extractor.image(stream_of(other, extractor.sensor))
            for view, mean in extractor.means(image, model.views).items():
                queries[view].setdefault(place, {})[number] = mean
    scores = [
        held_out_scores(held_out.readouts[view], held_out.sample, held_out.stages, model.kind, queries[view])
        for view in model.views
    ]
    others, logits, targets = [], list[FloatArray](), list[int]()
    for number in range(len(PACES)):
        found = StageScores(number, held_out.sample, scores)
        log_chances, distances = row.calibration.held_out(found, model.views)
        own = [matches[number, place] for place in found.places]
        values = np.column_stack([found.distances().min(axis=2), [match.excess_loss for match in own]])
        mean, spread = values.mean(axis=0), np.maximum(values.std(axis=0), LEAST_SPREAD)
        spread *= max(float(((values - mean) / spread).mean(axis=1).std()), LEAST_SPREAD)
        novelties = np.sort(((values - mean) / spread).mean(axis=1))
        # As many of these lie above the threshold as of touches in their own time.
        rank = min(len(novelties) - 1, math.ceil(WITHIN * (len(novelties) + 1)) - 1)
        high = float(novelties[rank]) / max(row.calibration.thresholds.above("", 1 - WITHIN), LEAST_SPREAD)
        others.append(np.stack([mean, spread * max(1.0, high)], axis=1))
        for match, chances, distance in zip(own, np.exp(log_chances), distances.tolist(), strict=True):
            scored = matcher.scores_of(found.names, match)
            logits.append(weighing.logits("paced", chances, match, scored, distance))
        targets += found.targets.tolist()
    natural = np.vstack([row.calibration.scale_novelty, row.excess])
    power = fit_weights(np.stack(logits)[:, None], targets, np.ones(1), POWER_TOUCHES)
    return Paces(natural, np.stack(others), float(power[0]))
