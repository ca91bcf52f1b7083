"""Where known tactile sensors keep their numbers: the topic, the field, and the sensor with its range.

Topic and field are those of its messages; of a file without topics, such as `.npy`, a preset is only its sensor.

Ranges are what a driver's type and data sheet allow, in its own units. Where a preset's range is wider than what a
sensor sends in use, a `Sensor` of one's own with the range seen resolves more.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass

from scroll_tactile.errors import FieldError, InputError
from scroll_tactile.recordings.paths import FieldPath, nearest
from scroll_tactile.sensors import CONTACTILE, Sensor

__all__ = ["PRESETS", "Preset", "definitions", "fields_for", "find", "is_known", "names_for"]


@dataclass(frozen=True)
class Preset:
    """A known sensor under its driver.

    sensor: what its readings are. topic: as its driver names it; None where that is up to the robot.
    field: the path to its numbers. types: the messages it is sent in, by their name after the package, in lower case.
    """

    sensor: Sensor
    topic: str | None
    field: str
    types: tuple[str, ...]

    def sized(self, channels: int) -> Sensor:
        """The sensor with as many channels as a recording has: pads are sold in several sizes."""
        if channels == self.sensor.channels:
            return self.sensor
        return self.sensor.model_copy(update={"channels": channels, "layout": None})


def _biotac(name: str, electrodes: int) -> Preset:
    sensor = Sensor(name=name, channels=electrodes, rate=100.0, low=0.0, high=4095.0, unit="counts", duration=4.0)
    return Preset(sensor, "/rh/tactile", "tactiles[0].electrodes", ("biotacall",))


def _camera(name: str, rate: float) -> Preset:
    sensor = Sensor(
        name=name,
        channels=320 * 240 * 3,
        rate=rate,
        low=0.0,
        high=255.0,
        unit="counts",
        duration=1.0,
        layout=(320, 240, 3) if name == "digit" else (240, 320, 3),
        camera=True,
    )
    return Preset(sensor, None, "data", ())


_USKIN = Sensor(name="xela-uskin", channels=48, rate=100.0, low=0.0, high=65535.0, unit="counts", duration=4.0)
_ANYSKIN = Sensor(name="anyskin", channels=15, rate=50.0, low=-5000.0, high=5000.0, unit="µT", duration=4.0)
_ROBOTIQ = Sensor(name="robotiq-tsf", channels=56, rate=60.0, low=0.0, high=65535.0, unit="counts", duration=4.0)

PRESETS = {
    "biotac": _biotac("biotac-electrodes", 19),
    "biotac-sp": _biotac("biotac-sp", 24),
    "xela-uskin": Preset(_USKIN, None, "sensors[0].taxels[*].{x,y,z}", ("sensstream",)),
    "papillarray": Preset(CONTACTILE, "/hub_0/sensor_0", "pillars[*].{fX,fY,fZ}", ("sensorstate",)),
    "anyskin": Preset(_ANYSKIN, None, "data", ()),
    # Its driver's clock, /TactileSensor/Timestamp, is of no use here: two counts of 16 bits, one of each finger, that
    # wrap, in messages of their own. Readings go by when they were logged.
    "robotiq-tsf": Preset(_ROBOTIQ, "/TactileSensor/StaticData", "taxels[*].values", ("staticdata",)),
    "digit": _camera("digit", 30.0),
    "gelsight": _camera("gelsight-mini", 25.0),
}
"""The presets by name."""

# Further fields of known messages that are worth listing first.
_ALSO = {"tactilestate": ("sensors[*].values",), "float32multiarray": ("data",), "float64multiarray": ("data",)}

# What is in drivers' messages, for bags that do not define them, as before ROS 2 Iron: by the name of what is sent,
# that and its parts. What stands in parentheses is in some versions of a driver alone.
_MESSAGES = {
    "BiotacAll": "BiotacAll: std_msgs/Header header; Biotac[5] tactiles | Biotac: int16 pac0; int16 pac1; "
    "(int16[] pac;) int16 pdc; int16 tac; int16 tdc; int16[] electrodes",
    "SensStream": "SensStream: SensorFull[] sensors | SensorFull: uint32 message; float64 time; string model; "
    "uint8 sensor_pos; Taxel[] taxels; Forces[] forces | Taxel: uint16 x; uint16 y; uint16 z | "
    "Forces: float32 x; float32 y; float32 z",
    "SensorState": "SensorState: std_msgs/Header header; int64 tus; PillarState[] pillars; float32 gfx; float32 gfy; "
    "float32 gfz; float32 gtx; float32 gty; float32 gtz (; float32 friction_est; float32 target_grip_force; "
    "bool is_sd_active; bool is_ref_loaded) (; bool is_contact) | PillarState: (std_msgs/Header header;) int32 id; "
    "float32 dx; float32 dy; float32 dz; float32 fx; float32 fy; float32 fz; bool in_contact; int32 slip_state",
    "StaticData": "StaticData: Taxels[2] taxels | Taxels: uint16[28] values",
    "TactileState": "TactileState: std_msgs/Header header; sensor_msgs/ChannelFloat32[] sensors",
}


def definitions(kind: str) -> list[dict[str, str]]:
    """The .msg texts of a known driver's message and its parts, by name; one for each version, none where none is."""
    versions = [_MESSAGES[kind]] if kind in _MESSAGES else []
    while versions and "(" in versions[0]:
        versions = [re.sub(r"\((.*?)\)", kept, text, count=1) for text in versions for kept in (r"\1", "")]
    pairs = [[part.partition(":")[::2] for part in text.split("|")] for text in versions]
    return [{name.strip(): text.replace(";", "\n").strip() for name, text in version} for version in pairs]


def find(name: str) -> Preset:
    """The preset of this name; raises InputError, with the nearest, for one that is not there."""
    if name not in PRESETS:
        raise InputError(f"expected a preset; came {name!r}{nearest(name, list(PRESETS))}", argument="preset")
    return PRESETS[name]


def is_known(kind: str) -> bool:
    """Whether messages of this type are of a known tactile sensor."""
    return _short(kind) in _ALSO or any(_short(kind) in preset.types for preset in PRESETS.values())


def names_for(kind: str, field: str, shape: tuple[int, ...]) -> list[str]:
    """The presets of messages of this type whose field this is, and whose sensor has readings of this shape."""
    return [
        name
        for name, preset in PRESETS.items()
        if _short(kind) in preset.types and preset.field == field and preset.sensor.shape == shape
    ]


def fields_for(kind: str, message: object) -> list[tuple[str, tuple[int, ...]]]:
    """The fields that presets know in a message of this type, and the shapes of what they lead to."""
    texts = [preset.field for preset in PRESETS.values() if _short(kind) in preset.types]
    found = {}
    for text in (*texts, *_ALSO.get(_short(kind), ())):
        with suppress(FieldError):
            found[text] = FieldPath(text).reading(message).shape
    return [(text, shape) for text, shape in found.items() if shape != (0,)]


def _short(kind: str) -> str:
    return kind.rpartition("/")[2].lower()
