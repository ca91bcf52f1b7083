"""Solvers of any doubles, measured on a regression, or on a memory as the regression that its readout stands for."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import numpy.typing as npt

from examples.benchmarks.numerics.learned import answers_error, flips
from examples.benchmarks.numerics.memories import Memory
from examples.benchmarks.numerics.recorded import digits
from examples.benchmarks.numerics.regressions import Case
from examples.benchmarks.solvers.methods import SOLVERS
from examples.benchmarks.solvers.solver_protocol import RidgeBase, SingularError
from scroll_tactile.errors import InputError
from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.moments import one_thread

__all__ = ["as_case", "decided", "error_of", "measure", "record", "solved"]

FloatArray = npt.NDArray[np.float64]
Record = dict[str, Any]

MOST_IN_A_BATCH = 32
EDGE = 2.0**BITS


def as_case(memory: Memory, penalty: float) -> Case:
    """The ridge regression on 0/1 targets that a readout with P stands for: of the codes, and of a feature that is
    always at the bound, for the intercept.
    """
    rows = memory.codes.reshape(-1, memory.codes.shape[2])
    evaluated = np.rint(memory.evaluated * EDGE)
    wide = [np.c_[np.full(len(part), EDGE), part.astype(np.float64)] for part in (rows, evaluated)]
    return Case(
        memory.name, wide[0], np.eye(memory.places.max() + 1)[memory.row_places], penalty, wide[1], None, memory.family
    )


def measure(case: Case, method: str, seed: int) -> Record:
    """Teach one solver a case, in random batches of 1 to 32 rows, and compare its weights with the truth.

    Times are of the processor, not of the clock: other programs do not count.
    """
    base = record(case.name, case.family, method, len(case.rows), case.rows.shape[1], case.penalty)
    solver = SOLVERS[method]()
    sizes = np.random.default_rng([seed, len(case.rows)]).integers(1, MOST_IN_A_BATCH + 1, size=len(case.rows))
    cuts = np.cumsum(sizes)
    cuts = cuts[cuts < len(case.rows)]
    batches = list(zip(np.split(case.rows, cuts), np.split(case.targets, cuts), strict=True))
    with one_thread():
        try:
            solver.start(case.rows.shape[1], case.targets.shape[1], case.penalty)
        except InputError:  # the recursion, which begins with 1 / λ
            return base | {"diagnosis": "needs λ > 0"}
        begin = time.process_time()
        for rows, targets in batches:
            solver.update(rows, targets)
        solver.settle()
        summed = time.process_time()
        weights, diagnosis = solved(solver)
        done = time.process_time()
    base |= {
        "seconds_per_row": (summed - begin) / len(case.rows),
        "solve_seconds": done - summed,
        "diagnosis": diagnosis,
    }
    if weights is None:
        return base
    if case.truth is None:
        return base | {"diagnosis": "answers where other weights fit as well"}
    base |= {"weights_error": error_of(weights, case.truth, case.sizes), **decided(case.evaluated, weights, case.truth)}
    if case.certified is not None:
        base["digits"] = digits(weights, case.certified)
    return base


def decided(evaluated: FloatArray | None, weights: FloatArray, truth: npt.NDArray[np.longdouble]) -> Record:
    """The error of the scores of rows, and how many of them are given to another class than by the true weights."""
    if evaluated is None:
        return {}
    rows = evaluated.astype(np.longdouble)
    found, true = rows @ weights.astype(np.longdouble), rows @ truth
    return {"answers_error": answers_error(found, true), "flipped": flips(found, true)}


def record(case: str, family: str, method: str, rows: int, dimension: int, penalty: float) -> Record:
    """A record with nothing measured yet."""
    return {
        "case": case,
        "family": family,
        "method": method,
        "weights_error": None,
        "answers_error": None,
        "flipped": None,
        "seconds_per_row": None,
        "diagnosis": "",
        "solve_seconds": None,
        "rows": rows,
        "dimension": dimension,
        "penalty": penalty,
    }


def solved(solver: RidgeBase) -> tuple[FloatArray | None, str]:
    """The weights and the diagnosis; None for weights that were refused or are not numbers."""
    try:
        weights: FloatArray = solver.weights()
    except SingularError as error:
        return None, f"refused: {error}"
    return (weights, solver.diagnosis) if np.isfinite(weights).all() else (None, solver.diagnosis or "not finite")


def error_of(weights: FloatArray, truth: npt.NDArray[np.longdouble], sizes: FloatArray) -> float | None:
    """‖S (W − T)‖ / ‖S T‖, Frobenius, with S the sizes of the columns: an error counts by what it does to answers.

    None where it is larger than a double can say.
    """
    difference = (weights.astype(np.longdouble) - truth) * sizes[:, None]
    whole = np.sqrt(np.square(truth * sizes[:, None]).sum())
    error = np.sqrt(np.square(difference).sum()) / whole if whole else np.sqrt(np.square(difference).sum())
    return float(error) if np.isfinite(error) and error < 1e300 else None
