"""Windows: the stretches of a stream that are embedded, at a few scales.

An embedding of a whole stream is lost when a touch is shorter, longer, faster or slower than those learned from.
So a stream is read in windows of about 0.3 s, about 1 s and three quarters of the usual duration, and each of
these scales has statistics of its own. A stream is known from its first 0.3 s on, and better with every reading.
"""

from __future__ import annotations

import numpy as np

from scroll_tactile.sensors import Sensor

__all__ = ["MOST_WINDOWS", "Extent", "extents", "scales", "starts"]

SHORTEST = 0.3  # seconds
LONGEST = 0.75  # of the usual duration: a touch that ends a little early still has a window of it
FEWEST = 9  # readings in a window, the taps of one kernel
APART = 4.0  # with more than this between the shortest and the longest there is a scale halfway
MOST_WINDOWS = 64  # of a scale in one stream: a touch of hours is sampled evenly, at bounded cost
FRAMES = 80  # columns of a camera's frame in its tactile image

Extent = dict[int, list[int]]  # width of windows → their first columns


def scales(sensor: Sensor) -> tuple[int, ...]:
    """The widths of windows in columns of the tactile image, ascending: BioTac (30, 95, 300), RoboSkin (15, 56).

    A camera has one: a frame.
    """
    if sensor.camera:
        return (min(FRAMES, sensor.shape[1]),)
    shortest = max(FEWEST, round(SHORTEST * sensor.rate))
    longest = round(LONGEST * sensor.readings)
    if longest < 1.5 * shortest:
        return (shortest,)
    if longest <= APART * shortest:
        return (shortest, longest)
    return (shortest, round(float(np.sqrt(shortest * longest))), longest)


def starts(columns: int, width: int) -> list[int]:
    """The first columns of the windows of a width: dense where the touch begins, then one after another.

    Steps grow from a sixth of the width to the width itself, for the beginning of a touch differs from the
    rest and is what an early decision rests on. There are at most MOST_WINDOWS, evenly thinned out.
    """
    begin = [0]
    if columns > 4 * MOST_WINDOWS * width:
        step = width
        begin = list(range(0, columns - width + 1, step))
    else:
        while (
            after := begin[-1] + int(np.clip(begin[-1] // 3, max(1, width // 6), width))
        ) + width <= columns:
            begin.append(after)
    if len(begin) > MOST_WINDOWS:
        begin = [begin[at] for at in np.linspace(0, len(begin) - 1, MOST_WINDOWS).round().astype(int)]
    return begin


def extents(columns: int, widths: tuple[int, ...]) -> list[Extent]:
    """What can be read of a stream after each of its stages, the last being all of it.

    Stage k is reached when a window of scale k fits; before the stream's own last stage it is the stretch of
    just that length. A stream shorter than the shortest scale is one window of its own length, of that scale.
    """
    if columns < widths[0]:
        return [{widths[0]: [0]}]
    reached = [width for width in widths if width <= columns]
    lengths = [*reached[:-1], columns]
    return [
        {width: starts(length, width) for width in reached[: at + 1]} for at, length in enumerate(lengths)
    ]
