"""The exact form: bytes under any schedule, sums in wider limbs, a solve that loses nothing or says what it lost."""

from fractions import Fraction

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from examples.benchmarks.solvers.diagnosis import solve_exact
from examples.benchmarks.solvers.exact import Exact, Exact20, Exact24
from examples.benchmarks.solvers.factors import FixedFactor, FloatFactor, NotDefiniteError
from examples.benchmarks.solvers.limbs import (
    LIMB,
    carry,
    from_integers,
    lowest_bits,
    product,
    shifted,
    split,
    split_if_whole,
    to_float,
    to_integers,
)
from examples.benchmarks.solvers.refinement import condition_of, refine, refined, sees
from examples.benchmarks.solvers.singular import independent_columns
from examples.benchmarks.solvers.systems import IntegerSystem
from examples.benchmarks.solvers.wide import WideMoments
from scroll_tactile.errors import InputError, MismatchError, SingularError
from scroll_tactile.statistics.moments import SecondMoment

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


# Limbs


@few
@given(st.lists(doubles, min_size=1, max_size=8))
def test_splitting_a_double_loses_nothing(values):
    numbers = np.array(values)
    unit = int(min(0, lowest_bits(numbers).min()))
    digits = split(numbers, unit)
    assert np.abs(digits).max() <= 2 ** (LIMB - 1)
    for value, whole in zip(values, to_integers(digits.astype(np.int64)), strict=True):
        assert Fraction(value) == whole * Fraction(2) ** unit


@few
@given(st.lists(doubles, min_size=1, max_size=8), st.integers(-40, 5))
def test_the_quick_way_gives_the_same_digits_or_none(values, unit):
    numbers = np.array(values)
    quick = split_if_whole(numbers, unit)
    whole = all(value == 0 or (Fraction(value) / Fraction(2) ** unit).denominator == 1 for value in values)
    assert quick is None or whole
    if quick is not None:
        assert [int(v) * Fraction(2) ** unit for v in to_integers(quick.astype(np.int64))] == list(
            map(Fraction, values)
        )


@few
@given(st.lists(st.integers(-(2**400), 2**400), min_size=1, max_size=6))
def test_integers_go_into_limbs_and_back(values):
    limbs = from_integers(np.array(values, dtype=object))
    assert limbs.min() >= -(2 ** (LIMB - 1))
    assert limbs.max() < 2 ** (LIMB - 1)
    assert to_integers(limbs).tolist() == values
    number, exponent = to_float(limbs)
    for value, x, e in zip(values, number, exponent, strict=True):
        assert abs(Fraction(x) * Fraction(2) ** int(e) - value) <= abs(value) * Fraction(1, 2**52)


@few
@given(st.lists(st.integers(-(2**62), 2**62), min_size=3, max_size=3))
def test_carrying_has_one_form_for_one_value(sums):
    limbs = np.array(sums, dtype=np.int64)[:, None]
    value = to_integers(limbs)[0]
    assert to_integers(carry(limbs))[0] == value
    assert np.array_equal(carry(limbs), carry(carry(limbs)))
    assert np.array_equal(carry(limbs), from_integers(np.array([value], dtype=object)))


@pytest.mark.parametrize(("inner", "limbs"), [(1, 1), (7, 3), (2100, 2)])
def test_products_are_those_of_integers(inner, limbs):
    rng = np.random.default_rng(inner)
    left = rng.integers(-(2**21), 2**21, size=(limbs, 2, inner), endpoint=True)
    right = rng.integers(-(2**21), 2**21, size=(limbs + 1, inner, 3), endpoint=True)
    found = to_integers(carry(product(left.astype(float), right.astype(float))))
    assert np.array_equal(found, to_integers(left) @ to_integers(right))


def test_products_that_could_overflow_are_refused():
    with pytest.raises(OverflowError, match="int64"):
        product(np.ones((2, 1, 2**18 + 1)), np.ones((2, 2**18 + 1, 1)))


def test_shifting_is_multiplying():
    limbs = from_integers(np.array([5, -7, 2**60], dtype=object))
    assert to_integers(shifted(limbs, np.array([0, 2, 1]))).tolist() == [5, -7 * 2**44, 2**82]


