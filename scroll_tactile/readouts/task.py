"""How a readout is made: solved from the statistics of one moment, or read from the arrays of an earlier one.

Shrinkage is in closed form: how far the scatter within materials is drawn to a multiple of the identity.

With S = S_w / N of n touches, Σ = (1 − ρ) S + ρ (tr S / d) I, and ρ of least expected squared error where features are
normally distributed (the oracle approximating shrinkage of Chen, Wiesel, Eldar and Hero 2010, IEEE Trans. Signal
Processing 58, equation 23):

    ρ = [(1 − 2/d) tr S² + tr² S] / [(n + 1 − 2/d) (tr S² − tr² S / d)].

It needs S alone, so there is nothing to hold out and nothing to choose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.held_means import HeldMeans, class_means
from scroll_tactile.readouts.pruning import ManyMaterials, PruningTable
from scroll_tactile.readouts.readout import Numbers, Readout, held_at_first
from scroll_tactile.readouts.system import System
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import Sums, one_thread, within_scatter
from scroll_tactile.statistics.statistics import Snapshot, Statistics

__all__ = ["LARGEST", "LEAST", "Task", "readout_from_arrays", "readout_to_arrays", "shrinkage"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FIRST_KNOWN = 256  # materials
# Bounds of ρ. Below LEAST the solution would not be accurate to 1e-9; above LARGEST nothing would be left of S. A
# memory of a million touches stays above LEAST.
LEAST, LARGEST = 1e-4, 0.99


@dataclass(frozen=True)
class Task:
    """The input of a readout's solution: the statistics at one moment, copied, so that solving needs no lock.

    packed: A, as in SecondMoment. names: the materials with rows, counts: their rows, shape (C,), sums: of their codes,
    shape (C, d). reference: the places of the materials that novelty and calibration use. touches: n. times: the
    factor by which the shrinkage of the formula is multiplied.
    """

    scale: Scale
    packed: IntArray
    names: list[str]
    counts: IntArray
    sums: Sums
    reference: npt.NDArray[np.intp]
    touches: int
    times: float = 1.0

    @classmethod
    def of(cls, statistics: Statistics, scale: Scale, reference: Sequence[str], times: float = 1.0) -> Task:
        """The task of a scale that has rows. reference: materials, of which those with rows at the scale count."""
        names = statistics.names(scale)
        places = {name: place for place, name in enumerate(names)}
        # If no sampled touch has rows at this scale, the first materials with rows are the reference.
        known = [places[name] for name in reference if name in places] or range(min(len(names), FIRST_KNOWN))
        own = np.array(known, dtype=np.intp)
        packed, (counts, sums) = statistics.second(scale).packed(), statistics.totals(scale)
        return cls(scale, packed, names, counts, sums, own, statistics.touches, times)

    @property
    def scatter(self) -> FloatArray:
        """S_w, shape (d, d): the lower triangle, formed anew each time."""
        return within_scatter(self.packed, self.counts, self.sums)

    @property
    def origin(self) -> FloatArray:
        """The mean of all rows, shape (d,)."""
        return np.asarray(
            (self.sums.sum(axis=0, dtype=np.int64).astype(np.longdouble) / self.counts.sum()).astype(np.float64)
        )

    def solve(self, statistics: Statistics | Snapshot, like: Readout | None = None) -> Readout:
        """The readout. like: an earlier one of the same reference, to which scores stay comparable.

        Raises numpy.linalg.LinAlgError where K is not positive definite to working precision.
        """
        origin, matrix = self.origin, self.scatter
        trace, dimension = float(np.trace(matrix)), len(matrix)
        share = 0.0
        if trace > 0:
            share = shrinkage(matrix, self.touches, self.times) if like is None else like.share
        places = held_at_first(self.reference, len(self.names))
        means = class_means(self.counts[places], self.sums[places], origin)
        # Single rows have no scatter: the readout then is the nearest mean.
        penalty = trace / dimension * share / (1 - share)
        if not penalty > 0:  # an earlier one had no share of a scatter either: its penalty stays, as where it follows
            penalty = max(float(np.mean(np.square(means))), 1.0) if like is None or trace == 0 else like.penalty
        matrix[np.diag_indices(dimension)] += penalty
        counts = self.counts.astype(np.float64)
        precision: FloatArray = counts.sum() / np.diagonal(matrix) if like is None else like.precision
        held = HeldMeans.none(dimension)
        with one_thread():
            system = System(matrix)
            held.add(places, means, system.solve(means))
        numbers = Numbers(self.reference, origin, counts, share, penalty, precision)
        return Readout(self.scale, self.names, statistics, system, held, numbers)


def shrinkage(scatter: FloatArray, touches: int, times: float = 1.0) -> float:
    """ρ times `times`, within bounds. scatter: in any unit, (d, d), of which the lower triangle is read."""
    dimension = len(scatter)
    diagonal = np.diagonal(scatter)
    trace = float(diagonal.sum())
    below = sum(float(row[:i] @ row[:i]) for i, row in enumerate(scatter))  # no copy of 8 MB
    squares = 2.0 * below + float(diagonal @ diagonal)
    spread = squares - trace**2 / dimension  # zero where S is a multiple of the identity already
    if not spread > 0:
        return LARGEST
    ratio = ((1 - 2 / dimension) * squares + trace**2) / ((touches + 1 - 2 / dimension) * spread)
    return float(min(max(times * ratio, LEAST), LARGEST))


def readout_to_arrays(readout: Readout, *, whole: bool) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a readout.

    reference: places, (R,). held: places in the order of what is held, (H,). rows: their means about the origin,
    and K⁻¹ times these, (H, 2, d). sizes: (H,). origin, precision: (d,). counts: (C,). shape: share and penalty.

    whole: with the system, by which materials that are not held are solved for, as `System.to_arrays` has it; and with
    the table of `pruning`, where there are too many materials to hold, its arrays' names with "table-" before them.
    """
    held = readout.held_means
    arrays: dict[str, npt.NDArray[Any]] = {
        "reference": readout.reference,
        "held": np.array(held.places, dtype=np.int64),
        "rows": held.pairs,
        "sizes": held.sizes,
        "origin": readout.origin,
        "precision": readout.precision,
        "counts": readout.counts,
        "shape": np.array([readout.share, readout.penalty]),
    }
    if not whole:
        return arrays
    if not readout.holds_all:
        arrays |= {f"table-{name}": part for name, part in readout.many.table.to_arrays().items()}
    return arrays | readout.system.to_arrays()


def readout_from_arrays(
    scale: Scale, names: Sequence[str], arrays: Mapping[str, npt.NDArray[Any]], statistics: Statistics
) -> Readout:
    """The readout of which `readout_to_arrays` gave the arrays, which are taken over; it can follow nothing."""
    reference, origin, counts, precision = (arrays[name] for name in ("reference", "origin", "counts", "precision"))
    share, penalty = arrays["shape"].tolist()
    numbers = Numbers(reference, origin, counts, share, penalty, precision)
    held = HeldMeans(arrays["held"].tolist(), arrays["rows"], arrays["sizes"])
    system = System.from_arrays(arrays) if "triangle" in arrays else System.unkept(len(origin))
    table = {name.removeprefix("table-"): part for name, part in arrays.items() if name.startswith("table-")}
    readout = Readout(scale, names, statistics, system, held, numbers)
    if table:
        readout.many = ManyMaterials(readout, PruningTable.from_arrays(table))
    return readout
