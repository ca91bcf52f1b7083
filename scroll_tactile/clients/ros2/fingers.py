"""Where the fingers' readings are, and whose memory they go to, by what parameters say."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from scroll_tactile.errors import InputError
from scroll_tactile.recordings import presets
from scroll_tactile.recordings.paths import FieldPath
from scroll_tactile.sensors import Sensor, read_sensor

__all__ = ["Finger", "fingers_of", "new_sensor"]

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)


@dataclass(frozen=True)
class Finger:
    """A finger: its name, "" of one alone, its topic, and the path to its numbers in a message."""

    name: str
    topic: str
    field: str


def fingers_of(topics: Sequence[str], fields: Sequence[str], names: Sequence[str], preset: str) -> list[Finger]:
    """The fingers that are meant; a topic or field alone is that of all.

    names: of several fingers; none: finger0, finger1, … preset: gives topic and field where they are not given.

    Raises InputError where topic or field is missing, for lists of different lengths, and for names that ROS cannot
    have in a topic or that come twice; FieldError for an unknown preset, and for a field that is no path.
    """
    known = presets.find(preset) if preset else None
    topics = topics or ([known.topic] if known is not None and known.topic else [])
    fields = fields or ([known.field] if known is not None and known.field else [])
    if not topics or not fields:
        what = " and ".join(f"{name}=" for name, given in (("topic", topics), ("field", fields)) if not given)
        raise InputError(
            f"expected {what}: where the readings are, such as topic='/rh/tactile' field='tactiles[0].electrodes'"
            + (f". Preset {preset!r} leaves the topic to the robot" if known else "; or preset= of a known sensor")
        )
    count = max(len(topics), len(fields), len(names))
    lists = {"topic": topics, "field": fields, "finger": names or [f"finger{i}" for i in range(count)]}
    for what, found in lists.items():
        if len(found) not in ((count,) if what == "finger" else (1, count)):
            raise InputError(f"expected {what} for each of {count} fingers, or one; came {len(found)}: {list(found)}")
    for name in names:
        if not _NAME.fullmatch(name) or list(names).count(name) > 1:
            raise InputError(f"expected fingers' names of letters, digits and _, each once; came {list(names)}")
    for field in fields:
        FieldPath(field)
    if count == 1 and not names:
        return [Finger("", topics[0], fields[0])]
    wide = [found if len(found) == count else [*found] * count for found in lists.values()]
    return [Finger(name, topic, field) for topic, field, name in zip(*wide, strict=True)]


def new_sensor(memory: Path, sensor: str, preset: str) -> Sensor | None:
    """The sensor that is named, "" for none; where there is no memory yet also that of a preset.

    Raises InputError for an unknown sensor, and where there is neither a memory nor a sensor to make one for.
    """
    if sensor:
        return read_sensor(sensor)
    if memory.exists():
        return None
    if preset:
        return presets.find(preset).sensor
    raise InputError(f"there is no memory in {memory}; to make one, say which sensor it is for: sensor= or preset=")
