"""The figures of a page, each a drawing to scale."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt

from scroll_tactile.clients.report.drawing import LEFT, WIDTH, Axis, Drawing, brief, clipped_name
from scroll_tactile.recordings import Recording

__all__ = [
    "MOST_TRACES",
    "Bin",
    "against_truth",
    "answers",
    "confusions",
    "counted_from",
    "dated",
    "evidence",
    "histogram",
    "over_time",
    "reliability",
    "shares",
    "timeline",
    "trace",
    "tree",
]

FloatArray = npt.NDArray[np.float64]

ROW = 15.0  # units a row of names
LETTER = 7.0  # a letter's width, about
RIGHT = WIDTH - 15.0
FIRST_DATE = 1e8  # seconds since 1970: less are counted from some other moment
COLUMNS = 256  # places along a time axis that are distinguished
MOST_TRACES = 12  # channels of a recording, those that move most
PIECES = 240  # of a trace: in each the least and the most are drawn
TRACE = 30.0  # units a trace


def dated(seconds: float) -> str:
    """A time since 1970 as a date in UTC."""
    try:
        return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S")
    except (OSError, OverflowError, ValueError):
        return f"{seconds:g} s since 1970"


def timeline(rows: Sequence[tuple[str, Sequence[float], Sequence[float]]], begin: float, end: float) -> str:
    """When each material was touched. rows: name, times of touches that count, and of retracted ones, in seconds."""
    drawing = Drawing(ROW * len(rows) + 34, "When each material was observed")
    axis, bottom = Axis(begin, end, LEFT, RIGHT), ROW * len(rows) + 2
    for i, (name, kept, retracted) in enumerate(rows):
        top = ROW * i + 2
        drawing.text(LEFT - 6, top + 11, clipped_name(name), anchor="end", title=name)
        drawing.line([(LEFT, top + ROW / 2), (RIGHT, top + ROW / 2)], "grid")
        for times, kind in ((kept, "tick"), (retracted, "tick retracted")):
            places = sorted({round(axis(time) * COLUMNS / WIDTH) * WIDTH / COLUMNS for time in times})
            drawing.ticks(places, top + 2, ROW - 4, kind)
    of_day = begin > FIRST_DATE
    drawing.text(LEFT, bottom + 13, dated(begin) if of_day else f"{begin:.4g} s", "small")
    if end > begin:
        drawing.text(RIGHT, bottom + 13, dated(end) if of_day else f"{end:.4g} s", "small", "end")
    drawing.text((LEFT + RIGHT) / 2, bottom + 27, "time (UTC)" if of_day else "time", "small", "middle")
    return drawing.svg()


def histogram(counts: Sequence[int], low: float, high: float, label: str, what: str, form: str = "{:g}") -> str:
    """How often numbers fall into equal steps from low to high. label: of the numbers; what: is counted."""
    drawing = Drawing(158, f"How many {what}, by {label}")
    axis, up = Axis(low, high, 46, RIGHT), Axis(0, max(counts, default=1), 122, 8)
    drawing.up(up, 46, RIGHT)
    wide = (axis.end - axis.begin) / max(len(counts), 1)
    for i, count in enumerate(counts):
        if count:
            top = min(up(count), 121.0)
            drawing.box(axis.begin + i * wide, top, max(wide - 0.6, 0.6), 122 - top, "fill", title=f"{count} {what}")
    drawing.across(axis, 8, 122, label, form)
    return drawing.svg()


def tree(names: Sequence[str], joins: npt.NDArray[np.float64]) -> tuple[str, list[str]]:
    """Materials joined from the nearest to the farthest, and the order that brings near ones together.

    joins: as `scipy.cluster.hierarchy.linkage` gives them, (C − 1, 4).
    """
    from scipy.cluster.hierarchy import leaves_list

    count, order = len(names), leaves_list(joins).tolist()
    drawing = Drawing(ROW * count + 34, "Which materials are joined at which separation")
    least, most = (math.log10(max(float(height), 0.1)) for height in (joins[:, 2].min(), joins[:, 2].max()))
    axis, bottom = Axis(least - 0.15 * (most - least) - 0.05, most + 0.02, LEFT, RIGHT), ROW * count + 4
    for height in (0.1, 0.3, 1, 3, 10, 30, 100, 300, 1000, 3000, 10_000):
        if axis.low <= math.log10(height) <= axis.high:
            drawing.line([(axis(math.log10(height)), 4), (axis(math.log10(height)), bottom)], "grid")
            drawing.text(axis(math.log10(height)), bottom + 12, f"{height:g}", "small", "middle")
    drawing.text((LEFT + RIGHT) / 2, bottom + 25, "separation (log scale)", "small", "middle")
    places = {leaf: (LEFT, ROW * i + ROW / 2 + 2) for i, leaf in enumerate(order)}
    for i in order:
        drawing.text(LEFT - 6, places[i][1] + 4, clipped_name(names[i]), anchor="end", title=names[i])
    for i, (first, second, height, _) in enumerate(joins.tolist()):
        (x1, y1), (x2, y2), x = places[int(first)], places[int(second)], axis(math.log10(max(height, 0.1)))
        drawing.line([(x1, y1), (x, y1), (x, y2), (x2, y2)], "branch")
        places[count + i] = (x, (y1 + y2) / 2)
    return drawing.svg(), [names[i] for i in order]


def confusions(names: Sequence[str], counts: npt.NDArray[np.int64]) -> str:
    """Counts of (truth, answer), (C, C): the diagonal in one colour, mistakes in another."""
    side = min(22.0, (RIGHT - LEFT - 14) / len(names))
    left = LEFT + 14
    drawing = Drawing(side * len(names) + 22, "Counts of the material that was touched by the answer that was given")
    totals = np.maximum(counts.sum(axis=1), 1)
    for i, name in enumerate(names):
        y = side * i + 16
        drawing.text(LEFT - 6, y + side / 2 + 4, clipped_name(name), anchor="end", title=name)
        drawing.text(left - 3, y + side / 2 + 3, i + 1, "tiny", "end")
        drawing.text(left + side * (i + 0.5), 11, i + 1, "tiny", "middle")
        for j, other in enumerate(names):
            count, title = int(counts[i, j]), f"{name} called {other}: {counts[i, j]} of {counts[i].sum()}"
            if count:
                share = 0.25 + 0.75 * count / int(totals[i])
                kind = "fill" if i == j else "wrong"
                drawing.box(left + side * j, y, side - 1, side - 1, kind, share, title)
                strong = "tiny strong" if share > 0.6 else "tiny"
                drawing.text(left + side * (j + 0.5) - 0.5, y + side / 2 + 3, count, strong, "middle")
            else:
                drawing.box(left + side * j, y, side - 1, side - 1, "none")
    return drawing.svg()


@dataclass(frozen=True)
class Bin:
    """Answers of about one confidence: how many, its mean, the share that is right, and its 95 % interval."""

    count: int
    confidence: float
    right: float
    low: float
    high: float


def reliability(bins: Sequence[Bin], confidences: Sequence[float]) -> str:
    """The share of right answers by their probability, and how many answers have which."""
    drawing = Drawing(300, "Share of right answers by the probability that was given")
    axis, up, down = Axis(0, 1, 46, RIGHT), Axis(0, 1, 205, 8), Axis(0, 1, 262, 226)
    drawing.up(up, 46, RIGHT, "{:.0%}")
    drawing.line([(axis(0), up(0)), (axis(1), up(1))], "ideal")
    for found in bins:
        x = axis(found.confidence)
        drawing.line([(x, up(found.low)), (x, up(found.high))], "whisker")
        title = f"{found.count} answers with {found.confidence:.0%}: {found.right:.0%} right"
        drawing.dot(x, up(found.right), 3 + 3 * math.sqrt(found.count / max(b.count for b in bins)), "point", title)
    counts = np.histogram(confidences, bins=20, range=(0, 1))[0]
    for i, count in enumerate(counts.tolist()):
        if count:
            tall = max(1.0, 36 * math.sqrt(count / counts.max()))
            drawing.box(axis(i / 20), down(0) - tall, axis(0.05) - axis(0) - 0.8, tall, "fill", 0.6, f"{count} answers")
    drawing.across(axis, 262, 262, "probability that was given", "{:.0%}")
    drawing.text(46, 221, "how many answers (root scale)", "tiny")
    return drawing.svg()


def against_truth(truth: Sequence[float], said: Sequence[float], half: float, names: Sequence[str], unit: str) -> str:
    """Numbers that were said of touches held out, by the true ones. half: an interval's, drawn about the ideal."""
    low, high = min(*truth, *said), max(*truth, *said)
    drawing = Drawing(300, "The number that was said, by the true one")
    axis, up = Axis(low, high, 46, RIGHT), Axis(low, high, 262, 8)
    drawing.up(up, 46, RIGHT)
    drawing.line([(axis(low), up(low)), (axis(high), up(high))], "ideal")
    reach = min(half, high - low)
    drawing.line([(axis(low), up(low + reach)), (axis(high - reach), up(high))], "grid")
    drawing.line([(axis(low + reach), up(low)), (axis(high), up(high - reach))], "grid")
    for true, value, name in zip(truth, said, names, strict=True):
        kind = "point" if abs(true - value) <= half else "wrong"
        drawing.dot(axis(true), up(value), 2.5, kind, f"{name}: {value:.4g} said, {true:.4g} true")
    drawing.across(axis, 262, 262, f"true, {unit}")
    return drawing.svg()


