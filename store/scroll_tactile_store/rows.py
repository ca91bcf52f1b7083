"""Which rows a log holds and where, by sequence and by key; and files that tell it without the log being read."""

from __future__ import annotations

import logging
import struct
from array import array
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scroll_tactile_store.derived import without_digest, write_digested
from scroll_tactile_store.exceptions import DamageError
from scroll_tactile_store.files import read_regular, remove_tree
from scroll_tactile_store.framing import Frame
from scroll_tactile_store.layout import DERIVED
from scroll_tactile_store.log import LogPlace, LogReader
from scroll_tactile_store.row_encoding import (
    HEAD_BYTES,
    ROW,
    head_size,
    key_prefix,
    prefix_in,
    row_sequence,
    verified_size,
)

__all__ = ["Index", "Rows", "head_bytes"]

logger = logging.getLogger(__name__)

USUAL_HEAD = 512  # bytes that are read at once of a row's head
COLUMNS = ("sequences", "offsets", "sizes", "keys")

# Of a file of the index: mark and version; the log's identity; where its rows begin and end, each an offset, the number
# of a frame and the checksum before it; the count of its rows. Behind it the columns, and a digest of all.
HEADER = struct.Struct("<8s8sQQ16sQQ16sQ")
MARK = b"\x89ARROW\x01\n"
EVERY = 4096  # rows that are read again rather than kept in a file
LARGEST_INDEX = 2**33  # bytes


class Rows:
    """Which rows a log holds, in order: of each its sequence, offset, size and the first bytes of its key.

    damage: what lies between them, by the count of the rows before it.
    """

    def __init__(self) -> None:
        self.sequences, self.offsets, self.sizes, self.keys = (array("Q") for _ in COLUMNS)
        self.damage: dict[int, list[DamageError]] = {}

    def __len__(self) -> int:
        return len(self.keys)

    def append(self, sequence: int, offset: int, size: int, key: int) -> None:
        """Add a row; key: as of `key_prefix`."""
        for name, value in zip(COLUMNS, (sequence, offset, size, key), strict=True):
            getattr(self, name).append(value)

    def cut(self, count: int) -> None:
        """Keep the first rows alone."""
        for name in COLUMNS:
            del getattr(self, name)[count:]

    def extend(self, rows: Rows) -> None:
        """Add rows behind these."""
        for index, damage in rows.damage.items():
            self.damage.setdefault(len(self) + index, []).extend(damage)
        for name in COLUMNS:
            getattr(self, name).extend(getattr(rows, name))

    def with_key(self, key: bytes) -> list[int]:
        """Return the indices of the rows whose keys begin as this one does."""
        found: list[int] = np.flatnonzero(np.frombuffer(self.keys, np.uint64) == key_prefix(key)).tolist()
        return found

    def take(self, log: LogReader, until: int | None = None) -> Iterator[LogPlace]:
        """Add the rows that follow in a log, up to an offset; yield the place behind each batch. Damage is noted."""
        while True:
            try:
                for batch in log.refresh():
                    for frame in batch:
                        if until is not None and frame.offset >= until:
                            return
                        if frame.kind == ROW:
                            self._take(log, frame)
                    yield log.place
                return
            except DamageError as damage:
                if damage.offset is None:
                    raise  # of the whole file
                noted = self.damage.setdefault(len(self), [])
                if damage.offset in [earlier.offset for earlier in noted]:
                    return  # nothing can be read behind it
                noted.append(damage)
                with suppress(DamageError):
                    log.resume()

    def _take(self, log: LogReader, frame: Frame) -> None:
        try:
            if log.payloads:
                data = log.peek(frame.offset, min(HEAD_BYTES + 8, frame.size))
            else:
                data = head_bytes(log, frame.offset, frame.size)
                verified_size(data, frame.size)
            sequence = row_sequence(data)
            if self.sequences and sequence <= self.sequences[-1]:
                raise ValueError(f"row {sequence} follows row {self.sequences[-1]}")
        except ValueError as error:
            what = f"{log.path} has a frame that is no row (byte {frame.offset}): {error}"
            self.damage.setdefault(len(self), []).append(DamageError(what, path=log.path, offset=frame.offset))
        else:
            self.append(sequence, frame.offset, frame.size, prefix_in(data))


