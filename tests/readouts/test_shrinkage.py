"""The choice of λ against a loop over the rows held out."""

import numpy as np
import pytest
from scipy.special import log_ndtr, logsumexp

from scroll_tactile.readouts.readout import Task, fit_readout
from scroll_tactile.readouts.shrinkage import PENALTIES, fit_readouts, select
from scroll_tactile.statistics.moments import SecondMoment, within_scatter
from scroll_tactile.statistics.statistics import FOLDS, Statistics

DIMENSION, SCALE = 6, 10


def touches(materials=5, each=8, seed=0, noise=30_000, shared=True):
    """(material, fold, rows); where `shared`, every material has touches in every fold."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(materials, DIMENSION)) * 40_000
    for material in range(materials):
        for at in range(each):
            fold = at % FOLDS if shared else int(rng.integers(FOLDS))
            rows = means[material] + rng.normal(size=(int(rng.integers(1, 6)), DIMENSION)) * noise
            yield "abcdefgh"[material], fold, np.rint(rows).astype(np.int32)


def statistics_of(observed):
    statistics = Statistics(DIMENSION, (SCALE,))
    for material, fold, rows in observed:
        statistics.add(material, fold, {SCALE: rows})
    return statistics


def fitted(observed, names, penalty):
    """The readout of these touches."""
    groups = [np.concatenate([rows for name, _, rows in observed if name == one]) for one in names]
    moment = SecondMoment(DIMENSION)
    for rows in groups:
        moment.add(rows)
    counts = np.array([len(rows) for rows in groups])
    sums = np.stack([rows.sum(axis=0, dtype=np.int64) for rows in groups])
    return fit_readout(Task.of(within_scatter(moment.packed(), counts, sums), counts, sums), penalty)


def trials(observed, penalty):
    """(names, readout of the others, (material, row) held out) of each fold."""
    for fold in range(FOLDS):
        others = [one for one in observed if one[1] != fold]
        names = sorted({name for name, *_ in others})
        held = [(name, row) for name, at, rows in observed if at == fold and name in names for row in rows]
        if len(names) > 1 and held:
            yield names, fitted(others, names, penalty), held


def squared_error(observed, penalty):
    total = 0.0
    for names, readout, held in trials(observed, penalty):
        for name, row in held:
            target = np.array([one == name for one in names], dtype=float)
            total += float(np.square(target - readout.scores(readout.project(row), "ridge")).sum())
    return total


def pairwise_error(observed, penalty):
    """Log of the rows' mean error, with the differences of two scores taken for normal."""
    total = 0.0
    for names, readout, held in trials(observed, penalty):
        scores = {
            one: readout.scores(readout.project(np.array([r for n, r in held if n == one])), "lda")
            for one in names
            if any(n == one for n, _ in held)
        }
        residuals = np.concatenate([rows - rows.mean(axis=0) for rows in scores.values()])
        terms = []
        for name, rows in scores.items():
            own = names.index(name)
            for other in range(len(names)):
                if other != own:
                    margin = (rows[:, own] - rows[:, other]).mean()
                    variance = np.square(residuals[:, own] - residuals[:, other]).mean()
                    terms.append(log_ndtr(-margin / np.sqrt(variance)) + np.log(len(rows) / len(held)))
        total += float(logsumexp(terms))
    return total


@pytest.mark.parametrize(("dimension", "materials"), [(1, 2), (2, 3), (6, 4), (70, 9)])
def test_a_path_gives_the_readout_of_each_penalty(dimension, materials):
    rng = np.random.default_rng(dimension)
    counts = rng.integers(1, 40, materials)
    groups = [np.rint(rng.normal(rng.normal(0, 1e5, dimension), 4e4, (n, dimension))).astype(np.int32) for n in counts]
    moment = SecondMoment(dimension)
    for rows in groups:
        moment.add(rows)
    sums = np.stack([rows.sum(axis=0, dtype=np.int64) for rows in groups])
    task = Task.of(within_scatter(moment.packed(), counts, sums), counts, sums)
    before = task.covariance.tobytes(), task.means.tobytes()
    penalties = [1e-6, 1e-3, 3e-2, 10.0]
    for penalty, found in zip(penalties, fit_readouts(task, penalties), strict=True):
        expected = fit_readout(task, penalty)
        assert found.penalty == penalty
        for name in ("center", "weights", "gram", "ridge", "shares", "penalties"):
            ours, theirs = getattr(found, name), getattr(expected, name)
            assert np.abs(ours - theirs).max() <= 1e-10 * np.abs(theirs).max()
    assert (task.covariance.tobytes(), task.means.tobytes()) == before


