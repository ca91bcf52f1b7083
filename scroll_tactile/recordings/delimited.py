"""Tables of text as a source, `.csv` as loggers, spreadsheets and robots write them."""

from __future__ import annotations

import fnmatch
import itertools
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FieldError, RecordingError, ScrollTactileError
from scroll_tactile.recordings.blocks import Block, Contents, Entry, Request, in_seconds, is_clock, rows_of
from scroll_tactile.recordings.paths import nearest
from scroll_tactile.recordings.text import FEWEST, LONGEST, Layout, Text, modal_length, moment, number

__all__ = ["LONGEST", "SUFFIXES", "Delimited"]

SUFFIXES = (".csv", ".tsv", ".txt", ".dat")

_MOST_COLUMNS = 1 << 18  # a picture of 320 × 240 in three colours has 230 400
_SEEN, _SEEN_TEXT = 200, 1 << 20  # lines, and characters of them, are looked at to say what a table is
_SAMPLE = 32  # of these lines say what separates cells
_SEPARATED = re.compile(r'"?sep=(.)"?', re.IGNORECASE)
_COUNTS = frozenset(("", "index", "idx", "unnamed: 0", "frame", "frame_index", "seq", "sequence", "sample", "row"))
_UNIT = re.compile(
    r"[\[(].*[\])]|[munµkM]?(?:s|N|V|A|g|m|bar|Pa|Hz|Ω|ohm|N·?m)|hPa|psi|°?[CFK]|sec(?:onds)?|counts?|raw|a\.?u\.?|-|%|"
    "°|rad|deg|lsb|ticks",
    re.IGNORECASE,
)
_BLANK = dict.fromkeys(("", " ", "NA", "N/A", "#N/A", "null", "None", "-", "-nan(ind)", "\n", "\t"), "nan")

Floats = npt.NDArray[np.float64]


