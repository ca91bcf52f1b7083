"""How a readout is made: solved from the statistics of one moment.

Shrinkage is in closed form: how far the scatter within materials is drawn to a multiple of the identity.

With S = S_w / N of n touches, Σ = (1 − ρ) S + ρ (tr S / d) I, and ρ of least expected squared error where features are
normally distributed (the oracle approximating shrinkage of Chen, Wiesel, Eldar and Hero 2010, IEEE Trans. Signal
Processing 58, equation 23):

    ρ = [(1 − 2/d) tr S² + tr² S] / [(n + 1 − 2/d) (tr S² − tr² S / d)].

It needs S alone, so there is nothing to hold out and nothing to choose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.readout import BLOCK, Means, Readout, Solution, about
from scroll_tactile.readouts.triangle import InverseTriangle
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import SecondMoment, Sums, one_thread, within_scatter
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["LARGEST", "LEAST", "Task", "shrinkage"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FIRST_KNOWN = 256  # materials
IN_DOUBLE = 1024  # materials: of more, those beyond the reference are held in single precision, within 1e-6 of scores
# Bounds of ρ. Below LEAST the solution would not be accurate to 1e-9; above LARGEST nothing would be left of S. A
# memory of a million touches stays above LEAST.
LEAST, LARGEST = 1e-4, 0.99


@dataclass(frozen=True)
class Task:
    """The input of a readout's solution: the statistics at one moment, copied, so that solving needs no lock.

    second: a copy, of which the thread that solves forms the products that wait. names: the materials with rows,
    counts: their rows, shape (C,), sums: of their codes, shape (C, d). reference: the places of the materials that
    novelty and calibration use. touches: n. times: the factor by which the shrinkage of the formula is multiplied.
    """

    scale: Scale
    second: SecondMoment
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
        counts, sums = statistics.totals(scale, names)
        return cls(scale, statistics.second(scale).copy(), names, counts, sums, own, statistics.touches, times)

    def without(self, material: str, rows: npt.NDArray[np.int32]) -> Task:
        """The same task without a touch of these rows, codes (k, d): as if it had never been observed.

        Another touch has rows at the scale. If no reference material is left, the first are the reference.
        """
        place = self.names.index(material)
        second, counts, sums = self.second.copy(), self.counts.copy(), self.sums.copy()
        second.remove(rows)
        counts[place] -= len(rows)
        sums[place] -= rows.sum(axis=0, dtype=np.int64).astype(sums.dtype)
        stay, reference = np.flatnonzero(counts), self.reference[counts[self.reference] > 0]
        return replace(
            self,
            second=second,
            names=[self.names[i] for i in stay],
            counts=counts[stay],
            sums=sums[stay],
            reference=np.searchsorted(stay, reference) if len(reference) else np.arange(min(len(stay), FIRST_KNOWN)),
            touches=self.touches - 1,
        )

    @property
    def scatter(self) -> FloatArray:
        """S_w, shape (d, d): the lower triangle, formed anew each time."""
        return within_scatter(self.second.packed(), self.counts, self.sums)

    @property
    def origin(self) -> FloatArray:
        """The mean of all rows, shape (d,)."""
        return np.asarray(
            (self.sums.sum(axis=0, dtype=np.int64).astype(np.longdouble) / self.counts.sum()).astype(np.float64)
        )

    def solve(self) -> Readout:
        """The readout. Materials beyond the reference are solved for when they are first asked for.

        Raises numpy.linalg.LinAlgError where K is not positive definite to working precision.
        """
        origin, matrix = self.origin, self.scatter
        trace, dimension = float(np.trace(matrix)), len(matrix)
        share = shrinkage(matrix, self.touches, self.times) if trace > 0 else 0.0
        others = np.setdiff1d(np.arange(len(self.names)), self.reference)
        places = [self.reference, *(others[first : first + BLOCK] for first in range(0, len(others), BLOCK))]
        penalty = trace / dimension * share / (1 - share)
        if not penalty > 0:  # single rows have no scatter: the readout then is the nearest mean
            squares = sum(float(np.square(about(self.counts[own], self.sums[own], origin)).sum()) for own in places)
            penalty = max(squares / (len(self.names) * dimension), 1.0)
        matrix[np.diag_indices(dimension)] += penalty
        rows = int(self.counts.sum())
        with one_thread():
            triangle = InverseTriangle(matrix)
        solution = Solution(origin, triangle, rows, share, penalty, rows / np.diagonal(matrix))
        single = len(self.names) > IN_DOUBLE
        near, *rest = (
            Means(self.counts[own], self.sums[own], solution, single=single and number > 0)
            for number, own in enumerate(places)
        )
        return Readout(self.scale, [self.names[i] for own in places for i in own], near, rest, solution)


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
