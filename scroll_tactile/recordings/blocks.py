"""What every format's reader gives: blocks of readings with their clocks and counters, and a list of what there is."""

from __future__ import annotations

import dataclasses
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FieldError, RecordingError, ScrollTactileError
from scroll_tactile.recordings.bounds import require_bounded

__all__ = ["Block", "Contents", "Entry", "Request", "Source", "floats", "guarded", "in_seconds", "is_clock", "rows_of"]

_MESSAGE = 8000  # letters of an error
_ROWS = 4096  # of a block …
_BYTES = 1 << 24  # … unless they would hold more than this
_TIME = re.compile(
    r"[\W_]*(?:(?:ros|rosbag|bag|unix|log|host|pc|sys(?:tem)?|device|sensor|elapsed|rel(?:ative)?|epoch|header|recv)"
    r"[ _-]*)?(?:time(?:[ _-]*stamps?)?s?|stamps?|ts?|seconds|n?secs?|nanosec|date[ _]?time|millis|micros|x_value)"
    r"(?:\(\))?(?:[ _-]+(\w+)|[ _-]*[\[(] ?(\w+) ?[\])])?",
    re.IGNORECASE,
)
_UNIT = re.compile(r"(m|u|µ|μ|n|milli|micro|nano)?s(?:ec(?:ond)?s?)?|(millis|micros|x_value)(?:\(\))?", re.IGNORECASE)
_FACTORS = {"": 1.0, "m": 1e3, "milli": 1e3, "millis": 1e3, "n": 1e9, "nano": 1e9}  # and a million of the others


@dataclass(frozen=True)
class Request:
    """What is requested of a file; see `read`."""

    topic: str | None = None
    field: str | None = None
    clock: str | None = None
    rate: float | None = None
    labels: str | None = None
    header: bool | None = None
    delimiter: str | None = None
    decimal: str | None = None
    likely: str | None = None  # the topic, where several have the field
    definitions: Mapping[str, str] = dataclasses.field(default_factory=dict)
    annotate: tuple[str, ...] = ()


@dataclass(eq=False)
class Block:
    """Some readings in the order of the file.

    readings: shape (k, n), or (k, height, width, 3) for pictures.
    clocks: seconds, float64 of shape (k,), by the clock's name; the first that runs is preferred.
    counters: what counts readings at their source, int64 of shape (k,), by name.
    episodes: the number of the episode of each reading, int64 of shape (k,), where a file has episodes.
    annotations: the columns that were requested to annotate touches by, as of `Recording`, of shape (k,).
    """

    readings: npt.NDArray[Any]
    clocks: dict[str, npt.NDArray[np.float64]] = dataclasses.field(default_factory=dict)
    counters: dict[str, npt.NDArray[np.int64]] = dataclasses.field(default_factory=dict)
    episodes: npt.NDArray[np.int64] | None = None
    annotations: dict[str, npt.NDArray[Any]] = dataclasses.field(default_factory=dict)


@dataclass(frozen=True)
class Entry:
    """Numbers that a file has: where they are, and how many; `rate` in Hz and `count` as far as was looked."""

    topic: str | None
    field: str
    shape: tuple[int, ...]
    count: int | None = None
    rate: float | None = None
    kind: str = ""


@dataclass(frozen=True)
class Contents:
    """What a file has, as `describe` gives it; as text, a table with a line to copy.

    source: the file's address. entries: the numbers in it. looked: how far was looked, where not to the end. notes:
    what could not be read, and why.
    """

    source: str
    entries: tuple[Entry, ...]
    looked: str = ""
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        where = ", ".join([repr(self.source), *self._where()])
        return self._listed(f"read({where})")

    def refused(self, what: str) -> FieldError:
        """The error of a topic or field that is not chosen, or not there, with those that there are."""
        return FieldError(f"{what}\n{self._listed(' '.join(['such as', *self._where()]))}", argument="topic field")

    def _where(self) -> list[str]:
        """The arguments that choose the first."""
        chosen = {"topic": self.entries[0].topic, "field": self.entries[0].field} if self.entries else {}
        return [f"{name}={value!r}" for name, value in chosen.items() if value]

    def _listed(self, last: str) -> str:
        if not self.entries:
            return f"{self.source} has no numbers in it" + (f": {'; '.join(self.notes)}" if self.notes else "")
        lines = [f"{self.source} has{f' {self.looked}' if self.looked else ''}:"]
        for entry in self.entries[:40]:
            where = f"{entry.topic}  " if entry.topic else ""
            count = "" if entry.count is None else f", {entry.count} readings"
            rate = "" if entry.rate is None else f", {entry.rate:.4g} Hz"
            kind = f"  ({entry.kind})" if entry.kind else ""
            lines.append(f"  {where}{entry.field}  {list(entry.shape)}{count}{rate}{kind}")
        if len(self.entries) > 40:
            lines.append(f"  … and {len(self.entries) - 40} more")
        lines += [f"  not read: {note}" for note in self.notes]
        return "\n".join([*lines, last])


