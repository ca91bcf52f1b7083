"""A recording: readings with their times, the episodes in them, and a report; resampled, or of some columns alone."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import ChannelCountError, FieldError, InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream, validate

__all__ = [
    "Episode",
    "Gap",
    "Recording",
    "Report",
    "longest_step",
    "only_columns",
    "places",
    "require_columns",
    "resampled",
]

_GAP = 0.1  # seconds without a reading that make a gap …
_STEPS = 5  # … and as many steps, for sensors that are slower than 50 Hz

_PART = re.compile(r"(\d{1,9})|(\d{1,9})?:(\d{1,9})?", re.ASCII)


def longest_step(step: float) -> float:
    """Seconds between two readings from which on there is a gap, where the median step is `step` seconds."""
    return max(_GAP, _STEPS * step)


@dataclass(frozen=True)
class Episode:
    """Readings [begin, end) of a recording, and what they are called; None where nothing names them."""

    begin: int
    end: int
    name: str | None = None


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
    rate: in Hz, of the median step; None without a clock. jitter: standard deviation of the steps in seconds, those of
    gaps, of lost readings and of time going back left out.
    gaps: pauses of more than 0.1 s and of five steps. lost: readings that a counter says were sent and are not there;
    None where nothing counts. repeated: readings with the count, or the time, of the one before.
    backward: how often time goes back inside an episode.
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
    backward: int = 0
    unset: int = 0
    cut_off: bool = False
    resampled: str | None = None
    notes: tuple[str, ...] = ()

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
    """

    source: str
    topic: str | None
    field: str
    readings: npt.NDArray[Any]
    times: npt.NDArray[np.float64]
    episodes: tuple[Episode, ...]
    report: Report
    annotations: Mapping[str, npt.NDArray[Any]] = dataclasses.field(default_factory=dict)

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

    def stream(self, sensor: Sensor) -> Stream:
        """All readings as one stream of `sensor`.

        Raises ChannelCountError where they come from another sensor, and whatever `validate` raises.
        """
        shape = self.readings.shape[1:]
        if shape != sensor.shape and int(np.prod(shape)) != sensor.channels:
            raise ChannelCountError(
                f"expected readings of sensor {sensor.name!r}, {sensor.channels} channels; {self.place} has {shape}. "
                f"{self.cure(sensor)}",
                argument="columns",
            )
        return validate(self.readings.reshape(len(self), *sensor.shape), sensor)


def resampled(recording: Recording, rate: float) -> Recording:
    """The recording at a steady `rate` in Hz: linear in time between readings, NaN inside gaps.

    Each episode has a grid of its own, from its first time on. A reading whose time is not after the one before it is
    left out. Between two readings more than 0.1 s and five steps apart there is no line but NaN, which a sensor with
    non_finite="missing" takes. Pictures are not interpolated.

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
    borders = sorted({0, len(recording), *(e.begin for e in recording.episodes), *(e.end for e in recording.episodes)})
    spans = itertools.pairwise(borders)
    lines = [_line(recording.times[begin:end], recording.readings[begin:end], rate) for begin, end in spans]
    lengths = itertools.accumulate((len(grid) for grid, _ in lines), initial=0)
    begins = dict(zip(borders, lengths, strict=True))
    episodes = tuple(Episode(begins[e.begin], begins[e.end], e.name) for e in recording.episodes)
    readings = np.concatenate([values for _, values in lines]) if lines else recording.readings
    note = f"resampled to {rate:g} Hz, linear in time, from {len(recording)} readings"
    report = replace(recording.report, readings=len(readings), resampled=note)
    times = np.concatenate([grid for grid, _ in lines]) if lines else recording.times
    return replace(recording, readings=readings, times=times, episodes=episodes, report=report)


def _line(
    times: npt.NDArray[np.float64], readings: npt.NDArray[Any], rate: float
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
    long = steps[before] > longest_step(float(np.median(steps)))
    values[long & (share[:, 0] > 0) & (share[:, 0] < 1)] = np.nan
    return grid, values


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
    return replace(recording, readings=recording.readings[:, chosen])
