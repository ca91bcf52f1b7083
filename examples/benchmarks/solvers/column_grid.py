"""Grids of 20 or 24 bits for doubles: a power of two for each column, and what rounding to it costs in weights.

`codes` rounds features of a known bound to 2⁻²⁰ of it; this is the same for columns of different bounds, and for
more bits. A code of 20 bits is one limb, of 24 bits two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from examples.benchmarks.solvers.factors import FloatFactor, NotDefiniteError
from examples.benchmarks.solvers.limbs import to_float
from examples.benchmarks.solvers.systems import IntegerSystem, times_power
from scroll_tactile.errors import InputError

__all__ = ["Grid", "rounding_effect"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

REACH = 900  # exponents of bounds: within them a power of two and its inverse are doubles


@dataclass(frozen=True)
class Grid:
    """Column j has codes of at most 2^bits, in units of 2^units_j: its bound is 2^(units_j + bits).

    bits: of a code's magnitude. units: shape (d,).
    """

    bits: int
    units: IntArray

    @classmethod
    def of(cls, bits: int, bounds: npt.ArrayLike, dimension: int) -> Grid:
        """The grid whose bounds are the next powers of two from `bounds` on, one number or one for each column."""
        wanted = np.asarray(bounds, dtype=np.float64)
        if wanted.ndim > 1 or wanted.size not in (1, dimension):
            raise InputError(f"expected one bound, or one for each of {dimension} columns; came shape {wanted.shape}")
        if not (np.isfinite(wanted).all() and (wanted >= 2.0**-REACH).all() and (wanted <= 2.0**REACH).all()):
            raise InputError(f"expected bounds from 2^-{REACH} to 2^{REACH}; came {wanted.min()} to {wanted.max()}")
        mantissa, exponent = np.frexp(np.broadcast_to(wanted, dimension))
        return cls(bits, exponent.astype(np.int64) - (mantissa == 0.5) - bits)

    def round(self, rows: FloatArray) -> FloatArray:
        """Rows, shape (n, d), rounded to the grid, as doubles.

        Raises InputError for the first value beyond its column's bound, naming row and column.
        """
        codes = np.rint(rows * np.exp2(-self.units))
        if not np.abs(codes).max(initial=0.0) <= 2.0**self.bits:
            row, column = np.argwhere(~(np.abs(codes) <= 2.0**self.bits))[0].tolist()
            raise InputError(
                f"expected values of magnitude at most {2.0 ** (self.units[column] + self.bits):g} in column {column}; "
                f"row {row} has {rows[row, column]:g}. Give a larger bound, or keep doubles as they are (no grid)"
            )
        rounded: FloatArray = codes * np.exp2(self.units)
        return rounded


def rounding_effect(system: IntegerSystem, weights: FloatArray, energy: FloatArray, rows: int) -> float:
    """The relative error, root mean square, that rounding to the system's units is expected to make in the weights.

    weights: W, shape (d, C); energy: the sum of squares of each target, shape (C,).

    To first order a change E of the rows X changes W by H (Eᵀ R − Xᵀ E W) with H = (A + λ)⁻¹ and R = Y − X W.
    Entries of E are independent, of variance v_j = unit_j² / 12; and E'E adds n v to the diagonal of A, as a ridge.
    Everything is counted in scaled columns, where a column's size is near 1. Infinite where H is out of reach.
    """
    try:
        inverse = FloatFactor(system).solve(np.eye(system.dimension))
    except NotDefiniteError:
        return np.inf
    variance = times_power(np.full(system.dimension, 1 / 12), 2 * system.scaling)
    scaled = times_power(weights, (system.units - system.scaling)[:, None])
    size = float(np.square(scaled).sum())
    if not size > 0:
        return 0.0
    value, exponent = to_float(system.right)
    right = times_power(value, exponent + system.scaling[:, None] + system.target_units)
    residual = float(np.maximum(energy - (scaled * right).sum(axis=0), 0).sum())
    spread = residual * float((np.square(inverse) @ variance).sum())
    spread += float(np.trace(inverse)) * float((np.square(scaled) * variance[:, None]).sum())
    bias = rows * float(np.linalg.norm(inverse @ (variance[:, None] * scaled)))
    return (float(np.sqrt(max(spread, 0.0))) + bias) / float(np.sqrt(size))
