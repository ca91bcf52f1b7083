"""Parquet files made to harm, written byte by byte: by name, which file of a LeRobotDataset and what writes it.

Footers and page headers are structures in Thrift's compact protocol, see parquet-format.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numcodecs import Zstd

I32, I64, BINARY, LIST, STRUCT = 5, 6, 8, 9, 12
TIP = "observation.tactile.tip"
MOST = 2**31 - 1
Write = Callable[[Path], Any]


def varint(number: int) -> bytes:
    out = b""
    while number > 127:
        out += bytes([number & 127 | 128])
        number >>= 7
    return out + bytes([number])


def value(kind: int, about: Any) -> bytes:
    if kind in (I32, I64):
        return varint(about << 1 ^ about >> 63)
    if kind == LIST:
        inner, parts = about
        return bytes([15 << 4 | inner]) + varint(len(parts)) + b"".join(value(inner, part) for part in parts)
    return varint(len(about)) + about if kind == BINARY else about


def struct(fields: dict[int, tuple[int, Any]]) -> bytes:
    """A structure: kind and value by the field's number."""
    body = b"".join(bytes([kind]) + value(I32, number) + value(kind, about) for number, (kind, about) in fields.items())
    return body + b"\0"


def page(form: int, whole: int, data: bytes, stored: int | None = None, values: int = 1) -> bytes:
    """A page of plain numbers. form: 0 and 3 of data, 2 a dictionary; whole, stored: the bytes that it claims."""
    inner = {1: values, 2: 0} if form == 2 else {1: values, 2: 0, 3: 3, 4: 3}
    if form == 3:
        inner = {1: values, 2: 0, 3: values, 4: 0, 5: 0, 6: 0}
    about = struct({field: (I32, number) for field, number in inner.items()})
    head = {1: (I32, form), 2: (I32, whole), 3: (I32, len(data) if stored is None else stored)}
    return struct(head | {{0: 5, 2: 7, 3: 8}[form]: (STRUCT, about)}) + data


ZERO = page(0, 4, Zstd().encode(np.zeros(1, "f4")))


def chunk(form: int, place: int, length: int) -> dict[int, tuple[int, Any]]:
    """Where a column's pages are, which zstd compressed."""
    about = {1: (I32, form), 2: (LIST, (I32, [0])), 3: (LIST, (BINARY, [b"x"])), 4: (I32, 6), 5: (I64, 1)}
    return about | {6: (I64, length), 7: (I64, length), 9: (I64, place)}


def parquet(tip: bytes, gap: int = 0, groups: bytes = b"") -> tuple[bytes, bytes]:
    """A file of one row of two numbers: its beginning, and its end behind so many bytes that are not written."""
    clock = page(0, 8, Zstd().encode(np.zeros(1)))
    begin = b"PAR1" + clock + tip
    chunks = [chunk(4, 4 + len(clock), len(tip) + gap), chunk(5, 4, len(clock))]
    columns = [struct({2: (I64, 4), 3: (STRUCT, struct(about))}) for about in chunks]
    schema = [struct({4: (BINARY, b"schema"), 5: (I32, 2)})]
    for name, form in ((TIP, 4), ("timestamp", 5)):
        schema.append(struct({1: (I32, form), 3: (I32, 0), 4: (BINARY, name.encode())}))
    group = struct({1: (LIST, (STRUCT, columns)), 2: (I64, 20), 3: (I64, 1)})
    groups = groups or value(LIST, (STRUCT, [group]))
    head = struct({1: (I32, 1), 2: (LIST, (STRUCT, schema)), 3: (I64, 1)})[:-1]
    footer = head + bytes([LIST]) + value(I32, 4) + groups + b"\0"
    return begin, footer + len(footer).to_bytes(4, "little") + b"PAR1"


def pages(tip: bytes) -> Write:
    """These are the pages of the readings."""
    return lambda file: file.write_bytes(b"".join(parquet(tip)))


def long_page(form: int) -> Write:
    """2 GiB of zeros in 100 KB: a frame of zstd behind the other."""
    frames = Zstd(9).encode(bytes(1 << 20)) * 2047 + Zstd(9).encode(bytes((1 << 20) - 1))
    return pages(page(form, MOST, frames, values=MOST // 4 if form == 2 else 1) + (ZERO if form == 2 else b""))


def many_groups(file: Path) -> None:
    """A list of a million row groups, of which none is there."""
    file.write_bytes(b"".join(parquet(ZERO, groups=bytes([15 << 4 | STRUCT]) + varint(10**6))))


def in_a_hole(file: Path) -> None:
    """A page of 2 GB that nobody wrote."""
    begin, end = parquet(page(0, 4, b"", stored=MOST), MOST)
    with file.open("wb") as there:
        there.write(begin)
        there.seek(MOST, 1)
        there.write(end)


def texts(name: str, clock: str) -> Write:
    """4096 rows of a text of a megabyte, which stands in the file once."""

    def write(file: Path) -> None:
        text = np.random.default_rng(1).integers(32, 127, 1 << 20).astype("u1").tobytes().decode()
        column = pa.DictionaryArray.from_arrays(np.zeros(4096, "i4"), pa.array([text]))
        pq.write_table(pa.table({name: column, clock: np.arange(4096)}), file, store_schema=False)

    return write


def long_row(file: Path) -> None:
    """A row of 4·10^7 numbers, and one of none."""
    count = 40_000_000
    rows = pa.ListArray.from_arrays(np.array([0, count, count], "i4"), pa.array(np.zeros(count, "f4")))
    pq.write_table(pa.table({TIP: rows, "timestamp": [0.0, 0.1]}), file, compression="zstd")


DATA, TASKS = "data/chunk-000/file-000.parquet", "meta/tasks.parquet"
PARQUETS: dict[str, tuple[str, Write]] = {
    "a long page": (DATA, long_page(0)),
    "a long page, version 2": (DATA, long_page(3)),
    "a long dictionary": (DATA, long_page(2)),
    "a dictionary of many": (DATA, pages(page(2, 4, Zstd().encode(bytes(4)), values=MOST) + ZERO)),
    "a page behind its column": (DATA, pages(page(0, 4, bytes(20), stored=4000))),
    "a page of too few": (DATA, pages(page(0, 0, Zstd().encode(b""), values=0))),
    "a page that nobody wrote": (DATA, in_a_hole),
    "many row groups": (DATA, many_groups),
    "texts for numbers": (DATA, texts(TIP, "timestamp")),
    "long tasks": (TASKS, texts("task", "task_index")),
    "a long row": (DATA, long_row),
}
