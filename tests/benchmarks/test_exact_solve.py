"""The exact form: bytes under any schedule, sums in wider limbs, a solve that loses nothing or says what it lost."""

from fractions import Fraction

import mpmath
import numpy as np
import pytest
from benchmarks.ridge_truth import truth
from hypothesis import given, settings
from hypothesis import strategies as st

from examples.benchmarks.solvers.certified import FIRST_BITS
from examples.benchmarks.solvers.exact import EMPTY, Exact, IntegerMoments
from examples.benchmarks.solvers.solver_protocol import SingularError

doubles = st.floats(allow_nan=False, allow_infinity=False)
moderate = st.floats(-1e6, 1e6, allow_subnormal=False)
# Codes and their neighbours: values of one limb, of two, of none.
codes = st.sampled_from([0.0, 1.0, -1.0, 0.5, 3.0, 2.0**-20, 1 - 2.0**-20, 2.0**-21, 2.0, 1e-3])
few = settings(max_examples=60, deadline=None)


def table(values, columns):
    return np.array(values, dtype=np.float64).reshape(-1, columns)


def tables(columns, values=codes | moderate, most=12):
    return st.lists(st.lists(values, min_size=columns, max_size=columns), max_size=most).map(
        lambda rows: table(rows, columns)
    )


# Exact sums


def moments(*parts, columns=3):
    found = IntegerMoments(columns)
    for part in parts:
        found.add(part)
    return found


def as_fractions(found):
    found.settle()
    units = np.where(found.units == EMPTY, 0, found.units).tolist()
    return [
        [int(found.sums[i, j]) * Fraction(2) ** (units[i] + units[j]) for j in range(found.width)]
        for i in range(found.width)
    ]


def true_moments(rows):
    exact = [[Fraction(value) for value in row] for row in rows.tolist()]
    width = rows.shape[1]
    return [[sum((r[i] * r[j] for r in exact), start=Fraction(0)) for j in range(width)] for i in range(width)]


@few
@given(tables(3, doubles, most=6))
def test_sums_of_any_doubles_are_exact(rows):
    assert as_fractions(moments(rows)) == true_moments(rows)


@few
@given(tables(3), st.randoms(use_true_random=False), st.lists(st.integers(0, 12), max_size=4))
def test_any_order_and_split_gives_the_same_bytes(rows, random, cuts):
    order = list(range(len(rows)))
    random.shuffle(order)
    found = moments()
    for part in np.split(rows[order], sorted(min(cut, len(rows)) for cut in cuts)):
        found.add(part)
        if random.random() < 0.3:
            found.digest()  # looking in between changes nothing
    assert found.digest() == moments(rows).digest()


# The solve


def solved(rows, targets, penalty=0.0):
    solver = Exact()
    solver.start(rows.shape[1], targets.shape[1], penalty)
    solver.update(rows, targets)
    return solver.solve()


def geometric(lowest):
    rng = np.random.default_rng(5)
    left, _ = np.linalg.qr(rng.normal(size=(30, 8)))
    right, _ = np.linalg.qr(rng.normal(size=(8, 8)))
    return left * np.logspace(0, lowest, 8) @ right.T


def laeuchli(small):
    return np.concatenate([np.ones((1, 6)), small * np.eye(6)])


HILBERT = 1 / (np.arange(9)[:, None] + np.arange(9) + 1.0)
GAUSSIAN = np.random.default_rng(4).normal(size=(30, 8))
HARD = {
    "gaussian": (GAUSSIAN, 1e-3),
    "gaussian, no penalty": (GAUSSIAN, 0.0),
    "geometric": (geometric(-12), 1e-16),
    "geometric, no penalty": (geometric(-12), 0.0),
    "geometric beyond doubles": (geometric(-40), 1e-70),
    "läuchli": (laeuchli(1e-8), 1e-18),
    "läuchli, no penalty": (laeuchli(1e-10), 0.0),
    "läuchli, absurd": (laeuchli(1e-100), 0.0),
    "hilbert": (HILBERT, 1e-20),
    "hilbert, no penalty": (HILBERT, 0.0),
    "tiny": (GAUSSIAN * 1e-150, 1e-303),
    "huge": (GAUSSIAN * 1e150, 1e297),
    "mixed": (GAUSSIAN * np.where(np.arange(8) % 2, 1e150, 1e-150), 0.0),
    "mixed, penalty": (GAUSSIAN * np.where(np.arange(8) % 2, 1e150, 1e-150), 1e-3),
    "far from zero": (np.c_[np.ones(30), 1e6 + GAUSSIAN], 0.0),
    "near-duplicate columns": (np.c_[GAUSSIAN, GAUSSIAN[:, 0] * (1 + 2.0**-50)], 1e-20),
    "denormal penalty": (GAUSSIAN, 5e-324),
    "more features than rows": (GAUSSIAN[:3], 1e-12),
}


@pytest.mark.parametrize(("rows", "penalty"), HARD.values(), ids=HARD)
def test_every_weight_is_right_to_its_last_bit_or_two(rows, penalty):
    targets = np.random.default_rng(6).normal(size=(len(rows), 1))
    found, diagnosis = solved(rows, targets, penalty)
    assert diagnosis.error_bound < 2.0**-52
    with mpmath.workdps(1500):  # as the widest case here needs: its condition is 10²⁰⁰
        for weight, true in zip(found[:, 0], truth(rows, targets, penalty, 1500)[0], strict=True):
            assert abs(mpmath.mpf(float(weight)) - true) <= abs(true) * mpmath.mpf(2) ** -52


def test_an_arithmetic_that_does_not_do_is_left_for_a_better_one():
    _, sound = solved(GAUSSIAN, np.ones((30, 1)))
    _, diagnosis = solved(laeuchli(1e-30), np.ones((7, 1)))
    assert sound.bits == FIRST_BITS < diagnosis.bits
    assert str(diagnosis).startswith("ill conditioned")
    assert 1e59 < diagnosis.condition < 1e62


def dependent():
    rows = np.rint(GAUSSIAN * 64)
    rows[:, 5] = 2 * rows[:, 0] - rows[:, 3]
    rows[:, 6] = 0
    return rows


@pytest.mark.parametrize(
    ("rows", "rank"), [(dependent(), "6 of 8"), (np.zeros((3, 2)), "0 of 2"), (np.zeros((0, 2)), "0 of 2")]
)
def test_a_singular_system_is_refused_with_its_exact_rank(rows, rank):
    with pytest.raises(SingularError, match=rf"rank {rank}\. Give a larger λ"):
        solved(rows, np.ones((len(rows), 1)))


def test_weights_too_large_for_a_double_are_not_passed_off():
    with pytest.raises(SingularError, match="exceed"):
        solved(np.array([[5e-324], [0.0]]), np.ones((2, 1)))
