"""The page of a recording: what a file has, how steady its clock is, and whether its channels are well."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from os import PathLike, fspath
from pathlib import PurePosixPath
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile import __version__
from scroll_tactile.clients.report.channels import (
    DEAD,
    DRIFTING,
    SATURATED,
    ChannelSummary,
    card_of,
    channels_of,
    level_picture,
    state_rows,
)
from scroll_tactile.clients.report.drawing import FIRST_DATE, MOST_TRACES, counted_from, dated, histogram, shown, trace
from scroll_tactile.clients.report.page import Card, State, cards, figure, lines, note, page, side_by_side, table
from scroll_tactile.errors import FieldError, InputError, printable
from scroll_tactile.live.detector import contact_spans
from scroll_tactile.recordings import PRESETS, Contents, Interval, Recording, Touch, describe, read, touches
from scroll_tactile.recordings.guessing import guessed_sensor
from scroll_tactile.recordings.presets import find, names_for
from scroll_tactile.sensors import Sensor, known
from scroll_tactile.signals.facts import Fact, merged, touch_facts
from scroll_tactile.signals.levels import LEVELS, MISSING, LevelArray

__all__ = ["recording_page"]

FloatArray = npt.NDArray[np.float64]

_OPTION = re.compile(r"\b(rate|columns)='([^']*)'")  # of Python, which a command types otherwise

MOST_READINGS = 1_000_000  # in which contacts are looked for
STRETCHES = 40  # that a recording is cut into, to see in which of them a channel is still
MOST_ROWS = 60
MOST_TOUCHES = 1000
MARGIN = 0.1  # of the range that was seen, beyond it at both ends
LARGEST = 1e30  # of readings in which contacts are looked for
LOST = 0.001  # of the readings: more is worth a look


class Whose(NamedTuple):
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
            recording.numbers(sensor)
        return Whose(sensor, None, f"that of sensor {sensor.name}")
    if preset is not None:
        return Whose(find(preset).sensor, preset, f"that of preset {preset}")
    for entry in contents.entries:
        if (entry.topic, entry.field) == (recording.topic, recording.field):
            for name in names_for(entry.kind, entry.field, recording.readings.shape[1:]):
                return Whose(find(name).sensor, name, f"that of preset {name}, of messages {entry.kind}")
    return Whose(None, None, "")


class Cutting(NamedTuple):
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
    reasons = {
        "these are pictures.": sensor is not None and sensor.camera,
        f"it has more than {MOST_READINGS} readings.": len(recording) > MOST_READINGS,
        "readings are missing.": not np.isfinite(recording.readings).all(),
        "it has no clock (give --rate), or its numbers are no sensor's.": sensor is None,
    }
    why = next((why for why, holds in reasons.items() if holds), "")
    if sensor is None or why:
        why = f"Not cut: the file has no episodes or labels, and contacts are not looked for: {why}"
        return Cutting((), "contact", False, why)
    spans = contact_spans(sensor, None, recording.readings, [gap.index for gap in recording.report.gaps])
    why = "None were found by contact: for that it begins at rest, for two seconds or more. It may be one touch."
    if spans:
        why = "proposed by contact, as learn --cut contact takes them"
    return Cutting(touches(recording, lambda _: spans) if spans else (), "contact", False, why)


def learning(
    recording: Recording, path: str, whose: Whose, cut: Cutting, chosen: Mapping[str, Any], given: Mapping[str, str]
) -> str:
    """The command that learns it, to be copied, and what is to be put into it.

    chosen: as of `read`, with the field that was read. given: as of `recording_page`.
    """
    name = given.get("sensor") or next((name for name, sensor in known().items() if sensor == whose.sensor), None)
    missing = []
    words = ["scroll-tactile", "learn", "memory", path]
    if whose.preset is not None:
        words += ["--preset", whose.preset]
    else:
        words += ["--sensor", name or "sensor.json"]
        missing += [] if name else ["sensor.json, its name, channels, rate, low, high, unit and duration"]
    usual = None if whose.preset is None else PRESETS[whose.preset]
    field = chosen.get("field") if recording.topic is None else recording.field
    if recording.topic is not None and (usual is None or recording.topic != usual.topic):
        words += ["--topic", recording.topic]
    if field and (usual is None or recording.topic is None or field != usual.field):
        words += ["--field", field]
    options = [name for name in ("clock", "columns", "definitions") if chosen.get(name)]
    words += [word for name in options for word in (f"--{name}", str(chosen[name]))]
    if whose.preset is None and not name:
        missing[0] += f", which {shlex.join(['scroll-tactile', 'sensor', path, *words[6:]])} > sensor.json guesses"
    if cut.by == "labels":
        words += ["--labels", given.get("labels") or "labels.csv"]
        missing += [] if given.get("labels") else ["labels.csv, the table of its touches"]
    elif not cut.named:
        words += ["--cut", "contact"] if cut.by == "contact" and cut.touches else []
        words += ["--label", "MATERIAL"]
        missing.append("MATERIAL, what was touched")
    if any(printable(word) != word for word in words):
        return ""
    put_in = note(f" Put in: {'; '.join(missing)}.") if missing else ""
    return f"<h3>To learn it</h3>{lines([shlex.join(words)])}{put_in}"


def odd(recording: Recording, whose: Whose, cut: Cutting) -> str:
    """What is odd about it, by the rules that `learn` has, with their cures; of no known sensor by a guessed one."""
    facts: list[Fact] = []
    with suppress(InputError):  # pictures and missing values, of which the page says more elsewhere
        sensor = whose.sensor or guessed_sensor([recording])[0]
        facts += recording.facts(sensor)
        for touch in cut.touches[:MOST_TOUCHES] or touches(recording):
            part = replace(recording, readings=touch.readings, times=touch.times)
            facts += touch_facts(part.numbers(sensor))
    told = [_OPTION.sub(r"--\1 \2", replace(fact, source="").sentence) for fact in merged(facts)]
    return "".join(map(note, told)) or note("Nothing that learning would speak of.")


def recording_page(
    path: str | PathLike[str],
    *,
    sensor: Sensor | None = None,
    intervals: Sequence[Interval] | None = None,
    given: Mapping[str, str] | None = None,
    **chosen: Any,
) -> str:
    """One HTML page that shows what a recording holds; it needs no network and no script.

    sensor: whose readings they are, which gives channels their range; unless given that of the preset, or of the one
    that the messages' type is of. chosen: topic, field, preset and the others of `read`; where a file has several
    fields and none is named, the first is shown. intervals: of touches in it; unless given its episodes, or contacts.
    given: for the line that learns it, the name or file of the "sensor", and the file of the intervals, "labels".

    Raises what `describe` and `read` raise, ChannelCountError for a sensor of other channels, and InputError for both a
    sensor and a preset.
    """
    if sensor is not None and chosen.get("preset") is not None:
        raise InputError("give sensor= or preset=: both say whose readings they are", argument="sensor preset")
    contents = describe(path, definitions=chosen.get("definitions"))
    recording, chosen, why = _read(contents, fspath(path), chosen)
    whose = whose_readings(contents, recording, sensor, chosen.get("preset"))
    seen = _Seen.of(recording, whose.sensor)
    cut = cut_of(recording, intervals, whose.sensor or (None if seen is None else seen.sensor(recording)))
    words = learning(recording, fspath(path), whose, cut, chosen, given or {})
    sections = [
        ("signal", "Signal", side_by_side(_signal(recording, cut), f"<div>{_touches(recording, cut)}{words}</div>")),
        ("channels", "Channels", _channels(seen, whose)),
        ("odd", "What is odd", odd(recording, whose, cut)),
        ("time", "Time", _time(recording)),
        ("holds", "What the file has", _holds(contents)),
    ]
    where = f"topic <code>{shown(recording.topic)}</code>, " if recording.topic else ""
    shape = recording.readings.shape[1:]
    holds = f"{shape[0]} channels" if len(shape) == 1 else f"pictures of {' × '.join(map(str, shape))}"
    under = f"A recording. Shown: {where}field <code>{shown(recording.field)}</code>, {holds}.{why}"
    summary = cards([_length(recording), _clock(recording), _losses(recording), _state(recording, seen, whose)])
    made = f"Made {datetime.now(UTC):%Y-%m-%d %H:%M UTC} by scroll-tactile {shown(__version__)}"
    foot = f"{made} of <code>{shown(recording.source)}</code>."
    return page(PurePosixPath(recording.source).name, under, summary, sections, foot)


def _signal(recording: Recording, cut: Cutting) -> str:
    channels = int(np.prod(recording.readings.shape[1:]))
    of = f"The {MOST_TRACES} of {channels} channels that move most" if channels > MOST_TRACES else "All channels"
    parts = {
        "The mean of each picture" if recording.readings.ndim > 2 else of: True,
        ", each from its least to its most.": True,
        " Blue bands are touches.": cut.touches,
        " Red bands are gaps, in which nothing was read.": recording.report.gaps,
        " Across: the number of the reading, for it has no clock that goes on.": counted_from(recording)[1] != "s",
    }
    drawn = trace(recording, [(touch.begin, touch.end) for touch in cut.touches])
    return figure(drawn, "".join(part for part, holds in parts.items() if holds))


def _read(contents: Contents, path: str, chosen: dict[str, Any]) -> tuple[Recording, dict[str, Any], str]:
    """The recording, of the requested field or of the first there is; how it was read; and a sentence on that."""
    try:
        return read(path, **chosen), chosen, ""
    except FieldError:
        if any(chosen.get(name) for name in ("topic", "field", "preset")) or not contents.entries:
            raise
    first = contents.entries[0]
    chosen = chosen | {"topic": first.topic, "field": first.field}
    why = f" It is the first of {len(contents.entries)} below; --topic and --field choose another."
    return read(path, **chosen), chosen, why


def _steps(recording: Recording) -> FloatArray:
    """The seconds from each reading to the next, as far as they are known."""
    steps = np.diff(recording.times)
    return np.asarray(steps[np.isfinite(steps)])


def _length(recording: Recording) -> Card:
    steps, count = _steps(recording), len(recording)
    lasts = f", {steps[steps > 0].sum():.4g} s" if len(steps) else ""  # of an episode each, where times begin anew
    state: State = "look" if recording.report.cut_off else "good"
    whole = "The file ends before its end: what was whole was read." if state == "look" else "It was read to its end."
    return state if count else "bad", "How much", f"{count} readings{lasts}", whole


def _clock(recording: Recording) -> Card:
    report = recording.report
    if report.rate is None:
        return "none", "How steady", "no clock", "Its readings have no times: give --clock or --rate."
    share = (report.jitter or 0.0) * report.rate
    state: State = "bad" if report.backward else "look" if report.gaps or share > 0.2 else "good"
    longest = max((gap.seconds for gap in report.gaps), default=0.0)
    gaps = (
        f"{len(report.gaps)} gap{'s' * (len(report.gaps) > 1)}, the longest {longest:.3g} s" if longest else "no gaps"
    )
    back = f"; time goes back {report.backward} times" if report.backward else ""
    answer = f"{report.rate:.4g} Hz ± {max(1e3 * (report.jitter or 0), 0.001):.2g} ms"
    return state, "How steady", answer, f"By the clock {report.clock!r}: {gaps}{back}."


def _losses(recording: Recording) -> Card:
    report = recording.report
    none = report.lost is None
    counted = "No counter shows whether readings were lost." if none else "By the counter in its messages."
    parts = {"lost": report.lost or 0, "repeated": report.repeated, "without a stamp": report.unset}
    bad = sum(parts.values())
    if none and not bad:
        return "none", "What was lost", "not counted", counted
    answer = ", ".join(f"{count} {what}" for what, count in parts.items() if count) or "none lost"
    return "look" if bad > LOST * len(recording) else "good", "What was lost", answer, counted


class _Seen(NamedTuple):
    """The readings as levels (C, T), the range of each channel, (C,), and the channels."""

    levels: LevelArray
    low: FloatArray
    high: FloatArray
    channels: list[ChannelSummary]

    @classmethod
    def of(cls, recording: Recording, sensor: Sensor | None) -> _Seen | None:
        """None of pictures, and of a single reading. Without a sensor the range is what was seen, and a tenth more at
        both ends: nothing that lies there can be called saturated."""
        if recording.readings.ndim != 2 or len(recording) < 2:
            return None
        readings = np.asarray(recording.readings, dtype=np.float64)
        readings = np.where(np.isfinite(readings), readings, np.nan)
        limits = _range(readings) if sensor is None else sensor.limits
        low, high = (np.broadcast_to(limit, readings.shape[1:]).astype(np.float64) for limit in limits)
        shares = (readings / 2 - low / 2) / np.maximum(high / 2 - low / 2, np.finfo(np.float64).tiny)
        levels = np.rint(np.clip(np.nan_to_num(shares), 0, 1) * (LEVELS - 1)).astype(np.uint8)
        levels = np.ascontiguousarray(np.where(np.isnan(readings), np.uint8(MISSING), levels).T)
        parts = np.array_split(levels, max(1, min(STRETCHES, len(readings) // 2)), axis=1)
        signed = (low < 0) & (high > 0) & (sensor is not None)
        return cls(levels, low, high, channels_of(parts, signed, ordered=True))

    def sensor(self, recording: Recording) -> Sensor | None:
        """One that the readings could be of, for contacts; None where they have no rate, or numbers beyond reason."""
        low, high = float(self.low.min()), float(self.high.max())
        if recording.report.rate is None or max(-low, high) > LARGEST or not 1e-3 <= recording.report.rate <= 1e5:
            return None
        rate = float(f"{recording.report.rate:.4g}")
        return Sensor(
            name="own-sensor", channels=len(self.levels), rate=rate, low=low, high=high, unit="", duration=4.0
        )


def _range(readings: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The least and the most of each channel, and a tenth of what lies between beyond them; ±1 where nothing is."""
    read = np.isfinite(readings)
    low, high = np.where(read, readings, np.inf).min(axis=0), np.where(read, readings, -np.inf).max(axis=0)
    low, high = np.where(read.any(axis=0), low, 0.0), np.where(read.any(axis=0), high, 0.0)
    margin = np.where(high > low, MARGIN * high - MARGIN * low, 1.0)
    limit = np.finfo(np.float64).max / 2
    return np.clip(low - margin, -limit, limit), np.clip(high + margin, -limit, limit)


