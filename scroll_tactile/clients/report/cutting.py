"""Whose readings a recording has, which touches are in it, and the command that learns them."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from scroll_tactile.clients.report.page import lines, note
from scroll_tactile.errors import InputError, printable
from scroll_tactile.live.detector import contact_spans
from scroll_tactile.recordings import PRESETS, Contents, Interval, Recording, Touch, touches
from scroll_tactile.recordings.presets import find, names_for
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
    """The touches in a recording; by what it was cut; whether all have a name; and how they were found, or why there
    are none."""

    touches: tuple[Touch, ...]
    by: Literal["labels", "episodes", "contact"]
    named: bool
    why: str


def cut_of(recording: Recording, intervals: Sequence[Interval] | None, sensor: Sensor | None) -> Cutting:
    """Touches by a table, by episodes, or else by contact. sensor: of the readings, as far as it is known."""
    if intervals is not None or recording.episodes:
        by: Literal["labels", "episodes"] = "episodes" if intervals is None else "labels"
        try:
            found = touches(recording, "episodes" if intervals is None else intervals)
        except InputError as error:
            return Cutting((), by, False, f"Not cut: {error}")
        named = all(touch.material is not None for touch in found)
        return Cutting(found, by, named, "" if named else "its episodes, of which some have no name")
    if sensor is None or sensor.camera or len(recording) > MOST_READINGS or not np.isfinite(recording.readings).all():
        why = "Not cut: the file has no episodes or labels, and contacts are not looked for: "
        return Cutting((), "contact", False, why + _why_not(recording, sensor))
    spans = contact_spans(sensor, None, recording.readings, [gap.index for gap in recording.report.gaps])
    if not spans:
        why = "None were found by contact: for that it begins at rest, for two seconds or more. It may be one touch."
        return Cutting((), "contact", False, why)
    proposed = "proposed by contact, as learn --cut contact takes them"
    return Cutting(touches(recording, lambda _: spans), "contact", False, proposed)


def _why_not(recording: Recording, sensor: Sensor | None) -> str:
    if sensor is not None and sensor.camera:
        return "these are pictures."
    if len(recording) > MOST_READINGS:
        return f"it has more than {MOST_READINGS} readings."
    if not np.isfinite(recording.readings).all():
        return "readings are missing."
    return "it has no clock (give --rate), or its numbers are no sensor's."


def learning(
    recording: Recording, path: str, whose: Whose, cut: Cutting, chosen: Mapping[str, Any], given: Mapping[str, str]
) -> str:
    """The command that learns it, to be copied, and what is to be put into it.

    chosen: as of `read`, with the field that was read. given: as of `recording_page`.
    """
    sensor, no_sensor = _sensor_words(whose, given)
    naming, no_name = _naming_words(cut, given)
    words = ["scroll-tactile", "learn", "memory", path, *sensor, *_where(recording, whose, chosen), *naming]
    if any(printable(word) != word for word in words):
        return ""
    missing = [what for what in (no_sensor, no_name) if what]
    what = f" Put in: {'; '.join(missing)}." if missing else ""
    return f"<h3>To learn it</h3>{lines([shlex.join(words)])}{note(what) if what else ''}"


def _sensor_words(whose: Whose, given: Mapping[str, str]) -> tuple[list[str], str]:
    """The option that says whose readings they are, and what is to be put into it."""
    if whose.preset is not None:
        return ["--preset", whose.preset], ""
    name = given.get("sensor") or next((name for name, sensor in known().items() if sensor == whose.sensor), None)
    if name is not None:
        return ["--sensor", name], ""
    return ["--sensor", "sensor.json"], "sensor.json, its name, channels, rate, low, high, unit and duration"


def _where(recording: Recording, whose: Whose, chosen: Mapping[str, Any]) -> list[str]:
    """The options that say where its readings are, but for what the preset says."""
    usual = None if whose.preset is None else PRESETS[whose.preset]
    field = chosen.get("field") if recording.topic is None else recording.field
    words = []
    if recording.topic is not None and (usual is None or recording.topic != usual.topic):
        words += ["--topic", recording.topic]
    if field and (usual is None or recording.topic is None or field != usual.field):
        words += ["--field", field]
    for name in ("clock", "columns"):
        words += [f"--{name}", str(chosen[name])] if chosen.get(name) else []
    return words


def _naming_words(cut: Cutting, given: Mapping[str, str]) -> tuple[list[str], str]:
    """The options that say where its touches are and what names them, and what is to be put into these."""
    if cut.by == "labels":
        table = given.get("labels")
        return ["--labels", table or "labels.csv"], "" if table else "labels.csv, the table of its touches"
    if cut.named:
        return [], ""
    contact = ["--cut", "contact"] if cut.by == "contact" and cut.touches else []
    return [*contact, "--label", "MATERIAL"], "MATERIAL, what was touched"
