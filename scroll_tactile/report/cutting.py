"""Whose readings a recording has, which touches are in it, and the command that learns them."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scroll_tactile.errors import InputError, printable
from scroll_tactile.live.spans import contact_spans
from scroll_tactile.recordings import PRESETS, Contents, Interval, Recording, Touch, touches
from scroll_tactile.recordings.presets import find, names_for
from scroll_tactile.report.page import lines, note
from scroll_tactile.sensors import Sensor, known

__all__ = ["Cutting", "Whose", "cut_of", "learning", "whose_readings"]

MOST_READINGS = 1_000_000  # in which contacts are looked for


@dataclass(frozen=True)
class Whose:
    """The sensor of a recording, None where nothing says it; the preset it is of; and how that is known, in words."""

    sensor: Sensor | None
    preset: str | None
    how: str


def whose_readings(contents: Contents, recording: Recording, sensor: Sensor | None, preset: str | None) -> Whose:
    """The sensor that was given, or the preset's, or the one whose messages these are.

    Raises ChannelCountError for a sensor of other channels.
    """
    if sensor is not None:
        if recording.readings[:1].size != sensor.channels:
            recording.stream(sensor)
        return Whose(sensor, None, f"that of sensor {sensor.name}")
    if preset is not None:
        return Whose(find(preset).sensor, preset, f"that of preset {preset}")
    for entry in contents.entries:
        if (entry.topic, entry.field) == (recording.topic, recording.field):
            for name in names_for(entry.kind, entry.field, recording.readings.shape[1:]):
                return Whose(find(name).sensor, name, f"that of preset {name}, of messages {entry.kind}")
    return Whose(None, None, "")


@dataclass(frozen=True)
class Cutting:
    """The touches in a recording; whether it names them; and how they were found, or why there are none."""

    touches: tuple[Touch, ...]
    named: bool
    why: str


def cut_of(recording: Recording, intervals: Sequence[Interval] | None, sensor: Sensor | None) -> Cutting:
    """Touches by a table, by episodes, or else by contact. sensor: of the readings, as far as it is known."""
    if intervals is not None or recording.episodes:
        try:
            return Cutting(touches(recording, "episodes" if intervals is None else intervals), True, "")
        except InputError as error:
            return Cutting((), False, f"Not cut: {error}")
    if sensor is None or sensor.camera or len(recording) > MOST_READINGS or not np.isfinite(recording.readings).all():
        why = "Not cut: the file has no episodes or labels, and contacts are not looked for: "
        return Cutting((), False, why + _why_not(recording, sensor))
    spans = contact_spans(sensor, None, recording.readings, [gap.index for gap in recording.report.gaps])
    if not spans:
        why = "None were found by contact: for that it begins at rest, for two seconds or more. It may be one touch."
        return Cutting((), False, why)
    return Cutting(touches(recording, lambda _: spans), False, "proposed by contact, as learn --cut contact takes them")


def _why_not(recording: Recording, sensor: Sensor | None) -> str:
    if sensor is not None and sensor.camera:
        return "these are pictures."
    if len(recording) > MOST_READINGS:
        return f"it has more than {MOST_READINGS} readings."
    if not np.isfinite(recording.readings).all():
        return "readings are missing."
    return "it has no clock (give --rate), or its numbers are no sensor's."


def learning(recording: Recording, path: str, whose: Whose, cut: Cutting, chosen: Mapping[str, Any]) -> str:
    """The command that learns it, to be copied, and what is to be put into it."""
    words, missing = ["scroll-tactile", "learn", "memory", path], []
    if whose.preset is not None:
        words += ["--preset", whose.preset]
        if recording.topic is not None and recording.topic != PRESETS[whose.preset].topic:
            words += ["--topic", recording.topic]
    else:
        name = next((name for name, sensor in known().items() if sensor == whose.sensor), None)
        words += ["--sensor", name or "sensor.json"]
        missing += [] if name else ["sensor.json, its name, channels, rate, low, high, unit and duration"]
        words += ["--topic", recording.topic] if recording.topic is not None else []
        words += ["--field", recording.field] if recording.topic is not None or chosen.get("field") else []
    words += ["--clock", str(chosen["clock"])] if chosen.get("clock") else []
    if not cut.named:
        words += ["--cut", "contact"] if cut.touches else []
        words += ["--label", "MATERIAL"]
        missing += ["MATERIAL, what was touched"]
    if any(printable(word) != word for word in words):
        return ""
    what = f" Put in: {'; '.join(missing)}." if missing else ""
    return f"<h3>To learn it</h3>{lines([shlex.join(words)])}{note(what) if what else ''}"
