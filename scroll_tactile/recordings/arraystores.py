"""Arrays on disk as sources: `.npy`, robomimic's HDF5, Zarr replay buffers."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from scroll_tactile.errors import FieldError, RecordingError
from scroll_tactile.recordings.blocks import LARGEST, Block, Contents, Entry, Source, floats, missing, rows_of
from scroll_tactile.recordings.keys import CLOCK_KEYS, matched
from scroll_tactile.recordings.paths import select

__all__ = ["Hdf5", "Npy", "ZarrBuffer", "is_zarr"]


def is_zarr(path: Path) -> bool:
    """Whether this is a Zarr group, as a folder or a zip of one."""
    if path.is_dir():
        return any((path / name).exists() for name in (".zgroup", ".zarray", "zarr.json"))
    return path.name.lower().endswith(".zarr.zip")


class _Arrays(Source):
    """What the three have in common."""

    def _listed(self, arrays: dict[str, list[Any]]) -> Contents:
        """The arrays that hold numbers in rows, touch first; the parts of one are its episodes."""
        entries = [
            Entry(None, key, tuple(parts[0].shape[1:]), sum(part.shape[0] for part in parts), None, str(parts[0].dtype))
            for key, parts in arrays.items()
            if parts[0].ndim and parts[0].dtype.kind in "biuf" and key.rpartition("/")[2] not in CLOCK_KEYS
        ]
        entries.sort(key=lambda entry: "tact" not in entry.field.lower())
        return Contents(self.address, tuple(entries))

    def _chosen(self, arrays: dict[str, list[Any]]) -> tuple[str, str, str | None]:
        """The array, the index behind it, and the array of its times, if there is one."""
        if self.request.field is None:
            contents = self._listed(arrays)
            if len(contents.entries) != 1:
                raise FieldError(f"expected a field to read\n{contents}")
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
        if not array.ndim or array.dtype.kind not in "biuf":
            raise FieldError(
                f"field {key!r} of {self.address} is {array.dtype} of shape {array.shape}; expected numbers"
            )
        width = int(np.prod(array.shape[1:], dtype=object)) * array.dtype.itemsize
        if width > LARGEST:
            raise RecordingError(f"{self.address} claims readings of {width} bytes in {key!r}, and may be damaged")
        if times is not None and (times.ndim != 1 or times.shape[0] != array.shape[0]):
            raise RecordingError(
                f"{self.address}: the times have shape {times.shape}, and {key!r} has {array.shape[0]} readings"
            )
        rows = rows_of(width)
        for i in range(0, array.shape[0], rows):
            part = floats(np.asarray(array[i : i + rows]))
            clocks = {} if times is None else {"times": np.asarray(times[i : i + rows]).astype(np.float64)}
            episodes = None if number is None else np.full(len(part), number, np.int64)
            yield Block(select(part, rest, key) if rest else part, clocks, {}, episodes)


class Npy(_Arrays):
    """One array in a `.npy`, shape (T, …): a row is a reading."""

    def contents(self) -> Contents:
        """The one array."""
        return self._listed({"": [self._array()]})

    def blocks(self) -> Iterator[Block]:
        """Its rows."""
        array = self._array()
        if self.request.field and not self.request.field.startswith("["):
            raise FieldError(f"{self.address} holds one array without a name; came field {self.request.field!r}")
        if self.request.clock is not None:
            raise FieldError(f"{self.address} holds no clock; came {self.request.clock!r}: give rate= in its place")
        yield from self._slices(array, None, "", self.field(), None)

    def _array(self) -> Any:
        array = np.load(self.path, mmap_mode="r", allow_pickle=False)
        if not isinstance(array, np.ndarray):
            array.close()
            raise RecordingError(f"expected one array in {self.address}; it is an archive of several, an .npz")
        return array


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
                yield from self._slices(part, times, key, rest, number if number >= 0 else None)

    def _open(self) -> Any:
        try:
            import h5py
        except ImportError as error:
            raise missing("h5py", "hdf5", "an HDF5 file") from error
        return h5py.File(self.path, "r")

    def _arrays(self, file: Any) -> dict[str, dict[int, Any]]:
        """The data sets by key, and of each the parts by demo; −1 where it is in none."""
        import h5py

        found: dict[str, dict[int, Any]] = {}

        def visit(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and item.shape is not None:
                match = re.fullmatch(r"data/demo_(\d{1,9})/(.+)", name)
                key, number = (match.group(2), int(match.group(1))) if match else (name, -1)
                found.setdefault(key, {})[number] = item

        file.visititems(visit)
        return {key: dict(sorted(parts.items())) for key, parts in found.items()}


class ZarrBuffer(_Arrays):
    """A Zarr replay buffer, `data/KEY` (N, …) with `meta/episode_ends`; any other group of arrays likewise."""

    def contents(self) -> Contents:
        """The arrays, those in `meta` left out."""
        return self._listed(self._arrays(self._open()))

    def blocks(self) -> Iterator[Block]:
        """The readings of one array, episode after episode."""
        group = self._open()
        arrays = self._arrays(group)
        key, rest, clock = self._chosen(arrays)
        array = arrays[key][0]
        times = arrays[clock][0] if clock is not None else None
        ends = self._ends(group, array.shape[0])
        done = 0
        for block in self._slices(array, times, key, rest, None):
            if ends is not None:
                index = np.arange(done, done + len(block.readings))
                block.episodes = np.searchsorted(ends, index, side="right").astype(np.int64)
            done += len(block.readings)
            yield block

    def _open(self) -> Any:
        import zarr

        store: Any = str(self.path)
        if not self.path.is_dir():
            store = zarr.storage.ZipStore(self.path, mode="r")
        return zarr.open(store, mode="r")

    def _arrays(self, group: Any) -> dict[str, list[Any]]:
        import zarr

        if isinstance(group, zarr.Array):
            return {"data": [group]}
        found: dict[str, list[Any]] = {}

        def walk(inside: Any, before: str, depth: int) -> None:
            for name, item in inside.members():
                if isinstance(item, zarr.Array):
                    found[f"{before}{name}"] = [item]
                elif depth < 8 and (before or name != "meta"):
                    walk(item, f"{before}{name}/", depth + 1)

        walk(group, "", 0)
        return found

    def _ends(self, group: Any, count: int) -> Any:
        import zarr

        if isinstance(group, zarr.Array) or "meta/episode_ends" not in group:
            return None
        ends = np.asarray(group["meta/episode_ends"][:], np.int64).reshape(-1)
        if (np.diff(ends, prepend=0) < 0).any() or (len(ends) and ends[-1] > count):
            raise RecordingError(
                f"{self.address}: meta/episode_ends does not rise to at most {count}, the readings' count"
            )
        return ends
