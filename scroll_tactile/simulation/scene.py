"""A minimal simulator of a sensor that slides over a textured surface, for the demo and the tests.

It is no model of any real sensor or material: the names are only names. Nothing measured on it is a result.

>>> from scroll_tactile.simulation.scene import Scene
>>> from scroll_tactile.sensors import BIOTAC
>>> scene = Scene(sensor=BIOTAC, seed=0)
>>> scene.materials[:3]
('bark', 'brick', 'canvas')
>>> scene.touch("cork", repetition=7)
Stream(biotac, (400, 19), 4 s, clipped=0)

A surface is a height over one coordinate: a few sine waves of its own wavelengths, and a fine irregular
relief. A channel at place x on the pad reads, at time t, the height at x + speed · t, so that what passes one
channel passes those behind it a little later. How strongly it responds depends on the force, and on how near
the middle of the contact it lies. Force and speed vary from touch to touch, and slowly within one.

Sensors respond to that in three ways, so that nothing is tuned to one of them: "pressure" reads it, as most do;
"events" is 1 in the reading in which a taxel's pressure has risen by a step, and 0 otherwise, under a contact so narrow
that most taxels stay quiet; "light" reads a contact of a tenth of the range on an offset that wanders.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError, UnknownMaterialError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["EVENT_SKIN", "LIGHT_PAD", "MATERIALS", "Response", "Scene"]

Response = Literal["pressure", "events", "light"]

EVENT_SKIN = Sensor(
    name="event-skin", channels=78, rate=50.0, low=0.0, high=1.0, unit="events", duration=4.0, layout=(6, 13)
)
"""A skin of binary taxels, to be touched with the response "events"."""

LIGHT_PAD = Sensor(name="light-pad", channels=38, rate=100.0, low=0.0, high=4095.0, unit="counts", duration=2.0)
"""A capacitive pad that is hardly pressed, to be touched with the response "light"."""

# fmt: off
MATERIALS = (
    "bark", "brick", "canvas", "carpet", "cork", "corduroy", "cotton", "denim", "felt", "gauze",
    "leather", "linen", "marble", "nylon", "oak", "paper", "rubber", "silk", "tile", "wool",
)
# fmt: on
"""The names of the twenty textures; a scene's seed makes what they feel like."""

_Floats = npt.NDArray[np.float64]

_PAD = 14.0  # mm across
_SPEED, _FORCE = 40.0, 1.0  # mm/s and N of a mean touch
_WAVES = 4
_NOISE = 0.006  # of the range: white noise, and a touch's own offset
_RISE = 0.04  # of the range: a rise of the pressure that a taxel of events reports
_NARROW = _PAD / 8  # mm: the contact under which most taxels of events stay quiet
_LIGHT = 0.1  # of a mean contact
_WANDER = 0.02  # of the range in a second's square root: a random walk of the offset, each channel's own
# First word of every seed: a texture, a pad and a touch must never draw the same numbers.
_TEXTURE, _PADS, _TOUCH = 1, 2, 3


@dataclass(frozen=True)
class _Texture:
    """What a material feels like.

    wavelengths: of its waves, in mm; amplitudes: theirs, as a share of the sensor's range.
    roughness: amplitude of its irregular relief, as a share of the range.
    firmness: mean reading at the mean force, as a share of the range.
    onset: seconds until the contact has settled: soft materials take longer.
    stick: how much the speed wavers within a touch.
    """

    wavelengths: _Floats
    amplitudes: _Floats
    roughness: float
    firmness: float
    onset: float
    stick: float


@dataclass(frozen=True)
class _Pad:
    """Where the channels lie and how they respond.

    along, across: places in mm from the middle of the pad, the sliding being along; shape (n,).
    rest: readings without contact, as a share of the range; gain: response to the surface; shape (n,).
    """

    along: _Floats
    across: _Floats
    rest: _Floats
    gain: _Floats


