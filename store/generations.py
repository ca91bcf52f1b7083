"""Generations: zarr groups that are written whole, made durable and verified when they are read."""

from __future__ import annotations

import errno
import logging
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from store.arrays import array_digest, chunk_digest, flat_bytes
from store.errors import DamageError, RecordError, StoreError, VersionError
from store.files import remove_tree, sync_folder, sync_tree
from store.records import JSON
from store.reporting import reported

if TYPE_CHECKING:
    import zarr

__all__ = ["folder_name", "highest_number", "read_generation", "read_rows", "remove_others", "write_generation"]

logger = logging.getLogger(__name__)

GROUP_VERSION = 1
PARTIAL = ".partial"

# Pieces of a large array: small enough to be compressed in cache-sized steps and on several
# threads, large enough that a hundred megabytes are some tens of files to make durable.
CHUNK_BYTES = 4 * 2**20

# What a reader may meet when a file is not there or is not a file; other failures of the system
# (no permission, too many open files) say nothing against the generation.
GONE = frozenset({errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EIO})


def folder_name(number: int) -> str:
    """Return the name of a generation's folder: its number in eight digits, or more when it needs them."""
    return f"{number:08d}"


def write_generation(
    parent: Path,
    number: int,
    upto: int,
    arrays: Mapping[str, np.ndarray],
    attributes: Mapping[str, JSON],
    chunks: Mapping[str, int],
) -> dict[str, Any]:
    """Write checked arrays as a durable zarr group in `parent` and return what must be read back.

    That is the group's format and, for each array, its dtype, shape and sha256, and for one that is in
    `chunks` (name → rows) a digest of each chunk, as JSON. On any error nothing is left behind. Raises
    StoreFullError, ReadOnlyError or StoreError.
    """
    described = {name: _describe(array, chunks.get(name)) for name, array in arrays.items()}
    content = {"format": GROUP_VERSION, "arrays": described}
    final = parent / folder_name(number)
    draft = parent / (folder_name(number) + PARTIAL)
    try:
        with reported(draft, f"writing generation {number}"):
            parent.mkdir(exist_ok=True)
            remove_tree(draft)
            known = {"format": GROUP_VERSION, "number": number, "upto": upto, "attributes": attributes}
            _write_group(draft, known, arrays, chunks)
            sync_tree(draft)
            draft.rename(final)
            sync_folder(parent)
    except BaseException:
        remove_tree(draft)
        remove_tree(final)
        raise
    return content


def _describe(array: np.ndarray, rows: int | None) -> dict[str, Any]:
    described = {"dtype": array.dtype.str, "shape": list(array.shape), "sha256": array_digest(array)}
    if rows is None:
        return described
    pieces = [chunk_digest(array[first : first + rows]) for first in range(0, len(array), rows)]
    return described | {"rows": rows, "chunks": pieces}


def _write_group(
    path: Path, attributes: dict[str, Any], arrays: Mapping[str, np.ndarray], chunks: Mapping[str, int]
) -> None:
    # Imported late: 300 ms that a process which only appends or reads the journal need not spend.
    import zarr
    from zarr.codecs import BloscCodec
    from zarr.storage import LocalStore

    group = zarr.create_group(store=LocalStore(path), zarr_format=3, attributes=attributes)
    for name, array in arrays.items():
        plain = _without_text(array)
        target = group.create_array(
            name,
            shape=plain.shape,
            dtype=plain.dtype,
            **_layout(plain, chunks.get(name)),
            compressors=BloscCodec(cname="zstd", clevel=1, shuffle="shuffle"),
            fill_value=0,
            attributes={"dtype": array.dtype.str},
            # A chunk that equals the fill value would have no file, nor would a lost one.
            config={"write_empty_chunks": True},
        )
        target[...] = plain


