"""The second moment and the scatter within classes, against integers and fractions that cannot round."""

from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scroll_tactile.errors import CapacityError
from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.moments import BLOCK, MOST_ROWS, SecondMoment, within_scatter

EDGE = 2**BITS


def codes(rows, dimension, seed=0, low=-EDGE, high=EDGE):
    return np.random.default_rng([rows, dimension, seed]).integers(
        low, high, size=(rows, dimension), dtype=np.int32, endpoint=True
    )


def truth(rows):
    """The packed lower triangle, in Python's integers."""
    table = [[int(value) for value in row] for row in rows]
    width = rows.shape[1]
    return [sum(row[i] * row[j] for row in table) for i in range(width) for j in range(i + 1)]


def added(*parts, dimension=4):
    moment = SecondMoment(dimension)
    for part in parts:
        moment.add(part)
    return moment


@pytest.mark.parametrize("rows", [0, 1, 2, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK, 1000])
def test_it_is_the_sum_of_products_in_exact_integers(rows):
    batch = codes(rows, 4)
    assert added(batch).packed().tolist() == truth(batch)
    assert added(batch).rows == rows


def test_codes_at_the_bound_are_exact_too():
    # Of odd codes: float64 would round a sum of so many of their products.
    batch = np.array([[EDGE, 1 - EDGE, EDGE - 1]], dtype=np.int32).repeat(20_001, axis=0)
    expected = [20_001 * int(x) * int(y) for i, x in enumerate(batch[0]) for y in batch[0, : i + 1]]
    assert added(batch, dimension=3).packed().tolist() == expected


@settings(max_examples=50, deadline=None)
@given(st.data())
def test_any_split_and_order_gives_the_same_bytes(data):
    batch = codes(data.draw(st.integers(0, 700)), 4)
    expected = added(batch).packed().tobytes()
    cuts = sorted(data.draw(st.lists(st.integers(0, len(batch)), max_size=6)))
    parts = np.split(batch[np.random.default_rng(data.draw(st.integers(0, 99))).permutation(len(batch))], cuts)
    moment = SecondMoment(4)
    for part in parts:
        moment.add(part)
        if data.draw(st.booleans()):
            moment.packed()  # reading in between changes nothing
    assert moment.packed().tobytes() == expected


