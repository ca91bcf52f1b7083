"""What `benchmarks numerics` measures beside single cases: a million observations, and a thousand schedules."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from examples.benchmarks.numerics.learned import SCALE, name_of
from examples.benchmarks.numerics.peers import Record, decided, error_of, record
from examples.benchmarks.numerics.peers import solved as weights_of
from examples.benchmarks.numerics.regressions import updates
from examples.benchmarks.numerics.truth import exact_weights
from examples.benchmarks.solvers.exact import Exact
from examples.benchmarks.solvers.methods import SOLVERS
from examples.benchmarks.solvers.solver_protocol import RidgeBase
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["run_schedules", "run_updates"]

FloatArray = npt.NDArray[np.float64]
Note = Callable[[str], None]
SCHEDULED = 256  # rows
DISTINCT = 1000  # rows of a long stream, which it repeats
JUDGED = 20


def run_updates(seed: int, dimension: int, most: int, methods: Sequence[str], note: Note) -> Iterator[Record]:
    """Observations of one row each as updates of the solvers of doubles, and their errors after every power of ten."""
    rng = np.random.default_rng([seed, dimension, 3])
    rows, targets, penalty = updates(rng, dimension, DISTINCT)
    truths: dict[int, npt.NDArray[np.longdouble]] = {}
    single_rows = [(rows[i : i + 1], targets[i : i + 1]) for i in range(len(rows))]
    for method in methods:
        solver = SOLVERS[method]()
        with one_thread():
            solver.start(dimension, targets.shape[1], penalty)
            fed, spent = 0, 0.0
            while fed < most:
                last_sequence = max(DISTINCT, 10 * fed)
                note(f"{last_sequence} one-row updates, {dimension} features: {method}")
                begin = time.process_time()
                for _ in range((last_sequence - fed) // DISTINCT):
                    for row, target in single_rows:
                        solver.update(row, target)
                solver.settle()
                spent += time.process_time() - begin
                fed = last_sequence
                if fed not in truths:
                    truths[fed] = np.asarray(exact_weights(rows, targets, penalty, fed // DISTINCT))
                begin = time.process_time()
                weights, diagnosis = weights_of(solver)
                found = record(_updates_name(fed, dimension), "updates", method, fed, dimension, penalty)
                found |= {"seconds_per_row": spent / fed, "solve_seconds": time.process_time() - begin}
                if weights is not None:
                    found["weights_error"] = error_of(weights, truths[fed], np.ones(dimension))
                    found |= decided(rows[:JUDGED], weights, truths[fed])
                yield found | {"diagnosis": diagnosis}


def _updates_name(count: int, dimension: int) -> str:
    return f"{count:.0e} observations, {dimension} features".replace("e+0", "e")


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
            parts = np.split(order, np.sort(orders.integers(0, len(rows), size=orders.integers(1, 40))))
            for threads in (1, 2):
                with threadpool_limits(threads, user_api="blas"):
                    said = _learned_bytes if method == "learner" else _solver_bytes
                    found = said(method, [(rows[part], targets[part]) for part in parts])
                seen[found] = seen.get(found, 0) + 1
        spent = time.process_time() - begin
        other = 2 * count - next(iter(seen.values()))
        yield record(f"{count} schedules × 1 and 2 threads", "schedules", method, len(rows), dimension, 1e-6) | {
            "seconds_per_row": spent / (2 * count * len(rows)),
            "diagnosis": f"{other} of {2 * count} differ in bytes from the first",
            "differing": other,
        }


def _learned_bytes(method: str, parts: list[tuple[FloatArray, FloatArray]]) -> bytes:
    """The digest of statistics that were learned part by part and joined."""
    dimension = parts[0][0].shape[1]
    whole = Statistics(dimension, [SCALE])
    for rows, targets in parts:
        part = Statistics(dimension, [SCALE])
        for row, target in zip(np.rint(rows * 2.0**20).astype(np.int32), targets, strict=True):
            part.add(name_of(int(target.argmax())), {SCALE: row[None]}, 1)
        if len(rows):
            whole = whole + part
    return whole.digest().encode()


def _solver_bytes(method: str, parts: list[tuple[FloatArray, FloatArray]]) -> bytes:
    """What is compared: the exact form's sums, and of the others, which keep none that are comparable, the weights."""
    solver: RidgeBase = SOLVERS[method]()
    solver.start(parts[0][0].shape[1], parts[0][1].shape[1], 1e-6)
    for rows, targets in parts:
        solver.update(rows, targets)
    solver.settle()
    if isinstance(solver, Exact):
        return solver.digest().encode()
    weights, _ = weights_of(solver)
    return b"" if weights is None else weights.tobytes()
