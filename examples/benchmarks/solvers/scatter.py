"""The scatter of rows about the means of their groups, formed in integers: nothing cancels, whatever the means."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from examples.benchmarks.solvers.limbs import carry, from_integers, product, to_float, to_integers, total
from examples.benchmarks.solvers.systems import times_power

__all__ = ["scatter_about_means"]

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]


def scatter_about_means(second: IntArray, units: IntArray, counts: list[int], sums: IntArray) -> FloatArray:
    """S = A − Σ_y c_y c_yᵀ / n_y, shape (d, d), in the rows' own units.

    second: A in carried limbs, shape (limbs, d, d), entry (i, j) in units of 2^(units_i + units_j).
    counts: n_y > 0 of each group; sums: c_y in carried limbs, shape (limbs, d, groups).

    With m the integer next to c / n and r = c − n m, c cᵀ / n = c mᵀ + m rᵀ + r rᵀ / n, as in `within_scatter`:
    the first two are integers and leave A exactly, and the third is at most n / 4 units.
    """
    whole = to_integers(sums)
    n = np.array(counts, dtype=object)
    means = (2 * whole + n) // (2 * n)
    rests = whole - n * means
    m, r = from_integers(means).astype(np.float64), from_integers(rests).astype(np.float64)
    away = [carry(product(sums.astype(np.float64), m.transpose(0, 2, 1))), carry(product(m, r.transpose(0, 2, 1)))]
    left, _ = total([(second, 0), (-away[0], 0), (-away[1], 0)])
    value, exponent = to_float(left)
    power = units[:, None] + units
    small = (rests / np.sqrt(n.astype(np.float64))).astype(np.float64)
    scatter: FloatArray = times_power(value, exponent + power) - times_power(small @ small.T, power)
    return scatter
