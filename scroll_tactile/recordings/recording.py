"""A recording: readings with their times, the episodes in them, and a report; resampled, or of some columns alone."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import ChannelCountError, FieldError, InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.facts import RULES, Fact, judged, warn_of
from scroll_tactile.signals.stream import Stream, validate

__all__ = [
    "Episode",
    "Gap",
    "Recording",
    "Report",
    "in_order",
    "longest_step",
    "only_columns",
    "places",
    "require_columns",
    "resampled",
]

_GAP = 0.1  # seconds without a reading that make a gap …
_STEPS = 5  # … and as many steps, for sensors that are slower than 50 Hz
_SHOWN = 8  # names of columns in a sentence

_PART = re.compile(r"(\d{1,9})|(\d{1,9})?:(\d{1,9})?", re.ASCII)


def longest_step(step: float) -> float:
    """Seconds between two readings from which on there is a gap, where the median step is `step` seconds."""
    return max(_GAP, _STEPS * step)


@dataclass(frozen=True)
class Episode:
    """Readings [begin, end) of a recording, and what they are called; None where nothing names them.

    path: where in the file they lie, such as "run/felt/1/tactile", where a pattern found them.
    """

    begin: int
    end: int
    name: str | None = None
    path: str = ""


@dataclass(frozen=True)
class Gap:
    """A pause: `seconds` pass before the reading of this index."""

    index: int
    seconds: float


@dataclass(frozen=True)
class Report:
    """What a file had, besides its readings.

    readings: how many. clock: whose times they have: "device", "header", "publish", "log", a column or field's name,
    "rate" where they were counted at a rate that was given, or None where there is no time.
    rate: in Hz, of the mean of the steps around the median step; of all where messages come in batches, or most stamps
    are that of the one before; None without a clock. jitter: standard deviation of the steps in seconds, those of gaps,
    of lost readings and of time going back left out.
    gaps: pauses of more than 0.1 s and of five steps. lost: readings that a counter says were sent and are not there;
    None where nothing counts. repeated: readings with the count, or the time, of the one before.
    back: where time goes back inside an episode, and by how much; backward: how often.
    unset: stamps of zero in a header, whose clock is then not used.
    cut_off: whether the file ends before its end. resampled: the requested rate in Hz, and how.
    notes: further sentences.
    """

    readings: int
    clock: str | None
    rate: float | None = None
    jitter: float | None = None
    gaps: tuple[Gap, ...] = ()
    lost: int | None = None
    repeated: int = 0
    unset: int = 0
    cut_off: bool = False
    resampled: str | None = None
    notes: tuple[str, ...] = ()
    back: tuple[Gap, ...] = ()

    @property
    def backward(self) -> int:
        """How often time goes back inside an episode."""
        return len(self.back)

    def facts(self, sensor: Sensor, source: str) -> list[Fact]:
        """What is odd about it, as of a recording of `sensor`: its times, what is lost, what its reader noted."""
        own = None if self.clock in (None, "rate") else self.rate
        ticks = self.readings - self.repeated  # of a clock that has a stamp for many readings, such as whole seconds
        loose = 1 / max(ticks - 1, 1) if 2 * self.repeated > self.readings else 0.0
        off = 0.0 if own is None else round(abs(own / sensor.rate - 1) - loose, 6)
        facts = judged("rate", off, source, rate=own, own=sensor.rate, sensor=sensor.name, step=1 / sensor.rate)
        for kind, pauses, count in (
            ("gap", self.gaps, "1 gap" if len(self.gaps) == 1 else f"{len(self.gaps)} gaps"),
            ("back", self.back, "once" if self.backward == 1 else f"{self.backward} times"),
        ):
            longest = max(pauses, key=lambda pause: pause.seconds, default=Gap(0, 0.0))
            words = {"count": count, **vars(longest)}
            facts += judged(kind, longest.seconds * sensor.rate, source, **words)
        for kind, counted in (("lost", self.lost or 0), ("repeated", self.repeated), ("unset", self.unset)):
            share = counted / max(self.readings + counted * (kind == "lost"), 1)
            facts += judged(kind, share, source, count=counted, share=100 * share)
        facts += judged("cut off", int(self.cut_off), source)
        return facts + [fact for note in self.notes for fact in judged("note", 1, source, text=note)]

    def __str__(self) -> str:
        rate = "no clock" if self.rate is None else f"{self.rate:.4g} Hz, jitter {1e3 * (self.jitter or 0):.2g} ms"
        parts = [f"{self.readings} readings", f"{rate} (clock: {self.clock})"]
        if self.gaps:
            parts.append(f"{len(self.gaps)} gaps, the longest {max(gap.seconds for gap in self.gaps):.3g} s")
        counts = {"lost": self.lost, "repeated": self.repeated, "times back": self.backward, "stamps unset": self.unset}
        parts += [f"{count} {what}" for what, count in counts.items() if count]
        parts += [self.resampled] if self.resampled else []
        return "; ".join([*parts, *(["cut off"] if self.cut_off else []), *self.notes])


@dataclass(frozen=True, eq=False)
class Recording:
    """Readings out of a file.

    source: the file's address. topic, field: where in it; topic is None where a format has none.
    readings: shape (T, n), float32 where that holds the source's numbers exactly and float64 otherwise; pictures are
        uint8 of shape (T, height, width, 3).
    times: seconds by the clock in the report, float64 of shape (T,); NaN where there is no clock and no rate was given.
    episodes: begin, end and name of each, in order; a label's span is one, too. Empty where the file has none.
    annotations: by heading, the columns that say something of touches: numbers, float64, or texts, of shape (T,).
    names: of the columns that are its channels; empty where they have none, or were taken by their places.
    """

    source: str
    topic: str | None
    field: str
    readings: npt.NDArray[Any]
    times: npt.NDArray[np.float64]
    episodes: tuple[Episode, ...]
    report: Report
    annotations: Mapping[str, npt.NDArray[Any]] = dataclasses.field(default_factory=dict)
    names: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.readings)

    @property
    def place(self) -> str:
        """What is read, as errors name it."""
        return f"field {self.field!r:.80} of {self.source}" if self.field else self.source

    def cure(self, sensor: Sensor) -> str:
        """What to do where these are not the sensor's readings."""
        wider = self.readings.ndim == 2 and self.readings.shape[1] > sensor.channels
        low = 0
        if wider and len(self) > 1:
            first, second = (np.diff(self.readings[:, i]) for i in (0, 1))
            if (first >= 0).all() and first.any() and not (second > 0).all():  # as times do, which are no channel
                low = self.readings.shape[1] - sensor.channels
        some = f" Some of its columns are taken by columns='{low}:{low + sensor.channels}'" if wider else ""
        return f"Is it another sensor's recording, or another field?{some}"

    def facts(self, sensor: Sensor) -> list[Fact]:
        """What is odd about it, as a recording of `sensor`."""
        return self.report.facts(sensor, self.source)

    def breaks(self, sensor: Sensor) -> list[int]:
        """The readings before which it is cut: behind a gap of more than ten readings, or a step back by as many."""
        rules = (("gap", self.report.gaps), ("back", self.report.back))
        return sorted(at.index for kind, of in rules for at in of if at.seconds * sensor.rate > RULES[kind].more)

    def stream(self, sensor: Sensor, *, rate: Literal["keep", "resample"] | None = None) -> Stream:
        """All readings as one stream of `sensor`. Warns by a FactWarning of what is odd about it.

        Channels that have names are taken by those of the sensor's columns, where it has some.
        rate: "keep" takes the numbers as they are, whatever their times say; "resample" one each step of the sensor's.

        Raises ChannelCountError where they come from another sensor, RecordingError where they have another rate, or a
        gap of more than ten readings or a step back by as many, and whatever `validate` and `resampled` raise.
        """
        ordered, facts = in_order(self, sensor.columns or (), f"sensor {sensor.name!r}")
        for fact in [*facts, *self.facts(sensor)]:
            if (fact.kind == "rate" and rate is not None) or (fact.argument == "rate" and rate == "keep"):
                continue
            if fact.then != "said":
                raise fact.error()
            warn_of(fact)
        return (ordered if rate != "resample" else resampled(ordered, sensor.rate, ())).numbers(sensor)

    def numbers(self, sensor: Sensor) -> Stream:
        """As `stream`, whatever is odd about it."""
        shape = self.readings.shape[1:]
        if shape != sensor.shape and int(np.prod(shape)) != sensor.channels:
            raise ChannelCountError(
                f"expected readings of sensor {sensor.name!r}, {sensor.channels} channels; {self.place} has {shape}. "
                f"{self.cure(sensor)}",
                argument="columns",
            )
        return validate(self.readings.reshape(len(self), *sensor.shape), sensor)


