"""Whether readings fit the range of their sensor: most outside it, or all in a corner of it, and little can be felt."""

from __future__ import annotations

import numpy as np

from scroll_tactile.signals.stream import Stream

__all__ = ["CURE", "all_clipped", "range_problem"]

CLIPPED = 0.25  # of the values; a blow or a glitch clips fewer
CURE = "make a new memory with a Sensor whose low and high are the least and the most that it sends, in its unit"
NARROW = 0.004  # of the range: readings from 0 to 1 of a sensor that is said to send a byte


def range_problem(stream: Stream) -> str | None:
    """What is wrong with the sensor's range, by a stream of it, and what to do; None where it fits, or nothing changes.

    >>> from scroll_tactile import Sensor
    >>> from scroll_tactile.signals.stream import validate
    >>> skin = Sensor(name="skin", channels=2, rate=50, low=0, high=255, unit="counts", duration=1)
    >>> print(range_problem(validate([[0.1, 0.2], [0.9, 0.3]], skin)))
    all readings lie in 0.31 % of the range of sensor 'skin' (0 to 255 counts) and can hardly be told apart: make a \
new memory with a Sensor whose low and high are the least and the most that it sends, in its unit
    """
    sensor = stream.sensor
    low, high = sensor.limits
    limits = f"{low:g} to {high:g} {sensor.unit}" if low.ndim == high.ndim == 0 else "each channel by its own"
    where = f"the range of sensor {sensor.name!r} ({limits})"
    share = stream.clipped / stream.readings.size
    if share > CLIPPED:
        return f"{100 * share:.0f} % of the values lie outside {where} and were clipped to its ends: {CURE}"
    least, most = stream.readings.min(axis=0), stream.readings.max(axis=0)
    span = float(np.max((most - low) / (high - low)) - np.min((least - low) / (high - low)))
    if not 0 < span <= NARROW:
        return None
    return f"all readings lie in {100 * span:.2g} % of {where} and can hardly be told apart: {CURE}"


def all_clipped(stream: Stream) -> bool:
    """Whether all values lay outside the range: streams that differed may be the same now."""
    return stream.clipped >= stream.readings.size - stream.missing
