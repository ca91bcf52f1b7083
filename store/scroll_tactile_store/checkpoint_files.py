"""A checkpoint on disk: a zarr group, written whole and durable, read back whole or in part, and verified."""

from __future__ import annotations

import errno
import os
import weakref
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from scroll_tactile_store.chunks import (
    GROUP_VERSION,
    LARGEST_DESCRIPTION,
    ArrayContent,
    ArrayFiles,
    file_digests,
    most_bytes,
    read_content,
)
from scroll_tactile_store.encoding import array_digest
from scroll_tactile_store.exceptions import DamageError, RecordError, StoreError, VersionError, reported
from scroll_tactile_store.files import open_regular, read_regular, remove_tree, replacing, sync_folder, tree_sizes
from scroll_tactile_store.layout import PARTIAL, checkpoint_path
from scroll_tactile_store.records import JSON, LARGEST_JSON, LARGEST_NUMBER, LateArray, from_json, json_digest

if TYPE_CHECKING:
    import zarr

__all__ = ["INDEX", "QUICK", "THOROUGH", "CheckpointDraft", "CheckpointReader", "index_name", "write_checkpoint"]

INDEX = "log-"  # begins the name of an array of the store's own: which rows are where in a log

# The arrays of 800 BioTac touches, 28.5 MB, become 17.2 MB at level 3, 16.9 at level 6 in thrice the time: that is for
# checkpoints that somebody waits for, and that stay.
QUICK, THOROUGH = 3, 6

# What a reader meets where a file is missing or is not a file; other failures of the system
# (no permission, too many open files) say nothing against the checkpoint.
GONE = frozenset({errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EIO})


@dataclass(frozen=True, eq=False)
class CheckpointDraft:
    """Checked arrays that are to become a checkpoint; `attributes` is JSON, `level` how hard to compress."""

    arrays: Mapping[str, np.ndarray]
    last_sequence: int
    attributes: str
    level: int


def index_name(log: bytes) -> str:
    """Return the name of the array that says which rows are where in the log of this identity."""
    return INDEX + log.hex()


def write_checkpoint(folder: Path, number: int, draft: CheckpointDraft, identity: Mapping[str, JSON]) -> str:
    """Write a draft as a durable zarr group in the store's folder; return the sha256 of how it describes itself.

    That is its number, `last_sequence`, attributes, the store's identity, the format and, for each array, dtype, shape
    and sha256. On any error nothing is left behind. Raises StoreFullError, ReadOnlyError or StoreError.
    """
    described = {
        name: ArrayContent(array.dtype, array.shape, array_digest(array)) for name, array in draft.arrays.items()
    }
    known: dict[str, Any] = {
        "number": number,
        "last_sequence": draft.last_sequence,
        "attributes": from_json(draft.attributes),
        "identity": identity,
    }
    final = checkpoint_path(folder, number)
    partial = final.with_name(final.name + PARTIAL)
    try:
        with reported(partial, f"writing checkpoint {number}"):
            if not final.parent.is_dir():
                final.parent.mkdir()
                sync_folder(folder)
            remove_tree(partial)
            with replacing(final, partial):
                group = _write_zarr(partial, draft, described, draft.level)
                if sum(content.size for content in described.values()) > most_bytes(tree_sizes(partial)):
                    # Readers make no room for so much that so little stands for: anybody could claim it.
                    remove_tree(partial)
                    group = _write_zarr(partial, draft, described, None)
                known |= {"format": GROUP_VERSION, "arrays": _as_json(partial, described)}
                digest = json_digest(known)
                group.update_attributes(known | {"sha256": digest})
                try:
                    _read_attributes(partial / "zarr.json")
                except (ValueError, DamageError) as error:
                    raise RecordError(
                        f"checkpoint {number} has more attributes than could be read again: {error}"
                    ) from error
    except BaseException:
        remove_tree(final)
        raise
    return digest


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


def _write_zarr(
    path: Path, draft: CheckpointDraft, described: Mapping[str, ArrayContent], level: int | None
) -> zarr.Group:
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
        target[...] = content.to_plain(array)
    return group


