"""LeRobotDataset v3 as a source: parquet files of many episodes each, tasks as text."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FieldError, RecordingError
from scroll_tactile.libraries import missing
from scroll_tactile.recordings.blocks import Block, Contents, Entry, Request, Source, floats, rows_of
from scroll_tactile.recordings.bounds import LARGEST, Budget, read_text, require_inside, stored_bytes
from scroll_tactile.recordings.headings import Heading
from scroll_tactile.recordings.paths import matched, select
from scroll_tactile.settings import LONGEST_NAME

__all__ = ["LeRobot", "is_lerobot"]

_LONGEST = 1 << 24  # bytes of info.json, and of a text in a footer
_PLACEHOLDER = re.compile(r"\{(?:episode_)?(?:chunk|file)_index(?::0?\d?d)?\}")
_TABLE_ROW = 100  # steps of work
_BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def is_lerobot(path: Path) -> bool:
    """Whether a folder is a LeRobot data set."""
    return (path / "meta" / "info.json").is_file()


class _Reading(NamedTuple):
    """What is read of each file.

    key, rest: the column with the readings, and the index behind it. tasks: by their number. annotating: by heading,
    see `_annotating`. required, columns: what there must be, and what is read where it is there. labels: texts of it.
    """

    key: str
    rest: str
    clock: str
    tasks: dict[int, str]
    annotating: dict[str, tuple[str, str, Heading]]
    required: list[str]
    columns: list[str]
    labels: list[str]


class LeRobot(Source):
    """A LeRobotDataset; see `Source`. An episode is called what its task is."""

    annotate = True

    def __init__(self, path: Path, address: str, request: Request) -> None:
        try:
            from pyarrow import parquet, types
        except ImportError as error:
            raise missing("pyarrow", "lerobot", "a LeRobot data set", cause=error) from error
        self.parquet: Any = parquet
        self.types: Any = types
        super().__init__(path, address, request)
        self.info = json.loads(read_text(path, path / "meta" / "info.json", _LONGEST))
        version = str(self.info.get("codebase_version", ""))
        if not version.startswith("v3"):
            raise RecordingError(
                f"{address} is a LeRobotDataset {version or 'of no version'}; expected v3: LeRobot converts older ones "
                "(python -m lerobot.datasets.v30.convert_dataset_v21_to_v30)"
            )
        self.features: dict[str, Any] = self.info["features"]

    def contents(self) -> Contents:
        """The columns that hold numbers, touch first."""
        fps, count = self.info.get("fps"), self.info.get("total_frames")
        rate = fps if type(fps) in (int, float) else None
        entries = [
            Entry(None, name, tuple(about["shape"]), count, rate, about["dtype"])
            for name, about in self.features.items()
            if name not in _BOOKKEEPING and about["dtype"] not in ("video", "image", "string")
        ]
        entries.sort(key=lambda entry: "tact" not in entry.field.lower())
        return Contents(self.address, tuple(entries))

    def blocks(self) -> Iterator[Block]:
        """The readings of the column, file after file."""
        self.budget = Budget(self.address)
        paths, reading = self._files(), self._reading()
        for path in paths:
            with self._opened(path, reading.columns, reading.labels) as file:
                there = [name for name in reading.columns if name in file.schema_arrow.names]
                for name in reading.required:
                    if name not in there:
                        raise FieldError(f"{path.name} of {self.address} has no column {name!r}")
                for name in there:
                    self._require_numbers(file.schema_arrow.field(name).type, name, texts=name in reading.labels)
                for batch in file.iter_batches(batch_size=rows_of(self._width(reading.key)), columns=there):
                    if batch.num_rows:
                        yield self._block(batch, reading)

    def _reading(self) -> _Reading:
        key, rest = self._column()
        clock = self.request.clock or "timestamp"
        annotating = {text: self._annotating(text) for text in self.request.annotate}
        required = list(dict.fromkeys([key, clock, *(own for own, *_ in annotating.values())]))
        labels = [own for own, _, heading in annotating.values() if heading.unit is None]
        columns = list(dict.fromkeys([*required, *_BOOKKEEPING]))
        return _Reading(key, rest, clock, self._tasks(), annotating, required, columns, labels)

    def _width(self, key: str) -> int:
        """The bytes of a reading of a column, as the data set describes it."""
        shape = self.features[key]["shape"]
        width = 8 * math.prod(int(size) for size in shape)
        if not 0 < width <= LARGEST:
            raise RecordingError(
                f"{self.address} claims readings of shape {shape!r:.60} in {key!r}, and may be damaged"
            )
        return width

    def _annotating(self, text: str) -> tuple[str, str, Heading]:
        """The column that a heading names, the index behind it, and the heading."""
        heading = Heading.parsed(text)
        key, rest = matched(heading.column, self.features, self.address)
        kind = self.features[key]["dtype"]
        if kind in ("video", "image") or (kind == "string") > (heading.unit is None):
            raise FieldError(
                f"column {key!r} of {self.address}, as {text!r}, is of type {kind}; expected "
                + ("texts, or whole numbers" if heading.unit is None else "numbers")
            )
        return key, rest, heading

    def _column_of(self, batch: Any, key: str, rest: str, heading: Heading) -> npt.NDArray[Any]:
        """A column that annotates touches: a number a reading, NaN where there is none, or a text, as str."""
        column = batch.column(key)
        if self.types.is_dictionary(column.type):
            self.budget.take(batch.num_rows * 8 + column.dictionary.nbytes)
            texts = np.array(["", *(text or "" for text in column.dictionary.to_pylist())], object)
            if (longest := max(map(len, texts))) > LONGEST_NAME:
                raise FieldError(
                    f"column {key!r} of {self.address} has a text of {longest} characters; expected labels of at most "
                    f"{LONGEST_NAME}"
                )
            found: npt.NDArray[Any] = texts[column.indices.fill_null(-1).to_numpy() + 1]
            return found
        rows = select(self._rows(column, key), rest, heading.column)
        if rows.shape[1] != 1:
            raise FieldError(
                f"column {key!r} of {self.address} has {rows.shape[1]} numbers a reading; expected one: give which by "
                f"its place, as in {heading.name} [{heading.unit or 'label'}] from {key}[0]"
            )
        if heading.unit is not None:
            return rows[:, 0].astype(np.float64)
        # Of whole numbers some of which are missing pyarrow makes floats.
        numbers = rows[:, 0].tolist()
        return np.array(["" if math.isnan(number) else str(number).removesuffix(".0") for number in numbers], object)

    def _opened(self, path: Path, columns: list[str] | None, texts: list[str] | None = None) -> Any:
        """A parquet file to read these columns of, or any; raises RecordingError for one that lies elsewhere.

        texts: the columns of which each text is to be in memory once, and not once for every row that has it; raises
        FieldError for one that is not there, or of lists.

        The budget is charged for what their pages claim, before pyarrow opens it. What the footer holds
        about columns is not read by pyarrow: where that is damaged, pyarrow ends the process.
        """
        require_inside(self.path, path)
        self.budget.add(stored_bytes(path))
        require_bounded_pages(path, columns, self.budget)
        limits = {"thrift_string_size_limit": _LONGEST, "thrift_container_size_limit": _LONGEST_LIST}
        try:
            return self.parquet.ParquetFile(path, pre_buffer=False, read_dictionary=texts, **limits)
        except KeyError as error:
            name = next((text for text in texts or () if error.args == (text.encode(),)), None)
            if name is None:
                raise
            raise FieldError(
                f"{path.name} of {self.address} has no column {name!r} of texts, one a row; expected texts, no lists"
            ) from error

    def _table(self, file: Any, numbers: list[str], text: str | None = None) -> dict[str, list[Any]]:
        """Some columns of a small parquet table, whole: of numbers, and one of texts."""
        columns = numbers if text is None else [*numbers, text]
        for name in numbers:
            self._require_numbers(file.schema_arrow.field(name).type, name)
        if text is not None and self.types.is_nested(file.schema_arrow.field(text).type):
            raise FieldError(f"column {text!r} of {self.address} holds lists; expected texts")
        table: dict[str, list[Any]] = {name: [] for name in columns}
        # A long text that stands in the file once may be every row's.
        rows = rows_of(8 * len(numbers)) if text is None else 1
        for batch in file.iter_batches(batch_size=rows, columns=columns):
            self.budget.work(_TABLE_ROW * batch.num_rows)
            self.budget.take(batch.nbytes)
            for name, values in batch.to_pydict().items():
                table[name] += values
        return table

    def _block(self, batch: Any, reading: _Reading) -> Block:
        values = select(floats(self._rows(batch.column(reading.key), reading.key)), reading.rest, self.field())
        clock, tasks = reading.clock, reading.tasks
        times = self._rows(batch.column(clock), clock).astype(np.float64).reshape(batch.num_rows, -1)[:, 0]
        numbers = {}
        for name in ("episode_index", "frame_index", "task_index"):
            if name in batch.schema.names:
                if name == "episode_index" and batch.column(name).null_count:
                    raise FieldError(
                        f"column {name!r} of {self.address} has rows without a number; expected one in each"
                    )
                numbers[name] = self._rows(batch.column(name), name).astype(np.int64).reshape(-1)
        for episode, task in zip(
            numbers.get("episode_index", np.empty(0)), numbers.get("task_index", np.empty(0)), strict=False
        ):
            if int(task) in tasks:
                self.names.setdefault(int(episode), tasks[int(task)])
        counters = {"message": numbers["frame_index"]} if "frame_index" in numbers else {}
        annotations = {text: self._column_of(batch, *own) for text, own in reading.annotating.items()}
        return Block(values, {clock: times}, counters, numbers.get("episode_index"), annotations)

    def _column(self) -> tuple[str, str]:
        if self.request.field is None:
            raise self.contents().refused("expected a field to read")
        key, rest = matched(self.request.field, self.features, self.address)
        kind = self.features[key]["dtype"]
        if kind in ("video", "image", "string"):
            raise FieldError(f"field {key!r} of {self.address} is of type {kind}; expected numbers")
        return key, rest

    def _rows(self, column: Any, name: str) -> npt.NDArray[Any]:
        """A column as (rows, …), nested lists flattened; raises RecordingError where rows differ in length."""
        count, array = len(column), getattr(column, "storage", column)
        while hasattr(array.type, "value_type"):
            if array.null_count:
                raise RecordingError(f"column {name!r} of {self.address} has rows without a value")
            lengths = np.diff(array.offsets.to_numpy()) if hasattr(array, "offsets") else np.empty(0)
            if (lengths != lengths[:1]).any():
                raise RecordingError(f"column {name!r} of {self.address} is ragged: its rows differ in length")
            array = array.flatten()
        return np.ascontiguousarray(array.to_numpy(zero_copy_only=False)).reshape(count, -1)

    def _require_numbers(self, kind: Any, name: str, *, texts: bool = False) -> None:
        """Raises FieldError for a column of anything else, before it is read: a text may stand for every row of it.

        texts: whether it is one of labels: texts that were opened as such are taken, and numbers with a fraction not.
        """
        kind = getattr(kind, "storage_type", kind)
        if texts and self.types.is_dictionary(kind):
            kind = kind.value_type
            if self.types.is_string(kind) or self.types.is_large_string(kind):
                return
        if texts and self.types.is_floating(kind):
            raise FieldError(f"column {name!r} of {self.address} holds {kind}; expected texts, or whole numbers")
        while self.types.is_nested(kind) and hasattr(kind, "value_type"):
            kind = kind.value_type
        if not (self.types.is_integer(kind) or self.types.is_floating(kind) or self.types.is_boolean(kind)):
            raise FieldError(f"column {name!r} of {self.address} holds {kind}; expected numbers")

    def _files(self) -> list[Path]:
        """The parquet files that the episodes are in; raises RecordingError where one is missing."""
        listed: dict[tuple[int, int], None] = {}
        columns = ["data/chunk_index", "data/file_index"]
        for path in sorted((self.path / "meta" / "episodes").glob("**/*.parquet")):
            with self._opened(path, columns) as file:
                table = self._table(file, columns)
            listed |= dict.fromkeys(zip(table["data/chunk_index"], table["data/file_index"], strict=True))
        pattern = str(self.info["data_path"])
        if re.search(r"[{}\\]", _PLACEHOLDER.sub("", pattern)):
            raise RecordingError(f"{self.address} names its data {pattern!r:.100}; expected chunk_index and file_index")
        files = [self.path / pattern.format(chunk_index=chunk, file_index=file) for chunk, file in sorted(listed)]
        files = files or sorted((self.path / "data").glob("**/*.parquet"))
        for file in files:
            require_inside(self.path, file)
        absent = [str(file.relative_to(self.path)) for file in files if not file.is_file()]
        if absent or not files:
            raise RecordingError(
                f"{self.address} is not whole: {', '.join(absent[:5]) or 'its parquet files'}"
                f"{f' and {len(absent) - 5} more' if len(absent) > 5 else ''} missing; copy it again"
            )
        return files

    def _tasks(self) -> dict[int, str]:
        path = self.path / "meta" / "tasks.parquet"
        if not path.is_file():
            self.notes.append("the tasks are missing, meta/tasks.parquet: episodes have no name")
            return {}
        with self._opened(path, None) as file:
            # pandas writes an index without a name under one of its own
            name = next((name for name in file.schema_arrow.names if name != "task_index"), None)
            table = self._table(file, ["task_index"], name)
        return {int(i): str(text) for i, text in zip(table["task_index"], table.get(name or "", []), strict=False)}


# What the pages of a parquet file claim to hold, looked at before pyarrow is: it allocates whatever they claim.
#
# The file ends with a footer that says where the pages of each column are, and each page begins with a header that
# says what it becomes. Both are structures in Thrift's compact protocol (apache/parquet-format: parquet.thrift has the
# numbers of their fields). They are read here as the code that Thrift generates reads them, and refused where that code
# and this could read different things: a column that only pyarrow sees would be bounded by nobody.

_LONGEST_LIST = 1 << 16  # row groups, columns or other elements in a footer: pyarrow makes 1 KB of each
_I16, _I32, _I64, _BINARY, _LIST, _SET, _STRUCT = 4, 5, 6, 8, 9, 10, 12
_BITS = {_I16: 16, _I32: 32, _I64: 64}
_DEEPEST = 32  # structures, lists or groups of columns within each other
_HEADER = 1 << 14  # bytes of a page's header, the largest and smallest value of the page in it
_A_PAGE = 10  # steps of work
_VALUE = 8  # bytes of a value in memory: a wide number, or a narrow one and its place in a list

# What the lists of a footer hold. Thrift's code does not compare it with what a list says of itself.
_COLUMN: Any = {
    3: {2: [_I32], 3: [_BINARY], 8: [{}], 13: [{}], 16: {2: [_I64], 3: [_I64]}, 17: {2: [_I32]}},
    8: {2: {1: [_BINARY]}},
}
_FOOTER: Any = {2: [{}], 4: [{1: [_COLUMN], 4: [{}]}], 5: [{}], 7: [{}]}
_ABOUT = {0: 5, 2: 7, 3: 8}  # fields of a page's header by its type: data, a dictionary, and data of version 2

_Struct = dict[tuple[int, int], Any]


def require_bounded_pages(path: Path, columns: Collection[str] | None, budget: Budget) -> None:
    """Charge the budget for the pages of these columns, or of all; raises RecordingError where they claim too much.

    Raises another error, which `guarded` makes one, for a file that no writer writes.
    """
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(size - 8, 0))
        length, magic = int.from_bytes(file.read(4), "little"), file.read(4)
        if magic != b"PAR1" or length > size - 12:
            raise ValueError(f"{path.name} does not end as a parquet file does")
        budget.work(length)
        file.seek(size - 8 - length)
        footer = _Thrift(file.read(length)).struct(_FOOTER)
        elements = iter(footer[2, _LIST])
        chosen = list(_chosen(elements, None if columns is None else {name.encode() for name in columns}))
        for group in footer[4, _LIST]:
            for column, is_read in zip(group[1, _LIST], chosen, strict=True):
                if is_read:
                    _charge(file, column[3, _STRUCT], size - 8 - length, budget)


def _chosen(
    elements: Iterator[_Struct], columns: set[bytes] | None, path: bytes = b"", depth: int = 0
) -> Iterator[bool]:
    """Whether each column below the next element of a schema is read: pyarrow does if one of `columns` is its path."""
    element = next(elements, {})
    children = element.get((5, _I32), 0)
    if depth:
        path += (b"." if path else b"") + element[4, _BINARY]
        columns = None if columns is not None and path in columns else columns
    if depth > _DEEPEST:
        raise ValueError(f"more than {_DEEPEST} groups of columns within each other")
    if not children and (1, _I32) in element:
        yield columns is None
    for _ in range(children):
        yield from _chosen(elements, columns, path, depth + 1)


def _charge(file: BinaryIO, column: _Struct, size: int, budget: Budget) -> None:
    """Charge the budget for what the pages of a column claim; raises ValueError where they leave their place.

    Raises RecordingError where there are none, as in a file without rows.
    """
    place = column[9, _I64]
    if 0 < (dictionary := column.get((11, _I64), 0)) < place:
        place = dictionary
    if not place and not column[5, _I64]:  # as pyarrow writes it
        raise RecordingError(f"{file.name} has no rows: remove it, or write it again")
    end, values = place + column[7, _I64], 0
    if end > size:
        raise ValueError(f"a column ends at byte {end}, behind the {size} bytes of all")
    while place < end:
        budget.work(_A_PAGE)
        file.seek(place)
        thrift = _Thrift(file.read(min(_HEADER, end - place)))
        header = thrift.struct({})
        form, whole, stored = (header[field, _I32] for field in (1, 2, 3))
        count = header[_ABOUT[form], _STRUCT][1, _I32]
        place += thrift.at + stored
        if min(whole, stored, count) < 0 or place > end:
            raise ValueError(
                f"a page of {count} values, {whole} bytes in {stored}, ends at {place}, its column at {end}"
            )
        budget.take(max(whole, stored, _VALUE * count))
        values += count if form != 2 else 0
    if values != column[5, _I64]:  # where it misses values, pyarrow may look for them behind the column's end
        raise ValueError(f"a column of {column[5, _I64]} values has {values} in its pages")


class _Thrift:
    """Reads a structure of Thrift's compact protocol; `at` is behind what was read.

    Raises IndexError where the data end, and ValueError for what no writer writes.
    """

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def struct(self, lists: Any, depth: int = 0) -> _Struct:
        """Values by their field's number and kind: Thrift's code passes over a field of another kind.

        lists: what the lists in it hold, by field.
        """
        found: _Struct = {}
        field = 0
        while kind := (head := self._byte()) & 15:
            field = field + (head >> 4) if head >> 4 else self._integer(16)
            if (field, kind) in found or not 0 <= field < 1 << 15:
                raise ValueError(f"field {field} of a structure, twice or beyond all")
            found[field, kind] = kind == 1 if kind in (1, 2) else self._value(kind, lists.get(field), depth)
        return found

    def _value(self, kind: int, lists: Any, depth: int) -> Any:
        if depth > _DEEPEST:
            raise ValueError(f"more than {_DEEPEST} structures within each other")
        if kind in _BITS:
            return self._integer(_BITS[kind])
        if kind == _STRUCT:
            return self.struct(lists if isinstance(lists, dict) else {}, depth + 1)
        if kind in (_LIST, _SET):
            return self._list(lists[0] if isinstance(lists, list) else None, depth + 1)
        if kind not in (1, 2, 3, 7, _BINARY):
            raise ValueError(f"a value of kind {kind}")
        count = self._number() if kind == _BINARY else 8 if kind == 7 else 1
        self.at += count
        if self.at > len(self.data):
            raise IndexError(f"{count} bytes of a value, more than there are")
        return self.data[self.at - count : self.at]

    def _list(self, lists: Any, depth: int) -> list[Any]:
        head = self._byte()
        count, kind = self._number() if head >> 4 == 15 else head >> 4, head & 15
        if count > _LONGEST_LIST or (
            count and lists is not None and kind != (_STRUCT if isinstance(lists, dict) else lists)
        ):
            raise ValueError(f"a list of {count} values of kind {kind}")
        return [self._value(kind, lists, depth) for _ in range(count)]

    def _byte(self) -> int:
        self.at += 1
        return self.data[self.at - 1]

    def _number(self) -> int:
        value = shift = 0
        while (byte := self._byte()) & 0x80 and shift < 63:
            value |= (byte & 0x7F) << shift
            shift += 7
        return value | byte << shift

    def _integer(self, bits: int) -> int:
        value = self._number()
        if value >> bits:
            raise ValueError(f"a number of more than {bits} bits")
        return value >> 1 ^ -(value & 1)
