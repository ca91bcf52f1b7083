"""A model brought up to date between two fits answers as one solved anew."""

import numpy as np
import pytest
from touches import PAD, SMALL, stream

from scroll_tactile import TactileLearner
from scroll_tactile.errors import InputError
from scroll_tactile.prediction.model import Model
from scroll_tactile.readouts.recursive import WoodburyReadout

OBSERVED = tuple((name, (seed, 60)) for seed in range(8) for name in "abc")
PROBE = (50, 60)


def fed(refit, **settings):
    learner = TactileLearner(sensor=PAD, embedding=SMALL, refit=refit, **settings)
    for name, touch in OBSERVED:
        learner.observe(name, stream(touch))
    return learner


def present(learner):
    """The model that predictions are made with; `learner.model()` is fitted to all that was observed."""
    return learner._current.present(learner._ledger)


def require_near(found, expected, tolerance):
    for name in ("weights", "gram", "ridge", "center"):
        values = getattr(expected, name)
        np.testing.assert_allclose(getattr(found, name), values, rtol=0, atol=tolerance * np.abs(values).max())


def test_between_fits_only_the_readouts_follow(monkeypatch):
    learner = fed(0.5)
    learner.predict(stream(PROBE))
    fits = []
    monkeypatch.setattr(Model, "of", lambda *_: fits.append(1))
    for i in range(10):
        learner.observe("abc"[i % 3], stream((20 + i, 60)))
        learner.predict(stream(PROBE))
    assert fits == []
    monkeypatch.undo()
    model, whole = present(learner), learner.model()
    for scale, selection in model.selections.items():
        assert selection.names == learner.memory.statistics.names(scale)
        assert np.isclose(selection.readout.shares, whole.selections[scale].readout.shares).all()
        assert np.isclose(selection.readout.center, whole.selections[scale].readout.center).all()
        assert (selection.readout.penalties > 0).all()


def test_answers_are_those_of_the_same_lambda_solved_anew():
    learner = fed(1.0)
    learner.predict(stream(PROBE))
    for i in range(12):
        learner.observe("abc"[i % 3], stream((20 + i, 60)))
    quick = present(learner)
    for scale, selection in quick.selections.items():
        anew = WoodburyReadout(learner.memory.statistics, scale, learner.model().selections[scale].readout)
        anew._penalties = selection.readout.penalties
        anew.anchor(learner.memory.statistics)
        require_near(selection.readout, anew.readout(), 1e-9)


@pytest.mark.parametrize(
    "change",
    [
        lambda learner: learner.observe("new", stream((3, 60))),
        lambda learner: [learner.observe("a", stream((30 + i, 60))) for i in range(9)],
    ],
)
def test_a_new_material_or_much_growth_is_fitted_anew(change):
    learner = fed(0.25)
    learner.predict(stream(PROBE))
    change(learner)
    assert present(learner) is learner.model()


def test_after_a_retraction_it_is_fitted_anew(tmp_path):
    with TactileLearner.open(tmp_path / "m", sensor=PAD, embedding=SMALL, refit=1.0) as learner:
        receipts = [learner.observe(name, stream(touch)) for name, touch in OBSERVED]
        learner.predict(stream(PROBE))
        learner.observe("a", stream((40, 60)))
        assert present(learner) is not learner.model()
        learner.retract(receipts[0])
        assert present(learner) is learner.model()


def test_the_papers_recursion_can_be_chosen_and_gives_the_same_answers_while_it_is_well():
    exact, recursive = fed(1.0), fed(1.0, solver="recursive")
    for learner in (exact, recursive):
        learner.predict(stream(PROBE))
        for i in range(12):
            learner.observe("abc"[i % 3], stream((20 + i, 60)))
    assert exact.digest() == recursive.digest()
    model = present(recursive)
    for scale, selection in present(exact).selections.items():
        found = model.selections[scale].readout
        assert found.weights.tobytes() != selection.readout.weights.tobytes()
        require_near(found, selection.readout, 1e-8)
    answers = [learner.predict(stream(PROBE)) for learner in (exact, recursive)]
    assert answers[0].material == answers[1].material
    assert answers[0].probability == pytest.approx(answers[1].probability, abs=1e-8)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"solver": "svd"}, "solver"),
        ({"solver": "recursive"}, "refit=1.0"),
        *(({"refit": refit}, "refit") for refit in (-0.1, 1.5, float("nan"))),
    ],
)
def test_a_solver_or_share_that_there_is_not_or_that_has_nothing_to_do_is_refused(settings, said):
    with pytest.raises(InputError, match=said):
        TactileLearner(sensor=PAD, **settings)
