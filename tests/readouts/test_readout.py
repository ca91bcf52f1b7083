"""Readouts, solved and followed, against the textbook's dense formulas in fifty digits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from readouts.dense import Dense, groups_of, require_near

from scroll_tactile.readouts.task import Task
from scroll_tactile.statistics.statistics import Statistics

EDGE, SCALE, WIDTH = 2**20, 7, 5


def touch(material, seed, offset=0, spread=20_000, rows=None):
    """A touch of a material: its rows about a mean of the material's own."""
    rng = np.random.default_rng([ord(material), seed])
    mean = np.random.default_rng(ord(material)).normal(size=WIDTH) * 60_000
    count = int(rng.integers(1, 4)) if rows is None else rows
    mixing = np.random.default_rng(9).normal(size=(WIDTH, WIDTH))
    found = offset + mean + rng.normal(size=(count, WIDTH)) @ mixing * spread
    return material, np.clip(np.rint(found), -EDGE, EDGE).astype(np.int32)


def statistics_of(touches):
    statistics = Statistics(WIDTH, [SCALE])
    for material, rows in touches:
        statistics.add(material, {SCALE: rows})
    return statistics


def readout_of(statistics, reference=None):
    return Task.of(statistics, SCALE, reference or statistics.names(SCALE)).solve()


def require_textbook(readout, touches, probes, tolerance=1e-9):
    names = sorted({material for material, _ in touches})
    reference = readout.reference
    dense = Dense(groups_of(touches), readout.penalty, readout.share, reference)
    places = [readout.places[name] for name in names]
    known = [readout.places[name] for name in reference]
    for row in probes:
        codes = row.astype(np.float64)
        require_near(readout.scores(codes, places, "lda"), dense.lda(row, names, readout.origin), tolerance)
        near = dense.distances(row, names)
        size = {"abs": tolerance * max(1.0, dense.length(row))}
        assert readout.novelty(codes, places) == pytest.approx(min(near), **size)
        assert readout.novelty(codes, places[1:] or places) == pytest.approx(min(near[1:] or near), **size)
        if len(reference) == len(names):
            require_near(readout.scores(codes, known, "ridge"), dense.ridge(row, reference), tolerance)
        for kind in ("lda", "ridge") if len(reference) == len(names) else ("lda",):
            weights, offsets = readout.linear(names, kind)
            require_near((codes - readout.origin) @ weights + offsets, readout.scores(codes, places, kind), tolerance)


CASES = {
    "ordinary": [touch("abc"[i % 3], i) for i in range(20)],
    "two materials": [touch("ab"[i > 3], i) for i in range(9)],
    "one material": [touch("a", i) for i in range(6)],
    "one touch each": [touch(name, 0) for name in "abcd"],
    "one row each": [touch(name, 0, rows=1) for name in "abcd"],
    "one row": [touch("a", 0, rows=1)],
    "fewer rows than features": [touch("a", 0, rows=1), touch("b", 0, rows=2), touch("b", 1, rows=1)],
    "mean far from zero": [touch("abc"[i % 3], i, 0.9 * EDGE, 50) for i in range(12)],
    "little spread": [touch("ab"[i % 2], i, 0, 200) for i in range(10)],
}
PROBES = [touch("a", 50, rows=1)[1][0], touch("c", 51, rows=1)[1][0], np.full(WIDTH, EDGE), np.zeros(WIDTH, np.int32)]


@pytest.mark.parametrize("touches", CASES.values(), ids=CASES)
def test_all_answers_are_the_textbooks(touches):
    require_textbook(readout_of(statistics_of(touches)), touches, [*PROBES, touches[0][1][0]])


def test_of_materials_fifty_thousand_spreads_apart_some_digits_of_novelty_and_ridge_are_lost():
    touches = [touch("ab"[i % 2], i, 0, 1) for i in range(10)]
    require_textbook(readout_of(statistics_of(touches)), touches, [*PROBES, touches[0][1][0]], 1e-6)


# A touch that comes, of a material and a number; or one that goes, by its place among those that are there.
CHANGES = st.lists(
    st.lists(
        st.tuples(st.sampled_from("abcdef"), st.integers(0, 10**6)) | st.integers(0, 10**6), min_size=1, max_size=4
    ),
    max_size=8,
)


