"""A simulated camera behind a gel that is pressed on reliefs: for tests and demonstrations, labelled simulated.

Six reliefs, each a few waves that differ in length, height and direction, are pressed into a gel lit by three lamps of
one colour each, so that a slope towards a lamp is brighter in its colour (as in Yuan, Dong and Adelson 2017). A stream
begins with the gel at rest; then the contact grows. Where a relief lies, how it is turned and how hard it is pressed
vary from touch to touch. Nothing in it was measured on a sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError, UnknownMaterialError
from scroll_tactile.sensors import GELSIGHT, Sensor
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["SMALL", "Gel"]

SMALL: Sensor = GELSIGHT.model_copy(update={"channels": 60 * 80 * 3, "layout": (60, 80, 3), "duration": 0.2})
"""A camera of 60 × 80 pixels, for quick tests; a touch of its sensor's duration is five frames."""

MATERIALS = ("burlap", "cord", "gravel", "leather", "mesh", "tile")

_Floats = npt.NDArray[np.float64]

_WAVES = 5  # in a relief
_LAMPS = np.deg2rad([90.0, 210.0, 330.0])  # the directions that red, green and blue light comes from
_BASE = np.array([0.35, 0.42, 0.45])  # of the range: the colour of the gel at rest
_GLOW = 0.12  # of the range: how much brighter each colour is on its lamp's side
_SLOPE = 0.9  # of the range, for a slope of one
_NOISE = 0.004  # of the range
_RELIEF, _TOUCH = 1, 2  # first words of the seeds


@dataclass(frozen=True)
class Gel:
    """Six reliefs and one camera; a seed makes the same reliefs for any camera.

    sensor: a camera. seed: 0 or more. Raises InputError for another sensor or a negative seed.

    >>> stream = Gel().touch("cord", 0)
    >>> stream.readings.shape
    (5, 60, 80, 3)
    """

    sensor: Sensor = SMALL
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.sensor.camera:
            raise InputError(f"expected a camera; sensor {self.sensor.name!r} has channels. Take simulator.Scene")
        if self.seed < 0:
            raise InputError(f"expected a seed of 0 or more; came {self.seed}")

    @property
    def materials(self) -> tuple[str, ...]:
        """The names of the reliefs."""
        return MATERIALS

    def touch(self, material: str, repetition: int, frames: int | None = None, force: float | None = None) -> Stream:
        """Press on a material: a stream that depends on the arguments and the seed alone.

        repetition: which touch of the material this is, 0 or more. frames: how many, the first of the gel at rest; as
        many as in the sensor's duration where none is given. force: 0 for no contact; varied around 1 where
        none is given.

        Raises UnknownMaterialError, and InputError for quantities that cannot be.
        """
        if material not in MATERIALS:
            raise UnknownMaterialError(f"expected one of {', '.join(MATERIALS)}; came {material!r}")
        count = self.sensor.readings if frames is None else frames
        if repetition < 0 or count < 1 or (force is not None and not 0 <= force < math.inf):
            raise InputError(
                "expected a repetition of 0 or more, one frame or more, and a force of 0 or more; came "
                f"{repetition}, {frames} and {force}"
            )
        index = MATERIALS.index(material)
        random = np.random.default_rng([_TOUCH, self.seed, index, repetition])
        mean = math.exp(random.normal(0, 0.15))
        pressure = np.arange(count) / max(1, count - 1) * (mean if force is None else force)
        height, width = self.sensor.shape[:2]
        # The pixels' places, in widths of the frame, from its middle.
        down, right = (np.arange(height) + 0.5 - height / 2) / width, (np.arange(width) + 0.5) / width - 0.5
        y, x = np.meshgrid(down, right, indexing="ij")
        slopes = _pressed(self.seed, index, y, x, random)
        shares = np.stack([_lit(y, x, *slopes, float(force)) for force in pressure])
        shares += _NOISE * random.standard_normal(shares.shape)
        low, high = np.asarray(self.sensor.low), np.asarray(self.sensor.high)
        return validate(low + np.round(np.clip(shares, 0, 1) * (high - low)), self.sensor)


def _pressed(
    seed: int, index: int, y: _Floats, x: _Floats, random: np.random.Generator
) -> tuple[_Floats, _Floats, _Floats]:
    """Of a relief fully pressed in: its slopes and the distance from the middle of the contact, (H, W) each."""
    relief = np.random.default_rng([_RELIEF, seed, index, 0])
    lengths = np.exp(relief.uniform(np.log(0.05), np.log(0.3), _WAVES))
    steepness = relief.dirichlet(np.ones(_WAVES)) * relief.uniform(0.2, 0.5)
    turns = relief.uniform(0, math.pi, _WAVES) + random.normal(0, 0.3)
    phases = random.uniform(0, 2 * math.pi, _WAVES)
    middle = random.normal(0, 0.05, 2)
    across, along = np.zeros_like(x), np.zeros_like(x)
    for length, steep, turn, phase in zip(lengths, steepness, turns, phases, strict=True):
        way = math.cos(turn) * x + math.sin(turn) * y
        slope = steep * np.cos(2 * math.pi / length * way + phase)
        across += slope * math.sin(turn)
        along += slope * math.cos(turn)
    return across, along, np.hypot(y - middle[0], x - middle[1])


def _lit(y: _Floats, x: _Floats, across: _Floats, along: _Floats, distance: _Floats, pressure: float) -> _Floats:
    """A frame as shares of the range, (H, W, 3)."""
    touched = 1 / (1 + np.exp((distance - 0.35 * math.sqrt(pressure)) / 0.02)) if pressure else np.zeros_like(x)
    colours = []
    for base, lamp in zip(_BASE, _LAMPS, strict=True):
        glow = _GLOW * (math.cos(lamp) * x - math.sin(lamp) * y)
        shade = math.cos(lamp) * along - math.sin(lamp) * across
        colours.append(base + glow + _SLOPE * touched * min(pressure, 1.5) * shade * 0.3)
    return np.stack(colours, axis=-1)
