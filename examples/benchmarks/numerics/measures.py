"""How `benchmarks numerics` measures one solver on one case, and what it writes down."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from examples.benchmarks.numerics.cases import Case
from examples.benchmarks.numerics.recorded import digits
from examples.benchmarks.solvers.exact import Exact
from examples.benchmarks.solvers.methods import SOLVERS
from examples.benchmarks.solvers.solver_protocol import RidgeBase, SingularError
from scroll_tactile.errors import InputError
from scroll_tactile.statistics.moments import one_thread

__all__ = ["DEFAULT", "bars", "error_of", "measure", "new_solver", "record", "solved"]

FloatArray = npt.NDArray[np.float64]
Record = dict[str, Any]

DEFAULT = "exact"
MARGIN = 10.0  # the default's error may be so many times the best one's
ROUNDING = 2.0**-53  # errors below it are no better than this: weights are doubles
MOST_IN_A_BATCH = 32


def new_solver(method: str, sizes: FloatArray) -> RidgeBase:
    """A solver by name; those with a grid are given the columns' largest magnitudes as bounds."""
    kind = SOLVERS[method]
    solver = kind(sizes) if issubclass(kind, Exact) and kind.bits is not None else kind()
    assert isinstance(solver, RidgeBase)
    return solver


def measure(case: Case, method: str, seed: int) -> Record:
    """Teach one solver a case, in random batches of 1 to 32 rows, and compare its weights with the truth.

    Times are of the processor, not of the clock: other programs do not count.
    """
    base = record(case.name, case.family, method, len(case.rows), case.rows.shape[1], case.penalty)
    solver = new_solver(method, case.sizes)
    sizes = np.random.default_rng([seed, len(case.rows)]).integers(1, MOST_IN_A_BATCH + 1, size=len(case.rows))
    cuts = np.cumsum(sizes)
    cuts = cuts[cuts < len(case.rows)]
    batches = list(zip(np.split(case.rows, cuts), np.split(case.targets, cuts), strict=True))
    with one_thread():
        try:
            solver.start(case.rows.shape[1], case.targets.shape[1], case.penalty)
        except InputError:  # the covariance form, which begins with 1 / λ
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
    error = error_of(weights, case.truth, case.sizes)
    base |= {"relative_error": error, "flipped": _flipped(case, weights)}
    if case.certified is not None:
        base["digits"] = digits(weights, case.certified)
    return base


def record(case: str, family: str, method: str, rows: int, dimension: int, penalty: float) -> Record:
    """A record with nothing measured yet."""
    return {
        "case": case,
        "family": family,
        "method": method,
        "relative_error": None,
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
    if isinstance(solver, Exact):
        weights, diagnosis = solver.solve("diagnose")
        return weights, str(diagnosis)
    assert hasattr(solver, "weights")
    try:
        weights = solver.weights()
    except SingularError:
        return None, "refused: not positive definite"
    if not np.isfinite(weights).all():
        return None, solver.diagnosis or "not finite"
    return weights, solver.diagnosis


def error_of(weights: FloatArray, truth: npt.NDArray[np.longdouble], sizes: FloatArray) -> float | None:
    """‖S (W − T)‖ / ‖S T‖, Frobenius, with S the sizes of the columns: an error counts by what it does to answers.

    None where it is larger than a double can say.
    """
    difference = (weights.astype(np.longdouble) - truth) * sizes[:, None]
    whole = np.sqrt(np.square(truth * sizes[:, None]).sum())
    error = np.sqrt(np.square(difference).sum()) / whole if whole else np.sqrt(np.square(difference).sum())
    return float(error) if np.isfinite(error) and error < 1e300 else None


def _flipped(case: Case, weights: FloatArray) -> int | None:
    """How many of the rows evaluated are given to another class than by the true weights."""
    if case.evaluated is None or case.targets.shape[1] < 2:
        return None
    evaluated = case.evaluated.astype(np.longdouble)
    said = (evaluated @ weights.astype(np.longdouble)).argmax(axis=1)
    return int(np.count_nonzero(said != (evaluated @ case.truth).argmax(axis=1)))


def bars(records: list[Record]) -> list[Record]:
    """For each case: the best method, the default's error, and whether that is within ten times, or was named."""
    found = []
    for case in dict.fromkeys(entry["case"] for entry in records):
        mine = {entry["method"]: entry for entry in records if entry["case"] == case}
        errors = {name: entry["relative_error"] for name, entry in mine.items() if entry["relative_error"] is not None}
        if DEFAULT not in mine or not errors:
            continue
        best = min(errors, key=errors.__getitem__)
        found.append({"case": case, "best": best, "best_error": errors[best], **_verdict(mine[DEFAULT], errors[best])})
    return found


def _verdict(ours: Mapping[str, Any], best: float) -> Record:
    error = ours["relative_error"]
    near = error is not None and error <= MARGIN * max(best, ROUNDING)
    named = not ours["diagnosis"].startswith("sound")
    return {"error": error, "diagnosis": ours["diagnosis"], "within_ten": near, "met": near or named}
