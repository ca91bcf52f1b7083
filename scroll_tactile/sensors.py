"""What is known about a tactile sensor: its channels, rate and range of values.

Five sensors come with the project, and another is made in one line. Presets of drivers (topic, field and sensor) are in
`recordings.presets`.

>>> from scroll_tactile.sensors import Sensor
>>> skin = Sensor(name="my-skin", channels=39, rate=50.0, low=0.0, high=1.0, unit="counts", duration=5.0)
>>> skin.readings
250
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from scroll_tactile.errors import InputError

__all__ = ["BIOTAC", "BIOTAC_ALL", "CONTACTILE", "GELSIGHT", "ROBOSKIN", "Sensor", "known", "read_sensor"]

MOST_RATE = 1e6  # Hz: a window is of a third of a second, and has to fit in memory
MOST_READINGS = 2**40  # of a touch: products of two lengths fit in 64 bits

_Positive = Annotated[FiniteFloat, Field(gt=0)]


class Sensor(BaseModel):
    """A tactile sensor, or one kind of it; frozen, and equal to another where all its fields are equal.

    name: what streams of this sensor are known by, non-empty.
    channels: how many values a reading has, n ≥ 1.
    rate: readings per second, in Hz; at most 1 000 000.
    low, high: the range of a valid value, in `unit`; what lies outside is clipped to it. A number means all channels;
        a sequence has one for each, as for electrodes beside pressure, or a gyroscope beside an accelerometer.
    unit: the unit of the values, such as "counts" or "N"; likewise one for all channels, or one for each.
    duration: how long a touch usually lasts, in seconds. Streams may be shorter or longer.
    layout: how the channels lie on the sensor, such as (6, 10) patches × taxels; its product is `channels`.
    camera: whether a reading is a picture; then layout is (height, width, 3).
    columns: what the channels are called in tables, where that is known: tables that call them so are read in this
        order. It tells no sensors apart.
    non_finite: whether streams with NaN or ±infinity are "refused", or these values are taken as "missing": then
        `validate` interpolates them, see `Stream.mask`.

    Raises InputError, which is a ValueError, for fields that are missing or do not fit together; pydantic's own error,
    a ValueError, too, where a model is validated or changed.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Annotated[str, Field(min_length=1)]
    channels: Annotated[int, Field(ge=1)]
    rate: Annotated[_Positive, Field(le=MOST_RATE)]
    low: FiniteFloat | tuple[FiniteFloat, ...]
    high: FiniteFloat | tuple[FiniteFloat, ...]
    unit: str | tuple[str, ...]
    duration: _Positive
    layout: tuple[Annotated[int, Field(ge=1)], ...] | None = None
    camera: bool = False
    non_finite: Literal["refused", "missing"] = "refused"
    columns: Annotated[tuple[str, ...] | None, Field(repr=False)] = None

    def __init__(self, **fields: Any) -> None:
        try:
            super().__init__(**fields)
        except ValidationError as error:
            raise InputError(_wrong(error, fields)) from None

    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]  # a model in another is validated as it was

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sensor):
            return NotImplemented
        return self is other or {**vars(self), "columns": None} == {**vars(other), "columns": None}

    def __hash__(self) -> int:
        return hash((self.name, self.channels, self.rate, self.low, self.high, self.duration))

    @model_serializer(mode="wrap")
    def _without_unknown_names(self, serialized: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields: dict[str, Any] = serialized(self)
        if fields.get("columns", ()) is None:
            del fields["columns"]
        return fields

    @model_validator(mode="after")
    def _one_for_all_or_one_each(self) -> Self:
        for field in ("low", "high", "unit", "columns"):
            value = getattr(self, field)
            if isinstance(value, tuple) and len(value) != self.channels:
                raise ValueError(
                    f"{field} has {len(value)} entries for {self.channels} channels: give one, or one each"
                )
            if isinstance(value, tuple) and self.camera and field != "columns":
                raise ValueError(f"a camera has one {field} for all its pixels; {field} has {len(value)} entries")
        return self

    @model_validator(mode="after")
    def _range_fits_float32(self) -> Self:
        # Readings are kept, compared and scaled in float32, so the range has to survive there too.
        largest = float(np.finfo(np.float32).max)
        lows, highs = np.atleast_1d(self.low, self.high)
        for channel, (low, high) in enumerate(np.broadcast(lows, highs)):
            where = f" in channel {channel}" if isinstance(self.low, tuple) or isinstance(self.high, tuple) else ""
            if not low < high:
                raise ValueError(f"low must lie below high{where}; they are {low:g} and {high:g}")
            if max(abs(low), abs(high), high - low) > largest:
                raise ValueError(f"the range {low:g} to {high:g}{where} is too wide for float32 readings")
            if not np.float32(low) < np.float32(high):
                raise ValueError(
                    f"{float(low)!r} and {float(high)!r}{where} are the same number in float32: rescale the readings"
                )
        return self

    @model_validator(mode="after")
    def _layout_fits_channels(self) -> Self:
        if self.layout is not None and math.prod(self.layout) != self.channels:
            raise ValueError(
                f"layout {self.layout} holds {math.prod(self.layout)} values, but channels is {self.channels}"
            )
        if self.camera and (self.layout is None or len(self.layout) != 3 or self.layout[2] != 3):
            raise ValueError(f"a camera needs layout=(height, width, 3); it is {self.layout}")
        return self

    @model_validator(mode="after")
    def _touch_holds_a_reading(self) -> Self:
        if self.rate * self.duration > MOST_READINGS:
            raise ValueError(f"{self.duration:g} s at {self.rate:g} Hz holds more readings than can be counted")
        if self.readings < 1:
            raise ValueError(f"{self.duration:g} s at {self.rate:g} Hz holds no reading")
        return self

    @property
    def readings(self) -> int:
        """The number of readings in a touch of the usual duration."""
        return round(self.rate * self.duration)

    @property
    def limits(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Low and high in `unit`, float32: of shape () where they mean all channels, of shape (n,) otherwise."""
        return np.asarray(self.low, dtype=np.float32), np.asarray(self.high, dtype=np.float32)

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of one reading: (n,), or (height, width, 3) for a camera."""
        return self.layout if self.camera and self.layout is not None else (self.channels,)


BIOTAC = Sensor(
    name="biotac",
    channels=19,
    rate=100.0,
    low=0.0,
    high=255.0,  # valid electrodes lie below about 250; recordings hold rare glitches of over 3000
    unit="counts",
    duration=4.0,
)
"""The 19 electrodes of a SynTouch BioTac."""

_BIOTAC_HIGH = (
    *(255.0,) * 19,  # electrodes, as of BIOTAC
    63.0,  # temperature, tdc: recordings reach 38
    511.0,  # its change, tac: 358
    255.0,  # pressure, pdc: 220
    1023.0,  # mean of the 22 vibration readings, pac: 99.9 % lie below 905 one by one
    255.0,  # their standard deviation: 99.9 % lie below 126
    63.0,  # mean absolute change from one to the next: 99.99 % lie below 79, 99.9 % below 30
)

BIOTAC_ALL = BIOTAC.model_copy(update={"name": "biotac-all", "channels": 25, "high": _BIOTAC_HIGH})
"""All that a SynTouch BioTac measures in 10 ms, made of its 44 words by `datasets.biotac_slide.all_channels`.

Electrodes 1 to 19, temperature, its change, pressure, and of the 22 vibration readings mean, standard deviation and
mean absolute change. Words are of 12 bits, 0 to 4095; the ranges are where those of BioTac-20's training parts lie.
"""

ROBOSKIN = Sensor(
    name="roboskin",
    channels=60,
    rate=50.0,
    low=0.0,
    high=255.0,  # 8-bit taxels; the published recordings reach 192
    unit="counts",
    duration=1.5,
    layout=(6, 10),
)
"""The six patches of ten taxels on the forearm of an iCub."""

CONTACTILE = Sensor(
    name="contactile",
    channels=27,
    rate=100.0,
    low=-10.0,  # not from a data sheet: ±10 N on each axis of a pillar is wider than a fabric's touch needs
    high=10.0,
    unit="N",
    duration=5.99,  # 599 readings
)
"""The nine pillars of a Contactile PapillArray, three axes of force each."""

GELSIGHT = Sensor(
    name="gelsight",
    channels=480 * 640 * 3,
    rate=25.0,
    low=0.0,
    high=255.0,
    unit="counts",
    duration=1.0,
    layout=(480, 640, 3),
    camera=True,
)
"""The camera behind the gel of a GelSight, red, green and blue."""


def known() -> dict[str, Sensor]:
    """The sensors that come with the project, by name."""
    return {sensor.name: sensor for sensor in (BIOTAC, BIOTAC_ALL, ROBOSKIN, CONTACTILE, GELSIGHT)}


def read_sensor(text: str) -> Sensor:
    """A sensor by its name, or from a JSON file of its fields.

    Raises InputError for an unknown name, a file that is not there, or fields that do not fit together.
    """
    presets = known()
    if text in presets:
        return presets[text]
    path = Path(text)
    if not path.is_file():
        raise InputError(f"expected a sensor, one of {', '.join(presets)}, or a JSON file of its fields; came {text!r}")
    try:
        return Sensor.model_validate_json(path.read_text(encoding="utf-8"))
    except ValidationError as error:
        raise InputError(f"{path} does not describe a sensor: {_wrong(error, {})}") from error
    except (ValueError, OSError) as error:
        raise InputError(f"{path} cannot be read as a sensor's: {error}") from error


def _wrong(error: ValidationError, fields: Mapping[str, Any]) -> str:
    """What is wrong with the fields of a sensor, in one sentence."""
    found = error.errors(include_url=False)
    lacking = [str(each["loc"][0]) for each in found if each["type"] == "missing"]
    wrong = [
        f"{'.'.join(map(str, each['loc']))}{': ' * bool(each['loc'])}{each['msg'].removeprefix('Value error, ')}"
        + f"; came {each['input']!r:.60}" * bool(each["loc"])
        for each in found
        if each["type"] != "missing"
    ]
    if lacking:
        whose = f"sensor {fields['name']!r:.60}" if "name" in fields else "a sensor"
        given = f"{', '.join(lacking[:-1])} and {lacking[-1]}" if len(lacking) > 1 else lacking[0]
        wrong.append(f"{whose} needs {given}, too: `scroll-tactile sensor FILES` guesses them from recordings of it")
    return "; ".join(wrong)
