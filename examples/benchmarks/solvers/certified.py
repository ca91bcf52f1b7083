"""The solution of a system of integers, each weight right to its last bit, with a diagnosis by name.

Arithmetic is FLINT's (python-flint): integers, and ball arithmetic (Johansson 2017, IEEE Transactions on Computers 66)
whose every number carries a bound of its own error. The system is solved with ever more bits until the balls are
narrower than a double; whether it is singular is a question of integers, which no tolerance answers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from flint import arb, arb_mat, ctx, fmpz, fmpz_mat

from examples.benchmarks.solvers.solver_protocol import SingularError
from scroll_tactile.errors import InputError

__all__ = ["Diagnosis", "IntegerSystem", "OnSingular", "Solution", "float_of", "floats_of", "solve_exact"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
OnSingular = Literal["raise", "diagnose"]
Verdict = Literal["sound", "ill conditioned", "singular", "out of range"]

ILL = 2.0**53  # condition: from here on the last bit of a row can change the first digit of the weights
PART = 0.1  # of the largest entry of a direction: columns with less are not named
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


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What is to be said of exact weights.

    verdict: "sound"; "ill conditioned": right for these rows, but their last bits decide; "singular": other weights fit as well; "out of range": some are too large for a
        double.
    rank: of d columns, as decided exactly; d where λ > 0.
    condition: of A + λ I with columns brought to one size, an estimate; where singular, of independent columns.
    directions: unit vectors in the columns' units, shape (d, d − rank), along which the weights are undetermined;
        where there are none, the one that is determined least, shape (d, 1).
    columns: those that have a part in them. relation: a singular system's first dependence, in words.
    bits: of the arithmetic that was enough. error_bound: of each weight's relative error, its rounding included.
    """

    verdict: Verdict
    rank: int
    dimension: int
    condition: float
    directions: FloatArray
    columns: tuple[int, ...]
    relation: str
    bits: int
    error_bound: float

    def __str__(self) -> str:
        if self.verdict == "singular":
            said = f"singular: rank {self.rank} of {self.dimension}; {self.relation}"
            return said + (f"; the rest has condition {self.condition:.1e}" if self.condition >= ILL else "")
        if self.verdict == "out of range":
            return "out of range: some weights exceed what a double can hold"
        if self.verdict == "ill conditioned":
            named = ", ".join(map(str, self.columns[:6])) + (" …" if len(self.columns) > 6 else "")
            return f"ill conditioned: {self.condition:.1e}, least determined in columns {named}"
        return f"sound: condition {self.condition:.1e}"


@dataclass(frozen=True, eq=False)
class Solution:
    """W of shape (d, C), and what is to be said of it."""

    weights: FloatArray
    diagnosis: Diagnosis


def solve_exact(system: IntegerSystem, on_singular: OnSingular = "raise") -> Solution:
    """W right to the last bit or two, and what is to be said of it.

    Where λ = 0 and the system is singular, or weights are out of a double's range, SingularError is raised, saying
    which columns depend on which. With on_singular="diagnose" the diagnosis says it instead, and the solution of
    smallest ‖W‖ is returned.
    """
    if on_singular not in ("raise", "diagnose"):
        raise InputError(f'expected on_singular to be "raise" or "diagnose"; came {on_singular!r}')
    matrix, right, q = system.scaled()
    singular = not system.penalty[0] and matrix.rank() < system.dimension
    solution = _smallest(system) if singular else _determined(system, matrix, right, q)
    diagnosis = solution.diagnosis
    if on_singular == "raise" and diagnosis.verdict in ("singular", "out of range"):
        penalty = float_of(fmpz(system.penalty[0]), system.penalty[1])
        raise SingularError(
            f"expected rows that determine the weights, or λ > 0; the system with λ = {penalty:g} is "
            f"{diagnosis}. Give a larger λ, leave out one of the columns {list(diagnosis.columns[:8])}, or ask with "
            'on_singular="diagnose" for what can be said'
        )
    return solution


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


def _condition(matrix: fmpz_mat, inverse: arb_mat) -> tuple[float, FloatArray]:
    """‖M‖ ‖M⁻¹‖, and the unit vector that M determines least, shape (d,), by inverse iteration."""
    vector = arb_mat(np.random.default_rng(0).normal(size=(matrix.nrows(), 1)).tolist())
    length = arb(1)
    for _ in range(4):
        vector = (inverse * vector).mid()
        length = sum((value * value for value in vector.entries()), start=arb(0)).sqrt().mid()
        vector = vector * (1 / length)
    whole = arb_mat(matrix)
    condition = float((whole * whole).trace().sqrt().mid() * length)
    return condition, np.array([float(value.mid()) for value in vector.entries()])


