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

from store.chunks import ArrayFiles, file_digests, most_bytes
from store.content import GROUP_VERSION, ArrayContent, read_content
from store.encoding import array_digest, flat_bytes
from store.exceptions import DamageError, RecordError, StoreError, VersionError, reported
from store.files import read_regular, remove_tree, sync_folder, sync_tree
from store.records import JSON, LARGEST_JSON, LARGEST_NUMBER, from_json

if TYPE_CHECKING:
    import zarr

__all__ = ["PARTIAL", "Draft", "GroupReader", "folder_name", "read_own_description", "require_known", "write_group"]

PARTIAL = ".partial"

# The memory of 800 BioTac touches, 29.3 MB, becomes 19.1 MB (level 1: 20.0; level 6: 18.7; with shuffled bytes, as in
# Blosc, 17.3; but zarr's format has no codec for these alone).
LEVEL = 3

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
        name: ArrayContent(array.dtype, array.shape, array_digest(array)) for name, array in draft.arrays.items()
    }
    known = {"number": number, "upto": draft.upto, "attributes": from_json(draft.attributes), "identity": identity}
    final = parent / folder_name(number)
    partial = parent / (folder_name(number) + PARTIAL)
    try:
        with reported(partial, f"writing generation {number}"):
            parent.mkdir(exist_ok=True)
            remove_tree(partial)
            group = _write_zarr(partial, draft, described, LEVEL)
            if sum(content.size for content in described.values()) > most_bytes(partial):
                # Readers make no room for so much that so little stands for: anybody could claim it.
                remove_tree(partial)
                group = _write_zarr(partial, draft, described, None)
            content = {"format": GROUP_VERSION, "arrays": _as_json(partial, described)}
            group.update_attributes(known | content | {"sha256": _own_digest(known | content)})
            try:
                _read_attributes(partial / "zarr.json")
            except (ValueError, DamageError) as error:
                raise RecordError(
                    f"generation {number} has more attributes than could be read again: {error}"
                ) from error
            sync_tree(partial)
            partial.rename(final)
            sync_folder(parent)
    except BaseException:
        remove_tree(partial)
        remove_tree(final)
        raise
    return content


def _as_json(path: Path, described: Mapping[str, ArrayContent]) -> dict[str, JSON]:
    return {
        name: {
            "dtype": content.dtype.str,
            "shape": list(content.shape),
            "sha256": content.sha256,
            "files": file_digests(path / name, content),
        }
        for name, content in described.items()
    }


def _own_digest(known: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(known, sort_keys=True, separators=(",", ":")).encode("ascii")).hexdigest()


def _write_zarr(path: Path, draft: Draft, described: Mapping[str, ArrayContent], level: int | None) -> zarr.Group:
    # Imported late: 300 ms that a process which reads, or only appends, need not spend.
    import zarr
    from zarr.codecs import ZstdCodec
    from zarr.storage import LocalStore

    group = zarr.create_group(store=LocalStore(path), zarr_format=3)
    for name, array in draft.arrays.items():
        content = described[name]
        target = group.create_array(
            name,
            shape=content.plain_shape,
            dtype=content.plain,
            chunks=content.chunk,
            compressors=None if level is None else ZstdCodec(level=level),
            fill_value=0,
            attributes={"dtype": array.dtype.str},
            # A chunk that equals the fill value would have no file, nor would a lost one.
            config={"write_empty_chunks": True},
        )
        target[...] = flat_bytes(array).view(content.plain).reshape(content.plain_shape)
    return group


class GroupReader:
    """The generation in folder `path`, verified against `content`, which `write_group` returned.

    Every method raises DamageError that names the file or folder, the array and the generation, VersionError
    for a newer format, and StoreError for a file that cannot be read for a reason that says nothing against it.
    """

    def __init__(self, path: Path, number: int, content: Mapping[str, Any]) -> None:
        require_known(path, content["format"])
        self._path, self._number, self._described = path, number, read_content(content)
        header = path / "zarr.json"
        try:
            found, room = _read_attributes(header).get("format"), most_bytes(path)
        except Exception as error:
            raise _unreadable(error, f"generation {number} in {header}", header) from error
        if found != content["format"]:
            raise DamageError(
                f"generation {number} in {header} claims format {found!r}, not {content['format']}", path=header
            )
        if (size := sum(array.size for array in self._described.values())) > room:
            raise DamageError(
                f"generation {number} in {path} claims arrays of {size} bytes; its files can stand for {room} at most",
                path=path,
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
        folder, content = self._path / name, self._described[name]
        what = f"array {name!r} of generation {self._number} in {folder}"
        try:
            array = ArrayFiles(self._path, name, content).read()
        except Exception as error:
            raise _unreadable(error, what, folder) from error
        if array_digest(array) != content.sha256:
            raise DamageError(f"{what} is not what was written: its sha256 differs", path=folder)
        return array


def _read_attributes(header: Path) -> dict[str, Any]:
    """Return the attributes of a group; raise DamageError, ValueError where it is none, and OSError."""
    group: dict[str, Any] = from_json(read_regular(header, LARGEST_JSON, within=header.parent.parent).decode())
    attributes = group.get("attributes")
    if not isinstance(attributes, dict) or (group.get("node_type"), group.get("zarr_format")) != ("group", 3):
        raise ValueError("it describes no group of zarr's format 3")
    return attributes


def _unreadable(error: Exception, what: str, path: Path) -> StoreError:
    if isinstance(error, DamageError):
        return DamageError(f"{what} cannot be read: {error}", path=error.path)
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
        known = _read_attributes(header)
        stored = known.pop("sha256", None)
        sound = _own_digest(known) == stored
    except Exception as error:
        raise _unreadable(error, f"a generation in {header}", header) from error
    # Before the version, which a flipped bit can make a newer one.
    if not sound:
        raise DamageError(
            f"what {header} says of its generation is not what was written: its sha256 differs", path=header
        )
    try:
        read_content(known)
        require_known(path, known["format"])
        _require_described(known)
    except ValueError as error:
        raise _unreadable(error, f"a generation in {header}", header) from error
    return known


def _require_described(known: Mapping[str, Any]) -> None:
    """Raise ValueError where a group of a known format does not say whose it is."""
    for name, kind in {"number": int, "upto": int, "attributes": dict, "identity": dict}.items():
        if type(known.get(name)) is not kind:
            raise ValueError(f"its {name} is {str(known.get(name))[:80]!r}")
    if not (0 <= known["number"] <= LARGEST_NUMBER and 0 <= known["upto"] <= LARGEST_NUMBER):
        raise ValueError(f"its number is {known['number']}, its upto {known['upto']}")


def require_known(path: Path, version: int) -> None:
    """Raise VersionError where a generation's format is newer than this release reads."""
    if version > GROUP_VERSION:
        raise VersionError(
            f"{path} is written in format {version}; this release reads generations up to format "
            f"{GROUP_VERSION}: upgrade it; nothing was changed"
        )
