"""What a model says of touches that it never observed: of the sampled ones, each left out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.prediction.comparing import Compared
from scroll_tactile.prediction.model import Judgement, Model
from scroll_tactile.prediction.recalling import together
from scroll_tactile.readouts.calibration import Calibration, common_names
from scroll_tactile.readouts.leave_one_out import LeftOut
from scroll_tactile.signals.windows import Scale

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
    rows = {} if model.pooled is None else model.pooled.recall.rows()
    held = set() if model.pooled is None else model.pooled.recall.held
    names_at: dict[tuple[Scale, ...], list[str]] = {}
    for touch, (material, key, _) in enumerate(model.sample):
        found = _judged(model, touch)
        if found is None:
            continue
        stage, scales, calibration = found
        apart = [model.apart[scale] for scale in scales]
        names = names_at.setdefault(tuple(scales), common_names(apart))
        if material not in names or len(names) < 2:
            continue
        said, pooled = _said(apart, names, touch, stage, calibration), model.pooled
        kept = pooled is not None and (material, key) in held
        if pooled is not None and kept and (said.probability.max() < pooled.sure or said.strange > pooled.familiar):
            recollection = pooled.recall.recollect(pooled.recall.levels(rows[key]), left_out=rows[key])
            said = together(pooled, names, Compared(said, recollection, own_time=True), None)
        threshold = calibration.threshold(false_alarms)
        yield UnseenTouch(material, key, tuple(names), said.probability, said.novelty, threshold)


def _judged(model: Model, touch: int) -> tuple[int, list[Scale], Calibration] | None:
    """The last stage that a sampled touch was left out at, the scales that judge there, and how they are read."""
    last = len(model.calibrations) - 1
    for stage in range(last, -1, -1):
        viewed = stage == last and model.whole is not None
        scales = [*model.stages[stage], *(model.views if viewed else [])]
        if all((touch, stage) in model.apart[scale].rows for scale in scales):
            whole = model.whole if viewed else None
            return stage, scales, model.calibrations[stage] if whole is None else whole
    return None


def _said(
    apart: Sequence[LeftOut], names: Sequence[str], touch: int, stage: int, calibration: Calibration
) -> Judgement:
    """What the readouts say of a touch that they never observed."""
    rows = [left.rows[touch, stage] for left in apart]
    places = [[left.names.index(name) for name in names] for left in apart]
    strange = np.array([left.strangeness[row] for left, row in zip(apart, rows, strict=True)])
    weights = calibration.believed(strange)
    logits = np.zeros(len(names))
    for weight, left, row, own in zip(weights, apart, rows, places, strict=True):
        logits += weight * left.scores[row][own]
    distances = [left.distances[row][own].min() for left, row, own in zip(apart, rows, places, strict=True)]
    novelty = float(calibration.novelty(np.array(distances)))
    chances = np.exp(logits - logits.max())
    return Judgement(chances / chances.sum(), novelty, calibration, float(calibration.relative(strange).min()))
