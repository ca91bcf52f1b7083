"""The normal equations as integers: (A + λ I) W = B without any rounding, and its residual for any W.

A and B are sums of products of doubles, so whole multiples of powers of two; λ is a double, so one too. In these
units the system is one of integers, and what a candidate leaves over is formed exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from examples.benchmarks.solvers.limbs import (
    EMPTY,
    LIMB,
    carry,
    from_integers,
    lowest_bits,
    product,
    split,
    to_float,
    to_integers,
    total,
)

__all__ = ["IntegerSystem", "Penalty", "times_power"]

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]
ObjectArray = npt.NDArray[np.object_]
Penalty = tuple[int, int]
"""λ as (m, e), exactly m · 2^e."""


def exactly(penalty: float) -> Penalty:
    """A double as (m, e) with value m · 2^e."""
    numerator, denominator = penalty.as_integer_ratio()
    return numerator, 1 - denominator.bit_length()


@dataclass(frozen=True)
class IntegerSystem:
    """(A + λ I) W = B with A_ij = 2^(units_i + units_j) · matrix_ij and B_ic = 2^(units_i + target_units_c) · right_ic.

    matrix: symmetric, ≥ 0, digits in carried limbs, shape (limbs, d, d). right: shape (limbs, d, C).
    units: shape (d,), and target_units: shape (C,): exponents of powers of two.
    penalty: λ.
    """

    matrix: IntArray
    right: IntArray
    units: IntArray
    target_units: IntArray
    penalty: Penalty

    @classmethod
    def of(
        cls, matrix: IntArray, right: IntArray, units: IntArray, target_units: IntArray, penalty: float | Penalty
    ) -> IntegerSystem:
        """The system of exact sums; a unit of EMPTY, of a column of zeros, counts as 1."""
        scale = penalty if isinstance(penalty, tuple) else exactly(penalty)
        return cls(
            matrix, right, np.where(units == EMPTY, 0, units), np.where(target_units == EMPTY, 0, target_units), scale
        )

    @classmethod
    def of_codes(cls, packed: IntArray, sums: IntArray, penalty: float) -> IntegerSystem:
        """The system of a memory's own sums, for 0/1 targets: A as in `SecondMoment`, c_y as B, λ in codes².

        packed: the lower triangle of A, row after row, shape (d·(d+1)/2,); sums: shape (C, d). Both below 2⁶².
        """
        dimension = sums.shape[1]
        matrix = np.zeros((dimension, dimension), dtype=np.int64)
        matrix[np.tril_indices(dimension)] = packed
        matrix += np.tril(matrix, -1).T
        ones, of_targets = np.zeros(dimension, dtype=np.int64), np.zeros(len(sums), dtype=np.int64)  # units of 2⁰
        return cls.of(from_integers(matrix), from_integers(sums.T), ones, of_targets, penalty)

    @property
    def dimension(self) -> int:
        """d."""
        return int(self.matrix.shape[1])

    @cached_property
    def _ridge(self) -> tuple[IntArray, int]:
        """λ / 2^(2 units_i) in limbs, shape (limbs, d), and the place of the first limb, ≤ 0."""
        mantissa, exponent = self.penalty
        if not mantissa:
            return np.zeros((1, self.dimension), dtype=np.int64), 0
        shifts = exponent - 2 * self.units
        place = min(0, int(shifts.min()) // LIMB)
        whole = [mantissa << int(shift - LIMB * place) for shift in shifts]
        return from_integers(np.array(whole, dtype=object)), place

    @cached_property
    def scaling(self) -> IntArray:
        """Exponents q, shape (d,), that bring each 2^(2 q_i) · (matrix_ii + λ_i) into [¼, 2), 0 where that is 0."""
        ridge, place = self._ridge
        diagonal = self.matrix[:, np.arange(self.dimension), np.arange(self.dimension)]
        sums, base = total([(diagonal, 0), (ridge, place)])
        bits = [int(value).bit_length() + LIMB * base if value else 0 for value in to_integers(sums)]
        return -np.array([bit // 2 for bit in bits], dtype=np.int64)

    @cached_property
    def scaled(self) -> FloatArray:
        """A + λ I with rows and columns multiplied by 2^q, in float64, shape (d, d): its diagonal is about 1."""
        return self.scaled_as(np.float64)

    def scaled_as(self, kind: type[np.floating]) -> npt.NDArray[Any]:
        """As `scaled`, in another kind of float."""
        value, exponent = to_float(self.matrix, kind)
        q = self.scaling
        found = times_power(value, exponent + q[:, None] + q)
        ridge, place = self._ridge
        value, exponent = to_float(ridge, kind)
        found[np.diag_indices(self.dimension)] += times_power(value, exponent + LIMB * place + 2 * q)
        return found

    def fixed(self, bits: int) -> ObjectArray:
        """The matrix of `scaled` as Python's integers, times 2^bits, rounded down."""
        q = self.scaling.astype(object)
        ridge, place = self._ridge
        whole = to_integers(self.matrix) << (-LIMB * place)
        whole[np.diag_indices(self.dimension)] += to_integers(ridge)
        shift = bits + q[:, None] + q + LIMB * place
        down = max(0, -int(shift.min()))
        rounded: ObjectArray = (whole << (shift + down)) >> down
        return rounded

    def residual(self, solution: FloatArray, exponents: IntArray) -> tuple[IntArray, int]:
        """B − (A + λ I) U, exact: in carried limbs, shape (limbs, d, C), and the place of the first.

        solution: U, shape (parts, d, C): Σ over parts of solution · 2^exponents; exponents: shape (d, C). Both in
        the units of the integers: W_jc = 2^(target_units_c − units_j) · U_jc.
        """
        digits, place = _digits(solution, exponents)
        ridge, ridge_place = self._ridge
        parts = [(self.right, 0), (-carry(product(self._digits, digits.astype(np.float64))), place)]
        if self.penalty[0]:
            sums = np.zeros((len(ridge) + len(digits) - 1, *digits.shape[1:]), dtype=np.int64)
            for at, limb in enumerate(ridge):
                if limb.any():
                    sums[at : at + len(digits)] -= limb[:, None] * digits
            parts.append((carry(sums), place + ridge_place))
        return total(parts)

    @cached_property
    def _digits(self) -> FloatArray:
        return self.matrix.astype(np.float64)

    def take(self, kept: npt.NDArray[np.intp], right: IntArray, target_units: IntArray) -> IntegerSystem:
        """The system of some columns only, and of another right-hand side in limbs, shape (limbs, kept, C)."""
        matrix = self.matrix[:, kept][:, :, kept]
        return IntegerSystem(matrix, right, self.units[kept], target_units, self.penalty)

    def centred(self, rows: int, sums: IntArray, target_sums: IntArray) -> IntegerSystem:
        """The system about the mean of the rows, times their number n: n A − c cᵀ, n B − c sᵀ and n λ, all whole.

        sums: c in carried limbs, shape (limbs, d), in the units of the columns; target_sums: s, shape (limbs, C).
        """
        count = from_integers(rows).astype(np.float64)[:, None, None]
        c, s = sums.astype(np.float64)[:, :, None], target_sums.astype(np.float64)[:, :, None]
        matrix = _scaled_less(self.matrix, count, c, c)
        right = _scaled_less(self.right, count, c, s)
        mantissa, exponent = self.penalty
        return IntegerSystem(matrix, right, self.units, self.target_units, (rows * mantissa, exponent))


