"""Systems that do not determine their solution: the exact rank, what is left open, and the smallest solution.

Whether a matrix of integers is singular is a question with an exact answer, which no tolerance gives. Its rank
modulo a prime is never larger than its rank, and smaller only where the prime divides a certain minor: for two
primes near 2³¹ a matter of less than one in 10¹⁵. So full rank is proven, and a lack of it certain enough.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg.lapack import dpstrf

from examples.benchmarks.solvers.limbs import LIMB
from examples.benchmarks.solvers.refinement import Refined, refined
from examples.benchmarks.solvers.systems import IntegerSystem, times_power
from scroll_tactile.statistics.moments import one_thread

__all__ = ["Undetermined", "independent_columns", "smallest_solution"]

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]

PRIMES = (2**31 - 1, 2**31 - 19)
SHOWS = 1e-9  # of a relation's largest term: smaller ones are what rounding leaves of zeros


def independent_columns(system: IntegerSystem) -> npt.NDArray[np.intp]:
    """Columns that are independent and span all, as many as the rank, ascending; λ is left out of account.

    They are looked for in the order of the pivoted Cholesky factorisation (LAPACK's dpstrf), so that they are well
    conditioned; how many there are is decided exactly.
    """
    with one_thread():
        _, order, _, _ = dpstrf(system.scaled, tol=0.0)
    found = max((_independent(system.matrix, order - 1, prime) for prime in PRIMES), key=len)
    return np.sort(found)


def _independent(matrix: IntArray, order: npt.NDArray[np.intp], prime: int) -> npt.NDArray[np.intp]:
    """Those columns, in the order given, that do not depend on ones before, by elimination modulo a prime."""
    rest = np.zeros(matrix.shape[1:], dtype=np.int64)
    for limb in matrix[::-1]:
        rest = (rest * 2**LIMB + limb) % prime
    rest = rest[order][:, order]
    kept: list[int] = []
    for column in range(len(rest)):
        row = len(kept)
        below = np.flatnonzero(rest[row:, column])
        if not len(below):
            continue
        pivot = row + below[0]
        rest[[row, pivot]] = rest[[pivot, row]]
        inverse = pow(int(rest[row, column]), -1, prime)
        rest[row, column:] = rest[row, column:] * inverse % prime
        others = row + 1 + np.flatnonzero(rest[row + 1 :, column])
        rest[others, column:] -= rest[others, column, None] * rest[row, column:] % prime
        rest[others, column:] %= prime
        kept.append(column)
    return order[kept]


@dataclass(frozen=True)
class Undetermined:
    """What a singular system leaves open.

    rank: of d columns. directions: unit vectors v, shape (d, d − rank): W + v · anything fits as well.
    columns: those that have a part in any direction. relation: the first one in words.
    """

    rank: int
    directions: FloatArray
    columns: tuple[int, ...]
    relation: str


def smallest_solution(system: IntegerSystem, kept: npt.NDArray[np.intp]) -> tuple[Refined, Undetermined]:
    """The solution of a singular system that has the smallest ‖W‖, and what is left open; λ is 0.

    With the independent columns I and the others J: solutions are those of A_II w = B_I with zeros elsewhere, and
    whatever is added of N = [−V; 1] where A_II V = A_IJ. The smallest is what is left after projecting N out.
    """
    dimension, outputs = system.dimension, system.right.shape[2]
    left = np.setdiff1d(np.arange(dimension), kept)
    sides = [system.right[:, kept], system.matrix[:, kept][:, :, left]]
    right = np.zeros((max(map(len, sides)), len(kept), outputs + len(left)), dtype=np.int64)
    right[: len(sides[0]), :, :outputs] = sides[0]
    right[: len(sides[1]), :, outputs:] = sides[1]
    if len(kept):
        part = refined(system.take(kept, right, np.concatenate([system.target_units, system.units[left]])))
    else:
        part = Refined(np.zeros((0, outputs + len(left))), "none", 0, True, 0.0, 1.0, np.zeros(0))
    weights = np.zeros((dimension, outputs))
    weights[kept] = part.weights[:, :outputs]
    open_ = np.zeros((dimension, len(left)))
    open_[kept] = -part.weights[:, outputs:]
    open_[left, np.arange(len(left))] = 1.0
    basis, _ = np.linalg.qr(open_ / np.abs(open_).max(axis=0))
    for _ in range(2):  # the second time takes out what rounding left the first time
        weights = weights - basis @ (basis.T @ weights)
    return (
        replace(part, weights=weights, weakest=np.zeros(0)),
        Undetermined(len(kept), basis, *_in_words(system, open_, kept, left)),
    )


def _in_words(
    system: IntegerSystem, open_: FloatArray, kept: npt.NDArray[np.intp], left: npt.NDArray[np.intp]
) -> tuple[tuple[int, ...], str]:
    """The columns that have a part in any relation, and the first relation: a column by independent ones."""
    # Terms are compared in the columns' own sizes: with W in the units where each column has a size near 1.
    sizes = times_power(np.ones(system.dimension), -system.scaling + system.units)
    terms = np.abs(open_) * sizes[:, None]
    terms[left, np.arange(len(left))] = np.maximum(terms[left, np.arange(len(left))], 1e-300)
    shown = terms > SHOWS * terms.max(axis=0)
    first = int(left[0])
    parts = [f"{-open_[at, 0]:.6g} × column {at}" for at in kept[shown[kept, 0]]]
    if len(parts) > 4:
        parts = [*parts[:4], f"{len(parts) - 4} more terms"]
    said = f"column {first} is " + (" + ".join(parts) if parts else "zero in every row")
    return tuple(np.flatnonzero(shown.any(axis=1)).tolist()), said
