"""Drawings to scale, the figures of a page made of them, and arrays as pictures: all of it text."""

from __future__ import annotations

import base64
import itertools
import math
import re
import struct
import unicodedata
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from html import escape

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import printable
from scroll_tactile.recordings import Recording

WIDTH = 360.0  # of every drawing, in its units: a phone's width, so that text stays as large as it is written
LEFT = 92.0  # of it, for names
RIGHT = WIDTH - 15.0
ROW = 15.0  # units a row of names
LETTER = 7.0  # a letter's width, about
FIRST_DATE = 1e8  # seconds since 1970: less are counted from some other moment
COLUMNS = 256  # places along a time axis that are distinguished
MOST_TRACES = 12  # channels of a recording, those that move most
PIECES = 240  # of a trace: in each the least and the most are drawn
TRACE = 30.0  # units a trace

# Cividis by nine of its colours: as even for eyes that distinguish few colours (Nuñez, Anderton and Renslow 2018).
COLOURS = ((0, 32, 76), (0, 52, 110), (54, 70, 108), (87, 93, 109), (112, 113, 115), (138, 134, 120), (171, 159, 112), (214, 189, 84), (255, 233, 69))  # fmt: skip  # noqa: E501

ByteArray = npt.NDArray[np.uint8]
FloatArray = npt.NDArray[np.float64]
Span = tuple[float, float]


def shown(text: object) -> str:
    """Text for a page: what does not print, or turns the reading direction, as escapes; HTML's signs as entities."""
    return escape(printable(str(text)))


def clipped_name(name: str, room: float = LEFT - 8) -> str:
    """A name, not yet escaped, cut to the units that there are for it."""
    name = printable(name)
    sizes = [_size(letter) for letter in name]
    if sum(sizes) <= room:
        return name
    kept = sum(total <= room - _size("…") for total in itertools.accumulate(sizes))
    return name[:kept] + "…"


def _size(letter: str) -> float:
    """About how wide a letter is, in units: more where a font is not known than in most."""
    if unicodedata.east_asian_width(letter) in "WF":
        return 11.0
    return 10.0 if letter in "mwMW@%…" else 8.2 if letter.isupper() else 3.6 if letter in "iljt.,:;!'| " else 7.0


def brief(value: float) -> str:
    """A number to three digits, without an exponent where it is of a size that people read."""
    return f"{value:.0f}" if 1000 <= abs(value) < 1e7 else f"{value:.3g}"


def as_counted(name: str) -> list[tuple[int, str]]:
    """By which names sort as people count: mat2 before mat10."""
    parts = re.split(r"([0-9]{1,18})", name)
    return [(int(part), "") if i % 2 else (-1, part) for i, part in enumerate(parts)]