def shares(rows: Sequence[tuple[str, float, str]], expected: float | None, label: str) -> str:
    """Bars of shares from 0 to 1. rows: name, share, what shows over it; expected: where a line stands."""
    most = max([share for _, share, _ in rows] + [expected or 0.0, 0.1])
    drawing = Drawing(ROW * len(rows) + 34, label)
    axis, bottom = Axis(0, most, LEFT, RIGHT - 30), ROW * len(rows) + 4
    drawing.across(axis, 4, bottom, label, "{:.0%}", 4)
    for i, (name, share, title) in enumerate(rows):
        y = ROW * i + 4
        drawing.text(LEFT - 6, y + 11, clipped_name(name), anchor="end", title=name)
        drawing.box(LEFT, y + 2, max(axis(share) - LEFT, 0.8), ROW - 4, "fill", title=title)
        drawing.text(axis(share) + 4, y + 10.5, f"{share:.0%}", "tiny")
    if expected is not None:
        drawing.line([(axis(expected), 2), (axis(expected), bottom)], "ideal")
    return drawing.svg()


def over_time(seconds: Sequence[float], lines: Mapping[str, Sequence[float]]) -> str:
    """Shares of touches over the seconds of each; three lines at most."""
    drawing = Drawing(186, "Shares of touches by the time that was felt of each")
    axis, up = Axis(0, max(seconds), 40, RIGHT), Axis(0, 1, 140, 12)
    drawing.up(up, 40, RIGHT, "{:.0%}")
    x = 40.0
    for kind, (name, line) in zip(("own", "decided", "rival"), lines.items(), strict=False):
        drawing.line([(axis(at), up(share)) for at, share in zip(seconds, line, strict=True)], kind)
        drawing.line([(x, 176), (x + 18, 176)], kind)
        drawing.text(x + 22, 180, name)
        x += 36 + LETTER * len(name)
        for at, share in zip(seconds, line, strict=True):
            drawing.dot(axis(at), up(share), 2, "point", f"{name}: {share:.0%} after {at:.2g} s")
    drawing.across(axis, 140, 140, "seconds of touch")
    return drawing.svg()


