"""An array of a checkpoint: its description, and how zarr has it on disk, in chunks that are read and verified.

zarr writes them and anybody may read them with it. Here they are read without it. A description from elsewhere is
accepted only if our own writers would have made the same for the array, and of a file no more is read than its chunk
needs.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from scroll_tactile_store.compression import decompress_zstd
from scroll_tactile_store.encoding import flat_bytes, kept_dtype, require_name, require_shape, require_values
from scroll_tactile_store.exceptions import DamageError
from scroll_tactile_store.records import from_json

__all__ = [
    "GROUP_VERSION",
    "LARGEST_DESCRIPTION",
    "ArrayContent",
    "ArrayFiles",
    "file_digests",
    "most_bytes",
    "read_content",
]

GROUP_VERSION = 2

# Pieces of a large array: small enough to be compressed in cache-sized steps and verified before they are
# decompressed, large enough that a hundred megabytes are some tens of files to make durable.
CHUNK_BYTES = 4 * 2**20

SHA256 = re.compile(r"[0-9a-f]{64}")

LARGEST_DESCRIPTION = 2**16  # bytes of an array's zarr.json, which has a few hundred

# Of small files that stand for gigabytes nobody is to make room for these. `write_group` keeps to it.
SPARE, RATIO = 192 * 2**20, 16

TURNED_AT_ONCE = 2**13  # elements of a plane: they stay in the processor's cache
CHUNK_MORE = 64  # bytes: the header of its frame, and what is no smaller compressed


def most_bytes(sizes: Iterable[int]) -> int:
    """Return how many bytes of arrays files of these sizes may stand for."""
    return SPARE + RATIO * sum(sizes)


@dataclass(frozen=True)
class ArrayContent:
    """An array of a checkpoint: of the elements and of each of its files the sha256, in hexadecimal."""

    dtype: np.dtype
    shape: tuple[int, ...]
    sha256: str
    files: tuple[str, ...] = ()

    @property
    def in_planes(self) -> bool:
        """Whether it is stored byte by byte, all lowest ones first: wide integers take a tenth less so."""
        return self.dtype.kind in "iu" and self.dtype.itemsize >= 4

    @property
    def plain(self) -> np.dtype:
        """The dtype in zarr, which has no settled type for fixed-width text and warns of it: code points have one."""
        return np.dtype("|u1") if self.in_planes else np.dtype("<u4") if self.dtype.kind == "U" else self.dtype

    @property
    def plain_shape(self) -> tuple[int, ...]:
        """The shape in zarr: text has a last axis of code points, integers in planes a first axis of bytes."""
        if self.in_planes:
            return (self.dtype.itemsize, *self.shape)
        return (*self.shape, self.dtype.itemsize // 4) if self.dtype.kind == "U" else self.shape

    def to_plain(self, array: np.ndarray) -> np.ndarray:
        """Return the array as it is in zarr."""
        if self.in_planes:
            return flat_bytes(array).reshape(-1, self.dtype.itemsize).T.reshape(self.plain_shape)
        return flat_bytes(array).view(self.plain).reshape(self.plain_shape)

    def from_plain(self, plain: np.ndarray) -> np.ndarray:
        """Return the array that was `plain` in zarr, of its shape and dtype; it may share its memory."""
        if self.in_planes:
            planes = plain.reshape(self.dtype.itemsize, -1)
            rows = np.empty(planes.shape[::-1], np.uint8)
            for first in range(0, len(rows), TURNED_AT_ONCE):  # part by part it takes a fifth of the time
                turned = slice(first, first + TURNED_AT_ONCE)
                for i, plane in enumerate(planes):
                    rows[turned, i] = plane[turned]
            return rows.view(self.dtype).reshape(self.shape)
        return plain.view(self.dtype).reshape(self.shape)

    @property
    def size(self) -> int:
        """The bytes of the elements."""
        return prod(self.shape) * self.dtype.itemsize

    @property
    def chunk(self) -> tuple[int, ...]:
        """The shape of a chunk, of about 4 MiB, along the first axes."""
        lengths, piece = [], self.size
        for length in self.plain_shape:
            slab = piece // max(length, 1)
            lengths.append(max(1, length if piece <= CHUNK_BYTES else CHUNK_BYTES // max(slab, 1)))
            piece = slab * lengths[-1]
        return tuple(lengths)

    def places(self, chunk: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
        """Yield where each chunk of this shape is in the grid of chunks; the last axis changes first."""
        grid = self.grid(chunk)
        strides = [prod(grid[axis + 1 :]) for axis in range(len(grid))]
        for i in range(prod(grid)):
            yield tuple(i // stride % count for stride, count in zip(strides, grid, strict=True))

    def grid(self, chunk: tuple[int, ...]) -> list[int]:
        """Return the number of chunks of this shape along each axis."""
        return [-(-length // step) for length, step in zip(self.plain_shape, chunk, strict=True)]


def read_content(content: Mapping[str, Any]) -> dict[str, ArrayContent]:
    """Return what a checkpoint says of its arrays, by name; nothing where it is of another format.

    Raises ValueError where it says it in another way than `write_group` has it.
    """
    version, arrays = content.get("format"), content.get("arrays")
    if type(version) is not int or version < 1:
        raise ValueError(f"the format of a checkpoint is {version!r}, not a number")
    if version != GROUP_VERSION:
        return {}
    if not isinstance(arrays, dict):
        raise ValueError("a checkpoint does not say what its arrays are")
    if len({str(name).casefold() for name in arrays}) < len(arrays):
        raise ValueError("two arrays of a checkpoint have one name")
    return {require_name(name): _read_array(name, described) for name, described in arrays.items()}


def _read_array(name: str, described: object) -> ArrayContent:
    if not isinstance(described, dict):
        raise ValueError(f"of array {name!r} {str(described)[:80]} is said")
    dtype = kept_dtype(described.get("dtype"))
    shape, sha256 = require_shape(described.get("shape"), dtype), _sha256(described.get("sha256"))
    files = described.get("files")
    if not isinstance(files, list):
        raise ValueError(f"array {name!r} does not say what its files are")
    content = ArrayContent(dtype, shape, sha256, tuple(map(_sha256, files)))
    if prod(content.grid(content.chunk)) != len(files):
        raise ValueError(f"array {name!r} of shape {shape} has {len(files)} files")
    return content


def _sha256(text: object) -> str:
    if not isinstance(text, str) or not SHA256.fullmatch(text):
        raise ValueError(f"{str(text)[:80]!r} is no sha256")
    return text


class ArrayFiles:
    """The files of an array in the checkpoint in folder `group`; `content` says what must be in them.

    read: returns the bytes of a file of at most so many.

    Every method raises DamageError, ValueError for what is not as it was written, and OSError.
    """

    def __init__(self, group: Path, name: str, content: ArrayContent, read: Callable[[Path, int], bytes]) -> None:
        self._folder, self._content, self._read = group / name, content, read
        text = read(self._folder / "zarr.json", LARGEST_DESCRIPTION).decode()
        known = from_json(text)
        self._chunk, self._compressed = content.chunk, _is_compressed(known, content)
        expected = _description(content)
        if wrong := sorted(name for name, value in expected.items() if known.get(name) != value):
            raise ValueError(f"its zarr.json has another {' and '.join(wrong)} than was written")

    def read(self) -> np.ndarray:
        """Return the array, each file verified before it is decompressed; its own sha256 is the caller's to verify."""
        content = self._content
        plain = np.empty(content.plain_shape, content.plain)
        for place, _, data in self.verified():
            self._fill(plain, place, data)
        array = content.from_plain(plain)
        require_values(array)
        return array

    def verified(self) -> Iterator[tuple[tuple[int, ...], Path, bytes]]:
        """Yield the place of each chunk, its file, and the bytes of that, which are those that were written."""
        most = prod(self._chunk) * self._content.plain.itemsize
        most += most // 64 + 1024 + CHUNK_MORE
        for i, place in enumerate(self._content.places(self._chunk)):
            path = self._folder.joinpath("c", *map(str, place))
            data = self._read(path, most)
            if hashlib.sha256(data).hexdigest() != self._content.files[i]:
                raise DamageError(f"{path} is not what was written: its sha256 differs", path=path)
            yield place, path, data

    def _fill(self, plain: np.ndarray, place: tuple[int, ...], data: bytes) -> None:
        pieces = (slice(i * step, (i + 1) * step) for i, step in zip(place, self._chunk, strict=True))
        region: tuple[Any, ...] = ..., *pieces  # with … it is a view also of an array without axes
        part = plain[region]
        # Zarr fills a chunk at the edge up to the shape of the others.
        if part.shape == self._chunk and part.flags.c_contiguous:
            self._decompress(data, flat_bytes(part))
            return
        chunk = np.empty(self._chunk, plain.dtype)
        self._decompress(data, flat_bytes(chunk))
        part[...] = chunk[tuple(map(slice, part.shape))]

    def _decompress(self, data: bytes, target: np.ndarray) -> None:
        if self._compressed:
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


def _is_compressed(known: Mapping[str, Any], content: ArrayContent) -> bool:
    """Return whether an array's chunks are compressed; raise ValueError for codecs or chunks that are not written."""
    codecs = known.get("codecs")
    plain: dict[str, Any] = {"name": "bytes"}
    if content.plain.itemsize > 1:
        plain["configuration"] = {"endian": "little"}
    grid = {"name": "regular", "configuration": {"chunk_shape": list(content.chunk)}}
    if known.get("chunk_grid") == grid and isinstance(codecs, list) and codecs[:1] == [plain]:
        if not codecs[1:]:
            return False
        if codecs[1:] == [_zstd(codecs[1])]:
            return True
    raise ValueError("its zarr.json has other chunks or codecs than are written")


def _zstd(codec: Any) -> dict[str, Any]:
    """Return the codec as it is written, with its level, which tells nothing of how it is read."""
    configuration = codec.get("configuration") if isinstance(codec, dict) else None
    level = configuration.get("level") if isinstance(configuration, dict) else None
    return {"name": "zstd", "configuration": {"level": level if type(level) is int else 0, "checksum": False}}
