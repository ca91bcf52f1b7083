"""What a memory's page rests on: how alike its materials are, and how it judges touches that it never observed."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Container, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.clients.report.drawing import Bin, as_counted
from scroll_tactile.clients.report.page import note
from scroll_tactile.embeddings.protocol import capabilities_of
from scroll_tactile.errors import (
    CapacityError,
    EmbeddingError,
    MismatchError,
    ScrollTactileError,
    StreamError,
    WeightsError,
)
from scroll_tactile.learner import TactileLearner
from scroll_tactile.live.decision import DecisionRule, decision_rule
from scroll_tactile.matching.kept_arrays import KeptTouch
from scroll_tactile.memory.exemplars import Exemplar
from scroll_tactile.memory.state import Memory
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.fitting import rehearse
from scroll_tactile.prediction.judging import HeldOutTouch, answer, held_out_touches, prediction_of
from scroll_tactile.prediction.model import Model
from scroll_tactile.readouts.leave_one_out import rows_at
from scroll_tactile.readouts.novelty import FEWEST
from scroll_tactile.readouts.task import Task
from scroll_tactile.results import Observation, Prediction
from scroll_tactile.signals.levels import stream_of
from scroll_tactile.signals.stream import Stream, fewest_readings, validate
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["MOST_NEAR", "Growing", "MemoryFacts", "bins_of", "mistakes", "unknown_by"]

FloatArray = npt.NDArray[np.float64]

Streams = Sequence[tuple[HeldOutTouch, Stream]]

MOST_NEAR = 1024  # materials: the separation of each two of more takes minutes
PRIOR = 0.1  # of a readout's scores, where the calibration is that of another kind
BINS = 10


def separations(statistics: Statistics, model: Model) -> tuple[list[str], FloatArray]:
    """The separation of materials: names, and the log-odds that a typical touch of one has over another, (C, C).

    Half the squared Mahalanobis distance of their means, of each scale that judges whole touches, as far as the
    calibration believes it. Materials that were never touched long enough are left out. None are there before a
    calibration is.
    """
    if model.weighing is None:
        return [], np.zeros((0, 0))
    complete = model.weighing.complete
    scales = complete.scales
    lda = model.kind == "lda"
    weights = complete.calibration.weights if lda else np.full(len(scales), PRIOR / len(scales))
    names = [name for name in model.names if all(name in model.readouts[scale].places for scale in scales)]
    total = np.zeros((len(names), len(names)))
    with one_thread():
        for scale, weight in zip(scales, weights.tolist(), strict=True):
            readout = model.readouts[scale]
            means = statistics.sums(scale, names) / statistics.counts(scale, names)[:, None] - readout.origin
            products = means @ readout.linear(names, "lda")[0]
            sizes = np.diagonal(products)
            total += weight * np.maximum(sizes[:, None] + sizes - (products + products.T), 0.0) / 2
    np.fill_diagonal(total, 0.0)
    return names, total


@dataclass(frozen=True)
class Mistake:
    """Left-out touches of one material that were called another: how many, of how many, and their mean probability."""

    material: str
    answer: str
    count: int
    tested: int
    confidence: float


def mistakes(held_out: Sequence[HeldOutTouch]) -> list[Mistake]:
    """All confusions, the most frequent first."""
    tested = Counter(touch.material for touch in held_out)
    wrong: dict[tuple[str, str], list[float]] = {}
    for touch in held_out:
        if touch.said.material != touch.material:
            wrong.setdefault((touch.material, str(touch.said.material)), []).append(touch.said.probability)
    found = [Mistake(*pair, len(sure), tested[pair[0]], float(np.mean(sure))) for pair, sure in wrong.items()]
    return sorted(found, key=lambda m: (-m.count, -m.count / m.tested, m.material, m.answer))


def interval(right: int, count: int) -> tuple[float, float]:
    """The 95 % interval of a share of one touch or more (Wilson 1927)."""
    z, share = 1.96, right / count
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return max(0.0, middle - half), min(1.0, middle + half)


@dataclass(frozen=True)
class Trust:
    """How right and how well calibrated answers to left-out touches are.

    count: of touches. right: share, between low and high with 95 %. confidence: the mean probability that was given.
    error: the expected calibration error, of equal steps of probability. chance: what that would be on average of
    answers that are right as often as they say. unknown: share called unknown.
    """

    count: int
    right: float
    low: float
    high: float
    confidence: float
    error: float
    chance: float
    unknown: float

    @property
    def miscalibrated(self) -> bool:
        """Whether the error is more than chance and matters."""
        return self.error > max(0.05, 2 * self.chance)


def trust_in(held_out: Sequence[HeldOutTouch]) -> Trust:
    """How far answers can be believed, by one or more touches left out."""
    confidence, right = _answered(held_out)
    draws = np.random.default_rng(0).random((200, len(held_out))) < confidence
    return Trust(
        len(held_out),
        float(right.mean()),
        *interval(int(right.sum()), len(held_out)),
        confidence=float(confidence.mean()),
        error=_error(confidence, right),
        chance=float(np.mean([_error(confidence, drawn) for drawn in draws])),
        unknown=float(np.mean([touch.said.known is False for touch in held_out])),
    )


def _answered(held_out: Sequence[HeldOutTouch]) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """How sure each answer was, and whether it was right."""
    sure = np.array([touch.said.probability for touch in held_out])
    return sure, np.array([touch.said.material == touch.material for touch in held_out])


def _places(confidence: FloatArray) -> npt.NDArray[np.intp]:
    return np.clip(np.ceil(confidence * BINS).astype(np.intp) - 1, 0, BINS - 1)


def _error(confidence: FloatArray, right: npt.NDArray[np.bool_]) -> float:
    """Expected calibration error: Σ_b (n_b / N) · |right_b − confidence_b|."""
    gaps = np.bincount(_places(confidence), right - confidence, BINS)
    return float(np.abs(gaps).sum() / len(confidence))


def bins_of(held_out: Sequence[HeldOutTouch]) -> list[Bin]:
    """Answers by their probability, in equal steps of it."""
    confidence, right = _answered(held_out)
    places, found = _places(confidence), []
    for place in np.unique(places):
        own = places == place
        count, hits = int(own.sum()), int(right[own].sum())
        found.append(Bin(count, float(confidence[own].mean()), hits / count, *interval(hits, count)))
    return found


def unknown_by(held_out: Sequence[HeldOutTouch]) -> list[tuple[str, int, int]]:
    """Material, its left-out touches that were called unknown, and all of them; the largest share first."""
    unknown = Counter(touch.material for touch in held_out if touch.said.known is False)
    tested = Counter(touch.material for touch in held_out)
    found = [(name, unknown[name], count) for name, count in tested.items()]
    return sorted(found, key=lambda row: (-row[1] / row[2], row[0]))


# Parts of a touch, where a rule has no moments before its end.
PARTS = (0.025, 0.05, 0.1, 0.15, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0)
CAMERA_PARTS = (0.2, 0.4, 0.7, 1.0)
TOUCHES, CAMERA_TOUCHES = 6, 3
CANNOT_EMBED = EmbeddingError, MismatchError, StreamError, WeightsError


class Growing(NamedTuple):
    """The answers to one touch, one after the other. decided: by which of them; None if by none."""

    material: str
    predictions: tuple[Prediction, ...]
    decided: int | None


@dataclass(frozen=True)
class Soon:
    """How soon held-out touches are decided, and how many of the decisions are wrong.

    seconds: of touch, at each moment. right: the share of touches of that length whose likeliest material is the true
    one. decided, wrong: the share of all touches that are decided by then, and that are decided wrongly. count: the
    touches.
    """

    seconds: tuple[float, ...]
    right: tuple[float, ...]
    decided: tuple[float, ...]
    wrong: tuple[float, ...]
    count: int

    @property
    def median(self) -> float | None:
        """The first of these moments at which half of the touches are decided."""
        return next((at for at, share in zip(self.seconds, self.decided, strict=True) if share >= 0.5), None)


def soon(model: Model, extractor: FeatureExtractor, rule: DecisionRule, false_alarms: float) -> Soon | None:
    """How soon answers come, by prefixes of held-out touches; None where too few touches were held out."""
    held_out = model.held_out.trajectories
    if model.weighing is None or held_out is None or len(held_out.targets) < FEWEST:
        return None
    rows, rate = model.weighing.early, extractor.sensor.rate
    done, wrong = np.zeros((2, len(held_out.targets)), bool)
    right, decided, mistaken = [], [], []
    places = [str(place) for place in range(held_out.chances.shape[2])]
    for i, row in enumerate(rows):
        chances, novelty = held_out.chances[:, i], held_out.novelty[:, i]
        reached = np.isfinite(novelty)
        best = np.where(reached, np.nan_to_num(chances).argmax(axis=1), -1)
        for touch in np.flatnonzero(reached & ~done).tolist():
            own = chances[touch], float(novelty[touch]), [row.calibration.thresholds]
            prediction = prediction_of(places, *own, false_alarms)
            if rule.decided(prediction, row.steps):
                done[touch], wrong[touch] = True, not prediction.known or best[touch] != held_out.targets[touch]
        right.append(float((best == held_out.targets)[reached].mean()) if reached.any() else 0.0)
        decided.append(float(done.mean()))
        mistaken.append(float(wrong.mean()))
    return Soon(
        seconds=tuple(row.steps / rate for row in rows),
        right=tuple(right),
        decided=tuple(decided),
        wrong=tuple(mistaken),
        count=len(held_out.targets),
    )


def chosen(held_out: Sequence[HeldOutTouch], keys: Container[bytes], camera: bool) -> list[HeldOutTouch]:
    """A few touches to look at: the two hardest, and others from hard to easy, of different materials if there are."""
    ranked = sorted(
        (touch for touch in held_out if touch.key in keys),
        key=lambda touch: (dict(touch.said.ranking)[touch.material], touch.key),
    )
    count, picked = CAMERA_TOUCHES if camera else TOUCHES, list[HeldOutTouch]()
    for place in [0, 1, *np.rint(np.linspace(0.1, 0.95, count - 2) * (len(ranked) - 1)).astype(int).tolist()]:
        if rest := [touch for touch in ranked[place:] if touch not in picked]:
            materials = {touch.material for touch in picked}
            picked.append(next((touch for touch in rest if touch.material not in materials), rest[0]))
    return picked


def growing(
    model: Model, memory: Memory, extractor: FeatureExtractor, rule: DecisionRule, false_alarms: float, touches: Streams
) -> list[Growing]:
    """The answers to some touches, each as if it had never been observed, at the rule's moments or at parts of it.

    Raises EmbeddingMismatchError where only its user can make the memory's embedding, and what that raises.
    """
    sensor, names, found = extractor.sensor, model.names, list[Growing]()
    first = 1 if sensor.camera and capabilities_of(extractor.embedding).rest is not None else 0  # the frame at rest
    for touch, readings in touches:
        stream, predictions, decided = extractor.stream(readings), list[Prediction](), None
        parts = [round(part * len(stream)) for part in (CAMERA_PARTS if sensor.camera else PARTS)]
        moments = [*(rule.moments if len(rule.moments) > 1 else parts), len(stream)]
        least = max(fewest_readings(sensor), first + 1)
        other = _without(model, memory, touch)
        for count in sorted({min(max(least, moment), len(stream)) for moment in moments}):
            prefix = stream.first(count / sensor.rate)
            encoded = extractor.encode(prefix, other.longest, lambda steps: model.scales_for(names, steps))
            predictions.append(answer(other, extractor, names, [encoded], false_alarms))
            if decided is None and rule.decided(predictions[-1], encoded.steps):
                decided = len(predictions) - 1
        found.append(Growing(touch.material, tuple(predictions), decided))
    return found


def _without(model: Model, memory: Memory, touch: HeldOutTouch) -> Model:
    """The model as if it had never observed a touch, nor kept it, but for how it is weighed."""
    sampled = next(each[2] for each in model.held_out.sample if each[:2] == touch[:2])
    statistics, codes = deepcopy(memory.statistics), {}
    for scale in model.readouts:
        if rows := rows_at(sampled, model.held_out.stages, scale):
            # As many rows as it added: of windows that are learned one by one the sample has the mean.
            times = max(1, round(sampled.pairs[rows[0], 2] / len(rows)))
            codes[scale] = np.repeat(sampled.rows[rows], times, axis=0)
    statistics.remove(touch.material, codes, statistics.longest)  # of some length: readouts do not depend on lengths
    readouts, matcher = dict(model.readouts), model.matcher
    for scale in codes:
        readouts[scale] = Task.of(statistics, scale, readouts[scale].reference, model.plan.shrinkage).solve()
    if matcher is not None and memory.kept is not None:
        kept = [each for each in memory.kept.touches() if (each.material, each.key) != touch[:2]]
        matcher = matcher.followed(kept) if kept else None
    return replace(model, readouts=readouts, matcher=matcher)


@dataclass
class MemoryFacts:
    """What a memory knows.

    risk: the share of wrong answers among those decided. of: an axis, whose labels it then knows in place of materials.
    missing: what the page lacks and why, filled as it is made.
    """

    learner: TactileLearner
    risk: float
    of: str | None = None
    missing: list[str] = field(default_factory=list)

    def lacks(self, what: str, why: str) -> str:
        """Note that something is missing, and say so in its place."""
        self.missing.append(f"{what}: {why}")
        return note(f"Not shown: {why}")

    @cached_property
    def memory(self) -> Memory:
        """What was learned, by materials or by labels."""
        return self.learner.memory if self.of is None else self.learner.memory.of_axis(self.of)

    def __post_init__(self) -> None:
        self.names = "materials" if self.of is None else f"labels on {self.of}"

    @cached_property
    def counts(self) -> dict[str, int]:
        """Material → touches, in the order of names."""
        return dict(sorted(self.memory.statistics.materials.items(), key=lambda pair: as_counted(pair[0])))

    @cached_property
    def journal(self) -> list[Observation]:
        """All observations in order."""
        return self.learner.observations()

    @cached_property
    def model(self) -> Model | None:
        """The model fitted to the memory as it is; None of an empty memory, and where none can be fitted."""
        try:
            if not self.counts:
                return None
            return rehearse(self.learner._by(self.of).fitted())
        except CapacityError:
            raise
        except ScrollTactileError as error:  # sums that came from elsewhere have no readout, and the ridge has a limit
            self.missing.append(f"Nothing could be fitted: {error}")
            return None

    @cached_property
    def held_out(self) -> list[HeldOutTouch]:
        """The answers to held-out touches."""
        return [] if self.model is None else held_out_touches(self.model, self.learner.settings.false_alarms)

    @cached_property
    def trust(self) -> Trust | None:
        """How far answers can be believed; None where nothing could be left out."""
        return trust_in(self.held_out) if self.held_out else None

    @cached_property
    def near(self) -> tuple[list[str], npt.NDArray[np.float64]]:
        """Materials and their separations; none where there are too few, or too many."""
        if self.model is None or not 1 < len(self.counts) <= MOST_NEAR:
            return [], np.zeros((0, 0))
        return separations(self.memory.statistics, self.model)

    @cached_property
    def kept(self) -> list[KeptTouch]:
        """The kept touches, in the order of observation where that is known."""
        touches = self.memory.kept.touches() if self.memory.kept is not None else []
        place = {row.key: row.sequence for row in self.journal}
        return sorted(touches, key=lambda touch: (place.get(touch.key, 0), touch.material, touch.key))

    @cached_property
    def exemplars(self) -> dict[str, list[Exemplar]]:
        """Material → its exemplars with readings."""
        return self.learner.ranked_exemplars()

    @cached_property
    def extractor(self) -> FeatureExtractor:
        """What makes features of touches."""
        return FeatureExtractor(self.learner.sensor, self.learner.embedding, self.learner.plan)

    @cached_property
    def rule(self) -> DecisionRule | None:
        """When an answer is safe to act on; None where nothing can be left out, or embedded."""
        if self.model is None or not self.held_out:
            return None
        return decision_rule(self.model, self.risk)

    @cached_property
    def soon(self) -> Soon | None:
        """How soon answers come; None where that was not measured."""
        if self.model is None or self.rule is None:
            return None
        return soon(self.model, self.extractor, self.rule, self.learner.settings.false_alarms)

    @cached_property
    def growing(self) -> tuple[list[Growing], str]:
        """How answers to a few left-out touches grow, or why there are none."""
        if self.model is None or not self.held_out:
            return [], self.nothing_left_out
        if self.rule is None:
            return [], self.nothing_left_out
        sensor, kept = self.learner.sensor, {touch.key: touch for touch in self.kept}
        held = {} if kept else {exemplar.key: exemplar for own in self.exemplars.values() for exemplar in own}
        streams = [
            (own, stream_of(kept[own.key].levels, sensor) if kept else validate(held[own.key].readings, sensor))
            for own in chosen(self.held_out, kept or held, sensor.camera)
        ]
        if not streams:
            return [], "of no touch that could be left out the readings are kept."
        try:
            return growing(
                self.model, self.memory, self.extractor, self.rule, self.learner.settings.false_alarms, streams
            ), ""
        except CANNOT_EMBED as error:
            return [], str(error)

    @property
    def nothing_left_out(self) -> str:
        """Why no touch could be left out."""
        if not self.counts:
            return "no touch was observed yet."
        if len(self.counts) == 1:
            return f"there is one of the {self.names}, with nothing to be mixed up with; teach a second one."
        return f"nothing can be left out: that takes two {self.names} with two touches or more of each."
