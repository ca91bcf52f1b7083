"""Arrays on disk as sources: `.npy`, robomimic's HDF5, Zarr replay buffers."""

from __future__ import annotations

import itertools
import math
import os
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from scroll_tactile.errors import FieldError, RecordingError
from scroll_tactile.libraries import missing
from scroll_tactile.recordings.blocks import Block, Contents, Entry, Source, floats, rows_of
from scroll_tactile.recordings.bounds import LARGEST, SPARE, Budget, stored_bytes
from scroll_tactile.recordings.paths import CLOCK_KEYS, matched, select
from scroll_tactile.recordings.zarrfile import open_zarr

__all__ = ["Hdf5", "Npy", "ZarrBuffer"]

_FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32", 32000: "lzf"}  # of HDF5, by their numbers
_DEFLATES = 1032  # times as many bytes at most
_DEEPEST = 32  # groups of HDF5 within each other
_VISIT = 20  # steps of work that it takes to look at one object
_EPISODES = 1 << 16  # may be empty
_NPY_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class _Arrays(Source):
    """What the three have in common."""

    def _listed(self, arrays: dict[str, list[Any]]) -> Contents:
        """The arrays that hold numbers in rows, touch first; the parts of one are its episodes."""
        entries = [
            Entry(None, key, tuple(parts[0].shape[1:]), sum(part.shape[0] for part in parts), None, str(parts[0].dtype))
            for key, parts in arrays.items()
            if parts[0].shape and parts[0].dtype.kind in "biuf" and key.rpartition("/")[2] not in CLOCK_KEYS
        ]
        entries.sort(key=lambda entry: "tact" not in entry.field.lower())
        return Contents(self.address, tuple(entries))

    def _chosen(self, arrays: dict[str, list[Any]]) -> tuple[str, str, str | None]:
        """The array, the index behind it, and the array of its times, if there is one."""
        if self.request.field is None:
            contents = self._listed(arrays)
            if len(contents.entries) != 1:
                raise contents.refused("expected a field to read")
            key, rest = contents.entries[0].field, ""
        else:
            key, rest = matched(self.request.field, arrays, self.address)
        beside = key.rpartition("/")[0]
        if self.request.clock is not None:
            return key, rest, matched(self.request.clock, arrays, self.address)[0]
        names = [f"{beside}/{name}" if beside else name for name in CLOCK_KEYS]
        return key, rest, next((name for name in names if name in arrays and name != key), None)

    def _slices(self, array: Any, times: Any, key: str, rest: str, number: int | None) -> Iterator[Block]:
        """Blocks of one array, all of one episode where it has a number."""
        if not array.shape or array.dtype.kind not in "biuf":
            raise FieldError(
                f"field {key!r} of {self.address} is {array.dtype} of shape {array.shape}; expected numbers"
            )
        width = math.prod(array.shape[1:]) * array.dtype.itemsize
        high = (getattr(array, "chunks", None) or (1,))[0]
        if width * high > LARGEST or (not width and array.shape[0]):
            raise RecordingError(
                f"{self.address} claims readings of {width} bytes in {key!r}, {high} at once, and may be damaged"
            )
        if times is not None and (times.shape != array.shape[:1] or times.dtype.kind not in "iuf"):
            raise RecordingError(
                f"{self.address}: the times are {times.dtype} of shape {times.shape}, and {key!r} has "
                f"{array.shape[0]} readings"
            )
        rows = rows_of(width)
        step = max(rows // high, 1) * high  # chunks are decompressed whole, and once
        for first in range(0, array.shape[0], step):
            slab = self._rows(array, first, min(first + step, array.shape[0]))
            for i in range(first, first + len(slab), rows):
                part = floats(slab[i - first : i - first + rows])
                own = {} if times is None else {"times": self._rows(times, i, i + len(part)).astype(np.float64)}
                episodes = None if number is None else np.full(len(part), number, np.int64)
                yield Block(select(part, rest, key), own, {}, episodes)

    def _rows(self, array: Any, begin: int, end: int) -> Any:
        """These rows of an array; raises RecordingError where a recording of this size cannot hold them."""
        self._charge(array, begin, end)
        return array[begin:end]

    def _charge(self, array: Any, begin: int, end: int) -> None:
        self.budget.take((end - begin) * math.prod(array.shape[1:]) * array.dtype.itemsize)


class Npy(_Arrays):
    """One array in a `.npy`, shape (T, …): a row is a reading."""

    def contents(self) -> Contents:
        """The one array."""
        return self._listed({"": [self._array()]})

    def blocks(self) -> Iterator[Block]:
        """Its rows."""
        if self.request.field and not self.request.field.startswith("["):
            raise FieldError(f"{self.address} holds one array without a name; came field {self.request.field!r}")
        if self.request.clock is not None:
            raise FieldError(
                f"{self.address} holds no clock; came {self.request.clock!r}: give rate= in its place",
                argument="clock rate",
            )
        yield from self._slices(self._array(), None, "", self.field(), None)

    def _array(self) -> _NpyArray:
        self.budget = Budget(self.address, stored_bytes(self.path))
        return _NpyArray(self.path, self.address)


class _NpyArray:
    """The array of a `.npy`, of which rows are read by a slice.

    It is not mapped: a file that another program cuts off meanwhile would end this one, and holes would take memory
    where the disk is memory.
    """

    def __init__(self, path: Path, address: str) -> None:
        self._path, self._address = path, address
        with path.open("rb") as file:
            if file.read(4) == b"PK\x03\x04":
                raise RecordingError(f"expected one array in {address}; it is an archive of several, an .npz")
            file.seek(0)
            version = np.lib.format.read_magic(file)
            if version not in _NPY_HEADERS:
                raise RecordingError(f"{address} is a .npy of version {version}; expected numbers, version 1 or 2")
            self.shape, self._columns_first, self.dtype = _NPY_HEADERS[version](file)
            self._begin, size = file.tell(), os.fstat(file.fileno()).st_size
        if self.dtype.hasobject:
            raise RecordingError(f"{address} holds Python objects, which are not read; expected numbers")
        if min(self.shape, default=0) < 0 or size < self._begin + math.prod(self.shape) * self.dtype.itemsize:
            raise RecordingError(f"{address} ends before the array of {self.dtype} {self.shape} that it announces")

    def __getitem__(self, rows: slice) -> Any:
        """These rows, shape (rows, …); raises RecordingError where the file has been cut off."""
        begin, end, _ = rows.indices(self.shape[0])
        rest = self.shape[1:]
        with self._path.open("rb") as file:
            if not self._columns_first:
                return self._read(file, begin * math.prod(rest), (end - begin) * math.prod(rest)).reshape(
                    end - begin, *rest
                )
            parts = [self._read(file, i * self.shape[0] + begin, end - begin) for i in range(math.prod(rest))]
        return np.stack(parts, axis=-1).reshape(end - begin, *rest, order="F")

    def _read(self, file: Any, first: int, count: int) -> Any:
        read = np.fromfile(file, self.dtype, count, offset=self._begin + first * self.dtype.itemsize - file.tell())
        if len(read) < count:
            raise RecordingError(f"{self._address} was cut off while it was read")
        return read


class Hdf5(_Arrays):
    """HDF5 as robomimic writes it, `data/demo_N/obs/KEY`, an episode in each demo; other data sets by their path."""

    def contents(self) -> Contents:
        """The data sets, those of all demos as one."""
        with self._open() as file:
            return self._listed({key: list(parts.values()) for key, parts in self._arrays(file).items()})

    def blocks(self) -> Iterator[Block]:
        """The readings of one data set, demo after demo."""
        with self._open() as file:
            arrays = self._arrays(file)
            key, rest, clock = self._chosen({key: list(parts.values()) for key, parts in arrays.items()})
            shapes = {part.shape[1:] for part in arrays[key].values()}
            if len(shapes) > 1:
                raise RecordingError(f"{self.address}: {key!r} is ragged: its demos have readings of {sorted(shapes)}")
            for number, part in arrays[key].items():
                times = None if clock is None else arrays[clock].get(number)
                for item in [part] if times is None else [part, times]:
                    self._require_own(item)
                yield from self._slices(part, times, key, rest, number if number >= 0 else None)

    def _charge(self, array: Any, begin: int, end: int) -> None:
        super()._charge(array, begin, end)
        if array.compression != "gzip":
            return
        # HDF5 takes all that deflate makes of a chunk, also where it is longer than a chunk. Only large ones can become
        # so large that it matters, and these are decompressed here first.
        size = math.prod(array.chunks) * array.dtype.itemsize
        along = [range(begin, end, array.chunks[0])]
        along += [range(0, whole, step) for whole, step in zip(array.shape[1:], array.chunks[1:], strict=True)]
        for corner in itertools.product(*along):
            self.budget.work()
            about = array.id.get_chunk_info_by_coord(corner)
            if about.size is None or about.size * _DEFLATES < SPARE:
                continue
            if about.size > self.budget.stored:
                raise RecordingError(f"{self.address} claims a chunk of {about.size} bytes, and may be damaged")
            _, data = array.id.read_direct_chunk(corner)
            inflating, length = zlib.decompressobj(), 0
            while data and length <= size:
                length += len(inflating.decompress(data, 1 << 20))
                data = inflating.unconsumed_tail
            if length > size:
                raise RecordingError(f"{self.address} has a chunk of more than the {size} bytes that are its own")

    def _open(self) -> Any:
        try:
            import h5py
        except ImportError as error:
            raise missing("h5py", "hdf5", "an HDF5 file", cause=error) from error
        self.budget = Budget(self.address, stored_bytes(self.path))
        return h5py.File(self.path, "r")

    def _arrays(self, file: Any) -> dict[str, dict[int, Any]]:
        """The data sets by key, and of each the parts by demo; −1 where it is in none."""
        import h5py

        found: dict[str, dict[int, Any]] = {}

        def visit(name: str, item: Any) -> None:
            self.budget.work(_VISIT)
            if name.count("/") > _DEEPEST:
                raise RecordingError(f"{self.address} has more than {_DEEPEST} groups within each other")
            if isinstance(item, h5py.Dataset) and item.shape is not None:
                match = re.fullmatch(r"data/demo_(\d{1,9})/(.+)", name)
                key, number = (match.group(2), int(match.group(1))) if match else (name, -1)
                found.setdefault(key, {})[number] = item

        file.visititems(visit)  # which follows neither soft nor external links
        return {key: dict(sorted(parts.items())) for key, parts in found.items()}

    def _require_own(self, item: Any) -> None:
        """Raises RecordingError for numbers that lie in other files, or in what only a plugin decodes."""
        import h5py

        about = item.id.get_create_plist()
        virtual = about.get_layout() == h5py.h5d.VIRTUAL
        if virtual or about.get_external_count():
            where = "other data sets (it is virtual)" if virtual else "other files (external storage)"
            raise RecordingError(
                f"{self.address}: the numbers of {item.name!r} lie in {where}, which may be any on this machine. Copy "
                "it with h5repack, which puts them in"
            )
        numbers = [about.get_filter(i)[0] for i in range(about.get_nfilters())]
        if not set(numbers) <= set(_FILTERS) or len(set(numbers)) < len(numbers):
            raise RecordingError(
                f"{self.address}: {item.name!r} has the filters {[_FILTERS.get(n, n) for n in numbers]}; expected at "
                f"most one each of {', '.join(_FILTERS.values())}: copy it with h5repack"
            )


class ZarrBuffer(_Arrays):
    """A Zarr replay buffer, `data/KEY` (N, …) with `meta/episode_ends`; any other group of arrays likewise."""

    def contents(self) -> Contents:
        """The arrays, those in `meta` left out."""
        arrays, _ = open_zarr(self.path, Budget(self.address))
        return self._listed({key: [array] for key, array in arrays.items()})

    def blocks(self) -> Iterator[Block]:
        """The readings of one array, episode after episode."""
        self.budget = Budget(self.address)
        arrays, episode_ends = open_zarr(self.path, self.budget)
        key, rest, clock = self._chosen({key: [array] for key, array in arrays.items()})
        for name in (key, clock):
            if name is not None and (why := arrays[name].why):
                raise RecordingError(f"{self.address}: {name!r} cannot be read: {why}")
        array = arrays[key]
        ends = None if episode_ends is None else self._ends(episode_ends, array.shape[0] if array.shape else 0)
        done = 0
        for block in self._slices(array, arrays[clock] if clock is not None else None, key, rest, None):
            if ends is not None:
                index = np.arange(done, done + len(block.readings))
                block.episodes = np.searchsorted(ends, index, side="right").astype(np.int64)
            done += len(block.readings)
            yield block

    def _charge(self, array: Any, begin: int, end: int) -> None:
        pass  # it charges for its chunks as it reads them

    def _ends(self, array: Any, count: int) -> Any:
        if array.why or len(array.shape) != 1 or array.dtype.kind not in "iu" or array.shape[0] > count + _EPISODES:
            why = array.why or f"they are {array.dtype} of shape {array.shape}, of {count} readings"
            raise RecordingError(f"{self.address}: meta/episode_ends cannot be read: {why}")
        ends = array[:].astype(np.int64)
        if (np.diff(ends, prepend=0) < 0).any() or (len(ends) and ends[-1] > count):
            raise RecordingError(
                f"{self.address}: meta/episode_ends does not rise to at most {count}, the readings' count"
            )
        return ends
