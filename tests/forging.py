"""Rows, identities and generations with right checksums, such as anyone can make: nothing in a checksum is secret."""

from __future__ import annotations

import hashlib
import json
import shutil
import sqlite3
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from store import Store
from store.encoding import array_digest, check_arrays, encode_payload
from store.records import checksum, payload_digest

HEADER = struct.Struct("<4sBH")
LENGTHS = struct.Struct("<BQQ")


@contextmanager
def connected(path: Path) -> Iterator[sqlite3.Connection]:
    """The journal of a memory, opened by SQLite and nothing else; each statement is its own transaction."""
    with closing(sqlite3.connect(path / "journal.sqlite", isolation_level=None)) as connection:
        connection.execute("PRAGMA synchronous = OFF")
        yield connection


def as_text(value: Any) -> str:
    """JSON as the store writes it; a text is taken to be JSON, or meant to be none."""
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True, separators=(",", ":"))


def _checksum(table: str, *fields: Any) -> bytes:
    """The right checksum; any where a field is of a type that no checksum takes."""
    try:
        return checksum(table, *(field.encode() if isinstance(field, str) else field for field in fields))
    except (TypeError, struct.error, UnicodeEncodeError):
        return bytes(16)


def observation(path: Path) -> tuple[dict[str, Any], bytes]:
    """The attributes and the payload of the first observation of a memory whose arrays are there."""
    query = "SELECT attributes, bytes FROM record JOIN payload USING (sequence) WHERE kind = 'observe' ORDER BY 1"
    with connected(path) as connection:
        attributes, payload = connection.execute(query).fetchone()
    return json.loads(attributes), payload


def put_row(
    path: Path,
    *,
    kind: str = "observe",
    label: str = "silk",
    key: bytes = b"k" * 32,
    attributes: Any = None,
    payload: bytes | Mapping[str, np.ndarray] | None = None,
    time: Any = 0.0,
    sequence: int | None = None,
    **columns: Any,
) -> int:
    """Put a row into a journal, in place of any that has its sequence, and return that: by default the next one.

    payload: bytes, or arrays by name. columns: size, digest or checksum, where they are to be others than the right
    ones.
    """
    body = payload if isinstance(payload, bytes) else encode_payload(check_arrays(payload or {}))
    with connected(path) as connection:
        if sequence is None:
            (last,) = connection.execute("SELECT coalesce(max(sequence), 0) FROM record").fetchone()
            sequence = last + 1
        row = {"sequence": sequence, "kind": kind, "label": label, "key": key, "time": time}
        row |= {"attributes": as_text({} if attributes is None else attributes)}
        row |= {"size": len(body), "digest": payload_digest(body)} | columns
        row.setdefault("checksum", _checksum("record", *row.values()))
        connection.execute("BEGIN")
        connection.execute("INSERT OR REPLACE INTO record VALUES (?,?,?,?,?,?,?,?,?)", tuple(row.values()))
        connection.execute("INSERT OR REPLACE INTO payload VALUES (?,?)", (sequence, body))
        connection.execute("COMMIT")
    return int(sequence)


def get_meta(path: Path, key: str) -> str:
    """What table meta holds."""
    with connected(path) as connection:
        found: str = connection.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()[0]
        return found


def set_meta(path: Path, key: str, value: str) -> None:
    """Write into table meta."""
    with connected(path) as connection:
        row = (key, value, _checksum("meta", key, value))
        connection.execute("INSERT OR REPLACE INTO meta VALUES (?,?,?)", row)


def get_identity(path: Path) -> dict[str, Any]:
    """The identity of a memory."""
    return dict(json.loads(get_meta(path, "identity")))


def set_identity(path: Path, identity: Any) -> None:
    """Give a memory another identity: a JSON value, or a text."""
    set_meta(path, "identity", as_text(identity))


