"""Readouts, solved and followed, against the textbook's dense formulas in fifty digits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from readouts.dense import Dense, groups_of, require_near

from scroll_tactile.readouts.task import Task
from scroll_tactile.readouts.triangle import InverseTriangle
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


def require_textbook(readout, touches, probes, tolerance=1e-9, solved=None):
    """solved: the touches that it was solved from, where it followed."""
    names = sorted({material for material, _ in touches})
    reference = readout.reference
    if solved is not None:
        solved = Dense(groups_of(solved), readout.penalty, readout.share)
    dense = Dense(groups_of(touches), readout.penalty, readout.share, reference, solved=solved)
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
@given(CHANGES, st.sampled_from([0, 0.9 * EDGE]), st.sampled_from([None, ["a", "b"]]), st.booleans())
def test_followed_it_has_the_means_of_what_is_there_and_the_scatter_that_it_was_solved_with(
    batches, offset, reference, asked
):
    """asked: whether it was asked for scores before, so that what is solved for already is taken over."""
    first = [touch("abc"[i % 3], i, offset) for i in range(15)]
    touches, statistics = [*first], statistics_of(first)
    readout = readout_of(statistics, reference)
    for batch in batches:
        changed = set()
        for change in batch:
            if isinstance(change, int) and len(touches) > 1:
                name, rows = touches.pop(change % len(touches))
                statistics.remove(name, {SCALE: rows})
            elif not isinstance(change, int):
                name, rows = touch(*change, offset)
                touches.append((name, rows))
                statistics.add(name, {SCALE: rows})
            changed.add(name)
        there, before = statistics.names(SCALE), readout
        if asked:
            before.novelty(PROBES[0].astype(float), range(len(before.names)))
        readout = before.followed(statistics, changed)
        if not set(before.reference) & set(there):
            assert readout is None
            return
        assert readout.names == [*(name for name in before.names if name in there), *sorted({*there} - {*before.names})]
        new = set() if len(before.reference) < len(before.names) else set(there)
        assert {*readout.reference} == ({*before.reference} | new) & {*there}
        assert readout.counts.tolist() == statistics.counts(SCALE, readout.names).tolist()
    require_textbook(readout, touches, PROBES[:2], solved=first)


def test_it_never_changes_and_only_what_changed_or_is_asked_for_is_solved(monkeypatch):
    """A scene of few materials costs what it holds; one that changed is solved for again, when it is asked for."""
    monkeypatch.setattr("scroll_tactile.readouts.readout.TOGETHER", 2)
    touches = [touch("abcdefg"[i % 7], i) for i in range(21)]
    statistics = statistics_of(touches)
    readout, probe = readout_of(statistics, ["a", "b"]), PROBES[0].astype(float)
    solve, solved = InverseTriangle.solve, []
    monkeypatch.setattr(InverseTriangle, "solve", lambda self, rows: solved.append(len(rows)) or solve(self, rows))

    def solved_for(of, names):
        """How many are solved for at a time where the materials of a scene are asked for."""
        solved.clear()
        of.scores(probe, [of.places[name] for name in names], "lda")
        of.novelty(probe, [of.places[name] for name in names])
        return [*solved]

    assert solved_for(readout, "g") == [1, 2]  # the last of an odd number, and the reference
    said = readout.scores(probe, [6], "lda").tobytes()
    for name in "eh":
        statistics.add(name, {SCALE: touch(name, 99)[1]})
    after = readout.followed(statistics, ["a", "e", "h", "never"])
    assert after.triangle is readout.triangle
    assert [solved_for(after, names) for names in ("g", "h", "de", "f")] == [[1], [1], [2, 2], []]  # first a
    assert after.scores(probe, [6], "lda").tobytes() == said == readout.scores(probe, [6], "lda").tobytes()
    assert solved_for(readout, "g") == []
    assert (readout.names, after.names) == ([*"abcdefg"], [*"abcdefgh"])


def test_a_material_that_is_new_joins_the_reference_where_that_is_all_materials():
    """As after an opening, where the ridge had an IndexError."""
    touches = [touch("bcd"[i % 3], i) for i in range(12)]
    statistics = statistics_of(touches)
    readout = readout_of(statistics)
    for name in "az":
        touches.append(touch(name, 0))
        statistics.add(name, {SCALE: touches[-1][1]})
    readout = readout.followed(statistics, "az")
    assert readout.reference == readout.names == [*"bcdaz"]
    require_textbook(readout, touches, PROBES[:2], solved=touches[:-2])
    assert readout.scores(touches[-1][1][0].astype(float), range(5), "lda").argmax() == 4


def test_of_more_than_a_thousand_materials_of_one_row_each_the_nearest_mean_is_found():
    """They have no scatter: 1030 materials that were touched once each had no readout."""
    rng = np.random.default_rng(0)
    rows = np.rint(rng.normal(size=(1030, WIDTH)) * 40_000).astype(np.int32)
    readout = readout_of(statistics_of([(f"{i:04d}", row[None]) for i, row in enumerate(rows)]), ["0000", "0001"])
    for i in (0, 1, 2, 700, 1029):
        assert readout.scores(rows[i] + 5.0, range(1030), "lda").argmax() == i
        assert np.isfinite(readout.novelty(rows[i] + 5.0, range(1030)))


def test_a_task_that_is_solved_later_is_of_the_moment_it_was_made():
    touches = [touch("abc"[i % 3], i) for i in range(12)]
    statistics = statistics_of(touches)
    tasks = [Task.of(statistics, SCALE, ["a", "b"])]
    for name, rows in (touch("c", 99, rows=3), touch("d", 99, rows=3)):
        statistics.add(name, {SCALE: rows})
    statistics.remove(touches[0][0], {SCALE: touches[0][1]})
    require_textbook(tasks[0].solve(), touches, PROBES[:2])
