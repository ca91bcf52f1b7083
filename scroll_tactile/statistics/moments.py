"""The exact second moment of codes, and the scatter within classes formed from it without cancellation."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Iterator

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

    While there are no more rows than features, all rows are kept: they take a fraction of the triangle's bytes on a
    disk. Later rows wait until there are 512 of them, or the triangle is asked for.

    Products are formed by BLAS in float64, of 512 rows at a time: products of integers below 2²¹ and their sums below
    2⁵³ are exact there, in any order and with any number of threads. The triangle is never changed in place: whoever
    has it keeps it as it is.
    """

    def __init__(self, dimension: int) -> None:
        self.dimension = dimension
        self.rows = 0
        self._codes = np.empty((0, dimension), dtype=np.int32)  # the rows that are kept, with room for more
        self._kept = 0
        self._all = True  # whether these are all rows
        self._packed: IntArray | None = None  # the triangle of all rows but those kept behind the first `_formed`
        self._formed = 0

    @classmethod
    def of(cls, packed: IntArray, rows: int, dimension: int) -> SecondMoment:
        """A second moment of a given lower triangle, which it takes over, and number of rows."""
        made = cls(dimension)
        made.rows, made._packed, made._all = rows, packed, False
        return made

    @classmethod
    def of_codes(cls, codes: Codes, dimension: int) -> SecondMoment:
        """A second moment of given rows, (rows, d), at most d, which it takes over."""
        made = cls(dimension)
        made._codes, made.rows, made._kept = codes, len(codes), len(codes)
        return made

    def add(self, codes: Codes) -> None:
        """Add rows of codes, shape (rows, d). Raises CapacityError before anything is added."""
        require_room(self.rows, len(codes))
        for first in range(0, len(codes), BLOCK):
            block = codes[first : first + BLOCK]
            self._all = self._all and self.rows + len(block) <= self.dimension
            if not self._all and self._kept + len(block) > BLOCK:
                self.packed()
            last = self._kept + len(block)
            if last > len(self._codes):
                longer = np.empty((max(2 * self._kept, last, FIRST), self.dimension), np.int32)
                longer[: self._kept] = self._codes[: self._kept]
                self._codes = longer
            self._codes[self._kept : last] = block
            self._kept = last
            self.rows += len(block)

    def remove(self, codes: Codes) -> None:
        """Take rows out again that were added, shape (rows, d): as if they had never been."""
        left = _without(self._codes[: self._kept], codes) if self._all else None
        packed = None
        if left is None or self._packed is not None:
            packed = self.packed().copy()
            _add_products(packed, codes, np.subtract)
        self._take(packed, left)
        self.rows -= len(codes)

    def _take(self, packed: IntArray | None, codes: Codes | None) -> None:
        """Keep this triangle, and these rows, all that it is of; None for rows that are not there any more."""
        rows = np.empty((0, self.dimension), dtype=np.int32) if codes is None else codes
        kept, formed = len(rows), 0 if packed is None else len(rows)
        # At once: whoever only reads forms products, too, and ctrl-C there must not lose the rows.
        self.__dict__.update(_all=codes is not None, _codes=rows, _packed=packed, _kept=kept, _formed=formed)

    def packed(self) -> IntArray:
        """The lower triangle of A as it is now, row after row, shape (d·(d+1)/2,): not to be changed."""
        if self._packed is None or self._formed < self._kept:
            size = self.dimension * (self.dimension + 1) // 2
            packed = np.zeros(size, np.int64) if self._packed is None else self._packed.copy()
            _add_products(packed, self._codes[self._formed : self._kept], np.add)
            self._take(packed, self._codes[: self._kept] if self._all else None)
            return packed
        return self._packed

    def codes(self) -> Codes | None:
        """All rows, (rows, d), in an order that does not depend on the one they came in; None where they are not there.

        Not to be changed.
        """
        rows = self._codes[: self._kept]
        return rows[sorted(range(len(rows)), key=[row.tobytes() for row in rows].__getitem__)] if self._all else None

    def copy(self) -> SecondMoment:
        """One that changes independently; the triangle is of both until it changes."""
        other = copy.copy(self)
        other._codes = self._codes[: self._kept].copy()
        return other

    def joined(self, other: SecondMoment, sign: int) -> SecondMoment:
        """This one and another; with a sign of −1 this one without the other."""
        rows, ours, theirs = self.rows + sign * other.rows, self.codes(), other.codes()
        if ours is not None and theirs is not None and rows <= self.dimension:
            both = np.concatenate([ours, theirs]) if sign > 0 else _without(ours, theirs)
            if both is not None:
                return SecondMoment.of_codes(both, self.dimension)
        return SecondMoment.of(self.packed() + sign * other.packed(), rows, self.dimension)


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
