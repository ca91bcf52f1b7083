"""What is said of a checkpoint's arrays and how they lie in chunks."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np

from store.encoding import flat_bytes, kept_dtype, require_name, require_shape

__all__ = ["GROUP_VERSION", "ArrayContent", "read_content"]

GROUP_VERSION = 1

# Pieces of a large array: small enough to be compressed in cache-sized steps and verified before they are
# decompressed, large enough that a hundred megabytes are some tens of files to make durable.
CHUNK_BYTES = 4 * 2**20

SHA256 = re.compile(r"[0-9a-f]{64}")


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
            rows = np.ascontiguousarray(plain.reshape(self.dtype.itemsize, -1).T)
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
    """Return what a checkpoint says of its arrays, by name; nothing where its format is newer.

    Raises ValueError where it says it in another way than `write_group` has it.
    """
    version, arrays = content.get("format"), content.get("arrays")
    if type(version) is not int or version < 1:
        raise ValueError(f"the format of a checkpoint is {version!r}, not a number")
    if version > GROUP_VERSION:
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
