"""Windows and views: the parts of a stream that are embedded, at a few scales.

An embedding of a whole stream is lost when a touch is shorter or longer than those learned from. So a stream is read in
windows of 0.3 s and of three quarters of the usual duration, and each of these scales has statistics of its own. A
stream is known from its first 0.3 s on, and better with every reading. Windows in seconds are lost when a touch is made
faster or slower: beside them the whole of it is read in its own time (see `image`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Literal

import numpy as np

from scroll_tactile.sensors import Sensor

__all__ = [
    "COMPETING",
    "ENOUGH",
    "FRAMES",
    "MOST_WINDOWS",
    "SHAPE",
    "VIEWS",
    "WHOLE",
    "Extent",
    "Scale",
    "ScaleKind",
    "WindowPlan",
    "measuring",
    "scales",
    "whole_steps",
]

SHORTEST = 0.3  # seconds
LONGEST = 0.75  # of the usual duration: a usual touch has several windows of it
ENOUGH = 0.65  # of a window: a touch half the usual one is read with the kernels of the wide windows as far as it goes
FEWEST = 9  # readings in a window, the taps of one kernel
MOST_WINDOWS = 64  # of a scale in one stream: a touch of hours is sampled evenly, at bounded cost
MOST_STEPS = 1024  # of a whole touch: windows read what is finer than a thousandth of it
FRAMES = 160  # steps of a camera's frame in its tactile image, at most: the columns of its pixels

Extent = dict[int, list[int]]  # width of windows → their first steps

VIEWS = {"whole": 2**20, "shape": 2**20 + 1, "competing": 2**20 + 2}  # their numbers on disk: no window is as wide


ScaleKind = Literal["window", "whole", "shape", "competing"]


@dataclass(frozen=True)
class Scale:
    """A kind of features that has statistics of its own.

    kind: "window" for windows of `width` steps; without a width the views of a whole touch: "whole" for it as it is,
    "competing" for it read by competing kernels, "shape" for what `signals.image` makes of it.

    Scales are ordered by their number, which names their arrays on disk; `str` and `int` of a scale give it. A window's
    is its width.
    """

    kind: ScaleKind
    width: int = 0

    @classmethod
    def numbered(cls, number: int) -> Scale:
        """The scale of a number on disk."""
        return {int(view): view for view in (WHOLE, SHAPE, COMPETING)}.get(number) or cls("window", number)

    def __hash__(self) -> int:
        return self.width  # scales are looked up a hundred times a touch

    def __index__(self) -> int:
        return self.width or VIEWS[self.kind]

    def __str__(self) -> str:
        return str(int(self))

    def __lt__(self, other: Scale) -> bool:
        return int(self) < int(other)


WHOLE, SHAPE, COMPETING = Scale("whole"), Scale("shape"), Scale("competing")


def measuring(scales: Sequence[Scale]) -> list[int]:
    """The places of those scales at which distances say how new a touch is, or how far off: all but "competing".

    With the distances of competing kernels, counts that are mostly 0, the learner called 1.6 % more of the touches of
    eight series unknown, and 10 % more of RoboSkin's with a fifth of the channels dead.
    """
    return [place for place, scale in enumerate(scales) if scale != COMPETING]


def scales(sensor: Sensor) -> tuple[int, ...]:
    """The widths of windows in steps of time of the tactile image, ascending: BioTac (30, 300), RoboSkin (15, 56).

    A camera has one: a frame. So has a sensor whose touches are too short for two.
    """
    if sensor.camera:
        return (min(FRAMES, sensor.shape[1]),)
    shortest = max(FEWEST, round(SHORTEST * sensor.rate))
    longest = int(LONGEST * sensor.readings)
    # A touch must fit the shortest before it fits the longest: stages are known by their number.
    two = longest >= 1.5 * shortest and ENOUGH * longest > shortest
    return (shortest, longest) if two else (shortest,)


def whole_steps(sensor: Sensor) -> int:
    """How many steps a whole touch is resampled to: those of a default one, within bounds. 0 for a camera: no views."""
    return 0 if sensor.camera else min(max(sensor.readings, FEWEST), MOST_STEPS)


def _starts(steps: int, width: int, *, dense: bool) -> list[int]:
    room = max(0, steps - width)
    if not dense:
        return _thinned(range(0, room + 1, max(1, width // 6, min(width // 2, room // 2))))
    begin = [0]
    while begin[-1] < min(room, 4 * width):
        begin.append(begin[-1] + max(1, width // 6, begin[-1] // 3))
    rest = range(begin[-1] + width, room + 1, width)
    return _thinned(rest, [start for start in begin if start <= room])


def _thinned(rest: range, begin: Sequence[int] = ()) -> list[int]:
    """At most MOST_WINDOWS first steps, evenly spaced among `begin` and then `rest`, long where a touch lasts hours."""
    count = len(begin) + len(rest)
    places = np.linspace(0, count - 1, MOST_WINDOWS).round().astype(int) if count > MOST_WINDOWS else range(count)
    return [begin[place] if place < len(begin) else rest[place - len(begin)] for place in map(int, places)]


@dataclass(frozen=True)
class WindowPlan:
    """How the touches of a sensor are read by an embedding: which windows, and which scales judge.

    widths: of windows, ascending. partial: whether a touch of 0.65 of a wide window or more is read as far as it goes.
    judged: "all" scales that fit a touch, or the "widest" of them alone. shrinkage: how many times as far as the
    formula says readouts are shrunk. frames: whether windows are a camera's frames. whole: the steps that a whole
    touch is stretched to for the views of it; 0 where there are none. competes: whether competing kernels read it, too.
    """

    widths: tuple[int, ...]
    partial: bool = True
    judged: Literal["all", "widest"] = "all"
    shrinkage: float = 1.0
    frames: bool = False
    whole: int = 0
    competes: bool = False

    @property
    def windows(self) -> tuple[Scale, ...]:
        """The scales that are windows, ascending."""
        return tuple(Scale("window", width) for width in self.widths)

    @property
    def views(self) -> tuple[Scale, ...]:
        """The scales that are views of a whole touch, ascending."""
        if not self.whole:
            return ()
        return (WHOLE, SHAPE, COMPETING) if self.competes else (WHOLE, SHAPE)

    @property
    def scales(self) -> tuple[Scale, ...]:
        """All scales, ascending by number: windows, then views."""
        return self.windows + self.views

    def extent(self, steps: int) -> Extent:
        """The windows that are read of a touch of so many steps, at every scale that fits.

        The shortest begin densely where the touch begins, which differs from the rest and is what an early decision
        rests on: their strides grow from a sixth of the width to the width. Wider ones overlap by half, or by more
        where few fit. There are at most MOST_WINDOWS of a scale, evenly spread. A touch that is shorter than a scale,
        but not much, is one window of it, if windows may be `partial`; of the shortest scale every touch is. A camera's
        windows are its frames, and lie across no two of them.
        """
        return _extent(self, steps)

    def fitting(self, steps: int) -> list[int]:
        """The widths of which a touch of so many steps has a window."""
        enough = ENOUGH if self.partial else 1.0
        return [width for width in self.widths if width == self.widths[0] or steps >= enough * width]

    def judging(self, length: int) -> list[Scale]:
        """The windows that judge when so many steps have been observed; the views always do."""
        fit = self.fitting(length)
        return [Scale("window", width) for width in (fit[-1:] if self.judged == "widest" else fit)]

    def observed(self, steps: int, length: int) -> dict[Scale, list[int]]:
        """Scale → places of the windows of a touch of so many steps that count when `length` steps are observed.

        They lie within these. A window of the shortest width also begins at least half a width after the one before:
        otherwise the densely read beginning would count for more than the rest.
        """
        extent, chosen = self.extent(steps), {}
        for width in self.fitting(length):
            begin, places = extent[width], list[int]()
            spacing = width // 2 if width == self.widths[0] else 1
            for place, start in enumerate(begin):
                inside = start + width <= length or start == 0
                if inside and (not places or start >= begin[places[-1]] + spacing):
                    places.append(place)
            chosen[Scale("window", width)] = places
        return chosen

    def scored(self, steps: int, length: int) -> dict[Scale, list[int]]:
        """Scale → places of the windows that judge a touch of so many steps after the first `length` of them."""
        places = self.observed(steps, length)
        return {scale: places[scale] for scale in self.judging(length)}

    def scored_stages(self, steps: int) -> list[dict[Scale, list[list[int]]]]:
        """For each stage that a touch of so many steps reached: scale → places of the windows that judge there.

        The views judge a touch as a whole, at its last stage. Places come in groups, each learned as its mean: the
        narrow windows together, wide ones and a camera's frames one by one. One of these may be all that is judged: of
        halves of BioTac's touches 97 % are right so and 92 learned from means of their wide windows, of single frames
        of GelSight 84.5 and 78.4 % from means of videos.
        """

        def grouped(scale: Scale, places: list[int]) -> list[list[int]]:
            return [[place] for place in places] if self.frames or scale.width > self.widths[0] else [places]

        stages = [self.scored(steps, length) for length in self.stages(steps)]
        groups = [{scale: grouped(scale, places) for scale, places in stage.items()} for stage in stages]
        groups[-1] |= {view: [[0]] for view in self.views}
        return groups

    def places(self, steps: int) -> dict[Scale, list[int]]:
        """Scale → places of the windows of a touch of so many steps whose codes are averaged, at every scale."""
        return dict(_places(self, steps))

    def milestones(self) -> tuple[int, ...]:
        """The lengths at which a touch reaches its stages: where a scale first fits, and geometrically halfway to it.

        How far a scale is to be believed depends on how many of its windows there are, so calibration is measured at
        each: BioTac 30, 77 and 195 readings.
        """
        enough = ENOUGH if self.partial else 1.0
        fit = [self.widths[0], *(math.ceil(enough * width) for width in self.widths[1:])]
        between = [round(math.sqrt(low * high)) for low, high in pairwise(fit)]
        return tuple(sorted({*fit, *between}))

    def stages(self, steps: int) -> list[int]:
        """The lengths of a touch's stages: the milestones that it reached, the last replaced by its own length."""
        reached = [length for length in self.milestones() if length <= steps]
        return [*reached[:-1], steps]


@lru_cache(maxsize=1024)  # asked three times a touch
def _extent(plan: WindowPlan, steps: int) -> Extent:
    if plan.frames:
        return {width: _thinned(range(0, max(1, steps - width + 1), width)) for width in plan.fitting(steps)}
    return {width: _starts(steps, width, dense=width == plan.widths[0]) for width in plan.fitting(steps)}


@lru_cache(maxsize=1024)
def _places(plan: WindowPlan, steps: int) -> Mapping[Scale, list[int]]:
    """See `WindowPlan.places`."""
    return plan.observed(steps, steps) | {view: [0] for view in plan.views}