class Delimited(Text):
    """A table of text; see `Source`.

    The rows before the numbers name columns where they have as many cells: names, and units below or above them. A
    header may also count 0, 1, 2 … as that of pandas does. A first column that counts rows and is called so, or has no
    name, is left out. A column that is called as times are holds the times.
    """

    continuous = labels = True

    def __init__(self, path: Path, address: str, request: Request) -> None:
        super().__init__(path, address, request)
        head, delimiter = self._head(), request.delimiter
        if head and (said := _SEPARATED.fullmatch(head[0][1].strip())):
            delimiter = request.delimiter or said[1]
            head.pop(0)
        if not head:
            raise RecordingError(f"expected readings in {address}, one row each; there are none")
        lines = [line for _, line in head if not line.startswith(("#", "%"))] or [line for _, line in head]
        self.layout = Layout.of(lines[-_SAMPLE:], delimiter, request.decimal)
        rows = [(row, line, self.layout.cells(line)) for row, line in head]
        self.width = modal_length([self.layout.cells(line) for line in lines])
        if self.width > _MOST_COLUMNS:
            raise RecordingError(f"{address} has {self.width} columns; expected at most {_MOST_COLUMNS}")
        self.episode, self.said = 0, ""
        self._understand(rows)

    @classmethod
    def holds_some(cls, path: Path) -> bool:
        """Whether it is a table of numbers, where it may be any text by its name."""
        if path.suffix.lower() in SUFFIXES[:2]:
            return True
        with suppress(ScrollTactileError, OSError, ValueError):
            table = cls(path, str(path), Request())
            return table.numbers == table.chosen and table.looked >= FEWEST
        return False

    def field(self) -> str:
        """The columns that are read."""
        return ",".join(self.columns[i] for i in self.chosen)

    def contents(self) -> Contents:
        """The columns as one entry."""
        return Contents(self.address, (Entry(None, self.field(), (len(self.chosen),), kind="table"),))

    def blocks(self) -> Iterator[Block]:
        """The rows, a number of them at a time."""
        most = rows_of(8 * self.width)
        lines = ((row, line) for row, line in self.lines() if row >= self.begin)
        last = None  # is given when all are read, and what was odd is known
        while batch := list(itertools.islice(lines, most)):
            block = self._block(batch)
            self.require_few()
            if len(block.readings):
                if last is not None:
                    yield last
                last = block
        self.finish()
        if last is not None:
            yield last

    def _block(self, batch: list[tuple[int, str]]) -> Block:
        rows: list[tuple[int, list[str]]] = []
        if (table := self._whole(batch)) is None:
            rows = [(row, self.layout.cells(line)) for row, line in batch]
            rows = [each for each, (_, line) in zip(rows, batch, strict=True) if self._fits(*each, line)]
            table = self._flat(rows)
        if table is None:
            found = [self._values(row, cells) for row, cells in rows]
            rows = [each for each, values in zip(rows, found, strict=True) if values is not None]
            table = np.array([values for values in found if values is not None], np.float64)
        table, clocks = table.reshape(-1, len(self.wanted)), {}
        if self.time is not None:
            name, unit = self.columns[self.time], self.units[self.time]
            clocks, table = {name: in_seconds(table[:, -1], name, unit)}, table[:, :-1]
        self.empty += int(np.isnan(table).all(axis=1).sum())
        return Block(table, clocks, {}, self._episodes([cells for _, cells in rows]))

    def _whole(self, batch: list[tuple[int, str]]) -> Floats | None:
        """All numbers by numpy's parser, the fastest; None where a row needs a closer look."""
        mark = self.layout.delimiter
        if self.label is not None or self.unended or self.layout.decimal == ",":
            return None
        with suppress(ValueError):
            lines = [line for _, line in batch]
            table = np.loadtxt(lines, delimiter=None if mark == " " else mark, comments=None, ndmin=2)
            if table.shape[1] == self.width:
                self.seen += len(table)
                return table[:, self.wanted]
        return None

    def _flat(self, rows: list[tuple[int, list[str]]]) -> Floats | None:
        """The numbers where all cells are such, or missing as most programs write it; None otherwise."""
        flat = [_BLANK.get(cells[i], cells[i]) for _, cells in rows for i in self.wanted]
        text, comma = "".join(flat), self.layout.decimal == ","
        if "_" in text or not text.isascii() or self.unended or (comma and "." in text):
            return None  # float takes 1_000, and digits of all scripts; a point may stand before thousands
        with suppress(ValueError):
            flat = [cell.replace(",", ".") for cell in flat] if comma else flat
            return np.fromiter(map(float, flat), np.float64, len(flat))
        return None

    def _fits(self, row: int, cells: list[str], line: str) -> bool:
        """Whether a row has the table's number of cells, or a delimiter more; others are comments, or left out."""
        comment = line.startswith(("#", "%")) and len(cells) != self.width
        self.seen += not comment
        if len(cells) == self.width or (len(cells) == self.width + 1 and not cells[-1].strip()):
            return True
        if not comment:
            self._leave(row, f": expected {self.width} cells as the others have; came {len(cells)}")
        return False

    def _episodes(self, rows: list[list[str]]) -> npt.NDArray[np.int64] | None:
        """The number of the episode of each row, which changes with the label."""
        if self.label is None:
            return None
        numbers = []
        for cells in rows:
            name = self.named(cells[self.label])
            if name != self.said or not self.episode:
                self.episode, self.said = self.episode + 1, name
                self.names |= {self.episode: name} if name else {}
            numbers.append(self.episode)
        return np.array(numbers, np.int64)

    def _values(self, row: int, cells: list[str]) -> list[float | None] | None:
        """The numbers of a row, its time last; None where there is text in their place."""
        if row == self.unended and self._is_half(cells[self.width - 1]):
            self._leave(row, ": it has no end")
            return None
        found = [number(cells[i], self.layout.decimal) for i in self.chosen]
        if self.time is not None:
            found.append(moment(cells[self.time], self.layout.decimal))
        if None not in found:
            return found
        place, hint, argument = self.wanted[found.index(None)], "", ""
        if self.request.field is None and self.numbers and place not in (*self.numbers, self.time):
            names = [self.columns[i] for i in self.numbers]
            beside = self.numbers[-1] - self.numbers[0] + 1 == len(names) > 1
            field = f"{names[0]}:{names[-1]}" if beside else ",".join(names)
            hint = f". Name the columns with numbers by field={field!r:.200}, or the column of labels by labels="
            argument = "field labels"
        what = f"expected a number; came {cells[place].strip()!r:.60}{hint}"
        self._leave(row, f", column {place + 1} ({self.columns[place]}): {what}", argument or None)
        return None

    def _is_half(self, cell: str) -> bool:
        """Whether the last cell of a line without an end is cut: empty, a sign, or of fewer decimals than others."""
        return cell.strip() in ("", "-", "+") or len(cell.strip().partition(self.layout.decimal)[2]) < self.tail

    def _leave(self, row: int, what: str, argument: str | None = None) -> None:
        self.leave_out(row, RecordingError(f"{self.address}, row {row}{what}", argument=argument))

    def _head(self) -> list[tuple[int, str]]:
        """The first lines, a name of several lines in quotation marks as one."""
        head: list[tuple[int, str]] = []
        size, open_ = 0, False
        for row, line in self.lines():
            if open_:
                head[-1] = (row, f"{head[-1][1]}\n{line}")
            elif (size > _SEEN_TEXT and len(head) > 3) or len(head) == _SEEN:
                break
            else:
                head.append((row, line))
            size += len(line)
            open_ ^= line.count('"') % 2 == 1
        return head

    def _understand(self, rows: list[tuple[int, str, list[str]]]) -> None:
        """What the first rows are: names and units of columns, and from which row on there are numbers."""
        point, header = self.layout.decimal, self.request.header
        same = [cells for _, _, cells in rows if len(cells) == self.width]
        if self.layout.delimiter != " " and self.width > 1 and not any(cells[-1].strip() for cells in same):
            self.width -= 1  # a delimiter stands behind each row
        sure = same[2 * len(same) // 3 :][-min(_SAMPLE, max(3, _MOST_COLUMNS // self.width)) :]
        numeric = [2 * sum(number(c[i], point) is not None for c in sure) > len(sure) for i in range(self.width)]
        above: list[list[str]] = []
        for i, (self.begin, line, cells) in enumerate(rows):
            if line.startswith(("#", "%")) and len(cells) != self.width:
                cells = self.layout.cells(line.lstrip("#% "))  # noqa: PLW2901
            elif header is not None or (above and not any(numeric)):
                if not header or above:
                    break
            elif not self._heads(cells, numeric):
                texts = any(number(cell, point) is None for cell in cells)
                if not texts or not any(self._heads(own, numeric) for _, _, own in rows[i + 1 : i + 4]):
                    break  # unless it is in a preamble, which goes on behind it
            above.append(cells)
        else:
            self.begin += 1
        data = [cells for row, _, cells in rows if row >= self.begin and self.width <= len(cells) <= self.width + 1]
        named = [cells for cells in above if self.width <= len(cells) <= self.width + 1]
        others = len(above) - len(named)
        numbers = [[cell for cell, own in zip(cells, numeric, strict=False) if own] for cells in data]
        if header is None and not named and self._counts(numbers):
            named, self.begin = [data.pop(0)], self.begin + 1
        units = next((cells for cells in named if len(named) > 1 and _are_units(cells)), None)
        names = next((cells for cells in reversed(named) if cells is not units), None)
        self.header = names is not None
        self.units = (units or [""] * self.width)[: self.width]
        self.columns = [self.named(name) for name in (names or map(str, range(self.width)))][: self.width]
        self.columns[0] = self.columns[0].lstrip("#% ")
        if others:
            self.notes.append(f"{others} rows above the numbers name no column")
        self._assign(data, numeric)

    def _assign(self, data: list[list[str]], numeric: list[bool]) -> None:
        """Which columns are times, labels and readings, by the first rows of numbers; others are left out."""
        own, self.looked = data[:-1] if self.unended else data, len(data)
        last = [cells[self.width - 1].strip() for cells in own] if len(own) > FEWEST else [""]
        self.tail = modal_length(
            [cell.partition(self.layout.decimal)[2] for cell in last]
        )  # decimals of the last column
        self.time = None if self.request.clock is None else self._column(self.request.clock)
        apart = []
        for i, name in enumerate(self.columns if self.header else []):
            if name.lower() == "date":
                apart.append(i)
            elif is_clock(name):
                told = sum(moment(cells[i], self.layout.decimal) is not None for cells in own)
                if self.time is None and 2 * told >= len(own):
                    self.time = i
                else:
                    apart.append(i)
            elif re.split("[./]", name.lower())[-1] in _COUNTS and _count(cells[i] for cells in own):
                apart.append(i)
        self.label = None if self.request.labels is None else self._column(self.request.labels)
        if said := [name for i in apart if (name := self.columns[i]) not in ("", "index", "Unnamed: 0")]:
            self.notes.append(f"left out, as they count or are further times: {', '.join(said)}")
        rest = [i for i in range(self.width) if i not in (self.time, self.label, *apart)]
        self.numbers = [i for i in rest if numeric[i]]
        self.chosen = self._chosen(rest)
        self.wanted = self.chosen if self.time is None else [*self.chosen, self.time]

    def _heads(self, cells: list[str], numeric: list[bool]) -> bool:
        """Whether a row stands above the numbers: it has text in their place, in as many cells as it has numbers."""
        point = self.layout.decimal
        own = [c for i, c in enumerate(cells) if i >= self.width or numeric[i] or not any(numeric)]
        numbers = [c.strip() for c in own if number(c, point) is not None and c.strip()]
        text = sum(number(c, point) is None for c in own)
        return text > 0 and (text >= len(numbers) or numbers == [str(i) for i in range(len(numbers))])

    def _counts(self, data: list[list[str]]) -> bool:
        """Whether the first of rows of numbers counts 0, 1, 2 …: one or two may be a reading like those below."""
        if not any(data[:1]):
            return False
        numbers = [cell.strip() for cell in data[0] if cell.strip()]
        counted = bool(numbers) and numbers == [str(i) for i in range(len(numbers))]
        unlike = not data[0][0].strip() or any("." in cell for cell in (data[1] if len(data) > 1 else []))
        return counted and (len(numbers) >= 3 or unlike)

    def _column(self, name: str) -> int:
        for each in (name, name.lstrip("#% "), self.named(name)):
            if each in self.columns:
                return self.columns.index(each)
        if re.fullmatch(r"\d{1,6}", name) and int(name) < self.width and not self.header:
            return int(name)
        raise FieldError(f"{self.address} has no column {name!r}{nearest(name, self.columns)}")

    def _chosen(self, rest: list[int]) -> list[int]:
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


def _count(cells: Iterable[str]) -> bool:
    """Whether each cell is one more than that before."""
    found = [cell.strip() for cell in cells]
    first = int(found[0]) if found and re.fullmatch("[0-9]{1,18}", found[0]) else None
    return first is not None and found == [str(first + i) for i in range(len(found))]


def _are_units(cells: list[str]) -> bool:
    """Whether all cells are units of measurement, in brackets or known ones."""
    texts = [cell.strip() for cell in cells if cell.strip()]
    return bool(texts) and all(map(_UNIT.fullmatch, texts))