@dataclass(frozen=True)
class Packed:
    """An array in a payload: what is said of it, and its buffer; stored: the length that the buffer is said to have."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    codec: int
    size: int
    buffer: bytes
    stored: int | None = None


def pack(arrays: Sequence[Packed], version: int = 1, count: int | None = None) -> bytes:
    """A payload as FORMAT.md says it is, of arrays of which anything may be said."""
    head, buffers = [HEADER.pack(b"ARPL", version, len(arrays) if count is None else count)], []
    for array in arrays:
        for text in (array.name.encode("latin-1"), array.dtype.encode("latin-1")):
            head.append(struct.pack("<B", len(text) % 256) + text)
        lengths = [length % 2**64 for length in array.shape]
        head.append(struct.pack(f"<B{len(lengths)}Q", len(lengths) % 256, *lengths))
        stored = len(array.buffer) if array.stored is None else array.stored
        head.append(LENGTHS.pack(array.codec % 256, array.size % 2**64, stored % 2**64))
        buffers.append(array.buffer)
    return b"".join(head + buffers)


def unpack(payload: bytes) -> tuple[int, list[Packed]]:
    """The version of a sound payload, and its arrays."""
    _, version, count = HEADER.unpack_from(payload)
    start, arrays = HEADER.size, []
    for _ in range(count):
        texts = []
        for _ in ("name", "dtype"):
            texts.append(payload[start + 1 : start + 1 + payload[start]].decode("ascii"))
            start += 1 + payload[start]
        axes = payload[start]
        shape = struct.unpack_from(f"<{axes}Q", payload, start + 1)
        codec, size, stored = LENGTHS.unpack_from(payload, start + 1 + 8 * axes)
        start += 1 + 8 * axes + LENGTHS.size
        arrays.append(Packed(*texts, shape, codec, size, b"", stored))
    for i, array in enumerate(arrays):
        length = array.stored or 0
        arrays[i] = replace(array, buffer=payload[start : start + length], stored=None)
        start += length
    return version, arrays


def raw(name: str, array: np.ndarray) -> Packed:
    """An array as it is, in no codec."""
    return Packed(name, array.dtype.str, array.shape, 0, array.nbytes, array.tobytes())


@dataclass(frozen=True)
class Named:
    """A row of table generation without its checksum."""

    number: int
    upto: int
    base: int
    time: Any
    attributes: str
    content: str


def generations(path: Path) -> list[Named]:
    """The generations that a journal names, the newest first."""
    with connected(path) as connection:
        query = "SELECT number, upto, base, time, attributes, content FROM generation ORDER BY upto DESC, number DESC"
        return [Named(*row) for row in connection.execute(query)]


def name_generation(path: Path, row: Named) -> None:
    """Have the journal name a generation, in place of any of its number."""
    with connected(path) as connection:
        values = (*astuple(row), _checksum("generation", *astuple(row)))
        connection.execute("INSERT OR REPLACE INTO generation VALUES (?,?,?,?,?,?,?)", values)


def group_of(path: Path, row: Named) -> Path:
    """The folder of a generation."""
    return path / "generations" / f"{row.number:08d}"


def seal(path: Path, row: Named, identity: Any = None) -> None:
    """Write a generation's row, and the same into its group, with the right sha256."""
    name_generation(path, row)
    header = group_of(path, row) / "zarr.json"
    group = json.loads(header.read_text(encoding="utf-8"))
    known = {"number": row.number, "upto": row.upto, "identity": get_identity(path) if identity is None else identity}
    try:
        content = json.loads(row.content)
        known |= {"attributes": json.loads(row.attributes)} | (content if isinstance(content, Mapping) else {})
    except (ValueError, RecursionError):
        return  # no JSON: the group stays as it was
    group["attributes"] = sealed(known)
    header.write_text(json.dumps(group), encoding="utf-8")


def sealed(known: Mapping[str, Any]) -> dict[str, Any]:
    """What a generation's group says of itself, with the sha256 of it."""
    return {**known, "sha256": hashlib.sha256(as_text(dict(known)).encode("ascii")).hexdigest()}


def put_arrays(path: Path, row: Named, arrays: Mapping[str, np.ndarray]) -> Named:
    """Write arrays into a generation's group, in place of those of their names; the row that names all of it.

    They are written without any codec but that for bytes, in one chunk each, as anyone may.
    """
    content = json.loads(row.content)
    for name, array in arrays.items():
        folder = group_of(path, row) / name
        put_array(folder, array)
        described = {"dtype": array.dtype.str, "shape": list(array.shape), "sha256": array_digest(array)}
        content["arrays"][name] = described
    return replace(row, content=as_text(content))


def put_array(folder: Path, array: np.ndarray) -> None:
    """Write one array as a zarr array of one chunk; text as its code points, as the store does."""
    plain = array
    if array.dtype.kind == "U":
        plain = np.frombuffer(array.tobytes(), "<u4").reshape(*array.shape, array.dtype.itemsize // 4)
    meta = {
        "shape": list(plain.shape),
        "data_type": "bool" if plain.dtype.kind == "b" else plain.dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [max(n, 1) for n in plain.shape]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": False if plain.dtype.kind == "b" else 0,
        "codecs": [{"name": "bytes", "configuration": {"endian": "little"}}],
        "attributes": {"dtype": array.dtype.str},
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }
    chunk = folder.joinpath("c", *["0"] * plain.ndim)
    chunk.parent.mkdir(parents=True, exist_ok=True)
    (folder / "zarr.json").write_text(json.dumps(meta), encoding="utf-8")
    if plain.size:
        chunk.write_bytes(np.ascontiguousarray(plain).tobytes())


def row_of(path: Path, sequence: int = 1) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """A row's attributes and arrays, the caller's to change."""
    with Store.open(path, mode="read") as store:
        record = store.record(sequence)
        return dict(record.attributes), dict(record.arrays)


def generation_of(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The attributes and arrays of the newest generation, the caller's to change."""
    with Store.open(path, mode="read") as store:
        newest = store.latest()
        return dict(newest.attributes), dict(newest.arrays)


def put_generation(path: Path, attributes: Any, arrays: Mapping[str, np.ndarray], *, base: bool = False) -> None:
    """Make this the newest generation, or the base of all rows."""
    with Store.open(path) as store:
        store.commit(arrays, upto=store.last, attributes=attributes)
        if base:
            store.compact(arrays, upto=store.last, attributes=attributes)


def copied(source: Path, target: Path) -> Path:
    """A copy of a memory's folder."""
    shutil.copytree(source, target)
    return target
