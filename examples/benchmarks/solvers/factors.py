"""Factorisations of an integer system, ever more precise: what refinement begins with and corrects with.

Each raises NotDefiniteError where its precision cannot tell the matrix from one that is not positive definite. All
work on the matrix as `IntegerSystem.scaled` gives it, with a diagonal near 1, and on right-hand sides scaled to match.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from scipy.linalg.lapack import dpotrf, dpotrs

from examples.benchmarks.solvers.limbs import to_float, to_integers
from examples.benchmarks.solvers.systems import IntegerSystem, times_power
from scroll_tactile.statistics.moments import one_thread

__all__ = ["Factor", "FixedFactor", "FloatFactor", "LongFactor", "NotDefiniteError", "factors"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

NOTHING = -(2**20)  # the length in bits of zero: below that of any number
MOST_BITS = 2**13  # of a fixed-point factorisation; doubles span 2¹¹, and the sums of their products 2¹²


class NotDefiniteError(ArithmeticError):
    """A pivot was not positive: the matrix is not positive definite to this precision."""


class Factor(Protocol):
    """A factorisation of a scaled matrix; `name` says in what arithmetic."""

    name: str

    def solve(self, right: FloatArray) -> FloatArray:
        """The solution for right-hand sides of shape (d, C), of magnitudes near 1; same shape."""
        ...

    def correct(self, rest: IntArray, exponents: IntArray) -> FloatArray:
        """The solution for exact right-hand sides, in parts that are to be added, shape (parts, d, C).

        rest: in carried limbs, shape (limbs, d, C), each integer to be multiplied by 2^exponents, shape (d, C).
        """
        ...


def factors(system: IntegerSystem) -> Iterator[Factor]:
    """Factorisations of a system, each more precise than the one before; those that fail are left out."""
    kinds: list[Any] = [FloatFactor]
    if np.finfo(np.longdouble).nmant > np.finfo(np.float64).nmant:
        kinds.append(LongFactor)
    bits = 128
    while bits <= MOST_BITS:
        kinds.append(lambda of, bits=bits: FixedFactor(of, bits))
        bits *= 2
    for kind in kinds:
        try:
            yield kind(system)
        except NotDefiniteError:
            continue


class FloatFactor:
    """Cholesky's U'U = A in float64, by LAPACK."""

    name = "float64"

    def __init__(self, system: IntegerSystem) -> None:
        with one_thread():
            self._factor, failed = dpotrf(system.scaled, lower=0)
        if failed or not np.isfinite(np.diagonal(self._factor)).all():
            raise NotDefiniteError

    def solve(self, right: FloatArray) -> FloatArray:
        """The solution for right-hand sides of shape (d, C)."""
        with one_thread():
            found: FloatArray = dpotrs(self._factor, right, lower=0)[0]
        return found

    def correct(self, rest: IntArray, exponents: IntArray) -> FloatArray:
        """The solution for exact right-hand sides, in one part, shape (1, d, C)."""
        value, exponent = to_float(rest)
        return self.solve(times_power(value, exponent + exponents))[None]


class LongFactor:
    """Cholesky's L L' = A in long doubles: 64 bits where the processor has them (x86), else not tried.

    Column k of L is (a_k − L_k l_k) / √pivot, with L_k the columns before it and l_k the row k of these.
    """

    name = "long double"

    def __init__(self, system: IntegerSystem) -> None:
        matrix = system.scaled_as(np.longdouble)
        factor = np.zeros_like(matrix)
        for k in range(len(matrix)):
            column = matrix[k:, k] - factor[k:, :k] @ factor[k, :k]
            if not column[0] > 0:
                raise NotDefiniteError
            factor[k:, k] = column / np.sqrt(column[0])
        self._factor = factor

    def _solve(self, right: npt.NDArray[np.longdouble]) -> npt.NDArray[np.longdouble]:
        lower, found = self._factor, right.copy()
        for k in range(len(lower)):
            found[k] = (found[k] - lower[k, :k] @ found[:k]) / lower[k, k]
        for k in range(len(lower) - 1, -1, -1):
            found[k] = (found[k] - lower[k + 1 :, k] @ found[k + 1 :]) / lower[k, k]
        return found

    def solve(self, right: FloatArray) -> FloatArray:
        """The solution for right-hand sides of shape (d, C)."""
        return self._solve(right.astype(np.longdouble)).astype(np.float64)

    def correct(self, rest: IntArray, exponents: IntArray) -> FloatArray:
        """The solution for exact right-hand sides, in two parts, shape (2, d, C)."""
        value, exponent = to_float(rest, np.longdouble)
        found = self._solve(times_power(value, exponent + exponents))
        first = found.astype(np.float64)
        return np.stack([first, (found - first).astype(np.float64)])


class FixedFactor:
    """L D L' = A in fixed-point integers with so many bits behind the point, Python's: as precise as is asked for."""

    def __init__(self, system: IntegerSystem, bits: int) -> None:
        self.name = f"{bits} bits"
        self._bits = bits
        matrix = system.fixed(bits)
        size = len(matrix)
        self._lower = np.zeros((size, size), dtype=object)
        self._pivots = np.zeros(size, dtype=object)
        for k in range(size):
            before = (self._lower[k, :k] * self._pivots[:k]) >> bits
            column = matrix[k:, k] - ((self._lower[k:, :k] @ before) >> bits)
            # So few units are rounding: each of the d steps before may have left one or two.
            if not column[0] > 4 * size:
                raise NotDefiniteError
            self._pivots[k] = column[0]
            self._lower[k + 1 :, k] = (column[1:] << bits) // column[0]

    def _solve(self, right: npt.NDArray[Any]) -> npt.NDArray[Any]:
        bits, lower, found = self._bits, self._lower, right.copy()
        for k in range(1, len(found)):
            found[k] -= (lower[k, :k] @ found[:k]) >> bits
        found = (found << bits) // self._pivots[:, None]
        for k in range(len(found) - 2, -1, -1):
            found[k] -= (lower[k + 1 :, k] @ found[k + 1 :]) >> bits
        return found

    def solve(self, right: FloatArray) -> FloatArray:
        """The solution for right-hand sides of shape (d, C). Raises OverflowError where float64 cannot hold it."""
        return self._floats(self._solve(self._fixed(right)), self._bits)

    def correct(self, rest: IntArray, exponents: IntArray) -> FloatArray:
        """The solution for exact right-hand sides, in two parts, shape (2, d, C)."""
        whole, power = to_integers(rest), exponents.astype(object)
        # Residuals grow ever smaller: each column is brought near 1, or its digits would fall below the point.
        lengths = np.frompyfunc(int.bit_length, 1, 1)(whole) + power
        up = -np.where(whole == 0, NOTHING, lengths).max(axis=0)
        up[up == -NOTHING] = 0
        shift = self._bits + power + up
        down = max(0, -int(shift.min()))
        found = self._solve((whole << (shift + down)) >> down)
        first = self._floats(found, self._bits + up)
        return np.stack([first, self._floats(found - self._fixed(first, up), self._bits + up)])

    def _fixed(self, values: FloatArray, up: npt.NDArray[Any] | int = 0) -> npt.NDArray[Any]:
        """values · 2^up in fixed point, rounded down; up: shape (C,)."""
        fixed = np.zeros(values.shape, dtype=object)
        ups = np.broadcast_to(np.asarray(up, dtype=np.int64), values.shape[1:])
        for row, column in np.ndindex(values.shape):
            numerator, denominator = float(values[row, column]).as_integer_ratio()
            shift = self._bits + int(ups[column])
            fixed[row, column] = (numerator << max(shift, 0)) // (denominator << max(-shift, 0))
        return fixed

    def _floats(self, fixed: npt.NDArray[Any], bits: npt.NDArray[Any] | int) -> FloatArray:
        """fixed / 2^bits: division of Python's integers rounds once, whatever their size; bits: shape (C,)."""
        floats = np.zeros(fixed.shape)
        places = np.broadcast_to(np.asarray(bits, dtype=np.int64), fixed.shape[1:])
        for row, column in np.ndindex(fixed.shape):
            place = int(places[column])
            floats[row, column] = (fixed[row, column] << max(-place, 0)) / (1 << max(place, 0))
        return floats