# Exact sums


def moments(*parts, columns=3):
    found = WideMoments(columns)
    for part in parts:
        found.add(part)
    return found


def as_fractions(found):
    sums, units = found.state()
    whole = to_integers(sums)
    return [
        [
            whole[i, j] * Fraction(2) ** int(units[i] + units[j]) if whole[i, j] else Fraction(0)
            for j in range(len(units))
        ]
        for i in range(len(units))
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
            found.state()  # looking in between changes nothing
    assert found.digest() == moments(rows).digest()


@few
@given(tables(3), tables(3), tables(3))
def test_sums_add_up_in_bytes(a, b, c):
    both = moments(a) + moments(b)
    assert both.digest() == moments(np.concatenate([a, b])).digest() == (moments(b) + moments(a)).digest()
    assert (both + moments(c)).digest() == (moments(a) + (moments(b) + moments(c))).digest()
    assert (moments(a) + moments()).digest() == moments(a).digest()


def test_a_single_row_of_one_limb_is_carried_like_any_other():
    """Products of 20-bit codes are wider than a limb, from the first on."""
    one = moments(np.array([[1.0, 0.5, -1.0]]))
    assert np.abs(one.state()[0]).max() <= 2 ** (LIMB - 1)
    assert one.digest() == (one + moments()).digest()
    solver = Exact()
    solver.start(1, 1, 0.0)
    solver.update([[1.0]], [[1.0]])
    assert solver.weights().tolist() == [[1.0]]


@pytest.mark.parametrize("reach", [300, 700, 1000])
def test_the_largest_digits_in_the_most_limbs_sum_exactly(reach):
    """All digits of one sign and near their bound, in so many rows as wait: the worst for float64's sums."""
    digit = 2.0 ** (LIMB - 1) - 1
    column = np.tile([digit * 2.0**power for power in range(-reach, reach, LIMB)], 20)[:512]
    rows = np.c_[column, np.roll(column, 1)]
    assert as_fractions(moments(rows, columns=2)) == true_moments(rows)


def test_more_rows_than_wait_and_many_limbs():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(1100, 3)) * 10.0 ** rng.integers(-30, 30, size=(1100, 3))
    found = moments(rows)
    assert found.limbs > 15
    assert as_fractions(found) == true_moments(rows)


def test_sums_of_other_shapes_or_grids_are_not_added():
    with pytest.raises(MismatchError, match="3 columns"):
        moments() + moments(columns=2)
    one, other = (WideMoments(1, np.array([unit])) for unit in (-20, -24))
    for found in (one, other):
        found.add(np.ones((1, 1)))
    with pytest.raises(MismatchError, match=r"column 0 has units of 2\^-20 and 2\^-24"):
        one + other


def test_before_a_sum_overflows_it_is_carried_into_wider_limbs_at_the_count_that_was_told():
    """Of the largest digit 2²¹ rows pass int64; a carry comes at a quarter of that, and is told before."""
    found = WideMoments(1, np.array([0]))
    block = np.full((2**16, 1), -(2.0**21))
    found.add(block)
    told = found.carries_at
    assert told == 2**19
    while found.rows < told:
        found.add(block)
    assert found.limbs == 1
    found.add(block[:1])
    assert found.limbs == 3
    assert found.carries_at == pytest.approx(2 * told, abs=2)
    for _ in range(40):
        found.add(block)
    assert found.rows > 2**21 + 2**20
    assert to_integers(found.state()[0])[0, 0] == found.rows * 2**42


def test_codes_take_one_limb_of_20_bits_and_two_of_24():
    rng = np.random.default_rng(1)
    rows, targets = rng.uniform(-1, 1, size=(50, 4)), rng.integers(0, 2, size=(50, 1))
    for kind, limbs in ((Exact20, 1), (Exact24, 3)):
        solver = kind()
        solver.start(4, 1, 0.1)
        solver.update(rows, targets)
        assert solver.limbs == limbs
    plain = Exact()
    plain.start(4, 1, 0.1)
    plain.update(np.rint(rows * 2**20) / 2**20, targets)
    assert plain.limbs == 1


