"""Columns in parquet and feather files, read by pyarrow: a file alone, or a LeRobotDataset v2 or v3, whole."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import RecordingError
from scroll_tactile.libraries import missing
from scroll_tactile.recordings.arraystores import ArraySource, HeldArray
from scroll_tactile.recordings.blocks import Contents, Entry, Request
from scroll_tactile.recordings.bounds import read_text, require_inside, stored_bytes

__all__ = ["Columnar", "LeRobot", "is_lerobot"]

_LONGEST = 1 << 24  # bytes of a description
_PLACEHOLDER = re.compile(r"\{(?:chunk_index|file_index|episode_chunk|episode_index)(?::0?\d?d)?\}")
_BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def is_lerobot(path: Path) -> bool:
    """Whether a folder is a LeRobot data set."""
    return (path / "meta" / "info.json").is_file()


class Columnar(ArraySource):
    """A `.parquet` or `.feather`: a column of numbers is a channel, one of lists has a reading a row."""

    table = True

    def __init__(self, path: Path, address: str, request: Request) -> None:
        try:
            import pyarrow
            from pyarrow import feather, parquet, types
        except ImportError as error:
            what = "a LeRobot data set" if path.is_dir() else "a parquet or feather file"
            raise missing("pyarrow", "lerobot", what, cause=error) from error
        super().__init__(path, address, request)
        self.arrow: Any = pyarrow
        self.parquet: Any = parquet
        self.feather: Any = feather
        self.types: Any = types
        self._loaded = lru_cache(maxsize=16)(self._load)  # the columns of a file or two, and not of all

    @contextmanager
    def opened(self) -> Iterator[dict[str, Any]]:
        """The columns by their names."""
        yield dict(self.columns(self.path, "", None))

    def columns(
        self, path: Path, before: str, shapes: Mapping[str, tuple[int, ...]] | None
    ) -> Iterator[tuple[str, Any]]:
        """The columns of a file, which are read when they are asked for. shapes: of entries, if they are known."""
        if self.path.is_dir():
            require_inside(self.path, path)
        self.stored += stored_bytes(path)
        feather = path.suffix.lower() == ".feather"
        # What the footer holds about columns is not read by pyarrow: where that is damaged, pyarrow ends the process.
        file = (
            self.arrow.ipc.open_file(self.arrow.OSFile(str(path)))
            if feather
            else self.parquet.ParquetFile(path, pre_buffer=False)
        )
        schema, rows = (file.schema, file.count_rows()) if feather else (file.schema_arrow, file.metadata.num_rows)
        groups = [] if feather else [file.metadata.row_group(i) for i in range(file.metadata.num_row_groups)]
        chunks = [group.column(i) for group in groups for i in range(file.metadata.num_columns)]
        for field in schema:
            kind, shape = getattr(field.type, "storage_type", field.type), [rows]
            while hasattr(kind, "value_type") and not self.types.is_dictionary(kind):
                shape.append(getattr(kind, "list_size", 0))
                kind = kind.value_type
            own = [chunk for chunk in chunks if f"{chunk.path_in_schema}.".startswith(f"{field.name}.")]
            claimed = [8 * math.prod(shape), *(max(one.total_uncompressed_size, 8 * one.num_values) for one in own)]
            load = partial(self._loaded, path, field.name, max(claimed[0], sum(claimed[1:])))
            numbers = self.types.is_integer(kind) or self.types.is_floating(kind) or self.types.is_boolean(kind)
            dtype = kind.to_pandas_dtype() if numbers else "M8[ns]" if self.types.is_timestamp(kind) else object
            if numbers and 0 in shape[1:]:  # lists of any length: they are looked at
                shape = list(load().shape) if shapes is None else [rows, *shapes.get(field.name, ())]
            name = "time" if field.name == "__index_level_0__" and dtype == "M8[ns]" else field.name  # pandas' index
            yield before + name, HeldArray(tuple(shape), np.dtype(dtype), load, str(field.type))

    def _load(self, path: Path, name: str, claimed: int) -> npt.NDArray[Any]:
        """A column, shape (rows, …); raises RecordingError for one that is ragged, or larger than its file can hold."""
        self.claim(claimed)
        if path.suffix.lower() == ".feather":
            column = self.feather.read_table(path, columns=[name], memory_map=False).column(0)
        else:
            column = self.parquet.ParquetFile(path, pre_buffer=False).read([name]).column(0)
        array = column.combine_chunks()
        shape, array = [len(array)], getattr(array, "storage", array)
        while hasattr(array.type, "value_type") and not self.types.is_dictionary(array.type):
            if array.null_count:
                raise RecordingError(f"column {name!r} of {self.address} has rows without a value")
            if not hasattr(array.type, "list_size"):
                lengths = np.diff(array.offsets.to_numpy())
                if (lengths != lengths[:1]).any():
                    raise RecordingError(f"column {name!r} of {self.address} is ragged: its rows differ in length")
            inner = array.flatten()
            shape.append(len(inner) // max(len(array), 1))
            array = inner
        found: npt.NDArray[Any] = array.to_numpy(zero_copy_only=False).reshape(shape)
        return found


class LeRobot(Columnar):
    """A LeRobotDataset; see `Source`. An episode is called what its task is."""

    labels = False

    def __init__(self, path: Path, address: str, request: Request) -> None:
        super().__init__(path, address, request)
        self.info = self._json(path / "meta" / "info.json")[0]
        version = str(self.info.get("codebase_version", ""))
        if not version.startswith(("v2", "v3")):
            raise RecordingError(f"{address} is a LeRobotDataset {version or 'of no version'}; expected v2 or v3")
        self.features: dict[str, Any] = self.info["features"]

    def _json(self, path: Path) -> list[Any]:
        """What a description says, a line each where it is one of lines."""
        text = read_text(self.path, path, _LONGEST)
        if not text.strip():
            raise RecordingError(f"{path} is empty, where it describes a LeRobot data set: copy it again")
        return [json.loads(part) for part in (text.splitlines() if path.suffix == ".jsonl" else [text]) if part.strip()]

    def key(self, name: str) -> str:
        """A column's name, without the number of its file."""
        return name.partition("/")[2]

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

    @contextmanager
    def opened(self) -> Iterator[dict[str, Any]]:
        """The columns of each file, below its number."""
        shapes = {name: tuple(about["shape"]) for name, about in self.features.items()}
        self.tasks = self._named_tasks()
        arrays: dict[str, Any] = {}
        for i, path in enumerate(self._files()):
            there = dict(self.columns(path, f"{i}/", shapes))
            for name in shapes.keys() - {self.key(name) for name in there}:
                kind = self.features[name]["dtype"]
                said = kind if kind in ("video", "image") else f"missing in {path.name}"
                there[f"{i}/{name}"] = HeldArray((0,), np.dtype(object), None, said)
            arrays |= there
        yield arrays

    def _files(self) -> list[Path]:
        """The parquet files that the episodes are in; raises RecordingError where one is missing."""
        pattern = str(self.info["data_path"])
        if re.search(r"[{}\\]", _PLACEHOLDER.sub("", pattern)):
            raise RecordingError(
                f"{self.address} names its data {pattern!r:.100}; expected the numbers of chunk, file and episode"
            )
        lines, files = self.path / "meta" / "episodes.jsonl", []
        for one in self._json(lines) if lines.is_file() else []:
            number = int(one["episode_index"])
            chunk = number // int(self.info.get("chunks_size", 1000))
            files.append(
                pattern.format(episode_chunk=chunk, episode_index=number, chunk_index=chunk, file_index=number)
            )
        for path in sorted((self.path / "meta" / "episodes").glob("**/*.parquet")):
            columns = dict(self.columns(path, "", {}))
            places = zip(columns["data/chunk_index"][:].tolist(), columns["data/file_index"][:].tolist(), strict=True)
            files += [pattern.format(chunk_index=chunk, file_index=file) for chunk, file in places]
        found = [self.path / name for name in dict.fromkeys(files)] or sorted((self.path / "data").glob("**/*.parquet"))
        for file in found:
            require_inside(self.path, file)
        absent = [str(file.relative_to(self.path)) for file in found if not file.is_file()]
        if absent or not found:
            raise RecordingError(
                f"{self.address} is not whole: {', '.join(absent[:5]) or 'its parquet files'}"
                f"{f' and {len(absent) - 5} more' if len(absent) > 5 else ''} missing; copy it again"
            )
        return found

    def _named_tasks(self) -> dict[int, str]:
        """What the tasks are called, by their numbers."""
        lines, table = self.path / "meta" / "tasks.jsonl", self.path / "meta" / "tasks.parquet"
        if lines.is_file():
            return {int(one["task_index"]): str(one["task"]) for one in self._json(lines)}
        if not table.is_file():
            self.notes.append("the tasks are missing, meta/tasks.parquet: episodes have no name")
            return {}
        columns = dict(self.columns(table, "", {}))
        # pandas writes an index without a name under one of its own
        names: Any = next((column[:] for name, column in columns.items() if name != "task_index"), [])
        return {int(i): str(text) for i, text in zip(columns["task_index"][:], names, strict=False)}
