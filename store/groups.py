"""One generation on disk: a zarr group, written whole and durable, read back whole or in part, and verified."""

from __future__ import annotations

import errno
import hashlib
import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from store.encoding import array_digest, flat_bytes
from store.exceptions import DamageError, StoreError, VersionError, reported
from store.files import remove_tree, sync_folder, sync_tree
from store.records import JSON, from_json

if TYPE_CHECKING:
    import zarr

__all__ = ["PARTIAL", "Draft", "GroupReader", "folder_name", "read_own_description", "require_known", "write_group"]

GROUP_VERSION = 1
PARTIAL = ".partial"

# Pieces of a large array: small enough to be compressed in cache-sized steps and on several
# threads, large enough that a hundred megabytes are some tens of files to make durable.
CHUNK_BYTES = 4 * 2**20

# What a reader meets where a file is missing or is not a file; other failures of the system
# (no permission, too many open files) say nothing against the generation.
GONE = frozenset({errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EIO})


def folder_name(number: int) -> str:
    """Return the name of a generation's folder: its number in eight digits, or more when it needs them."""
    return f"{number:08d}"


@dataclass(frozen=True, eq=False)
class Draft:
    """Checked arrays that are to become a generation; `attributes` is JSON."""

    arrays: Mapping[str, np.ndarray]
    upto: int
    attributes: str


def write_group(parent: Path, number: int, draft: Draft, identity: Mapping[str, JSON]) -> dict[str, Any]:
    """Write a draft as a durable zarr group in `parent`; return what a reader verifies it against.

    That is the group's format and, for each array, its dtype, shape and sha256, as JSON. The group also
    describes itself so, and names its store, so that it verifies without the journal. On any error nothing is
    left behind. Raises StoreFullError, ReadOnlyError or StoreError.
    """
    described = {
        name: {"dtype": array.dtype.str, "shape": list(array.shape), "sha256": array_digest(array)}
        for name, array in draft.arrays.items()
    }
    content = {"format": GROUP_VERSION, "arrays": described}
    known = {"number": number, "upto": draft.upto, "attributes": from_json(draft.attributes), "identity": identity}
    known |= content
    final = parent / folder_name(number)
    partial = parent / (folder_name(number) + PARTIAL)
    try:
        with reported(partial, f"writing generation {number}"):
            parent.mkdir(exist_ok=True)
            remove_tree(partial)
            _write_zarr(partial, known | {"sha256": _own_digest(known)}, draft)
            sync_tree(partial)
            partial.rename(final)
            sync_folder(parent)
    except BaseException:
        remove_tree(partial)
        remove_tree(final)
        raise
    return content


def _own_digest(known: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(known, sort_keys=True, separators=(",", ":")).encode("ascii")).hexdigest()


