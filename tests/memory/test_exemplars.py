"""The buffer: herded exactly, spread evenly, and a function of what was observed, not of when."""

from collections import Counter
from dataclasses import replace
from fractions import Fraction
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paper_touches import recorded
from touches import Windowed, fed

from examples.benchmarks import buffers
from scroll_tactile import Kernels
from scroll_tactile.memory.exemplars import (
    Exemplar,
    ExemplarFields,
    herd,
    quotas,
    rank,
)
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.fields import encode
from scroll_tactile.statistics.grid import mean_code
from scroll_tactile.statistics.sample import Sample

few = settings(max_examples=60, deadline=None)
LARGEST = 2**20


def keys_of(count, seed=0):
    rng = np.random.default_rng(seed)
    return [rng.bytes(8) for _ in range(count)]


def herded_in_fractions(candidates, keys, mean, count):
    """Algorithm 4 of iCaRL as it is written, in rational numbers."""
    left = sorted(range(len(keys)), key=lambda i: keys[i])
    total, chosen = [Fraction(0)] * len(mean), []
    for step in range(1, min(count, len(keys)) + 1):

        def distance(i, step=step, total=total):
            return sum((m - (x + s) / step) ** 2 for m, x, s in zip(mean, candidates[i], total, strict=True))

        best = min(left, key=distance)  # the first of equal ones
        left.remove(best)
        total = [s + x for s, x in zip(total, candidates[best], strict=True)]
        chosen.append(best)
    return chosen


@st.composite
def classes(draw):
    size, width = draw(st.integers(1, 7)), draw(st.integers(1, 3))
    # Few values, so that distances tie; or the largest that there are.
    value = draw(
        st.sampled_from([st.integers(-2, 2), st.integers(-LARGEST, LARGEST), st.sampled_from([-LARGEST, LARGEST])])
    )
    rows = draw(st.lists(st.lists(value, min_size=width, max_size=width), min_size=size, max_size=size))
    mean = draw(st.lists(value, min_size=width, max_size=width))
    keys = draw(st.lists(st.binary(min_size=2, max_size=2), min_size=size, max_size=size, unique=True))
    return rows, keys, mean, draw(st.integers(0, size + 1))


@few
@given(classes())
def test_herding_is_the_papers_in_exact_numbers(given):
    rows, keys, mean, count = given
    expected = herded_in_fractions([[Fraction(x) for x in row] for row in rows], keys, mean, count)
    assert herd(np.array(rows), keys, np.array(mean), count) == expected