def evidence(grew: Sequence[tuple[int, float]], alarm: float) -> str:
    """The logarithm of the evidence of a change, to base ten, over the rows of the journal. alarm: where it is one."""
    drawing = Drawing(176, "Evidence that the sensor changed, over the touches")
    lowest = min(0.0, *(power for _, power in grew))
    axis = Axis(grew[0][0], max(grew[-1][0], grew[0][0] + 1), 40, RIGHT)
    up = Axis(lowest, max(alarm, *(power for _, power in grew)) + 0.5, 140, 12)
    drawing.up(up, 40, RIGHT, "{:.0f}")
    drawing.line([(40, up(alarm)), (RIGHT, up(alarm))], "ideal")
    drawing.line([(axis(row), up(power)) for row, power in grew], "own")
    drawing.across(axis, 140, 140, "observation")
    return drawing.svg()


def answers(
    seconds: Sequence[float], chances: Mapping[str, Sequence[float]], own: str, decided: tuple[float, str] | None
) -> str:
    """Probability of each material over the time of a touch of `own`. decided: when, in seconds, and what to say."""
    last = {name: line[-1] for name, line in chances.items()}
    rival = max((name for name in chances if name != own), key=lambda name: max(chances[name]), default=None)
    drawing = Drawing(196, f"Probability of each material over the time of a touch of {own}")
    axis, up = Axis(0, max(seconds), 40, RIGHT), Axis(0, 1, 140, 20)
    drawing.up(up, 40, RIGHT, "{:.0%}")
    for name in sorted(last, key=lambda name: (name == own, name == rival)):
        kind = "own" if name == own else "rival" if name == rival else "other"
        if name in (own, rival) or max(chances[name]) > 0.02:
            drawing.line([(axis(at), up(p)) for at, p in zip(seconds, chances[name], strict=True)], kind)
    for at, p in zip(seconds, chances[own], strict=True):
        drawing.dot(axis(at), up(p), 2.2, "point", f"{own} with {p:.1%} after {at:.2g} s")
    if decided is not None:
        x, words = axis(decided[0]), decided[1]
        drawing.line([(x, 12), (x, 140)], "decided")
        late = x > WIDTH / 2
        drawing.text(x + (-4 if late else 4), 11, words, "small", "end" if late else "start")
    drawing.across(axis, 140, 140, "seconds of touch")
    drawing.line([(40, 184), (60, 184)], "own")
    drawing.text(64, 188, clipped_name(own, 120), title=own)
    if rival is not None:
        x = 80 + min(120.0, LETTER * len(own))
        drawing.line([(x, 184), (x + 20, 184)], "rival")
        drawing.text(x + 24, 188, clipped_name(rival, 120), title=rival)
    return drawing.svg()


