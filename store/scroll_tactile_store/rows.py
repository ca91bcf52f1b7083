"""Which rows a log holds and where, by sequence and by key; a checkpoint keeps it as an array."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import suppress
from typing import Self

import numpy as np

from scroll_tactile_store.exceptions import DamageError
from scroll_tactile_store.framing import Frame
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

__all__ = ["Rows", "head_bytes"]

USUAL_HEAD = 512  # bytes that are read at once of a row's head
COLUMNS = ("sequences", "offsets", "sizes", "keys")


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

    def table(self, last_sequence: int) -> np.ndarray:
        """Return those up to a sequence as an array: the columns, shape (4, rows)."""
        count = bisect_right(self.sequences, last_sequence)
        return np.stack([np.frombuffer(getattr(self, name), np.uint64)[:count] for name in COLUMNS])

    @classmethod
    def of_table(cls, table: np.ndarray, until: int) -> Self:
        """Return the rows of a `table` that lie before an offset. Raises ValueError where that is none."""
        if table.dtype != np.uint64 or table.ndim != 2 or len(table) != len(COLUMNS):
            raise ValueError(f"an index of rows is no array of {table.dtype.str} and shape {table.shape}")
        rows, table = cls(), table[:, table[1] < until]
        for name, column in zip(COLUMNS, table, strict=True):
            getattr(rows, name).frombytes(column.tobytes())
        return rows

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