@settings(max_examples=30, deadline=None)
@given(CHANGES, st.sampled_from([0, 0.9 * EDGE]), st.sampled_from([None, ["a", "b"]]))
def test_followed_it_is_the_textbooks_of_what_is_there(batches, offset, reference):
    """With the same P and ρ; where it cannot follow it says so, and is solved again."""
    touches = [touch("abc"[i % 3], i, offset) for i in range(15)]
    statistics = statistics_of(touches)
    readout = readout_of(statistics, reference)
    for batch in batches:
        changes = []
        for change in batch:
            if isinstance(change, int) and len(touches) > 1:
                name, rows = touches.pop(change % len(touches))
                statistics.remove(name, {SCALE: rows})
                changes.append((name, rows, -1))
            elif not isinstance(change, int):
                touches.append(touch(*change, offset))
                statistics.add(touches[-1][0], {SCALE: touches[-1][1]})
                changes.append((*touches[-1], 1))
        gone = any(name not in statistics.names(SCALE) for name, *_ in changes)
        followed = readout.follow(changes)
        assert not (gone and followed)
        if not followed:
            there = statistics.names(SCALE)
            readout = readout_of(statistics, [name for name in reference or there if name in there] or there[:1])
    require_textbook(readout, touches, PROBES[:2])


def test_following_stays_exact_for_as_long_as_it_follows():
    touches = [touch("abc"[i % 3], i, 0.9 * EDGE) for i in range(15)]
    statistics = statistics_of(touches)
    readout, followed = readout_of(statistics), 0
    for i in range(200):
        touches.append(touch("abc"[i % 3], 100 + i, 0.9 * EDGE, rows=1))
        statistics.add(touches[-1][0], {SCALE: touches[-1][1]})
        if readout.follow([(*touches[-1], 1)]):
            followed += 1
            continue
        break
    assert followed == 32  # all the columns that there is room for
    require_textbook(readout, touches[:-1], PROBES[:2])
    fresh = readout_of(statistics)
    require_textbook(fresh, touches, PROBES[:2])


@pytest.mark.parametrize(
    "changes",
    [
        [("a", touch("a", 0, rows=40)[1], 1)],  # more columns than there is room for
        [(*touch("a", 91, spread=9, rows=3), 1), (*touch("a", 90, spread=10**6, rows=3), 1)],  # much louder than others
        [(*touch("d", 0), -1)],  # never observed
        [(*touch("a", i, spread=300), -1) for i in (0, 3)],  # all that there was of it
    ],
)
def test_where_it_cannot_follow_it_says_so(changes):
    statistics = statistics_of([touch("abc"[i % 3], i, spread=300) for i in range(6)])
    assert not readout_of(statistics).follow(changes)
    assert readout_of(statistics).follow([])


def test_a_material_that_is_new_is_known_at_once_and_belongs_to_the_reference_where_all_do():
    touches = [touch("abc"[i % 3], i) for i in range(12)]
    statistics = statistics_of(touches)
    whole, part = readout_of(statistics), readout_of(statistics, ["a", "b"])
    touches.append(touch("z", 0))
    statistics.add(touches[-1][0], {SCALE: touches[-1][1]})
    assert whole.follow([(*touches[-1], 1)])
    assert part.follow([(*touches[-1], 1)])
    assert [readout.names for readout in (whole, part)] == [[*"abcz"]] * 2
    assert [readout.reference for readout in (whole, part)] == [[*"abcz"], [*"ab"]]
    require_textbook(whole, touches, PROBES[:2])
    require_textbook(part, touches, PROBES[:2])


@pytest.mark.parametrize("offset", [0, 0.9 * EDGE])
def test_of_many_materials_scores_in_single_precision_are_near_enough(monkeypatch, offset):
    rng = np.random.default_rng(0)
    names = [f"{i:03d}" for i in range(300)]
    statistics = Statistics(64, [SCALE])
    means, mixing = rng.normal(size=(301, 64)) * 30_000, rng.normal(size=(64, 64))

    def rows_of(place):
        found = offset + means[place] + rng.normal(size=(2, 64)) @ mixing * 2_000
        return {SCALE: np.clip(np.rint(found), -EDGE, EDGE).astype(np.int32)}

    for place, name in enumerate(names * 2):
        statistics.add(name, rows_of(place % 300))
    double = readout_of(statistics, names[:20])
    monkeypatch.setattr("scroll_tactile.readouts.task.IN_DOUBLE", 299)
    single = readout_of(statistics, names[:20])
    assert (single.near.solved.dtype, single.others.solved.dtype) == (np.float64, np.float32)
    for followed in range(12):
        probe = rows_of(followed * 25)[SCALE][0].astype(float)
        for places in (range(300), [7, 150, 299]):
            expected = double.scores(probe, places, "lda")
            require_near(single.scores(probe, places, "lda"), expected, 1e-6)
            distance = double.novelty(probe, places)
            assert single.novelty(probe, places) == pytest.approx(distance, abs=1e-6 * np.abs(expected).max())
        own = followed * 25
        assert single.diagonal_distance(probe, own) == pytest.approx(double.diagonal_distance(probe, own), rel=1e-4)
        change = [(["new", *names][own], rows_of(own)[SCALE], 1)]
        assert double.follow(change)
        assert single.follow(change)