# Grids


@pytest.mark.parametrize(("kind", "bits"), [(Exact20, 20), (Exact24, 24)])
def test_a_grid_rounds_to_its_bits(kind, bits):
    rng = np.random.default_rng(bits)
    rows, targets = rng.uniform(-3, 3, size=(60, 4)), rng.normal(size=(60, 2))
    bounds = np.array([3, 3.5, 4, 100])
    gridded, exact = kind(bounds), Exact()
    for solver in (gridded, exact):
        solver.start(4, 2, 0.01)
    gridded.update(rows, targets)
    unit = np.array([4, 4, 4, 128]) * 2.0**-bits
    exact.update(np.rint(rows / unit) * unit, targets)
    assert np.array_equal(gridded.weights(), exact.weights())
    assert gridded.diagnosis.startswith("rounded")
    assert exact.diagnosis == ""


@pytest.mark.parametrize(("kind", "bits"), [(Exact20, 20), (Exact24, 24)])
def test_the_error_that_a_grid_is_expected_to_make_is_about_what_it_makes(kind, bits):
    rng = np.random.default_rng(bits)
    rows, targets = rng.uniform(-1, 1, size=(300, 10)), rng.normal(size=(300, 2))
    gridded, exact = kind(), Exact()
    for solver in (gridded, exact):
        solver.start(10, 2, 1e-3)
        solver.update(rows, targets)
    found, diagnosis = gridded.solve()
    true = exact.weights()
    made = np.linalg.norm(found - true) / np.linalg.norm(true)
    assert diagnosis.rounding / 3 < made < 3 * diagnosis.rounding


def test_what_lies_on_the_grid_is_not_called_rounded():
    solver = Exact20()
    solver.start(2, 1, 0.1)
    solver.update([[0.5, -1.0], [0.25, 0.125]], [[1], [0]])
    assert solver.solve()[1].verdict == "sound"


def test_a_value_beyond_the_bound_is_refused_naming_row_and_column():
    solver = Exact20([1.0, 2.0])
    solver.start(2, 1, 0.1)
    solver.update([[1.0, 2.0]], [[1]])
    before = solver.digest()
    with pytest.raises(InputError, match=r"at most 2 in column 1; row 2 has -2\.5"):
        solver.update([[1.0, 2.0], [0, 0], [0, -2.5]], np.ones((3, 1)))
    assert solver.digest() == before
    assert solver.rows == 1


@pytest.mark.parametrize("bounds", [0.0, -1.0, np.inf, np.nan, [1, 2, 3], [[1.0]], 1e-300])
def test_bounds_that_are_none_are_refused(bounds):
    with pytest.raises(InputError, match="bound"):
        Exact20(bounds).start(2, 1, 0.1)


# The solve


def solved(rows, targets, penalty=0.0, on_singular="raise"):
    solver = Exact()
    solver.start(rows.shape[1], targets.shape[1], penalty)
    solver.update(rows, targets)
    return solver.solve(on_singular)


def truth(rows, targets, penalty):
    """To as many digits as the widest case here needs: its condition is 10²⁰⁰."""
    with mpmath.workdps(1500):
        x, y = mpmath.matrix(rows.tolist()), mpmath.matrix(targets.tolist())
        found = mpmath.lu_solve(x.T * x + mpmath.mpf(penalty) * mpmath.eye(x.cols), x.T * y)
        return [found[j] for j in range(x.cols)]


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
    assert diagnosis.converged
    assert diagnosis.error_bound < 2.0**-52
    assert diagnosis.rank == rows.shape[1]
    with mpmath.workdps(1500):
        for weight, true in zip(found[:, 0], truth(rows, targets, penalty), strict=True):
            assert abs(mpmath.mpf(float(weight)) - true) <= abs(true) * mpmath.mpf(2) ** -52


