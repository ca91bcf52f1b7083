"""Ridge regression from exact sums: the rows' doubles as they are, or rounded to a grid of 20 or 24 bits.

Three ways to the integers, with one solve behind them that loses nothing (`refinement`):

- `Exact`: every double is kept as it is, in as many limbs as its column needs (`wide`). Nothing is rounded. Rows
  that are codes already, as those of an embedding, take one limb, and cost what `Exact20` costs.
- `Exact20`: rounded to 2⁻²⁰ of a bound for each column: one limb, about the price of a plain float64 sum.
- `Exact24`: to 2⁻²⁴: two limbs, about four times that.

Targets are always kept as they are. Sums can be added (`+`) and compared in bytes (`digest`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt

from examples.benchmarks.solvers.column_grid import Grid, rounding_effect
from examples.benchmarks.solvers.diagnosis import Diagnosis, OnSingular, solve_exact
from examples.benchmarks.solvers.limbs import EMPTY, from_integers, to_float, to_integers
from examples.benchmarks.solvers.scatter import scatter_about_means
from examples.benchmarks.solvers.solver_protocol import RidgeBase
from examples.benchmarks.solvers.systems import IntegerSystem
from examples.benchmarks.solvers.wide import WideMoments
from scroll_tactile.errors import InputError, MismatchError

__all__ = ["Exact", "Exact20", "Exact24"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


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
        self._grid: Grid | None = None
        self._rounded = False
        self._moments = WideMoments(1)

    def _begin(self) -> None:
        units = np.full(1 + self.dimension + self.outputs, EMPTY, dtype=np.int64)
        units[0] = 0
        if self.bits is not None:
            self._grid = Grid.of(self.bits, self._bounds, self.dimension)
            units[1 : 1 + self.dimension] = self._grid.units
        self._rounded = False
        self._moments = WideMoments(len(units), units)

    def _take(self, x: FloatArray, y: FloatArray) -> None:
        if self._grid is not None:
            rounded = self._grid.round(x)
            self._rounded = self._rounded or bool((rounded != x).any())
            x = rounded
        self._moments.add(np.concatenate([np.ones((len(x), 1)), x, y], axis=1))

    @property
    def rows(self) -> int:
        """How many rows were taken in."""
        return self._moments.rows

    @property
    def carries_at(self) -> int:
        """The number of rows at which sums are carried into wider limbs, before any could overflow."""
        self._require_start()
        return self._moments.carries_at

    @property
    def limbs(self) -> int:
        """In how many limbs of 22 bits the sums are kept at present."""
        self._require_start()
        return self._moments.limbs

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
        if self._grid is not None and other._grid is not None and (self._grid.units != other._grid.units).any():
            raise MismatchError(
                f"expected sums on the same grid; column {np.flatnonzero(self._grid.units != other._grid.units)[0]} "
                "has another bound. Give both the same bounds before they start"
            )
        joint = type(self)(self._bounds)
        joint.start(self.dimension, self.outputs, self.penalty)
        joint._moments = self._moments + other._moments
        joint._rounded = self._rounded or other._rounded
        return joint

    def system(self, *, centred: bool = False) -> IntegerSystem:
        """The normal equations as integers; `centred`: about the means of rows and targets, λ as it is."""
        self._require_start()
        sums, units = self._moments.state()
        x, y = slice(1, 1 + self.dimension), slice(1 + self.dimension, None)
        plain = IntegerSystem.of(sums[:, x, x], sums[:, x, y], units[x], units[y], self.penalty)
        return plain.centred(self.rows, sums[:, 0, x], sums[:, 0, y]) if centred else plain

    def weights(self) -> FloatArray:
        """W of shape (d, C). Raises SingularError where λ = 0 and other weights fit as well."""
        return self.solve()[0]

    def solve(self, on_singular: OnSingular = "raise", *, centred: bool = False) -> tuple[FloatArray, Diagnosis]:
        """W of shape (d, C) and what is to be said of it; of `centred` rows, so that an intercept is free of λ.

        Where λ = 0 and other weights fit as well SingularError is raised; or, with on_singular="diagnose", the
        smallest are returned.
        """
        system = self.system(centred=centred)
        weights, diagnosis = solve_exact(system, on_singular)
        if self._rounded:
            effect = rounding_effect(system, weights, self._energy(), self.rows)
            verdict = "rounded" if diagnosis.verdict == "sound" else diagnosis.verdict
            diagnosis = replace(diagnosis, verdict=verdict, rounding=effect)
        self.diagnosis = "" if diagnosis.verdict == "sound" else str(diagnosis)
        return weights, diagnosis

    def _energy(self) -> FloatArray:
        """Σ y² of each target, shape (C,), in float64."""
        sums, units = self._moments.state()
        y = np.arange(1 + self.dimension, len(units))
        value, exponent = to_float(sums[:, y, y])
        found: FloatArray = np.ldexp(value, exponent + 2 * np.where(units[y] == EMPTY, 0, units[y]))
        return found

    def scatter(self, *, within: bool = False) -> FloatArray:
        """Σ (x − m)(x − m)ᵀ about the mean m of all rows, or `within` classes about each its own; shape (d, d).

        Formed in integers: exact to rounding whatever the distance of the means from zero. Within classes targets
        have to be 0/1, one 1 a row; InputError is raised for others.
        """
        self._require_start()
        sums, units = self._moments.state()
        units = np.where(units == EMPTY, 0, units)
        x = slice(1, 1 + self.dimension)
        if not within:
            counts, of_group = ([self.rows] if self.rows else []), sums[:, x, :1]
        else:
            counts, of_group = self._classes(sums, units)
        if not counts:
            return np.zeros((self.dimension, self.dimension))
        return scatter_about_means(sums[:, x, x], units[x], counts, of_group)

    def _classes(self, sums: IntArray, units: IntArray) -> tuple[list[int], IntArray]:
        """n_y of the classes that have rows, and their sums of rows in limbs, in the units of the columns."""
        y = np.arange(1 + self.dimension, len(units))
        # In units of 1 at last: targets of zeros and ones are whole, and so are their sums and products.
        down = np.maximum(-units[y], 0).astype(object)
        counts = to_integers(sums[:, 0, y]) >> down
        products = to_integers(sums[:, y][:, :, y]) >> (down + down[:, None])
        exact = (counts << down == to_integers(sums[:, 0, y])).all() and not (units[y] > 0).any()
        # The sum of squares is the sum, and no two targets of a row are not zero: then each is 0 or 1.
        if not exact or (products != np.diag(counts)).any() or counts.sum() != self.rows:
            raise InputError("expected targets of one 1 and else 0 in each row, to know the classes")
        felt = np.flatnonzero(counts)
        of_class = to_integers(sums[:, 1 : 1 + self.dimension, y[felt]]) >> down[felt]
        return [int(count) for count in counts[felt]], from_integers(of_class)


class Exact24(Exact):
    """`Exact` with columns rounded to codes of 24 bits of their bound."""

    bits = 24


class Exact20(Exact):
    """`Exact` with columns rounded to codes of 20 bits of their bound: the grid of a memory."""

    bits = 20