def resampled(recording: Recording, rate: float, breaks: Sequence[int] | None = None) -> Recording:
    """The recording at a steady `rate` in Hz: linear in time between readings, NaN inside gaps.

    Each episode has a grid of its own, from its first time on. A reading whose time is not after the one before it is
    left out. Between two readings more than 0.1 s and five steps apart there is no line but NaN, which a sensor with
    non_finite="missing" takes. Pictures are not interpolated.
    breaks: with them a grid begins before each of these readings, as `Recording.breaks` has them, and lines go over all
    other gaps.

    Raises InputError for pictures, for a recording without a clock or with annotations, and for a rate that is no
    positive number or would make over a hundred times as many readings.
    """
    if not rate > 0 or not np.isfinite(rate):
        raise InputError(f"expected a positive rate in Hz to resample to; came {rate!r}")
    if recording.readings.ndim != 2 or not np.isfinite(recording.times).all():
        what = "pictures" if recording.readings.ndim != 2 else "no clock: give clock= or rate="
        raise InputError(f"{recording.source} cannot be resampled: it has {what}", argument="clock rate")
    if recording.annotations:
        raise InputError(
            f"{recording.source} has annotations, one a reading: take resample=, or annotate=, not both",
            argument="resample annotate",
        )
    ends = (end for episode in recording.episodes for end in (episode.begin, episode.end))
    borders = sorted({0, len(recording), *ends, *(breaks or ())})
    spans, nowhere = itertools.pairwise(borders), breaks is None
    lines = [_line(recording.times[begin:end], recording.readings[begin:end], rate, nowhere) for begin, end in spans]
    lengths = itertools.accumulate((len(grid) for grid, _ in lines), initial=0)
    begins = dict(zip(borders, lengths, strict=True))
    episodes = tuple(replace(e, begin=begins[e.begin], end=begins[e.end]) for e in recording.episodes)
    readings = np.concatenate([values for _, values in lines]) if lines else recording.readings
    note = f"resampled to {rate:g} Hz, linear in time, from {len(recording)} readings"
    report = replace(
        recording.report,
        readings=len(readings),
        resampled=note,
        rate=rate,
        jitter=0.0,
        repeated=0,
        gaps=tuple(Gap(begins[gap.index], gap.seconds) for gap in recording.report.gaps if gap.index in begins),
        back=tuple(Gap(begins[back.index], back.seconds) for back in recording.report.back if back.index in begins),
    )
    times = np.concatenate([grid for grid, _ in lines]) if lines else recording.times
    return replace(recording, readings=readings, times=times, episodes=episodes, report=report)