def png(pixels: ByteArray) -> str:
    """A picture as a data URI: (height, width) of levels 0 to 255 in cividis, or (height, width, 3) of colours."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = pixels.shape[:2]
    header = struct.pack(">IIBBBBB", width, height, 8, 3 if pixels.ndim == 2 else 2, 0, 0, 0)
    rows = np.pad(np.ascontiguousarray(pixels).reshape(height, -1), ((0, 0), (1, 0)))  # each begins with its filter: 0
    palette = chunk(b"PLTE", tinted(np.arange(256) / 255).tobytes()) if pixels.ndim == 2 else b""
    parts = chunk(b"IHDR", header), palette, chunk(b"IDAT", zlib.compress(rows.tobytes(), 9)), chunk(b"IEND", b"")
    return "data:image/png;base64," + base64.b64encode(b"\x89PNG\r\n\x1a\n" + b"".join(parts)).decode()


def tinted(shares: npt.NDArray[np.floating]) -> ByteArray:
    """The colours of numbers from 0 to 1, (…, 3)."""
    places = np.linspace(0, 1, len(COLOURS))
    bands = [np.interp(shares, places, [colour[i] for colour in COLOURS]) for i in range(3)]
    return np.asarray(np.rint(np.stack(bands, axis=-1)), dtype=np.uint8)


def steps(low: float, high: float, count: int = 5) -> list[float]:
    """About so many round numbers from low to high."""
    if not math.isfinite(high - low) or high - low < 1e-300:
        return [low]
    rough = (high - low) / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [float(f"{i * step:.12g}") for i in range(first, math.floor(high / step + 1e-9) + 1)]


class Axis:
    """Numbers from `low` to `high` along places from `begin` to `end`."""

    def __init__(self, low: float, high: float, begin: float, end: float) -> None:
        self.low, self.high = low, high if high > low else low + 1
        self.begin, self.end = begin, end

    def __call__(self, value: float) -> float:
        """The place of a number."""
        return self.begin + (self.end - self.begin) * (value - self.low) / (self.high - self.low)


class Drawing:
    """A vector drawing of the page's width: shapes by class, which the page's style colours in dark and in light.

    title: what a screen reader says of it. The title of a shape shows over it.
    """

    def __init__(self, height: float, title: str) -> None:
        self.height, self.title = height, title
        self._parts: list[str] = []

    def text(self, x: float, y: float, text: object, kind: str = "", anchor: str = "start", title: str = "") -> None:
        """Write at a place."""
        style = f' class="{kind}"' if kind else ""
        where = "" if anchor == "start" else f' text-anchor="{anchor}"'
        self._parts.append(f'<text x="{x:.4g}" y="{y:.4g}"{style}{where}>{_tip(title)}{shown(text)}</text>')

    def name(self, y: float, name: str) -> None:
        """Write a name left of a row."""
        self.text(LEFT - 6, y, clipped_name(name), anchor="end", title=name)

    def box(
        self, x: float, y: float, width: float, height: float, kind: str, share: float = 1, title: str = ""
    ) -> None:
        """Fill a rectangle; share: how strongly."""
        opacity = "" if share >= 1 else f' fill-opacity="{share:.2f}"'
        sizes = f'x="{x:.4g}" y="{y:.4g}" width="{width:.4g}" height="{height:.4g}"'
        self._parts.append(f'<rect {sizes} class="{kind}"{opacity}>{_tip(title)}</rect>')

    def dot(self, x: float, y: float, radius: float, kind: str, title: str = "") -> None:
        """Fill a disc."""
        self._parts.append(f'<circle cx="{x:.4g}" cy="{y:.4g}" r="{radius:.3g}" class="{kind}">{_tip(title)}</circle>')

    def line(self, points: Iterable[tuple[float, float]], kind: str) -> None:
        """Draw from point to point."""
        path = "L".join(f"{x:.4g} {y:.4g}" for x, y in points)
        self._parts.append(f'<path d="M{path}" class="{kind}"/>')

    def ticks(self, places: Sequence[float], y: float, height: float, kind: str) -> None:
        """Short upright lines of one height, as one path."""
        path = "".join(f"M{x:.4g} {y:.4g}v{height:.3g}" for x in places)
        if path:
            self._parts.append(f'<path d="{path}" class="{kind}"/>')

    def across(self, axis: Axis, top: float, bottom: float, label: str, form: str = "{:g}", count: int = 5) -> None:
        """A horizontal axis under a plot, with lines up to its top."""
        for value in steps(axis.low, axis.high, count):
            self.line([(axis(value), top), (axis(value), bottom)], "grid")
            self.text(axis(value), bottom + 12, form.format(value), "small", "middle")
        self.text((axis.begin + axis.end) / 2, bottom + 25, label, "small", "middle")

    def plot(
        self, across: Span, upward: Span, left: float = 40, bottom: float = 140, top: float = 12, form: str = "{:.0%}"
    ) -> tuple[Axis, Axis]:
        """The axes of a plot, across and upward; of the latter there are lines already."""
        up = Axis(*upward, bottom, top)
        for value in steps(up.low, up.high, 4):
            self.line([(left, up(value)), (RIGHT, up(value))], "grid")
            self.text(left - 4, up(value) + 3.5, form.format(value), "small", "end")
        return Axis(*across, left, RIGHT), up

    def svg(self) -> str:
        """The drawing as an element of a page."""
        size = f'viewBox="0 0 {WIDTH:g} {self.height:.4g}"'
        return f'<svg {size} role="img" aria-label="{shown(self.title)}">{"".join(self._parts)}</svg>'


def _tip(title: str) -> str:
    return f"<title>{shown(title)}</title>" if title else ""


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
        drawing.name(top + 11, name)
        drawing.line([(LEFT, top + ROW / 2), (RIGHT, top + ROW / 2)], "grid")
        for times, kind in ((kept, "tick"), (retracted, "tick retracted")):
            places = sorted({round(axis(time) * COLUMNS / WIDTH) * WIDTH / COLUMNS for time in times})
            drawing.ticks(places, top + 2, ROW - 4, kind)
    of_day = begin > FIRST_DATE
    ends = [(LEFT, begin, "start"), (RIGHT, end, "end")]
    for x, seconds, anchor in ends if end > begin else ends[:1]:
        drawing.text(x, bottom + 13, dated(seconds) if of_day else f"{seconds:.4g} s", "small", anchor)
    drawing.text((LEFT + RIGHT) / 2, bottom + 27, "time (UTC)" if of_day else "time", "small", "middle")
    return drawing.svg()


def histogram(counts: Sequence[int], high: float, label: str, what: str) -> str:
    """How often numbers fall into equal steps from 0 to high. label: of the numbers; what: is counted."""
    drawing = Drawing(158, f"How many {what}, by {label}")
    axis, up = drawing.plot((0, high), (0, max(counts)), 46, 122, 8, "{:g}")
    wide = (axis.end - axis.begin) / len(counts)
    for i, count in enumerate(counts):
        if count:
            top = min(up(count), 121.0)
            drawing.box(axis.begin + i * wide, top, max(wide - 0.6, 0.6), 122 - top, "fill", title=f"{count} {what}")
    drawing.across(axis, 8, 122, label)
    return drawing.svg()


def tree(names: Sequence[str], joins: FloatArray) -> tuple[str, list[str]]:
    """Materials joined from the nearest to the farthest, and the order that brings near ones together.

    joins: as `scipy.cluster.hierarchy.linkage` gives them, (C − 1, 4).
    """
    from scipy.cluster.hierarchy import leaves_list

    count, order = len(names), leaves_list(joins).tolist()
    drawing = Drawing(ROW * count + 34, "Which materials are joined at which separation")
    heights = [math.log10(max(height, 0.1)) for height in joins[:, 2].tolist()]
    least, most, bottom = min(heights), max(heights), ROW * count + 4
    axis = Axis(least - 0.15 * (most - least) - 0.05, most + 0.02, LEFT, RIGHT)
    for height in (0.1, 0.3, 1, 3, 10, 30, 100, 300, 1000, 3000, 10_000):
        if axis.low <= math.log10(height) <= axis.high:
            x = axis(math.log10(height))
            drawing.line([(x, 4), (x, bottom)], "grid")
            drawing.text(x, bottom + 12, f"{height:g}", "small", "middle")
    drawing.text((LEFT + RIGHT) / 2, bottom + 25, "separation (log scale)", "small", "middle")
    places = {leaf: (LEFT, ROW * i + ROW / 2 + 2) for i, leaf in enumerate(order)}
    for i in order:
        drawing.name(places[i][1] + 4, names[i])
    for i, (first, second) in enumerate(joins[:, :2].astype(int).tolist()):
        (x1, y1), (x2, y2), x = places[first], places[second], axis(heights[i])
        drawing.line([(x1, y1), (x, y1), (x, y2), (x2, y2)], "branch")
        places[count + i] = (x, (y1 + y2) / 2)
    return drawing.svg(), [names[i] for i in order]


def confusions(names: Sequence[str], counts: Mapping[tuple[str, str], int]) -> str:
    """Counts of (truth, answer), where there are any: right answers in one colour, mistakes in another."""
    left = LEFT + 14
    side = min(22.0, (RIGHT - left) / len(names))
    drawing = Drawing(side * len(names) + 22, "Counts of the material that was touched by the answer that was given")
    for i, name in enumerate(names):
        own = [counts.get((name, answer), 0) for answer in names]
        y, total = side * i + 16, sum(own)
        drawing.name(y + side / 2 + 4, name)
        drawing.text(left - 3, y + side / 2 + 3, i + 1, "tiny", "end")
        drawing.text(left + side * (i + 0.5), 11, i + 1, "tiny", "middle")
        for j, count in enumerate(own):
            x, share, kind = left + side * j, 0.25 + 0.75 * count / max(total, 1), "fill" if i == j else "wrong"
            if count:
                drawing.box(x, y, side - 1, side - 1, kind, share, f"{name} called {names[j]}: {count} of {total}")
                strong = "tiny strong" if share > 0.6 else "tiny"
                drawing.text(x + side / 2 - 0.5, y + side / 2 + 3, count, strong, "middle")
            else:
                drawing.box(x, y, side - 1, side - 1, "none")
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
    axis, up = drawing.plot((0, 1), (0, 1), 46, 205, 8)
    drawing.line([(axis(0), up(0)), (axis(1), up(1))], "ideal")
    most = max(found.count for found in bins)
    for found in bins:
        x = axis(found.confidence)
        drawing.line([(x, up(found.low)), (x, up(found.high))], "whisker")
        title = f"{found.count} answers with {found.confidence:.0%}: {found.right:.0%} right"
        drawing.dot(x, up(found.right), 3 + 3 * math.sqrt(found.count / most), "point", title)
    counts = np.histogram(confidences, bins=20, range=(0, 1))[0]
    for i, count in enumerate(counts.tolist()):
        if count:
            tall = max(1.0, 36 * math.sqrt(count / counts.max()))
            drawing.box(axis(i / 20), 262 - tall, axis(0.05) - axis(0) - 0.8, tall, "fill", 0.6, f"{count} answers")
    drawing.across(axis, 262, 262, "probability that was given", "{:.0%}")
    drawing.text(46, 221, "how many answers (root scale)", "tiny")
    return drawing.svg()


def against_truth(truth: Sequence[float], said: Sequence[float], half: float, names: Sequence[str], unit: str) -> str:
    """Numbers that were said of touches held out, by the true ones. half: an interval's, drawn about the ideal."""
    low, high = min(*truth, *said), max(*truth, *said)
    drawing = Drawing(300, "The number that was said, by the true one")
    axis, up = drawing.plot((low, high), (low, high), 46, 262, 8, "{:g}")
    reach = min(half, high - low)
    for above, below, kind in ((0.0, 0.0, "ideal"), (reach, 0.0, "grid"), (0.0, reach, "grid")):
        drawing.line([(axis(low + below), up(low + above)), (axis(high - above), up(high - below))], kind)
    for true, value, name in zip(truth, said, names, strict=True):
        kind = "point" if abs(true - value) <= half else "wrong"
        drawing.dot(axis(true), up(value), 2.5, kind, f"{name}: {value:.4g} said, {true:.4g} true")
    drawing.across(axis, 262, 262, f"true, {unit}")
    return drawing.svg()


