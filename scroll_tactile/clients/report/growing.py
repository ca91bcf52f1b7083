"""How the answers to held-out touches change while they are felt, and when they are decided."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from scroll_tactile.embeddings.protocol import capabilities_of
from scroll_tactile.learner import TactileLearner
from scroll_tactile.live.decision import DecisionRule
from scroll_tactile.matching.match import KeptTouch
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.judging import HeldOutTouch, answer
from scroll_tactile.prediction.model import Model
from scroll_tactile.readouts.calibration import FEWEST
from scroll_tactile.readouts.leave_one_out import rows_at
from scroll_tactile.results import Prediction
from scroll_tactile.signals.stream import Stream, fewest_readings
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.sample import SampledTouch

__all__ = ["Growing", "Soon", "chosen", "growing", "soon"]

PARTS = (
    0.025,
    0.05,
    0.1,
    0.15,
    0.2,
    0.3,
    0.45,
    0.6,
    0.8,
    1.0,
)  # of a touch, where a rule has no moments before its end
CAMERA_PARTS = (0.2, 0.4, 0.7, 1.0)
TOUCHES, CAMERA_TOUCHES = 6, 3


@dataclass(frozen=True)
class Growing:
    """The answers to one touch.

    seconds: of touch at each moment. predictions: then. decided: by which of them; None if by none.
    """

    material: str
    seconds: tuple[float, ...]
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
    if model.fusion is None or len(model.fusion.trajectories.targets) < FEWEST:
        return None
    held_out, moments, rate = model.fusion.trajectories, model.fusion.moments[:-1], extractor.sensor.rate
    done, wrong = np.zeros(len(held_out.targets), bool), np.zeros(len(held_out.targets), bool)
    right, decided, mistaken = [], [], []
    for i, moment in enumerate(moments):
        threshold = moment.threshold(false_alarms)
        chances, novelty = held_out.chances[:, i], held_out.novelty[:, i]
        reached = np.isfinite(novelty)
        best = np.where(reached, np.nan_to_num(chances).argmax(axis=1), -1)
        for touch in np.flatnonzero(reached & ~done).tolist():
            name, chance = str(best[touch]), float(chances[touch].max())
            known = bool(novelty[touch] <= threshold)
            prediction = Prediction(name, chance, ((name, chance),), float(novelty[touch]), known, moment.steps / rate)
            if rule.decided(prediction, moment.steps):
                done[touch], wrong[touch] = True, not known or best[touch] != held_out.targets[touch]
        right.append(float((best == held_out.targets)[reached].mean()) if reached.any() else 0.0)
        decided.append(float(done.mean()))
        mistaken.append(float(wrong.mean()))
    seconds = tuple(moment.steps / rate for moment in moments)
    return Soon(seconds, tuple(right), tuple(decided), tuple(mistaken), len(held_out.targets))


def chosen(held_out: Sequence[HeldOutTouch], keys: Iterable[bytes], camera: bool) -> list[HeldOutTouch]:
    """A few touches to look at: the two hardest, and others from hard to easy, of different materials if there are."""
    known = set(keys)
    ranked = sorted(
        (touch for touch in held_out if touch.key in known),
        key=lambda touch: (touch.probability[touch.names.index(touch.material)], touch.key),
    )
    count, picked, materials = CAMERA_TOUCHES if camera else TOUCHES, list[HeldOutTouch](), set[str]()
    wanted = [0, 1, *(round(i) for i in np.linspace(0.1, 0.95, count - 2) * (len(ranked) - 1))] if ranked else []
    for place in wanted[:count]:
        rest = [touch for touch in ranked[place:] if touch not in picked]
        if rest:
            fresh = next((touch for touch in rest if touch.material not in materials), rest[0])
            picked.append(fresh)
            materials.add(fresh.material)
    return picked


def growing(
    learner: TactileLearner,
    model: Model,
    extractor: FeatureExtractor,
    rule: DecisionRule,
    touches: Sequence[HeldOutTouch],
    streams: Mapping[bytes, Stream],
) -> list[Growing]:
    """The answers to some touches, each as if it had never been observed. streams: the touches, by key.

    Raises EmbeddingMismatchError where only its user can make the memory's embedding, and what that raises.
    """
    found = []
    for touch in touches:
        stream = extractor.stream(streams[touch.key])
        with _without(model, touch) as other:
            answers = list(_answers(learner, other, extractor, rule, stream))
        decided = next((i for i, (steps, at) in enumerate(answers) if rule.decided(at, steps)), None)
        predictions = tuple(prediction for _, prediction in answers)
        found.append(Growing(touch.material, tuple(at.seconds for at in predictions), predictions, decided))
    return found


@contextmanager
def _without(model: Model, touch: HeldOutTouch) -> Iterator[Model]:
    """The model as if it had never observed a touch, nor kept it, but for how it is calibrated."""
    sampled = next(item for material, key, item in model.sample if (material, key) == (touch.material, touch.key))
    with one_thread():
        other = _left_by(model, touch.material, sampled)
    matcher = model.matcher
    if matcher is None or (touch.material, touch.key) not in matcher.kept.held:
        yield other
        return
    kept = KeptTouch(touch.material, touch.key, matcher.kept.levels(matcher.kept.rows()[touch.key]))
    matcher.kept.follow((), [(touch.material, touch.key)])
    try:
        yield other
    finally:
        matcher.kept.follow([kept])


def _left_by(model: Model, material: str, sampled: SampledTouch) -> Model:
    """The model of which the readouts never observed a sampled touch; its material has others."""
    stages = [[*stage, *model.views] for stage in model.stages]
    readouts = dict(model.readouts)
    for scale, readout in model.readouts.items():
        if own := rows_at(sampled, stages, scale):
            # As many rows as it added: of windows that are learned one by one the sample has the mean.
            times = max(1, round(sampled.pairs[own[0], 2] / len(own)))
            readouts[scale] = readout.without(material, np.repeat(sampled.rows[own], times, axis=0))
    return replace(model, readouts=readouts)


def _answers(
    learner: TactileLearner, model: Model, extractor: FeatureExtractor, rule: DecisionRule, stream: Stream
) -> Iterator[tuple[int, Prediction]]:
    """Steps and prediction at the rule's moments, or at some parts of the touch, and at its end."""
    sensor, names = learner.sensor, model.names
    first = 1 if sensor.camera and capabilities_of(learner.embedding).rest is not None else 0  # the frame at rest
    parts = CAMERA_PARTS if sensor.camera else PARTS
    counts = {round(part * len(stream)) for part in parts} if len(rule.moments) < 2 else {*rule.moments, len(stream)}
    for count in sorted({min(max(fewest_readings(sensor), first + 1, count), len(stream)) for count in counts}):
        prefix = stream.first(count / sensor.rate)
        encoded = extractor.encode(prefix, model.longest, lambda steps: model.scales_for(names, steps))
        prediction = answer(model, extractor, names, [(encoded, None)], learner.settings.false_alarms)
        yield encoded.steps, prediction
