"""The exact second moment of codes, and the scatter within classes formed from it without cancellation."""

from __future__ import annotations

import copy
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from scroll_tactile.blas import one_thread
from scroll_tactile.errors import CapacityError
from scroll_tactile.statistics.grid import BITS, mean_code

__all__ = ["MOST_ROWS", "Codes", "SecondMoment", "Sums", "one_thread", "require_room", "within_scatter"]

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]
Codes = npt.NDArray[np.int32]
Sums = npt.NDArray[np.int32] | IntArray

MOST_ROWS = 2 ** (63 - 2 * BITS) - 1  # with one row more an entry could pass int64: 8 388 607
BLOCK = 512  # rows whose product is packed at once; below 2¹³ it is exact in float64
FIRST = 64  # rows that there is room for at once
LIMB = 22  # bits
ROWS = 128  # of a product that are formed at once: the whole of one is 8 MB


def _rows_of_triangle(dimension: int) -> Iterator[tuple[int, slice]]:
    """Each row of a lower triangle, and where it lies where they are packed one after another."""
    first = 0
    for row in range(dimension):
        yield row, slice(first, first + row + 1)
        first += row + 1


def require_room(rows: int, more: int) -> None:
    """Raise CapacityError where a sum over `rows` rows and `more` of them might not be exact."""
    if rows + more > MOST_ROWS:
        raise CapacityError(
            f"int64 sums of {BITS}-bit codes are exact for {MOST_ROWS} rows; there are {rows} and {more} came. "
            "Start a new memory"
        )


class SecondMoment:
    """A = Σ x xᵀ over rows of codes, as exact int64; the lower triangle is asked for, row after row.

    While there are no more rows than features, the rows themselves are kept (`_Rows`): they say what A is in half the
    numbers or less, and take a fraction of its bytes on a disk. From then on the triangle is kept (`_Triangle`).

    Products are formed by BLAS in float64, of 512 rows at a time: products of integers below 2²¹ and their sums below
    2⁵³ are exact there, in any order and with any number of threads. The triangle is never changed in place: whoever
    has it keeps it as it is, and what is cut short by ctrl-C has changed nothing.
    """

    def __init__(self, dimension: int, rows: int = 0, kept: _Rows | _Triangle | None = None) -> None:
        self.dimension = dimension
        self.rows = rows
        self._kept: _Rows | _Triangle = _Rows(dimension) if kept is None else kept

    @classmethod
    def of(cls, packed: IntArray | Callable[[], IntArray], rows: int, dimension: int) -> SecondMoment:
        """A second moment of a given lower triangle, which it takes over, and number of rows.

        packed: or what reads the triangle, called when it is needed, and again where that failed.
        """
        return cls(dimension, rows, _Triangle(dimension, packed))

    @classmethod
    def of_codes(cls, codes: Codes | Callable[[], Codes], rows: int, dimension: int) -> SecondMoment:
        """A second moment of given rows, at most `dimension`, which it takes over; or of what reads them (see `of`)."""
        return cls(dimension, rows, _Rows(dimension, codes))

    def add(self, codes: Codes) -> None:
        """Add rows of codes, shape (rows, d). Raises CapacityError before anything is added."""
        require_room(self.rows, len(codes))
        for first in range(0, len(codes), BLOCK):
            block = codes[first : first + BLOCK]
            if isinstance(self._kept, _Rows) and self.rows + len(block) > self.dimension:
                self._kept = _Triangle(self.dimension, self._kept.packed())
            self._kept.add(block)
            self.rows += len(block)

    def remove(self, codes: Codes) -> None:
        """Take rows out again that were added, shape (rows, d): as if they had never been."""
        self._kept = self._kept.without(codes)
        self.rows -= len(codes)

    def packed(self) -> IntArray:
        """The lower triangle of A as it is now, row after row, shape (d·(d+1)/2,): not to be changed."""
        return self._kept.packed()

    def codes(self) -> Codes | None:
        """All rows, (rows, d), in an order that does not depend on the one they came in; None where they are not there.

        Not to be changed.
        """
        return self._kept.codes() if isinstance(self._kept, _Rows) else None

    def copy(self) -> SecondMoment:
        """One that changes independently; a triangle is of both until it changes."""
        return SecondMoment(self.dimension, self.rows, self._kept.copy())

    def joined(self, other: SecondMoment, sign: int) -> SecondMoment:
        """This one and another; with a sign of −1 this one without the other."""
        rows, ours, theirs = self.rows + sign * other.rows, self.codes(), other.codes()
        if ours is not None and theirs is not None and rows <= self.dimension:
            both = np.concatenate([ours, theirs]) if sign > 0 else _without(ours, theirs)
            if both is not None:
                return SecondMoment.of_codes(both, rows, self.dimension)
        return SecondMoment.of(self.packed() + sign * other.packed(), rows, self.dimension)