def test_a_path_to_a_system_that_is_not_definite_says_so():
    task = Task(np.asfortranarray(-np.eye(3)), np.eye(2, 3), np.zeros(3), np.ones(3), np.full(2, 0.5), 10)
    with pytest.raises(np.linalg.LinAlgError, match=r"λ = 0\.5 is not positive definite"):
        fit_readouts(task, [2.0, 0.5])


TOUCHES = {
    "easy": list(touches(noise=15_000)),
    "hard": list(touches(noise=90_000)),
    "many": list(touches(materials=8, each=12)),
    "fewer touches than folds": list(touches(each=2)),
    "more features than rows": list(touches(materials=2, each=2)),
}


@pytest.mark.parametrize("penalties", [PENALTIES, tuple(np.geomspace(1e-4, 1.0, 9).tolist())], ids=["usual", "wide"])
@pytest.mark.parametrize("observed", TOUCHES.values(), ids=TOUCHES)
@pytest.mark.parametrize(("kind", "error"), [("ridge", squared_error), ("lda", pairwise_error)])
def test_the_loss_is_that_of_a_loop_over_the_rows_held_out(observed, kind, error, penalties):
    selection = select(statistics_of(observed), SCALE, kind, penalties)
    expected = {penalty: error(observed, penalty) for penalty in penalties}
    assert selection.losses == pytest.approx(expected, rel=1e-7)
    assert selection.readout.penalty == min(expected, key=expected.__getitem__)


@pytest.mark.parametrize("kind", ["ridge", "lda"])
def test_the_readouts_are_those_of_all_touches_and_of_the_other_folds(kind):
    observed = TOUCHES["many"]
    selection = select(statistics_of(observed), SCALE, kind)
    penalty = selection.readout.penalty
    assert selection.names == sorted({name for name, *_ in observed})
    assert selection.places == {name: place for place, name in enumerate(selection.names)}
    assert np.allclose(selection.readout.weights, fitted(observed, selection.names, penalty).weights, rtol=1e-9)
    assert sorted(selection.held_out) == list(range(FOLDS))
    for fold, (names, readout, _) in enumerate(trials(observed, penalty)):
        known, kept = selection.held_out[fold]
        assert [selection.names[place] for place in known] == names
        assert np.allclose(kept.weights, readout.weights, rtol=1e-9)


def test_materials_in_one_fold_only_are_unknown_to_the_readout_of_the_others():
    observed = [*touches(materials=3), ("z", 1, np.full((4, DIMENSION), 500_000, np.int32))]
    selection = select(statistics_of(observed), SCALE, "lda")
    assert [selection.names[place] for place in selection.held_out[1][0]] == ["a", "b", "c"]
    assert [selection.names[place] for place in selection.held_out[0][0]] == ["a", "b", "c", "z"]


@pytest.mark.parametrize("kind", ["ridge", "lda"])
def test_nothing_to_hold_out_still_gives_a_readout(kind):
    for observed in ([*touches(materials=1, each=1)], [*touches(materials=1)], [*touches(materials=2, each=1)]):
        selection = select(statistics_of(observed), SCALE, kind)
        assert not selection.held_out
        assert not selection.losses
        assert np.isfinite(selection.readout.weights).all()


@pytest.mark.parametrize("kind", ["ridge", "lda"])
def test_identical_materials_and_constant_features_can_be_chosen_for(kind):
    observed = [(name, at % FOLDS, np.full((3, DIMENSION), 1000, np.int32)) for name in "ab" for at in range(4)]
    selection = select(statistics_of(observed), SCALE, kind)
    assert all(np.isfinite(loss) for loss in selection.losses.values())
    assert selection.readout.penalty == max(PENALTIES)  # a tie goes to the tamer readout
