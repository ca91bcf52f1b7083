"""What a model says of touches that it never observed: of the sampled ones, each left out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.prediction.judging import fused
from scroll_tactile.prediction.model import Judgement, Model
from scroll_tactile.prediction.moments import tempered
from scroll_tactile.readouts.held_out import held_out

__all__ = ["UnseenTouch", "unseen_touches"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class UnseenTouch:
    """What is said of a touch by all others.

    material, key: its own. names: the materials it was weighed among, in alphabetical order. probability: of each,
    shape (C,). novelty: see `Prediction`. threshold: of the novelty, from which on it is called unknown.
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


def unseen_touches(model: Model, false_alarms: float) -> list[UnseenTouch]:
    """What a model, just fitted, says of the sampled touches, each left out of readouts and kept touches.

    They are weighed among the materials that have a sampled touch. Those of a material's only touch are not there.
    Calibration is that of all. false_alarms: as in `Settings`.
    """
    return list(_unseen(model, false_alarms))


def _unseen(model: Model, false_alarms: float) -> Iterator[UnseenTouch]:
    fusion, seen = model.fusion, set[int]()
    if fusion is None:
        return
    matcher = fusion.matcher
    rows = {} if matcher is None else matcher.kept.rows()
    for stage in range(len(model.calibrations) - 1, -1, -1):
        scales, whole = model.scales("complete", stage), stage == len(model.calibrations) - 1
        calibration = fusion.complete.calibration if whole else model.calibrations[stage]
        held = held_out(stage, scales, model.sample, model.apart, calibration)
        moment = next((moment for moment in reversed(fusion.moments) if moment.stage == stage), fusion.complete)
        for i, place in enumerate(held.places):
            if place in seen:
                continue
            seen.add(place)
            material, key, _ = model.sample[place]
            chances, novelty = np.exp(held.logs[i]), float(held.novelty[i])
            said = Judgement(chances, novelty, moment, float(held.distance[i]))
            if matcher is not None and key in rows and not moment.suffices(float(chances.max()), said.distance):
                way = matcher.match(matcher.kept.levels(rows[key]), held_out=rows[key])
                said = fused(matcher, held.names, said, way, own_time=True)
            else:
                said = replace(said, probability=tempered(chances, moment.model_outlier_rate))
            threshold = moment.threshold(false_alarms)
            yield UnseenTouch(material, key, tuple(held.names), said.probability, said.novelty, threshold)