def shares(rows: Sequence[tuple[str, float, str]], expected: float, label: str) -> str:
    """Bars of shares from 0 to 1. rows: name, share, what shows over it; expected: where a line stands."""
    drawing = Drawing(ROW * len(rows) + 34, label)
    most = max([share for _, share, _ in rows] + [expected, 0.1])
    axis, bottom = Axis(0, most, LEFT, RIGHT - 30), ROW * len(rows) + 4
    drawing.across(axis, 4, bottom, label, "{:.0%}", 4)
    for i, (name, share, title) in enumerate(rows):
        y = ROW * i + 4
        drawing.name(y + 11, name)
        drawing.box(LEFT, y + 2, max(axis(share) - LEFT, 0.8), ROW - 4, "fill", title=title)
        drawing.text(axis(share) + 4, y + 10.5, f"{share:.0%}", "tiny")
    drawing.line([(axis(expected), 2), (axis(expected), bottom)], "ideal")
    return drawing.svg()


def over_time(seconds: Sequence[float], lines: Mapping[str, Sequence[float]]) -> str:
    """Shares of touches over the seconds of each; three lines at most."""
    drawing, x = Drawing(186, "Shares of touches by the time that was felt of each"), 40.0
    axis, up = drawing.plot((0, max(seconds)), (0, 1))
    for kind, (name, line) in zip(("own", "decided", "rival"), lines.items(), strict=False):
        points = [(axis(at), up(share)) for at, share in zip(seconds, line, strict=True)]
        drawing.line(points, kind)
        drawing.line([(x, 176), (x + 18, 176)], kind)
        drawing.text(x + 22, 180, name)
        x += 36 + LETTER * len(name)
        for point, at, share in zip(points, seconds, line, strict=True):
            drawing.dot(*point, 2, "point", f"{name}: {share:.0%} after {at:.2g} s")
    drawing.across(axis, 140, 140, "seconds of touch")
    return drawing.svg()