def test_scores_beyond_64_bits_are_still_compared_exactly():
    # All candidates lie opposite the mean. From the 342nd step on the score of the far one exceeds 2⁶³; it comes last.
    # The others differ by single steps of the grid, which float64 would not see in such scores.
    width, count = 8192, 400
    rows = np.full((count + 1, width), LARGEST // 2, dtype=np.int32)
    rows[np.arange(count), np.arange(count)] -= np.arange(count) % 7
    rows[count] = LARGEST
    keys = keys_of(count + 1)
    expected = sorted(range(count), key=lambda i: (-(i % 7), keys[i]))
    assert herd(rows, keys, np.full(width, -LARGEST), count + 1) == [*expected, count]


def test_the_mean_code_is_rounded_to_the_next_integer():
    assert mean_code(np.array([-5, -3, 3, 4, 5, 6]), 4).tolist() == [-1, -1, 1, 1, 1, 2]


@few
@given(st.dictionaries(st.sampled_from("abcdefg"), st.integers(0, 20)), st.integers(0, 90))
def test_a_larger_buffer_takes_a_place_from_nobody(available, capacity):
    less, more = quotas(available, capacity), quotas(available, capacity + 1)
    assert all(less[name] <= more[name] for name in available)


@pytest.mark.parametrize(("capacity", "places"), [(1, [1, 0, 0]), (2, [1, 1, 0]), (5, [2, 2, 1])])
def test_of_materials_with_as_many_streams_the_first_by_name_get_the_spare_places(capacity, places):
    for order in ("abc", "cba", "bca"):
        assert quotas(dict.fromkeys(order, 9), capacity) == dict(zip("abc", places, strict=True))


# --- candidates ---


def exemplar(material, number, scale=40):
    """A stream of two readings of four bytes; number gives its key."""
    code = np.random.default_rng([number, ord(material[0])]).integers(-LARGEST, LARGEST, 3).astype(np.int32)
    return Exemplar(material, bytes([number]), np.full((2, 1), number, np.float32), code, Scale("window", scale))


def sample_of(streams, capacity=9):
    """A sample in which row 1000 + number has a stream's readings."""
    sample = Sample(capacity)
    for material, number in streams:
        key, before = bytes([number]), state(sample)
        wanted = sample.wants(material, key)
        sample.add(material, key, 1000 + number)
        assert wanted == (state(sample) != before)
    return sample


def state(sample):
    arrays, told = encode(ExemplarFields.of(sample))
    return {name: (array.shape, array.tobytes()) for name, array in arrays.items()}, told


def held(sample):
    return [(material, key[0]) for material, key, _ in sample]


streams = st.lists(st.tuples(st.sampled_from("abcdef"), st.integers(0, 25)), max_size=40)


@few
@given(streams, streams, st.integers(1, 24), st.randoms(use_true_random=False))
def test_any_order_split_merge_or_restart_keeps_what_the_definition_says(ours, theirs, capacity, random):
    """The definition: by rank of the key in its material, key, material, the first that fit."""
    observed = {name: sorted({number for other, number in ours + theirs if other == name}) for name, _ in ours + theirs}
    order = sorted((i, number, name) for name, numbers in observed.items() for i, number in enumerate(numbers))
    expected = sorted((name, number) for _, number, name in order[:capacity])
    together = sample_of(ours + theirs, capacity)
    assert held(together) == expected
    shuffled = ours + theirs
    random.shuffle(shuffled)
    assert state(sample_of(shuffled, capacity)) == state(together)
    merged = sample_of(ours, capacity)
    merged.update(sample_of(theirs, capacity))
    assert state(merged) == state(together)


@few
@given(streams, streams, st.integers(1, 6), st.integers(1, 6))
def test_a_restarted_sample_goes_on_and_one_of_fewer_is_the_beginning_of_it(ours, theirs, before, after):
    restarted = Sample(min(before, after))
    restarted.update(ExemplarFields.of(sample_of(ours, before)).rows(0))
    for material, number in theirs:
        restarted.add(material, bytes([number]), 1000 + number)
    assert state(restarted) == state(sample_of(ours + theirs, min(before, after)))


@few
@given(streams)
def test_a_compaction_checkpoint_gives_exemplars_back_and_says_that_it_has_them(observed):
    kept = [exemplar(*stream) for stream in sorted(set(observed))]
    fields = ExemplarFields.of(Sample(99), kept)
    again = fields.exemplars()
    assert [(e.material, e.key, e.readings.tobytes(), e.readings.shape, e.code.tolist(), e.scale) for e in again] == [
        (e.material, e.key, e.readings.tobytes(), e.readings.shape, e.code.tolist(), e.scale) for e in kept
    ]
    assert all(source == 0 for *_, source in fields.rows(0))


def test_an_exemplars_code_is_the_last_of_its_own_at_its_widest_scale():
    narrow, wide = Scale("window", 5), Scale("window", 20)
    codes = {narrow: np.arange(8, dtype=np.int32).reshape(4, 2), wide: np.array([[1, 2], [3, 4], [8, 9]], np.int32)}
    stages = [{narrow: [[0]]}, {narrow: [[0]], wide: [[0]]}, {narrow: [[0]], wide: [[0, 1]]}]  # and a row of a copy
    one = Exemplar.of("wool", b"k", np.zeros((30, 4), np.float32), stages, codes)
    assert (one.scale, one.code.tolist(), one.code.dtype) == (wide, [3, 4], np.int32)


# --- the buffer ---


@few
@given(streams, st.integers(1, 10), st.randoms(use_true_random=False))
def test_the_buffer_depends_on_no_order_and_is_even(observed, capacity, random):
    def buffer(observed):
        candidates = [exemplar(material, key[0]) for material, key, _ in sample_of(observed, capacity)]
        ranked = rank(candidates, capacity, lambda material, _: np.full(3, ord(material)))
        return {name: [exemplar.key for exemplar in exemplars] for name, exemplars in ranked.items()}

    found = buffer(observed)
    shuffled = observed.copy()
    random.shuffle(shuffled)
    assert list(buffer(shuffled).items()) == list(found.items())
    assert list(found) == sorted(found)
    available = Counter(name for name, _ in set(observed))
    assert sum(map(len, found.values())) == min(capacity, sum(available.values()))
    for name, count in available.items():
        if len(found.get(name, [])) < count:
            assert len(found.get(name, [])) >= max(map(len, found.values())) - 1


def test_the_buffer_is_herded_at_the_widest_scale_and_brief_touches_come_behind():
    streams = {9: (20, [1, 0, 0]), 1: (20, [90, 0, 0]), 7: (5, [0, 0, 0]), 8: (5, [0, 0, 0])}
    candidates = [
        replace(exemplar("a", number, scale), code=np.array(code, np.int32))
        for number, (scale, code) in streams.items()
    ]
    asked = []

    def means(material, scale):
        asked.append((material, scale))
        return np.zeros(3, np.int64)

    assert [exemplar.key[0] for exemplar in rank(candidates, 6, means)["a"]] == [9, 1, 7, 8]
    assert asked == [("a", Scale("window", 20))]


def test_the_study_of_buffers_fine_tunes_on_each_way_of_choosing(monkeypatch):
    monkeypatch.setattr(buffers, "fine_tune", partial(buffers.fine_tune, epochs=1))
    result = buffers.run_buffers(recorded(materials=2, each=4, folds=2, ordered=True), Kernels(dimension=64), (6,))
    ways = {record["way"]: record for record in result["records"]}
    assert set(ways) == {"full", "pooled-2", "pooled-3", "pooled-4", "live", "random"}
    assert ways["pooled-3"]["overlap"] == 1
    assert all(0 <= record["tuned"] <= 1 and record["gap"] > 0 for record in ways.values())


def test_views_change_no_exemplar():
    """They are herded by windows, as f* is trained."""
    observed = [(name, (seed, readings)) for seed, readings in enumerate((60, 10, 25, 90, 60, 60, 37)) for name in "ab"]
    windowed = fed(observed, embedding=Windowed(seed=0, dimension=64))
    assert fed(observed).exemplars == windowed.exemplars
    assert sum(map(len, windowed.exemplars.values())) == 4 < len(observed)