T = TypeVar("T", bound=npt.NDArray[np.integer])


class _Late(Generic[T]):
    """Codes or a triangle, read when they are first needed: once for all copies, of whatever thread.

    What reads them has one place in one file, and two threads would move it.
    """

    def __init__(self, read: Callable[[], T]) -> None:
        self._read, self._lock = read, threading.Lock()
        self._found: T | None = None

    def __call__(self) -> T:
        with self._lock:
            if self._found is None:
                self._found = self._read()
            return self._found

    def __deepcopy__(self, memo: object) -> _Late[T]:
        return self


class _Rows:
    """All rows of a second moment, at most as many as features, with room for more; read when they are first needed."""

    def __init__(self, dimension: int, codes: Codes | Callable[[], Codes] | None = None) -> None:
        self._dimension = dimension
        self._late = _Late(codes) if callable(codes) else None
        self._codes = np.empty((0, dimension), dtype=np.int32) if codes is None or callable(codes) else codes
        self._count = len(self._codes)
        self._packed: IntArray | None = None
        self._formed = 0  # of the rows, in the triangle

    def copy(self) -> _Rows:
        """The same rows, with room of their own."""
        other = copy.copy(self)
        other._codes = self._codes.copy()
        return other

    def add(self, codes: Codes) -> None:
        """Add rows."""
        last = self._count + len(codes)
        self._codes = _with_room(self._codes, self._count, last, self._dimension)
        self._codes[self._count : last] = codes
        self._count = last

    def _read(self) -> Codes:
        """The rows that are there, read where that was left for later."""
        if self._late is not None:
            rows = np.concatenate([self._late().astype(np.int32, copy=False), self._codes[: self._count]])
            self._codes, self._count, self._late = rows, len(rows), None
        return self._codes[: self._count]

    def packed(self) -> IntArray:
        """The lower triangle."""
        rows = self._read()
        if self._packed is None or self._formed < len(rows):
            size = self._dimension * (self._dimension + 1) // 2
            packed = np.zeros(size, np.int64) if self._packed is None else self._packed.copy()
            _add_products(packed, rows[self._formed :], np.add)
            self._packed, self._formed = packed, len(rows)
        return self._packed

    def codes(self) -> Codes:
        """The rows in the order of their bytes."""
        rows = self._read()
        return rows[sorted(range(len(rows)), key=[row.tobytes() for row in rows].__getitem__)]

    def without(self, codes: Codes) -> _Rows | _Triangle:
        """The same without some rows; of rows that are not all there the sums that are left."""
        left = _without(self.codes(), codes)
        if left is not None and self._packed is None:
            return _Rows(self._dimension, left)
        packed = self.packed().copy()
        _add_products(packed, codes, np.subtract)
        if left is None:
            return _Triangle(self._dimension, packed)
        rows = _Rows(self._dimension, left)
        rows._packed, rows._formed = packed, len(left)
        return rows


class _Triangle:
    """The lower triangle of a second moment, and a block of at most 512 rows that waits to be added to it."""

    def __init__(self, dimension: int, packed: IntArray | Callable[[], IntArray]) -> None:
        self._dimension, self._packed = dimension, _Late(packed) if callable(packed) else packed
        self._waiting = np.empty((0, dimension), dtype=np.int32)
        self._count = 0  # of rows that wait

    def copy(self) -> _Triangle:
        """The same triangle, with rows of its own that wait."""
        other = copy.copy(self)
        other._waiting = self._waiting.copy()
        return other

    def add(self, codes: Codes) -> None:
        """Add at most 512 rows."""
        if self._count + len(codes) > BLOCK:
            self.packed()
        last = self._count + len(codes)
        self._waiting = _with_room(self._waiting, self._count, last, BLOCK)
        self._waiting[self._count : last] = codes
        self._count = last

    def packed(self) -> IntArray:
        """The lower triangle, with all rows that waited."""
        packed = self._packed().astype(np.int64, copy=False) if callable(self._packed) else self._packed
        if self._count:
            packed = packed.copy()
            _add_products(packed, self._waiting[: self._count], np.add)
        self._packed, self._waiting, self._count = packed, self._waiting[:0], 0
        return packed

    def without(self, codes: Codes) -> _Triangle:
        """The same without some rows."""
        packed = self.packed().copy()
        _add_products(packed, codes, np.subtract)
        return _Triangle(self._dimension, packed)


