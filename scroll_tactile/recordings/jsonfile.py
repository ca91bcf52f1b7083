"""JSON as a source: lines of objects or lists, and documents with lists of them, as teleoperation is recorded."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from scroll_tactile.errors import FieldError, RecordingError, ScrollTactileError
from scroll_tactile.recordings.blocks import Block, Contents, Entry, Request, in_seconds, is_clock, rows_of
from scroll_tactile.recordings.paths import FieldPath
from scroll_tactile.recordings.text import FEWEST, Text, moment

__all__ = ["SUFFIXES", "JsonFile"]

SUFFIXES = (".json", ".jsonl", ".ndjson")

_LARGEST = 1 << 29  # bytes of a document, which becomes some eight times as many; lines may be as many as they are
_LOOKED = 200  # lines, to say what there is
_PARTS = 32  # objects in a list inside another object; where they are more, they are readings
_RATE = re.compile(r'"(fps|hz|freq|frequency|rate|sampl\w+_rate)"\s*:\s*(\d+(?:\.\d+)?)')
_LIST = re.compile(r"\[\s*(?=[{\[])")
_BETWEEN = re.compile(r"[\s,]*")
_NAMES = ("material", "label", "task")
_COUNTERS = ("idx", "index", "frame", "frame_index", "seq", "id")

Listed = tuple[str, list[Any], list[Any], str | None]


class JsonFile(Text):
    """JSON lines, or a document; see `Source`.

    A line, or an element of a list, is a reading: a list of numbers, or an object in which `field` leads to them, and
    `clock`, or a key that is called as times are, to its time. Each list in a document is an episode where there are
    several. A document may also have one list of all readings, and one of their times beside it.
    """

    labels = True

    def __init__(self, path: Path, address: str, request: Request) -> None:
        super().__init__(path, address, request)
        self._head = next(self.pieces(), "").lstrip()
        first, *more = self._head.split("\n", 3)
        several = path.suffix.lower() != ".json" or any(line.strip() for line in more)
        self.by_line = several and first.strip() not in ("[", "{") and any(map(_is_whole, (first, *more[:2])))
        self.path_to, self.clock, self.width = (request.field or "").strip(), request.clock, 0
        self.collected: dict[str, FieldPath] = {}

    @classmethod
    def holds_some(cls, path: Path) -> bool:
        """Whether it has readings: settings and calibrations are JSON, too."""
        with suppress(ScrollTactileError, OSError, ValueError, RecursionError):
            entries = cls(path, str(path), Request()).contents().entries
            return any(entry.shape and (entry.count is None or entry.count >= FEWEST) for entry in entries)
        return False

    def field(self) -> str:
        """The path to the numbers."""
        return self.path_to

    def contents(self) -> Contents:
        """The numbers in the first objects, those of touch first."""
        found: dict[str, tuple[tuple[int, ...], int | None]] = {}
        for _, value in itertools.islice(self._values(), _LOOKED):
            lists = [("", [value])] if self.by_line else [each[:2] for each in _lists(value, _are_readings)]
            for place, rows in lists:
                for name, shape in _leaves(rows[0], "" if isinstance(rows[0], dict) else place):
                    if name in (self.request.clock, self.request.labels):
                        continue
                    found[name] = (shape, None if self.by_line else (found.get(name, ((), 0))[1] or 0) + len(rows))
        entries = [Entry(None, name, shape, count) for name, (shape, count) in found.items()]
        entries.sort(key=lambda entry: (not entry.shape, "tact" not in entry.field.lower()))
        return Contents(self.address, tuple(entries))

    def blocks(self) -> Iterator[Block]:
        """The readings that the field leads to, list after list."""
        if self.request.field is None:
            contents = self.contents()
            lists = [entry for entry in contents.entries if entry.shape] or list(contents.entries)
            if len(lists) != 1:
                raise contents.refused("expected a field to read")
            self.path_to = lists[0].field
        rate = None if self.by_line else _RATE.search(self._head)
        last, readings = None, self._readings()
        while batch := list(itertools.islice(readings, rows_of(8 * max(self.width, 1)))):
            self.require_few()
            if last is not None:
                yield last
            values, times, numbers, places = zip(*batch, strict=True)
            clocks = {}
            if None not in times:
                clocks = {self.clock or "time": in_seconds(np.array(times, np.float64), self.clock or "")}
            elif rate is not None:
                clocks = {rate[1]: np.array(places) / float(rate[2])}
                self.counted = f"it has no times: they are counted at {rate[1]}, {rate[2]}"
            last = Block(np.array(values), clocks, {}, np.array(numbers, np.int64) if numbers[0] else None)
        if last is None:
            raise self.first or self.contents().refused(f"no readings are at {self.path_to!r:.80} in {self.address}")
        self.finish()
        yield last

    def _readings(self) -> Iterator[tuple[Any, float | None, int, int]]:
        """Each reading's values and time, the number of its episode, 0 where there are none, and its place there."""
        number = index = 0
        before: tuple[str, Any] = ("", None)
        for row, value in self._values():
            lists = list(_lists([value] if self.by_line else value, self._leads))
            if self.by_line and not lists:
                self._taken(row, value, [])
            for place, messages, times, name in lists:
                several = bool(place) or self.request.labels is not None
                for i, message in enumerate(messages):
                    if (taken := self._taken(row if self.by_line else i, message, times[i : i + 1])) is None:
                        continue
                    label = name if self.request.labels is None else self._found(message, self.request.labels)[0]
                    if several and (f"{row} {place}" if place else "", label) != before:
                        before, number, index = (f"{row} {place}" if place else "", label), number + 1, 0
                        self.paths[number] = place.replace(".", "/")
                        self.names |= {number: self.named(label)} if isinstance(label, str) and label.strip() else {}
                    yield (*taken, number, index)
                    index += 1

    def _taken(self, row: int, message: Any, times: list[Any]) -> tuple[Any, float | None] | None:
        """A reading's values and its time; None where it is left out."""
        self.seen += 1
        try:
            found = self._found(message, self.path_to)
            with suppress(ValueError, TypeError, OverflowError):
                several = [np.asarray(each, np.float64).reshape(-1) for each in found]
                values = several[0] if len(several) == 1 else np.concatenate(several)
                self.width = self.width or len(values)
                if len(values) == self.width > 0 and found != [None]:
                    return values, self._time(message, times)
            raise FieldError(f"expected {self.width or ''} numbers at {self.path_to!r:.80}; came {found!s:.80}")
        except FieldError as error:
            self.leave_out(row, RecordingError(f"{self.address}, row {row}: {error}"))
            return None

    def _time(self, message: Any, times: list[Any]) -> float | None:
        if self.clock is None and isinstance(message, dict):
            self.clock = next((key for key in message if is_clock(key)), "")
        found = self._found(message, self.clock) if self.clock and isinstance(message, dict) else times
        time = found[0] if found else None
        if found and not isinstance(time, float) and (time := moment(str(found[0]))) is None:
            raise FieldError(f"expected a time at {self.clock!r:.80}; came {found[0]!s:.60}")
        return time

    def _found(self, message: Any, path: str) -> list[Any]:
        """What a path leads to in a message. A key may have letters that no path has; a list may be the reading."""
        if not isinstance(message, dict) and not path.startswith("["):
            return [message]
        if isinstance(message, dict) and path in message:
            return [message[path]]
        if path not in self.collected:
            self.collected[path] = FieldPath(path)
        return self.collected[path].values(message)

    def _leads(self, place: str, rows: list[Any]) -> bool:
        """Whether the field leads to something in a list's elements, or is the place of a list of numbers."""
        if not isinstance(rows[0], dict):
            return place == ("" if self.path_to.startswith("[") else self.path_to) and _shape(rows[0]) is not None
        for row in rows[:_PARTS]:  # the first may be null
            with suppress(FieldError):
                return bool(self._found(row, self.path_to))
        return False

    def _values(self) -> Iterator[tuple[int, Any]]:
        """The values of all lines, with their numbers; or the document."""
        if not self.by_line:
            yield 0, self._document()
            return
        for row, line in self.lines():
            try:
                yield row, json.loads(line)
            except ValueError as error:
                self.seen += 1
                self.leave_out(row, RecordingError(f"{self.address}, row {row}: expected JSON: {error}"))

    def _document(self) -> Any:
        """The document; of one that is cut off the whole elements of its first list of lists or objects."""
        if self.size > _LARGEST:
            what = f"{self.address} is one document of {self.size} bytes; expected at most {_LARGEST}"
            raise RecordingError(f"{what}. Write it as lines of JSON, one object each")
        text = "".join(self.pieces()).rstrip("\0")
        if not text.strip():
            raise RecordingError(f"expected readings in {self.address}; there are none")
        try:
            return json.loads(text)
        except json.JSONDecodeError as error:
            why = error
        begin, rows, decoder = _LIST.search(text), [], json.JSONDecoder()
        at = len(text) if begin is None else begin.end()
        try:
            while True:
                value, at = decoder.raw_decode(text, _BETWEEN.match(text, at).end())  # type: ignore[union-attr]
                rows.append(value)
        except json.JSONDecodeError as error:
            if not rows or not (error.pos >= len(text) - 8 or error.msg.startswith("Unterminated")):
                raise RecordingError(f"{self.address} is no JSON: {why}") from None
        self.ending = f"it ends in the middle of JSON, behind element {len(rows)}"
        return rows


