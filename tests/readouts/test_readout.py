"""Readouts, solved and followed, against the textbook's dense formulas in fifty digits."""

import copy

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
    return Task.of(statistics, SCALE, reference or statistics.names(SCALE)).solve(statistics)


def require_textbook(readout, touches, probes, tolerance=1e-9):
    names = sorted({material for material, _ in touches})
    reference = [readout.names[place] for place in readout.reference]
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


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 9), st.integers(1, 3), st.integers(1, 9))
def test_of_a_reference_and_materials_held_when_asked_for(seed, materials, each, reference):
    touches = [touch("abcdefghi"[i % materials], seed + i) for i in range(materials * each)]
    names = sorted({name for name, _ in touches})[: min(reference, materials)]
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("scroll_tactile.readouts.readout.EAGER", 3)
        monkeypatch.setattr("scroll_tactile.readouts.readout.MOST_HELD", 5)
        readout = readout_of(statistics_of(touches), names)
        few = sorted({name for name, _ in touches})[-3:]
        dense = Dense(groups_of(touches), readout.penalty, readout.share, names)
        for row in PROBES:
            found = readout.scores(row.astype(float), [readout.places[name] for name in few], "lda")
            require_near(found, dense.lda(row, few, readout.origin))


# A touch that comes, of a material and a number; or one that goes, by its place among those that are there.
CHANGES = st.lists(
    st.lists(
        st.tuples(st.sampled_from("abcdef"), st.integers(0, 10**6)) | st.integers(0, 10**6), min_size=1, max_size=4
    ),
    max_size=8,
)


@settings(max_examples=30, deadline=None)
@given(CHANGES, st.sampled_from([0, 0.9 * EDGE]), st.booleans())
def test_followed_it_is_the_textbooks_of_what_is_there(batches, offset, lazily):
    """With the same P and ρ; where it cannot follow it says so, and is solved again."""
    touches = [touch("abc"[i % 3], i, offset) for i in range(15)]
    statistics = statistics_of(touches)
    with pytest.MonkeyPatch.context() as monkeypatch:
        if lazily:
            monkeypatch.setattr("scroll_tactile.readouts.readout.EAGER", 1)
        reference = ["a", "b"] if lazily else None
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
        monkeypatch.setattr("scroll_tactile.readouts.readout.EAGER", 1024)
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
    assert [readout.reference.tolist() for readout in (whole, part)] == [[0, 1, 2, 3], [0, 1]]
    require_textbook(whole, touches, PROBES[:2])
    require_textbook(part, touches, PROBES[:2])


@pytest.mark.parametrize("followed", [False, True])
@pytest.mark.parametrize("materials", [4, 400])
def test_pruning_keeps_its_bounds(monkeypatch, followed, materials):
    monkeypatch.setattr("scroll_tactile.readouts.readout.EAGER", 3)
    rng = np.random.default_rng(0)
    names = [f"{i:03d}" for i in range(materials)]
    statistics = Statistics(WIDTH, [SCALE])
    for name in names * 2:
        statistics.add(name, {SCALE: rng.integers(-EDGE, EDGE, (2, WIDTH), dtype=np.int32)})
    readout = readout_of(statistics, names[:2])
    probe = rng.integers(-EDGE, EDGE, WIDTH).astype(float)
    every = np.arange(materials)
    readout.many.bounds(probe, every)
    if followed:
        for name in ("000", names[-1], "new", "new"):
            rows = rng.integers(-EDGE, EDGE, (2, WIDTH), dtype=np.int32)
            statistics.add(name, {SCALE: rows})
            assert readout.follow([(name, rows, 1)])
    every = np.arange(len(readout.names))
    exact = copy.deepcopy(readout).scores(probe, every, "lda")
    assert readout.many.exact(probe, every) == pytest.approx(exact, rel=1e-11)
    loose = np.median(readout.many.bounds(probe, every)[1] - exact)
    for fine in (False, True):
        assert (exact <= readout.many.bounds(probe, every, fine=fine)[1]).all()
    assert np.median(readout.many.bounds(probe, every)[1] - exact) <= loose
    monkeypatch.setattr("scroll_tactile.readouts.readout.EAGER", 10**6)
    plain = readout.novelty(probe, np.arange(len(readout.names)))
    monkeypatch.setattr("scroll_tactile.readouts.readout.EAGER", 3)
    assert readout.novelty(probe, np.arange(len(readout.names))) == pytest.approx(plain, rel=1e-12)


def test_the_diagonal_distance_from_a_material_that_was_not_held_is_that_of_one_that_was(monkeypatch):
    monkeypatch.setattr("scroll_tactile.readouts.readout.EAGER", 3)
    rng = np.random.default_rng(0)
    statistics = Statistics(WIDTH, [SCALE])
    for name in [f"{i:03d}" for i in range(40)] * 2:
        statistics.add(name, {SCALE: rng.integers(-EDGE, EDGE, (2, WIDTH), dtype=np.int32)})
    probe = rng.integers(-EDGE, EDGE, WIDTH).astype(float)
    few, again = (readout_of(statistics, ["000", "001"]) for _ in range(2))
    again.held(range(40))
    assert [few.diagonal_distance(probe, place) for place in range(40)] == [
        again.diagonal_distance(probe, place) for place in range(40)
    ]