def _with_room(codes: Codes, count: int, needed: int, most: int) -> Codes:
    """The first rows, so many, with room for those that are needed: twice as many at once, but no more than `most`."""
    if len(codes) >= needed:
        return codes
    longer = np.empty((min(most, max(2 * count, needed, FIRST)), codes.shape[1]), np.int32)
    longer[:count] = codes[:count]
    return longer


def _without(rows: Codes, gone: Codes) -> Codes | None:
    """Rows without some of them; None where they are not all there."""
    left = Counter(row.tobytes() for row in gone.astype(np.int32, copy=False))
    stay = []
    for place, row in enumerate(rows):
        if left[key := row.tobytes()]:
            left[key] -= 1
        else:
            stay.append(place)
    return None if +left else rows[stay]


def _add_products(packed: IntArray, codes: Codes, put: np.ufunc) -> None:
    """Add the lower triangle of codesᵀ · codes to `packed`, exact; or, with np.subtract for `put`, take it out."""
    places = list(_rows_of_triangle(codes.shape[1]))
    for begin in range(0, len(codes), BLOCK):
        rows = codes[begin : begin + BLOCK].astype(np.float64)
        for first in range(0, len(places), ROWS):
            last = min(first + ROWS, len(places))
            with one_thread():
                product = (rows[:, first:last].T @ rows[:, :last]).astype(np.int64)
            for row, place in places[first:last]:
                put(packed[place], product[row - first, : row + 1], out=packed[place])


def within_scatter(packed: IntArray, counts: IntArray, sums: Sums) -> FloatArray:
    """S_w = A − Σ_y c_y c_yᵀ / n_y, shape (d, d), in units of codes²: the lower triangle.

    What stands above the diagonal means nothing. packed: A as in SecondMoment; counts: n_y > 0, shape (C,); sums: c_y,
    shape (C, d). With m_y the integer next to c_y / n_y and r_y = c_y − n_y m_y,
    c_y c_yᵀ / n_y = c_y m_yᵀ + m_y r_yᵀ + r_y r_yᵀ / n_y. The first two are integers and leave A exactly; what is
    rounded is the scatter itself, whatever the distance of the means from zero.
    """
    # So many classes at once that products of their sums and means stay below 2⁵³; of large sums, in two limbs.
    largest = int(np.abs(sums).max(initial=1))
    together = min(1024, 2 ** (53 - BITS) // largest)
    limbs, together = (False, together) if together >= 64 else (True, 1024)
    dimension = sums.shape[1]
    scatter = np.zeros((dimension, dimension))  # first of the rests alone
    places = list(_rows_of_triangle(dimension))
    blocks = [(first, min(first + ROWS, dimension)) for first in range(0, dimension, ROWS)]
    centred = [np.zeros((last - first, last), dtype=np.int64) for first, last in blocks]
    for (first, last), block in zip(blocks, centred, strict=True):
        for row, place in places[first:last]:
            block[row - first, : row + 1] = packed[place]
    for begin in range(0, len(counts), together):
        rows, total = counts[begin : begin + together, None], sums[begin : begin + together].astype(np.int64)
        means = mean_code(total, rows)
        rest = (total - rows * means).astype(np.float64)
        high = (total >> LIMB).astype(np.float64) if limbs else None
        low = (total - (total >> LIMB << LIMB) if limbs else total).astype(np.float64)
        mean, root = means.astype(np.float64), np.sqrt(rows)
        with one_thread():
            for i, (first, last) in enumerate(blocks):
                if high is not None:
                    centred[i] -= (high[:, first:last].T @ mean[:, :last]).astype(np.int64) << LIMB
                centred[i] -= (low[:, first:last].T @ mean[:, :last]).astype(np.int64)
                centred[i] -= (mean[:, first:last].T @ rest[:, :last]).astype(np.int64)
                scatter[first:last, :last] += (rest[:, first:last] / root).T @ (rest[:, :last] / root)
    for (first, last), block in zip(blocks, centred, strict=True):
        np.subtract(block, scatter[first:last, :last], out=scatter[first:last, :last])
    return scatter