def trace(recording: Recording, spans: Sequence[tuple[int, int]]) -> str:
    """The channels that move most, each from its least to its most, over time; gaps and touches are bands.

    Of pictures it is their mean. spans: begin and end of touches, in readings.
    """
    readings = _channels(recording)
    chosen = _moving(readings)
    at, unit = counted_from(recording)
    drawing = Drawing(TRACE * max(len(chosen), 1) + 50, "The channels over time")
    axis, bottom = Axis(float(at[0]), float(at[-1]), LEFT, RIGHT), TRACE * max(len(chosen), 1) + 14
    for begin, end in spans:
        left, right = axis(at[begin]), axis(at[end - 1])
        drawing.box(left, 10, max(right - left, 1.0), bottom - 10, "fill", 0.15, f"touch, readings {begin} to {end}")
    gaps = recording.report.gaps if unit == "s" else ()
    for gap in gaps:
        left, right = axis(at[gap.index - 1]), axis(at[gap.index])
        title = f"a gap of {gap.seconds:.3g} s before reading {gap.index}"
        drawing.box(left, 10, max(right - left, 1.0), bottom - 10, "wrong", 0.35, title)
    for place, channel in enumerate(chosen):
        _draw(drawing, readings[:, channel], at, [gap.index for gap in gaps], axis, TRACE * place + 12)
        name = "mean" if recording.readings.ndim > 2 else f"channel {channel + 1}"
        drawing.text(LEFT - 6, TRACE * place + 22, name, anchor="end")
    drawing.across(axis, 10, bottom, "time, seconds from its begin" if unit == "s" else "reading")
    return drawing.svg()


def counted_from(recording: Recording) -> tuple[FloatArray, str]:
    """Where each reading lies, and the unit: seconds from the first; or its number, without a clock that goes on."""
    times = recording.times
    if len(times) and np.isfinite(times).all() and (np.diff(times) >= 0).all() and times[-1] > times[0]:
        return np.asarray(times - times[0]), "s"
    return np.arange(len(times), dtype=np.float64), ""


def _channels(recording: Recording) -> FloatArray:
    """What is drawn, (T, n)."""
    found = recording.readings
    if found.ndim > 2:
        return np.asarray(found.reshape(len(found), -1).mean(axis=1, dtype=np.float64)[:, None])
    found = np.asarray(found, dtype=np.float64).reshape(len(found), -1)
    return np.where(np.isfinite(found), found, np.nan)


def _moving(readings: FloatArray) -> list[int]:
    """The channels of which something is read, those that move most, in their order."""
    read = np.flatnonzero(np.isfinite(readings).any(axis=0))
    if len(read) > MOST_TRACES:
        own = readings[:, read]
        spread = np.nanquantile(own, 0.95, axis=0) / 2 - np.nanquantile(own, 0.05, axis=0) / 2  # halves: no overflow
        read = np.sort(read[np.argsort(-spread, kind="stable")[:MOST_TRACES]])
    return [int(channel) for channel in read]


def _draw(drawing: Drawing, values: FloatArray, at: FloatArray, gaps: Sequence[int], axis: Axis, top: float) -> None:
    """One channel, broken where time was lost or nothing was read."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    shares = (values / 2 - low / 2) / max(high / 2 - low / 2, np.finfo(np.float64).tiny)
    up = Axis(0.0, 1.0, top + TRACE - 6, top)
    for run in _runs(shares, gaps):
        points = [(axis(at[i]), up(share)) for i, share in _pieces(shares, run, len(values))]
        drawing.line(points if len(points) > 1 else [*points, (points[0][0] + 0.5, points[0][1])], "own thin")
    drawing.text(LEFT - 6, top + 21, f"{brief(low)} to {brief(high)}", "tiny", "end")


def _runs(shares: FloatArray, gaps: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Begin and end of each stretch without a gap in which all is read."""
    read = np.isfinite(shares)
    starts = {0, *gaps, *(np.flatnonzero(np.diff(read.astype(np.int8))) + 1).tolist()}
    edges = [*sorted(start for start in starts if start < len(shares)), len(shares)]
    for begin, end in itertools.pairwise(edges):
        if read[begin]:
            yield begin, end


def _pieces(shares: FloatArray, run: tuple[int, int], count: int) -> Iterator[tuple[int, float]]:
    """The readings of a run, or the least and the most of each piece of it, in the order of time."""
    begin, end = run
    step = max(1, 2 * count // PIECES)
    for first in range(begin, end, step):
        own = shares[first : min(first + step, end)]
        for i in sorted({int(own.argmin()), int(own.argmax())}):
            yield first + i, float(own[i])
