"""Arrays in a Zarr group, of format 2 or 3, as a folder or a zip, such as a replay buffer.

Zarr's own reader takes whatever data type and codec a file names, pickles among them, and follows links. So each
description is looked at before zarr is asked for numbers in codecs of a short list, and no chunk becomes more than its
shape says.
"""

from __future__ import annotations

import json
import math
import os
import re
import stat
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from scroll_tactile.errors import RecordingError
from scroll_tactile.recordings.arraystores import ArraySource
from scroll_tactile.recordings.bounds import on_disk, require_bounded, require_file, require_inflated, stored_bytes

__all__ = ["ZarrBuffer", "is_zarr"]

_DESCRIPTIONS = ("zarr.json", ".zarray", ".zgroup")
_NUMBERS = re.compile(r"[<>|](?:b1|[iu][1248]|f[248])|bool|u?int(?:8|16|32|64)|float(?:16|32|64)")
_CODECS = {"bytes", "transpose", "crc32c", "blosc", "gzip", "lz4", "zlib", "zstd", "shuffle", "delta"}
_DESCRIPTION = 1 << 24  # bytes of a description, that of a group with all others in it
_POINTER = 200  # bytes: files of fewer may be pointers of Git LFS


def is_zarr(path: Path) -> bool:
    """Whether this is a Zarr group, as a folder or a zip of one."""
    there = (path / name for name in _DESCRIPTIONS)
    return any(file.exists() for file in there) if path.is_dir() else path.name.lower().endswith(".zarr.zip")


class ZarrBuffer(ArraySource):
    """A Zarr replay buffer, `data/KEY` (N, …) with `meta/episode_ends`; any other group of arrays likewise."""

    @contextmanager
    def opened(self) -> Iterator[dict[str, Any]]:
        """The arrays by their path in the group, those of numbers; one array alone is "data"."""
        import zarr
        from zarr.core.sync import sync
        from zarr.storage import LocalStore, ZipStore

        folder, arrays = self.path.is_dir(), {}
        with ExitStack() as stack:
            if folder:
                sizes = _sizes(self.path)
                self.stored = sum(sizes.values())
            else:
                file = stack.enter_context(zipfile.ZipFile(self.path))
                sizes = {info.filename: info.file_size for info in file.infolist()}
                self.stored = stored_bytes(self.path)
                require_bounded(sum(sizes.values()), self.stored, self.address)
            kind: Any = LocalStore if folder else ZipStore
            store = stack.enter_context(sync(kind.open(self.path, read_only=True)))
            for name in sorted(sizes):
                key, _, last = name.rpartition("/")
                if last not in _DESCRIPTIONS[:2]:
                    continue
                try:
                    codecs = _codecs(json.loads((self.path / name).read_bytes() if folder else file.read(name)))
                except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
                    self.unread.append(f"{key or 'the array'}: {error!s:.200}")
                    continue
                if codecs is not None:
                    how: dict[str, Any] = {"path": key, "mode": "r", "zarr_format": 3 if last == "zarr.json" else 2}
                    checked = _checked(store, sizes, codecs, self.address)
                    array = arrays[key or "data"] = zarr.open_array(checked, **how)
                    checked.chunk = math.prod(array.chunks) * array.dtype.itemsize
            yield arrays


def _codecs(about: dict[str, Any]) -> list[str] | None:
    """The codecs of an array, by its description; None for a group. Raises ValueError for what zarr is not to read."""
    if about.get("node_type") == "group":
        return None
    new = about["zarr_format"] == 3
    codecs = about["codecs"] if new else [about["compressor"], *(about.get("filters") or ())]
    names = [codec["name" if new else "id"] for codec in codecs if codec]
    kind = about["data_type" if new else "dtype"]
    if not isinstance(kind, str) or not _NUMBERS.fullmatch(kind):
        raise ValueError(f"its data type is {str(kind)[:40]!r}; expected numbers")
    if not set(names) <= _CODECS or about.get("storage_transformers"):
        raise ValueError(f"it has the codecs {names!s:.200}; expected some of {', '.join(sorted(_CODECS))}")
    return names


def _sizes(folder: Path) -> dict[str, int]:
    """The bytes of each file in a folder, by its path there; raises RecordingError for a link, FIFO or device."""
    found = {}
    for place, folders, files in os.walk(folder):
        for path in (Path(place, name) for name in (*folders, *files)):
            about = path.lstat()
            if not (stat.S_ISREG(about.st_mode) or stat.S_ISDIR(about.st_mode)):
                raise RecordingError(f"{path} is a link, a FIFO or a device; a Zarr group is made of files and folders")
            if stat.S_ISREG(about.st_mode):
                found[path.relative_to(folder).as_posix()] = on_disk(about)
                if about.st_size < _POINTER:
                    require_file(path)
    return found


def _checked(store: Any, sizes: dict[str, int], codecs: list[str], address: str) -> Any:
    """The store, of which no chunk becomes more bytes than its `chunk` says, which an array's description tells."""
    from zarr.storage import WrapperStore

    class Checked(WrapperStore[Any]):
        chunk = 0

        async def get(self, key: str, prototype: Any, byte_range: Any = None) -> Any:
            if sizes.get(key, 0) > 2 * self.chunk + _DESCRIPTION:
                what = f"{key} of {address} has {sizes[key]} bytes for a chunk of {self.chunk}"
                raise RecordingError(f"{what}: is it whole?")
            found = await store.get(key, prototype, byte_range)
            if found is not None and not key.endswith((".zarray", ".zattrs", "zarr.json")):
                _require_chunk(found.to_bytes(), codecs, self.chunk, f"chunk {key} of {address}")
            return found

    return Checked(store)


def _require_chunk(data: bytes, codecs: list[str], size: int, what: str) -> None:
    """Raises RecordingError where a chunk becomes more bytes than its array's shape has."""
    claimed = size
    if "blosc" in codecs or "lz4" in codecs:
        claimed = int.from_bytes(data[4:8] if "blosc" in codecs else data[:4], "little")
    elif "zstd" in codecs:
        from scroll_tactile_store.encoding import declared_size

        try:
            claimed = declared_size(data)
        except ValueError:  # a frame that was streamed does not say its size
            from numcodecs import zstd

            zstd.decompress(data, np.empty(size, np.uint8))
    elif "gzip" in codecs or "zlib" in codecs:
        require_inflated(data, size, what)
    if claimed > size:
        raise RecordingError(f"{what} claims {claimed} bytes, where {size} can be: is it whole?")