class Source(ABC):
    """A file that was opened for reading; `notes`, `names` and `marks` fill up as blocks are read.

    path, address: where it is on this machine, and as it was given. request: what is requested of it.
    topic: the topic that is read; None where the format has none.
    notes: what went wrong without losing everything, as sentences. cut_off: whether the file ends before its end.
    names: what each episode is called, by its number. paths: where in the file it lies, by the same number, such as
    "run/felt/1/tactile", where a pattern found it.
    marks: the texts of a topic of labels, each with its time in seconds by the clock "log".
    continuous: whether time goes on from one episode to the next, and does not begin anew.
    stored: its bytes on the disk. claimed: those that it becomes in memory.
    topics, labels, annotate: whether the format has topics, something that labels, and columns beside the readings.
    """

    continuous = topics = labels = annotate = False

    def __init__(self, path: Path, address: str, request: Request) -> None:
        self.path, self.address, self.request = path, address, request
        self.topic = request.topic
        self.stored = self.claimed = 0
        self.notes: list[str] = []
        self.cut_off = False
        self.names: dict[int, str] = {}
        self.paths: dict[int, str] = {}
        self.marks: list[tuple[float, str]] = []

    @classmethod
    def holds_some(cls, path: Path) -> bool:
        """Whether a file in a folder is a recording, where its name alone does not say so; `find` asks."""
        return True

    def field(self) -> str:
        """The field that is read, as far as it is known before reading."""
        return self.request.field or ""

    def claim(self, size: int) -> None:
        """Say that a buffer of so many bytes will be made, for what the file says of itself.

        Raises RecordingError where all of them are more than a file of its size can hold.
        """
        self.claimed += size
        require_bounded(self.claimed, self.stored, self.address)

    @abstractmethod
    def contents(self) -> Contents:
        """What the file has."""

    @abstractmethod
    def blocks(self) -> Iterator[Block]:
        """The readings that were requested, in the order of the file; raises FieldError where they are not there."""


def rows_of(width: int) -> int:
    """How many readings of so many bytes make a block."""
    return max(1, min(_ROWS, _BYTES // max(width, 1)))


def floats(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The same numbers as float32 where it holds them all (16 bit, float32), as float64 otherwise; pictures stay.

    Raises FieldError for what are no real numbers.
    """
    if array.dtype.kind not in "biuf":
        raise FieldError(f"expected numbers; came values of type {array.dtype}")
    if array.ndim == 4 and array.dtype == np.uint8 and array.shape[3] == 3:
        return array
    kind = np.float32 if np.can_cast(array.dtype, np.float32, "safe") else np.float64
    return array.reshape(len(array), -1).astype(kind, copy=False) if array.ndim != 2 else array.astype(kind, copy=False)


def is_clock(name: str) -> bool:
    """Whether a column, array or key is called as times are: t, timestamp_ns, `Time [ms]`, `__time`, `header.stamp`."""
    match = _TIME.fullmatch(_last(name))
    return match is not None and _unit(match[1] or match[2] or "s") > 0


def in_seconds(times: npt.NDArray[Any], name: str, unit: str = "") -> npt.NDArray[np.float64]:
    """Times in seconds, by their own type, by the unit in their name or beside it, or by their size since 1970."""
    if times.dtype.kind in "mM":
        return times.astype(f"{times.dtype.kind}8[ns]").astype(np.int64) / 1e9
    name = _last(name)
    match = _TIME.fullmatch(name)
    named = _unit((match and (match[1] or match[2])) or unit) or (_unit(name) if name[:2].lower() == "mi" else 0.0)
    largest = float(np.nanmax(np.abs(times.astype(np.float64)), initial=0.0))
    return times / (named or next((by for size, by in ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3)) if largest > size), 1.0))


def _last(name: str) -> str:
    return re.split("[./]", name.strip())[-1]


def _unit(text: str) -> float:
    """How many of a unit of time make a second; 0 for what is none."""
    match = _UNIT.fullmatch(text.strip("[]() "))
    return 0.0 if match is None else _FACTORS.get((match[1] or match[2] or "").lower(), 1e6)


@contextmanager
def guarded(path: str) -> Iterator[None]:
    """Damaged bytes make parsers fail in many ways: all of them become a RecordingError that names the file."""
    try:
        yield
    except ScrollTactileError as error:
        text = str(error)
        if len(text) > _MESSAGE:  # names and definitions in a file may have any length
            error.args = (f"{text[:_MESSAGE]} …",)
        raise
    except MemoryError as error:
        raise RecordingError(f"{path} claims to hold more than fits into memory, and may be damaged") from error
    except Exception as error:
        reason = str(error).strip().splitlines() or [""]
        raise RecordingError(
            f"{path} cannot be read, and may be damaged or half copied: {type(error).__name__}: {reason[0]:.200}"
        ) from error
