"""Every solver of the ridge regression against fifty digits, and what each does with bad input."""

import numpy as np
import pytest
from benchmarks.ridge_truth import truth
from hypothesis import given, settings
from hypothesis import strategies as st

from examples.benchmarks.solvers.methods import SOLVERS
from examples.benchmarks.solvers.solver_protocol import SingularError
from scroll_tactile.errors import InputError, ScrollTactileError

# What each reaches where nothing is hard: the recursion starts from 1 / λ and loses as many digits as λ is small.
REACHED = {"recursion": 1e-10, "square root": 1e-13, "plain sums": 1e-13, "pseudo-inverse": 1e-12, "exact": 2.0**-52}
NAMES = list(SOLVERS)


def problem(rows=40, dimension=6, outputs=3, seed=0):
    rng = np.random.default_rng([rows, dimension, outputs, seed])
    return rng.uniform(-1, 1, size=(rows, dimension)), rng.normal(size=(rows, outputs))


def started(name, dimension=6, outputs=3, penalty=1e-3):
    solver = SOLVERS[name]()
    solver.start(dimension, outputs, penalty)
    return solver


def distance(found, true):
    true = np.array(true, dtype=float)
    return np.linalg.norm(found - true) / np.linalg.norm(true)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("rows", "dimension", "outputs"), [(40, 6, 3), (1, 1, 1), (30, 1, 2), (5, 9, 2), (1200, 4, 1)])
def test_all_agree_with_the_truth_where_nothing_is_hard(name, rows, dimension, outputs):
    x, y = problem(rows, dimension, outputs)
    solver = started(name, dimension, outputs, 0.5)
    for first in range(0, rows, 7):
        solver.update(x[first : first + 7], y[first : first + 7])
    assert distance(solver.weights().T, truth(x, y, 0.5)) < REACHED[name]
    assert solver.weights().shape == (dimension, outputs)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=15, deadline=None)
@given(cuts=st.lists(st.integers(0, 40), max_size=5), order=st.permutations(range(40)))
def test_any_order_and_split_comes_to_the_same_but_for_rounding(name, cuts, order):
    x, y = problem()
    solver = started(name)
    for some in np.split(np.array(order), np.sort(np.array(cuts, dtype=int))):
        solver.update(x[some], y[some])
        solver.weights()[:] = 77  # a copy; asking in between changes nothing
    assert distance(solver.weights().T, truth(x, y, 1e-3)) < 10 * REACHED[name]


BAD = {
    "too narrow": (np.ones((3, 5)), np.ones((3, 3)), r"\(n, 6\); came \(3, 5\)"),
    "one row, not a table": (np.ones(6), np.ones((1, 3)), r"\(n, 6\); came \(6,\)"),
    "other targets": (np.ones((3, 6)), np.ones((3, 2)), r"targets of shape \(n, 3\)"),
    "more rows than targets": (np.ones((3, 6)), np.ones((2, 3)), "3 rows and 2 targets"),
    "NaN": (np.where(np.arange(18).reshape(3, 6) == 8, np.nan, 1), np.ones((3, 3)), "row 1, column 2 is nan"),
    "infinite target": (np.ones((3, 6)), np.full((3, 3), np.inf), "targets; row 0, column 0 is inf"),
    "words": ([["a"] * 6], [[0] * 3], "real numbers"),
}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("case", BAD.values(), ids=BAD)
def test_bad_rows_are_refused_and_leave_it_as_it_was(name, case):
    rows, targets, said = case
    x, y = problem()
    solver = started(name)
    solver.update(x, y)
    before = solver.weights()
    with pytest.raises(InputError, match=said):
        solver.update(rows, targets)
    assert np.array_equal(solver.weights(), before)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("arguments", "said"),
    [((0, 1, 1.0), "one feature"), ((2, 0, 1.0), "one output"), ((2, 1, -1e-9), "λ ≥ 0"), ((2, 1, np.nan), "λ ≥ 0")],
)
def test_bad_beginnings_are_refused(name, arguments, said):
    solver = SOLVERS[name]()
    with pytest.raises(InputError, match=said):
        solver.start(*arguments)
    with pytest.raises(InputError, match="start"):
        solver.weights()


@pytest.mark.parametrize("name", NAMES)
def test_no_penalty_on_a_singular_system_is_never_answered_in_silence(name):
    x, y = problem()
    x[:, 4] = 0.0  # whatever the arithmetic, a column of zeros stays one
    if name == "recursion":
        with pytest.raises(InputError, match="λ > 0"):
            started(name, penalty=0.0)
        return
    solver = started(name, penalty=0.0)
    solver.update(x, y)
    if name == "pseudo-inverse":
        solver.weights()
        assert solver.diagnosis == "taken for singular: rank 5 of 6"
        return
    with pytest.raises(SingularError, match="λ") as caught:
        solver.weights()
    assert isinstance(caught.value, ScrollTactileError)


def test_the_recursion_says_when_it_is_lost():
    """Random features that depend on each other, and a small λ: what the report shows, in small."""
    rng = np.random.default_rng(0)
    x = np.maximum((4 + rng.normal(size=(300, 8))) @ rng.normal(size=(8, 60)), 0)
    y = np.eye(2)[rng.integers(2, size=300)]
    lost, exact = started("recursion", 60, 2, 1e-10), started("exact", 60, 2, 1e-10)
    for at in range(0, 300, 5):
        lost.update(x[at : at + 5], y[at : at + 5])
        exact.update(x[at : at + 5], y[at : at + 5])
    assert distance(lost.weights(), exact.weights()) > 0.1
    assert "not positive definite" in lost.diagnosis
    assert exact.solve()[1].error_bound < 2.0**-52
