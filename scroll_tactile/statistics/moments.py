"""The exact second moment of codes, and the scatter within classes formed from it without cancellation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

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
MANY = 1024  # classes
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
    """A = Σ x xᵀ over rows of codes, as exact int64; the lower triangle is kept, row after row.

    While there are no more rows than features, they are kept themselves: they say what A is in half the numbers or
    less, and take a fraction of its bytes on a disk. The triangle is formed when it is asked for. Of more rows a block
    of at most 512 waits to be added to it.

    Products are formed by BLAS in float64, of 512 rows at a time: products of integers below 2²¹ and their sums below
    2⁵³ are exact there, in any order and with any number of threads. The triangle is never changed in place: whoever
    has it keeps it as it is, and what is cut short by ctrl-C has changed nothing.
    """

    def __init__(self, dimension: int) -> None:
        self.dimension = dimension
        self.rows = 0
        self._packed: IntArray | None = None
        self._whole = True  # whether all rows are there
        self._late: Callable[[], IntArray | Codes] | None = None  # the first rows where it is whole, or the triangle
        self._codes: Codes | None = None
        self._count = 0  # of rows there
        self._formed = 0  # of them, in the triangle

    def add(self, codes: Codes) -> None:
        """Add rows of codes, shape (rows, d). Raises CapacityError before anything is added."""
        require_room(self.rows, len(codes))
        for first in range(0, len(codes), BLOCK):
            block = codes[first : first + BLOCK]
            if self._whole and self.rows + len(block) > self.dimension:
                self._give_up_rows()
            self._wait(block)
            self.rows += len(block)

    def _give_up_rows(self) -> None:
        packed = self.packed()
        self._packed, self._whole, self._codes, self._count, self._formed = packed, False, None, 0, 0

    def _wait(self, codes: Codes) -> None:
        if not self._whole and self._count + len(codes) > BLOCK:
            self._form()
        last = self._count + len(codes)
        if self._codes is None or len(self._codes) < last:
            most = self.dimension if self._whole else BLOCK
            longer = np.empty((min(most, max(2 * self._count, last, FIRST)), self.dimension), dtype=np.int32)
            if self._codes is not None:
                longer[: self._count] = self._codes[: self._count]
            self._codes = longer
        self._codes[self._count : last] = codes
        self._count = last

    def remove(self, codes: Codes) -> None:
        """Take rows out again that were added, shape (rows, d): as if they had never been."""
        own = self.codes()
        left = None if own is None else _without(own, codes)
        packed = self._packed
        if packed is not None or left is None:
            packed = self.packed().copy()
            for first in range(0, len(codes), BLOCK):
                _add_product(packed, codes[first : first + BLOCK], np.subtract)
        count = 0 if left is None else len(left)
        self._packed, self._whole, self._codes, self._count = packed, left is not None, left, count
        self._formed, self.rows = 0 if packed is None else count, self.rows - len(codes)

    def _read(self) -> None:
        """Read what was left for later."""
        if self._late is None:
            return
        found = self._late()
        if self._whole:
            rows = np.concatenate([found.astype(np.int32, copy=False), *self._there()])
            self._codes, self._count, self._late = rows, len(rows), None
        else:
            self._packed, self._late = found.astype(np.int64, copy=False), None

    def _there(self) -> list[Codes]:
        return [] if self._codes is None else [self._codes[: self._count]]

    def _form(self) -> None:
        """Add the rows that are not in the triangle to it."""
        self._read()
        packed = self._packed
        if packed is None:
            packed = np.zeros(self.dimension * (self.dimension + 1) // 2, dtype=np.int64)
        for rows in self._there():
            packed = packed.copy() if packed is self._packed and len(rows) > self._formed else packed
            for first in range(self._formed, len(rows), BLOCK):
                _add_product(packed, rows[first : first + BLOCK], np.add)
        if self._whole:
            self._packed, self._formed = packed, self._count
        else:
            self._packed, self._codes, self._count = packed, None, 0

    def packed(self) -> IntArray:
        """The lower triangle of A as it is now, row after row, shape (d·(d+1)/2,): not to be changed."""
        self._form()
        assert self._packed is not None
        return self._packed

    def codes(self) -> Codes | None:
        """All rows, (rows, d), in an order that does not depend on the one they came in; None where they are not there.

        Not to be changed.
        """
        if not self._whole:
            return None
        self._read()
        rows = np.concatenate([np.zeros((0, self.dimension), dtype=np.int32), *self._there()])
        return rows[sorted(range(len(rows)), key=[row.tobytes() for row in rows].__getitem__)]

    def undo(self) -> Callable[[], None]:
        """What takes the next `add` back, however much of it was done; it can be called again."""
        state = self._packed, self._whole, self._late, self._codes, self._count, self._formed, self.rows

        def undo() -> None:
            self._packed, self._whole, self._late, self._codes, self._count, self._formed, self.rows = state

        return undo

    @property
    def empty(self) -> bool:
        """Whether no row was ever added; then `packed` would only make zeros."""
        return self._packed is None and self._late is None and not self._count

    @classmethod
    def of(cls, packed: IntArray | Callable[[], IntArray], rows: int, dimension: int) -> SecondMoment:
        """A second moment of a given lower triangle, which it takes over, and number of rows.

        packed: or what reads the triangle, called when it is needed, and again where that failed.
        """
        moment = cls(dimension)
        moment.rows, moment._whole = rows, False
        if callable(packed):
            moment._late = packed
        else:
            moment._packed = packed
        return moment

    @classmethod
    def of_codes(cls, codes: Codes | Callable[[], Codes], rows: int, dimension: int) -> SecondMoment:
        """A second moment of given rows, at most `dimension`, which it takes over; or of what reads them (see `of`)."""
        moment = cls(dimension)
        moment.rows = rows
        if callable(codes):
            moment._late = codes
        else:
            moment._codes, moment._count = codes, rows
        return moment

    def joined(self, other: SecondMoment, sign: int) -> SecondMoment:
        """This one and another; with a sign of −1 this one without the other."""
        rows = self.rows + sign * other.rows
        if self._whole and other._whole and rows <= self.dimension:
            ours, theirs = self.codes(), other.codes()
            assert ours is not None
            assert theirs is not None
            both = np.concatenate([ours, theirs]) if sign > 0 else _without(ours, theirs)
            if both is not None:
                return SecondMoment.of_codes(both, rows, self.dimension)
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


def _add_product(packed: IntArray, codes: npt.NDArray[np.int32], put: np.ufunc) -> None:
    """Add the lower triangle of codesᵀ · codes to `packed`, exact; or, with np.subtract for `put`, take it out."""
    rows = codes.astype(np.float64)
    places = list(_rows_of_triangle(codes.shape[1]))
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
    # The whole square, of which half is waste: gathering the triangle of each product took three times as long.
    dimension = sums.shape[1]
    if len(counts) <= MANY:
        return _exactly(packed, counts, sums)
    centred = np.zeros((dimension, dimension), dtype=np.int64)
    for row, place in _rows_of_triangle(dimension):
        centred[row, : row + 1] = packed[place]
    rounded = np.zeros((dimension, dimension))
    _take_about_the_mean(centred, rounded, counts, sums)
    rounded *= -1.0
    rounded += centred
    return rounded


def _exactly(packed: IntArray, counts: IntArray, sums: Sums) -> FloatArray:
    """The scatter, block of rows after block: of the whole square every step would take 8 MB more."""
    # So many classes at once that products of their sums and means stay below 2⁵³; of large sums, in two limbs.
    largest = int(np.abs(sums).max(initial=1))
    together = min(1024, 2 ** (53 - BITS) // largest)
    limbs, together = (False, together) if together >= 64 else (True, 1024)
    parts = []
    for first in range(0, len(counts), together):
        rows, total = counts[first : first + together, None], sums[first : first + together].astype(np.int64)
        means = mean_code(total, rows)
        rest = (total - rows * means).astype(np.float64)
        high = (total >> LIMB).astype(np.float64) if limbs else None
        low = (total - (total >> LIMB << LIMB) if limbs else total).astype(np.float64)
        parts.append((high, low, means.astype(np.float64), rest, np.sqrt(rows)))
    dimension = sums.shape[1]
    scatter = np.zeros((dimension, dimension))
    places = list(_rows_of_triangle(dimension))
    with one_thread():
        for first in range(0, dimension, ROWS):
            last = min(first + ROWS, dimension)
            centred, rounded = np.zeros((last - first, last), dtype=np.int64), np.zeros((last - first, last))
            for row, place in places[first:last]:
                centred[row - first, : row + 1] = packed[place]
            for high, low, mean, rest, root in parts:
                if high is not None:
                    centred -= (high[:, first:last].T @ mean[:, :last]).astype(np.int64) << LIMB
                centred -= (low[:, first:last].T @ mean[:, :last]).astype(np.int64)
                centred -= (mean[:, first:last].T @ rest[:, :last]).astype(np.int64)
                rounded += (rest[:, first:last] / root).T @ (rest[:, :last] / root)
            np.subtract(centred, rounded, out=scatter[first:last, :last])
    return scatter


def _take_about_the_mean(centred: IntArray, rounded: FloatArray, counts: IntArray, sums: Sums) -> None:
    """Move `centred` to the integer g next to the mean of all, exactly; add Σ_y n_y (m_y − g)(m_y − g)ᵀ to `rounded`.

    A product of half the operations in place of two: of ten thousand classes a second less for each scale. What is
    lost is the digits by which the scatter between classes exceeds that within, and not those of the mean.
    """
    total, rows = sums.sum(axis=0, dtype=np.int64), int(counts.sum())
    mean = mean_code(total, rows)
    centred -= np.outer(total, mean) + np.outer(mean, total - rows * mean)
    with one_thread():
        for first in range(0, len(counts), 1024):
            block = counts[first : first + 1024, None]
            apart = (sums[first : first + 1024] - block * mean).astype(np.float64)
            apart /= np.sqrt(block)
            rounded += apart.T @ apart
