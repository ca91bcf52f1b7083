"""What is expected of the arrays of a readout that was stored, which may come from elsewhere.

Their types, shapes and bounds are checked, so that no prediction fails or takes more memory because of them. Whether
their numbers are the fitted ones cannot be checked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.readout import Readout
from scroll_tactile.readouts.task import readout_from_arrays
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import MOST_ROWS
from scroll_tactile.validation.expected import array, counts, expect, whole

__all__ = ["ArrayReader", "stored_readout"]

FloatArray = npt.NDArray[np.float64]


class ArrayReader:
    """Reads arrays; raises Unexpected for those of another type or shape, or out of bounds."""

    def __init__(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        self.arrays = arrays

    def floats(
        self,
        field: str,
        shape: tuple[int | None, ...],
        least: float = -np.inf,
        most: float = np.inf,
        kinds: tuple[str, ...] = ("float64",),
    ) -> FloatArray:
        """Numbers within bounds; infinity only where `most` is infinite."""
        found = array(self.arrays, field, kinds, shape)
        ends = np.isposinf(found) & (most == np.inf) & (least >= 0)
        expect(bool((np.isfinite(found) | ends).all()), field, "finite numbers", "others")
        expect(bool(((found >= least) & (found <= most)).all()), field, f"from {least} to {most}", "others")
        return found

    def places(self, field: str, count: int, among: int) -> npt.NDArray[np.intp]:
        """Different places, so many of them."""
        found = counts(field, array(self.arrays, field, ("int64",), (count,)), 0, among - 1)
        expect(len(set(found.tolist())) == count, field, "different places", found)
        return found.astype(np.intp, copy=False)

    def length(self, field: str, most: int, least: int = 1, axes: int = 1) -> int:
        """How many rows an array has."""
        found = self.arrays.get(field)
        return whole(field, -1 if found is None or found.ndim != axes else len(found), least, most)


def stored_readout(reader: ArrayReader, scale: Scale, names: Sequence[str], dimension: int) -> Readout:
    """The readout of a scale; Unexpected for arrays of none. names: its materials, the reference first."""
    count = len(names)
    near = reader.length(f"near-sizes-{scale}", count)
    parts: dict[str, npt.NDArray[Any]] = {
        "origin": reader.floats(f"origin-{scale}", (dimension,)),
        "precision": reader.floats(f"precision-{scale}", (dimension,), 0.0, 1e300),
        "counts": reader.floats(f"counts-{scale}", (count,), 1.0, MOST_ROWS),
        "shape": reader.floats(f"shape-{scale}", (2,), 0.0, 1e300),
    }
    expect(parts["shape"][0] < 1, f"shape-{scale}", "a share below 1", parts["shape"])
    for part, held, kinds in (("near", near, ("float64",)), ("others", count - near, ("float32", "float64"))):
        parts[f"{part}-solved"] = solved = reader.floats(f"{part}-solved-{scale}", (held, dimension), kinds=kinds)
        parts[f"{part}-sizes"] = reader.floats(f"{part}-sizes-{scale}", (held,), -1e300, 1e300)
        # The means of the others are not read here, which would hold all of the mapped file: see `diagonal_distance`.
        means = array(reader.arrays, f"{part}-means-{scale}", (str(solved.dtype),), (held, dimension))
        expect(part == "others" or bool(np.isfinite(means).all()), f"near-means-{scale}", "finite numbers", "others")
        parts[f"{part}-means"] = means
    return readout_from_arrays(scale, names, parts)
