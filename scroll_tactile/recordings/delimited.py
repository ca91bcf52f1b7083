"""Tables of text as a source, `.csv` as people have it: any delimiter, a header of names or numbers, missing cells."""

from __future__ import annotations

import csv
import fnmatch
import itertools
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FieldError, RecordingError
from scroll_tactile.recordings.blocks import Block, Contents, Entry, Request, Source, rows_of
from scroll_tactile.recordings.bounds import stored_bytes
from scroll_tactile.recordings.paths import nearest

__all__ = ["LONGEST", "Delimited", "is_missing", "is_number", "is_table", "missing_cells"]

LONGEST = 1 << 24
"""Characters in a line; a longer one is no table's."""

_MISSING = frozenset(("", "nan", "na", "n/a", "null", "none", "-", "?"))
_MOST_COLUMNS = 1 << 18  # a picture of 320 × 240 in three colours has 230 400
_SEEN = 200  # lines are looked at to say what a table is
_TIME = re.compile(
    r"(?:time(?:[ _]?stamp)?s?|t|stamp|seconds)(?:[ _]*[\[(]?(s|sec|seconds|ms|us|µs|ns)[\])]?)?", re.IGNORECASE
)
_UNITS = {"ms": 1e3, "us": 1e6, "µs": 1e6, "ns": 1e9}
_NUMBER = re.compile(
    r"[+-]?(?:\d+(?:\.\d*)?(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?|inf(?:inity)?)", re.IGNORECASE | re.ASCII
)


def is_table(path: Path) -> bool:
    """Whether a file's name is that of a table of text."""
    return path.suffix.lower() in (".csv", ".tsv", ".txt", ".dat")


def is_number(cell: str) -> bool:
    """Whether a cell is a number as every program writes it: no underscores, no digits of other scripts."""
    return _NUMBER.fullmatch(cell.strip()) is not None


def is_missing(cell: str) -> bool:
    """Whether a cell stands for a value that is missing: empty, NaN, NA, null, none, - or ?."""
    return cell.strip().lower() in _MISSING


def missing_cells(delimiter: str) -> re.Pattern[str]:
    """What finds the cells of a line that are missing.

    It has one way to read a run of spaces: where nothing could stand between two runs, it would try each place.
    """
    mark = re.escape(delimiter)
    tokens = "|".join(re.escape(token) for token in sorted(filter(None, _MISSING), key=len, reverse=True))
    space = rf"[^\S{mark}]*"
    return re.compile(rf"(?:(?<={mark})|^){space}(?:(?:{tokens}){space})?(?={mark}|$)", re.IGNORECASE)


