"""Ridge regression from exact sums of doubles: every value is an integer in units of a power of two of its column.

Nothing is rounded before the solve. Sums are FLINT's integers: any order and batching gives the same ones. They can be
compared in bytes (`digest`), and are solved in ball arithmetic (`certified`).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from flint import fmpz_mat

from examples.benchmarks.solvers.certified import Diagnosis, IntegerSystem, solve_exact
from examples.benchmarks.solvers.solver_protocol import RidgeBase

__all__ = ["Exact", "IntegerMoments"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

EMPTY = 2**20  # the unit of a column of zeros: above that of any double
WAITING = 512  # rows that wait for one product: at one row a time it would be bound by reading and writing the sums


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


class Exact(RidgeBase):
    """Exact sums of [1, x, y] [1, x, y]ᵀ over rows x with targets y, and the exact ridge regression.

    A + λ I, B = Σ x yᵀ and λ are integers in powers of two: W = (A + λ I)⁻¹ B is solved until its last bit or two.

    >>> solver = Exact()
    >>> solver.start(2, 1, 0.0)
    >>> solver.update([[1.0, 1.0], [1e-12, 0.0]], [[3.0], [1e-12]])  # in float64 AᵀA would be singular
    >>> solver.weights().tolist()
    [[1.0], [2.0]]
    """

    def _begin(self) -> None:
        self._moments = IntegerMoments(1 + self.dimension + self.outputs)

    def _take(self, x: FloatArray, y: FloatArray) -> None:
        self._moments.add(np.concatenate([np.ones((len(x), 1)), x, y], axis=1))

    def settle(self) -> None:
        """Bring rows that wait into the sums."""
        self._moments.settle()

    def digest(self) -> str:
        """Hex of a SHA-256 over all sums: equal if and only if they are, whatever the order of the rows was."""
        self._require_start()
        return self._moments.digest()

    def _block(self, rows: range, columns: range) -> fmpz_mat:
        return fmpz_mat([[self._moments.sums[i, j] for j in columns] for i in rows])

    def _settled(self) -> tuple[range, range, IntArray]:
        """The places of x and of y in the sums, with all rows in them, and their units; of zeros 2⁰."""
        self._require_start()
        self._moments.settle()
        units = self._moments.units
        places = range(1, 1 + self.dimension), range(1 + self.dimension, len(units))
        return *places, np.where(units == EMPTY, 0, units)

    def system(self) -> IntegerSystem:
        """The normal equations as integers."""
        x, y, units = self._settled()
        numerator, denominator = self.penalty.as_integer_ratio()
        penalty = numerator, 1 - denominator.bit_length()
        matrix, right = self._block(x, x), self._block(x, y)
        return IntegerSystem(matrix, right, units[x.start : x.stop], units[y.start : y.stop], penalty)

    def weights(self) -> FloatArray:
        """W of shape (d, C). Raises SingularError where λ = 0 and other weights fit as well."""
        return self.solve()[0]

    def solve(self) -> tuple[FloatArray, Diagnosis]:
        """W of shape (d, C) and what is to be said of it."""
        weights, diagnosis = solve_exact(self.system())
        self.diagnosis = str(diagnosis)
        return weights, diagnosis
