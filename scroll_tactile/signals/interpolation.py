"""Values that a sensor missed, interpolated in time."""

import numpy as np
import numpy.typing as npt

from scroll_tactile.sensors import Sensor

__all__ = ["interpolate"]

_BLOCK = 2**20  # values at once: a camera that drops a frame lacks a million


def interpolate(values: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], sensor: Sensor) -> None:
    """Write into each missing value, in place, the line between its channel's neighbours in time.

    values: contiguous, (T, n) or (T, height, width, 3), within the sensor's range except where missing. mask: which are
    missing, of the same shape. At a channel's ends its nearest value is held; a channel without any reads the low end.
    """
    flat, flags = values.reshape(len(values), -1), mask.reshape(len(mask), -1)
    low = np.broadcast_to(sensor.limits[0], sensor.shape).reshape(-1)
    channels = np.flatnonzero(flags.any(axis=0))
    size = max(1, _BLOCK // len(values))
    for block in (channels[first : first + size] for first in range(0, len(channels), size)):
        flat[:, block] = _lines(flat[:, block].astype(np.float64), flags[:, block], low[block])
    np.clip(values, *sensor.limits, out=values)  # rounding may pass a neighbour by a unit in the last place


def _lines(
    values: npt.NDArray[np.float64], gap: npt.NDArray[np.bool_], low: npt.NDArray[np.float32]
) -> npt.NDArray[np.float64]:
    """Values (T, n) whose gaps are interpolated, held at the ends, `low` in a channel (n,) that is all gap."""
    dead = gap.all(axis=0)
    values[:, dead], gap = low[dead], gap & ~dead
    last = len(values)
    time = np.arange(last)[:, None]
    before = np.maximum.accumulate(np.where(gap, -1, time), axis=0)
    after = np.minimum.accumulate(np.where(gap, last, time)[::-1], axis=0)[::-1]
    before, after = np.where(before < 0, after, before), np.where(after == last, before, after)  # held at the ends
    begin, end = np.take_along_axis(values, before, axis=0), np.take_along_axis(values, after, axis=0)
    # Step by step in float64, not np.interp: a fused multiply-add would round otherwise on another machine.
    slope = (end - begin) / np.maximum(after - before, 1)
    return np.where(gap, begin + slope * (time - before), values)