def _lists(value: Any, leads: Callable[[str, list[Any]], bool], place: str = "") -> Iterator[Listed]:
    """The lists in a value whose elements are readings, the times beside each, and what they are called there."""
    if isinstance(value, list) and value:
        if leads(place, value):
            yield place, value, [], None
        else:
            for i, inner in enumerate(value):
                yield from _lists(inner, leads, f"{place}[{i}]") if isinstance(inner, dict | list) else ()
    elif isinstance(value, dict):
        times = next((own for key, own in value.items() if is_clock(key) and isinstance(own, list)), [])
        name = next((value[key] for key in _NAMES if isinstance(value.get(key), str)), None)
        for key, inner in value.items():
            for at, rows, own, called in _lists(inner, leads, f"{place}.{key}" if place else key):
                yield at, rows, own or times * (len(times) == len(rows)), called or name


def _are_readings(place: str, rows: list[Any]) -> bool:
    """Whether a list holds readings, as far as one can see without a field: no list in them has more."""
    if not isinstance(rows[0], dict):
        return len(rows) > 1 and _shape(rows[0]) is not None
    return not any(_are_rows(inner) and len(inner) >= _PARTS for inner in rows[0].values())


def _shape(value: Any) -> tuple[int, ...] | None:
    """The shape of numbers; None for what has other things in it, or is ragged."""
    try:
        return np.asarray(value, np.float64).shape
    except (ValueError, TypeError):
        return None


def _leaves(value: Any, before: str) -> Iterator[tuple[str, tuple[int, ...]]]:
    """The paths to the lists of numbers in a message, and to the numbers of each object in it together."""
    if not isinstance(value, dict):
        if not isinstance(value, str) and (shape := _shape(value)) is not None:
            yield before, shape
        return
    start, alone = f"{before}." if before else "", []
    for key, inner in value.items():
        if isinstance(inner, int | float):
            alone += [key] if key.isidentifier() and not is_clock(key) and key not in _COUNTERS else []
        elif _are_rows(inner):
            yield from ((name, (len(inner), *shape)) for name, shape in _leaves(inner[0], f"{start}{key}[*]"))
        elif inner:
            yield from _leaves(inner, f"{start}{key}")
    if alone:
        several = len(alone) > 1
        yield start + (f"{{{','.join(alone)}}}" if several else alone[0]), (len(alone),) * several


def _are_rows(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def _is_whole(line: str) -> bool:
    with suppress(ValueError):
        return isinstance(json.loads(line), dict | list)
    return False
