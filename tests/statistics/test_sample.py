"""Samples: bounded, even over the materials, and functions of what was observed, not of the order."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scroll_tactile.errors import InputError
from scroll_tactile.statistics.sample import CAPACITY, TouchSample, WindowSums

DIMENSION = 2


def sums_of(material, key):
    """Sums whose content tells which touch they are of."""
    stages = len(key) % 2 + 1
    sums = np.full((stages, DIMENSION), 1000 * ord(material[0]) + key[0], dtype=np.int32)
    return WindowSums(sums, np.array([(stage, 0, stage + 1) for stage in range(stages)]))


def sample_of(streams, capacity=6):
    sample = TouchSample(capacity)
    for material, key in streams:
        before, wanted = content(sample), sample.wants(material, key)
        assert content(sample) == before
        sample.add(material, key, sums_of(material, key))
        assert (content(sample) != before) == wanted
        assert not (wanted and not sample.holds(material, key))
    return sample


def content(sample):
    return [(material, key, sums.sums.tobytes(), sums.pairs.tobytes()) for material, key, sums in sample]


def expected(streams, capacity=6):
    """The definition, word for word: rank each material's keys, take the smallest (rank, key, material)."""
    keys = {name: sorted({key for other, key in streams if other == name}) for name, _ in streams}
    ranked = sorted((rank, key, name) for name, own in keys.items() for rank, key in enumerate(own))
    return sorted((name, key) for _, key, name in ranked[:capacity])


# Few keys, so that one key comes under two names and twice under one.
stream = st.tuples(st.sampled_from("abcd"), st.integers(0, 12).map(lambda number: bytes([number])))
streams = st.lists(stream, max_size=30)


@settings(max_examples=100, deadline=None)
@given(streams, streams, st.integers(1, 8), st.randoms(use_true_random=False))
def test_any_order_and_split_holds_what_the_definition_says(ours, theirs, capacity, random):
    together = sample_of(ours + theirs, capacity)
    assert [(material, key) for material, key, _ in together] == expected(ours + theirs, capacity)
    shuffled = ours + theirs
    random.shuffle(shuffled)
    assert content(sample_of(shuffled, capacity)) == content(together)
    merged = sample_of(ours, capacity)
    merged.update(sample_of(theirs, capacity))
    assert content(merged) == content(together)


@settings(max_examples=50, deadline=None)
@given(streams, streams, st.integers(1, 8))
def test_it_is_filled_again_from_streams_of_which_only_those_that_stay_are_made(held, behind, capacity):
    sample, made = sample_of(held, capacity), []

    def make(material, key, sequence):
        made.append((material, key, sequence))
        return sums_of(material, key)

    kept = [(material, key) for material, key, _ in sample]
    sample.refill([(material, key, sequence) for sequence, (material, key) in enumerate(behind)], make)
    assert content(sample) == content(sample_of(kept + behind, capacity))
    stays = [(material, key) for material, key, _ in sample if (material, key) not in kept]
    assert [(material, key, behind.index((material, key))) for material, key in stays] == made


@settings(max_examples=50, deadline=None)
@given(streams, stream)
def test_what_a_store_keeps_is_all_of_it(before, after):
    sample = sample_of(before, CAPACITY)
    again = TouchSample.from_arrays(*sample.to_arrays())
    for part in (sample, again):
        part.add(*after, sums_of(*after))
    assert content(again) == content(sample) == content(sample_of([*before, after], CAPACITY))


@pytest.mark.parametrize("capacity", [0, -1])
def test_a_sample_of_nothing_is_refused(capacity):
    with pytest.raises(InputError, match=f"1 or more items; came {capacity}"):
        TouchSample(capacity)


def test_a_touch_holds_the_sums_of_each_stages_windows():
    codes = {5: np.arange(12, dtype=np.int32).reshape(4, 3), 20: np.full((1, 3), 2**20, dtype=np.int32)}
    sums = WindowSums.of([{5: [0]}, {5: [0, 2, 3], 20: [0]}], codes)
    assert [mean.tolist() for mean in sums.means(0)] == [[0, 1, 2]]
    assert [mean.tolist() for mean in sums.means(1)] == [[5, 6, 7], [2**20] * 3]
    assert (sums.means(2), sums.windows(0), sums.windows(1), sums.windows(2)) == (None, [1], [3, 1], [])


@pytest.mark.parametrize("materials", [1, 7, 400])
def test_the_usual_capacity_is_shared_evenly(materials):
    rng = np.random.default_rng(0)
    sample = TouchSample()
    for i in range(1200):
        key = rng.bytes(32)
        sample.add(str(i % materials), key, sums_of("m", key))
    assert len(sample) == CAPACITY
    places = Counter(material for material, *_ in sample).values()
    assert max(places) - min(places) <= 1
