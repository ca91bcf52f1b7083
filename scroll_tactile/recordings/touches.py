"""Touches out of a recording: cut by episodes, by intervals in a table, or by a function; and what names them."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from os import PathLike, fspath
from pathlib import Path, PurePosixPath
from typing import Any, Literal, TextIO

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FieldError, InputError, RecordingError
from scroll_tactile.quantities import Quantity
from scroll_tactile.recordings.bounds import require_file
from scroll_tactile.recordings.delimited import LONGEST
from scroll_tactile.recordings.headings import Heading, Noted
from scroll_tactile.recordings.paths import nearest
from scroll_tactile.recordings.recording import Episode, Recording, longest_step

__all__ = ["Interval", "Touch", "declared_quantities", "read_intervals", "require_found", "touches"]

_MOST, _LONGEST_NAMES = 1 << 25, 1 << 16  # characters of a table of intervals, which are a million; and of its names


@dataclass(frozen=True)
class Interval:
    """A touch of `material` in a file, from `begin` to before `end` in seconds of the recording's clock.

    Where a recording's times are times of day, those below a million count from its first reading. `row` is where it
    stands. values: (quantity, unit, value) of each that was measured; labels: (axis, label).
    """

    file: str
    begin: float
    end: float
    material: str
    row: int = 0
    values: tuple[tuple[str, str, float], ...] = ()
    labels: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, eq=False)
class Touch:
    """Some readings of a recording in one piece, with their times; material is None where nothing names it.

    source: the recording's address. begin, end: which of its readings. values, labels: as of its interval.
    """

    source: str
    begin: int
    end: int
    readings: npt.NDArray[Any]
    times: npt.NDArray[np.float64]
    material: str | None
    values: tuple[tuple[str, str, float], ...] = ()
    labels: tuple[tuple[str, str], ...] = ()

    @property
    def name(self) -> str:
        """The file's name and where in it: "felt.mcap[120:240]"."""
        return f"{_place(self.source).name}[{self.begin}:{self.end}]"


Cut = Literal["whole", "episodes"] | Sequence[Interval] | Callable[[Recording], Iterable[tuple[int, int]]]


def touches(recording: Recording, cut: Cut = "whole", label: str | None = None) -> tuple[Touch, ...]:
    """The touches in a recording.

    cut: "whole" (all readings are one touch), "episodes", a table's intervals (those of this file), or a function that
        gives the begin and end of each touch, such as one that watches for contact.
    label: what names a touch: the "topic", the name of the "file" (without suffix) or of its "folder", the "task" that
        its episode is called, or "group:2", the second part of the path in the file where a pattern found it; of those
        "folder" is the first part in which their paths differ. Without it intervals and episodes name their own, and
        the whole recording has no name but that of all its episodes, where they have the same.

    Raises InputError for a recording without episodes, without the requested label or with an empty one, for intervals
    of which none is of this file, which lie outside it, or overlap and name two materials, and for spans that a
    function gives outside the recording.
    """
    intervals: Sequence[Interval] = ()
    if isinstance(cut, str):
        if cut not in ("whole", "episodes"):
            raise InputError(f"expected cut 'whole', 'episodes', intervals or a function; came {cut!r}")
        if cut == "episodes" and not recording.episodes:
            raise InputError(f"{recording.source} has no episodes: cut it by intervals=, or not", argument="intervals")
        names = {episode.name for episode in recording.episodes}
        whole = Episode(0, len(recording), names.pop() if len(names) == 1 else None)
        spans = recording.episodes if cut == "episodes" else (whole,)
    elif callable(cut):
        spans = tuple(_during(recording, begin, end) for begin, end in cut(recording))
        for span in spans:
            if not 0 <= span.begin < span.end <= len(recording):
                raise InputError(f"a cut gave readings {span.begin} to {span.end} of {len(recording)}")
    else:
        intervals = [interval for interval in cut if _same(interval.file, recording.source)]
        spans = _of_intervals(recording, intervals, cut)
    return tuple(
        Touch(
            recording.source,
            span.begin,
            span.end,
            recording.readings[span.begin : span.end],
            recording.times[span.begin : span.end],
            _label(recording, span, label),
            *((intervals[i].values, intervals[i].labels) if intervals else ()),
        )
        for i, span in enumerate(spans)
    )