def head_bytes(log: LogReader, offset: int, size: int) -> bytes:
    """Return the bytes of a row without its arrays, not verified; raise ValueError for no row."""
    data = log.peek(offset, min(size, USUAL_HEAD))
    needed = head_size(data, size)
    return data[:needed] if needed <= len(data) else log.peek(offset, needed)


@dataclass(frozen=True)
class _Segment:
    """A file of the index: rows that follow each other, from one place in the log to another."""

    path: Path
    begin: LogPlace
    end: LogPlace
    count: int


class Index:
    """Files in a store's folder `derived` that say which rows are in a log, up to a place; wrong or lost, they are made
    again.

    begin: the place of the first row. Each new file takes in those before it that are not much larger, so that there
    are few, and each row is written a few times.
    """

    def __init__(self, folder: Path, identity: bytes, begin: LogPlace) -> None:
        self._folder, self._identity = folder / DERIVED, identity
        self._segments: list[_Segment] = []
        self.end = begin

    @property
    def count(self) -> int:
        """How many rows it has."""
        return sum(segment.count for segment in self._segments)

    def read(self, log: LogReader, until: int) -> Rows:
        """Return the rows that the files have, none behind an offset, nor what the log never had or has no more."""
        rows = Rows()
        while True:
            path = self._path(self.end)
            try:
                data = read_regular(path, LARGEST_INDEX)
                segment, found = self._decoded(path, data)
            except (DamageError, OSError, ValueError, struct.error) as error:
                if not isinstance(error, FileNotFoundError):
                    logger.info("%s is not used: %s", path, error)
                return rows
            if segment.begin != self.end or segment.end.offset > until or segment.end.offset <= segment.begin.offset:
                return rows
            if not log.has_place(segment.end):  # a copy of the store was put over it, and another way taken
                logger.info("%s is not used: the log has not come that way", path)
                return rows
            rows.extend(found)
            self._segments.append(segment)
            self.end = segment.end

    def _path(self, begin: LogPlace) -> Path:
        return self._folder / f"rows-{begin.number:012d}"

    def _decoded(self, path: Path, data: bytes) -> tuple[_Segment, Rows]:
        data = without_digest(data)
        mark, identity, *places, count = HEADER.unpack_from(data)
        if mark != MARK or identity != self._identity or len(data) != HEADER.size + 32 * count:
            raise ValueError("it is of another log")
        begin, end = (LogPlace(places[i], places[i + 1], places[i + 1], places[i + 2]) for i in (0, 3))
        rows = Rows()
        for i, name in enumerate(COLUMNS):
            getattr(rows, name).frombytes(data[HEADER.size + 8 * count * i : HEADER.size + 8 * count * (i + 1)])
        return _Segment(path, begin, end, count), rows

    def write(self, rows: Rows, end: LogPlace) -> None:
        """Keep the rows, which are all up to a place, where there are enough that are in no file. Raises OSError."""
        if len(rows) - self.count < EVERY or rows.damage:
            return
        first, kept = self.count, list(self._segments)
        begin = self.end
        while kept and kept[-1].count <= 2 * (len(rows) - first):
            begin, first = kept[-1].begin, first - kept.pop().count
        count = len(rows) - first
        places = (begin.offset, begin.number, begin.previous, end.offset, end.number, end.previous)
        columns = (getattr(rows, name)[first:].tobytes() for name in COLUMNS)
        path = self._path(begin)
        write_digested(path, b"".join((HEADER.pack(MARK, self._identity, *places, count), *columns)))
        self._segments, self.end = [*kept, _Segment(path, begin, end, count)], end
        mine = {segment.path for segment in self._segments}
        for entry in self._folder.glob("rows-*"):
            if entry not in mine:
                remove_tree(entry)
