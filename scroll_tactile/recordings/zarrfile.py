"""Arrays in a Zarr group, of format 2 or 3, as a folder or a zip: read row by row, and nothing but numbers.

Zarr's own reader takes whatever data type and codec a file names, text pickled into filters among them, and follows
links. Here an array is read where its description is one of numbers, in codecs of a short list, and each chunk has to
become exactly the bytes that its shape says.
"""

from __future__ import annotations

import bz2
import itertools
import json
import math
import os
import re
import stat
import struct
import zipfile
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import RecordingError
from scroll_tactile.recordings.bounds import LARGEST, Budget, on_disk, stored_bytes

__all__ = ["ZarrArray", "is_zarr", "open_zarr"]

_DESCRIPTIONS = ("zarr.json", ".zarray", ".zgroup")
_A_CHUNK = 20  # steps of work
_DESCRIPTION = 1 << 24  # bytes of a description at most; that of a group may hold all others' once more
_DEEPEST = 8  # groups within each other
_NUMBERS = re.compile(r"[<>|](?:b1|[iu][1248]|f[248])")
_NAMES = {"bool": "|b1"} | {
    f"{name}{8 * size}": f"<{kind}{size}"
    for kind, name, sizes in (("i", "int", (1, 2, 4, 8)), ("u", "uint", (1, 2, 4, 8)), ("f", "float", (2, 4, 8)))
    for size in sizes
}
_CODECS = ("blosc", "bz2", "gzip", "lz4", "zlib", "zstd")
_BLOSC = {0: "blosclz", 1: "lz4", 2: "snappy", 3: "zlib", 4: "zstd"}
_NO_NUMBERS = np.dtype("V1")
_WORDS = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


def is_zarr(path: Path) -> bool:
    """Whether this is a Zarr group, as a folder or a zip of one."""
    there = (path / name for name in _DESCRIPTIONS)
    return any(file.exists() for file in there) if path.is_dir() else path.name.lower().endswith(".zarr.zip")


