"""How the answer to a touch grows while it is felt: of touches that are left out, moment after moment."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from scroll_tactile.embeddings.protocol import capabilities_of
from scroll_tactile.errors import EmbeddingError, MismatchError, StreamError, WeightsError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.model import Model
from scroll_tactile.prediction.recalling import judged
from scroll_tactile.prediction.unseen import UnseenTouch, rows_added
from scroll_tactile.readouts.likelihood import LEVELS, MISSING, LevelArray
from scroll_tactile.readouts.recollection import Kept
from scroll_tactile.results import Prediction
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream, fewest_readings, validate
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.sample import SampledTouch

__all__ = ["Decided", "Growing", "chosen", "growing", "stream_of", "sure"]

Decided = Callable[[Prediction, int], bool]
"""Whether a prediction after so many columns is safe to act on."""

SURE = 0.95
PARTS = (0.025, 0.05, 0.1, 0.15, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0)  # of a touch, after which it is asked about
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


def sure(prediction: Prediction, columns: int) -> bool:
    """Whether one material has 95 % of the probability, and the touch is not called unknown."""
    return prediction.known and prediction.probability >= SURE


def chosen(unseen: Sequence[UnseenTouch], keys: Iterable[bytes], camera: bool) -> list[UnseenTouch]:
    """A few touches to look at: the two hardest, and others from hard to easy, of different materials if there are."""
    known = set(keys)
    ranked = sorted(
        (touch for touch in unseen if touch.key in known),
        key=lambda touch: (touch.probability[touch.names.index(touch.material)], touch.key),
    )
    count, picked, materials = CAMERA_TOUCHES if camera else TOUCHES, list[UnseenTouch](), set[str]()
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
    touches: Sequence[UnseenTouch],
    streams: Mapping[bytes, Stream],
    decided: Decided = sure,
) -> tuple[list[Growing], str]:
    """The answers to some touches, each as if it had never been observed; and why there are no more, where some lack.

    model: just fitted to the learner's memory; what is left out comes back. Another is fitted where it has followed as
    much as it can. streams: the touches, by key.
    """
    extractor = FeatureExtractor(learner.sensor, learner.embedding, learner.plan, learner.augmentation)
    sampled = {(material, key): touch for material, key, touch in model.sample}
    found: list[Growing] = []
    for touch in touches:
        try:
            own = sampled[touch.material, touch.key]
            if not _has_room(model, own):
                model = learner.model()
            with _without(model, own, touch) as whole:
                if not whole:
                    return found, "the readouts could not be solved without the others"
                answers = list(_answers(learner, model, extractor, extractor.stream(streams[touch.key])))
        except (EmbeddingError, MismatchError, StreamError, WeightsError) as error:
            return found, str(error)
        when = next((i for i, (columns, at) in enumerate(answers) if decided(at, columns)), None)
        predictions = tuple(prediction for _, prediction in answers)
        found.append(Growing(touch.material, tuple(p.seconds for p in predictions), predictions, when))
    return found, ""


def _has_room(model: Model, sampled: SampledTouch) -> bool:
    """Whether the readouts can follow that a touch goes and comes back."""
    return all(2 * len(rows) <= model.readouts[scale].system.room for scale, rows in rows_added(model, sampled).items())


@contextmanager
def _without(model: Model, sampled: SampledTouch, touch: UnseenTouch) -> Iterator[bool]:
    """The model as if it had never observed a touch, but for how it is calibrated; whether it could be made so."""
    rows, recall = rows_added(model, sampled), model.pooled.recall if model.pooled else None
    held = recall is not None and (touch.material, touch.key) in recall.held
    kept = Kept(touch.material, touch.key, recall.levels(recall.rows()[touch.key])) if recall and held else None
    gone = []
    try:
        for scale, own in rows.items():
            gone.append(scale)
            if not model.readouts[scale].follow([(touch.material, own, -1)]):
                yield False
                return
        if recall is not None and kept is not None:
            recall.follow((), [(touch.material, touch.key)])
        yield True
    finally:
        for scale in gone:
            model.readouts[scale].follow([(touch.material, rows[scale], 1)])
        if recall is not None and kept is not None and (touch.material, touch.key) not in recall.held:
            recall.follow([kept])


def _answers(
    learner: TactileLearner, model: Model, extractor: FeatureExtractor, stream: Stream
) -> Iterator[tuple[int, Prediction]]:
    """Columns and prediction after each part of a touch."""
    sensor, fewest = learner.sensor, fewest_readings(learner.sensor)
    first = 1 if sensor.camera and capabilities_of(learner.embedding).rest is not None else 0  # the frame at rest
    parts = CAMERA_PARTS if sensor.camera else PARTS
    names = model.names
    for count in sorted({max(fewest, first + 1, round(part * len(stream))) for part in parts}):
        beginning = stream.first(count / sensor.rate)
        encoded = extractor.encode(beginning, model.longest, lambda columns: model.needed(names, columns))
        with one_thread():
            judgement = judged(model, extractor, names, encoded)
        order = np.argsort(-judgement.probability, kind="stable").tolist()
        ranking = tuple((names[i], float(judgement.probability[i])) for i in order)
        known = judgement.novelty <= judgement.calibration.threshold(learner.settings.false_alarms)
        yield encoded.columns, Prediction(*ranking[0], ranking, judgement.novelty, bool(known), beginning.seconds)


def stream_of(levels: LevelArray, sensor: Sensor) -> Stream:
    """The touch that kept levels stand for; what was missing is as the last reading before it."""
    low, high = sensor.limits
    lacking = levels == MISSING
    if lacking.any():
        last = np.maximum.accumulate(np.where(lacking, 0, np.arange(levels.shape[1])), axis=1)
        levels = np.where(lacking, np.take_along_axis(levels, last, axis=1), levels)
        levels = np.where(levels == MISSING, 0, levels)
    readings = low + (high - low) * (levels.T.astype(np.float32) / np.float32(LEVELS - 1))
    return validate(readings.clip(low, high), sensor)
