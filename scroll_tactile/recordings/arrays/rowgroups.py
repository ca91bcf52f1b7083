"""All columns of a parquet file, row group after row group, as they are: to write them again with others beside them.

A text that stands in a file once may be every row's. So texts are read as dictionaries, in which each is in memory
once; what they become row by row is counted, and charged, before they do.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from scroll_tactile.errors import RecordingError
from scroll_tactile.recordings.arrays.lerobot import LeRobot
from scroll_tactile.recordings.bounds import Budget

__all__ = ["codec_of", "row_groups", "schema_of"]

_WIDEST = 64  # bytes of a value of fixed length: a decimal, or a hash
_VIEWS = ("string_view", "binary_view")  # which pyarrow makes of no dictionary


def schema_of(source: LeRobot, path: Path) -> Any:
    """The schema of a parquet file of a data set, as pyarrow has it; the file counts towards its budget."""
    with source.opened(path, None) as file:
        return file.schema_arrow


def codec_of(source: LeRobot, path: Path) -> str:
    """What the first column of a parquet file is compressed by, as pyarrow's writer takes it."""
    with source.opened(path, []) as file:
        about = file.metadata
        codec = about.row_group(0).column(0).compression if about.num_row_groups and about.num_columns else "SNAPPY"
    return "none" if codec == "UNCOMPRESSED" else str(codec).lower()


def row_groups(source: LeRobot, path: Path) -> Iterator[Any]:
    """The row groups of a parquet file of a data set, as pyarrow's tables, with its schema.

    Raises RecordingError for a file that lies elsewhere, or claims to hold more than one of its size can.
    """
    with source.opened(path, None) as file:
        schema, texts = file.schema_arrow, _texts(file, path)
    with source.opened(path, None, texts) as file:
        for number in range(file.num_row_groups):
            table = file.read_row_group(number)
            columns = [_plain(table.column(field.name), field.type, source.budget) for field in schema]
            yield type(table).from_arrays(columns, schema=schema)


def _texts(file: Any, path: Path) -> list[str]:
    """The paths of the columns of texts and bytes that are no dictionaries yet."""
    found = []
    for place in range(len(file.schema)):
        column = file.schema.column(place)
        if column.physical_type == "FIXED_LEN_BYTE_ARRAY" and column.length > _WIDEST:
            raise RecordingError(
                f"column {column.path!r} of {path} has values of {column.length} bytes each; expected at most {_WIDEST}"
            )
        if column.physical_type != "BYTE_ARRAY":
            continue
        of = max((name for name in file.schema_arrow.names if f"{column.path}.".startswith(f"{name}.")), key=len)
        kinds = list(_kinds(file.schema_arrow.field(of).type))
        if any(hasattr(kind, "storage_type") for kind in kinds):
            raise RecordingError(
                f"column {column.path!r} of {path} holds texts of an extension type, which cannot be bounded: leave it "
                "out, or write it as plain texts"
            )
        for kind in kinds:
            if hasattr(kind, "key_type") or str(kind) in _VIEWS:
                raise RecordingError(
                    f"column {column.path!r} of {path} holds texts as {kind}, which cannot be written again: leave it "
                    "out, or write it as plain texts, or lists of them"
                )
        found += [] if any(hasattr(kind, "index_type") for kind in kinds) else [column.path]
    return found


def _kinds(kind: Any) -> Iterator[Any]:
    """A type and all within it."""
    yield kind
    for place in range(kind.num_fields):
        yield from _kinds(kind.field(place).type)


def _plain(column: Any, kind: Any, budget: Budget) -> Any:
    """A column whose texts were read as dictionaries, in the type that the file gives it."""
    if column.type == kind:
        return column
    for chunk in column.chunks:
        for leaf in _dictionaries(chunk):
            budget.take(_bytes(leaf))
    return column.cast(kind)


def _dictionaries(array: Any) -> Iterator[Any]:
    """The dictionaries in an array of lists and structures."""
    if hasattr(array, "dictionary"):
        yield array
    elif hasattr(array.type, "value_type"):
        yield from _dictionaries(array.flatten())
    elif hasattr(array.type, "num_fields") and array.type.num_fields:
        for inner in array.flatten():
            yield from _dictionaries(inner)


def _bytes(array: Any) -> int:
    """What the texts of a dictionary take, row by row."""
    from pyarrow import compute

    lengths = compute.binary_length(array.dictionary).cast("int64")
    return 8 * len(array) + (compute.sum(lengths.take(array.indices)).as_py() or 0)