@dataclass(frozen=True, eq=False)
class ZarrArray:
    """An array on the disk: `array[begin:end]` reads rows. why: why it cannot be read, where it cannot."""

    key: str
    shape: tuple[int, ...] = ()
    dtype: np.dtype[Any] = _NO_NUMBERS
    chunks: tuple[int, ...] = ()
    layout: _Layout | None = None
    why: str | None = None

    def __getitem__(self, rows: slice) -> npt.NDArray[Any]:
        """These rows, from chunks that are decompressed once each; raises RecordingError for one that is damaged.

        Only of an array that can be read.
        """
        assert self.layout is not None
        begin, end, _ = rows.indices(self.shape[0])
        layout, budget = self.layout, self.layout.files.budget
        found = np.empty((end - begin, *self.shape[1:]), self.dtype)
        last = (end - 1) // self.chunks[0] + 1 if end > begin else begin // self.chunks[0]
        along = [range(begin // self.chunks[0], last)]
        along += [range(-(-size // step)) for size, step in zip(self.shape[1:], self.chunks[1:], strict=True)]
        chunk_bytes = math.prod(self.chunks) * self.dtype.itemsize
        for cell in itertools.product(*along):
            budget.work(_A_CHUNK)
            key = f"{self.key}/{layout.name(cell)}" if self.key else layout.name(cell)
            there = layout.files.find(key)
            spans = [
                slice(max(i * step, low), min((i + 1) * step, high))
                for i, step, low, high in zip(
                    cell, self.chunks, (begin, *(0,) * len(cell)), (end, *self.shape[1:]), strict=False
                )
            ]
            held = math.prod(span.stop - span.start for span in spans) * self.dtype.itemsize
            budget.take(chunk_bytes if there else held)
            target = (slice(spans[0].start - begin, spans[0].stop - begin), *spans[1:])
            if not there:
                found[target] = layout.fill
                continue
            chunk = layout.decoded(key, self.chunks, self.dtype, chunk_bytes)
            inside = tuple(
                slice(span.start - i * step, span.stop - i * step)
                for i, step, span in zip(cell, self.chunks, spans, strict=True)
            )
            found[target] = chunk[inside]
        return found


@dataclass(frozen=True, eq=False)
class _Layout:
    """How an array's chunks are named and written.

    prefix, separator: "c/" and "/" make "c/0/1". order: the axes as they lie in a chunk. codec: what compresses, by its
    name. checksum: whether a crc32c lies behind it.
    """

    files: _Files
    prefix: str
    separator: str
    order: tuple[int, ...]
    codec: str | None
    fill: Any
    checksum: bool = False

    def name(self, cell: Sequence[int]) -> str:
        return self.prefix + self.separator.join(map(str, cell)) if cell else self.prefix.rstrip("/.") or "0"

    def decoded(self, key: str, chunks: tuple[int, ...], dtype: np.dtype[Any], size: int) -> npt.NDArray[Any]:
        data = self.files.read(key, 2 * size + _DESCRIPTION)
        try:
            if self.checksum:
                import google_crc32c  # comes with zarr

                data, sum_of = data[:-4], int.from_bytes(data[-4:], "little")
                if google_crc32c.value(data) != sum_of:
                    raise ValueError("its checksum does not verify")
            raw = _decompressed(self.codec, data, size)
        except (ValueError, RuntimeError, OSError, EOFError, zlib.error) as error:
            raise RecordingError(f"chunk {key} of {self.files.address} is damaged: {error}") from error
        lying = np.frombuffer(raw, dtype).reshape([chunks[i] for i in self.order])
        return lying.transpose(np.argsort(self.order))


def _decompressed(codec: str | None, data: bytes, size: int) -> bytes | npt.NDArray[np.uint8]:
    """A chunk of `size` bytes, never more; raises ValueError where it is not as long, among other errors."""
    if codec in ("blosc", "lz4", "zstd"):
        raw = np.empty(size, np.uint8)
        if codec == "blosc":
            _decompress_blosc(data, raw)
        elif codec == "zstd":
            from numcodecs import zstd

            zstd.decompress(data, raw)  # also where a frame does not say its size, as those that were streamed
        else:
            from numcodecs import lz4

            if data[:4] != size.to_bytes(4, "little"):
                raise ValueError(f"a frame of another size than {size} bytes")
            lz4.decompress(data, raw)
        return raw
    if codec is None:
        whole, ended = data, True
    elif codec == "bz2":
        burrows = bz2.BZ2Decompressor()
        whole = burrows.decompress(data, size)
        ended = burrows.eof or not burrows.decompress(b"", 1)
    else:
        deflate = zlib.decompressobj(31 if codec == "gzip" else 15)
        whole = deflate.decompress(data, size)
        ended = deflate.eof or not deflate.decompress(deflate.unconsumed_tail, 1)
    if len(whole) != size or not ended:
        raise ValueError(f"expected {size} bytes; came {len(whole)}{'' if ended else ' and more'}")
    return whole


def _decompress_blosc(frame: bytes, target: npt.NDArray[np.uint8]) -> None:
    """Fill `target` from a Blosc 1 frame of zstd or LZ4; raises ValueError or RuntimeError for one that is damaged.

    c-blosc keeps within the lengths that the frame's header claims, so these have to be the true ones.
    """
    from numcodecs import blosc

    if len(frame) < 16 or struct.unpack_from("<I4xI", frame, 4) != (target.size, len(frame)):
        raise ValueError(f"a Blosc frame of {len(frame)} bytes claims to be another, or not to hold {target.size}")
    if not frame[2] & 2 and (kind := frame[2] >> 5) not in (1, 4):  # 2: the bytes as they were
        raise ValueError(f"it is written by {_BLOSC.get(kind, kind)} of Blosc; expected lz4 or zstd of Blosc")
    blosc.decompress(frame, target)


def open_zarr(path: Path, budget: Budget) -> tuple[dict[str, ZarrArray], ZarrArray | None]:
    """The arrays of a group by their path in it, those in "meta" left out; and where the episodes end.

    A file that is one array has it under "data". Each description is read here and none of the arrays. What is no array
    of numbers is among them and says why it cannot be read. Raises RecordingError for what is no Zarr group.
    """
    files = _Folder(path, budget) if path.is_dir() else _Zip(path, budget)
    if files.is_array(""):
        return {"data": _described(files, "")}, None
    found: dict[str, ZarrArray] = {}
    for key in _walk(files, "", 0):
        found[key] = _described(files, key)
    ends = found.pop("meta/episode_ends", None)
    return {key: array for key, array in found.items() if not key.startswith("meta/")}, ends


def _walk(files: _Files, before: str, depth: int) -> Iterator[str]:
    for name in files.inside(before.rstrip("/")):
        key = f"{before}{name}"
        files.budget.work()
        if files.is_array(key):
            yield key
        elif depth < _DEEPEST:
            yield from _walk(files, f"{key}/", depth + 1)


def _described(files: _Files, key: str) -> ZarrArray:
    """An array by its description; with the reason where that is not one of numbers in known codecs."""
    try:
        at = f"{key}/" if key else ""
        version = 3 if files.find(f"{at}zarr.json") else 2
        about = json.loads(files.read(f"{at}{'zarr.json' if version == 3 else '.zarray'}", _DESCRIPTION))
        return (_of_version_3 if version == 3 else _of_version_2)(files, key, about)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, IndexError, RecursionError) as error:
        what = error.args[0] if isinstance(error, _UnreadableError) else f"{type(error).__name__}: {error}"
        return ZarrArray(key, why=f"its description is not one of an array of numbers as it can be read: {what:.200}")


class _UnreadableError(ValueError):
    """What a description has that is not read, as a sentence."""


def _of_version_2(files: _Files, key: str, about: Mapping[str, Any]) -> ZarrArray:
    if not isinstance(about["dtype"], str) or not _NUMBERS.fullmatch(about["dtype"]):
        raise _UnreadableError(f"its data type is {str(about['dtype'])[:40]!r}; expected numbers")
    if about.get("filters"):
        raise _UnreadableError(f"it has filters, {_name(about['filters'])}; expected none")
    codec = about["compressor"]
    if codec is not None and (codec := codec["id"]) not in _CODECS:
        raise _UnreadableError(f"it is compressed by {codec!r:.40}; expected one of {', '.join(_CODECS)}")
    separator = about.get("dimension_separator", ".")
    axes = range(len(about["shape"]))
    order = {"C": tuple(axes), "F": tuple(axes)[::-1]}[about["order"]]
    dtype = np.dtype(about["dtype"])
    layout = _Layout(files, "", _separator(separator), order, codec, _fill(about.get("fill_value"), dtype))
    return ZarrArray(key, *_shapes(about["shape"], about["chunks"], dtype), layout)


def _of_version_3(files: _Files, key: str, about: Mapping[str, Any]) -> ZarrArray:
    if about["data_type"] not in _NAMES:
        raise _UnreadableError(f"its data type is {str(about['data_type'])[:40]!r}; expected numbers")
    if about.get("storage_transformers") or about["chunk_grid"]["name"] != "regular":
        raise _UnreadableError("its chunks do not lie in a regular grid")
    dtype, order = np.dtype(_NAMES[about["data_type"]]), tuple(range(len(about["shape"])))
    codec, checksum, written = None, False, False
    for each in about["codecs"]:
        name = _name([each])
        options = each.get("configuration", {}) if isinstance(each, dict) else {}
        if name == "transpose" and not written:
            order = tuple(order[i] for i in options["order"])
        elif name == "bytes" and not written:
            written = True
            dtype = dtype.newbyteorder(">" if options.get("endian", "little") == "big" else "<")
        elif name in ("blosc", "gzip", "zstd") and written and codec is None and not checksum:
            codec = name
        elif name == "crc32c" and written and not checksum:
            checksum = True
        else:
            raise _UnreadableError(
                f"it has the codecs {_name(about['codecs'])}; expected bytes, perhaps behind transpose, then at most "
                "one of blosc, gzip and zstd, and crc32c. Arrays in shards have to be written without"
            )
    if not written:
        raise _UnreadableError("it has no codec that makes bytes of it")
    naming = about["chunk_key_encoding"]
    prefix, default = {"default": ("c", "/"), "v2": ("", ".")}[naming["name"]]
    separator = _separator(naming.get("configuration", {}).get("separator", default))
    layout = _Layout(
        files,
        prefix + (separator if prefix else ""),
        separator,
        order,
        codec,
        _fill(about.get("fill_value"), dtype),
        checksum,
    )
    return ZarrArray(key, *_shapes(about["shape"], about["chunk_grid"]["configuration"]["chunk_shape"], dtype), layout)


def _name(codecs: Any) -> str:
    """What codecs are called, for a sentence."""
    each = [codec.get("name", codec.get("id")) if isinstance(codec, dict) else codec for codec in codecs[:5]]
    return ", ".join(str(name)[:40] for name in each)


def _separator(text: Any) -> str:
    if text not in (".", "/"):
        raise _UnreadableError(f"its chunks are named with {text!r:.20}; expected a dot or a slash")
    return str(text)


def _shapes(shape: Any, chunks: Any, dtype: np.dtype[Any]) -> tuple[tuple[int, ...], np.dtype[Any], tuple[int, ...]]:
    whole = all(type(size) is int and 0 <= size < 2**62 for size in [*shape, *chunks])
    if not whole or len(shape) != len(chunks) or len(shape) > 32 or not all(chunks):
        raise _UnreadableError(f"it has the shape {shape!r:.60} in chunks of {chunks!r:.60}")
    if math.prod(chunks) * dtype.itemsize > LARGEST:
        raise _UnreadableError(f"it claims chunks of {math.prod(chunks) * dtype.itemsize} bytes")
    return tuple(shape), dtype, tuple(chunks)


def _fill(value: Any, dtype: np.dtype[Any]) -> Any:
    """The value of what was never written."""
    if isinstance(value, str) and value.startswith("0x") and len(value) <= 18:
        return np.array(int(value, 16), f"u{dtype.itemsize}").view(dtype.newbyteorder("="))[()]
    number = _WORDS[value] if isinstance(value, str) else value or 0
    if dtype.kind in "iu" and int(number) != number:
        raise _UnreadableError(f"its fill value is {value!r:.40}, and its numbers are {dtype}")
    return np.array(int(number) if dtype.kind in "iu" else number, dtype)[()]


class _Files(ABC):
    """The files of a group, in a folder or a zip: nothing but files and folders, under names that were listed here."""

    def __init__(self, path: Path, budget: Budget) -> None:
        self.path, self.address, self.budget = path, budget.address, budget

    @abstractmethod
    def inside(self, key: str) -> list[str]:
        """The names of the folders in a folder, in order."""

    @abstractmethod
    def find(self, key: str) -> bool:
        """Whether a file is there, whose bytes are then counted; raises RecordingError for a link, FIFO or device."""

    @abstractmethod
    def read(self, key: str, most: int) -> bytes:
        """The bytes of a file that is there; raises RecordingError where there are more than `most`."""

    def is_array(self, key: str) -> bool:
        """Whether a folder is an array."""
        at = f"{key}/" if key else ""
        if not self.find(f"{at}zarr.json"):
            return self.find(f"{at}.zarray")
        about = json.loads(self.read(f"{at}zarr.json", _DESCRIPTION))
        return isinstance(about, dict) and about.get("node_type") == "array"

    def _require_at_most(self, most: int, key: str, size: int) -> None:
        if size > most:
            raise RecordingError(f"{key} of {self.address} has {size} bytes, where at most {most} can be: is it whole?")


class _Folder(_Files):
    def inside(self, key: str) -> list[str]:
        with os.scandir(self.path / key) as entries:
            return sorted(entry.name for entry in entries if entry.is_dir(follow_symlinks=False))

    def find(self, key: str) -> bool:
        folders = itertools.accumulate(key.split("/")[:-1], "{}/{}".format)
        return all(self._is(folder, stat.S_ISDIR) for folder in folders) and self._is(key, stat.S_ISREG)

    def _is(self, key: str, kind: Any) -> bool:
        try:
            about = (self.path / key).lstat()
        except (FileNotFoundError, NotADirectoryError):
            return False
        if not kind(about.st_mode):
            what = "link" if stat.S_ISLNK(about.st_mode) else "FIFO, a device or another kind of entry than expected"
            raise RecordingError(f"{key} of {self.address} is a {what}; a Zarr group is made of files and folders")
        if kind is stat.S_ISREG:
            self.budget.add(on_disk(about))
        return True

    def read(self, key: str, most: int) -> bytes:
        with (self.path / key).open("rb") as file:
            self._require_at_most(most, key, os.fstat(file.fileno()).st_size)
            return file.read(most)


class _Zip(_Files):
    def __init__(self, path: Path, budget: Budget) -> None:
        super().__init__(path, budget)
        budget.add(stored_bytes(path))
        self._zip = zipfile.ZipFile(path)
        self._there = self._zip.NameToInfo
        budget.work(len(self._there))
        self._inside: dict[str, set[str]] = {}
        for name in self._there:
            parts = name.split("/")[: _DEEPEST + 2]
            for i in range(len(parts) - 1):
                self._inside.setdefault("/".join(parts[:i]), set()).add(parts[i])

    def inside(self, key: str) -> list[str]:
        return sorted(self._inside.get(key, ()))

    def find(self, key: str) -> bool:
        return key in self._there

    def read(self, key: str, most: int) -> bytes:
        info = self._there[key]
        self._require_at_most(most, key, info.file_size)
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise RecordingError(f"{key} of {self.address} is compressed in the zip; expected stored or deflated")
        with self._zip.open(info) as file:
            return file.read(most)
