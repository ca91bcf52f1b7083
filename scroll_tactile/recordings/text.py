"""What all files and streams of text share: cells and times, how lines are cut into cells, encodings, ends cut off."""

from __future__ import annotations

import codecs
import csv
import io
import itertools
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from datetime import time as time_of_day
from pathlib import Path

from scroll_tactile.errors import RecordingError, ScrollTactileError, printable
from scroll_tactile.recordings.blocks import Request, Source
from scroll_tactile.recordings.bounds import require_file

__all__ = ["FEWEST", "LONGEST", "Layout", "Text", "modal_length", "moment", "number"]

LONGEST = 1 << 24
"""Characters in a line; a longer one is no table's."""

FEWEST = 8
"""Readings in a file that is a recording, where its name does not say so."""

_FEW = 100  # one row in so many may be left out
_PIECE = 1 << 20  # bytes that are decoded at once
_OTHERS = {
    b"PK\x03\x04": "an archive or a workbook (.xlsx): save it as text",
    b"\xd0\xcf\x11\xe0": "a workbook (.xls): save it as text",
    b"\x1f\x8b": "compressed by gzip: unpack it",
}
_MISSING = re.compile(
    r"|-|\?|missing|<na>|null|none|n/?a|#n/?a|#nv|#(?:value|num|ref|div/0)!|-?nan(?:\(s?nan\)|\(ind\))?|"
    r"-?1\.#(?:qnan|snan|ind)0*",
    re.IGNORECASE,
)
_NUMBER = re.compile(
    r"[+-]?(?:\d+(?:\.\d*)?(?:e[+-]?\d+)?|\.\d+(?:e[+-]?\d+)?|inf(?:inity)?|1\.#inf)", re.IGNORECASE | re.ASCII
)
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")


def number(cell: str, decimal: str = ".") -> float | None:
    """A cell's number, NaN where it stands for a missing one; None for text.

    Numbers are as every program writes them, without underscores and digits of other scripts.
    """
    text = cell.strip()
    written = text if decimal == "." else text.replace(".", "_").replace(",", ".")
    if _NUMBER.fullmatch(written):
        return float(written.replace("1.#", ""))
    return math.nan if _MISSING.fullmatch(text) else None


def moment(cell: str, decimal: str = ".") -> float | None:
    """Seconds of a cell that holds a number, a date with a time, or a time of the day; None for other text."""
    if (found := number(cell, decimal)) is not None:
        return found
    try:
        when = datetime.fromisoformat(cell.strip().replace("/", "-"))
    except ValueError:
        try:
            day = time_of_day.fromisoformat(cell.strip())
        except ValueError:
            return None
        when = datetime.combine(datetime(1970, 1, 1), day)
    return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()


@dataclass(frozen=True)
class Layout:
    """How lines are written: what separates their cells (a space is any run of blanks), and the decimal mark."""

    delimiter: str
    decimal: str = "."

    @classmethod
    def of(cls, lines: Sequence[str], delimiter: str | None = None, decimal: str | None = None) -> Layout:
        """The layout by which the most cells of these lines are numbers, in lines of the same number of cells.

        Raises RecordingError where a comma may stand before decimals or thousands, and for a delimiter that is none.
        """
        delimiter = {"\\t": "\t", "tab": "\t", "space": " "}.get(delimiter or "", delimiter)
        if delimiter is not None and (len(delimiter) != 1 or delimiter in '"\r\n'):
            raise RecordingError(f"expected a delimiter of one character; came {delimiter!r:.40}", argument="delimiter")
        if decimal not in (None, ".", ","):
            raise RecordingError(f"expected decimal='.' or ','; came {decimal!r:.40}", argument="decimal")
        best, most = cls(delimiter or ",", decimal or "."), -1.0
        for point, mark in itertools.product(decimal or ".,", [delimiter] if delimiter else ";\t|, "):
            if mark == point and not any('"' in line for line in lines):
                continue
            layout = cls(mark, point)
            rows = [layout.cells(line) for line in lines]
            width = modal_length(rows)
            own = [row[:64] for row in rows if len(row) == width]
            numbers = sum(number(cell, point) is not None for row in own for cell in row)
            score = (numbers / max(sum(map(len, own)), 1) + 1e-3 * (width > 1)) * len(own)
            if score > most and (width > 1 or point == (decimal or ".")):
                best, most = layout, score
        commas = [cell.strip() for line in lines for cell in best.cells(line)[:64] if "," in cell]
        unsure = [cell for cell in commas if best.decimal == "," and number(cell, ",") is not None]
        if decimal is None and unsure and all(map(_THOUSANDS.fullmatch, unsure)):
            what = f"{unsure[0]!r:.40} may have a comma before decimals, or before thousands"
            raise RecordingError(f"{what}: if it is before decimals, pass decimal=','", argument="decimal")
        return best

    def cells(self, line: str) -> list[str]:
        """The cells of a line."""
        if self.delimiter == " ":
            return line.split()
        if '"' not in line:
            return line.split(self.delimiter)
        try:
            return next(csv.reader(line.splitlines(keepends=True), delimiter=self.delimiter, skipinitialspace=True), [])
        except csv.Error:  # a mark that is never closed
            return [line]


