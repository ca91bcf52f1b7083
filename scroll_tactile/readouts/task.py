"""How a readout is made: solved from the statistics of one moment, its shrinkage in closed form.

With S = S_w / N of n touches, Σ = (1 − ρ) S + ρ (tr S / d) I, and ρ of least expected squared error where features are
normally distributed (the oracle approximating shrinkage of Chen, Wiesel, Eldar and Hero 2010, IEEE Trans. Signal
Processing 58, equation 23):

    ρ = [(1 − 2/d) tr S² + tr² S] / [(n + 1 − 2/d) (tr S² − tr² S / d)].

It needs S alone, so there is nothing to hold out and nothing to choose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.readout import Readout
from scroll_tactile.readouts.triangle import InverseTriangle
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import SecondMoment, Sums, one_thread, within_scatter
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["LARGEST", "LEAST", "Task", "shrinkage"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FIRST_KNOWN = 256  # materials
# Bounds of ρ. Below LEAST the solution would not be accurate to 1e-9; above LARGEST nothing would be left of S. A
# memory of a million touches stays above LEAST.
LEAST, LARGEST = 1e-4, 0.99


@dataclass(frozen=True)
class Task:
    """The input of a readout's solution: the statistics at one moment, copied, so that solving needs no lock.

    names, reference, counts, sums: see `Readout`. second: a copy, of which the thread that solves forms the products
    that wait. touches: n. times: the factor by which the shrinkage of the formula is multiplied.
    """

    scale: Scale
    names: list[str]
    reference: list[str]
    counts: IntArray
    sums: Sums
    second: SecondMoment
    touches: int
    times: float

    @classmethod
    def of(cls, statistics: Statistics, scale: Scale, reference: Sequence[str], times: float = 1.0) -> Task:
        """The task of a scale that has rows. reference: materials, of which those with rows at the scale count."""
        names = statistics.names(scale)
        there = set(names)
        # If no sampled touch has rows at this scale, the first materials with rows are the reference.
        near = [name for name in reference if name in there] or names[:FIRST_KNOWN]
        names = near + sorted(there.difference(near))
        counts, sums = statistics.totals(scale, names)
        return cls(scale, names, near, counts, sums, statistics.second(scale).copy(), statistics.touches, times)

    @property
    def scatter(self) -> FloatArray:
        """S_w, shape (d, d): the lower triangle, formed anew each time."""
        return within_scatter(self.second.packed(), self.counts, self.sums)

    @property
    def origin(self) -> FloatArray:
        """The mean of all rows, shape (d,)."""
        total = self.sums.sum(axis=0, dtype=np.int64).astype(np.longdouble)
        return np.asarray((total / self.counts.sum()).astype(np.float64))

    def solve(self) -> Readout:
        """The readout. Raises numpy.linalg.LinAlgError where K is not positive definite to working precision."""
        origin, matrix = self.origin, self.scatter
        trace, dimension, rows = float(np.trace(matrix)), len(matrix), int(self.counts.sum())
        share = shrinkage(matrix, self.touches, self.times) if trace > 0 else 0.0
        penalty = trace / dimension * share / (1 - share)
        if not penalty > 0:  # single rows have no scatter: the readout then is the nearest mean
            penalty = max(float(np.square(self.sums / self.counts[:, None] - origin).mean()), 1.0)
        matrix[np.diag_indices(dimension)] += penalty
        with one_thread():
            triangle = InverseTriangle(matrix)
        own, precision = (self.scale, self.names, self.reference, self.counts, self.sums), rows / np.diagonal(matrix)
        return Readout(*own, origin, triangle, rows / (1 - share), share, penalty, precision)


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