def _scaled_less(limbs: IntArray, count: FloatArray, left: FloatArray, right: FloatArray) -> IntArray:
    """count · limbs − left · rightᵀ, exact: of shape (limbs, rows, columns)."""
    shape = limbs.shape[1:]
    flat = limbs.astype(np.float64).reshape(len(limbs), 1, -1)
    whole = carry(product(count, flat)).reshape(-1, *shape)
    outer = carry(product(left, right.transpose(0, 2, 1)))
    return total([(whole, 0), (-outer, 0)])[0]


def _digits(parts: FloatArray, exponents: IntArray) -> tuple[IntArray, int]:
    """Σ over the first axis of parts · 2^exponents in carried limbs, and the place of the first."""
    lowest = (lowest_bits(parts) + exponents).min()
    place = int(lowest) // LIMB if lowest < EMPTY // 2 else 0
    summed = [(split(part, LIMB * place - exponents).astype(np.int64), 0) for part in parts]
    return total(summed)[0], place


def times_power(value: npt.NDArray[Any], exponent: IntArray) -> npt.NDArray[Any]:
    """value · 2^exponent; exponents far outside float64's range are no error: the result is 0 or infinite."""
    with np.errstate(over="ignore", under="ignore"):
        found: npt.NDArray[Any] = np.ldexp(value, np.clip(exponent, -5000, 5000).astype(np.int32))
    return found
