"""How a readout is made: solved from the statistics of one moment, or read from the arrays of an earlier one.

Shrinkage is in closed form: how far the scatter within materials is drawn to a multiple of the identity.

With S = S_w / N of n touches, Σ = (1 − ρ) S + ρ (tr S / d) I, and ρ of least expected squared error where features are
normally distributed (the oracle approximating shrinkage of Chen, Wiesel, Eldar and Hero 2010, IEEE Trans. Signal
Processing 58, equation 23):

    ρ = [(1 − 2/d) tr S² + tr² S] / [(n + 1 − 2/d) (tr S² − tr² S / d)].

It needs S alone, so there is nothing to hold out and nothing to choose.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.readout import Means, Numbers, Readout
from scroll_tactile.readouts.system import System
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import Sums, one_thread, within_scatter
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["LARGEST", "LEAST", "Task", "readout_from_arrays", "readout_to_arrays", "shrinkage"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FIRST_KNOWN = 256  # materials
IN_DOUBLE = 1024  # materials: of more, those beyond the reference are held in single precision, within 1e-6 of scores
AT_ONCE = 1024  # materials that are solved for at once
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

    def solve(self, like: Readout | None = None) -> Readout:
        """The readout. like: an earlier one of the same reference, to which scores stay comparable.

        Raises numpy.linalg.LinAlgError where K is not positive definite to working precision.
        """
        origin, matrix = self.origin, self.scatter
        trace, dimension = float(np.trace(matrix)), len(matrix)
        share = 0.0
        if trace > 0:
            share = shrinkage(matrix, self.touches, self.times) if like is None else like.share
        others = np.setdiff1d(np.arange(len(self.names)), self.reference)
        order = np.concatenate([self.reference, others])
        # Single rows have no scatter: the readout then is the nearest mean.
        penalty = trace / dimension * share / (1 - share)
        if not penalty > 0:  # an earlier one had no share of a scatter either: its penalty stays, as where it follows
            squares = sum(float(np.square(means).sum()) for _, means in self._means(order))
            own = max(squares / (len(order) * dimension), 1.0)
            penalty = own if like is None or trace == 0 else like.penalty
        matrix[np.diag_indices(dimension)] += penalty
        counts = self.counts.astype(np.float64)
        precision: FloatArray = counts.sum() / np.diagonal(matrix) if like is None else like.precision
        single = len(self.names) > IN_DOUBLE
        with one_thread():
            system = System(matrix)
            del matrix  # 8 MB
            near = self._solved(system, self.reference, np.float64)
            rest = self._solved(system, others, np.float32 if single else np.float64)
        numbers = Numbers(origin, counts[order], share, penalty, precision)
        return Readout(self.scale, [self.names[place] for place in order], system, near, rest, numbers)

    def _means(self, places: npt.NDArray[np.intp]) -> Iterator[tuple[slice, FloatArray]]:
        """The means of materials at some places about the origin, (k, d) in grid units, block after block."""
        # Sums about the integers nearest to the origin are exact, so a mean close to the origin loses no digits.
        origin = self.origin
        near = np.rint(origin)
        for first in range(0, len(places), AT_ONCE):
            own = places[first : first + AT_ONCE]
            about = self.sums[own] - np.outer(self.counts[own], near.astype(np.int64))
            yield slice(first, first + len(own)), about / self.counts[own, None] - (origin - near)

    def _solved(self, system: System, places: npt.NDArray[np.intp], kind: type[np.floating]) -> Means:
        """The materials at some places."""
        shape = len(places), self.sums.shape[1]
        found = Means(np.empty(shape, kind), np.empty(shape, kind), np.empty(len(places)))
        for rows, means in self._means(places):
            found.put(rows, means, system.solve(means))
        return found


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


PARTS = "near", "others"


def readout_to_arrays(readout: Readout) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a readout.

    near-means, near-solved, near-sizes, and others- likewise: as `Means` has them. origin, precision: (d,). counts:
    (C,). shape: share and penalty.
    """
    return {
        **{f"{part}-{name}": array for part in PARTS for name, array in vars(getattr(readout, part)).items()},
        "origin": readout.origin,
        "precision": readout.precision,
        "counts": readout.counts,
        "shape": np.array([readout.share, readout.penalty]),
    }


def readout_from_arrays(scale: Scale, names: Sequence[str], arrays: Mapping[str, npt.NDArray[Any]]) -> Readout:
    """The readout of which `readout_to_arrays` gave the arrays, which are taken over; it can follow nothing."""
    near, others = (Means(*(arrays[f"{part}-{name}"] for name in ("means", "solved", "sizes"))) for part in PARTS)
    origin = arrays["origin"]
    share, penalty = arrays["shape"].tolist()
    numbers = Numbers(origin, arrays["counts"], share, penalty, arrays["precision"])
    return Readout(scale, names, System.unkept(len(origin)), near, others, numbers)
