"""The readings of a live session: the last few seconds, and those of the touch under way."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["Recent", "Rows"]

Array = npt.NDArray[Any]


class Recent:
    """The last readings, in a ring of so many. shape, dtype: of a reading."""

    def __init__(self, count: int, shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._ring: Array = np.empty((count, *shape), dtype)
        self._came = 0

    def add(self, rows: Array) -> None:
        """Add readings (k, …)."""
        ring, count = self._ring, len(self._ring)
        place = self._came % count
        self._came += len(rows)
        if len(rows) > count:
            rows, place = rows[-count:], self._came % count
        before_edge = min(len(rows), count - place)
        ring[place : place + before_edge] = rows[:before_edge]
        ring[: len(rows) - before_edge] = rows[before_edge:]

    def clear(self) -> None:
        """Forget them."""
        self._came = 0

    def last(self, wanted: int) -> Array:
        """The last so many, or as many as there are, in their order."""
        count = len(self._ring)
        wanted = min(wanted, self._came, count)
        return self._ring[np.arange(self._came - wanted, self._came) % count]


class Rows:
    """The readings of a touch, up to a limit; those beyond it are counted."""

    def __init__(self, first: Array, limit: int) -> None:
        self._room: Array = np.empty((max(64, 2 * len(first)), *first.shape[1:]), first.dtype)
        self._limit = limit
        self.kept = self.came = 0
        self.add(first)

    def add(self, rows: Array) -> None:
        """Add readings (k, …), as far as there is room within the limit."""
        self.came += len(rows)
        kept = min(self.kept + len(rows), self._limit)
        if kept > len(self._room):
            room = np.empty((max(2 * len(self._room), kept), *self._room.shape[1:]), self._room.dtype)
            room[: self.kept] = self._room[: self.kept]
            self._room = room
        self._room[self.kept : kept] = rows[: kept - self.kept]
        self.kept = kept

    def drop(self, count: int) -> None:
        """Take the last so many out again."""
        self.came -= count
        self.kept = min(self.kept, self.came)

    def first(self, count: int) -> Array:
        """The first so many, to be read."""
        return self._room[: min(count, self.kept)]
