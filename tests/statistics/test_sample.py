"""Samples: bounded, even over the materials, and functions of what was observed, not of the order."""

from collections import Counter
from fractions import Fraction
from math import floor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scroll_tactile.statistics.grid import mean_code
from scroll_tactile.statistics.sample import CAPACITY, SampledTouch, TouchSample, stage_rows

DIMENSION = 2


def rows_at(touch, stage):
    """The rows of the scales that judge at a stage."""
    return touch.rows[touch.pairs[:, 0] == stage]


def touch_of(material, key):
    """Rows whose content tells which touch they are of."""
    stages = len(key) % 2 + 1
    rows = np.full((stages, DIMENSION), 1000 * ord(material[0]) + key[0], dtype=np.int32)
    return SampledTouch(rows, np.array([(stage, 0, stage + 1) for stage in range(stages)]))


def sample_of(streams, capacity=6):
    sample = TouchSample(capacity)
    for material, key in streams:
        before, wanted = content(sample), sample.wants(material, key)
        assert content(sample) == before
        sample.add(material, key, touch_of(material, key))
        assert (content(sample) != before) == wanted
        assert not (wanted and not sample.holds(material, key))
    return sample


def content(sample):
    return [(material, key, touch.rows.tobytes(), touch.pairs.tobytes()) for material, key, touch in sample]


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

    def make(source):
        made.append(source)
        return touch_of(*source[:2])

    kept = [(material, key) for material, key, _ in sample]
    sample.refill([(*each, (*each, sequence)) for sequence, each in enumerate(behind)], make)
    assert content(sample) == content(sample_of(kept + behind, capacity))
    stays = [(material, key) for material, key, _ in sample if (material, key) not in kept]
    assert [(material, key, behind.index((material, key))) for material, key in stays] == made


@settings(max_examples=50, deadline=None)
@given(streams, stream)
def test_what_a_store_keeps_is_all_of_it(before, after):
    sample = sample_of(before, CAPACITY)
    again = TouchSample.of(sample.to_fields(DIMENSION))
    for part in (sample, again):
        part.add(*after, touch_of(*after))
    assert content(again) == content(sample) == content(sample_of([*before, after], CAPACITY))


# Of each stage: the places of windows, in groups, at each of two scales; a scale judges there or does not.
stages = st.lists(
    st.dictionaries(
        st.sampled_from([5, 20]),
        st.lists(st.lists(st.integers(0, 7), min_size=1, max_size=5), min_size=1, max_size=3),
        min_size=1,
    ),
    min_size=1,
    max_size=4,
)


def rounded(rows):
    """The mean of rows, halves upward, in exact fractions."""
    return [floor(Fraction(sum(column), len(rows)) + Fraction(1, 2)) for column in zip(*rows.tolist(), strict=True)]


@settings(max_examples=60, deadline=None)
@given(stages, st.integers(0, 999), st.integers(0, 3))
def test_a_touch_is_a_row_a_group_the_rounded_mean_of_its_windows(stages, seed, copies):
    rng = np.random.default_rng(seed)
    windows = {scale: rng.integers(-(2**20), 2**20, (8, 3), dtype=np.int32, endpoint=True) for scale in (5, 20)}
    learned = stage_rows(stages, windows)
    for scale, rows in learned.items():
        groups = [group for stage in stages for group in stage.get(scale, [])]
        assert rows.dtype == np.int32
        assert rows.tolist() == [rounded(windows[scale][group]) for group in groups]
    assert set(learned) == {scale for stage in stages for scale in stage}
    # Its copies' rows stand behind its own.
    codes = {scale: np.concatenate([rows, *[rows[::-1] // 2] * copies]) for scale, rows in learned.items()}
    touch, used = SampledTouch.of(stages, codes), dict.fromkeys(learned, 0)
    for number, stage in enumerate(stages):
        expected = []
        for place, scale in enumerate(sorted(stage)):
            first, used[scale] = used[scale], used[scale] + len(stage[scale])
            expected.append(rounded(learned[scale][first : used[scale]]))
            assert [number, place, len(codes[scale])] in touch.pairs.tolist()
        assert rows_at(touch, number).tolist() == expected
    assert rows_at(touch, len(stages)).shape == (0, 3)


def test_halves_go_upward_whatever_the_sign():
    assert mean_code(np.array([3, -3, 5, -5, 1, -1]), 2).tolist() == [2, -1, 3, -2, 1, 0]


@pytest.mark.parametrize("materials", [1, 7, 400])
def test_the_usual_capacity_is_shared_evenly(materials):
    rng = np.random.default_rng(0)
    sample = TouchSample()
    for i in range(1200):
        key = rng.bytes(32)
        sample.add(str(i % materials), key, touch_of("m", key))
    assert len(sample) == CAPACITY
    places = Counter(material for material, *_ in sample).values()
    assert max(places) - min(places) <= 1
