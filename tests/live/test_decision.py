"""Early answers: what their probabilities are worth, when they are decided, several touches of one thing."""

import itertools
from functools import cache

import numpy as np
import pytest

from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.errors import InputError
from scroll_tactile.live.decision import DecisionRule, decision_rule, in_pairs, least_sure
from scroll_tactile.prediction.fitting import rehearse
from scroll_tactile.prediction.model import Trajectories
from scroll_tactile.readouts.calibration import Dependence
from scroll_tactile.results import Prediction
from scroll_tactile.simulation.scene import Scene

SKIN = Sensor(name="skin", channels=8, rate=50.0, low=0.0, high=100.0, unit="N", duration=1.6)
SCENE = Scene(sensor=SKIN, seed=1)
NAMES = SCENE.materials[:5]
TOUCHES = [(name, SCENE.touch(name, i)) for i in range(12) for name in NAMES]
LATER = [(name, SCENE.touch(name, i)) for i in range(50, 56) for name in NAMES]


def learned(touches=TOUCHES, **settings):
    learner = TactileLearner(sensor=SKIN, embedding=Kernels(dimension=128), **settings)
    for name, touch in touches:
        learner.observe(name, touch)
    learner.settle()
    return learner


@cache
def model_of(learner):
    """The model of a learner that observes nothing more."""
    model = learner.model()
    rehearse(model)
    return model


def rule_of(learner, risk):
    return decision_rule(model_of(learner), risk)


@pytest.fixture(scope="module")
def learner():
    return learned()


def decided(learner, rule, touch):
    """The column at which a touch is decided, with the prediction; None where it stays undecided."""
    for columns in [*(moment for moment in rule.moments if moment < len(touch)), len(touch)]:
        prediction = learner.predict(touch.first(columns / SKIN.rate))
        if rule.decided(prediction, columns):
            return columns, prediction
    return None


def test_touches_are_decided_early_and_right(learner):
    rule = rule_of(learner, 0.05)
    found = [decided(learner, rule, touch) for _, touch in LATER]
    answers = [(at, now, name) for (name, _), of in zip(LATER, found, strict=True) if of for at, now in [of]]
    assert len(answers) >= 0.9 * len(LATER)
    assert np.mean([now.material == name for _, now, name in answers]) >= 0.9
    assert np.mean([at for at, *_ in answers]) < 0.5 * len(LATER[0][1])


def test_less_risk_is_never_decided_earlier_or_less_surely(learner):
    rules = [rule_of(learner, risk) for risk in (0.2, 0.05, 0.01)]
    assert [rule.sure for rule in rules] == sorted(rule.sure for rule in rules)
    for _, touch in LATER[:4]:
        at = [of[0] if (of := decided(learner, rule, touch)) else np.inf for rule in rules]
        assert at == sorted(at)


def test_rule_and_predictions_are_of_the_set_of_touches_whether_a_rule_was_asked_for_or_not(learner):
    rule, unasked = rule_of(learner, 0.05), learned(TOUCHES[::-1])
    for _, touch in LATER[:3]:
        for asked in (touch, touch.first(0.2)):
            assert unasked.predict(asked) == learner.predict(asked)
    assert rule_of(unasked, 0.05) == rule


def test_what_was_never_felt_is_not_decided_to_be_known(learner):
    rule, strange = rule_of(learner, 0.05), []
    for i in range(4):
        touch = SCENE.touch(SCENE.materials[8], i)
        noise = np.random.default_rng(i).uniform(0, 100, touch.readings.shape).astype(np.float32)
        strange.append(learner.predict(noise))
    assert not any(rule.decided(now, len(noise)) and now.known is not False for now in strange)


@pytest.mark.parametrize("touches", [TOUCHES[:1], TOUCHES[:5], [TOUCHES[0], TOUCHES[5]]])
def test_where_few_touches_can_be_held_out_they_are_decided_at_their_end_alone(touches):
    rule = rule_of(learned(touches), 0.05)
    assert rule.moments == (len(touches[0][1]),) and rule.sure == 0.95


@pytest.mark.parametrize("risk", [0.0, 1.0, -1, float("nan")])
def test_a_risk_is_a_share(learner, risk):
    with pytest.raises(InputError, match="risk"):
        rule_of(learner, risk)


def test_a_rule_says_known_where_it_is_sure_and_new_where_it_is_strange():
    rule = DecisionRule((5, 10), 0.05, sure=0.97, together=0.98, least_new=6.0)
    known = {probability: Prediction("oak", probability, (), 0.0, True, 1.0) for probability in (0.94, 0.96, 0.97)}
    new = {novelty: Prediction("oak", 0.99, (), novelty, False, 1.0) for novelty in (5.9, 6.0)}
    assert [rule.decided(known[p], 5) for p in known] == [False, False, True]
    assert [rule.decided(known[p], 10) for p in known] == [False, True, True]  # of a whole touch 1 − risk is enough
    assert [rule.decided(new[n], 5) for n in new] == [False, True]
    untold = Prediction("oak", 0.97, (), 0.0, None, 1.0)
    assert [rule.decided(untold, 5), rule.likely(untold, 5), rule.likely(new[6.0], 5)] == [False, True, False]
    assert not rule.decided(known[0.97], 4)
    early = DecisionRule((5, 10), 0.05, sure=0.9, together=0.9, least_new=6.0)
    assert [early.decided(known[0.94], columns) for columns in (5, 10)] == [True, True]  # what was decided stays so
    assert [rule.decided(known[0.97], columns, several=True) for columns in (4, 5, 10)] == [False, False, True]