@dataclass(frozen=True)
class Scene:
    """Twenty textures and one sensor that can touch them; a seed makes the same textures for any sensor.

    sensor: any but a camera.
    seed: 0 or more.
    response: how the sensor responds to the surface: "pressure", "events" or "light".

    Raises InputError for a camera, whose pictures are not modelled, for a negative seed, and for another response.
    """

    sensor: Sensor
    seed: int = 0
    response: Response = "pressure"

    def __post_init__(self) -> None:
        if self.response not in get_args(Response):
            raise InputError(f"expected a response of {', '.join(get_args(Response))}; came {self.response!r}")
        if self.sensor.camera:
            raise InputError(
                f"expected a sensor with channels; {self.sensor.name!r} is a camera, which the simulator "
                "does not model. Use recorded frames"
            )
        if self.seed < 0:
            raise InputError(f"expected a seed of 0 or more; came {self.seed}")

    @property
    def materials(self) -> tuple[str, ...]:
        """The names of the scene's materials."""
        return MATERIALS

    @property
    def rest(self) -> _Floats:
        """The channels' readings at rest, as shares of the range, (n,)."""
        rest = _pad(self.seed, self.sensor).rest
        return np.zeros_like(rest) if self.response == "events" else rest

    @property
    def step(self) -> _Floats:
        """Of the sensor's converter, in its unit: one for all channels, or one for each."""
        span: _Floats = np.asarray(self.sensor.high) - np.asarray(self.sensor.low)
        if self.response == "events":
            return span
        counts = (np.asarray(self.sensor.unit) == "counts") & (span >= 100)  # whole; a unit of rescaled counts is none
        return np.where(counts, 1.0, span / 4095)

    def noise(self, random: np.random.Generator, count: int) -> _Floats:
        """Noise of so many readings, as shares of the range, (count, n); events have none."""
        noise = _NOISE * random.standard_normal((count, self.sensor.channels))
        return np.zeros_like(noise) if self.response == "events" else noise

    def touch(
        self,
        material: str,
        repetition: int,
        seconds: float | None = None,
        speed: float | None = None,
        force: float | None = None,
        heading: float = 0.0,
    ) -> Stream:
        """Slide over a material: a stream that depends on the arguments and the scene's seed alone.

        repetition: which touch of the material this is, 0 or more.
        seconds: its length; the sensor's duration where none is given.
        speed: in mm/s; force: in N. Where none is given they vary from touch to touch around 40 mm/s and 1 N.
        heading: where to it slides over the pad, in degrees from the first axis of its layout to the second.

        Raises UnknownMaterialError, StreamTooShortError, and InputError for quantities that cannot be.
        """
        if material not in MATERIALS:
            raise UnknownMaterialError(
                f"expected one of the scene's materials, {', '.join(MATERIALS)}; came {material!r}"
            )
        if repetition < 0:
            raise InputError(f"expected a repetition of 0 or more; came {repetition}")
        seconds = self.sensor.duration if seconds is None else seconds
        for name, value in (("seconds", seconds), ("speed", speed), ("force", force)):
            if value is not None and not 0 < value < math.inf:
                raise InputError(f"expected {name} above 0 and finite; came {value}")
        if not math.isfinite(heading):
            raise InputError(f"expected a finite heading, in degrees; came {heading}")
        index = MATERIALS.index(material)
        random = np.random.default_rng([_TOUCH, self.seed, index, repetition])
        count = max(1, round(seconds * self.sensor.rate))  # validate refuses too few, as for any stream
        times = np.arange(count) / self.sensor.rate
        pad = _turned(_pad(self.seed, self.sensor), heading)
        width = _NARROW if self.response == "events" else _PAD / 2
        shares = _slide(_texture(self.seed, index), pad, times, random, speed, force, width)
        if self.response == "events":
            shares = _events(shares)
        elif self.response == "light":
            wander = np.cumsum(random.standard_normal(shares.shape), axis=0) / math.sqrt(self.sensor.rate)
            shares = pad.rest + _LIGHT * (shares - pad.rest) + _WANDER * wander
        low, high, step = np.asarray(self.sensor.low), np.asarray(self.sensor.high), self.step
        return validate(np.clip(low + np.round(shares * (high - low) / step) * step, low, high), self.sensor)


@lru_cache(maxsize=256)
def _texture(seed: int, index: int) -> _Texture:
    random = np.random.default_rng([_TEXTURE, seed, index, 0])
    return _Texture(
        wavelengths=np.exp(random.uniform(np.log(2.5), np.log(16.0), _WAVES)),
        amplitudes=random.dirichlet(np.ones(_WAVES)) * random.uniform(0.07, 0.16),
        roughness=np.exp(random.uniform(np.log(0.003), np.log(0.04))),
        firmness=random.uniform(0.15, 0.5),
        onset=random.uniform(0.03, 0.2),
        stick=random.uniform(0.0, 0.05),
    )


