"""The beginnings of touches left out: what a model that never observed them says of each, at every moment.

A sampled touch that is kept is taken out of the readouts and of the kept touches. What is then said of its beginnings,
made of its kept levels, is what will be said of those of a touch to come: nothing is trained, and all is a function of
the set of touches.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.prediction.comparing import compared
from scroll_tactile.prediction.features import FeatureExtractor, WindowCache
from scroll_tactile.prediction.model import Model
from scroll_tactile.readouts.deviation import spaced
from scroll_tactile.readouts.early import Early, Heard, early_of, moments_of
from scroll_tactile.readouts.leave_one_out import rows_at
from scroll_tactile.readouts.likelihood import LEVELS, MISSING, LevelArray
from scroll_tactile.readouts.pooled import Pooled
from scroll_tactile.readouts.readout import Readout
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream, fewest_readings, validate
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.sample import SampledTouch

__all__ = ["early_answers", "stream_of", "without"]

FloatArray = npt.NDArray[np.float64]

LEFT_OUT = 96  # touches, each judged at every moment


@dataclass(frozen=True)
class _Left:
    """A touch that is left out: its material, its row among the kept ones, and what the sample has of it."""

    material: str
    row: int
    sampled: SampledTouch


@dataclass(frozen=True)
class _Said:
    """What is said of one beginning; see `Heard`."""

    logs: FloatArray
    scores: FloatArray
    certainty: float
    novelty: float


def early_answers(model: Model, extractor: FeatureExtractor) -> Early | None:
    """How a model judges beginnings; None where it keeps no touches, or too few. Measured when first asked for."""
    return model.early(_Measured(extractor))


@dataclass(frozen=True)
class _Measured:
    """Measures how models judge beginnings."""

    extractor: FeatureExtractor

    def __call__(self, model: Model) -> Early | None:
        if model.pooled is None:
            return None
        sensor, least = self.extractor.sensor, min(model.least, model.pooled.recall.longest)
        moments = moments_of(sensor.rate, model.plan.milestones(), least, fewest_readings(sensor))
        return early_of(*_heard(model, self.extractor, model.pooled, moments))


def _heard(
    model: Model, extractor: FeatureExtractor, pooled: Pooled, moments: Sequence[int]
) -> tuple[list[Heard], npt.NDArray[np.intp]]:
    """What is said of touches left out at each moment, and their materials; nothing of fewer than two materials."""
    left = _left(model, pooled)
    names = sorted({touch.material for touch in left} & model.known)
    if len(names) < 2:
        return [], np.empty(0, np.intp)
    with one_thread():
        said = [_said(model, extractor, pooled, names, touch, moments) for touch in left]
    targets = np.array([names.index(touch.material) for touch in left], dtype=np.intp)
    return [_gathered(columns, [of.get(columns) for of in said], targets) for columns in moments], targets


def _left(model: Model, pooled: Pooled) -> list[_Left]:
    """The touches that are left out: of sampled ones that are kept, where their material has others."""
    rows = pooled.recall.rows()
    found = [
        _Left(material, rows[key], sampled)
        for material, key, sampled in model.sample
        if key in rows and all(_others(readout, material, sampled) for readout in model.readouts.values())
    ]
    return [found[i] for i in spaced(found, LEFT_OUT)]


def _others(readout: Readout, material: str, sampled: SampledTouch) -> bool:
    place = readout.places.get(material)
    return place is None or readout.counts[place] > sampled.learned.max()


def without(model: Model, material: str, sampled: SampledTouch) -> Model:
    """The model as if it had never observed a sampled touch, of a material that has others; calibrated as it is.

    Kept touches stay what they are. Whoever calls has BLAS on one thread.
    """
    other = copy.copy(model)
    other.readouts = dict(model.readouts)
    asked = [[*stage, *model.plan.views] for stage in model.stages]
    for scale, readout in model.readouts.items():
        own = rows_at(sampled, asked, scale)
        if own:
            # As many rows as it added: of windows that are learned one by one the sample has the mean.
            times = max(1, round(sampled.learned[own[0]] / len(own)))
            other.readouts[scale] = readout.without(material, np.repeat(sampled.rows[own], times, axis=0))
    return other


def _said(
    model: Model,
    extractor: FeatureExtractor,
    pooled: Pooled,
    names: Sequence[str],
    touch: _Left,
    moments: Sequence[int],
) -> dict[int, _Said]:
    """What is said of the beginnings of a touch that is left out, by their columns."""
    other, levels = without(model, touch.material, touch.sampled), pooled.recall.levels(touch.row)
    whole, said, cache = stream_of(levels, extractor.sensor), {}, WindowCache()
    for columns in moments:
        if columns > levels.shape[1]:
            break
        encoded = extractor.encode(
            whole.first(columns / whole.sensor.rate), model.longest, lambda reach: other.needed(names, reach), cache
        )
        judgement = other.judge(names, encoded.means, encoded.columns)
        way = compared(other, extractor, names, encoded, judgement, pooled, left_out=touch.row)[0]
        certainty = way.recollection.certainty
        said[columns] = _Said(way.logs, way.scores(pooled, names), certainty, way.novelty(pooled))
    return said


def stream_of(levels: LevelArray, sensor: Sensor) -> Stream:
    """The readings that kept levels stand for; what was missing as the last before it."""
    low, high = sensor.limits
    lacking = levels == MISSING
    if lacking.any():
        last = np.maximum.accumulate(np.where(lacking, 0, np.arange(levels.shape[1])), axis=1)
        levels = np.take_along_axis(levels, last, axis=1)
    readings = low + (high - low) * (levels.T.astype(np.float32) / np.float32(LEVELS - 1))
    return validate(readings.clip(low, high), sensor)


def _gathered(columns: int, said: Sequence[_Said | None], targets: npt.NDArray[np.intp]) -> Heard:
    reached = np.array([i for i, of in enumerate(said) if of is not None], dtype=np.intp)
    found = [of for of in said if of is not None]
    return Heard(
        columns,
        reached,
        targets[reached],
        np.array([of.logs for of in found]),
        np.array([of.scores for of in found]),
        float(np.median([of.certainty for of in found])) if found else 0.0,
        np.array([of.novelty for of in found]),
    )
