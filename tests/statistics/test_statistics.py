"""Statistics: an algebra of exact integers, compared in bytes."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from scroll_tactile.errors import CapacityError, InputError, MismatchError, UnknownMaterialError
from scroll_tactile.statistics.fields import decode, encode
from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.moments import MOST_ROWS, SecondMoment
from scroll_tactile.statistics.statistics import Statistics, StatisticsFields

DIMENSION, SCALES = 3, (5, 20)
SIZES = {"d": DIMENSION, "triangle": 6}


def touch(seed):
    """Material and codes: rows at the short scale, and at the long one too for some."""
    rng = np.random.default_rng(seed)
    material = "abcdefghijkl"[rng.integers(12)]
    codes = {5: rng.integers(-(2**BITS), 2**BITS, size=(rng.integers(1, 5), DIMENSION), dtype=np.int32, endpoint=True)}
    if rng.random() < 0.5:
        codes[20] = rng.integers(-(2**BITS), 2**BITS, size=(2, DIMENSION), dtype=np.int32)
    return material, codes


def of(touches):
    statistics = Statistics(DIMENSION, SCALES)
    for one in touches:
        statistics.add(*touch(one))
    return statistics


def restored(statistics):
    """What a store gives back of them."""
    arrays, told = encode(statistics.to_fields())
    kept = decode(StatisticsFields, {name: array.copy() for name, array in arrays.items()}, told, SIZES)
    for field in ("rows", "sums", "codes", "second"):
        setattr(kept, field, {int(scale): array for scale, array in getattr(kept, field).items()})
    return Statistics.of(DIMENSION, SCALES, kept)


def same(left, right):
    assert left == right
    assert left.digest() == right.digest()
    assert left.materials == right.materials
    for scale in SCALES:
        assert left.names(scale) == right.names(scale)
        names = left.names(scale)
        assert left.counts(scale, names).tobytes() == right.counts(scale, names).tobytes()
        assert left.sums(scale, names).tobytes() == right.sums(scale, names).tobytes()
        assert left.second(scale).rows == right.second(scale).rows
        assert left.second(scale).packed().tobytes() == right.second(scale).packed().tobytes()


touches = st.lists(st.integers(0, 40), max_size=25)
few = settings(max_examples=40, deadline=None)


@settings(max_examples=25, deadline=None)
@given(touches, touches, touches)
def test_a_sum_is_the_union(a, b, c):
    left, right = of(a), of(b)
    joint = left + right
    same(joint, of(a + b))
    for number in (1, 2, 3):  # the sum shares nothing with its parts
        joint.add(*touch(number))
        left.add(*touch(number))
    same(joint, of([*a, *b, 1, 2, 3]))
    same(left, of([*a, 1, 2, 3]))
    same(right, of(b))
    same(of(a) + of(b), of(b) + of(a))
    same((of(a) + of(b)) + of(c), of(a) + (of(b) + of(c)))
    same(of(a) + Statistics(DIMENSION, SCALES), of(a))


@few
@given(touches, touches)
def test_a_difference_takes_out_again(a, b):
    same((of(a) + of(b)) - of(b), of(a))
    same((of(a) + of(b)) - of(a), of(b))
    same(of(a) - of(a), Statistics(DIMENSION, SCALES))


@few
@given(touches, touches)
def test_what_was_removed_leaves_no_trace_even_when_more_is_observed(a, b):
    statistics = of(a + b)
    for one in b:
        statistics.remove(*touch(one))
    same(statistics, of(a))
    for one in b[::-1]:
        statistics.add(*touch(one))
    same(statistics, of(b + a))
    absent = {name for name in "abcdefghijkl" if name not in statistics.materials}
    for name in absent:
        with pytest.raises(UnknownMaterialError):
            statistics.remove(name, {5: np.ones((1, 3), np.int32)})
    same(statistics, of(b + a))


@few
@given(touches)
def test_what_a_store_keeps_is_all_of_it(observed):
    kept = of(observed).to_fields()
    assert kept.materials == sorted(of(observed).materials)
    arrays, _ = encode(kept)
    before = {name: array.tobytes() for name, array in arrays.items()}
    again = restored(of(observed))
    same(again, of(observed))
    for one in (1, 2, 3, 4, 5):
        again.add(*touch(one))
    same(again, of([*observed, 1, 2, 3, 4, 5]))
    assert {name: array.tobytes() for name, array in arrays.items()} == before
    rows = {scale: of(observed).second(scale).rows for scale in SCALES}
    assert {name for name in arrays if name.startswith("codes")} == {
        f"codes-{scale}" for scale in SCALES if 0 < rows[scale] <= DIMENSION
    }


@pytest.mark.parametrize(
    "change",
    [
        lambda s: s.add("wool", {5: np.array([[0, 0, 1]], np.int32)}),
        lambda s: s.add("felt", {5: np.zeros((1, 3), np.int32)}),
        lambda s: s.add("wool", {20: np.zeros((1, 3), np.int32)}),
        lambda s: s.add("wool", {5: np.zeros((2, 3), np.int32)}),
        lambda s: None,
    ],
)
def test_any_difference_shows_in_the_digest(change):
    base = of([])
    base.add("wool", {5: np.zeros((1, 3), np.int32)})
    changed = of([])
    change(changed)
    assert base != changed
    assert base.digest() != changed.digest()
    assert base.digest() != Statistics(4, SCALES).digest() != Statistics(3, (5,)).digest()


def test_what_is_not_contained_cannot_be_taken_out():
    wool = ("wool", {5: np.ones((2, 3), np.int32)})
    small, large = of([]), of([])
    small.add(*wool)
    large.add(*wool)
    large.add(*wool)
    for other in (large, of([1]), of([2])):
        before = small.digest()
        with pytest.raises(InputError, match="contain"):
            small - other
        assert small.digest() == before


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        ([[[1, 2, 3]]], [[[4, 5, 6]]]),
        ([[[1, 2, 3]]], [[[-1, -2, -3]]]),  # the products agree, and yet the sums do not
        ([[[1, 2, 3]], [[-1, -2, -3]]], [[[4, 5, 6]], [[-4, -5, -6]]]),  # the sums agree, and yet the products do not
        ([[[0, 0, 0]]], [[[0, 0, 0], [0, 0, 0]]]),  # nothing but the number of rows differs
        ([[[1, 1, 1], [1, 1, 1]], [[2, 2, 2]]], [[[1, 1, 1]], [[1, 1, 1]], [[2, 2, 2]]]),  # fewer touches
    ],
)
def test_as_many_touches_of_other_content_cannot_be_taken_out(ours, theirs):
    whole, part = of([]), of([])
    for statistics, touches in ((whole, ours), (part, theirs)):
        for rows in touches:
            statistics.add("wool", {5: np.array(rows, np.int32)})
    with pytest.raises(InputError, match="contain"):
        whole - part


def test_touches_of_other_lengths_are_distinguished():
    codes = {5: np.ones((2, 3), np.int32)}
    shorter, longer = of([]), of([])
    shorter.add("wool", codes, 40)
    longer.add("wool", codes, 50)
    # All counts and sums agree; only the lengths do not.
    assert shorter != longer
    before = shorter.digest()
    with pytest.raises(UnknownMaterialError, match="50 columns"):
        shorter.remove("wool", codes, 50)
    with pytest.raises(InputError, match="contain"):
        shorter - longer
    assert shorter.digest() == before
    joint = shorter + longer
    assert joint.longest == 50
    assert (joint - longer).longest == 40
    assert restored(joint).longest == 50
    joint.remove("wool", codes, 50)
    same(joint, shorter)
    assert joint.longest == 40
    joint.remove("wool", codes, 40)
    assert joint.longest == 0


def test_statistics_of_other_shapes_do_not_mix():
    for other in (Statistics(4, SCALES), Statistics(DIMENSION, (5,))):
        with pytest.raises(MismatchError, match="features"):
            of([1]) + other
        with pytest.raises(MismatchError):
            of([1]) - other
        assert of([]) != other
    assert of([]) != 3
    with pytest.raises(TypeError):
        hash(of([]))


def filled(rows, scale=20):
    """Statistics that seem to hold so many rows of zeros at a scale already."""
    statistics = of([])
    statistics.add("wool", {5: np.zeros((1, 3), np.int32), scale: np.zeros((1, 3), np.int32)})
    statistics._own["wool"].rows[scale] = rows
    statistics._seconds[scale] = SecondMoment.of(np.zeros(6, np.int64), rows, DIMENSION)
    return statistics


def test_full_statistics_refuse_before_anything_is_added():
    statistics = filled(MOST_ROWS - 1)
    before = statistics.digest()
    codes = {5: np.ones((3, 3), np.int32), 20: np.ones((2, 3), np.int32)}
    with pytest.raises(CapacityError, match="exact"):
        statistics.add("felt", codes)
    assert statistics.digest() == before
    assert statistics.materials == {"wool": 1}
    assert statistics.second(5).rows == 1
    statistics.add("felt", {5: codes[5], 20: codes[20][:1]})
    assert statistics.materials == {"felt": 1, "wool": 1}
    half = MOST_ROWS // 2 + 1
    with pytest.raises(CapacityError, match="exact"):
        filled(half) + filled(half)


lengths = st.lists(st.sampled_from([1, 2, 9, 9, 40, 50, 400, 10**6]), max_size=60)


@few
@given(lengths, lengths)
@example([1, *[9] * 19], [9])
def test_the_fifth_percentile_is_the_length_that_nineteen_of_twenty_touches_have(first, second):
    def observed(columns):
        statistics = Statistics(DIMENSION, SCALES)
        for i, length in enumerate(columns):
            statistics.add("ab"[i % 2], {5: np.zeros((1, DIMENSION), np.int32)}, length)
        return statistics

    def least(columns):
        """The longest that fewer than one of twenty are shorter than."""
        had = [length for length in columns if 20 * sum(other < length for other in columns) < len(columns)]
        return max(had, default=0)

    a, b = observed(first), observed(second)
    assert a.fifth_percentile_length == least(first)
    assert (a + b).fifth_percentile_length == least(first + second)
    assert ((a + b) - b).fifth_percentile_length == least(first)
    assert restored(a).fifth_percentile_length == least(first)
    for i, length in enumerate(first[:5]):
        a.remove("ab"[i % 2], {5: np.zeros((1, DIMENSION), np.int32)}, length)
    assert a.fifth_percentile_length == least(first[5:])


def test_sums_that_need_more_than_32_bits_are_exact_and_can_be_taken_out():
    statistics, codes = of([1, 2]), {5: np.full((3000, DIMENSION), 2**BITS, dtype=np.int32)}
    codes[5][:, 0] *= -1
    before = statistics.digest()
    statistics.add("z", codes)
    assert statistics.sums(5, ["z"]).tolist() == [[-3000 << BITS, 3000 << BITS, 3000 << BITS]]
    same(restored(statistics), statistics)
    same(statistics + of([3]), of([3]) + statistics)
    statistics.remove("z", codes)
    assert statistics.digest() == before
