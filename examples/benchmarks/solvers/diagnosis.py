"""The solution of an exact system, with a diagnosis by name in place of a silent wrong answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from examples.benchmarks.solvers.refinement import Refined, clearly_definite, refined
from examples.benchmarks.solvers.singular import Undetermined, independent_columns, smallest_solution
from examples.benchmarks.solvers.systems import IntegerSystem, times_power
from scroll_tactile.errors import InputError, SingularError

__all__ = ["Diagnosis", "OnSingular", "solve_exact"]

FloatArray = npt.NDArray[np.float64]
OnSingular = Literal["raise", "diagnose"]
Verdict = Literal["sound", "rounded", "ill conditioned", "singular", "out of range", "not converged"]

ILL = 2.0**53  # condition: from here on the last bit of a row can change the first digit of the weights
PART = 0.1  # of the largest entry of a direction: columns with less are not named


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What is to be said of exact weights.

    verdict: "sound"; "rounded": the rows were rounded to a grid; "ill conditioned": right for these rows, but
        their last bits decide; "singular": other weights fit as well; "out of range": some are too large for a
        double; "not converged": do not use them.
    rank: of d columns, as decided exactly; d where λ > 0.
    condition: of A + λ I with columns brought to one size, an estimate; where singular, of independent columns.
    directions: unit vectors in the columns' units, shape (d, d − rank), along which the weights are undetermined;
        where there are none, the one that is determined least, shape (d, 1).
    columns: those that have a part in them. relation: a singular system's first dependence, in words.
    arithmetic: of the factorisation. steps: of refinement, and whether it converged.
    error_bound: of the weights' relative error against the exact solution for the rows as they are summed.
    rounding: the relative error that the grid is expected to have made, 0 without one.
    """

    verdict: Verdict
    rank: int
    dimension: int
    condition: float
    directions: FloatArray
    columns: tuple[int, ...]
    relation: str
    arithmetic: str
    steps: int
    converged: bool
    error_bound: float
    rounding: float

    def __str__(self) -> str:
        if self.verdict == "singular":
            said = f"singular: rank {self.rank} of {self.dimension}; {self.relation}"
            return said + (f"; the rest has condition {self.condition:.1e}" if self.condition >= ILL else "")
        if self.verdict == "not converged":
            return f"not converged: condition {self.condition:.1e}, error up to {self.error_bound:.1e}"
        if self.verdict == "out of range":
            return "out of range: some weights exceed what a double can hold"
        if self.verdict == "ill conditioned":
            named = ", ".join(map(str, self.columns[:6])) + (" …" if len(self.columns) > 6 else "")
            said = f"ill conditioned: {self.condition:.1e}, least determined in columns {named}"
            return said + (f"; rounded: expect {self.rounding:.1e}" if self.rounding else "")
        if self.verdict == "rounded":
            return f"rounded: expect an error of {self.rounding:.1e} from the grid"
        return f"sound: condition {self.condition:.1e}"


def solve_exact(system: IntegerSystem, on_singular: OnSingular = "raise") -> tuple[FloatArray, Diagnosis]:
    """W of shape (d, C), right to the last bit or two, and what is to be said of it.

    Where λ = 0 and the system is singular, or weights are out of a double's range, SingularError is raised, saying
    which columns depend on which. With on_singular="diagnose" the diagnosis says it instead, and the solution of
    smallest ‖W‖ is returned.
    """
    if on_singular not in ("raise", "diagnose"):
        raise InputError(f'expected on_singular to be "raise" or "diagnose"; came {on_singular!r}')
    if system.penalty[0] or clearly_definite(system):
        found, left = refined(system), None
    else:
        kept = independent_columns(system)
        found, left = (refined(system), None) if len(kept) == system.dimension else smallest_solution(system, kept)
    diagnosis = _determined(system, found) if left is None else _undetermined(found, left)
    if on_singular == "raise" and diagnosis.verdict in ("singular", "out of range", "not converged"):
        raise SingularError(
            f"expected rows that determine the weights, or λ > 0; the system with λ = {_as_float(system):g} is "
            f"{diagnosis}. Give a larger λ, leave out one of the columns {list(diagnosis.columns[:8])}, or ask with "
            'on_singular="diagnose" for what can be said'
        )
    return found.weights, diagnosis


def _as_float(system: IntegerSystem) -> float:
    mantissa, exponent = system.penalty
    return float(np.ldexp(float(mantissa), exponent))


def _determined(system: IntegerSystem, found: Refined) -> Diagnosis:
    verdict: Verdict = "sound" if found.condition < ILL else "ill conditioned"
    if not np.isfinite(found.weights).all():
        verdict = "out of range"
    # The direction is one of scaled columns: back to their own units, where these are within a double's range.
    direction = times_power(found.weakest, system.scaling - system.units)
    if not np.isfinite(direction).all() or not direction.any():
        direction = found.weakest
    length = float(np.linalg.norm(direction / max(np.abs(direction).max(), 1e-300))) or 1.0
    share = np.abs(found.weakest)
    return Diagnosis(
        verdict=verdict if found.converged else "not converged",
        rank=system.dimension,
        dimension=system.dimension,
        condition=found.condition,
        directions=(direction / max(np.abs(direction).max(), 1e-300) / length)[:, None],
        columns=tuple(np.flatnonzero(share >= PART * share.max()).tolist()),
        relation="",
        arithmetic=found.arithmetic,
        steps=found.steps,
        converged=found.converged,
        error_bound=found.bound,
        rounding=0.0,
    )


def _undetermined(found: Refined, left: Undetermined) -> Diagnosis:
    return Diagnosis(
        verdict="singular" if found.converged else "not converged",
        rank=left.rank,
        dimension=len(left.directions),
        condition=found.condition,
        directions=left.directions,
        columns=left.columns,
        relation=left.relation,
        arithmetic=found.arithmetic,
        steps=found.steps,
        converged=found.converged,
        error_bound=found.bound,
        rounding=0.0,
    )
