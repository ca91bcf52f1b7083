"""Exact second moments of arbitrary doubles: sums of products in as many limbs as the numbers need.

Every column has a unit, a power of two of which all its values so far are whole multiples; a value that needs
a finer one lowers the unit by whole limbs, and the sums are moved up to match. So nothing is ever rounded, and the
sums are a function of the rows alone: any order, batching, merging or number of threads gives the same bytes.
"""

from __future__ import annotations

import functools
import hashlib

import numpy as np
import numpy.typing as npt

from examples.benchmarks.solvers.limbs import (
    EMPTY,
    LIMB,
    LONGEST,
    ROOM,
    carry,
    lowest_bits,
    shifted,
    split,
    split_if_whole,
    total,
)
from scroll_tactile.errors import MismatchError

__all__ = ["WideMoments"]

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]

WAITING = 512  # rows that wait for one product: at one row a time it would be bound by reading and writing the sums
OFFSET = 20  # units are −20 modulo 22, so that 20-bit codes of a unit bound fit one limb


class WideMoments:
    """A = Σ z zᵀ over rows z of doubles, shape (D, D), entry (i, j) in units of 2^(units[i] + units[j]).

    width: D. units: to begin with, shape (D,): a known grid; lowered where a value needs it. EMPTY, the
        default, where nothing is known: the first values decide.
    rows: how many were added.
    """

    def __init__(self, width: int, units: IntArray | None = None) -> None:
        self.width = width
        self.rows = 0
        self._units = np.full(width, EMPTY, dtype=np.int64) if units is None else units.astype(np.int64)
        self._sums = np.zeros((1, width, width), dtype=np.int64)  # A is the mean of it and its transpose
        self._carried = True
        self._load = 0  # no sum's magnitude exceeds this many products of two digits
        self._pairs = 1  # products of limbs that the last rows added to one sum
        self._waiting = np.empty((WAITING, width))
        self._count = 0

    @property
    def carries_at(self) -> int:
        """The number of rows at which sums are carried into wider limbs, if rows go on as the last ones.

        Not carried, an int64 could overflow at four times as many products.
        """
        self.settle()
        return int(self.rows + max(0, ROOM - self._load) // self._pairs)

    @property
    def limbs(self) -> int:
        """In how many limbs the sums are kept at present."""
        self.settle()
        return len(self._sums)

    def add(self, rows: FloatArray) -> None:
        """Add finite rows, shape (n, D); they may wait, and are copied."""
        self.rows += len(rows)
        for first in range(0, len(rows), WAITING):
            part = rows[first : first + WAITING]
            if self._count + len(part) > WAITING:
                self.settle()
            self._waiting[self._count : self._count + len(part)] = part
            self._count += len(part)

    def settle(self) -> None:
        """Bring the rows that wait into the sums."""
        block, self._count = self._waiting[: self._count], 0
        if not len(block):
            return
        known = self._units != EMPTY
        digits = None if block[:, ~known].any() else split_if_whole(block, np.where(known, self._units, 0))
        if digits is None:
            self._lower(lowest_bits(block).min(axis=0))
            digits = split(block, self._units)
        # So few rows at once that all pairs of limbs of one place sum exactly in float64.
        most = max(1, LONGEST // len(digits))
        for some in np.array_split(digits, -(-len(block) // most), axis=1):
            self._add_products(some)

    def _lower(self, lowest: IntArray) -> None:
        """Lower the units until bits of exponent `lowest`, shape (D,), are whole; sums stay what they are."""
        wide = (lowest + OFFSET) // LIMB * LIMB - OFFSET
        fixed = self._units - (self._units - lowest + LIMB - 1) // LIMB * LIMB
        lowered = np.where(lowest >= self._units, self._units, np.where(self._units == EMPTY, wide, fixed))
        by = np.where(self._units == EMPTY, 0, (self._units - lowered) // LIMB)
        self._units = lowered
        if by.any():
            self._carry()
            self._sums = shifted(self._sums, by[:, None] + by)

    def _add_products(self, digits: FloatArray) -> None:
        self._pairs = len(digits)
        if self._load + self._pairs * digits.shape[1] > ROOM:
            self._carry()
        self._load += self._pairs * digits.shape[1]
        self._carried = False
        if len(self._sums) < 2 * len(digits) - 1:
            grown = np.zeros((2 * len(digits) - 1, self.width, self.width), dtype=np.int64)
            grown[: len(self._sums)] = self._sums
            self._sums = grown
        filled = [at for at, digit in enumerate(digits) if digit.any()]
        for place in range(2 * len(digits) - 1):
            pairs = [(low, place - low) for low in filled if low <= place - low and place - low in filled]
            if pairs:
                # A pair and its exchange are each other's transpose: twice the one, until `_carry` makes it symmetric.
                products = (digits[low].T @ ((1 + (low < high)) * digits[high]) for low, high in pairs)
                self._sums[place] += functools.reduce(np.add, products).astype(np.int64)

    def _carry(self) -> None:
        if not self._carried:
            self._sums = carry((self._sums + self._sums.transpose(0, 2, 1)) >> 1)
            self._load = 1
            self._carried = True

    def state(self) -> tuple[IntArray, IntArray]:
        """(sums, units): A in carried limbs, shape (limbs, D, D), and the units, shape (D,). Not to be written to.

        A column of zeros has the unit EMPTY.
        """
        self.settle()
        self._carry()
        return self._sums, self._units

    def digest(self) -> str:
        """Hex of a SHA-256 over the rows' number, the units and all sums: equal if and only if these are."""
        sums, units = self.state()
        digest = hashlib.sha256(repr((self.rows, self.width, len(sums))).encode())
        digest.update(units.astype("<i8").tobytes())
        digest.update(sums.astype("<i8").tobytes())
        return digest.hexdigest()

    def __add__(self, other: WideMoments) -> WideMoments:
        if self.width != other.width:
            raise MismatchError(f"expected moments of {self.width} columns to be added; came {other.width}")
        joint = WideMoments(self.width)
        (ours, units), (theirs, others) = self.state(), other.state()
        joint.rows = self.rows + other.rows
        apart = (units != EMPTY) & (others != EMPTY) & ((units - others) % LIMB != 0)
        if apart.any():
            raise MismatchError(
                f"expected moments on the same grid; column {int(np.flatnonzero(apart)[0])} has units of "
                f"2^{units[apart][0]} and 2^{others[apart][0]}: the bounds that were given differ"
            )
        joint._units = np.minimum(units, others)
        parts = []
        for sums, own in ((ours, units), (theirs, others)):
            by = np.where(own == EMPTY, 0, (own - joint._units) // LIMB)
            parts.append((shifted(sums, by[:, None] + by), 0))
        joint._sums, _ = total(parts)
        joint._load = 1
        return joint