class CheckpointReader:
    """A checkpoint of a store: how it describes itself, and its arrays, verified. path: its folder.

    Every method raises DamageError that names the file or folder, the array and the checkpoint, VersionError
    for another format, and StoreError for a file that cannot be read for a reason that says nothing against it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        known, self._described = _read_description(path)
        self.number: int = known["number"]
        self.last_sequence: int = known["last_sequence"]
        self.sha256: str = known["sha256"]
        self.attributes: Mapping[str, JSON] = known["attributes"]
        self.identity: Mapping[str, JSON] = known["identity"]
        try:
            room = most_bytes(tree_sizes(path))
        except OSError as error:
            raise _unreadable(error, f"checkpoint {self.number} in {path}", path) from error
        if (size := sum(array.size for array in self._described.values())) > room:
            raise DamageError(
                f"checkpoint {self.number} in {path} claims arrays of {size} bytes; its files can stand for {room} at "
                "most",
                path=path,
            )

    def arrays(self, names: Collection[str] | None = None, but: Collection[str] = ()) -> dict[str, np.ndarray]:
        """Return those of these arrays that it has, or all of the caller's but some, verified and writable."""
        return {
            name: self._array(name)
            for name in self._described
            if name not in but and (name in names if names is not None else not name.startswith(INDEX))
        }

    def late(self, names: Collection[str]) -> dict[str, LateArray]:
        """Return those of these arrays that it has; their files are verified, and stay open until they are read."""
        return {name: self._late(name) for name in self._described if name in names}

    def _late(self, name: str) -> LateArray:
        content, held = self._described[name], dict[Path, BinaryIO]()
        with self._naming(name), ExitStack() as opened:
            for _, path, _ in ArrayFiles(self._path, name, content, self._read).verified():
                held[path] = opened.enter_context(os.fdopen(open_regular(path, os.O_RDONLY), "rb"))
            text = self._read(self._path / name / "zarr.json", LARGEST_DESCRIPTION)
            guard = Lock()

            def read(path: Path, limit: int) -> bytes:
                if path.name == "zarr.json":
                    return text
                with guard:
                    held[path].seek(0)
                    return held[path].read(limit)

            late = LateArray(content.dtype, content.shape, lambda: self._array(name, read=read))
            weakref.finalize(late, opened.pop_all().close)
        return late

    def damage(self, log: bytes = b"") -> Iterator[DamageError]:
        """Yield what is wrong with the caller's arrays, or, where a log's identity is given, with the index of that."""
        for name in self._described:
            if name == index_name(log) if log else not name.startswith(INDEX):
                try:
                    self._array(name, thorough=True)
                except DamageError as damage:
                    yield damage

    def _array(
        self, name: str, *, thorough: bool = False, read: Callable[[Path, int], bytes] | None = None
    ) -> np.ndarray:
        content = self._described[name]
        with self._naming(name) as (what, folder):
            array = ArrayFiles(self._path, name, content, read or self._read).read()
        # Its files were verified; what they stand for is looked at where damage is looked for.
        if thorough and array_digest(array) != content.sha256:
            raise DamageError(f"{what} is not what was written: its sha256 differs", path=folder)
        return array

    def _read(self, path: Path, limit: int) -> bytes:
        return read_regular(path, limit, within=self._path.parent.parent)

    @contextmanager
    def _naming(self, name: str) -> Iterator[tuple[str, Path]]:
        """Name the array in what is raised."""
        folder = self._path / name
        what = f"array {name!r} of checkpoint {self.number} in {folder}"
        try:
            yield what, folder
        except Exception as error:
            raise _unreadable(error, what, folder) from error


def _read_attributes(header: Path) -> dict[str, Any]:
    """Return the attributes of a group; raise DamageError, ValueError where it is none, and OSError."""
    group: dict[str, Any] = from_json(read_regular(header, LARGEST_JSON, within=header.parents[2]).decode())
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


def _read_description(path: Path) -> tuple[dict[str, Any], dict[str, ArrayContent]]:
    header = path / "zarr.json"
    try:
        known = _read_attributes(header)
        stored = known.pop("sha256", None)
        sound = json_digest(known) == stored
    except Exception as error:
        raise _unreadable(error, f"a checkpoint in {header}", header) from error
    # Before the version, which a flipped bit can make a newer one.
    if not sound:
        raise DamageError(
            f"what {header} says of its checkpoint is not what was written: its sha256 differs", path=header
        )
    try:
        described = read_content(known)
        if known["format"] != GROUP_VERSION:
            raise VersionError(
                f"{path} is written in format {known['format']}; this release reads checkpoints of format "
                f"{GROUP_VERSION}: open it with the release that wrote it; nothing was changed"
            )
        _require_described(known)
    except ValueError as error:
        raise _unreadable(error, f"a checkpoint in {header}", header) from error
    return known | {"sha256": stored}, described


def _require_described(known: Mapping[str, Any]) -> None:
    """Raise ValueError where a group of a known format does not say whose it is."""
    for name, kind in {"number": int, "last_sequence": int, "attributes": dict, "identity": dict}.items():
        if type(known.get(name)) is not kind:
            raise ValueError(f"its {name} is {str(known.get(name))[:80]!r}")
    if not (0 <= known["number"] <= LARGEST_NUMBER and 0 <= known["last_sequence"] <= LARGEST_NUMBER):
        raise ValueError(f"its number is {known['number']}, its last_sequence {known['last_sequence']}")
