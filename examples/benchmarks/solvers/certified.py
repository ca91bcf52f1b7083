"""The solution of a system of integers, each weight right to its last bit.

Arithmetic is FLINT's (python-flint): integers, and ball arithmetic (Johansson 2017, IEEE Transactions on Computers 66)
whose every number carries a bound of its own error. The system is solved with ever more bits until the balls are
narrower than a double; whether it is singular is a question of integers, which no tolerance answers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from flint import arb, arb_mat, ctx, fmpz, fmpz_mat

from examples.benchmarks.solvers.solver_protocol import SingularError

__all__ = ["Diagnosis", "IntegerSystem", "floats_of", "solve_exact"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

ILL = 2.0**53
NOTHING = -(2**20)  # the length in bits of zero: below that of any sum of doubles' products
FIRST_BITS = 128
ENOUGH_BITS = 60  # of a weight: then it is rounded to the nearest double, or to its neighbour
ZERO_BITS = 128  # below the largest weight of its column: a weight so small is not waited for


@dataclass(frozen=True)
class IntegerSystem:
    """(A + λ I) W = B with A_ij = 2^(units_i + units_j) · matrix_ij and B_ic = 2^(units_i + target_units_c) · right_ic.

    matrix: d × d, symmetric, ≥ 0. right: d × C. units: shape (d,), target_units: shape (C,), exponents of two.
    penalty: λ = m · 2^e as (m, e).
    """

    matrix: fmpz_mat
    right: fmpz_mat
    units: IntArray
    target_units: IntArray
    penalty: tuple[int, int]

    @property
    def dimension(self) -> int:
        """d."""
        return self.matrix.nrows()

    def scaled(self) -> tuple[fmpz_mat, fmpz_mat, IntArray]:
        """(M, R, q): M = 2^q (matrix + λ) 2^q and R = 2^q right in integers; M's diagonal is of one length.

        A solution U of M U = R gives W_jc = 2^(target_units_c + q_j − units_j) · U_jc. q: shape (d,).
        """
        mantissa, exponent = self.penalty
        places = exponent - 2 * self.units  # of λ in the units of the matrix
        of_ridge = places + fmpz(mantissa).bit_length() if mantissa else np.full_like(places, NOTHING)
        diagonal = [self.matrix[j, j] for j in range(self.dimension)]
        lengths = np.maximum([value.bit_length() if value else NOTHING for value in diagonal], of_ridge)
        q = np.where(lengths == NOTHING, 0, (lengths.max() - lengths) // 2)
        if mantissa:  # and λ whole
            q += max(0, -int((places + 2 * q).min() // 2))
        up = [int(power) for power in q]
        table = [
            [value << (i + j) for value, j in zip(row, up, strict=True)]
            for row, i in zip(self.matrix.tolist(), up, strict=True)
        ]
        for j, place in enumerate(places):
            table[j][j] += fmpz(mantissa) << int(place + 2 * q[j]) if mantissa else 0
        right = [[value << i for value in row] for row, i in zip(self.right.tolist(), up, strict=True)]
        return fmpz_mat(table), fmpz_mat(right), q


@dataclass(frozen=True)
class Diagnosis:
    """What is to be said of exact weights.

    condition: of A + λ I with columns of one size, an estimate: from 2⁵³ on the last bit of a row can change the first
    digit of the weights. bits: of the arithmetic that was enough. error_bound: of each weight's relative error,
    its rounding included.
    """

    condition: float
    bits: int
    error_bound: float

    def __str__(self) -> str:
        return f"{'sound' if self.condition < ILL else 'ill conditioned'}: condition {self.condition:.1e}"


def solve_exact(system: IntegerSystem) -> tuple[FloatArray, Diagnosis]:
    """W of shape (d, C) right to the last bit or two, and what is to be said of it.

    Raises SingularError where λ = 0 and the rows leave weights open, or some are out of a double's range.
    """
    matrix, right, q = system.scaled()
    if not system.penalty[0] and (rank := matrix.rank()) < system.dimension:
        raise SingularError(
            f"expected rows that determine the weights, or λ > 0; they have rank {rank} of {system.dimension}. Give a "
            "larger λ, or leave out columns that depend on others"
        )
    inverse, found, bits, accuracy = _certified(matrix, right)
    weights = floats_of(found.tolist(), system.target_units + (q - system.units)[:, None])
    if not np.isfinite(weights).all():
        raise SingularError("expected weights that a double can hold; some exceed it. Give a larger λ")
    return weights, Diagnosis(_condition(matrix, inverse), bits, 2.0**-53 + 2.0**-accuracy)


def float_of(value: arb | fmpz, exponent: int) -> float:
    """value · 2^exponent, rounded once: infinite or zero where a double cannot hold it."""
    middle = value if isinstance(value, fmpz) else value.mid()
    mantissa, place = (middle, 0) if isinstance(middle, fmpz) else middle.man_exp()
    return float(arb((mantissa, place + exponent)))


def floats_of(values: Sequence[Sequence[arb | fmpz]], exponents: IntArray) -> FloatArray:
    """values · 2^exponents, each rounded once; both of one shape."""
    table = [
        [float_of(value, int(exponent)) for value, exponent in zip(row, of_row, strict=True)]
        for row, of_row in zip(values, exponents, strict=True)
    ]
    return np.array(table, dtype=np.float64).reshape(exponents.shape)


def _certified(matrix: fmpz_mat, right: fmpz_mat) -> tuple[arb_mat, arb_mat, int, int]:
    """(matrix⁻¹, matrix⁻¹ right, bits of arithmetic, bits that are right of each entry) of a matrix not singular."""
    bits = FIRST_BITS
    while True:
        with ctx.workprec(bits):
            try:
                inverse = arb_mat(matrix).inv()
                found = inverse * arb_mat(right)
            except ZeroDivisionError:  # balls too wide to tell the matrix from a singular one
                bits *= 2
                continue
            accuracy = _accuracy(found)
        if accuracy >= ENOUGH_BITS:
            return inverse, found, bits, accuracy
        bits *= 2


def _accuracy(found: arb_mat) -> int:
    """The bits that are right in the worst entry; one that is nothing beside its column's largest is left out."""
    worst = 2**20
    for column in found.transpose().tolist():
        least = max((abs(value.mid()) for value in column), default=arb(0)) * arb((1, -ZERO_BITS))
        bits = [value.rel_accuracy_bits() for value in column if not value.abs_upper() < least]
        worst = min([worst, *bits])
    return worst


def _condition(matrix: fmpz_mat, inverse: arb_mat) -> float:
    """‖M‖ ‖M⁻¹‖, by inverse iteration."""
    vector = arb_mat(np.random.default_rng(0).normal(size=(matrix.nrows(), 1)).tolist())
    length = arb(1)
    for _ in range(4):
        vector = (inverse * vector).mid()
        length = sum((value * value for value in vector.entries()), start=arb(0)).sqrt().mid()
        vector = vector * (1 / length)
    whole = arb_mat(matrix)
    return float((whole * whole).trace().sqrt().mid() * length)