def _state(recording: Recording, seen: _Seen | None, whose: Whose) -> Card:
    if seen is None:
        return "none", "Channels", "not looked at", "Only rows of numbers have channels that can be dead."
    state, heading, answer, more = card_of(seen.channels, f"{len(recording)} readings")
    unranged = "" if whose.sensor is not None else " Their range is not known: whether one is saturated is not told."
    return state, heading, answer, more + unranged


def _channels(seen: _Seen | None, whose: Whose) -> str:
    if seen is None:
        return note("Not shown: these are pictures, or too few readings.")
    drawn = level_picture(
        seen.levels,
        "level of each channel over time",
        "Each row is a channel, 0 at the top; time runs to the right. Dark is the least mean level that the channel "
        "had, yellow the most: a dead channel is a stripe of one colour, a drifting one changes from left to right.",
    )
    saturated = f"Saturated: {SATURATED:.0%} of the readings lie at the end of the range, {whose.how}."
    if whose.sensor is None:
        saturated = (
            "The range of a channel is taken as what was seen of it and a tenth more, so that none can be called "
            "saturated: --sensor or --preset gives the true one."
        )
    words = (
        f"Dead: it never changes in {DEAD:.0%} of {STRETCHES} equal stretches of the recording. Drifting: its level "
        f"moves by {DRIFTING:.0%} of the range from begin to end. {saturated}"
    )
    return drawn + note(words) + state_rows(seen.channels, seen.low, seen.high, "")


