"""What is said of a touch beside its material: what sets it apart, and what too few touches cannot tell."""

import numpy as np
import pytest
from prediction.test_matched import CHANNELS, REACH, SCENE, lasting, learned, some, uniform

from scroll_tactile.errors import InputError
from scroll_tactile.results import Prediction

NAMES = SCENE.materials[:4]
LATER = [SCENE.touch(name, i).readings for i in range(60, 64) for name in NAMES]


@pytest.fixture(scope="module")
def learner():
    return learned(of_each=10, names=NAMES)


def shifted(values, rng):
    return (values + rng.choice([0.2, 0.4], CHANNELS) * REACH).clip(0, REACH)


def drifting(values, rng):
    return (values + np.linspace(0, 0.4, len(values))[:, None] * REACH).clip(0, REACH)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda values, rng: uniform(values, rng).clip(0, REACH), "noisy"),
        (shifted, "zero moved"),
        (drifting, "zero moved"),
        (lambda values, rng: some(values, rng, 3, 0.0), "channels dead"),
        (lambda values, rng: lasting(values, 2.0), "slower"),
        (lambda values, rng: lasting(values, 0.5), "faster"),
        (lambda values, rng: values[:25], "shorter"),
    ],
)
def test_what_sets_a_touch_apart_is_said(learner, change, expected):
    rng = np.random.default_rng(0)
    said = [learner.predict(change(values, rng)).unusual for values in LATER]
    assert np.mean([expected in ways for ways in said]) >= 0.75


def test_touches_as_those_that_were_learned_are_usual(learner):
    assert np.mean([not learner.predict(values).unusual for values in LATER]) >= 0.9


def test_of_several_touches_all_that_sets_any_apart_is_said(learner):
    first, second = LATER[0][:25], lasting(LATER[4], 2.0)
    alone = {*learner.predict(first).unusual, *learner.predict(second).unusual}
    assert learner.predict(first, second).unusual == tuple(sorted(alone))


def test_without_kept_touches_the_length_is_said():
    made = learned(kept_touches=0, names=NAMES)
    assert made.predict(LATER[0][:25]).unusual == ("shorter",)
    assert made.predict(LATER[0]).unusual == ()
    assert made.predict(lasting(LATER[0], 2.0)).unusual == ("longer",)


@pytest.mark.parametrize(("of_each", "enough"), [(1, False), (4, False), (5, True)])
def test_whether_a_touch_is_known_is_told_from_enough_touches(of_each, enough):
    """Of 4 materials: 16 touches left out are too few for one false alarm in 20, and 20 are enough."""
    made = learned(of_each=of_each, names=NAMES)
    known = [made.predict(values).known for values in LATER]
    assert (True in known) == enough
    assert (None in known) != enough


def test_a_rate_of_false_alarms_asks_for_so_many_touches():
    made = learned(of_each=4, names=NAMES, false_alarms=0.1)
    assert None not in [made.predict(values).known for values in LATER]


def test_one_material_alone_is_never_called_known():
    made = learned(of_each=21, names=NAMES[:1])
    assert {made.predict(values).known for values in LATER[::4]} == {None}


class TestCandidates:
    def test_those_of_which_too_few_touches_are_kept_are_named(self, learner):
        prediction = learner.predict(LATER[0])
        assert set(prediction.candidates(0.05).too_few) == set(NAMES)  # of ten touches each nothing is one in twenty
        assert prediction.candidates(0.1).too_few == ()
        assert prediction.candidates(0.05) == tuple(name for name, _ in prediction.ranking)
        assert set(prediction.candidates(0.5)) <= set(prediction.candidates(0.1))
        assert "typicality" not in repr(prediction)
        assert learner.predict(uniform(LATER[0], np.random.default_rng(0)).clip(0, REACH)).candidates(0.1) == ()

    def test_by_all_touches_forty_are_enough(self, learner):
        for values in LATER[:4]:
            found = learner.predict(values).candidates(0.05, of_all=True)
            assert found.too_few == ()
            assert len(found) < len(NAMES)

    def test_of_a_memory_without_kept_touches_all_are_candidates_and_too_few(self):
        found = learned(kept_touches=0, names=NAMES).predict(LATER[0]).candidates()
        assert set(found) == set(found.too_few) == set(NAMES)

    @pytest.mark.parametrize("error", [0, 1, -0.1, float("nan")])
    def test_an_error_that_is_no_share_is_refused(self, error):
        with pytest.raises(InputError, match="between 0 and 1"):
            Prediction(None, 0.0, (), 0.0, None, 0.0).candidates(error)