def _line(
    times: npt.NDArray[np.float64], readings: npt.NDArray[Any], rate: float, nowhere: bool
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    latest = np.maximum.accumulate(times)
    kept = np.concatenate([[True], latest[1:] > latest[:-1]])
    times, readings = times[kept], readings[kept].astype(np.float64)
    # A step's rounding must not lose the last reading.
    count = int(np.floor((times[-1] - times[0]) * rate + 1e-6)) + 1
    if count > 100 * len(times) + 1000:
        raise InputError(f"{rate:g} Hz would make {count} readings of {len(times)}: give a lower rate")
    grid = times[0] + np.arange(count) / rate
    after = np.clip(np.searchsorted(times, grid, side="right"), 1, max(len(times) - 1, 1))
    if len(times) == 1:
        return grid, readings
    before, steps = after - 1, np.diff(times)
    share = np.clip((grid - times[before]) / steps[before], 0, 1)[:, None]
    values = readings[before] * (1 - share) + readings[after] * share
    if nowhere:
        long = steps[before] > longest_step(float(np.median(steps)))
        values[long & (share[:, 0] > 0) & (share[:, 0] < 1)] = np.nan
    return grid, values


def in_order(recording: Recording, names: Sequence[str], whose: str) -> tuple[Recording, list[Fact]]:
    """A recording whose channels are the columns of these names, in their order; and what is to be said of it.

    whose: who has the columns in this order. Raises RecordingError where one is not there.
    """
    own, names = recording.names, tuple(names)
    if not own or not names or own == names:
        return recording, []
    lacking, columns = [name for name in names if name not in own], f"0:{len(names)}"
    words = {"first": whose, "columns": columns, "lacking": _listed(lacking), "own": _listed(own)}
    if refused := judged("names", len(lacking), recording.source, **words):
        raise refused[0].error()
    readings = recording.readings[:, [own.index(name) for name in names]]
    return replace(recording, readings=readings, names=names), judged("columns", 1, recording.source, **words)


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(f"{name!r:.40}" for name in names[:_SHOWN]) + more


def require_columns(columns: str) -> list[re.Match[str]]:
    """The parts of a text that names columns. Raises FieldError for one that does not."""
    parts = columns.split(",")
    found = [match for part in parts if (match := _PART.fullmatch(part.strip()))]
    if len(found) < len(parts):
        raise FieldError(
            f"expected columns such as 25:44 or 0,3,5:9, counted from 0; came {columns!r:.80}", argument="columns"
        )
    return found


def places(columns: str, width: int) -> list[int]:
    """The columns that a text names, of `width`: counted from 0, a range without its end, as Python has it.

    Raises FieldError for a text that is none, and for columns that are not there.

    >>> places("0,3,5:9", 10)
    [0, 3, 5, 6, 7, 8]
    """
    found: list[int] = []
    for part in require_columns(columns):
        one, low, high = part.groups()
        begin, end = (int(one), int(one) + 1) if one else (int(low or 0), width if high is None else int(high))
        if begin >= end or end > width:
            raise FieldError(
                f"columns {part[0]} are not there: expected places from 0 to {width - 1}, a range without its end; "
                f"0:{width} are all",
                argument="columns",
            )
        found += range(begin, end)
    return found


def only_columns(recording: Recording, columns: str) -> Recording:
    """A recording of these of its columns, those of times, labels and an index not counted.

    Raises FieldError for a recording of pictures, and as `places` does.
    """
    if recording.readings.ndim != 2:
        raise FieldError(
            f"{recording.source} has pictures, which have no columns; came columns={columns!r:.80}", argument="columns"
        )
    try:
        chosen = places(columns, recording.readings.shape[1])
    except FieldError as error:
        raise FieldError(f"{recording.source}: {error}", argument=error.argument) from None
    return replace(recording, readings=recording.readings[:, chosen], names=())  # by place, whatever they are called
