"""Arrays as sources: `.npy`, `.npz`, `.mat` and HDF5; and how a field names arrays, here and in Zarr and parquet.

A field is an array's name, or the end of it, with an index of columns behind it (`[0:19]`). Arrays of one number a
reading stand beside each other as columns: `fx,fy,fz`, `fx:fz`, `f*`. Those that a pattern finds in several groups are
episodes: `run/*/tactile`. `tactile[*]` reads a stack (touches, time, channels) as episodes, `tactile[+]` one of blocks
(rows, samples, channels) as readings that follow each other, and `tactile[:]` each entry as one reading.
"""

from __future__ import annotations

import math
import os
import re
import struct
import zipfile
from abc import abstractmethod
from collections import defaultdict
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FieldError, RecordingError
from scroll_tactile.libraries import missing
from scroll_tactile.recordings.blocks import Block, Contents, Entry, Source, floats, in_seconds, is_clock, rows_of
from scroll_tactile.recordings.bounds import RATIO, SPARE, require_bounded, require_inflated, stored_bytes
from scroll_tactile.recordings.headings import Heading
from scroll_tactile.recordings.paths import matched, select
from scroll_tactile.settings import LONGEST_NAME

__all__ = ["ArraySource", "Hdf5", "HeldArray", "Mat", "Npy", "Npz"]

_FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32", 32000: "lzf"}  # of HDF5, by their numbers
_DEEPEST = 32  # groups within each other
_FEW = 10  # readings: fewer are no touch
_LARGE = 1 << 18  # bytes of a chunk, of which deflate could make more than any file may
_COUNTS = (
    "index",
    "__index_level_0__",
    "axis0",
    "axis1",
    "frame_index",
    "episode_index",
    "task_index",
)  # of LeRobot and pandas
_ENDS = "meta/episode_ends"
_Vector = npt.NDArray[Any]


class HeldArray:
    """An array that is read whole when its first rows are asked for. said: its type. source: what it is made from."""

    def __init__(self, shape: tuple[int, ...], dtype: Any, make: Any, said: str = "", source: Any = None) -> None:
        self.shape, self.dtype, self.make, self.said, self.source = shape, np.dtype(dtype), make, said, source

    def __getitem__(self, rows: Any) -> Any:
        return self.make()[rows]


