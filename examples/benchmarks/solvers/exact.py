"""Ridge regression from exact sums: the rows' doubles as they are, or rounded to a grid of 20 or 24 bits.

- `Exact`: every double is kept as it is, an integer in units of a power of two of its column. Nothing is rounded.
- `Exact20`, `Exact24`: columns rounded to 2⁻²⁰ or 2⁻²⁴ of a bound for each.

Targets are always kept as they are. Sums are FLINT's integers: any order, batching or merging gives the same ones.
They can be added (`+`) and compared in bytes (`digest`), and are solved in ball arithmetic (`certified`).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from math import lcm
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt
from flint import fmpz_mat

from examples.benchmarks.solvers.certified import (
    Diagnosis,
    IntegerSystem,
    OnSingular,
    Solution,
    float_of,
    floats_of,
    solve_exact,
)
from examples.benchmarks.solvers.solver_protocol import RidgeBase
from scroll_tactile.errors import InputError, MismatchError

__all__ = ["Exact", "Exact20", "Exact24", "IntegerMoments"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

EMPTY = 2**20  # the unit of a column of zeros: above that of any double
WAITING = 512  # rows that wait for one product: at one row a time it would be bound by reading and writing the sums
REACH = 900  # exponents of bounds: within them a power of two and its inverse are doubles


def _whole(values: FloatArray) -> tuple[IntArray, IntArray]:
    """(m, e) with values = m · 2^e and m odd; a zero has e = EMPTY."""
    mantissa, exponent = np.frexp(values)
    whole = np.ldexp(mantissa, 53).astype(np.int64)
    zeros = np.frexp((whole & -whole).astype(np.float64))[1] - 1  # behind the last bit that is set
    return whole >> np.maximum(zeros, 0), np.where(whole == 0, EMPTY, exponent - 53 + zeros)


@dataclass(eq=False)
class IntegerMoments:
    """A = Σ z zᵀ over rows z of doubles, shape (D, D), entry (i, j) in units of 2^(units[i] + units[j]).

    A column's unit is the lowest bit that is set in any of its values, EMPTY where all are zero.
    """

    width: int

    def __post_init__(self) -> None:
        self.rows = 0
        self.units = np.full(self.width, EMPTY, dtype=np.int64)
        self.sums = fmpz_mat(self.width, self.width)
        self._waiting: list[FloatArray] = []
        self._count = 0

    def add(self, rows: FloatArray) -> None:
        """Add finite rows, shape (n, D); they may wait, and are copied."""
        self.rows += len(rows)
        self._count += len(rows)
        self._waiting.append(rows.copy())
        if self._count >= WAITING:
            self.settle()

    def settle(self) -> None:
        """Bring the rows that wait into the sums."""
        if not self._count:
            return
        whole, exponent = _whole(np.concatenate(self._waiting))
        self._waiting, self._count = [], 0
        self._lower(exponent.min(axis=0))
        up = np.where(whole == 0, 0, exponent - self.units)
        # Beyond nine bits a mantissa of 53 does not fit an int64 any more.
        rows = whole << up if up.max() < 9 else whole.astype(object) << up.astype(object)
        digits = fmpz_mat(rows.tolist())
        self.sums += digits.transpose() * digits

    def _lower(self, lowest: IntArray) -> None:
        """Lower the units to bits of these exponents, shape (D,); the sums stay what they are."""
        units = np.minimum(self.units, lowest)
        by = np.where(self.units == EMPTY, 0, self.units - units).tolist()
        self.units = units
        if any(by):
            table = zip(self.sums.tolist(), by, strict=True)
            self.sums = fmpz_mat([[value << (i + j) for value, j in zip(row, by, strict=True)] for row, i in table])

    def digest(self) -> str:
        """Hex of a SHA-256 over the rows' number, the units and all sums: equal if and only if these are."""
        self.settle()
        said = (self.rows, self.units.tolist(), [int(value) for value in self.sums.entries()])
        return hashlib.sha256(repr(said).encode()).hexdigest()

    def __add__(self, other: IntegerMoments) -> IntegerMoments:
        if self.width != other.width:
            raise MismatchError(f"expected moments of {self.width} columns to be added; came {other.width}")
        self.settle()
        other.settle()
        joint, rest = IntegerMoments(self.width), IntegerMoments(self.width)
        for copy, part in ((joint, self), (rest, other)):
            copy.units, copy.sums = part.units, part.sums
            copy._lower(np.minimum(self.units, other.units))
        joint.sums += rest.sums
        joint.rows = self.rows + other.rows
        return joint