@settings(max_examples=30, deadline=None)
@given(kept=st.integers(0, 300), gone=st.integers(0, 600), seed=st.integers(0, 99))
def test_what_is_added_and_removed_leaves_no_trace(kept, gone, seed):
    stay, go = codes(kept, 4, seed), codes(gone, 4, seed + 1)
    moment = added(stay[: kept // 2], go, stay[kept // 2 :])
    moment.remove(go)
    assert moment.rows == kept
    assert moment.packed().tobytes() == added(stay).packed().tobytes()


@settings(max_examples=50, deadline=None)
@given(st.data())
def test_no_more_rows_than_features_are_kept_and_any_order_of_them_is_the_same(data):
    batch = codes(data.draw(st.integers(0, 12)), 8, low=-1, high=0)  # some come twice
    gone = data.draw(st.integers(0, len(batch)))
    order = np.random.default_rng(data.draw(st.integers(0, 99))).permutation(len(batch))
    moment = SecondMoment(8)
    for row in order:
        moment.add(batch[row : row + 1])
        if data.draw(st.booleans()):
            moment.packed()  # reading in between changes nothing
    kept = moment.codes()
    assert (kept is not None) == (len(batch) <= 8)
    assert moment.packed().tolist() == truth(batch)
    if kept is None:
        return
    assert kept.tobytes() == added(batch, dimension=8).codes().tobytes()
    assert sorted(kept.tolist()) == sorted(batch.tolist())
    for one in (moment, SecondMoment.of_codes(kept.copy(), 8)):
        one.remove(batch[:gone])
        assert one.codes().tobytes() == added(batch[gone:], dimension=8).codes().tobytes()
        assert one.packed().tolist() == truth(batch[gone:])
        one.add(batch[:gone])
        assert one.codes().tobytes() == kept.tobytes()
        assert one.packed().tolist() == truth(batch)


@pytest.mark.parametrize(("ours", "theirs"), [(0, 0), (3, 0), (0, 3), (3, 5), (4, 5), (9, 3), (3, 9)])
def test_moments_are_joined_and_taken_apart_with_their_rows_or_without(ours, theirs):
    a, b = codes(ours, 8, 1), codes(theirs, 8, 2)
    both = added(a, dimension=8).joined(added(b, dimension=8), 1)
    assert both.rows == ours + theirs
    assert both.packed().tolist() == truth(np.concatenate([a, b]))
    assert (both.codes() is None) == (ours + theirs > 8)
    again = both.joined(added(b, dimension=8), -1)
    assert again.rows == ours
    assert again.packed().tolist() == truth(a)
    if ours + theirs <= 8:
        assert again.codes().tobytes() == added(a, dimension=8).codes().tobytes()


def test_rows_that_were_never_added_leave_the_sums_that_are_left():
    moment = added(codes(3, 8, 1), dimension=8)
    moment.remove(other := codes(1, 8, 2))
    assert moment.rows == 2
    assert moment.codes() is None
    assert moment.packed().tolist() == [x - y for x, y in zip(truth(codes(3, 8, 1)), truth(other), strict=True)]


def test_a_full_moment_refuses_before_anything_is_added():
    assert MOST_ROWS * EDGE**2 < 2**63
    moment = SecondMoment.of(np.arange(10, dtype=np.int64), MOST_ROWS - 2, 4)
    with pytest.raises(CapacityError, match="exact"):
        moment.add(codes(3, 4))
    assert moment.rows == MOST_ROWS - 2
    assert moment.packed().tolist() == list(range(10))
    moment.add(np.ones((2, 4), dtype=np.int32))
    assert moment.rows == MOST_ROWS
    assert moment.packed().tolist() == [at + 2 for at in range(10)]
    with pytest.raises(CapacityError):
        moment.add(codes(1, 4))


@pytest.mark.parametrize("change", ["add", "remove"])
def test_what_was_given_out_stays_as_it_was(change):
    batch = codes(4, 3)
    moment = added(batch, dimension=3)
    given = moment.packed()
    before = given.tolist()
    getattr(moment, change)(batch[:1])
    assert moment.packed().tolist() != before
    assert given.tolist() == before


# The scatter within classes


def exact_scatter(groups):
    """Σ over classes of Σ (x − mean)(x − mean)ᵀ, as fractions."""
    width = len(groups[0][0])
    total = [[Fraction(0)] * width for _ in range(width)]
    for rows in groups:
        table = [[int(value) for value in row] for row in rows]
        sums = [sum(column) for column in zip(*table, strict=True)]
        for i in range(width):
            for j in range(i + 1):
                product = sum(row[i] * row[j] for row in table)
                total[i][j] += Fraction(product * len(table) - sums[i] * sums[j], len(table))
    return total


def compare(groups, *, relative=1e-14):
    width = groups[0].shape[1]
    moment = SecondMoment(width)
    for rows in groups:
        moment.add(rows)
    counts = np.array([len(rows) for rows in groups])
    sums = np.stack([rows.sum(axis=0, dtype=np.int64) for rows in groups])
    before = moment.packed().copy()
    found = np.tril(within_scatter(moment.packed(), counts, sums))
    assert np.array_equal(moment.packed(), before)
    exact = exact_scatter(groups)
    for i in range(width):
        for j in range(i + 1):
            # An entry's rounding is measured against the features' own scatter.
            size = float(exact[i][i] * exact[j][j]) ** 0.5
            assert abs(Fraction(float(found[i, j])) - exact[i][j]) <= Fraction(relative * size), (i, j)


@pytest.mark.parametrize("sizes", [[5], [40, 30], [1, 2, 3], [300, 1]])
def test_the_scatter_of_ordinary_classes(sizes):
    compare([codes(size, 5, seed) for seed, size in enumerate(sizes)])


@pytest.mark.parametrize("sign", [1, -1])
def test_the_scatter_where_the_mean_is_a_million_times_the_spread(sign):
    groups = [sign * codes(50, 4, seed, EDGE - 2 - seed, EDGE - seed) for seed in range(3)]
    compare(groups)
    assert np.abs(np.mean(groups[0])) > 1e5 * np.std(groups[0])


def test_single_rows_and_constant_classes_have_no_scatter_at_all():
    for groups in ([codes(1, 4, seed) for seed in range(30)], [np.repeat(codes(1, 4, s), 9, axis=0) for s in range(5)]):
        moment = added(*groups)
        counts = np.array([len(rows) for rows in groups])
        sums = np.stack([rows.sum(axis=0, dtype=np.int64) for rows in groups])
        assert not np.tril(within_scatter(moment.packed(), counts, sums)).any()


def test_the_scatter_of_a_class_near_capacity():
    """Rows that no test could add: A, n and c of 2²² rows of each of two values, at the bound."""
    many = 2**22 - 1
    low, high = EDGE - 1, EDGE
    packed = np.array([many * (low**2 + high**2)], dtype=np.int64)
    found = np.tril(within_scatter(packed, np.array([2 * many]), np.array([[many * (low + high)]])))
    assert found[0, 0] == pytest.approx(many / 2, rel=1e-14)


def test_a_large_dimension_and_read_only_rows():
    batch = codes(40, 301)
    batch.setflags(write=False)
    found = added(batch, dimension=301).packed()
    exact = batch.astype(object).T @ batch.astype(object)
    assert found.tolist() == exact[np.tril_indices(301)].tolist()


def test_the_scatter_of_more_classes_than_one_block():
    rng = np.random.default_rng(0)
    compare([codes(int(size), 3, seed) for seed, size in enumerate(rng.integers(1, 5, size=1100))])
    # At the bound, where the limbs are largest.
    compare([codes(2, 2, seed, EDGE - 3, EDGE) for seed in range(2100)])


@pytest.mark.parametrize("rows", [3, 600])
def test_a_copy_stays_what_it_was_while_another_thread_changes_the_one_it_was_made_of(rows):
    batch, more = codes(rows, 4), codes(40, 4, 3)
    moment, expected = added(batch), added(batch).packed().tobytes()

    def change():
        for row in more:
            moment.add(row[None])
            moment.packed()
        for row in more:
            moment.remove(row[None])

    copies = [moment.copy() for _ in range(20)]
    with ThreadPoolExecutor() as pool:
        changing = pool.submit(change)
        assert {copy.packed().tobytes() for copy in copies} == {expected}
        changing.result()
    assert moment.packed().tobytes() == expected