def _without_text(array: np.ndarray) -> np.ndarray:
    # zarr v3 has no settled type for fixed-width text and warns of it: code points have one.
    if array.dtype.kind != "U":
        return array
    shape = (*array.shape, array.dtype.itemsize // 4)
    return flat_bytes(array).view("<u4").reshape(shape)


def _layout(array: np.ndarray, rows: int | None) -> dict[str, Any]:
    if rows is None:
        return {"chunks": _chunks(array)}
    # One file for all the chunks: hundreds of small ones would each have to be made durable.
    rest = tuple(max(1, length) for length in array.shape[1:])
    return {"chunks": (rows, *rest), "shards": (rows * max(1, -(-len(array) // rows)), *rest)}


def _chunks(array: np.ndarray) -> tuple[int, ...]:
    chunks, piece = [], array.nbytes
    for length in array.shape:
        slab = piece // max(length, 1)
        chunks.append(max(1, length if piece <= CHUNK_BYTES else CHUNK_BYTES // max(slab, 1)))
        piece = slab * chunks[-1]
    return tuple(chunks)


def read_generation(path: Path, number: int, content: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the arrays of the generation in folder `path`, each verified against `content`.

    They are writable and the caller's own. Raises DamageError naming the file or folder, the array and
    the generation, and VersionError for a group of a newer format.
    """
    group = _opened(path, number, content["format"])
    arrays = {}
    for name, description in content["arrays"].items():
        folder = path / name
        what = f"array {name!r} of generation {number} in {folder}"
        array = _read(group, name, what, folder, description, slice(None))
        if array is None or array_digest(array) != description["sha256"]:
            raise DamageError(f"{what} is not what was written: its sha256 differs", path=folder)
        arrays[name] = array
    return arrays


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
    file = path / name / "c" / "/".join("0" * (len(description["shape"]) + (description["dtype"][1] == "U")))
    pieces = [np.empty((0, *description["shape"][1:]), description["dtype"])]
    for chunk in range(first // step, -(-last // step) if last > first else 0):
        begin, end = chunk * step, min(length, (chunk + 1) * step)
        what = f"chunk {chunk} (rows {begin} to {end}) of array {name!r} of generation {number} in {file}"
        shape = [end - begin, *description["shape"][1:]]
        piece = _read(group, name, what, file, {**description, "shape": shape}, slice(begin, end))
        if piece is None or chunk_digest(piece) != description["chunks"][chunk]:
            raise DamageError(f"{what} is not what was written: its digest differs", path=file)
        pieces.append(piece[max(first - begin, 0) : last - begin])
    return np.concatenate(pieces)


def _read(
    group: zarr.Group, name: str, what: str, path: Path, description: Mapping[str, Any], rows: slice
) -> np.ndarray | None:
    import zarr

    try:
        node = group[name]
        return _read_array(node, description, rows) if isinstance(node, zarr.Array) else None
    except Exception as error:
        raise _unreadable(error, what, path) from error


def _opened(path: Path, number: int, version: int) -> zarr.Group:
    if version > GROUP_VERSION:
        raise VersionError(
            f"{path} is written in format {version}; this release reads generations up to format "
            f"{GROUP_VERSION}: upgrade it; nothing was changed"
        )
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


def _read_array(node: zarr.Array[Any], description: Mapping[str, Any], rows: slice) -> np.ndarray | None:
    shape, dtype = tuple(description["shape"]), np.dtype(description["dtype"])
    # zarr gives a scalar for a 0-d array, which has no rows to choose from.
    plain = np.asarray(node[rows] if shape else node[...])
    if dtype.kind == "U":
        expected: tuple[int, ...] = (*shape, dtype.itemsize // 4)
        if plain.shape != expected or plain.dtype != np.dtype("<u4"):
            return None
        array = np.empty(shape, dtype)
        flat_bytes(array)[:] = flat_bytes(np.asarray(plain, order="C"))
        return array
    if plain.shape != shape or plain.dtype != dtype:
        return None
    return np.require(plain, requirements=["C", "W"])


def _unreadable(error: Exception, what: str, path: Path) -> StoreError:
    other = isinstance(error, OSError) and error.errno is not None and error.errno not in GONE
    if other or isinstance(error, MemoryError):
        return StoreError(f"{what} could not be read: {error}")
    return DamageError(f"{what} cannot be read: {type(error).__name__}: {error}", path=path)


def highest_number(parent: Path) -> int:
    """Return the highest number of a generation's folder in `parent`, finished or not; 0 for none."""
    if not parent.is_dir():
        return 0
    stems = (entry.name.removesuffix(PARTIAL) for entry in parent.iterdir())
    return max((int(stem) for stem in stems if stem.isascii() and stem.isdigit()), default=0)


def remove_others(parent: Path, kept: Collection[int]) -> None:
    """Remove every generation's folder, finished or not, that is not numbered in `kept`.

    What does not carry a generation's name is left alone; what cannot be removed stays for the next open.
    """
    if not parent.is_dir():
        return
    names = {folder_name(number) for number in kept}
    for entry in sorted(parent.iterdir()):
        stem = entry.name.removesuffix(PARTIAL)
        if entry.name not in names and stem.isascii() and stem.isdigit():
            remove_tree(entry)
            logger.debug("removed %s", entry)