def _write_zarr(path: Path, attributes: dict[str, Any], draft: Draft) -> None:
    # Imported late: 300 ms that a process which only appends or reads the journal need not spend.
    import zarr
    from zarr.codecs import BloscCodec
    from zarr.storage import LocalStore

    group = zarr.create_group(store=LocalStore(path), zarr_format=3, attributes=attributes)
    for name, array in draft.arrays.items():
        plain = array
        if array.dtype.kind == "U":
            # zarr v3 has no settled type for fixed-width text and warns of it: code points have one.
            plain = flat_bytes(array).view("<u4").reshape(*array.shape, array.dtype.itemsize // 4)
        target = group.create_array(
            name,
            shape=plain.shape,
            dtype=plain.dtype,
            chunks=_chunks(plain),
            # Second moments and a sample of 800 BioTac touches, 12.3 MB, become 7.9 MB in 75 ms, synced, and are read
            # in 20 ms (level 1: 8.1 MB in 56 ms; level 5: 7.6 MB in 105 ms; differences of rows save nothing).
            compressors=BloscCodec(cname="zstd", clevel=3, shuffle="shuffle"),
            fill_value=0,
            attributes={"dtype": array.dtype.str},
            # A chunk that equals the fill value would have no file, nor would a lost one.
            config={"write_empty_chunks": True},
        )
        target[...] = plain


def _chunks(array: np.ndarray) -> tuple[int, ...]:
    lengths, piece = [], array.nbytes
    for length in array.shape:
        slab = piece // max(length, 1)
        lengths.append(max(1, length if piece <= CHUNK_BYTES else CHUNK_BYTES // max(slab, 1)))
        piece = slab * lengths[-1]
    return tuple(lengths)


class GroupReader:
    """The generation in folder `path`, verified against `content`, which `write_group` returned.

    Every method raises DamageError that names the file or folder, the array and the generation, VersionError
    for a newer format, and StoreError for a file that cannot be read for a reason that says nothing against it.
    """

    def __init__(self, path: Path, number: int, content: Mapping[str, Any]) -> None:
        require_known(path, content["format"])
        import zarr
        from zarr.storage import LocalStore

        self._path, self._number, self._described = path, number, content["arrays"]
        header = path / "zarr.json"
        try:
            self._group = zarr.open_group(store=LocalStore(path, read_only=True), mode="r", zarr_format=3)
            found = self._group.attrs.get("format")
        except Exception as error:
            raise _unreadable(error, f"generation {number} in {header}", header) from error
        if found != content["format"]:
            raise DamageError(
                f"generation {number} in {header} claims format {found!r}, not {content['format']}", path=header
            )

    def arrays(self, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
        """Return these arrays, all where it is not said, verified, writable and the caller's own."""
        return {name: self._array(name) for name in (self._described if names is None else names)}

    def damage(self) -> Iterator[DamageError]:
        """Yield what is wrong with the arrays, array by array; nothing where all verifies."""
        for name in self._described:
            try:
                self._array(name)
            except DamageError as damage:
                yield damage

    def _array(self, name: str) -> np.ndarray:
        import zarr

        folder = self._path / name
        what = f"array {name!r} of generation {self._number} in {folder}"
        try:
            node = self._group[name]
            array = _read_array(node, self._described[name]) if isinstance(node, zarr.Array) else None
        except Exception as error:
            raise _unreadable(error, what, folder) from error
        if array is None or array_digest(array) != self._described[name]["sha256"]:
            raise DamageError(f"{what} is not what was written: its sha256 differs", path=folder)
        return array


def _read_array(node: zarr.Array[Any], described: Mapping[str, Any]) -> np.ndarray | None:
    shape, dtype = tuple(described["shape"]), np.dtype(described["dtype"])
    text = dtype.kind == "U"
    stored = ((*shape, dtype.itemsize // 4), np.dtype("<u4")) if text else (shape, dtype)
    # Before it is read: a flipped bit in a shape could ask for more memory than there is.
    if (node.shape, node.dtype) != stored:
        return None
    plain = np.asarray(node[...])
    if not text:
        return np.require(plain, requirements=["C", "W"])
    array = np.empty(shape, dtype)
    flat_bytes(array)[:] = flat_bytes(np.asarray(plain, order="C"))
    return array


def _unreadable(error: Exception, what: str, path: Path) -> StoreError:
    other = isinstance(error, OSError) and error.errno is not None and error.errno not in GONE
    if other or isinstance(error, MemoryError):
        return StoreError(f"{what} could not be read: {error}")
    return DamageError(f"{what} cannot be read: {type(error).__name__}: {error}", path=path)


def read_own_description(path: Path) -> dict[str, Any]:
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
    if _own_digest(known) != stored:
        raise DamageError(
            f"what {header} says of its generation is not what was written: its sha256 differs", path=header
        )
    require_known(path, known["format"])
    return dict(known)


def require_known(path: Path, version: int) -> None:
    """Raise VersionError where a generation's format is newer than this release reads."""
    if version > GROUP_VERSION:
        raise VersionError(
            f"{path} is written in format {version}; this release reads generations up to format "
            f"{GROUP_VERSION}: upgrade it; nothing was changed"
        )