@pytest.mark.parametrize("penalty", [0.0, 1e-3])
def test_every_arithmetic_gives_the_same(penalty):
    solver = Exact()
    solver.start(8, 2, penalty)
    solver.update(GAUSSIAN, np.eye(2)[np.arange(30) % 2])
    system = solver.system()
    for factor in (FloatFactor(system), FixedFactor(system, 128), FixedFactor(system, 1024)):
        assert np.array_equal(refine(system, factor).weights, solver.weights())


def test_an_arithmetic_that_does_not_do_is_left_for_a_better_one():
    solver = Exact()
    solver.start(6, 1, 0.0)
    solver.update(laeuchli(1e-10), np.ones((7, 1)))
    system = solver.system()
    with pytest.raises(NotDefiniteError):
        FloatFactor(system)
    with pytest.raises(NotDefiniteError):
        FixedFactor(system, 32)
    _, diagnosis = solver.solve()
    assert diagnosis.arithmetic == "128 bits"
    assert diagnosis.verdict == "ill conditioned"
    assert 1e19 < diagnosis.condition < 1e22


def test_a_factorisation_that_is_blind_in_one_direction_is_found_out():
    """It cuts corrections along that direction short, so they look like those of a solution that is reached."""
    rng = np.random.default_rng(3)
    a, b = rng.integers(0, 2, size=(2, 64)).astype(float)
    systems = []
    for penalty in (0.0, 2.0**-6):
        solver = Exact()
        solver.start(2, 1, penalty)
        solver.update(np.c_[a, a + 2.0**-20 * b], a[:, None])
        systems.append(solver.system())
    system, stiffer = systems
    for factor, seeing in ((FloatFactor(stiffer), False), (FixedFactor(system, 128), True)):
        _, weakest = condition_of(system, factor)
        assert sees(system, factor, weakest) is seeing
    blind = refine(system, FloatFactor(stiffer))
    assert not blind.converged
    assert blind.bound == np.inf
    assert refined(system).converged


def test_an_ill_conditioned_system_names_the_direction_it_determines_least():
    rows = np.c_[GAUSSIAN[:, :3], GAUSSIAN[:, 1] * (1 + 2.0**-45 * GAUSSIAN[:, 7])]
    _, diagnosis = solved(rows, np.ones((30, 1)), 1e-30)
    assert diagnosis.columns == (1, 3)
    direction = diagnosis.directions[:, 0]
    assert np.allclose(np.abs(direction), [0, np.sqrt(0.5), 0, np.sqrt(0.5)], atol=1e-6)
    assert direction[1] * direction[3] < 0
    assert "columns 1, 3" in str(diagnosis)


def test_targets_of_zeros_and_a_single_row():
    assert not solved(GAUSSIAN, np.zeros((30, 2)))[0].any()
    found, _ = solved(np.array([[2.0]]), np.array([[3.0, 0.0]]), 1.0)
    assert found.tolist() == [[1.2, 0.0]]


def test_the_weights_do_not_depend_on_threads():
    from threadpoolctl import threadpool_limits

    rng = np.random.default_rng(8)
    rows, targets = rng.normal(size=(700, 60)), rng.normal(size=(700, 3))
    found = []
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            solver = Exact()
            solver.start(60, 3, 1e-9)
            solver.update(rows, targets)
            found.append((solver.digest(), solver.weights().tobytes()))
    assert found[0] == found[1]


# Singular systems


def dependent():
    rows = np.rint(GAUSSIAN * 64)
    rows[:, 5] = 2 * rows[:, 0] - rows[:, 3]
    rows[:, 6] = 0
    return rows


def test_a_singular_system_is_refused_naming_what_depends_on_what():
    with pytest.raises(SingularError, match=r"rank 6 of 8; column \d is .*Give a larger λ"):
        solved(dependent(), np.ones((30, 1)))


def test_or_the_smallest_solution_is_given_with_a_diagnosis():
    rows, targets = dependent(), np.random.default_rng(1).normal(size=(30, 2))
    found, diagnosis = solved(rows, targets, on_singular="diagnose")
    assert np.allclose(found, np.linalg.pinv(rows) @ targets, rtol=1e-11, atol=1e-15)
    assert diagnosis.verdict == "singular"
    assert (diagnosis.rank, diagnosis.dimension) == (6, 8)
    assert diagnosis.columns == (0, 3, 5, 6)
    assert diagnosis.directions.shape == (8, 2)
    assert np.abs(rows @ diagnosis.directions).max() < 1e-10
    assert np.allclose(diagnosis.directions.T @ diagnosis.directions, np.eye(2))


