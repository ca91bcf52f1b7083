"""Iterative refinement of a solution against the integers: what the factorisation loses is won back.

u ← u + F⁻¹ (b − M u), with the residual exact and u in two doubles (Wilkinson 1963; with the extra precision as in
Demmel, Hida, Kahan, Li, Mukherjee & Riedy 2006, ACM TOMS 32). Where F is a factorisation so good that the corrections
shrink at a rate ρ < 1, what is left of the error after the last one, δ, is at most ρ / (1 − ρ) · |δ|.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from examples.benchmarks.solvers.factors import Factor, FloatFactor, NotDefiniteError, factors
from examples.benchmarks.solvers.limbs import LIMB, to_float
from examples.benchmarks.solvers.systems import IntegerSystem, times_power

__all__ = ["Refined", "clearly_definite", "condition_of", "refine", "refined", "sees"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

ENOUGH = 2.0**-60  # of the solution: a correction so small does not show in a double any more
EACH = 2.0**-55  # of an entry
EXTRA = 3  # corrections for the sake of small entries
SLOWEST = 2.0**-6  # rate of corrections: with a slower one a more precise factorisation is sooner there
STEPS = 12  # of rate 2⁻⁶ reach 2⁻⁶⁰ and more
ROUNDING = 2.0**-53


@dataclass(frozen=True)
class Refined:
    """A solution and how it was reached.

    weights: W, shape (d, C), rounded once.
    arithmetic: of the factorisation. steps: corrections. bound: of the relative error of a column of the scaled
    solution, in the largest component. condition: of the scaled matrix, an estimate. weakest: the unit vector of
    the direction that is determined least, shape (d,), in scaled columns.
    """

    weights: FloatArray
    arithmetic: str
    steps: int
    converged: bool
    bound: float
    condition: float
    weakest: FloatArray


def refined(system: IntegerSystem) -> Refined:
    """Solve with ever better factorisations until one lets refinement converge; else the best there was."""
    best: Refined | None = None
    for factor in factors(system):
        found = refine(system, factor)
        if found.converged:
            return found
        if best is None or found.bound < best.bound:
            best = found
    if best is None:
        nothing = np.full((system.dimension, system.right.shape[2]), np.nan)
        best = Refined(nothing, "none", 0, False, np.inf, np.inf, np.zeros(system.dimension))
    return best


def refine(system: IntegerSystem, factor: Factor) -> Refined:
    """Solve with one factorisation and refine until the corrections no longer show, or no longer shrink."""
    q = system.scaling[:, None]
    size = _sizes(system, q)
    u = np.zeros((2, *system.right.shape[1:]))
    rest, base = system.right, 0
    bound, before, converged_at, steps = np.inf, np.inf, 0, 0
    while steps < STEPS:
        try:
            parts = factor.correct(rest, LIMB * base + q - size)
        except OverflowError:  # the solution is too large for float64
            break
        if not np.isfinite(parts).all():
            break
        for part in parts:
            u = _added(u, part)
        steps += 1
        step, each = _relative(parts[0], u[0])
        if steps > 1:
            rate = step / before
            bound = step * rate / (1 - rate) + ROUNDING if rate < 1 else np.inf
        if step <= ENOUGH and not converged_at:
            converged_at = steps
        # Entries that are small beside the largest may have to wait for theirs; those that cancel wait in vain.
        if converged_at and (each <= EACH or steps >= converged_at + EXTRA):
            break
        if not converged_at and steps > 1 and step > SLOWEST * before:
            break
        before = step
        rest, base = system.residual(u, q + size)
    # W = 2^(target_units − units) U, and U = 2^(q + size) u.
    power = q + size + system.target_units - system.units[:, None]
    weights = times_power(u[0], power) + times_power(u[1], power)
    condition, weakest = condition_of(system, factor)
    converged = converged_at > 0 and sees(system, factor, weakest)
    return Refined(weights, factor.name, steps, converged, bound if converged else np.inf, condition, weakest)


def _sizes(system: IntegerSystem, q: IntArray) -> IntArray:
    """Exponents, shape (C,), of the largest entry of each scaled right-hand side; 0 for a column of zeros."""
    value, exponent = to_float(system.right)
    reach = np.where(value == 0, -(2**20), np.frexp(value)[1] + exponent + q).max(axis=0)
    return np.where(reach == -(2**20), 0, reach)


def _added(u: FloatArray, part: FloatArray) -> FloatArray:
    """Two doubles and one, added (Knuth's two-sum, then renormalised)."""
    high = u[0] + part
    back = high - u[0]
    low = u[1] + ((u[0] - (high - back)) + (part - back))
    first = high + low
    return np.stack([first, low - (first - high)])


def _relative(part: FloatArray, whole: FloatArray) -> tuple[float, float]:
    """A correction by the solution: its largest entry by that of its column, and entry by entry; of the worst."""
    size, largest = np.abs(part), np.abs(whole).max(axis=0)
    by_column = size.max(axis=0) / np.where(largest == 0, 1.0, largest)
    with np.errstate(divide="ignore", over="ignore"):
        by_entry = np.divide(size, np.abs(whole), out=np.zeros_like(size), where=size > 0)
    return float(by_column.max()), float(by_entry.max())


def sees(system: IntegerSystem, factor: Factor, weakest: FloatArray) -> bool:
    """Whether the factorisation gives back its weakest direction v from M v, and is not blind there.

    Where rounding made the factor far stiffer than M in some direction, corrections along it are small because they
    are cut short, not because nothing is left to correct; F⁻¹ M v = v tells the two apart.
    """
    q = system.scaling[:, None]
    nothing = np.zeros((1, system.dimension, 1), dtype=np.int64)
    alone = replace(system, right=nothing, target_units=np.zeros(1, dtype=np.int64))
    rest, base = alone.residual(weakest[None, :, None], q)
    try:
        back = -factor.correct(rest, LIMB * base + q).sum(axis=0)[:, 0]
    except OverflowError:
        return False
    return bool(np.abs(back - weakest).max() <= SLOWEST * np.abs(weakest).max())


def clearly_definite(system: IntegerSystem) -> bool:
    """Whether float64 alone proves the matrix not singular: rounding could not have hidden it.

    Of a singular matrix Cholesky factorises, if anything, one that differs from it by less than about 4 d² units of
    rounding, so with a condition of 2⁵¹ / d² or more; a sixteenth of that leaves room for the estimate's.
    """
    try:
        condition, _ = condition_of(system, FloatFactor(system))
    except NotDefiniteError:
        return False
    return condition * system.dimension**2 < 2.0**47


def condition_of(system: IntegerSystem, factor: Factor) -> tuple[float, FloatArray]:
    """The condition of the scaled matrix, and the unit vector it determines least, by inverse iteration."""
    vector = np.random.default_rng(0).normal(size=(system.dimension, 1))
    vector /= np.linalg.norm(vector)
    length = 0.0
    for _ in range(4):
        try:
            grown = factor.solve(vector)
        except OverflowError:
            return np.inf, vector[:, 0]
        largest = float(np.abs(grown).max())
        if not 0 < largest < 1e300:
            return np.inf, vector[:, 0]
        grown /= largest
        length = float(np.linalg.norm(grown))
        vector, length = grown / length, length * largest
    return float(np.linalg.norm(system.scaled)) * length, vector[:, 0]
