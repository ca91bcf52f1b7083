"""An array of a generation as zarr has it on disk: its description, and its chunks, read and verified.

zarr writes them and anybody may read them with it. Here they are read without it: of a description that somebody else
made, only one that our own writers would have made for the array counts, and of a file not more than its chunk needs.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterator, Mapping
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from store.content import ArrayContent
from store.encoding import flat_bytes, require_values
from store.exceptions import DamageError
from store.files import read_regular
from store.frames import decompress_blosc, decompress_zstd
from store.records import from_json

__all__ = ["ArrayFiles", "file_digests", "most_bytes"]

LARGEST_DESCRIPTION = 2**16  # bytes of an array's zarr.json, which has a few hundred

# Of small files that stand for gigabytes nobody is to make room for these. `write_group` keeps to it.
SPARE, RATIO = 192 * 2**20, 16

SHARD_INDEX = np.dtype([("start", "<u8"), ("size", "<u8")])
NOTHING = 2**64 - 1  # in both, for a chunk of zeros that has no bytes
CHECKSUM = 4  # bytes behind the index
CHUNK_MORE = 64  # bytes: a chunk's place in the index, the header of its frame, and what is no smaller compressed
MOST_CHUNKS = 2**18  # each costs time; the largest memory that is known has a few thousand


def most_bytes(group: Path) -> int:
    """Return how many bytes of arrays the files in a generation's folder may stand for."""
    files = (Path(folder, name).lstat() for folder, _, names in os.walk(group) for name in names)
    return SPARE + RATIO * sum(found.st_size for found in files if stat.S_ISREG(found.st_mode))


class ArrayFiles:
    """The files of an array in `folder` of the generation `group`; `content` says what must be in them.

    Every method raises DamageError, ValueError for what is not as it was written, and OSError.
    """

    def __init__(self, group: Path, name: str, content: ArrayContent) -> None:
        self._group, self._folder, self._content = group, group / name, content
        text = read_regular(self._folder / "zarr.json", LARGEST_DESCRIPTION, within=group).decode()
        known = from_json(text)
        self._codec, self._shard, self._chunk = _layout(known, content)
        expected = _description(content)
        if wrong := sorted(name for name, value in expected.items() if known.get(name) != value):
            raise ValueError(f"its zarr.json has another {' and '.join(wrong)} than was written")

    def _files(self) -> Iterator[tuple[tuple[int, ...], Path]]:
        for place in self._content.places(self._shard or self._chunk):
            yield place, self._folder.joinpath("c", *map(str, place))

    def read(self) -> np.ndarray:
        """Return the array, each file verified before it is decompressed; its own sha256 is the caller's to verify."""
        content = self._content
        array = np.empty(content.shape, content.dtype)
        plain = flat_bytes(array).view(content.plain).reshape(content.plain_shape)
        most = prod(self._shard or self._chunk) * plain.itemsize
        most += most // 64 + 1024 + CHUNK_MORE * prod(content.grid(self._chunk))
        for i, (place, path) in enumerate(self._files()):
            data = read_regular(path, most, within=self._group)
            if content.files is not None and hashlib.sha256(data).hexdigest() != content.files[i]:
                raise DamageError(f"{path} is not what was written: its sha256 differs", path=path)
            if self._shard is None:
                self._fill(plain, place, data)
            else:
                self._fill_all(plain, data)
        require_values(array)
        return array

    def _fill_all(self, plain: np.ndarray, data: bytes) -> None:
        """Fill an array from its only shard, whose chunks are in the order of the grid, their index at the end."""
        count = prod(self._content.grid(self._chunk))
        index = len(data) - CHECKSUM - SHARD_INDEX.itemsize * count
        if index < 0 or count > MOST_CHUNKS:
            raise ValueError(f"a shard of {len(data)} bytes claims {count} chunks")
        chunks = np.frombuffer(data[index:-CHECKSUM], SHARD_INDEX).tolist()
        for place, (start, size) in zip(self._content.places(self._chunk), chunks, strict=True):
            if start == size == NOTHING:
                plain[self._region(place)] = 0
                continue
            if start + size > index:
                raise ValueError("a chunk ends behind its shard")
            self._fill(plain, place, data[start : start + size])

    def _region(self, place: tuple[int, ...]) -> tuple[Any, ...]:
        # With … it is a view also of an array without axes.
        return ..., *(slice(i * step, (i + 1) * step) for i, step in zip(place, self._chunk, strict=True))

    def _fill(self, plain: np.ndarray, place: tuple[int, ...], data: bytes) -> None:
        # Zarr fills a chunk at the edge up to the shape of the others.
        part = plain[self._region(place)]
        if part.shape == self._chunk and part.flags.c_contiguous:
            self._decompress(data, flat_bytes(part))
            return
        chunk = np.empty(self._chunk, plain.dtype)
        self._decompress(data, flat_bytes(chunk))
        part[...] = chunk[tuple(map(slice, part.shape))]

    def _decompress(self, data: bytes, target: np.ndarray) -> None:
        if self._codec == "blosc":
            decompress_blosc(data, target)
        elif self._codec == "zstd":
            decompress_zstd(data, target)
        elif len(data) == target.size:
            target[:] = np.frombuffer(data, np.uint8)
        else:
            raise ValueError(f"a chunk of {target.size} bytes has {len(data)}")