def _determined(system: IntegerSystem, matrix: fmpz_mat, right: fmpz_mat, q: IntArray) -> Solution:
    inverse, found, bits, accuracy = _certified(matrix, right)
    weights = floats_of(found.tolist(), system.target_units + (q - system.units)[:, None])
    condition, weakest = _condition(matrix, inverse)
    share = np.abs(weakest)
    verdict: Verdict = "sound" if condition < ILL else "ill conditioned"
    if not np.isfinite(weights).all():
        verdict = "out of range"
    # The direction is one of scaled columns: back to their own units, the longest of which is a double's 1.
    power = np.where(share > 0, q - system.units, -(2**20))
    direction = np.ldexp(weakest, np.maximum(power - power.max(), -5000).astype(np.int32))
    diagnosis = Diagnosis(
        verdict=verdict,
        rank=system.dimension,
        dimension=system.dimension,
        condition=condition,
        directions=(direction / np.linalg.norm(direction))[:, None],
        columns=tuple(np.flatnonzero(share >= PART * share.max()).tolist()),
        relation="",
        bits=bits,
        error_bound=2.0**-53 + 2.0**-accuracy,
    )
    return Solution(weights, diagnosis)


def _smallest(system: IntegerSystem) -> Solution:
    """The solution of a singular system that has the smallest ‖W‖, and what is left open; λ is 0.

    With independent columns I and null vectors N it is the one solution of A_I W = B_I and Nᵀ W = 0. The reduced row
    echelon form gives both in whole numbers.
    """
    dimension, outputs, units = system.dimension, system.right.ncols(), system.units
    reduced, scale, rank = system.matrix.rref()
    echelon = reduced.tolist()[:rank]
    kept = [next(j for j, value in enumerate(row) if value) for row in echelon]
    left = sorted(set(range(dimension)) - set(kept))
    null = [[fmpz(0)] * dimension for _ in left]
    for vector, j in zip(null, left, strict=True):
        vector[j] = scale
        for column, row in zip(kept, echelon, strict=True):
            vector[column] = -row[j]
    # In the columns' own units entry j of a null vector counts 2^−units_j, and so does entry j of the solution.
    power = int(units.max()) - units
    rows = [[value << 2 * int(up) for value, up in zip(vector, power, strict=True)] for vector in null]
    whole, right = system.matrix.tolist(), system.right.tolist()
    _, found, bits, accuracy = _certified(
        fmpz_mat([whole[i] for i in kept] + rows), fmpz_mat([right[i] for i in kept] + [[0] * outputs] * len(left))
    )
    q = np.zeros(dimension, dtype=np.int64)
    weights = floats_of(found.tolist(), system.target_units + (q - system.units)[:, None])
    directions, _ = np.linalg.qr(np.transpose([_as_floats(vector, power) for vector in null]))
    diagnosis = Diagnosis(
        verdict="singular",
        rank=rank,
        dimension=dimension,
        condition=_condition_of(system, kept),
        directions=directions,
        columns=tuple(j for j in range(dimension) if any(vector[j] for vector in null)),
        relation=_in_words(null[0], left[0], kept, power),
        bits=bits,
        error_bound=2.0**-53 + 2.0**-accuracy,
    )
    return Solution(weights, diagnosis)


def _condition_of(system: IntegerSystem, kept: list[int]) -> float:
    """The condition of the part of a system that independent columns make, brought to one size."""
    if not kept:
        return 1.0
    part = fmpz_mat([[system.matrix[i, j] for j in kept] for i in kept])
    alone = IntegerSystem(part, fmpz_mat(len(kept), 0), system.units[kept], np.zeros(0, np.int64), (0, 0))
    matrix, right, _ = alone.scaled()
    return _condition(matrix, _certified(matrix, right)[0])[0]


def _as_floats(vector: list[fmpz], power: IntArray) -> FloatArray:
    """vector_j · 2^power_j, multiplied by a power of two that brings the largest near 1."""
    reach = max(value.bit_length() + int(up) for value, up in zip(vector, power, strict=True) if value)
    return np.array([float_of(value, int(up) - reach) for value, up in zip(vector, power, strict=True)])


def _in_words(vector: list[fmpz], first: int, kept: list[int], power: IntArray) -> str:
    """A null vector as a sentence: a column by the independent ones it depends on."""
    with ctx.workprec(FIRST_BITS):
        terms = {j: float_of(-arb(vector[j]) / vector[first], int(power[j] - power[first])) for j in kept if vector[j]}
    parts = [f"{term:.6g} × column {j}" for j, term in terms.items()]
    if len(parts) > 4:
        parts = [*parts[:4], f"{len(parts) - 4} more terms"]
    return f"column {first} is " + (" + ".join(parts) if parts else "zero in every row")
