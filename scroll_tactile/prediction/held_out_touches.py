"""Answers of a model to the sampled touches, each held out, as complete touches in their own time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.prediction.judging import fused
from scroll_tactile.prediction.model import Judgement, Model
from scroll_tactile.prediction.moments import tempered
from scroll_tactile.readouts.calibration import held_out_probabilities
from scroll_tactile.readouts.leave_one_out import StageScores

__all__ = ["HeldOutTouch", "held_out_touches"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class HeldOutTouch:
    """The answer to a touch by all others.

    material, key: its own. names: the materials it was weighed among, in alphabetical order. probability: of each,
    shape (C,). novelty: see `Prediction`. threshold: a novelty above it is called unknown.
    """

    material: str
    key: bytes
    names: tuple[str, ...]
    probability: FloatArray
    novelty: float
    threshold: float

    @property
    def answer(self) -> str:
        """The likeliest material."""
        return self.names[int(self.probability.argmax())]

    @property
    def confidence(self) -> float:
        """Its probability."""
        return float(self.probability.max())

    @property
    def known(self) -> bool:
        """Whether it is not called unknown."""
        return self.novelty <= self.threshold


def held_out_touches(model: Model, false_alarms: float) -> list[HeldOutTouch]:
    """Answers of a model, just fitted, to the sampled touches, each held out of readouts and kept touches.

    They are weighed among the materials that have a sampled touch. A touch that is its material's only one is omitted.
    The calibration was fitted to all of them, each one included; no other pace is tried, no dead channel filled in.
    false_alarms: as in `Settings`.
    """
    return list(_held_out_touches(model, false_alarms))


def _held_out_touches(model: Model, false_alarms: float) -> Iterator[HeldOutTouch]:
    fusion, judged = model.fusion, set[int]()
    if fusion is None:
        return
    matcher = fusion.matcher
    rows = {} if matcher is None else matcher.kept.rows()
    for stage in range(len(model.calibrations) - 1, -1, -1):
        calibration = model.calibration("complete", fusion.complete, stage)
        scales, moment = model.scales("complete", stage), fusion.latest(stage)
        found = StageScores(stage, model.sample, [model.held_out[scale] for scale in scales])
        held = held_out_probabilities(found, scales, calibration)
        for i, place in enumerate(held.places):
            if place in judged:
                continue
            judged.add(place)
            material, key, _ = model.sample[place]
            chances = np.exp(held.logs[i])
            alone = Judgement(chances, float(held.novelty[i]), moment, float(held.distance[i]))
            if matcher is not None and key in rows and not moment.suffices(float(chances.max()), alone.distance):
                match = matcher.match(matcher.kept.levels(rows[key]), held_out=rows[key])
                result = fused(matcher, held.names, alone, match, own_time=True)
            else:
                result = replace(alone, probability=tempered(chances, moment.model_outlier_rate))
            threshold = moment.threshold(false_alarms)
            yield HeldOutTouch(material, key, tuple(held.names), result.probability, result.novelty, threshold)
