"""Codes: quantised features, integers in units of a fixed grid, so that their sums are exact."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["BITS", "in_units", "mean_code", "to_codes"]

BITS = 20  # the grid: bound · 2⁻²⁰. 2²⁰ · 2²⁰ · 8192 rows is 2⁵³, the last integer that float64 counts to


def to_codes(features: npt.NDArray[np.floating], bound: float) -> npt.NDArray[np.int32]:
    """Round features to integers of magnitude at most 2²⁰, in units of bound · 2⁻²⁰; same shape.

    features: finite and within the bound, see `embeddings.protocol.require_features`.
    """
    return np.rint(in_units(features, bound)).astype(np.int32)


def in_units(features: npt.NDArray[np.floating], bound: float) -> npt.NDArray[np.float64]:
    """Features in grid units, bound · 2⁻²⁰, not rounded; float64 of the same shape."""
    return np.asarray(np.multiply(features, 2.0**BITS / bound, dtype=np.float64))


def mean_code(total: npt.NDArray[np.integer], rows: int | npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Σ x / n rounded to integers (halves upward), the same on every machine; total: Σ x, any shape; rows: n > 0."""
    whole: npt.NDArray[np.int64] = total.astype(np.int64)
    return (2 * whole + rows) // (2 * rows)
