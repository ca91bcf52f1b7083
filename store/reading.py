"""Generations read back, whole or in part, and verified against what the journal or they themselves say of them."""

from __future__ import annotations

import errno
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from store.arrays import array_digest, chunk_digest, flat_bytes
from store.errors import DamageError, RecordError, StoreError, VersionError
from store.generations import GROUP_VERSION, own_digest

if TYPE_CHECKING:
    import zarr

__all__ = ["generation_damage", "read_generation", "read_known", "read_rows"]

# What a reader may meet when a file is not there or is not a file; other failures of the system
# (no permission, too many open files) say nothing against the generation.
GONE = frozenset({errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EIO})


def read_generation(path: Path, number: int, content: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the arrays of the generation in folder `path`, each verified against `content`.

    They are writable and the caller's own. Raises DamageError naming the file or folder, the array and
    the generation, and VersionError for a group of a newer format.
    """
    group = _opened(path, number, content["format"])
    return {name: _verified(group, path, number, name, description) for name, description in content["arrays"].items()}


def read_rows(path: Path, number: int, content: Mapping[str, Any], name: str, first: int, last: int) -> np.ndarray:
    """Return rows `first` to before `last` of an array that the generation in folder `path` keeps in chunks.

    Only the chunks that hold them are read and verified. The rows are writable and the caller's own.
    Raises RecordError for an array that is not there or not in chunks and for rows that it has not,
    otherwise as `read_generation`; DamageError names the file and the chunk.
    """
    description = content["arrays"].get(name)
    if description is None or "rows" not in description:
        kept = sorted(one for one, described in content["arrays"].items() if "rows" in described)
        raise RecordError(f"generation {number} in {path} keeps {kept} in chunks, not {name!r}: read it as a whole")
    length, step = description["shape"][0], description["rows"]
    if not 0 <= first <= last <= length:
        raise RecordError(f"array {name!r} of generation {number} has rows 0 to {length}, not {first} to {last}")
    group = _opened(path, number, content["format"])
    pieces = [np.empty((0, *description["shape"][1:]), description["dtype"])]
    for chunk in range(first // step, -(-last // step) if last > first else 0):
        piece = _verified_chunk(group, path, number, name, description, chunk)
        begin = chunk * step
        pieces.append(piece[max(first - begin, 0) : last - begin])
    return np.concatenate(pieces)


def generation_damage(path: Path, number: int, content: Mapping[str, Any]) -> Iterator[DamageError]:
    """Yield what is wrong with the arrays of the generation in folder `path`: array by array, and chunk by chunk.

    Nothing for one that verifies. Raises VersionError for a newer format, and StoreError for a file that cannot
    be read for a reason that says nothing against it.
    """
    try:
        group = _opened(path, number, content["format"])
    except DamageError as damage:
        yield damage
        return
    for name, description in content["arrays"].items():
        chunks = list(_damaged_chunks(group, path, number, name, description))
        yield from chunks
        try:
            _verified(group, path, number, name, description)
        except DamageError as damage:
            if not chunks:
                yield damage


def _damaged_chunks(
    group: zarr.Group, path: Path, number: int, name: str, description: Mapping[str, Any]
) -> Iterator[DamageError]:
    for chunk in range(len(description.get("chunks", ()))):
        try:
            _verified_chunk(group, path, number, name, description, chunk)
        except DamageError as damage:
            yield damage


def _verified(group: zarr.Group, path: Path, number: int, name: str, description: Mapping[str, Any]) -> np.ndarray:
    folder = path / name
    what = f"array {name!r} of generation {number} in {folder}"
    array = _read(group, name, what, folder, description, slice(None))
    if array is None or array_digest(array) != description["sha256"]:
        raise DamageError(f"{what} is not what was written: its sha256 differs", path=folder)
    return array


def _verified_chunk(
    group: zarr.Group, path: Path, number: int, name: str, description: Mapping[str, Any], chunk: int
) -> np.ndarray:
    file = path / name / "c" / "/".join("0" * (len(description["shape"]) + (description["dtype"][1] == "U")))
    begin, end = chunk * description["rows"], min(description["shape"][0], (chunk + 1) * description["rows"])
    what = f"chunk {chunk} (rows {begin} to {end}) of array {name!r} of generation {number} in {file}"
    piece = _read(group, name, what, file, description, slice(begin, end))
    if piece is None or chunk_digest(piece) != description["chunks"][chunk]:
        raise DamageError(f"{what} is not what was written: its digest differs", path=file)
    return piece


def _read(
    group: zarr.Group, name: str, what: str, path: Path, description: Mapping[str, Any], rows: slice
) -> np.ndarray | None:
    import zarr

    try:
        node = group[name]
        return _read_array(node, description, rows) if isinstance(node, zarr.Array) else None
    except Exception as error:
        raise _unreadable(error, what, path) from error


def _read_array(node: zarr.Array[Any], description: Mapping[str, Any], rows: slice) -> np.ndarray | None:
    shape, dtype = tuple(description["shape"]), np.dtype(description["dtype"])
    stored, plainly = shape, dtype
    if text := dtype.kind == "U":
        stored, plainly = (*shape, dtype.itemsize // 4), np.dtype("<u4")
    # Before it is read: a flipped bit in a shape could ask for more memory than there is.
    if node.shape != stored or node.dtype != plainly:
        return None
    # zarr gives a scalar for a 0-d array, which has no rows to choose from.
    plain = np.asarray(node[rows] if shape else node[...])
    if not text:
        return np.require(plain, requirements=["C", "W"])
    array = np.empty(plain.shape[:-1], dtype)
    flat_bytes(array)[:] = flat_bytes(np.asarray(plain, order="C"))
    return array


def _opened(path: Path, number: int, version: int) -> zarr.Group:
    _require_known(path, version)
    import zarr
    from zarr.storage import LocalStore

    header = path / "zarr.json"
    try:
        group = zarr.open_group(store=LocalStore(path, read_only=True), mode="r", zarr_format=3)
        found = group.attrs.get("format")
    except Exception as error:
        raise _unreadable(error, f"generation {number} in {header}", header) from error
    if found != version:
        raise DamageError(f"generation {number} in {header} claims format {found!r}, not {version}", path=header)
    return group


def _unreadable(error: Exception, what: str, path: Path) -> StoreError:
    other = isinstance(error, OSError) and error.errno is not None and error.errno not in GONE
    if other or isinstance(error, MemoryError):
        return StoreError(f"{what} could not be read: {error}")
    return DamageError(f"{what} cannot be read: {type(error).__name__}: {error}", path=path)


def read_known(path: Path) -> dict[str, Any]:
    """Return what the group in folder `path` says of itself: number, upto, attributes, identity, format, arrays.

    Raises DamageError where it is not as it was written, and VersionError for a newer format.
    """
    header = path / "zarr.json"
    try:
        known = json.loads(header.read_text(encoding="utf-8"))["attributes"]
        stored = known.pop("sha256", None)
    except Exception as error:
        raise _unreadable(error, f"a generation in {header}", header) from error
    # Before the version, which a flipped bit can make a newer one.
    if own_digest(known) != stored:
        raise DamageError(
            f"what {header} says of its generation is not what was written: its sha256 differs", path=header
        )
    _require_known(path, known["format"])
    return dict(known)


def _require_known(path: Path, version: int) -> None:
    if version > GROUP_VERSION:
        raise VersionError(
            f"{path} is written in format {version}; this release reads generations up to format "
            f"{GROUP_VERSION}: upgrade it; nothing was changed"
        )
