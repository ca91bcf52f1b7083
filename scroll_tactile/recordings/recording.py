"""A recording: readings with their times, the episodes in them, and a report of what a file had."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import ChannelCountError, InputError
from scroll_tactile.recordings.blocks import Block, Source
from scroll_tactile.recordings.clocks import lost
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["Episode", "Gap", "Recording", "Report", "assemble", "resampled"]

_GAP = 0.1  # seconds without a reading that make a gap …
_STEPS = 5  # … and as many steps, for sensors that are slower than 50 Hz


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
    cut_off: whether the file ends before its end. resampled: the rate in Hz that was asked for, and how.
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
    """

    source: str
    topic: str | None
    field: str
    readings: npt.NDArray[Any]
    times: npt.NDArray[np.float64]
    episodes: tuple[Episode, ...]
    report: Report

    def __len__(self) -> int:
        return len(self.readings)

    @property
    def place(self) -> str:
        """What is read, as errors name it."""
        return f"field {self.field!r:.80} of {self.source}" if self.field else self.source

    def cure(self, sensor: Sensor) -> str:
        """What to do where these are not the sensor's readings."""
        wider = self.readings.ndim == 2 and self.readings.shape[1] > sensor.channels
        some = f" Some of its columns are taken by columns='0:{sensor.channels}'" if wider else ""
        return f"Is it another sensor's recording, or another field?{some}"

    def stream(self, sensor: Sensor) -> Stream:
        """All readings as one stream of `sensor`.

        Raises ChannelCountError where they come from another sensor, and whatever `validate` raises.
        """
        shape = self.readings.shape[1:]
        if shape != sensor.shape and int(np.prod(shape)) != sensor.channels:
            raise ChannelCountError(
                f"expected readings of sensor {sensor.name!r}, {sensor.channels} channels; {self.place} has {shape}. "
                f"{self.cure(sensor)}"
            )
        return validate(self.readings.reshape(len(self), *sensor.shape), sensor)


def assemble(
    block: Block, clock: str | None, source: Source
) -> tuple[npt.NDArray[Any], npt.NDArray[np.float64], tuple[Episode, ...], Report]:
    """Readings, times by this clock, episodes and the report, from one block."""
    order = _order(block)
    readings = block.readings if order is None else block.readings[order]
    clocks = {name: times if order is None else times[order] for name, times in block.clocks.items()}
    counters = {name: counts if order is None else counts[order] for name, counts in block.counters.items()}
    numbers = block.episodes if order is None or block.episodes is None else block.episodes[order]
    episodes = _spans(clocks["log"], source.marks) if source.marks else _runs(numbers, source.names)
    begins = [] if source.marks or source.continuous else [episode.begin for episode in episodes if episode.begin]
    borders = np.array(begins, np.int64)
    times = np.full(len(readings), np.nan) if clock is None else clocks[clock]
    unset = int(np.count_nonzero(clocks["header"] == 0)) if "header" in clocks else 0
    return readings, times, episodes, _report(times, clock, counters, borders, unset)


def _order(block: Block) -> npt.NDArray[np.int64] | None:
    """How to sort readings by the time they were logged, as all players do; None where they are."""
    logged = block.clocks.get("log")
    if logged is None or not (np.diff(logged) < 0).any():
        return None
    return np.argsort(logged, kind="stable")


def _runs(numbers: npt.NDArray[np.int64] | None, names: dict[int, str]) -> tuple[Episode, ...]:
    if numbers is None or not len(numbers):
        return ()
    borders = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
    return tuple(Episode(begin, end, names.get(int(numbers[begin]))) for begin, end in itertools.pairwise(borders))


def _spans(logged: npt.NDArray[np.float64], marks: list[tuple[float, str]]) -> tuple[Episode, ...]:
    """A label holds from its message to the next; an empty one ends it, and the same again goes on with it."""
    kept: list[tuple[float, str]] = []
    for seconds, text in sorted(marks, key=lambda mark: mark[0]):
        if not kept or kept[-1][1] != text.strip():
            kept.append((seconds, text.strip()))
    begins = np.searchsorted(logged, [seconds for seconds, _ in kept])
    ends = [*begins[1:].tolist(), len(logged)]
    spans = zip(begins.tolist(), ends, kept, strict=True)
    return tuple(Episode(begin, end, text) for begin, end, (_, text) in spans if text and end > begin)