class Exact(RidgeBase):
    """Exact sums of [1, x, y] [1, x, y]ᵀ over rows x with targets y, and the exact ridge regression.

    A + λ I, B = Σ x yᵀ and λ are integers in powers of two: W = (A + λ I)⁻¹ B is solved until its last bit or two.

    bounds: largest magnitude of each column, one number or d of them; used only with a grid.

    >>> solver = Exact()
    >>> solver.start(2, 1, 0.0)
    >>> solver.update([[1.0, 1.0], [1e-12, 0.0]], [[3.0], [1e-12]])  # in float64 AᵀA would be singular
    >>> solver.weights().tolist()
    [[1.0], [2.0]]
    >>> solver.solve()[1].verdict
    'ill conditioned'
    """

    bits: ClassVar[int | None] = None  # of the grid's codes; None: no grid

    def __init__(self, bounds: npt.ArrayLike = 1.0) -> None:
        super().__init__()
        self._bounds = bounds
        self._grid = np.zeros(0, dtype=np.int64)  # units of the codes, exponents of two, shape (d,)
        self._rounded = False
        self._moments = IntegerMoments(1)

    def _begin(self) -> None:
        if self.bits is not None:
            self._grid = _grid(self._bounds, self.dimension) - self.bits
        self._rounded = False
        self._moments = IntegerMoments(1 + self.dimension + self.outputs)

    def _take(self, x: FloatArray, y: FloatArray) -> None:
        if self.bits is not None:
            rounded = self._round(x, self.bits)
            self._rounded = self._rounded or bool((rounded != x).any())
            x = rounded
        self._moments.add(np.concatenate([np.ones((len(x), 1)), x, y], axis=1))

    def _round(self, x: FloatArray, bits: int) -> FloatArray:
        codes = np.rint(x * np.exp2(-self._grid))
        if not np.abs(codes).max(initial=0.0) <= 2.0**bits:
            row, column = np.argwhere(~(np.abs(codes) <= 2.0**bits))[0].tolist()
            raise InputError(
                f"expected values of magnitude at most {2.0 ** (self._grid[column] + bits):g} in column {column}; "
                f"row {row} has {x[row, column]:g}. Give a larger bound, or keep doubles as they are (no grid)"
            )
        rounded: FloatArray = codes * np.exp2(self._grid)
        return rounded

    @property
    def rows(self) -> int:
        """How many rows were taken in."""
        return self._moments.rows

    def settle(self) -> None:
        """Bring rows that wait into the sums."""
        self._moments.settle()

    def digest(self) -> str:
        """Hex of a SHA-256 over all sums: equal if and only if they are, whatever the order of the rows was."""
        self._require_start()
        return self._moments.digest()

    def __add__(self, other: Self) -> Self:
        mine = (type(self), self.dimension, self.outputs, self.penalty)
        theirs = (type(other), other.dimension, other.outputs, other.penalty)
        if mine != theirs:
            raise MismatchError(f"expected sums of the same kind, d, C and λ: {mine}; came {theirs}")
        if (self._grid != other._grid).any():
            raise MismatchError(
                f"expected sums on the same grid; column {np.flatnonzero(self._grid != other._grid)[0]} "
                "has another bound. Give both the same bounds before they start"
            )
        joint = type(self)(self._bounds)
        joint.start(self.dimension, self.outputs, self.penalty)
        joint._moments = self._moments + other._moments
        joint._rounded = self._rounded or other._rounded
        return joint

    def _block(self, rows: range, columns: range) -> fmpz_mat:
        return fmpz_mat([[self._moments.sums[i, j] for j in columns] for i in rows])

    def _settled(self) -> tuple[range, range, IntArray]:
        """The places of x and of y in the sums, with all rows in them, and their units; of zeros 2⁰."""
        self._require_start()
        self._moments.settle()
        units = self._moments.units
        places = range(1, 1 + self.dimension), range(1 + self.dimension, len(units))
        return *places, np.where(units == EMPTY, 0, units)

    def system(self, *, centred: bool = False) -> IntegerSystem:
        """The normal equations as integers; `centred`: about the means of rows and targets, λ as it is."""
        x, y, units = self._settled()
        numerator, denominator = self.penalty.as_integer_ratio()
        matrix, right = self._block(x, x), self._block(x, y)
        if centred:  # n A − c cᵀ, n B − c sᵀ and n λ are whole too
            sums, n = self._block(x, range(1)), self.rows
            matrix, right = matrix * n - sums * sums.transpose(), right * n - sums * self._block(range(1), y)
            numerator *= n
        return IntegerSystem(
            matrix, right, units[x.start : x.stop], units[y.start : y.stop], (numerator, 1 - denominator.bit_length())
        )

    def weights(self) -> FloatArray:
        """W of shape (d, C). Raises SingularError where λ = 0 and other weights fit as well."""
        return self.solve()[0]

    def solve(self, on_singular: OnSingular = "raise", *, centred: bool = False) -> tuple[FloatArray, Diagnosis]:
        """W of shape (d, C) and what is to be said of it; of `centred` rows, so that an intercept is free of λ.

        Where λ = 0 and other weights fit as well SingularError is raised; or, with on_singular="diagnose", the
        smallest are returned.
        """
        system = self.system(centred=centred)
        solution = solve_exact(system, on_singular)
        diagnosis = solution.diagnosis
        if self._rounded:
            verdict = "rounded" if diagnosis.verdict == "sound" else diagnosis.verdict
            effect = self._rounding_effect(system, solution, self.rows if centred else 1)
            diagnosis = replace(diagnosis, verdict=verdict, rounding=effect)
        self.diagnosis = "" if diagnosis.verdict == "sound" else str(diagnosis)
        return solution.weights, diagnosis

    def _rounding_effect(self, system: IntegerSystem, solution: Solution, times: int) -> float:
        """The relative error, root mean square, that rounding to the grid is expected to make in the weights.

        To first order a change E of the rows X changes W by H (Eᵀ R − Xᵀ E W) with H = (A + λ)⁻¹ and R = Y − X W.
        Entries of E are independent, of variance v_j = unit_j² / 12; and E'E adds n v to the diagonal of A, as a
        ridge. Counted in columns brought to one size near 1. times: what the system was multiplied by. Infinite
        where the system is singular.
        """
        if solution.inverse is None:
            return np.inf
        half = max(2 * int(i) + system.matrix[j, j].bit_length() for j, i in enumerate(solution.q)) // 2
        power = solution.q - system.units - half
        inverse = times * floats_of(solution.inverse.tolist(), np.full((self.dimension, self.dimension), 2 * half))
        right = floats_of(system.right.tolist(), (solution.q - half)[:, None] + system.target_units) / times
        with np.errstate(over="ignore", invalid="ignore", under="ignore"):
            scaled = solution.weights * np.exp2(-power)[:, None]
            variance = np.exp2(2.0 * (self._grid + power)) / 12
            size = float(np.linalg.norm(scaled))
            residual = float(np.maximum(self._energy(times) - (scaled * right).sum(axis=0), 0).sum())
            spread = residual * float((np.square(inverse) @ variance).sum())
            spread += float(np.trace(inverse)) * float((np.square(scaled) * variance[:, None]).sum())
            bias = self.rows * float(np.linalg.norm(inverse @ (variance[:, None] * scaled)))
            return float(np.nan_to_num((np.sqrt(spread) + bias) / size, nan=np.inf)) if size else 0.0

    def _energy(self, times: int) -> FloatArray:
        """Σ y² of each target, shape (C,); about their means where the system was multiplied by the rows' number."""
        _, y, units = self._settled()
        sums = self._moments.sums
        whole = [times * sums[c, c] - (times > 1) * sums[0, c] * sums[0, c] for c in y]
        return np.array([float_of(value, 2 * int(units[c])) for value, c in zip(whole, y, strict=True)]) / times

    def scatter(self, *, within: bool = False) -> FloatArray:
        """Σ (x − m)(x − m)ᵀ about the mean m of all rows, or `within` classes about each its own; shape (d, d).

        Formed in integers: exact to rounding whatever the distance of the means from zero. Within classes targets
        have to be 0/1, one 1 a row; InputError is raised for others.
        """
        x, y, units = self._settled()
        counts, sums = self._classes(y) if within else ([self.rows], self._block(x, range(1)))
        groups = [g for g, count in enumerate(counts) if count]
        # S = A − Σ_y c_y c_yᵀ / n_y, in whole numbers times the n_y's least common multiple.
        common = lcm(*(counts[g] for g in groups))
        whole = self._block(x, x) * common
        for g in groups:
            of_group = fmpz_mat([[sums[i, g]] for i in range(self.dimension)])
            whole -= of_group * of_group.transpose() * (common // counts[g])
        return floats_of(whole.tolist(), units[x.start : x.stop][:, None] + units[x.start : x.stop]) / common

    def _classes(self, y: range) -> tuple[list[int], fmpz_mat]:
        """n_y of each class, and the sums of its rows, shape (d, C), in the units of the columns."""
        counts = [int(self._moments.sums[0, c]) for c in y]
        products = self._block(y, y)
        diagonal = [[n if i == j else 0 for j in range(len(counts))] for i, n in enumerate(counts)]
        # Whole targets whose sum is that of their squares, no two of a row not zero: each is 0 or 1.
        units = self._moments.units[y.start : y.stop]
        if set(units.tolist()) - {0, EMPTY} or products != fmpz_mat(diagonal) or sum(counts) != self.rows:
            raise InputError("expected targets of one 1 and else 0 in each row, to know the classes")
        return counts, self._block(range(1, 1 + self.dimension), y)


class Exact24(Exact):
    """`Exact` with columns rounded to codes of 24 bits of their bound."""

    bits = 24


class Exact20(Exact):
    """`Exact` with columns rounded to codes of 20 bits of their bound: the grid of a memory."""

    bits = 20


def _grid(bounds: npt.ArrayLike, dimension: int) -> IntArray:
    """Exponents of the next powers of two from `bounds` on, one number or one for each column; shape (d,)."""
    wanted = np.asarray(bounds, dtype=np.float64)
    if wanted.ndim > 1 or wanted.size not in (1, dimension):
        raise InputError(f"expected one bound, or one for each of {dimension} columns; came shape {wanted.shape}")
    if not (np.isfinite(wanted).all() and (wanted >= 2.0**-REACH).all() and (wanted <= 2.0**REACH).all()):
        raise InputError(f"expected bounds from 2^-{REACH} to 2^{REACH}; came {wanted.min()} to {wanted.max()}")
    mantissa, exponent = np.frexp(np.broadcast_to(wanted, dimension))
    return np.asarray(exponent.astype(np.int64) - (mantissa == 0.5), dtype=np.int64)
