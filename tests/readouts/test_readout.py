"""Readouts against the textbook's dense formulas, in fifty digits."""

from fractions import Fraction

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.special import softmax

from examples.benchmarks.solvers.exact import Exact
from scroll_tactile.readouts.readout import Task, centred_means, fit_readout
from scroll_tactile.statistics.moments import SecondMoment, within_scatter

EDGE = 2**20


def classes(sizes, dimension=4, seed=0, offset=0, spread=EDGE // 20):
    rng = np.random.default_rng([seed, *sizes])
    mixing = rng.normal(size=(dimension, dimension))
    groups = []
    for size in sizes:
        mean = offset + rng.normal(size=dimension) * spread
        rows = np.rint(mean + rng.normal(size=(size, dimension)) @ mixing * spread)
        groups.append(np.clip(rows, -EDGE, EDGE).astype(np.int32))
    return groups


def task_of(groups):
    moment = SecondMoment(groups[0].shape[1])
    for rows in groups:
        moment.add(rows)
    counts = np.array([len(rows) for rows in groups])
    sums = np.stack([rows.sum(axis=0, dtype=np.int64) for rows in groups])
    return Task.of(within_scatter(moment.packed(), counts, sums), counts, sums)


class Dense:
    """The same answers from the rows themselves, with matrices of mpmath's numbers."""

    def __init__(self, groups, penalty):
        with mpmath.workdps(50):
            rows = mpmath.matrix(np.concatenate(groups).tolist())
            self.width, total = rows.cols, rows.rows
            self.center = [mpmath.fsum(rows[:, j]) / total for j in range(self.width)]
            variances = [
                mpmath.fsum((rows[i, j] - self.center[j]) ** 2 for i in range(total)) / total for j in range(self.width)
            ]
            self.scale = [mpmath.sqrt(v) if v else mpmath.mpf(1) for v in variances]
            x = mpmath.matrix(total, self.width)
            for i in range(total):
                for j in range(self.width):
                    x[i, j] = (rows[i, j] - self.center[j]) / self.scale[j]
            labels = [y for y, group in enumerate(groups) for _ in group]
            self.shares = [mpmath.mpf(len(group)) / total for group in groups]
            targets = mpmath.matrix(total, len(groups))
            for i, y in enumerate(labels):
                for k in range(len(groups)):
                    targets[i, k] = (1 if k == y else 0) - self.shares[k]
            self.means = []
            first = 0
            centred = x.copy()
            for group in groups:
                mean = [
                    mpmath.fsum(x[i, j] for i in range(first, first + len(group))) / len(group)
                    for j in range(self.width)
                ]
                for i in range(first, first + len(group)):
                    for j in range(self.width):
                        centred[i, j] -= mean[j]
                self.means.append(mpmath.matrix(mean))
                first += len(group)
            diagonal = penalty * mpmath.eye(self.width)
            self.within = centred.T * centred / total + diagonal
            self.total = x.T * x / total + diagonal
            self.regression = mpmath.inverse(self.total) * (x.T * targets / total)

    def scaled(self, x):
        return mpmath.matrix([(int(v) - c) / s for v, c, s in zip(x, self.center, self.scale, strict=True)])

    def ridge(self, x):
        with mpmath.workdps(50):
            found = self.scaled(x).T * self.regression
            return [float(share + found[0, k]) for k, share in enumerate(self.shares)]

    def squared(self, system, x):
        return (x.T * mpmath.lu_solve(system, x))[0]

    def distances(self, x):
        with mpmath.workdps(50):
            return [self.squared(self.within, self.scaled(x) - mean) for mean in self.means]

    def lda(self, x):
        """Scores less the first one's: what all classes share cancels."""
        near = self.distances(x)
        return [float((near[0] - one) / 2) for one in near]

    def novelty(self, x, candidates=None):
        with mpmath.workdps(50):
            near = self.distances(x)
            nearest = min(near[y] for y in (range(len(near)) if candidates is None else candidates))
            return float(nearest - self.squared(self.total, self.scaled(x)))


CASES = {
    "ordinary": classes([12, 9, 15]),
    "two classes": classes([5, 30]),
    "single rows": classes([1, 1, 1, 2]),
    "fewer rows than features": classes([2, 1], dimension=6),
    "far from zero": classes([10, 10, 10], offset=EDGE * 0.9, spread=200),
    "hardly any spread": classes([10, 10], offset=EDGE // 2, spread=2),
}


@pytest.mark.parametrize("penalty", [1e-4, 1e-2, 1.0])
@pytest.mark.parametrize("groups", CASES.values(), ids=CASES)
def test_all_answers_are_the_textbooks(groups, penalty):
    readout = fit_readout(task_of(groups), penalty)
    dense = Dense(groups, penalty)
    rng = np.random.default_rng(1)
    points = [groups[0][0], groups[-1][-1], np.rint(np.mean(groups[1], axis=0)).astype(np.int32)]
    points.append(np.clip(points[0] + rng.integers(-300, 300, len(points[0])), -EDGE, EDGE))
    for x in points:
        z = readout.project(x)
        scores = readout.scores(z, "lda")
        close = {"rel": 1e-8, "abs": 1e-8 * (1 + np.abs(scores).max())}
        assert readout.scores(z, "ridge").tolist() == pytest.approx(dense.ridge(x), rel=1e-8, abs=1e-8)
        assert (scores - scores[0]).tolist() == pytest.approx(dense.lda(x), **close)
        assert float(readout.novelty(z)) == pytest.approx(dense.novelty(x), **close)
        assert float(readout.novelty(z, np.array([1]))) == pytest.approx(dense.novelty(x, [1]), **close)


FELT = st.lists(
    hnp.arrays(np.int32, st.tuples(st.integers(1, 6), st.just(3)), elements=st.integers(-EDGE, EDGE)),
    min_size=2,
    max_size=5,
)


@settings(max_examples=40, deadline=None)
@given(FELT, st.sampled_from([1e-3, 1.0, 1e6]))
def test_targets_of_plus_and_minus_one_are_those_of_0_and_1_at_temperature_2(groups, penalty):
    rows, places = np.concatenate(groups) / EDGE, np.repeat(np.arange(len(groups)), [len(one) for one in groups])
    targets = np.eye(len(groups))[places]
    scores = []
    for wanted in (targets, 2 * targets - 1):
        solver = Exact()
        solver.start(3, len(groups), penalty)
        solver.update(rows, wanted)
        weights, _ = solver.solve(centred=True)
        scores.append((rows - rows.mean(axis=0)) @ weights + wanted.mean(axis=0))
    assert softmax(scores[0], axis=1) == pytest.approx(softmax(scores[1] / 2, axis=1), rel=1e-12, abs=1e-15)


def test_class_means_keep_the_digits_of_their_distance():
    counts = np.array([3, 7, 1_000_003])
    sums = np.array([[3 * EDGE - 1], [7 * EDGE - 3], [1_000_003 * EDGE - 400_001]])
    center, means = centred_means(counts, sums)
    exact = [Fraction(int(total), int(count)) for (total,), count in zip(sums, counts, strict=True)]
    assert float(center[0]) == pytest.approx(sums.sum() / counts.sum(), rel=1e-15)
    rounding = 4 * EDGE * float(np.finfo(np.longdouble).eps) + 2.0**-52  # of the means, and of what is left of them
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert abs(Fraction(means[i, 0]) - Fraction(means[j, 0]) - (exact[i] - exact[j])) <= rounding


@pytest.mark.parametrize("value", [0, EDGE, 333_333, -777_777])
def test_a_constant_feature_says_nothing(value):
    groups = classes([7, 8, 9], dimension=3)
    wider = [np.insert(rows, 1, value, axis=1) for rows in groups]
    without, readout = fit_readout(task_of(groups), 0.01), fit_readout(task_of(wider), 0.01)
    assert not readout.weights[1].any()
    assert np.isfinite(readout.weights).all()
    for x, row in zip(groups[0], wider[0], strict=True):
        longer = row.copy()
        longer[1] = -5000  # a value never observed there
        assert np.allclose(without.project(x), readout.project(longer), rtol=1e-9, atol=1e-9)


def test_all_features_constant_leave_the_shares():
    groups = [np.full((3, 4), 77, np.int32), np.full((1, 4), 77, np.int32)]
    readout = fit_readout(task_of(groups), 0.01)
    z = readout.project(np.array([1, 2, 3, 4]))
    assert readout.scores(z, "ridge").tolist() == [0.75, 0.25]
    assert readout.scores(z, "lda").tolist() == [0, 0]


@pytest.mark.parametrize("size", [1, 2, 20])
def test_one_class_is_always_the_answer(size):
    readout = fit_readout(task_of(classes([size])), 0.01)
    for x in (np.zeros(4), np.full(4, EDGE)):
        z = readout.project(x)
        assert readout.scores(z, "ridge").tolist() == pytest.approx([1])
        assert np.isfinite(readout.scores(z, "lda")).all()
        assert np.isfinite(readout.novelty(z))


def test_a_penalty_too_small_is_named_and_the_task_is_left_as_it_was():
    task = task_of(CASES["fewer rows than features"])
    before = task.covariance.tobytes()
    with pytest.raises(np.linalg.LinAlgError, match="too small"):
        fit_readout(task, -1.0)
    fit_readout(task, 0.1)
    assert task.covariance.tobytes() == before
