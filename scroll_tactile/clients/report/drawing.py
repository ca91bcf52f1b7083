"""Pictures as text: vector drawings to scale, and arrays as PNG."""

from __future__ import annotations

import base64
import itertools
import math
import re
import struct
import unicodedata
import zlib
from collections.abc import Sequence
from html import escape

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import printable

__all__ = ["LEFT", "WIDTH", "Axis", "Drawing", "as_counted", "brief", "clipped_name", "png", "shown", "steps", "tinted"]

WIDTH = 360.0  # of every drawing, in its units: a phone's width, so that text stays as large as it is written
LEFT = 92.0  # of it, for names
TINY = 1e-300
ROOM = LEFT - 8.0  # for a name

# Cividis by nine of its colours: as even for eyes that distinguish few colours (Nuñez, Anderton and Renslow 2018).
COLOURS = ((0, 32, 76), (0, 52, 110), (54, 70, 108), (87, 93, 109), (112, 113, 115), (138, 134, 120), (171, 159, 112), (214, 189, 84), (255, 233, 69))  # fmt: skip  # noqa: E501

ByteArray = npt.NDArray[np.uint8]


def shown(text: object) -> str:
    """Text for a page: what does not print, or turns the reading direction, as escapes; HTML's signs as entities."""
    return escape(printable(str(text)))


def clipped_name(name: str, room: float = ROOM) -> str:
    """A name, not yet escaped, cut to the units that there are for it."""
    name = printable(name)
    sizes = [_size(letter) for letter in name]
    if sum(sizes) <= room:
        return name
    reach = room - _size("…")
    kept = sum(total <= reach for total in itertools.accumulate(sizes))
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
    if not math.isfinite(high - low) or high - low < TINY:
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

    title: what a screen reader says of it.
    """

    def __init__(self, height: float, title: str) -> None:
        self.height, self.title = height, title
        self._parts: list[str] = []

    def text(self, x: float, y: float, text: object, kind: str = "", anchor: str = "start", title: str = "") -> None:
        """Write at a place; title: what shows over it."""
        style = f' class="{kind}"' if kind else ""
        tip = f"<title>{shown(title)}</title>" if title else ""
        where = "" if anchor == "start" else f' text-anchor="{anchor}"'
        self._parts.append(f'<text x="{x:.4g}" y="{y:.4g}"{style}{where}>{tip}{shown(text)}</text>')

    def box(
        self, x: float, y: float, width: float, height: float, kind: str, share: float = 1, title: str = ""
    ) -> None:
        """Fill a rectangle; share: how strongly."""
        tip = f"<title>{shown(title)}</title>" if title else ""
        opacity = "" if share >= 1 else f' fill-opacity="{share:.2f}"'
        sizes = f'x="{x:.4g}" y="{y:.4g}" width="{width:.4g}" height="{height:.4g}"'
        self._parts.append(f'<rect {sizes} class="{kind}"{opacity}>{tip}</rect>')

    def dot(self, x: float, y: float, radius: float, kind: str, title: str = "") -> None:
        """Fill a disc."""
        tip = f"<title>{shown(title)}</title>" if title else ""
        self._parts.append(f'<circle cx="{x:.4g}" cy="{y:.4g}" r="{radius:.3g}" class="{kind}">{tip}</circle>')

    def line(self, points: Sequence[tuple[float, float]], kind: str) -> None:
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

    def up(self, axis: Axis, left: float, right: float, form: str = "{:g}", count: int = 4) -> None:
        """A vertical axis left of a plot, with lines to its right side."""
        for value in steps(axis.low, axis.high, count):
            self.line([(left, axis(value)), (right, axis(value))], "grid")
            self.text(left - 4, axis(value) + 3.5, form.format(value), "small", "end")

    def svg(self) -> str:
        """The drawing as an element of a page."""
        size = f'viewBox="0 0 {WIDTH:g} {self.height:.4g}"'
        return f'<svg {size} role="img" aria-label="{shown(self.title)}">{"".join(self._parts)}</svg>'