def _label(recording: Recording, span: Episode, label: str | None) -> str | None:
    place = _place(recording.source)
    if label is None:
        return span.name
    level = re.fullmatch(r"group:(\d{1,4})", label, re.ASCII)
    if level is None and label not in ("topic", "file", "folder", "task"):
        raise InputError(f"expected a label by 'topic', 'file', 'folder', 'task' or 'group:2'; came {label!r}")
    parts = [episode.path.split("/") for episode in recording.episodes if episode.path]
    if level is not None or (label == "folder" and len(parts) > 1):
        path = span.path.split("/")
        differing = (i for i, names in enumerate(zip(*parts, strict=False)) if len(set(names)) > 1)
        place_in = int(level[1]) - 1 if level else next(differing, 0)
        name: str | None = path[place_in] if 0 <= place_in < len(path) else ""
        if not span.path or not name or (level is None and not any(map(str.isalpha, name))):
            there = ", ".join(f"by='group:{i + 1}', {part}" for i, part in enumerate(path[:-1]))
            raise InputError(
                f"{recording.source} has no {label} to be named by: readings {span.begin} to {span.end} lie in "
                + (
                    f"{span.path}; expected {there}"
                    if span.path
                    else "no groups that a pattern as group/*/tactile found"
                ),
                argument="by field",
            )
    elif label == "task":
        name = span.name
    elif label == "topic":
        name = None if recording.topic is None else recording.topic.rstrip("/").rpartition("/")[2]
    else:
        name = place.name.partition(".")[0] if label == "file" else place.parent.name
    if name is None or not name.strip():
        raise InputError(f"{recording.source}, readings {span.begin} to {span.end}, has no {label} to be named by")
    return name.strip()


