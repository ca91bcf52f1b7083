"""Codes: quantised features, integers in units of a fixed grid, so that their sums are exact; and rows of them, stored.

A feature is a proportion of a window, so there are few values, and rows of one feature are alike: as a table of the
values, and for each feature which of these each row has, they take a third of the bytes on a disk.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["BITS", "in_units", "mean_code", "rows_of", "table_of", "to_codes"]

Codes = npt.NDArray[np.int32]

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


def table_of(rows: Codes) -> tuple[Codes, Codes]:
    """The different values of rows (n, d), all there, ascending, and the place of each code among them, (d, n)."""
    low = int(rows.min())
    offsets = (rows.T - low).astype(np.intp)
    # Codes are 21 bits: to look them up takes a thirtieth of the time that sorting takes.
    known = np.zeros(int(offsets.max()) + 1, dtype=bool)
    known[offsets] = True
    values = np.flatnonzero(known)
    place = np.empty(len(known), dtype=np.int32)
    place[values] = np.arange(len(values), dtype=np.int32)
    return (values + low).astype(np.int32), place[offsets]


def rows_of(values: Codes, places: Codes) -> Codes:
    """The rows that `table_of` gave values and places of."""
    return np.ascontiguousarray(values[places].T)
