"""A checkpoint on disk: a zarr group that zarr writes and reads; here it is made durable, and verified.

zarr itself never syncs, follows links and believes what it reads. So each file is read here, and compared with the
sha256 that the group has of it, before zarr gets to see its bytes.
"""

from __future__ import annotations

import errno
import hashlib
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from scroll_tactile_store.encoding import KEPT_TYPES, NAME, array_bytes, declared_size
from scroll_tactile_store.exceptions import DamageError, StoreError, VersionError, reported
from scroll_tactile_store.files import read_regular, remove_tree, replacing, sync_folder, tree_size
from scroll_tactile_store.layout import FORMAT_VERSION, PARTIAL, checkpoint_path, other_format
from scroll_tactile_store.records import JSON, LARGEST_JSON, Checkpoint, from_json, json_digest

INDEX = "log-"  # begins the name of an array of the store's own: which rows are where in a log

# The arrays of 800 BioTac touches, 28.5 MB, become 14.5 MB; at level 6 14.0 MB, in twice the time.
LEVEL = 3

# Pieces of a large array, along its first axis: a hundred megabytes are some tens of files to make durable.
CHUNK_BYTES = 4 * 2**20

# Of small files that stand for gigabytes nobody is to make room for these. `write_checkpoint` keeps to it.
SPARE, RATIO = 192 * 2**20, 16

FILE = re.compile(rf"({NAME})/(zarr\.json|c(?:/\d{{1,18}}){{0,64}})", re.ASCII)
DTYPES = {np.dtype(text).name: np.dtype(text) for text in KEPT_TYPES}  # by the names that zarr has for them
CODECS = (["bytes"], ["bytes", "zstd"])
LARGEST_DESCRIPTION = 2**16  # bytes of an array's zarr.json, which has a few hundred

# What a reader meets where a file is missing or is not a file; other failures of the system
# (no permission, too many open files) say nothing against the checkpoint.
GONE = frozenset({errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EIO})


def index_name(log: bytes) -> str:
    """Return the name of the array that says which rows are where in the log of this identity."""
    return INDEX + log.hex()


def write_checkpoint(folder: Path, draft: Checkpoint, identity: Mapping[str, JSON]) -> str:
    """Write checked arrays as a durable zarr group in the store's folder; return the sha256 of how it describes itself.

    That is its number, `last_sequence`, attributes, the store's identity, the format and the sha256 of each of its
    files. Raises StoreFullError, ReadOnlyError or another StoreError.
    """
    final = checkpoint_path(folder, draft.number)
    partial = final.with_name(final.name + PARTIAL)
    with reported(partial, f"writing checkpoint {draft.number}"):
        if not final.parent.is_dir():
            final.parent.mkdir()
            sync_folder(folder)
        with replacing(final, partial):
            group = _write_zarr(partial, draft.arrays, LEVEL)
            if sum(array.nbytes for array in draft.arrays.values()) > SPARE + RATIO * tree_size(partial):
                # Readers make no room for so much that so little stands for: anybody could claim it.
                remove_tree(partial)
                group = _write_zarr(partial, draft.arrays, None)
            known: dict[str, Any] = {
                "format": FORMAT_VERSION,
                "number": draft.number,
                "last_sequence": draft.last_sequence,
                "attributes": draft.attributes,
                "identity": identity,
                "files": {
                    path.relative_to(partial).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
                    for array in draft.arrays
                    for path in sorted((partial / array).rglob("*"))
                    if path.is_file()
                },
            }
            digest = json_digest(known)
            group.update_attributes(known | {"sha256": digest})
    return digest


def _write_zarr(path: Path, arrays: Mapping[str, np.ndarray], level: int | None) -> Any:
    # Imported late: 0.3 s that a process which only appends need not spend.
    import zarr
    from zarr.codecs import ZstdCodec
    from zarr.storage import LocalStore

    group = zarr.create_group(store=LocalStore(path), zarr_format=3)
    for name, array in arrays.items():
        group.create_array(
            name,
            data=array,
            chunks=chunk_shape(array),
            compressors=None if level is None else ZstdCodec(level=level),
            fill_value=0,
            # A chunk that equals the fill value would have no file, nor would a lost one.
            config={"write_empty_chunks": True},
        )
    return group