def _during(recording: Recording, begin: int, end: int) -> Episode:
    """A span, called as the episode is in which its middle lies."""
    around = (e for e in recording.episodes if e.begin <= (begin + end) // 2 < e.end)
    return replace(next(around, Episode(begin, end)), begin=begin, end=end)


def _place(source: str) -> PurePosixPath:
    if "://" in source:
        return PurePosixPath(source.partition("://")[2])
    return PurePosixPath(Path(source).resolve().as_posix())


def _of_intervals(recording: Recording, mine: Sequence[Interval], intervals: Sequence[Interval]) -> tuple[Episode, ...]:
    """The spans of the intervals that are of a recording, out of some."""
    if not mine:
        files = list(dict.fromkeys(interval.file for interval in intervals))
        raise InputError(f"no interval is of {recording.source}{nearest(_place(recording.source).name, files)}")
    times = recording.times
    if not np.isfinite(times).all():
        raise InputError(
            f"{recording.source} has no clock to cut intervals by: give clock= or rate= as it is read",
            argument="clock rate",
        )
    if (np.diff(times) < 0).any():
        raise InputError(
            f"{recording.source}: time goes back, so that intervals have no place: give another clock=",
            argument="clock",
        )
    first, last = (float(times[0]), float(times[-1])) if len(times) else (0.0, 0.0)
    slack = longest_step(float(np.median(np.diff(times))) if len(times) > 1 else 0.0)  # tables round
    spans: list[Episode] = []
    for interval in mine:
        start = first if first > 1e6 and interval.end < 1e6 else 0.0
        begin, end = np.searchsorted(times, [interval.begin + start, interval.end + start]).tolist()
        outside = interval.begin + start < first - slack or interval.end + start > last + slack
        if end <= begin or outside:
            lies = "lies outside" if end > begin else "holds no reading of"
            raise InputError(
                f"row {interval.row} of the intervals, {interval.begin:g} to {interval.end:g} s, {lies} "
                f"{recording.source}, which lasts from {first - start:g} to {last - start:g} s"
            )
        spans.append(Episode(begin, end, interval.material))
    pairs = sorted(zip(spans, mine, strict=True), key=lambda pair: pair[0].begin)
    latest = pairs[0]
    for span, interval in pairs[1:]:
        if span.begin < latest[0].end and interval.material != latest[1].material:
            raise InputError(
                f"rows {latest[1].row} and {interval.row} of the intervals overlap in {recording.source}, and name two "
                f"materials: {latest[1].material!r} until {latest[1].end:g} s, {interval.material!r} from "
                f"{interval.begin:g} s"
            )
        latest = max(latest, (span, interval), key=lambda pair: pair[0].end)
    return tuple(spans)


def _same(file: str, source: str) -> bool:
    """Whether a file in a table is this one: its path ends alike, part by part; a suffix may be left out."""
    given, place = PurePosixPath(file.replace("\\", "/")), _place(source)
    parts = [part for part in given.parts if part not in (".", "..")]
    alike = bool(parts) and tuple(parts[:-1]) == place.parts[-len(parts) : -1]
    return alike and parts[-1] in (place.name, place.stem)


def require_found(intervals: Iterable[Interval], files: Sequence[str]) -> None:
    """Raise InputError for an interval whose file is none of these, or fits several of them."""
    called: dict[str, list[str]] = {}  # by name, with and without the suffix; each pair would be too many
    for file in files:
        place = _place(file)
        for name in {place.name, place.stem}:
            called.setdefault(name, []).append(file)
    for interval in intervals:
        name = PurePosixPath(interval.file.replace("\\", "/")).name
        fitting = [file for file in called.get(name, ()) if _same(interval.file, file)]
        if len(fitting) == 1:
            continue
        where = f"row {interval.row} of the intervals: {interval.file!r}"
        if not fitting:
            raise InputError(f"{where} is none of the recordings{nearest(interval.file, files)}")
        parts = _place(fitting[0]).parts
        longer = ("/".join(parts[-count:]) for count in range(2, len(parts)))
        alone = next((text for text in longer if not any(_same(text, other) for other in fitting[1:])), fitting[0])
        listed = ", ".join(fitting[:5]) + (f" and {len(fitting) - 5} more" if len(fitting) > 5 else "")
        raise InputError(f"{where} fits {len(fitting)} recordings, {listed}: write more of its path, such as {alone}")


def read_intervals(path: str | PathLike[str]) -> list[Interval]:
    """The intervals in a table with the columns file, begin, end and material (or label), in any order.

    A column with brackets is noted of each touch that has something there: values under "force [N]", of a quantity that
    the memory has in this unit, or under "force [N] 0..10 step 0.01", which `declared_quantities` has; labels on the
    axis slip under "slip [label]". Other columns are passed over.

    Raises FieldError for a column that is missing, or there twice; RecordingError for a table that cannot be read;
    InputError for a row whose times are no numbers or end before they begin, whose material is empty, that has
    more cells than the table has columns, or a value which is no number.
    """
    names, headings, table = _table(path)
    found = []
    for row, cells in table:
        where = f"{path}, row {row}"
        if beyond := [cell for cell in cells[len(names) :] if cell.strip()]:
            raise InputError(
                f"{where}: expected {len(names)} cells, {', '.join(names)}; came {len(cells)}, the last "
                f"{beyond[-1]!r:.60}. A cell with a comma in it stands in quotation marks"
            )
        found.append(_interval(where, row, dict(zip(names, cells, strict=False)), headings))
    return found


def declared_quantities(path: str | PathLike[str]) -> list[Quantity]:
    """The quantities whose range the headings of a table of intervals say. Raises as `read_intervals`."""
    return [heading.quantity for heading in _table(path)[1].values() if heading.quantity is not None]


def _table(path: str | PathLike[str]) -> tuple[list[str], dict[str, Heading], list[tuple[int, list[str]]]]:
    """The names of a table's columns, what those with brackets say, and its rows with their numbers.

    Names without brackets are in lower case.
    """
    try:
        require_file(Path(fspath(path)))
        with Path(fspath(path)).open(encoding="utf-8-sig", newline="") as file:
            lines = _lines(path, file)
            first = next(lines, "")
            delimiter = next((mark for mark in ";\t," if mark in first), ",")
            cells = [cell.strip() for cell in next(csv.reader([first], delimiter=delimiter), [])]
            table = [(i + 2, row) for i, row in enumerate(csv.reader(lines, delimiter=delimiter)) if any(row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RecordingError(f"{path} cannot be read as a table of intervals: {error}") from error
    headings = {cell: heading for cell in cells if (heading := Heading.found(cell)) is not None}
    names = [cell if cell in headings else cell.lower() for cell in cells]
    names = ["material" if name == "label" else name for name in names]
    for name in ("file", "begin", "end", "material"):
        if name not in names:
            raise FieldError(f"{path} has no column {name!r}; expected file, begin, end, material; there are {names}")
    noted = [headings[name].name for name in names if name in headings]
    if twice := sorted({name for name in noted if noted.count(name) > 1}):
        raise FieldError(f"{path} has several columns {twice[0]!r} with a unit; expected one")
    return names, headings, table


def _lines(path: str | PathLike[str], file: TextIO) -> Iterator[str]:
    """The lines of a table; raises RecordingError where it, or one of them, is longer than any table's."""
    total, longest = 0, _LONGEST_NAMES
    while line := file.readline(longest):
        total += len(line)
        if len(line) == longest or total > _MOST:
            what = f"more than {_MOST} characters" if total > _MOST else f"a line of {longest} characters and more"
            raise RecordingError(f"{path} has {what}; expected a table of intervals: is it another file?")
        yield line
        longest = LONGEST


def _interval(where: str, row: int, cells: dict[str, str], headings: dict[str, Heading]) -> Interval:
    file, material = cells.get("file", "").strip(), cells.get("material", "").strip()
    if not file or not material:
        raise InputError(f"{where}: expected a file and a material; came {file!r} and {material!r}")
    try:
        begin, end = float(cells.get("begin", "")), float(cells.get("end", ""))
    except ValueError as error:
        raise InputError(f"{where}: expected begin and end in seconds: {error}") from error
    if not (math.isfinite(begin) and math.isfinite(end) and begin < end):
        raise InputError(f"{where}: expected begin before end; came {begin:g} and {end:g}")
    noted = _noted(where, cells, headings)
    return Interval(
        file=file, begin=begin, end=end, material=material, row=row, values=noted.values, labels=noted.labels
    )


def _noted(where: str, cells: dict[str, str], headings: dict[str, Heading]) -> Noted:
    """What the columns of a row that have brackets say."""
    values, labels = [], []
    for text, heading in headings.items():
        if not (cell := cells.get(text, "").strip()):
            continue
        if heading.unit is None:
            labels.append((heading.name, cell))
            continue
        try:
            values.append((heading.name, heading.unit, float(cell)))
        except ValueError as error:
            raise InputError(f"{where}: expected {text!r} as a number: {error}") from error
    return Noted(tuple(values), tuple(labels))