def evidence(grew: Sequence[tuple[int, float]], alarm: float) -> str:
    """The logarithm of the evidence of a change, to base ten, over the rows of the journal. alarm: where it is one."""
    drawing = Drawing(176, "Evidence that the sensor changed, over the touches")
    (first, _), (last, _), powers = grew[0], grew[-1], [power for _, power in grew]
    axis, up = drawing.plot(
        (first, max(last, first + 1)), (min(0.0, *powers), max(alarm, *powers) + 0.5), form="{:.0f}"
    )
    drawing.line([(40, up(alarm)), (RIGHT, up(alarm))], "ideal")
    drawing.line([(axis(row), up(power)) for row, power in grew], "own")
    drawing.across(axis, 140, 140, "observation")
    return drawing.svg()


def answers(
    seconds: Sequence[float], chances: Mapping[str, Sequence[float]], own: str, decided: tuple[float, str] | None
) -> str:
    """Probability of each material over the time of a touch of `own`. decided: when, in seconds, and what to say."""
    rival = max((name for name in chances if name != own), key=lambda name: max(chances[name]), default=None)
    drawing = Drawing(196, f"Probability of each material over the time of a touch of {own}")
    axis, up = drawing.plot((0, max(seconds)), (0, 1), top=20)
    for name in sorted(chances, key=lambda name: (name == own, name == rival)):
        kind = "own" if name == own else "rival" if name == rival else "other"
        if kind != "other" or max(chances[name]) > 0.02:
            drawing.line([(axis(at), up(p)) for at, p in zip(seconds, chances[name], strict=True)], kind)
    for at, p in zip(seconds, chances[own], strict=True):
        drawing.dot(axis(at), up(p), 2.2, "point", f"{own} with {p:.1%} after {at:.2g} s")
    if decided is not None:
        x, late = axis(decided[0]), axis(decided[0]) > WIDTH / 2
        drawing.line([(x, 12), (x, 140)], "decided")
        drawing.text(x + (-4 if late else 4), 11, decided[1], "small", "end" if late else "start")
    drawing.across(axis, 140, 140, "seconds of touch")
    for called, kind, x in ((own, "own", 40.0), (rival, "rival", 80 + min(120.0, LETTER * len(own)))):
        if called is not None:
            drawing.line([(x, 184), (x + 20, 184)], kind)
            drawing.text(x + 24, 188, clipped_name(called, 120), title=called)
    return drawing.svg()