def modal_length(rows: Sequence[Sequence[str]]) -> int:
    """The number of cells that most rows have, the larger one of two."""
    counts = Counter(map(len, rows))
    return max(counts, key=lambda width: (counts[width], width), default=0)


class Text(Source):
    """A file of text that is read a piece at a time: its encoding, its end, and the rows that are left out of it.

    The last line is cut off where the recorder was: it has no end and is no row, or zeros stand behind it. One row in
    a hundred may be unreadable. Both are noted; what is worse is refused.
    """

    def __init__(self, path: Path, address: str, request: Request) -> None:
        super().__init__(path, address, request)
        self._before = require_file(path)
        self.size = self._before.st_size
        self.stored += self.size
        with path.open("rb") as file:
            head = file.read(4096)
        if (what := next((what for begin, what in _OTHERS.items() if head.startswith(begin)), None)) is not None:
            raise RecordingError(f"expected text in {address}; it is {what}")
        self.encoding, self._guess = _encoding_of(head)
        self._begin()

    def _begin(self) -> None:
        self.unended = self.seen = self.empty = self._left_out = 0
        self.ending = self.counted = ""
        self.first: ScrollTactileError | None = None

    def pieces(self) -> Iterator[str]:
        """The text, as far as the file went when it was opened."""
        errors = "replace" if self.encoding.startswith("utf-16") else "surrogateescape"
        decoder = io.IncrementalNewlineDecoder(codecs.getincrementaldecoder(self.encoding)(errors), translate=True)
        left = self.size
        with self.path.open("rb") as file:
            while left > 0 and (data := file.read(min(left, _PIECE))):
                left -= len(data)
                yield decoder.decode(data, final=left <= 0)

    def lines(self) -> Iterator[tuple[int, str]]:
        """The lines that are not blank, with their numbers. Raises RecordingError for one that is longer than any."""
        self._begin()
        row, rest, zeros = 0, "", False
        for piece in filter(None, self.pieces()):
            zeros = piece[-1] == "\0"
            lines = (rest + piece.replace("\0", "")).split("\n")
            if max(map(len, lines)) >= LONGEST:
                raise RecordingError(f"{self.address}, row {row + 1}, is longer than any; is it another file?")
            rest = lines.pop()
            for line in lines:
                row += 1
                if line and not line.isspace():
                    yield row, line
        if zeros:
            self.ending = f"zeros stand behind row {row}, as after a power cut"
        elif rest and not rest.isspace():
            self.unended = row + 1
            yield row + 1, rest

    def leave_out(self, row: int, error: ScrollTactileError) -> None:
        """Count a row that cannot be read; the last one, where it has no end, is cut off."""
        if row == self.unended:
            self.ending = f"it ends in the middle of row {row}"
            return
        self._left_out += 1
        self.first = self.first or error

    def require_few(self) -> None:
        """Raises the error of the first row that was left out where more than a hundredth were."""
        if self.first is not None and self._left_out * _FEW > self.seen:
            raise self.first

    def finish(self) -> None:
        """Note what was odd, after the last row. Raises RecordingError for a file that was changed meanwhile."""
        now, before = self.path.stat(), self._before
        same = (now.st_size, now.st_mtime_ns) == (before.st_size, before.st_mtime_ns)
        if now.st_ino != before.st_ino or not (same or now.st_size > before.st_size):
            raise RecordingError(f"{self.address} was changed while it was read: read it when nothing writes to it")
        self.cut_off = bool(self.ending)
        first = str(self.first).removeprefix(f"{self.address}, ")
        said = (
            (self._guess, f"its encoding is guessed: {self._guess}"),
            (self.counted, self.counted),
            (self.ending, self.ending),
            (self._left_out, f"{self._left_out} of {self.seen} rows are left out, the first by this: {first}"),
            (self.empty, f"{self.empty} rows have no number at all"),
            (not same, f"it grew while it was read: what came behind its first {before.st_size} bytes is left out"),
        )
        self.notes += [text for holds, text in said if holds]

    def named(self, text: str) -> str:
        """A name in the file on one line, of what prints, in the form in which equal names are equal."""
        if not text.isascii() and any("\udc80" <= letter <= "\udcff" for letter in text):
            self._guess = "latin-1"
            text = text.encode("utf-8", "surrogateescape").decode("latin-1")
        return unicodedata.normalize("NFC", printable(" ".join(text.split())))


def _encoding_of(head: bytes) -> tuple[str, str]:
    """The encoding of a file that begins so, and its name where it is guessed."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16", ""
    text = head.rstrip(b"\0")
    for place, name in ((1, "utf-16-le"), (0, "utf-16-be")):
        half = text[place::2]
        if len(half) > 1 and half.count(0) > 0.9 * len(half):
            return name, name
    return "utf-8-sig", ""