@lru_cache(maxsize=16)
def _pad(seed: int, sensor: Sensor) -> _Pad:
    random = np.random.default_rng([_PADS, seed, sensor.channels, 0])
    along, across = _places(sensor)
    return _Pad(
        along=along,
        across=across,
        rest=random.uniform(0.08, 0.2, sensor.channels),
        gain=random.uniform(0.7, 1.3, sensor.channels),
    )


def _turned(pad: _Pad, heading: float) -> _Pad:
    """The pad as it is met by a surface that passes it in another direction."""
    if heading % 360 == 0:
        return pad
    cosine, sine = math.cos(math.radians(heading)), math.sin(math.radians(heading))
    return replace(pad, along=cosine * pad.along + sine * pad.across, across=cosine * pad.across - sine * pad.along)


def _places(sensor: Sensor) -> tuple[_Floats, _Floats]:
    """Places of the channels in mm: a grid for a layout of two axes, else spread evenly over a disc."""
    if sensor.layout is not None and len(sensor.layout) == 2:
        rows, columns = ((np.arange(size) + 0.5) / size - 0.5 for size in sensor.layout)
        return np.tile(columns * _PAD, len(rows)), np.repeat(rows * _PAD, len(columns))
    order = np.arange(sensor.channels)
    radius = _PAD / 2 * np.sqrt((order + 0.5) / sensor.channels)
    angle = order * math.pi * (3 - math.sqrt(5))  # the golden angle: a sunflower's seeds
    return radius * np.cos(angle), radius * np.sin(angle)


def _slide(
    texture: _Texture,
    pad: _Pad,
    times: _Floats,
    random: np.random.Generator,
    speed: float | None,
    force: float | None,
    width: float,
) -> _Floats:
    """Pressures as shares of the range, shape (T, n). width: of the contact, a standard deviation in mm."""
    # Drawn even where they are given, so that a touch at another speed is otherwise the same touch.
    mean_speed = _SPEED * math.exp(random.normal(0, 0.025))
    mean_force = _FORCE * math.exp(random.normal(0, 0.06))
    speed, force = mean_speed if speed is None else speed, mean_force if force is None else force
    middle = random.normal(0, 0.5, 2)
    rhythm, turn = random.uniform(0.5, 1.5), random.uniform(0, 2 * math.pi)

    # The integral of a speed that wavers as speed · (1 + stick · cos(2π rhythm t + turn)).
    waver = np.sin(2 * math.pi * rhythm * times + turn) / (2 * math.pi * rhythm)
    place = pad.along + (speed * (times + texture.stick * waver))[:, None]
    height = _height(texture, place, random)

    distance = (pad.along - middle[0]) ** 2 + (pad.across - middle[1]) ** 2
    contact = pad.gain * np.exp(-distance / (2 * width**2))
    press = -np.expm1(-times / texture.onset)
    drift = 1 + random.normal(0, 0.02) * times
    load = (press * drift * math.sqrt(force))[:, None]
    noise = random.normal(0, _NOISE) + _NOISE * random.standard_normal(place.shape)
    return np.asarray(pad.rest + noise + contact * load * (texture.firmness + height))


def _height(texture: _Texture, place: _Floats, random: np.random.Generator) -> _Floats:
    """The surface at `place` in mm, from where this touch happens to begin; as a share of the range."""
    height: _Floats = np.zeros_like(place)
    phases = random.uniform(0, 2 * math.pi, _WAVES)
    for wavelength, amplitude, phase in zip(texture.wavelengths, texture.amplitudes, phases, strict=True):
        height += amplitude * np.sin(2 * math.pi / wavelength * place + phase)
    begin = place.min()
    relief = random.standard_normal(math.ceil(place.max() - begin) + 2)  # one point a mm
    height += texture.roughness * np.interp(place - begin, np.arange(len(relief)), relief)
    return height


def _events(shares: _Floats) -> _Floats:
    """1 where a pressure is a step higher than all since its last event or its last fall by a step, 0 elsewhere."""
    events = np.zeros_like(shares)
    reported = shares[0].copy()
    for event, now in zip(events[1:], shares[1:], strict=True):
        event[now >= reported + _RISE] = 1.0
        reported = np.where(np.abs(now - reported) >= _RISE, now, reported)
    return events
