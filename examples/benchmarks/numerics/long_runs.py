"""What `benchmarks numerics` measures beside weights of a case: long streams, schedules, and the scatter of classes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from examples.benchmarks.numerics.cases import Case, updates
from examples.benchmarks.numerics.measures import Record, error_of, new_solver, record, solved
from examples.benchmarks.numerics.truth import refined_weights
from examples.benchmarks.solvers.exact import Exact
from examples.benchmarks.solvers.solver_protocol import RidgeBase
from scroll_tactile.statistics.moments import one_thread

__all__ = ["run_scatter", "run_schedules", "run_updates"]

FloatArray = npt.NDArray[np.float64]
Note = Callable[[str], None]
SCHEDULED = 256  # rows
DISTINCT = 1000  # rows of a long stream, which it repeats


def run_updates(seed: int, dimension: int, most: dict[str, int], note: Note) -> Iterator[Record]:
    """Updates of one row each, and the error after every power of ten from 10³ to as many as each method is given."""
    rng = np.random.default_rng([seed, dimension, 3])
    rows, targets, penalty = updates(rng, dimension, DISTINCT)
    truths: dict[int, npt.NDArray[np.longdouble]] = {}
    single_rows = [(rows[i : i + 1], targets[i : i + 1]) for i in range(len(rows))]
    sizes = np.ones(dimension)
    for method, last in most.items():
        solver = new_solver(method, sizes)
        with one_thread():
            solver.start(dimension, targets.shape[1], penalty)
            fed, spent = 0, 0.0
            while fed < last:
                upto = max(DISTINCT, 10 * fed)
                note(f"{upto} one-row updates, {dimension} features: {method}")
                begin = time.process_time()
                for _ in range((upto - fed) // DISTINCT):
                    for row, target in single_rows:
                        solver.update(row, target)
                solver.settle()
                spent += time.process_time() - begin
                fed = upto
                rounds = fed // DISTINCT
                if rounds not in truths:
                    truths[rounds] = refined_weights(rows, targets, penalty / rounds)
                begin = time.process_time()
                weights, diagnosis = solved(solver)
                yield record(_updates_name(fed, dimension), "updates", method, fed, dimension, penalty) | {
                    "relative_error": None if weights is None else error_of(weights, truths[rounds], sizes),
                    "flipped": None if weights is None else _flips(rows, weights, truths[rounds]),
                    "seconds_per_row": spent / fed,
                    "solve_seconds": time.process_time() - begin,
                    "diagnosis": diagnosis,
                }


def _updates_name(count: int, dimension: int) -> str:
    return f"{count:.0e} one-row updates, d={dimension}".replace("e+0", "e")


def _flips(rows: FloatArray, weights: FloatArray, truth: npt.NDArray[np.longdouble]) -> int:
    wide = rows.astype(np.longdouble)
    return int(np.count_nonzero((wide @ weights).argmax(axis=1) != (wide @ truth).argmax(axis=1)))


def run_schedules(seed: int, methods: tuple[str, ...], count: int, dimension: int, note: Note) -> Iterator[Record]:
    """The same rows in random orders and splits, with one BLAS thread and two: how many give other bytes."""
    rng = np.random.default_rng([seed, count, 5])
    rows = np.abs(rng.normal(size=(SCHEDULED, dimension)))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    targets = np.eye(4)[rng.integers(4, size=len(rows))]
    for method in methods:
        note(f"{count} schedules: {method}")
        orders = np.random.default_rng([seed, count, 6])
        seen: dict[bytes, int] = {}
        begin = time.process_time()
        for _ in range(count):
            order = orders.permutation(len(rows))
            cuts = np.sort(orders.integers(0, len(rows), size=orders.integers(1, 40)))
            for threads in (1, 2):
                solver = new_solver(method, np.ones(dimension))
                solver.start(dimension, targets.shape[1], 1e-6)
                with threadpool_limits(threads, user_api="blas"):
                    for some in np.split(order, cuts):
                        solver.update(rows[some], targets[some])
                    solver.settle()
                said = _bytes(solver)
                seen[said] = seen.get(said, 0) + 1
        spent = time.process_time() - begin
        other = 2 * count - next(iter(seen.values()))
        yield record(f"{count} schedules × 1 and 2 threads", "schedules", method, len(rows), dimension, 1e-6) | {
            "seconds_per_row": spent / (2 * count * len(rows)),
            "diagnosis": f"{other} of {2 * count} differ in bytes from the first",
            "differing": other,
        }


def _bytes(solver: RidgeBase) -> bytes:
    """What is compared: the exact form's sums, and of the others, which keep none that are comparable, the weights."""
    if isinstance(solver, Exact):
        return solver.digest().encode()
    weights, _ = solved(solver)
    return b"" if weights is None else weights.tobytes()


def run_scatter(case: Case, note: Note) -> Iterator[Record]:
    """The scatter within classes of a case, whose first column is constant: exact, and A − Σ c cᵀ / n in float64."""
    note("scatter within classes")
    rows, targets = case.rows[:, 1:], case.targets
    wide = rows.astype(np.longdouble)
    truth = np.zeros((rows.shape[1], rows.shape[1]), dtype=np.longdouble)
    for chosen in targets.T.astype(bool):
        about = wide[chosen] - wide[chosen].mean(axis=0)
        truth += about.T @ about
    begin = time.process_time()
    exact = Exact()
    exact.start(rows.shape[1], targets.shape[1], 0.0)
    exact.update(rows, targets)
    ours = exact.scatter(within=True)
    between = time.process_time()
    sums, counts = rows.T @ targets, targets.sum(axis=0)
    plain = rows.T @ rows - (sums / counts) @ sums.T
    end = time.process_time()
    sizes = np.ones(rows.shape[1])
    for method, found, spent in (("exact", ours, between - begin), ("gram64", plain, end - between)):
        least = float(np.linalg.eigvalsh(found)[0])
        yield record(f"scatter within classes, {case.name}", case.family, method, len(rows), len(truth), 0.0) | {
            "relative_error": error_of(found, truth, sizes),
            "seconds_per_row": spent / len(rows),
            "diagnosis": "sound" if least > 0 else f"not positive definite: eigenvalue {least:.1e}",
        }