def trace(recording: Recording, spans: Sequence[tuple[int, int]]) -> str:
    """The channels that move most, each from its least to its most, over time; gaps and touches are bands.

    Of pictures it is their mean. spans: begin and end of touches, in readings.
    """
    pictures, readings = recording.readings.ndim > 2, recording.readings.reshape(len(recording), -1)
    readings = readings.mean(axis=1, dtype=np.float64)[:, None] if pictures else readings.astype(np.float64)
    readings[~np.isfinite(readings)] = np.nan
    chosen, (at, unit) = _moving(readings), counted_from(recording)
    gaps = recording.report.gaps if unit == "s" else ()
    axis, bottom = Axis(float(at[0]), float(at[-1]), LEFT, RIGHT), TRACE * max(len(chosen), 1) + 14
    drawing = Drawing(bottom + 36, "The channels over time")
    bands = [(at[begin], at[end - 1], "fill", 0.15, f"touch, readings {begin} to {end}") for begin, end in spans]
    bands += [
        (at[gap.index - 1], at[gap.index], "wrong", 0.35, f"a gap of {gap.seconds:.3g} s before reading {gap.index}")
        for gap in gaps
    ]
    for begin, end, kind, share, title in bands:
        drawing.box(axis(begin), 10, max(axis(end) - axis(begin), 1.0), bottom - 10, kind, share, title)
    for place, channel in enumerate(chosen):
        _draw(drawing, readings[:, channel], at, [gap.index for gap in gaps], axis, TRACE * place + 12)
        drawing.text(LEFT - 6, TRACE * place + 22, "mean" if pictures else f"channel {channel + 1}", anchor="end")
    drawing.across(axis, 10, bottom, "time, seconds from its begin" if unit == "s" else "reading")
    return drawing.svg()