class Delimited(Source):
    """A table of text; see `Source`.

    A first row is a header where it has text in it, or counts 0, 1, 2 … as pandas does. A first column without a name
    (or called "index") that counts rows is left out. A column called time, timestamp, t … holds the times.
    """

    continuous = labels = True

    def __init__(self, path: Path, address: str, request: Request) -> None:
        super().__init__(path, address, request)
        self.stored += stored_bytes(path)
        if request.decimal not in (".", ","):
            raise RecordingError(
                f"expected a decimal point or comma, decimal='.' or ','; came {request.decimal!r}", argument="decimal"
            )
        self.comment = ""
        with self._text() as file:
            lines = list(itertools.islice(self._lines(file), _SEEN))
        if not lines:
            raise RecordingError(f"expected readings in {address}, one row each; there are none")
        self.delimiter = request.delimiter or _delimiter([line for _, line in lines], request.decimal)
        rows = [(number, self._cells(line, number)) for number, line in lines]
        self.width = len(rows[0][1])
        if self.width > _MOST_COLUMNS:
            raise RecordingError(f"{address} has {self.width} columns; expected at most {_MOST_COLUMNS}")
        self._empty = missing_cells(self.delimiter)
        self.header = self._header(rows)
        names = rows[0][1] if self.header else [str(i) for i in range(self.width)]
        if not self.header and self.comment and len(self.comment.split()) == self.width:
            names = self.comment.split()
        self.columns = [name.strip() for name in names]
        data = [cells for _, cells in rows[1 if self.header else 0 :] if len(cells) == self.width]
        self.time = self._time_column()
        self.index = self._index_column(data)
        self.label = None if request.labels is None else self._column(request.labels)
        self.chosen = self._chosen()

    def field(self) -> str:
        """The columns that are read."""
        return self.request.field or ",".join(self.columns[i] for i in self.chosen)

    def contents(self) -> Contents:
        """The columns as one entry."""
        return Contents(self.address, (Entry(None, self.field(), (len(self.chosen),), kind="table"),))

    def blocks(self) -> Iterator[Block]:
        """The rows, a number of them at a time."""
        most = rows_of(8 * self.width)
        episode, label = 0, None
        with self._text() as file:
            lines = itertools.islice(self._lines(file), int(self.header), None)
            while batch := list(itertools.islice(lines, most)):
                block, episode, label = self._block(batch, episode, label)
                yield block

    def _block(self, batch: list[tuple[int, str]], episode: int, label: str | None) -> tuple[Block, int, str | None]:
        table = self._fast([line for _, line in batch])
        times: npt.NDArray[np.float64] | None = None
        episodes = None
        if table is None:
            rows = [self._row(line, number) for number, line in batch]
            table = np.array([[self._value(cells[i], number, i) for i in self.chosen] for number, cells in rows])
            if self.time is not None:
                times = np.array([self._time_of(cells[self.time], number) for number, cells in rows])
            if self.label is not None:
                numbers = []
                for _, cells in rows:
                    name = cells[self.label].strip()
                    if name != label:
                        episode, label = episode + 1, name
                        if name:
                            self.names[episode] = name
                    numbers.append(episode)
                episodes = np.array(numbers, np.int64)
        elif self.time is not None:
            times, table = table[:, -1], table[:, :-1]
        clocks = {} if times is None or self.time is None else {self.columns[self.time]: self._in_seconds(times)}
        return Block(table, clocks, {}, episodes), episode, label

    def _fast(self, lines: list[str]) -> npt.NDArray[np.float64] | None:
        """All numbers at once, by numpy's parser; None where a row needs a closer look."""
        if (
            self.label is not None
            or self.delimiter == '"'
            or len(self.delimiter) != 1
            or (self.delimiter != " " and any(line.count(self.delimiter) != self.width - 1 for line in lines))
        ):
            return None
        if self.request.decimal == ",":
            lines = [line.replace(",", ".") for line in lines]
        columns = self.chosen + ([] if self.time is None else [self.time])
        try:
            if self.delimiter == " ":
                whole = np.loadtxt(lines, comments=None, ndmin=2)
                return whole[:, columns] if whole.shape[1] == self.width else None
            lines = [self._empty.sub("nan", line) for line in lines]  # numpy's parser refuses what is missing
            return np.loadtxt(lines, delimiter=self.delimiter, comments=None, ndmin=2, usecols=columns)
        except ValueError:
            return None

    def _row(self, line: str, number: int) -> tuple[int, list[str]]:
        cells = self._cells(line, number)
        if len(cells) != self.width:
            raise RecordingError(
                f"{self.address}, row {number}: expected {self.width} cells as in the rows before it; came {len(cells)}"
            )
        return number, cells

    def _value(self, cell: str, number: int, column: int) -> float:
        if is_missing(cell):
            return float("nan")
        text = cell.replace(",", ".") if self.request.decimal == "," else cell
        if is_number(text):
            return float(text)
        hint, argument = "", None
        if self.request.decimal == "." and is_number(cell.replace(",", ".")):
            hint, argument = ". For numbers with a decimal comma pass decimal=','", "decimal"
        elif self.request.field is None:
            hint = ". Name the columns with numbers by field='first:last', or the column of labels by labels="
            argument = "field labels"
        raise RecordingError(
            f"{self.address}, row {number}, column {column + 1} ({self.columns[column]}): expected a number; "
            f"came {cell!r:.60}{hint}",
            argument=argument,
        )

    def _time_of(self, cell: str, number: int) -> float:
        if is_number(cell) or is_missing(cell) or self.time is None:
            return self._value(cell, number, self.time or 0)
        try:
            moment = datetime.fromisoformat(cell.strip())
        except ValueError:
            return self._value(cell, number, self.time)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()

    def _in_seconds(self, times: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """By the unit in the column's name, or as milli-, micro- or nanoseconds since 1970 by their size."""
        match = _TIME.fullmatch(self.columns[self.time or 0])
        if match and match[1]:
            return times / _UNITS.get(match[1].lower(), 1.0)
        largest = float(np.nanmax(np.abs(times), initial=0.0))
        return times / next((factor for size, factor in ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3)) if largest > size), 1.0)

    def _header(self, rows: list[tuple[int, list[str]]]) -> bool:
        if self.request.header is not None:
            return self.request.header
        first = rows[0][1]
        text = [cell for cell in first if not is_number(cell) and not is_missing(cell)]
        odd = [cell for cell in text if self.request.decimal == "." and is_number(cell.replace(",", "."))]
        numbers = [cell.strip() for cell in first if is_number(cell)]
        counted = numbers == [str(i) for i in range(len(numbers))]
        if not odd and not counted and len(text) < len(numbers):
            odd = text
        if odd:
            self.columns = [str(i) for i in range(self.width)]
            self._value(odd[0], rows[0][0], first.index(odd[0]))  # says what is wrong with it
        if text or not numbers or not counted:
            return bool(text)
        # One or two cells may be a reading of 0 and 1: there the rows below have to look otherwise.
        below = rows[1][1] if len(rows) > 1 else []
        return len(numbers) >= 3 or not first[0].strip() or any("." in cell for cell in below)

    def _time_column(self) -> int | None:
        clock = self.request.clock
        if clock is not None:
            return self._column(clock)
        names = self.columns if self.header or self.comment else []
        return next((i for i, name in enumerate(names) if _TIME.fullmatch(name)), None)

    def _index_column(self, data: list[list[str]]) -> int | None:
        """The first column, where it has no name and counts the rows from 0 or 1."""
        if not self.header or self.columns[0].lower() not in ("", "index", "unnamed: 0") or not data:
            return None
        cells = [cells[0].strip() for cells in data]
        return 0 if any(cells == [str(i + first) for i in range(len(cells))] for first in (0, 1)) else None

    def _column(self, name: str) -> int:
        if name in self.columns:
            return self.columns.index(name)
        if re.fullmatch(r"\d{1,6}", name) and int(name) < self.width and not self.header:
            return int(name)
        raise FieldError(f"{self.address} has no column {name!r}{nearest(name, self.columns)}")

    def _chosen(self) -> list[int]:
        rest = [i for i in range(self.width) if i not in (self.time, self.index, self.label)]
        if self.request.field is None:
            if not rest:
                raise RecordingError(f"{self.address} has no column of numbers besides its times, index and labels")
            return rest
        chosen: list[int] = []
        for part in self.request.field.split(","):
            name = part.strip()
            first, mark, last = name.partition(":")
            if mark and name not in self.columns:
                chosen.extend(range(self._column(first.strip()), self._column(last.strip()) + 1))
            elif name in self.columns:
                chosen.append(self._column(name))
            else:
                matching = [i for i in rest if fnmatch.fnmatchcase(self.columns[i], name)]
                chosen.extend(matching or [self._column(name)])
        if not chosen:
            raise FieldError(
                f"{self.address}: field {self.request.field!r} names no column, or the last before the first"
            )
        return chosen

    def _cells(self, line: str, number: int) -> list[str]:
        if self.delimiter == " ":
            return line.split()
        try:
            return next(csv.reader([line], delimiter=self.delimiter, skipinitialspace=True))
        except (csv.Error, StopIteration, TypeError) as error:
            raise RecordingError(
                f"{self.address}, row {number}, cannot be read as a table: {error}. Is a quotation mark never closed?"
            ) from error

    def _text(self) -> TextIO:
        return self.path.open(encoding="utf-8-sig", newline=None)

    def _lines(self, file: TextIO) -> Iterator[tuple[int, str]]:
        number = 0
        while line := file.readline(LONGEST):
            number += 1
            if len(line) == LONGEST:
                raise RecordingError(f"{self.address}, row {number}, is longer than any table's; is it another file?")
            if line.startswith("#"):
                self.comment = line.lstrip("#").strip()
            elif line.strip():
                yield number, line


def _delimiter(lines: list[str], decimal: str) -> str:
    """What separates cells: the first of ; tab | , and space that splits all lines alike."""
    for mark in (";", "\t", "|", ",", " "):
        if mark == "," and decimal == ",":
            continue
        counts = {len(line.split()) if mark == " " else line.strip("\n").count(mark) + 1 for line in lines[:_SEEN]}
        if len(counts) == 1 and counts != {1}:
            return mark
    marks = {mark: sum(mark in line for line in lines) for mark in ";\t|,"}
    best = max(marks, key=lambda mark: marks[mark])
    return best if marks[best] else ","