def chunk_shape(array: np.ndarray) -> tuple[int, ...]:
    """Return the shape of a chunk: as many steps along the first axis as have about 4 MiB."""
    if not array.ndim:
        return ()
    step = max(1, array.nbytes // max(1, len(array)))
    return (max(1, min(len(array), CHUNK_BYTES // step)), *(max(1, length) for length in array.shape[1:]))


def _read_zarr(content: Mapping[str, bytes]) -> np.ndarray:
    """Return the array of these files of it, by their names in its folder."""
    import zarr
    from zarr.core.buffer import cpu
    from zarr.storage import MemoryStore

    held = MemoryStore({name: cpu.Buffer.from_bytes(data) for name, data in content.items()})
    return np.asarray(zarr.open_array(held, mode="r", zarr_format=3)[...])


class CheckpointReader:
    """A checkpoint of a store: how it describes itself, and its arrays, verified. path: its folder.

    Every method raises DamageError that names the file or folder, the array and the checkpoint, VersionError
    for another format, and StoreError for a file that cannot be read for a reason that says nothing against it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        header = path / "zarr.json"
        with _reading(f"a checkpoint in {header}", header):
            known = _described(header)
            self._room = SPARE + RATIO * tree_size(path)  # bytes of arrays that its files may stand for
            self.files = dict[str, str](known["files"])  # the sha256 of each file, by its path
        self.number: int = known["number"]
        self.last_sequence: int = known["last_sequence"]
        self.sha256: str = known["sha256"]
        self.attributes: Mapping[str, JSON] = known["attributes"]
        self.identity: Mapping[str, JSON] = known["identity"]

    @property
    def names(self) -> list[str]:
        """The names of its arrays, the store's own among them."""
        return list(dict.fromkeys(name.partition("/")[0] for name in self.files))

    def arrays(self, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
        """Return those of these arrays that it has, or all of the caller's, verified and writable."""
        room, found = self._room, {}
        for name in self.names:
            if name in names if names is not None else not name.startswith(INDEX):
                folder = self._path / name
                with _reading(f"array {name!r} of checkpoint {self.number} in {folder}", folder):
                    content, size = self._verified(name, room)
                    found[name] = _read_zarr(content)
                room -= size
        return found

    def _verified(self, name: str, room: int) -> tuple[dict[str, bytes], int]:
        """Return the files of an array, which are those that were written, and its bytes, at most `room`."""
        content = {"zarr.json": self._verified_file(f"{name}/zarr.json", LARGEST_DESCRIPTION)}
        chunk, chunks, compressed = _claimed(content["zarr.json"])
        if chunk * chunks > room:
            raise ValueError(f"it claims {chunk * chunks} bytes; the checkpoint's files can stand for {room} more")
        own = [file for file in self.files if file.startswith(f"{name}/c")]
        if chunks != len(own):
            raise ValueError(f"it has {len(own)} files for {chunks} chunks")
        for file in own:
            data = content[file.removeprefix(f"{name}/")] = self._verified_file(file, chunk + chunk // 64 + 1024)
            if (declared_size(data) if compressed else len(data)) != chunk:
                raise ValueError(f"{file} does not stand for {chunk} bytes")
        return content, chunk * chunks

    def _verified_file(self, name: str, limit: int) -> bytes:
        path = self._path / name
        data = read_regular(path, limit, within=self._path.parent.parent)
        if hashlib.sha256(data).hexdigest() != self.files.get(name):
            raise DamageError(f"{path} is not what was written: its sha256 differs", path=path)
        return data


def _claimed(description: bytes) -> tuple[int, int, bool]:
    """Return the bytes of a chunk, the number of chunks, and whether they are compressed, as a zarr.json has it.

    Raises ValueError, KeyError or TypeError for what is no array of numbers in known codecs.
    """
    known: Any = from_json(description.decode())
    codecs = [codec["name"] for codec in known["codecs"]]
    if known["data_type"] not in DTYPES or codecs not in CODECS or known.get("storage_transformers"):
        raise ValueError(f"it has elements of {str(known['data_type'])[:80]} in the codecs {str(codecs)[:80]}")
    dtype = DTYPES[known["data_type"]]
    chunk = known["chunk_grid"]["configuration"]["chunk_shape"]
    array_bytes(known["shape"], dtype)
    grid = [-(-length // step) for length, step in zip(known["shape"], chunk, strict=True)]
    return array_bytes(chunk, dtype), prod(grid), len(codecs) > 1


@contextmanager
def _reading(what: str, path: Path) -> Iterator[None]:
    """Raise whatever reading raises as DamageError, but where the system, and no file, is at fault."""
    try:
        yield
    except VersionError:
        raise
    except DamageError as error:
        raise DamageError(f"{what} cannot be read: {error}", path=error.path) from error
    except Exception as error:
        other = isinstance(error, OSError) and error.errno is not None and error.errno not in GONE
        if other or isinstance(error, MemoryError):
            raise StoreError(f"{what} could not be read: {error}") from error
        raise DamageError(f"{what} cannot be read: {type(error).__name__}: {error}", path=path) from error


def _described(header: Path) -> dict[str, Any]:
    """Return what a group says of itself, verified. Raises ValueError for another thing, VersionError and OSError."""
    group: dict[str, Any] = from_json(read_regular(header, LARGEST_JSON, within=header.parents[2]).decode())
    known: dict[str, Any] = dict(group["attributes"])
    # Before the format, which a flipped bit can make another one.
    if json_digest({name: value for name, value in known.items() if name != "sha256"}) != known.get("sha256"):
        raise ValueError("it is not what was written: its sha256 differs")
    if known["format"] != FORMAT_VERSION:
        raise VersionError(other_format(header.parent, known["format"]))
    if strange := [name for name in known["files"] if not FILE.fullmatch(name)]:
        raise ValueError(f"it names the file {strange[0][:80]!r}, which is no array's")
    return known
