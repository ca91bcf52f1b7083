"""The exact second moment of codes, and the scatter within classes formed from it without cancellation."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from scroll_tactile.blas import one_thread
from scroll_tactile.errors import CapacityError
from scroll_tactile.statistics.grid import BITS, mean_code

__all__ = ["MOST_ROWS", "SecondMoment", "Sums", "one_thread", "require_room", "within_scatter"]

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]
Sums = npt.NDArray[np.int32] | IntArray

MOST_ROWS = 2 ** (63 - 2 * BITS) - 1  # with one row more an entry could pass int64: 8 388 607
BLOCK = 512  # rows that wait; below 2¹³ their product is exact in float64, and it is packed once for all of them
FIRST = 64  # of them that there is room for at once
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

    Rows wait in a block of at most 512, whose product is formed by BLAS in float64: products of integers below
    2²¹ and their sums below 2⁵³ are exact there, in any order and with any number of threads. The triangle is never
    changed in place: whoever has it keeps it as it is, and what is cut short by ctrl-C has changed nothing.
    """

    def __init__(self, dimension: int) -> None:
        self.dimension = dimension
        self.rows = 0
        self._packed: IntArray | None = None
        self._late: Callable[[], IntArray] | None = None
        self._waiting: npt.NDArray[np.int32] | None = None
        self._count = 0

    def add(self, codes: npt.NDArray[np.int32]) -> None:
        """Add rows of codes, shape (rows, d). Raises CapacityError before anything is added."""
        require_room(self.rows, len(codes))
        for first in range(0, len(codes), BLOCK):
            self._wait(codes[first : first + BLOCK])
        self.rows += len(codes)

    def _wait(self, codes: npt.NDArray[np.int32]) -> None:
        if self._count + len(codes) > BLOCK:
            self._flush()
        last = self._count + len(codes)
        if self._waiting is None or len(self._waiting) < last:
            longer = np.empty((min(BLOCK, max(2 * self._count, last, FIRST)), self.dimension), dtype=np.int32)
            if self._waiting is not None:
                longer[: self._count] = self._waiting[: self._count]
            self._waiting = longer
        self._waiting[self._count : last] = codes
        self._count = last

    def remove(self, codes: npt.NDArray[np.int32]) -> None:
        """Take rows out again that were added, shape (rows, d): as if they had never been."""
        packed = self.packed().copy()
        for first in range(0, len(codes), BLOCK):
            _add_product(packed, codes[first : first + BLOCK], np.subtract)
        self._packed, self.rows = packed, self.rows - len(codes)

    def _flush(self) -> None:
        if self._late is not None:
            self._packed, self._late = self._late(), None
        packed = self._packed
        if packed is None:
            packed = np.zeros(self.dimension * (self.dimension + 1) // 2, dtype=np.int64)
        if self._count:
            assert self._waiting is not None
            packed = packed.copy() if packed is self._packed else packed
            _add_product(packed, self._waiting[: self._count], np.add)
        self._packed, self._waiting, self._count = packed, None, 0

    def packed(self) -> IntArray:
        """The lower triangle of A as it is now, row after row, shape (d·(d+1)/2,): not to be changed."""
        self._flush()
        assert self._packed is not None
        return self._packed

    def undo(self) -> Callable[[], None]:
        """What takes the next `add` back, however much of it was done; it can be called again."""
        state = self._packed, self._late, self._waiting, self._count, self.rows

        def undo() -> None:
            self._packed, self._late, self._waiting, self._count, self.rows = state

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
        moment.rows = rows
        if callable(packed):
            moment._late = packed
        else:
            moment._packed = packed
        return moment


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
