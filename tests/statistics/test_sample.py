"""The pool: bounded, even over the materials, and a function of what was felt, not of when."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scroll_tactile.statistics.sample import CAPACITY, TouchSample, WindowSums

DIMENSION = 2


def touch(material, key):
    """A touch whose content tells which it is."""
    stages = len(key) % 2 + 1
    sums = np.full((stages, DIMENSION), 1000 * ord(material[0]) + key[0], dtype=np.int32)
    return WindowSums(sums, np.array([(stage, 0, stage + 1) for stage in range(stages)]))


def filled(entries, capacity=6):
    pool = TouchSample(capacity)
    for material, key in entries:
        pool.add(material, key, touch(material, key))
    return pool


def content(pool):
    return [(material, key, one.sums.tobytes(), one.pairs.tobytes()) for material, key, one in pool]


def expected(entries, capacity=6):
    """The definition, word for word: rank each material's keys, take the smallest (rank, key, material)."""
    keys = {}
    for material, key in set(entries):
        keys.setdefault(material, []).append(key)
    ranked = [(rank, key, name) for name, those in keys.items() for rank, key in enumerate(sorted(those))]
    return sorted((name, key) for _, key, name in sorted(ranked)[:capacity])


# Few keys, so that one key comes under two names and twice under one.
entries = st.lists(st.tuples(st.sampled_from("abcd"), st.integers(0, 12).map(lambda at: bytes([at]))), max_size=30)
few = settings(max_examples=200, deadline=None)


@few
@given(entries, st.integers(1, 8))
def test_it_holds_what_its_definition_says(felt, capacity):
    assert [(material, key) for material, key, _ in filled(felt, capacity)] == expected(felt, capacity)


@few
@given(entries, st.integers(1, 8), st.randoms(use_true_random=False))
def test_any_order_gives_the_same_pool(felt, capacity, random):
    shuffled = felt.copy()
    random.shuffle(shuffled)
    assert content(filled(shuffled, capacity)) == content(filled(felt, capacity))


def test_one_stream_under_two_names_is_kept_in_any_order():
    felt = [("a", b"\x05"), ("b", b"\x05")]
    assert content(filled(felt, 1)) == content(filled(felt[::-1], 1))


@few
@given(entries, entries)
def test_a_pool_of_two_pools_is_the_pool_of_all(a, b):
    kept = [(material, key) for pool in (filled(a), filled(b)) for material, key, _ in pool]
    assert content(filled(kept)) == content(filled(a + b))


@few
@given(entries)
def test_it_is_bounded_and_even(felt):
    pool = filled(felt)
    assert len(pool) == len(content(pool)) <= 6
    kept, there = Counter(material for material, *_ in pool), Counter(material for material, _ in set(felt))
    for material in there:
        # A material with spare touches has at most one place fewer than any other.
        if kept[material] < there[material]:
            assert kept[material] >= max(kept.values()) - 1
            assert len(pool) == 6


@few
@given(entries, st.tuples(st.sampled_from("abcd"), st.integers(0, 12).map(lambda at: bytes([at]))))
def test_wants_says_whether_add_would_keep_it(felt, one):
    pool = filled(felt)
    before = content(pool)
    wanted = pool.wants(*one)
    assert content(pool) == before
    pool.add(*one, touch(*one))
    assert (content(pool) != before) == wanted


@few
@given(entries)
def test_what_a_store_keeps_is_all_of_it(felt):
    pool = filled(felt, CAPACITY)
    arrays, materials = pool.to_arrays()
    again = TouchSample.from_arrays(arrays, materials)
    assert content(again) == content(pool)
    assert len(again) == len(pool)
    again.add("z", b"\x01", touch("z", b"\x01"))
    pool.add("z", b"\x01", touch("z", b"\x01"))
    assert content(again) == content(pool)


def test_an_empty_pool_can_be_kept():
    arrays, materials = TouchSample().to_arrays()
    assert list(TouchSample.from_arrays(arrays, materials)) == []


def test_a_touch_holds_the_sums_of_each_stages_windows():
    codes = {5: np.arange(12, dtype=np.int32).reshape(4, 3), 20: np.full((1, 3), 2**20, dtype=np.int32)}
    one = WindowSums.of([{5: [0]}, {5: [0, 2, 3], 20: [0]}], codes)
    assert [mean.tolist() for mean in one.means(0)] == [[0, 1, 2]]
    assert [mean.tolist() for mean in one.means(1)] == [[5, 6, 7], [2**20] * 3]
    assert one.means(2) is None


def test_sums_of_the_most_windows_fit():
    codes = {5: np.full((64, 2), 2**20, dtype=np.int32)}
    assert WindowSums.of([{5: list(range(64))}], codes).means(0)[0].tolist() == [2**20] * 2


@pytest.mark.parametrize("materials", [1, 7, 400])
def test_the_default_capacity(materials):
    rng = np.random.default_rng(0)
    pool = TouchSample()
    for at in range(1200):
        key = rng.bytes(32)
        pool.add(str(at % materials), key, touch("m", key))
    assert len(pool) == CAPACITY
    places = Counter(material for material, *_ in pool).values()
    assert max(places) - min(places) <= 1