def file_digests(folder: Path, content: ArrayContent) -> list[str]:
    """Return the sha256 of each file of an array that was just written, in hexadecimal."""
    paths = (folder.joinpath("c", *map(str, place)) for place in content.places(content.chunk))
    return [hashlib.sha256(path.read_bytes()).hexdigest() for path in paths]


def _description(content: ArrayContent) -> dict[str, Any]:
    """Return what zarr.json has for an array, but for its chunks and codecs."""
    return {
        "shape": list(content.plain_shape),
        "data_type": content.plain.name,
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": 0,
        "attributes": {"dtype": content.dtype.str},
        "zarr_format": 3,
        "node_type": "array",
    }


def _layout(
    known: Mapping[str, Any], content: ArrayContent
) -> tuple[str | None, tuple[int, ...] | None, tuple[int, ...]]:
    """Return an array's codec, the shape of its shard where it has one, and that of its chunks.

    Raises ValueError for any that our own writers do not make.
    """
    codecs = known.get("codecs")
    plain: dict[str, Any] = {"name": "bytes"}
    if content.plain.itemsize > 1:
        plain["configuration"] = {"endian": "little"}
    if content.files is None and isinstance(codecs, list) and _named(codecs, "sharding_indexed"):
        return _sharded(known, codecs[0].get("configuration"), plain, content)
    if known.get("chunk_grid") == _grid(content.chunk) and isinstance(codecs, list) and codecs[:1] == [plain]:
        if content.files is None and codecs[1:] == [_blosc(codecs[1:], content)]:
            return "blosc", None, content.chunk
        if content.files is not None and codecs[1:] in ([], [_zstd(codecs[1:])]):
            return "zstd" if codecs[1:] else None, None, content.chunk
    raise ValueError("its zarr.json has other chunks or codecs than are written")


def _sharded(
    known: Mapping[str, Any], configuration: object, plain: dict[str, Any], content: ArrayContent
) -> tuple[str, tuple[int, ...], tuple[int, ...]]:
    """Return the layout of an array that a release up to 0.2 kept in one file, a chunk for some rows each."""
    if isinstance(configuration, dict) and content.plain_shape:
        rows = (configuration.get("chunk_shape") or [None])[0]
        inner = configuration.get("codecs")
        rest = tuple(max(1, length) for length in content.plain_shape[1:])
        if type(rows) is int and rows > 0 and isinstance(inner, list):
            chunk = (rows, *rest)
            shard = (rows * max(1, -(-content.plain_shape[0] // rows)), *rest)
            expected = {
                "chunk_shape": list(chunk),
                "codecs": [plain, _blosc(inner[1:], content)],
                "index_codecs": [{"name": "bytes", "configuration": {"endian": "little"}}, {"name": "crc32c"}],
                "index_location": "end",
            }
            if known.get("chunk_grid") == _grid(shard) and configuration == expected:
                return "blosc", shard, chunk
    raise ValueError("its zarr.json has another shard than was written")


def _grid(chunk: tuple[int, ...]) -> dict[str, Any]:
    return {"name": "regular", "configuration": {"chunk_shape": list(chunk)}}


def _named(codecs: list[Any], name: str) -> bool:
    return len(codecs) == 1 and isinstance(codecs[0], dict) and codecs[0].get("name") == name


def _level(codecs: list[Any], name: str) -> int:
    """Return the level that the only codec has, which tells nothing of how it is read, or 0."""
    configuration = codecs[0].get("configuration") if len(codecs) == 1 and isinstance(codecs[0], dict) else None
    level = configuration.get(name) if isinstance(configuration, dict) else None
    return level if type(level) is int else 0


def _blosc(codecs: list[Any], content: ArrayContent) -> dict[str, Any]:
    configuration = {"typesize": content.plain.itemsize, "cname": "zstd", "shuffle": "shuffle", "blocksize": 0}
    return {"name": "blosc", "configuration": configuration | {"clevel": _level(codecs, "clevel")}}


def _zstd(codecs: list[Any]) -> dict[str, Any]:
    return {"name": "zstd", "configuration": {"level": _level(codecs, "level"), "checksum": False}}
