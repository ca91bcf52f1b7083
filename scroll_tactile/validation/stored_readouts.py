"""What is expected of the arrays of a readout that was stored, which may come from elsewhere.

Their types, shapes and bounds are checked, so that no prediction fails or takes more memory because of them. Whether
their numbers are the fitted ones cannot be checked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.pruning import PruningTable
from scroll_tactile.readouts.readout import Readout
from scroll_tactile.readouts.system import System
from scroll_tactile.readouts.task import readout_from_arrays
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import MOST_ROWS
from scroll_tactile.statistics.statistics import Statistics
from scroll_tactile.validation.expected import array, counts, expect, whole

__all__ = ["ArrayReader", "stored_readout"]

FloatArray = npt.NDArray[np.float64]
AT_ONCE = 4096  # rows that are checked at once


class ArrayReader:
    """Reads arrays; raises Unexpected for those of another type or shape, or out of bounds."""

    def __init__(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        self.arrays = arrays

    def floats(
        self, field: str, shape: tuple[int | None, ...], least: float = -np.inf, most: float = np.inf
    ) -> FloatArray:
        """Numbers within bounds; infinity only where `most` is infinite."""
        found = array(self.arrays, field, ("float64",), shape)
        ends = np.isposinf(found) & (most == np.inf) & (least >= 0)
        expect(bool((np.isfinite(found) | ends).all()), field, "finite numbers", "others")
        expect(bool(((found >= least) & (found <= most)).all()), field, f"from {least} to {most}", "others")
        return found

    def finite(self, field: str, kind: str, shape: tuple[int, ...]) -> npt.NDArray[Any]:
        """Finite numbers of a type, which may be many: they are looked at part by part. One axis: they are lengths."""
        found = array(self.arrays, field, (kind,), shape)
        least = 0.0 if len(shape) == 1 else -np.inf
        for first in range(0, len(found) if found.dtype.kind == "f" else 0, AT_ONCE):
            part = found[first : first + AT_ONCE]
            sound = np.isfinite(part) & (part >= least)
            expect(bool(sound.all()), field, "finite numbers", "others")
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


def stored_readout(
    reader: ArrayReader, scale: Scale, names: Sequence[str], statistics: Statistics, *, whole: bool
) -> Readout:
    """The readout of a scale; Unexpected for arrays of none. names: its materials. whole: see `readout_to_arrays`."""
    dimension, count = statistics.dimension, len(names)
    references = reader.length(f"reference-{scale}", count)
    held = reader.length(f"held-{scale}", count, references) if whole else count
    parts: dict[str, npt.NDArray[Any]] = {
        "reference": reader.places(f"reference-{scale}", references, count),
        "held": reader.places(f"held-{scale}", held, count),
        "rows": reader.floats(f"rows-{scale}", (held, 2, dimension)),
        "sizes": reader.floats(f"sizes-{scale}", (held,), -1e300, 1e300),
        "origin": reader.floats(f"origin-{scale}", (dimension,)),
        "precision": reader.floats(f"precision-{scale}", (dimension,), 0.0, 1e300),
        "counts": reader.floats(f"counts-{scale}", (count,), 1.0, MOST_ROWS),
        "shape": reader.floats(f"shape-{scale}", (2,), 0.0, 1e300),
    }
    expect(parts["shape"][0] < 1, f"shape-{scale}", "a share below 1", parts["shape"])
    own = parts["held"][:references]
    expect(bool((own == parts["reference"]).all()), f"held-{scale}", "the reference first", own)
    if whole:
        rank = reader.length(f"signs-{scale}", System.most_columns(dimension), 0)
        for name, shape in System.parts(dimension, rank).items():
            parts[name] = reader.floats(f"{name}-{scale}", shape)
    if whole and f"table-directions-{scale}" in reader.arrays:  # without them they are made again
        directions = reader.length(f"table-directions-{scale}", dimension, axes=2)
        for name, (kind, shape) in PruningTable.parts(count, dimension, directions).items():
            parts[f"table-{name}"] = reader.finite(f"table-{name}-{scale}", kind, shape)
    return readout_from_arrays(scale, names, parts, statistics)