def _time(recording: Recording) -> str:
    steps = _steps(recording)
    if not len(steps):
        return note("Not shown: its readings have no times. Give --clock, or --rate to count them.")
    longest = float(np.quantile(steps, 0.999)) * 1e3
    regular = steps[(steps >= 0) & (steps * 1e3 <= max(longest, 1e-9))] * 1e3
    high = float(regular.max(initial=0.0)) * 1.1 or 1.0
    counts, _ = np.histogram(regular, bins=60, range=(0, high))
    drawn = figure(
        histogram(counts.tolist(), high, "ms from a reading to the next", "readings"),
        "How long it takes from one reading to the next: one narrow peak is a steady clock, two are lost readings.",
    )
    longest_first, begin = sorted(recording.report.gaps, key=lambda gap: -gap.seconds), float(recording.times[0])
    rows = [[gap.index, f"{recording.times[gap.index - 1] - begin:.3f}", gap.seconds] for gap in longest_first]
    gaps = note("There are no gaps.")
    if rows:
        gaps = f"<h3>Gaps</h3>{table(['before reading', 'after (s)', 'lasts (s)'], rows[:MOST_ROWS], 'gaps')}"
    more = note(f"{len(rows) - MOST_ROWS} shorter gaps are left out.") if len(rows) > MOST_ROWS else ""
    first = note(f"It begins {dated(begin)} UTC.") if begin > FIRST_DATE else ""
    return drawn + first + gaps + more + "".join(map(note, recording.report.notes))