def test_a_hair_of_difference_is_no_dependence():
    """What no tolerance tells apart: a column that equals another but for one last bit in one row."""
    rows = dependent()[:, :6]
    rows[0, 5] = np.nextafter(rows[0, 5], np.inf)
    found, diagnosis = solved(rows, np.ones((30, 1)))
    assert diagnosis.verdict == "ill conditioned"
    assert np.isfinite(found).all()


@pytest.mark.parametrize("rows", [np.zeros((3, 2)), np.zeros((0, 2))], ids=["zeros", "none"])
def test_nothing_determined_at_all(rows):
    targets = np.ones((len(rows), 1))
    with pytest.raises(SingularError, match="column 0 is zero in every row"):
        solved(rows, targets)
    found, diagnosis = solved(rows, targets, on_singular="diagnose")
    assert not found.any()
    assert (diagnosis.rank, diagnosis.columns) == (0, (0, 1))


def test_more_features_than_rows_without_a_penalty():
    rows, targets = GAUSSIAN[:5], np.arange(5.0)[:, None]
    found, diagnosis = solved(rows, targets, on_singular="diagnose")
    assert diagnosis.rank == 5
    assert np.allclose(found, np.linalg.pinv(rows) @ targets, rtol=1e-12)


@few
@given(st.integers(0, 6), st.integers(0, 99))
def test_the_rank_is_exact(rank, seed):
    rng = np.random.default_rng([rank, seed])
    rows = (rng.integers(-9, 9, size=(9, rank)) @ rng.integers(-9, 9, size=(rank, 6))).astype(float)
    solver = Exact()
    solver.start(6, 1, 0.0)
    solver.update(rows, np.ones((9, 1)))
    kept = independent_columns(solver.system())
    exact = int(mpmath.matrix(rows.tolist()).rows and np.linalg.matrix_rank(rows)) if rank else 0
    assert len(kept) == exact
    assert np.linalg.matrix_rank(rows[:, kept]) == exact if exact else not len(kept)


def test_weights_too_large_for_a_double_are_not_passed_off():
    rows = np.array([[5e-324], [0.0]])
    with pytest.raises(SingularError, match="exceed"):
        solved(rows, np.ones((2, 1)))
    assert solved(rows, np.ones((2, 1)), on_singular="diagnose")[1].verdict == "out of range"


def test_another_wish_for_singular_systems_is_refused():
    with pytest.raises(InputError, match="diagnose"):
        solved(GAUSSIAN, np.ones((30, 1)), on_singular="ignore")


# Centring


def centred_truth(rows, targets, penalty):
    with mpmath.workdps(60):
        x, y = mpmath.matrix(rows.tolist()), mpmath.matrix(targets.tolist())
        for part in (x, y):
            for column in range(part.cols):
                mean = mpmath.fsum(part[:, column]) / part.rows
                for row in range(part.rows):
                    part[row, column] -= mean
        found = mpmath.lu_solve(x.T * x + penalty * mpmath.eye(x.cols), x.T * y[:, 0])
        return np.array([float(value) for value in found])


@pytest.mark.parametrize("offset", [0.0, 1e6, 1e12])
def test_centred_weights_do_not_cancel(offset):
    rows, targets = offset + GAUSSIAN, np.random.default_rng(2).normal(size=(30, 1))
    solver = Exact()
    solver.start(8, 1, 0.25)
    solver.update(rows, targets)
    found, diagnosis = solver.solve(centred=True)
    assert np.allclose(found[:, 0], centred_truth(rows, targets, 0.25), rtol=1e-15, atol=0)
    assert diagnosis.condition < 100


