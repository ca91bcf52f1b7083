"""Readouts that follow the statistics equal those that are solved anew, however long they have followed."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from scroll_tactile.readouts.readout import Readout, Task, fit_readout
from scroll_tactile.readouts.recursive import RecursiveLeastSquares, WoodburyReadout
from scroll_tactile.statistics.moments import within_scatter
from scroll_tactile.statistics.statistics import Statistics

SCALE = 7


def fitted(statistics, penalty=1e-2):
    names = statistics.names(SCALE)
    counts, sums = statistics.counts(SCALE, names).sum(axis=1), statistics.sums(SCALE, names).sum(axis=1)
    scatter = within_scatter(statistics.total_second(SCALE), counts, sums)
    return fit_readout(Task.of(scatter, counts, sums), penalty)


def dense(statistics, penalties):
    """(S_w + P) W = N M and what follows from it, in long double where it matters, without any update."""
    names = statistics.names(SCALE)
    counts, sums = statistics.counts(SCALE, names).sum(axis=1), statistics.sums(SCALE, names).sum(axis=1)
    scatter = np.triu(within_scatter(statistics.total_second(SCALE), counts, sums))
    system = scatter + np.triu(scatter, 1).T + np.diag(penalties)
    shares = counts / counts.sum()
    exact = sums.astype(np.longdouble) / counts[:, None]
    center = shares.astype(np.longdouble) @ exact
    means = (exact - center).astype(np.float64)
    weights = counts.sum() * np.linalg.solve(system, means.T)
    gram = means @ weights
    ridge = np.linalg.inv(np.diag(1 / shares) + (gram + gram.T) / 2)
    return Readout(0.0, center.astype(float), weights, (gram + gram.T) / 2, ridge, shares, penalties)


def distance(found, truth):
    fields = ("weights", "gram", "ridge", "center")
    return max(
        np.abs(getattr(found, name) - getattr(truth, name)).max() / np.abs(getattr(truth, name)).max()
        for name in fields
    )


class Source:
    """Rows of codes of some classes about means of their own."""

    def __init__(self, dimension, classes, seed=0, offset=0):
        self.random = np.random.default_rng(seed)
        self.means = self.random.normal(offset, 1e5, (classes, dimension))
        self.names = [f"class {at:02d}" for at in range(classes)]

    def rows(self, place, count=1):
        rows = self.means[place] + self.random.normal(0, 5e4, (count, self.means.shape[1]))
        return np.clip(np.rint(rows), -(2**20), 2**20).astype(np.int32)

    def fill(self, count):
        statistics = Statistics(self.means.shape[1], [SCALE])
        for at in range(count):
            place = at % len(self.names)
            statistics.add(self.names[place], at % 3, {SCALE: self.rows(place)})
        return statistics


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([WoodburyReadout, RecursiveLeastSquares]),
    st.lists(st.tuples(st.integers(0, 3), st.integers(1, 9)), max_size=12),
    st.sampled_from([0, 8 * 10**5]),
    st.integers(0, 9),
)
def test_it_equals_a_fresh_solve_after_any_rows(kind, added, offset, seed):
    source = Source(24, 4, seed, offset)
    statistics = source.fill(40)
    start = fitted(statistics)
    tracked = kind(statistics, SCALE, start)
    for place, count in added:
        rows = source.rows(place, count)
        statistics.add(source.names[place], place % 3, {SCALE: rows})
        if not tracked.add(rows, place):
            tracked.anchor(statistics)
    assert distance(tracked.readout(), dense(statistics, start.penalties)) < 1e-9


def test_nothing_drifts_in_ten_thousand_interleavings():
    source = Source(32, 5)
    statistics = source.fill(200)
    start = fitted(statistics)
    tracked, worst = WoodburyReadout(statistics, SCALE, start), 0.0
    for at in range(10_000):
        place = int(source.random.integers(5))
        rows = source.rows(place)
        statistics.add(source.names[place], at % 3, {SCALE: rows})
        if not tracked.add(rows, place):
            tracked.anchor(statistics)
        readout = tracked.readout()
        if at % 500 == 499:
            worst = max(worst, distance(readout, dense(statistics, start.penalties)))
    assert worst < 1e-10


def test_rounding_adds_up_in_the_recursion_until_it_is_anchored():
    # It starts from fewer rows than features, so that P spans many orders of magnitude.
    source = Source(24, 4, offset=8e5)
    statistics = source.fill(12)
    start = fitted(statistics, 1e-9)
    woodbury, recursive = (kind(statistics, SCALE, start) for kind in (WoodburyReadout, RecursiveLeastSquares))
    for i in range(600):
        rows = source.rows(i % 4)
        statistics.add(source.names[i % 4], i % 3, {SCALE: rows})
        assert recursive.add(rows, i % 4)
        if not woodbury.add(rows, i % 4):
            woodbury.anchor(statistics)
    truth = dense(statistics, start.penalties)
    assert distance(woodbury.readout(), truth) < 1e-12
    assert 1e-9 < distance(recursive.readout(), truth) < 1e-3
    recursive.anchor(statistics)
    assert distance(recursive.readout(), truth) < 1e-12


def test_where_it_cannot_follow_it_says_so_and_stays_as_it_was():
    source = Source(24, 3)
    statistics = source.fill(30)
    tracked = WoodburyReadout(statistics, SCALE, fitted(statistics))
    before = tracked.readout()
    assert not tracked.add(source.rows(1, 40), 1)
    after = tracked.readout()
    assert before.weights.tobytes() == after.weights.tobytes()
    assert before.gram.tobytes() == after.gram.tobytes()


def test_a_feature_that_begins_to_vary_is_penalised_like_the_others():
    source = Source(10, 3)
    statistics = Statistics(10, [SCALE])
    for at in range(30):
        rows = source.rows(at % 3)
        rows[:, 4] = 1000
        statistics.add(source.names[at % 3], at % 3, {SCALE: rows})
    start = fitted(statistics)
    assert not start.weights[4].any()
    tracked = WoodburyReadout(statistics, SCALE, start)
    rows = source.rows(1)
    rows[:, 4] = 2000
    statistics.add(source.names[1], 0, {SCALE: rows})
    assert tracked.add(rows, 1)
    penalties = start.penalties.copy()
    penalties[4] = np.delete(start.penalties, 4).mean()
    assert distance(tracked.readout(), dense(statistics, penalties)) < 1e-9
