"""Levels: readings in 255 steps of their channels' ranges, as kept touches hold them, a byte each."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["LEVELS", "MISSING", "LevelArray", "levels_of", "stream_of"]

LEVELS = 255
MISSING = 255  # the level of a value that was not read; it has a likelihood of 1 beside any other
LevelArray = npt.NDArray[np.uint8]


def levels_of(readings: npt.NDArray[np.floating], sensor: Sensor) -> LevelArray:
    """Readings in the sensor's unit, shape (T, C), as levels, shape (C, T); NaN is MISSING, the rest is clipped."""
    low, high = (limit.astype(np.float64) for limit in sensor.limits)
    share = np.clip((np.asarray(readings, dtype=np.float64) - low) / (high - low), 0.0, 1.0)
    levels = np.where(np.isnan(share), MISSING, np.rint(share * (LEVELS - 1)))
    return np.ascontiguousarray(levels.T.astype(np.uint8))


def stream_of(levels: LevelArray, sensor: Sensor) -> Stream:
    """The readings that kept levels stand for.

    A missing value repeats the last one before it, or where there is none the first that was read; a channel without
    any lies at the low end of its range.
    """
    low, high = sensor.limits
    lacking = levels == MISSING
    if lacking.any():
        last = np.maximum.accumulate(np.where(lacking, -1, np.arange(levels.shape[1])), axis=1)
        first = lacking.argmin(axis=1)[:, None]  # 0 of a channel without any
        levels = np.take_along_axis(levels, np.where(last < 0, first, last), axis=1)
        levels[lacking.all(axis=1)] = 0
    readings = low + (high - low) * (levels.T.astype(np.float32) / np.float32(LEVELS - 1))
    return validate(readings.clip(low, high), sensor)