def test_touches_left_out_are_rehearsed_behind_another_of_their_material():
    """Four touches of material 0 and one of 1, two moments; one of 0 too short for the second, one for both."""
    short = [np.nan] * 2
    likely = np.array([[0.6, 0.8], [0.3, 0.9], [0.5, np.nan], short, [0.1, 0.1]])
    chances = np.stack([likely, 1 - likely], axis=2)
    novelty = np.array([[0.0, 1.0], [2.0, 0.5], [1.0, np.nan], short, [0.0, 0.0]])
    dependence = Dependence(0.5, 0.0)
    pairs, known = in_pairs(Trajectories(chances, novelty, np.array([0, 0, 0, 0, 1])), np.array([1.0, 2.0]), dependence)
    assert pairs.targets.tolist() == [0, 0, 0]
    for row, (first, second) in enumerate([(chances[0, 1], 1), (chances[1, 1], 2), (chances[2, 0], 0)]):
        expected = dependence.probability([first, chances[second, 0]])
        np.testing.assert_array_equal(pairs.chances[row, 0], expected)
    assert np.isnan(pairs.chances[1, 1]).all() and np.isnan(pairs.novelty[1, 1]) and not known[1, 1]
    np.testing.assert_allclose(pairs.novelty[0], [(1.0 + 2.0) / np.sqrt(2), (1.0 + 0.5) / np.sqrt(2)])
    assert known[0].tolist() == [False, True]  # 2.1 of a usual (2 + 1) / 2, and 1.1 of (2 + 2) / 2


def test_touches_that_err_alike_take_more_to_be_decided_together(learner):
    for risk in (0.2, 0.05, 0.01):
        rule = rule_of(learner, risk)
        assert rule.sure <= rule.together <= 1
    rng = np.random.default_rng(2)
    names, odd = np.repeat(np.arange(20), 4), np.repeat(rng.random(20) < 0.15, 4)  # whole materials that mislead
    right = np.where(odd, 0.3, 0.8)[:, None] + rng.uniform(-0.1, 0.1, (80, 3))
    chances = np.zeros((80, 3, 20))
    chances[np.arange(80), :, names], chances[np.arange(80), :, (names + 1) % 20] = right, 1 - right
    alone = Trajectories(chances, np.zeros((80, 3)), names)
    pairs, known = in_pairs(alone, np.ones(3), Dependence(0.0, 0.0))
    assert known.all()
    levels = [
        least_sure(of.chances.max(axis=2), of.chances.argmax(axis=2) == of.targets[:, None], 0.1)
        for of in (alone, pairs)
    ]
    assert levels[1] > levels[0]


def test_the_least_probability_keeps_the_risk_of_calibrated_answers():
    """Posteriors of two hypotheses by a growing number of draws: stopping when one is sure keeps what it says."""
    rng = np.random.default_rng(0)

    def made(count):
        truth = rng.integers(0, 2, count)
        logit = np.cumsum(np.where(truth, 1.0, -1.0)[:, None] * 0.5 + rng.normal(size=(count, 12)), axis=1)
        first = 1 / (1 + np.exp(-logit))
        return np.maximum(first, 1 - first), (first > 0.5) == truth[:, None]

    wrong = []
    for _ in range(40):
        sure = least_sure(*made(128), 0.05)
        chances, right = made(400)
        reached = chances >= sure
        taken = reached.any(axis=1)
        wrong.append(np.mean(~right[taken, reached.argmax(axis=1)[taken]]))
    assert np.mean(wrong) <= 0.05
    assert np.mean(wrong) >= 0.01  # it is no more careful than it has to be


def test_answers_that_were_right_by_luck_are_decided_no_earlier():
    assert least_sure(np.full((200, 1), 0.9), np.full((200, 1), True), 0.02) > 0.9  # one in ten should be wrong


def test_several_touches_say_more_than_one_in_any_order(learner):
    for name, i in itertools.product(NAMES[:3], (60, 63)):
        touches = [SCENE.touch(name, i + k).first(0.1) for k in range(3)]
        together = learner.predict(*touches)
        assert learner.predict(*touches[::-1]) == together
        assert learner.predict(*touches, touches[1]) == together
        assert together.seconds == pytest.approx(0.3)
        assert sum(share for _, share in together.ranking) == pytest.approx(1.0)
    right = {
        count: np.mean([learner.predict(*[SCENE.touch(name, i + k).first(0.1) for k in range(count)]).material == name
                        for name in NAMES for i in range(60, 78, 3)])
        for count in (1, 3)
    }  # fmt: skip
    assert right[3] >= right[1]