def _touches(recording: Recording, cut: Cutting) -> str:
    """The touches in it, and where each begins."""
    if not cut.touches:
        return f"<h3>Touches</h3>{note(cut.why)}"
    at, unit = counted_from(recording)
    rows = []
    for touch in cut.touches:
        begins, lasts = float(at[touch.begin]), float(at[touch.end - 1] - at[touch.begin])
        times = [begins, lasts] if unit == "s" else [None, None]
        rows.append([touch.material, touch.begin, touch.end - touch.begin, *times])
    header, counted = ["material", "from reading", "readings", "begins (s)", "lasts (s)"], f"{len(rows)} touches"
    own = slice(None) if cut.named else slice(1, None)
    listed = table(header[own], [row[own] for row in rows[:MOST_TOUCHES]], "touches")
    names = len({touch.material for touch in cut.touches})
    counted += f" of {names} names." if cut.named else f", {cut.why}."
    return f"<h3>Touches</h3>{note(counted)}{listed}"


def _holds(contents: Contents) -> str:
    rows = [
        [entry.topic, entry.field, " × ".join(map(str, entry.shape)) or "1", entry.count, entry.rate, entry.kind]
        for entry in contents.entries
    ]
    looked = f"Rates and counts {contents.looked}." if contents.looked else "All numbers in the file."
    return note(looked) + table(["topic", "field", "shape", "readings", "Hz", "type"], rows, "contents")