def _report(
    times: npt.NDArray[np.float64],
    clock: str | None,
    counters: dict[str, npt.NDArray[np.int64]],
    borders: npt.NDArray[np.int64],
    unset: int,
) -> Report:
    inside = np.ones(max(len(times) - 1, 0), bool)
    inside[borders[borders > 0] - 1] = False
    found = _lost(counters, borders)
    report = Report(len(times), clock, lost=None if found is None else found[0], unset=unset)
    repeated = 0 if found is None else found[1]
    steps = np.diff(times)
    if not (np.isfinite(steps) & inside).any():
        return replace(report, repeated=repeated)
    steps[~inside] = np.nan
    forward = steps[steps > 0]
    middle = float(np.median(forward)) if len(forward) else 0.0
    long = steps > max(_GAP, _STEPS * middle)
    usual = forward[forward <= min(max(_GAP, _STEPS * middle), 2 * middle)]
    return replace(
        report,
        rate=1 / middle if middle > 0 else None,
        jitter=float(usual.std()) if len(usual) else None,
        gaps=tuple(Gap(int(i) + 1, float(steps[i])) for i in np.flatnonzero(long)),
        repeated=repeated or int(np.count_nonzero(steps == 0)),
        backward=int(np.count_nonzero(steps < 0)),
    )


def _lost(counters: dict[str, npt.NDArray[np.int64]], borders: npt.NDArray[np.int64]) -> tuple[int, int] | None:
    """Lost and repeated readings by the device's counter, or else by the recorder's, if it counts each topic alone."""
    single = {name: int(np.count_nonzero(np.diff(counts) == 1)) for name, counts in counters.items()}
    for name in ("message", "sequence"):
        if name not in counters or len(counters[name]) < 2 or 2 * single[name] < len(counters[name]) - 1:
            continue  # what seldom goes on by one is no counter
        if name == "sequence" and single["all"] > single[name]:
            continue  # it counts all topics, so that nobody knows whose messages are lost
        found = [lost(part) for part in np.split(counters[name], borders)]
        return sum(gone for gone, _ in found), sum(again for _, again in found)
    return None


def resampled(recording: Recording, rate: float) -> Recording:
    """The recording at a steady `rate` in Hz: linear in time between readings, NaN inside gaps.

    Each episode has a grid of its own, from its first time on. A reading whose time is not after the one before it is
    left out. Between two readings more than 0.1 s and five steps apart there is no line but NaN, which a sensor with
    non_finite="missing" takes. Pictures are not interpolated.

    Raises InputError for pictures, for a recording without a clock, and for a rate that is no positive number or would
    make over a hundred times as many readings.
    """
    if not rate > 0 or not np.isfinite(rate):
        raise InputError(f"expected a positive rate in Hz to resample to; came {rate!r}")
    if recording.readings.ndim != 2 or not np.isfinite(recording.times).all():
        what = "pictures" if recording.readings.ndim != 2 else "no clock: give clock= or rate="
        raise InputError(f"{recording.source} cannot be resampled: it has {what}")
    whole = [Episode(0, len(recording))] if len(recording) else []
    parts, times, episodes = [], [], []
    borders = sorted({0, len(recording), *(e.begin for e in recording.episodes), *(e.end for e in recording.episodes)})
    starts = {}
    pieces = itertools.pairwise(borders) if recording.episodes else ((e.begin, e.end) for e in whole)
    done = 0
    for begin, end in pieces:
        grid, values = _line(recording.times[begin:end], recording.readings[begin:end], rate)
        parts.append(values)
        times.append(grid)
        starts[begin] = done, done + len(grid)
        done += len(grid)
    for episode in recording.episodes:
        inside = [span for begin, span in starts.items() if episode.begin <= begin < episode.end]
        episodes.append(Episode(inside[0][0], inside[-1][1], episode.name))
    readings = np.concatenate(parts) if parts else recording.readings
    note = f"resampled to {rate:g} Hz, linear in time, from {len(recording)} readings"
    report = replace(recording.report, readings=len(readings), resampled=note)
    all_times = np.concatenate(times) if times else recording.times
    return replace(recording, readings=readings, times=all_times, episodes=tuple(episodes), report=report)


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
    long = steps[before] > max(_GAP, _STEPS * float(np.median(steps)))
    values[long & (share[:, 0] > 0) & (share[:, 0] < 1)] = np.nan
    return grid, values