class ArraySource(Source):
    """What sources of arrays have in common.

    arrays: by name, while the file is open. groups: the names of those that are called alike in several episodes, by
    what they are called. clocks: the names of arrays of times, by what stands before them. unread: why arrays cannot be
    read. tasks: what the numbers in an array task_index stand for. table: whether all are columns of a table,
    of which a row is a reading. named: whether a pattern found episodes.
    """

    labels = annotate = True
    table = named = False

    def __init__(self, *of: Any) -> None:
        super().__init__(*of)
        self.called = self.request.field or ""
        self.arrays: dict[str, Any] = {}
        self.groups: dict[str, list[str]] = {}
        self.clocks: dict[str, list[str]] = {}
        self.unread: list[str] = []
        self.tasks: dict[int, str] = {}

    @abstractmethod
    def opened(self) -> AbstractContextManager[dict[str, Any]]:
        """The arrays by name, each with a shape, a dtype and rows by a slice, while the file is open."""

    def key(self, name: str) -> str:
        """What an array is called together with those like it in other episodes."""
        return name

    @contextmanager
    def _open(self) -> Iterator[None]:
        with self.opened() as self.arrays:
            groups, clocks = defaultdict(list), defaultdict(list)
            for name in sorted(self.arrays, key=lambda name: re.sub(r"\d+", lambda part: part[0].zfill(20), name)):
                groups[self.key(name)].append(name)
                if is_clock(_last(name)) and self.arrays[name].dtype.kind in "iufM":
                    clocks[_folder(name)].append(name)
            self.clocks = dict(clocks)
            self.groups = dict(groups)
            yield

    def field(self) -> str:
        """The field that is read; of columns beside each other, their names."""
        return self.called

    def contents(self) -> Contents:
        """The arrays that hold numbers in rows; those of one number a row that make up a table are one entry."""
        with self._open():
            return self._listed()

    def _listed(self) -> Contents:
        tables, entries = defaultdict(list), []
        for key, names in self.groups.items():
            if self._numeric(names[0]) and not key.startswith("meta/"):
                tables[_folder(key)].append((key, [self.arrays[name] for name in names]))
        for columns in tables.values():
            shapes = {parts[0].shape for _, parts in columns}
            table = len(columns) > 1 and len(shapes) == 1 and len(shapes.pop()) == 1
            for beside in [columns] if table else [[column] for column in columns]:
                parts = beside[0][1]
                shape = (len(beside),) if table else tuple(parts[0].shape[1:])
                kinds = ", ".join(dict.fromkeys(str(parts[0].dtype) for _, parts in beside))
                field = ",".join(key for key, _ in beside)
                entries.append(Entry(None, field, shape, sum(part.shape[0] for part in parts), None, kinds))
        entries.sort(key=lambda entry: "tact" not in entry.field.lower())
        return Contents(self.address, tuple(entries), notes=tuple(self.unread))

    def _numeric(self, name: str) -> bool:
        """Whether an array may hold readings."""
        array, last = self.arrays[name], _last(name)
        many = bool(array.shape) and math.prod(array.shape) != 1
        return many and array.dtype.kind in "biuf" and not is_clock(last) and last not in _COUNTS

    def _chosen(self) -> tuple[list[list[str]], str, str]:
        """The names of the arrays of each touch, which stand beside each other; the index behind; how rows fold."""
        if (field := self.request.field) is None:
            listed = self._listed()
            if len(listed.entries) != 1 and len(self.groups) != 1:
                raise listed.refused("expected a field to read")
            field = listed.entries[0].field if listed.entries else next(iter(self.groups))
        self.called = field
        way = next((way for way in "*+" if f"[{way}]" in field), "")
        stem, rest = self._split(field.replace(f"[{way}]", "", 1) if way else field)
        if stem in self.arrays:
            return ([[name] for name in self.groups.get(stem, [stem])]), rest, way
        if re.search(r"[*?]", stem) and not self.table and "," not in stem and stem not in self.groups:
            found = [name for own in self.groups.values() for name in own if _pattern(stem).fullmatch(name)]
            found = [name for name in found if self._numeric(name)]
            if len({_folder(name) for name in found}) > 1 or any(len(self.arrays[name].shape) > 1 for name in found):
                self.named = True
                return [[name] for name in found], rest, way
        keys = [
            key for part in ([stem] if stem in self.groups else stem.split(",")) for key in self._keys(part.strip())
        ]
        self.called = ",".join(keys) if len(keys) > 1 else field
        return [list(names) for names in zip(*(self.groups[key] for key in keys), strict=True)], rest, way

    def _split(self, field: str) -> tuple[str, str]:
        """A name, and the index behind it."""
        if field in self.groups or field in self.arrays or not field.endswith("]"):
            return field, ""
        stem, _, rest = field.rpartition("[")
        if "[" in stem and stem.rstrip() not in self.arrays:
            raise FieldError(
                f"field {field!r:.200}: expected one index such as [0:19] after the name", argument="field"
            )
        return stem.rstrip(), f"[{rest}"

    def _keys(self, part: str) -> list[str]:
        """The keys that a part of a field names: one, the first to the last, or those of a pattern."""
        keys = list(self.groups)
        first, mark, last = part.partition(":")
        if mark and part not in keys:
            begin, end = (keys.index(self._one(one.strip())) for one in (first, last))
            return keys[begin : end + 1]
        found = [key for key in keys if _pattern(part).fullmatch(key) and self._numeric(self.groups[key][0])]
        return found if found and part not in keys else [self._one(part)]

    def _one(self, name: str, argument: str = "field") -> str:
        """The key that a name names. Raises FieldError with a pattern where several end so, or with the nearest."""
        ends = [key.split("/") for key in self.groups if key.endswith(f"/{name}")]
        if name not in self.groups and len(ends) > 1 and len({len(parts) for parts in ends}) == 1:
            pattern = "/".join(level[0] if len(set(level)) == 1 else "*" for level in zip(*ends, strict=True))
            raise FieldError(
                f"{self.address}: field {name!r} may be any of {', '.join('/'.join(parts) for parts in ends[:12])}"
                f"{' …' if len(ends) > 12 else ''}: name one in full, or read them as episodes by field={pattern!r}",
                argument=argument,
            )
        if list(self.groups) == [""]:
            raise FieldError(f"{self.address} holds one array without a name, and no {name!r}", argument=argument)
        try:
            return matched(name, self.groups, self.address)[0]
        except FieldError as error:
            why = "; ".join(["", *(f"not read: {why}" for why in self.unread if name in why)])
            raise FieldError(f"{error}{why}", argument=argument) from None

    def _beside(self, name: str, wanted: str, argument: str) -> str:
        """The array that is called so next to another, in its group or in one around it, or else anywhere."""
        key = next((folder + wanted for folder in _folders(name) if folder + wanted in self.arrays), None)
        if key is None:
            one = self._one(wanted, argument)
            key = next((folder + one for folder in _folders(name) if folder + one in self.arrays), one)
        return key

    def blocks(self) -> Iterator[Block]:
        """The readings of the arrays that were chosen, episode after episode."""
        with self._open():
            touches, rest, way = self._chosen()
            done = 0
            for names in touches:
                columns = [self._readable(name) for name in names]
                shapes = [tuple(self.arrays[own[0]].shape[2 if way else 1 :]) for own in (touches[0], names)]
                if shapes[0] != shapes[1]:
                    what = f"is ragged: {names[0]} has readings of {shapes[1]}, those before {shapes[0]}"
                    raise RecordingError(f"{self.address}: {self.field()!r} {what}")
                clock = self._clock(names[0], way)
                fold = self._fold(names[0], way, known=rest == "[:]" or clock is not None)
                about = self._about(names[0], clock, way, fold, done)
                last = done if about.episodes is None else int(about.episodes.max(initial=done - 1))
                self.paths |= {number: names[0] for number in range(done, last + 1) if self.named}
                done = last + 1
                for span, readings in self._slabs(columns, fold if way else 0):
                    yield Block(
                        select(readings, rest, names[0]),
                        {key: own[span] for key, own in about.clocks.items()},
                        {key: own[span] for key, own in about.counters.items()},
                        None if about.episodes is None else about.episodes[span],
                        {key: own[span] for key, own in about.annotations.items()},
                    )

    def _slabs(self, columns: list[Any], fold: int) -> Iterator[tuple[slice, _Vector]]:
        """The readings of arrays that stand beside each other, and which they are; fold: how many a row holds, or 0."""
        width = sum(math.prod(column.shape[1:]) * column.dtype.itemsize for column in columns)
        high = max((getattr(column, "chunks", None) or (1,))[0] for column in columns)
        rows, count = rows_of(width), columns[0].shape[0]
        step = max(rows // high, 1) * high  # chunks are decompressed whole, and once
        for first in range(0, count, step):
            slabs = [np.asarray(column[first : min(first + step, count)]) for column in columns]
            for i in range(0, len(slabs[0]), rows):
                parts = [slab[i : i + rows] for slab in slabs]
                if fold:
                    parts = [part.reshape(len(part) * fold, *part.shape[2:]) for part in parts]
                found = [floats(part) for part in parts]
                readings = found[0] if len(found) == 1 else np.concatenate(found, axis=1)
                begin = (first + i) * max(fold, 1)
                yield slice(begin, begin + len(readings)), readings

    def _readable(self, name: str) -> Any:
        """An array. Raises FieldError for what are no numbers, RecordingError for more than such a file can hold."""
        array = self.arrays[name]
        if not array.shape or array.dtype.kind not in "biuf":
            what = getattr(array, "said", "") or f"{array.dtype} of shape {array.shape}"
            raise FieldError(f"{self.key(name)!r} of {self.address} holds {what}; expected numbers", argument="field")
        if not math.prod(array.shape[1:]):
            raise RecordingError(f"{self.address} has readings without numbers in {name!r}, of shape {array.shape}")
        self.claim((8 + math.prod(array.shape[1:]) * array.dtype.itemsize) * array.shape[0])
        require_bounded(
            math.prod(getattr(array, "chunks", None) or ()) * array.dtype.itemsize, self.stored, self.address
        )
        return array

    def _vector(self, name: str) -> _Vector:
        """The values of an array along its one axis; raises RecordingError as `_readable` does."""
        array = self.arrays[name]
        self.claim(8 * math.prod(array.shape))
        return np.asarray(array[0 : array.shape[0]] if array.shape else array[()]).reshape(-1)

    def _fold(self, name: str, way: str, *, known: bool) -> int:
        """How many readings a row holds. Raises FieldError where the first axis may count touches or readings."""
        shape = self.arrays[name].shape
        if way and len(shape) < 2:
            raise FieldError(f"field {name!r} of {self.address} has one axis, {list(shape)}; [{way}] needs two")
        picture = len(shape) == 4 and shape[3] == 3 and self.arrays[name].dtype == np.uint8
        known = known or _ENDS in self.arrays or (self.key(name) != name and not self.named)
        if way or known or picture or len(shape) < 3 or shape[1] < _FEW:
            return int(shape[1]) if way else 1
        count, long, width = shape[0], shape[1], math.prod(shape[2:])
        key = self._split(self.request.field or name)[0]
        raise FieldError(
            f"{name or 'the array'} of {self.address} has the shape {tuple(shape)}: say what its first axis counts. "
            f"field='{key}[*]' reads {count} touches of {long} readings of {width} numbers, field='{key}[:]' {count} "
            f"readings of {long * width}, and field='{key}[+]' {count * long} readings of {width}, {long} in each row",
            argument="field",
        )

    def _clock(self, name: str, way: str) -> str | None:
        """The array of times of another: the one that was requested, or one near it that is called so and as long."""
        shape = self.arrays[name].shape
        if self.request.clock is None:
            near = (key for folder in _folders(name) for key in self.clocks.get(folder, ()))
            return next((key for key in near if key != name and _fits(self.arrays[key].shape, shape, way)), None)
        key = self._beside(name, self.request.clock, "clock rate")
        if not _fits(self.arrays[key].shape, shape, way) or self.arrays[key].dtype.kind not in "iufM":
            what = f"{self.arrays[key].dtype} of shape {self.arrays[key].shape}, and {name!r} has {shape[0]} readings"
            raise RecordingError(f"{self.address}: the times {key!r} are {what}", argument="clock")
        return key

    def _about(self, name: str, clock: str | None, way: str, fold: int, done: int) -> Block:
        """What is known of each reading of a touch, in a block without readings."""
        about, height = Block(np.empty(0)), self.arrays[name].shape[0]
        if clock is not None:
            times = in_seconds(self._vector(clock), _last(clock))
            if way == "*" and len(times) < height * fold:
                times = np.tile(times, height)
            elif len(times) < height * fold:
                step = float(np.median(np.diff(times))) / fold if height > 1 else 0.0
                times = (times[:, None] + step * np.arange(fold)).reshape(-1)
            about.clocks[_last(clock)] = times
        near = {key: folder + key for folder in _folders(name) for key in _COUNTS if folder + key in self.arrays}
        if "frame_index" in near and not way:
            about.counters["message"] = self._vector(near["frame_index"]).astype(np.int64)
        for text in self.request.annotate:
            about.annotations[text] = np.repeat(self._annotation(text, name), fold)
        labels = self.request.labels
        texts = [] if labels is None else self._texts(self._beside(name, labels, "labels field"))
        if "episode_index" in near and not way and not texts:
            numbers = self._vector(near["episode_index"])
            if not np.isfinite(numbers).all():
                raise FieldError(f"'episode_index' of {self.address} has rows without a number; expected one in each")
            about.episodes = numbers.astype(np.int64)
            tasks = self._vector(near["task_index"]).tolist() if self.tasks and "task_index" in near else []
            for episode, task in zip(about.episodes.tolist(), tasks, strict=False):
                if task in self.tasks:
                    self.names.setdefault(episode, self.tasks[task])
            return about
        each = np.repeat(np.arange(height), fold) if way == "*" else None
        if _ENDS in self.arrays and not way:
            each = np.searchsorted(self._ends(height), np.arange(height), side="right")
        if each is None and (self.named or self.key(name) != name) and len(texts) != height:
            each = np.zeros(height * fold, np.int64)
        about.episodes = self._numbered(height * fold, each, texts, done)
        return about

    def _numbered(self, count: int, each: _Vector | None, texts: list[str], done: int) -> _Vector | None:
        """The episode of each of `count` readings, from `done` on, and what texts call them; None where there is none.

        each: the episode of each reading, where the file says so. texts: one for all, one an episode, or one a reading.
        """
        if each is None and len(texts) == count > 1:
            change = np.flatnonzero([True, *(one != other for one, other in zip(texts[1:], texts, strict=False))])
            each, self.continuous = np.repeat(np.arange(len(change)), np.diff([*change, count])), True
            texts = [texts[i] for i in change]
        if each is None and not texts:
            return None
        each = np.zeros(count, np.int64) if each is None else each
        several = int(each.max(initial=0)) + 1
        if len(texts) == count > several:
            texts = [texts[int(i)] for i in np.searchsorted(each, np.arange(several))]
        if len(texts) not in (0, 1, several):
            what = f"{len(texts)} labels {self.request.labels!r}; expected one for each of its {several} episodes"
            raise FieldError(f"{self.address} has {what}, or of its {count} readings", argument="labels")
        named = zip(range(several), texts * several if len(texts) == 1 else texts, strict=False)
        self.names |= {done + i: text for i, text in named if text}
        return each.astype(np.int64) + done

    def _texts(self, key: str, values: _Vector | None = None) -> list[str]:
        """What an array of labels says, or values of it; of whole numbers where some are missing floats were made."""
        array = self.arrays[key]
        texts = array.dtype.kind == "O" and getattr(array, "said", "string") in ("string", "large_string")
        if array.dtype.kind not in "biuSU" and not texts:
            said = getattr(array, "said", "") or array.dtype
            raise FieldError(f"{self.key(key)!r} of {self.address} holds {said}; expected texts, or whole numbers")
        values = self._vector(key) if values is None else values
        found = []
        for one in values.tolist():
            text = one.decode(errors="replace") if isinstance(one, bytes) else "" if one is None else str(one)
            found.append(("" if text == "nan" else text.removesuffix(".0")) if isinstance(one, float) else text.strip())
        if (longest := max(map(len, found), default=0)) > LONGEST_NAME:
            what = f"has a text of {longest} characters; expected labels of at most {LONGEST_NAME}"
            raise FieldError(f"{self.key(key)!r} of {self.address} {what}")
        return found

    def _annotation(self, text: str, name: str) -> _Vector:
        """A column that annotates touches: a number a row, NaN where there is none, or a text, as str."""
        heading = Heading.parsed(text)
        key, rest = self._split(heading.column)
        own = self._beside(name, key, "annotate intervals")
        if heading.unit is None and not rest:
            return np.array(self._texts(own), object)
        rows = np.asarray(self._readable(own)[0 : self.arrays[own].shape[0]])
        rows = select(rows.reshape(len(rows), -1), rest, heading.column)
        if rows.shape[1] != 1:
            raise FieldError(
                f"column {self.key(own)!r} of {self.address} has {rows.shape[1]} numbers a reading; expected one: give "
                f"which by its place, as in {heading.name} [{heading.unit or 'label'}] from {self.key(own)}[0]"
            )
        return np.array(self._texts(own, rows[:, 0]), object) if heading.unit is None else rows[:, 0].astype(np.float64)

    def _ends(self, count: int) -> _Vector:
        ends = self._vector(_ENDS)
        if ends.dtype.kind not in "iu" or (np.diff(ends.astype(np.int64), prepend=0) < 0).any() or (ends > count).any():
            raise RecordingError(f"{self.address}: {_ENDS} does not rise to at most {count}, the count of readings")
        return ends.astype(np.int64)


def _last(name: str) -> str:
    return re.split(r"[/.]", name)[-1]


def _folder(name: str) -> str:
    """What stands before the last part of a name, with the mark behind it."""
    return name[: len(name) - len(_last(name))]


def _folders(name: str) -> Iterator[str]:
    """The groups that an array is in, from the innermost to the file."""
    while folder := _folder(name):
        yield folder
        name = folder[:-1]
    yield ""


def _fits(shape: tuple[int, ...], readings: tuple[int, ...], way: str) -> bool:
    """Whether an array of times has one for each row; in a stack for each reading, or for those of one touch."""
    if way and tuple(shape) == tuple(readings[:2]):
        return True
    return sum(size > 1 for size in shape) <= 1 <= len(shape) and math.prod(shape) == readings[way == "*"]


def _pattern(text: str) -> re.Pattern[str]:
    """`*` stands for any characters within a name, and `?` for one."""
    return re.compile(re.escape(text).replace(r"\*", "[^/]*").replace(r"\?", "[^/]"))


def _vectors(shape: tuple[int, ...]) -> tuple[int, ...]:
    """The shape of MATLAB's array: rows and columns of numbers have one axis here."""
    return (math.prod(shape),) if len(shape) == 2 and 1 in shape else tuple(shape)


def _fields(name: str, array: Any) -> Iterator[tuple[str, Any]]:
    """An array, or the fields of one that is structured, by their names."""
    for field in array.dtype.names or ():
        kind = array.dtype[field]
        make = lru_cache(maxsize=1)(lambda field=field: array[field])
        column = HeldArray((*array.shape, *kind.shape), kind.base, make, source=array)
        yield from _fields(
            f"{name}.{field}" if name else field, array[field] if isinstance(array, np.ndarray) else column
        )
    if array.dtype.names is None:
        yield name, array


class Npy(ArraySource):
    """One array in a `.npy`, shape (T, …): a row is a reading; of a structured array its fields are arrays."""

    @contextmanager
    def opened(self) -> Iterator[dict[str, Any]]:
        """The array, under no name, or its fields."""
        self.stored = stored_bytes(self.path)
        require_bounded(self.path.stat().st_size, self.stored, self.address)
        with self.path.open("rb") as file:
            yield dict(_fields("", np.lib.format.read_array(file, allow_pickle=False)))


class Npz(ArraySource):
    """Several arrays in a `.npz`."""

    @contextmanager
    def opened(self) -> Iterator[dict[str, Any]]:
        """The arrays by their names."""
        self.stored = stored_bytes(self.path)
        arrays: dict[str, Any] = {}
        with zipfile.ZipFile(self.path) as file:
            require_bounded(sum(info.file_size for info in file.infolist()), self.stored, self.address)
            for name in file.namelist():
                try:
                    with file.open(name) as member:
                        array = np.lib.format.read_array(member, allow_pickle=False)
                    arrays.update(_fields(name.removesuffix(".npy"), array))
                except ValueError as error:
                    self.unread.append(f"{name}: {error}")
        yield arrays


class Hdf5(ArraySource):
    """HDF5: data sets by their path; as robomimic writes them, `data/demo_N/obs/KEY`, an episode in each demo."""

    turned = False  # whether axes are the other way round, as MATLAB's are

    def key(self, name: str) -> str:
        """The path of a data set, of a demo's that within the demo."""
        return re.sub(r"^data/demo_\d{1,9}/", "", name)

    @contextmanager
    def opened(self) -> Iterator[dict[str, Any]]:
        """The data sets by their path, fields of compound ones behind a dot; links are not followed."""
        try:
            import h5py
        except ImportError as error:
            raise missing("h5py", "hdf5", "an HDF5 file", cause=error) from error
        self.stored = stored_bytes(self.path)
        arrays: dict[str, Any] = {}

        def visit(name: str, item: Any) -> None:
            if name.count("/") > _DEEPEST:
                raise RecordingError(f"{self.address} has more than {_DEEPEST} groups within each other")
            if not isinstance(item, h5py.Dataset) or item.shape is None or name.startswith("#"):
                return
            if item.dtype.kind == "O" and h5py.check_string_dtype(item.dtype) is None:
                self.unread.append(f"{name} holds references to others, as cells of MATLAB 7.3 do: save them with -v7")
            elif not self.turned:
                arrays.update(_fields(name, item))
            elif item.attrs.get("MATLAB_class") == b"char" and item.size < _LARGE:
                arrays[name] = np.array("".join(map(chr, item[()].T.flat)))
            else:
                shape = _vectors(item.shape[::-1])
                arrays[name] = HeldArray(shape, item.dtype, lambda: item[()].T.reshape(shape), source=item)

        try:
            file = h5py.File(self.path, "r")
        except OSError as error:
            if "unable to lock" not in str(error) and "already open for write" not in str(error):
                raise
            raise RecordingError(
                f"{self.address} is being written: another program has it open. Read it once that has closed it; where "
                f"none has, h5clear -s {self.path.name} says that its writer is gone. ({error})"
            ) from error
        with file:
            file.visititems(visit)  # which follows neither soft nor external links
            yield arrays

    def _readable(self, name: str) -> Any:
        """Also raises RecordingError for numbers that lie in other files, or in what only a plugin decodes."""
        array = item = super()._readable(name)
        while isinstance(item, HeldArray):
            item = item.source
        if isinstance(item, np.ndarray):
            return array
        import h5py

        about = item.id.get_create_plist()
        numbers = [about.get_filter(i)[0] for i in range(about.get_nfilters())]
        why = ""
        if about.get_layout() == h5py.h5d.VIRTUAL or about.get_external_count():
            why = "lies in other files (external storage, or a virtual data set), which may be any on this machine"
        elif not set(numbers) <= set(_FILTERS) or len(set(numbers)) < len(numbers):
            known = ", ".join(_FILTERS.values())
            why = f"has the filters {[_FILTERS.get(n, n) for n in numbers]}; expected at most one each of {known}"
        if why:
            raise RecordingError(f"{self.address}: {name!r} {why}. Copy it with h5repack, which puts it in")
        if 1 in numbers:  # HDF5 takes all that deflate makes of a chunk, also where it is longer than a chunk
            large: list[Any] = []
            item.id.chunk_iter(lambda chunk: large.append(chunk.chunk_offset) if chunk.size > _LARGE else None)
            for _, data in map(item.id.read_direct_chunk, large):
                size = math.prod(item.chunks) * item.dtype.itemsize + 4  # with a checksum
                require_inflated(data, size, f"a chunk of {name!r} of {self.address}")
        return array


class Mat(Hdf5):
    """A `.mat`: by h5py as MATLAB 7.3 writes it, by scipy before. Elements of struct arrays and cells are episodes."""

    turned = True

    def key(self, name: str) -> str:
        """The path of an array through structs, without the places of elements."""
        return re.sub(r"\[\d+\]", "", name)

    @contextmanager
    def opened(self) -> Iterator[dict[str, Any]]:
        """The arrays by the paths to them, such as `trial[0].tactile`."""
        self.stored = stored_bytes(self.path)
        arrays: dict[str, Any] = {}
        with self.path.open("rb") as file:
            head = file.read(520)
            if b"\x89HDF\r\n\x1a\n" in (head[:8], head[512:]):
                with super().opened() as found:
                    yield found
                return
            order = "<>"[head[126:128] == b"MI"]
            file.seek(128)
            while len(tag := file.read(8)) == 8:
                kind, size = struct.unpack(f"{order}II", tag)
                if kind == 15:  # compressed
                    require_inflated(file.read(size), SPARE + RATIO * self.stored, self.address)
                else:
                    file.seek(size, os.SEEK_CUR)
        from scipy.io import loadmat

        for name, value in loadmat(self.path).items():
            arrays.update(() if name.startswith("__") else self._flat(name, value, 0))
        yield arrays

    def _flat(self, name: str, value: Any, depth: int) -> Iterator[tuple[str, Any]]:
        """The arrays in a value, by their paths through structs and cells."""
        if not isinstance(value, np.ndarray) or depth > _DEEPEST or "Opaque" in type(value).__name__:
            self.unread.append(f"{name} is a {type(value).__name__}: save what is in it as arrays")
            return
        cells = list(value.flat) if value.dtype.hasobject else []
        if all(isinstance(cell, np.ndarray) and cell.dtype.kind == "U" for cell in cells):
            texts = np.array(["".join(cell.flat) for cell in cells])
            yield name, texts if cells else value.reshape(_vectors(value.shape))
            return
        for i, cell in enumerate(cells):
            place = f"{name}[{i}]" if len(cells) > 1 else name
            for field in value.dtype.names or ("",):
                inside = cell[field] if field else cell
                yield from self._flat(f"{place}.{field}" if field else place, inside, depth + 1)