@pytest.mark.parametrize("offset", [0.0, 1e6, -1e9])
def test_the_scatter_does_not_cancel(offset):
    rows, labels = offset + GAUSSIAN, np.arange(30) % 3
    solver = Exact()
    solver.start(8, 4, 0.0)
    solver.update(rows, np.eye(4)[labels])  # a class without rows has no scatter
    exact = rows.astype(np.longdouble)
    for groups, found in (
        ([labels >= 0], solver.scatter()),
        ([labels == y for y in range(3)], solver.scatter(within=True)),
    ):
        about = [exact[group] - exact[group].mean(axis=0) for group in groups]
        true = sum(part.T @ part for part in about)
        assert np.abs(found - true).max() <= 1e-15 * np.abs(true).max()
        assert np.array_equal(found, found.T)


def test_scatter_of_nothing_and_of_what_is_no_class():
    solver = Exact()
    solver.start(3, 2, 0.0)
    assert not solver.scatter().any()
    assert not solver.scatter(within=True).any()
    for targets in ([[0.5, 0.5]], [[1, 1]], [[0, 0]], [[-1, 1]], [[2.0**30, 0]]):
        solver.start(3, 2, 0.0)
        solver.update(np.ones((1, 3)), targets)
        with pytest.raises(InputError, match="one 1"):
            solver.scatter(within=True)


# Merging


def test_two_halves_are_the_whole():
    targets = np.eye(3)[np.arange(30) % 3]
    halves = []
    for some in (slice(0, 11), slice(11, 30), slice(0, 30)):
        solver = Exact()
        solver.start(8, 3, 1e-3)
        solver.update(GAUSSIAN[some], targets[some])
        halves.append(solver)
    joint = halves[0] + halves[1]
    assert joint.rows == 30
    assert joint.digest() == halves[2].digest()
    assert joint.weights().tobytes() == halves[2].weights().tobytes()


def test_what_does_not_belong_together_is_not_added():
    one = Exact()
    one.start(2, 1, 0.1)
    for other, start in ((Exact(), (2, 1, 0.2)), (Exact(), (3, 1, 0.1)), (Exact20(), (2, 1, 0.1))):
        other.start(*start)
        with pytest.raises(MismatchError, match="same kind"):
            one + other


def test_other_bounds_are_another_grid():
    solvers = []
    for bound in (1.0, 2.0**22):
        solvers.append(Exact20(bound))
        solvers[-1].start(2, 1, 0.1)
        solvers[-1].update([[1.0, 0.5]], [[1]])
    with pytest.raises(MismatchError, match="column 0 has another bound"):
        solvers[0] + solvers[1]


def test_a_memorys_own_sums_are_solved_as_the_rows_are():
    codes = np.random.default_rng(7).integers(-(2**20), 2**20, size=(40, 5), dtype=np.int32)
    targets = np.eye(3)[np.arange(40) % 3]
    moment, solver = SecondMoment(5), Exact()
    moment.add(codes)
    solver.start(5, 3, 1e6)
    solver.update(codes, targets)
    sums = (targets.T @ codes).astype(np.int64)
    found, diagnosis = solve_exact(IntegerSystem.of_codes(moment.packed(), sums, 1e6))
    assert np.array_equal(found, solver.weights())
    assert diagnosis.verdict == "sound"


# Schedules


def test_a_hundred_schedules_give_the_same_bytes_where_plain_sums_do_not():
    """The thousand, with two threads, are measured by `bench numerics`."""
    rng = np.random.default_rng(9)
    rows, targets = rng.normal(size=(120, 9)), np.eye(3)[rng.integers(3, size=120)]
    exact, plain = set(), set()
    for _ in range(100):
        order = rng.permutation(120)
        solver, total = Exact(), np.zeros((9, 9))
        solver.start(9, 3, 1e-6)
        for some in np.split(order, np.sort(rng.integers(0, 120, size=rng.integers(1, 20)))):
            solver.update(rows[some], targets[some])
            total += rows[some].T @ rows[some]
        exact.add((solver.digest(), solver.weights().tobytes()))
        plain.add(total.tobytes())
    assert len(exact) == 1
    assert len(plain) > 90
