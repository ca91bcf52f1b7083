"""Packed files: arrays and records in one file that travels, each part under its checksum (FORMAT.md describes it)."""

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self
from uuid import uuid4

import numpy as np

from store.encoding import check_arrays, decode_payload, encode_payload
from store.exceptions import DamageError, NotAStoreError, VersionError, reported
from store.files import CAREFULLY, remove_tree, sync_folder
from store.records import JSON, LARGEST_JSON, from_json, to_json

__all__ = ["PackedFile", "PackedWriter", "packing"]

BEGIN, VERSION, END = b"ARPF", 1, b"ARPFend\n"
HEAD = struct.Struct("<4sI")
TRAILER = struct.Struct("<Q32s8s")
PART_BYTES = 64 * 2**20  # of arrays together, before compressing: what a reader has in memory at once
LARGEST_PART = 2**29  # bytes in the file; what it unpacks to is bounded as any payload is


class PackedWriter:
    """Writes a packed file: payloads one behind another, then arrays, then the index. Made by `packing`."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._file.write(HEAD.pack(BEGIN, VERSION))
        self._place = HEAD.size
        self._rows = 0
        self._parts: list[list[JSON]] = []

    def row(self, payload: bytes) -> None:
        """Append the payload of one record; the caller keeps its length and digest among the arrays."""
        self._file.write(payload)
        self._place += len(payload)
        self._rows += len(payload)

    def arrays(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Append arrays under a name, in as many parts as they take. Raises RecordError for what no store keeps."""
        group: dict[str, np.ndarray] = {}
        for key, array in check_arrays(arrays).items():
            if group and sum(each.nbytes for each in group.values()) + array.nbytes > PART_BYTES:
                self._part(name, group)
                group = {}
            group[key] = array
        self._part(name, group)

    def _part(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        payload = encode_payload(arrays)
        self._file.write(payload)
        self._place += len(payload)
        self._parts.append([name, len(payload), hashlib.sha256(payload).hexdigest()])

    def finish(self, about: Mapping[str, JSON]) -> None:
        """Write the index, with what is said of the whole file."""
        index = to_json("the index", {"about": about, "rows": self._rows, "parts": self._parts}).encode()
        self._file.write(index)
        self._file.write(TRAILER.pack(len(index), _index_digest(VERSION, index), END))


def _index_digest(version: int, index: bytes) -> bytes:
    return hashlib.sha256(HEAD.pack(BEGIN, version) + index).digest()


@contextmanager
def packing(path: Path) -> Iterator[PackedWriter]:
    """Write a packed file that appears whole and durable when the block ends, or not at all.

    Raises StoreFullError, ReadOnlyError or another StoreError.
    """
    draft = path.with_name(f"{path.name}.{uuid4().hex}.partial")
    with reported(path, "writing a packed file"):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with draft.open("xb") as file:
                yield PackedWriter(file)
                file.flush()
                os.fsync(file.fileno())
            draft.replace(path)
            sync_folder(path.parent)
        finally:
            remove_tree(draft)


class PackedFile:
    """A packed file that is read: its index is verified when it is opened, and every part before it is decoded.

    about: what is said of the whole file. rows: bytes of the payloads of records, from `first_row` on.

    Raises NotAStoreError for what is no packed file, VersionError for one of a newer version, DamageError, StoreError.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.first_row = HEAD.size
        with reported(self.path, "opening a packed file"):
            self._file = os.fdopen(os.open(self.path, os.O_RDONLY | CAREFULLY), "rb")
        try:
            with reported(self.path, "reading a packed file"):
                self._read_index()
        except BaseException:
            self._file.close()
            raise

    def _read_index(self) -> None:
        size = self._file.seek(0, os.SEEK_END)
        if size < HEAD.size + TRAILER.size:
            raise NotAStoreError(f"{self.path} is no packed memory: it has {size} bytes")
        magic, version = HEAD.unpack(self._bytes(0, HEAD.size))
        length, digest, end = TRAILER.unpack(self._bytes(size - TRAILER.size, TRAILER.size))
        if magic != BEGIN and end != END:
            raise NotAStoreError(f"{self.path} is no packed memory: neither its beginning nor its end is that of one")
        room = size - HEAD.size - TRAILER.size
        if magic != BEGIN or end != END or length > min(room, LARGEST_JSON):
            raise self.damage("its index cannot be found: it is cut off, or its beginning or its end is damaged")
        index = self._bytes(size - TRAILER.size - length, length)
        if _index_digest(version, index) != digest:
            raise self.damage("its index fails its checksum")
        if version > VERSION:
            raise VersionError(
                f"{self.path} is packed in format {version}; this release reads {VERSION}: upgrade it, or pack the "
                "memory with this one"
            )
        try:
            found = from_json(index.decode())
            about, rows, parts = found["about"], found["rows"], found["parts"]
            if not isinstance(about, dict) or type(rows) is not int or rows < 0 or not isinstance(parts, list):
                raise ValueError("about, rows and parts are not what they must be")
            self.about: Mapping[str, JSON] = about
            self.rows: int = rows
            self._parts = self._places(parts, HEAD.size + rows)
        except (KeyError, UnicodeDecodeError, ValueError) as error:
            raise self.damage(f"its index is none: {error}") from error
        if sum(stored for _, _, stored, _ in self._parts) + rows + length != room:
            raise self.damage("its parts have not the bytes that its index says")

    def _places(self, parts: list[JSON], place: int) -> list[tuple[str, int, int, str]]:
        places = []
        for part in parts:
            if not isinstance(part, list) or len(part) != 3:
                raise ValueError("a part is none")
            name, length, digest = part
            if not isinstance(name, str) or type(length) is not int or not isinstance(digest, str):
                raise ValueError("a part is none")
            if not 0 <= length <= LARGEST_PART:
                raise ValueError(f"a part has {length} bytes")
            places.append((name, place, length, digest))
            place += length
        return places

    def arrays(self, name: str) -> dict[str, np.ndarray]:
        """The arrays under a name; none where there is no such part. Raises DamageError."""
        found: dict[str, np.ndarray] = {}
        for part, place, length, digest in self._parts:
            if part == name:
                found |= self._decoded(place, length, bytes.fromhex(digest), f"its {name}")
        return found

    def row(self, place: int, length: int, digest: bytes) -> dict[str, np.ndarray]:
        """The arrays of a record whose payload begins at `place` among the rows. Raises DamageError."""
        if not 0 <= place <= place + length <= self.rows:
            raise self.damage(f"a row of {length} bytes at {place} is not among its rows")
        return self._decoded(self.first_row + place, length, digest, f"the row at byte {place}")

    def _decoded(self, place: int, length: int, digest: bytes, what: str) -> dict[str, np.ndarray]:
        with reported(self.path, "reading a packed file"):
            payload = self._bytes(place, length)
        if len(payload) != length or hashlib.sha256(payload).digest() != digest:
            raise self.damage(f"{what} fails its checksum")
        try:
            return decode_payload(payload)
        except (ValueError, MemoryError) as error:
            raise self.damage(f"{what} was never written so: {error}") from error

    def damage(self, what: str) -> DamageError:
        """The error for a file of which this is wrong."""
        return DamageError(
            f"{self.path} is not as it was written: {what}. Fetch it again from where it was packed", path=self.path
        )

    def _bytes(self, place: int, length: int) -> bytes:
        self._file.seek(place)
        return self._file.read(length)

    def close(self) -> None:
        """Release the file; a second call does nothing."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