def counted_from(recording: Recording) -> tuple[FloatArray, str]:
    """Where each reading lies, and the unit: seconds from the first; or its number, without a clock that goes on."""
    times = recording.times
    if len(times) and np.isfinite(times).all() and (np.diff(times) >= 0).all() and times[-1] > times[0]:
        return np.asarray(times - times[0]), "s"
    return np.arange(len(times), dtype=np.float64), ""


def _moving(readings: FloatArray) -> list[int]:
    """The channels of which something is read, those that move most, in their order."""
    read = np.flatnonzero(np.isfinite(readings).any(axis=0))
    if len(read) > MOST_TRACES:
        low, high = np.nanquantile(readings[:, read], (0.05, 0.95), axis=0)
        spread = high / 2 - low / 2  # halves: no overflow
        read = np.sort(read[np.argsort(-spread, kind="stable")[:MOST_TRACES]])
    return [int(channel) for channel in read]


def _draw(drawing: Drawing, values: FloatArray, at: FloatArray, gaps: Sequence[int], axis: Axis, top: float) -> None:
    """One channel, broken where time was lost or nothing was read: of each piece the least and the most."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    shares = (values / 2 - low / 2) / max(high / 2 - low / 2, np.finfo(np.float64).tiny)
    up, step = Axis(0.0, 1.0, top + TRACE - 6, top), max(1, 2 * len(values) // PIECES)
    read = np.isfinite(shares)
    starts = {0, *gaps, *(np.flatnonzero(np.diff(read.astype(np.int8))) + 1).tolist()}
    for begin, end in itertools.pairwise([*sorted(starts), len(values)]):
        points = []
        for first in range(begin, end, step) if read[begin] else ():
            own = shares[first : min(first + step, end)]
            points += [(axis(at[first + i]), up(own[i])) for i in sorted({int(own.argmin()), int(own.argmax())})]
        if points:
            drawing.line(points if len(points) > 1 else [*points, (points[0][0] + 0.5, points[0][1])], "own thin")
    drawing.text(LEFT - 6, top + 21, f"{brief(low)} to {brief(high)}", "tiny", "end")
