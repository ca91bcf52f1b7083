"""An array of a checkpoint as zarr has it on disk: its description, and its chunks, read and verified.

zarr writes them and anybody may read them with it. Here they are read without it: of a description that somebody else
made, only one that our own writers would have made for the array counts, and of a file not more than its chunk needs.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from store.content import ArrayContent
from store.encoding import flat_bytes, require_values
from store.exceptions import DamageError
from store.frames import decompress_zstd
from store.records import from_json

__all__ = ["LARGEST_DESCRIPTION", "ArrayFiles", "file_digests", "most_bytes"]

LARGEST_DESCRIPTION = 2**16  # bytes of an array's zarr.json, which has a few hundred

# Of small files that stand for gigabytes nobody is to make room for these. `write_group` keeps to it.
SPARE, RATIO = 192 * 2**20, 16

CHUNK_MORE = 64  # bytes: the header of its frame, and what is no smaller compressed


def most_bytes(sizes: Iterable[int]) -> int:
    """Return how many bytes of arrays files of these sizes may stand for."""
    return SPARE + RATIO * sum(sizes)


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

    def _files(self) -> Iterator[tuple[tuple[int, ...], Path]]:
        for place in self._content.places(self._chunk):
            yield place, self._folder.joinpath("c", *map(str, place))

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
        for i, (place, path) in enumerate(self._files()):
            data = self._read(path, most)
            if hashlib.sha256(data).hexdigest() != self._content.files[i]:
                raise DamageError(f"{path} is not what was written: its sha256 differs", path=path)
            yield place, path, data

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
