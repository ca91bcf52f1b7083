"""What a page says is measured: touches left out, separations, calibration, and faults of channels."""

import functools

import numpy as np
import pytest

from scroll_tactile import Kernels, TactileLearner
from scroll_tactile import sensors as known
from scroll_tactile.clients.learning.metrics import calibration_error
from scroll_tactile.clients.report.channels import channels_of
from scroll_tactile.clients.report.memory_facts import (
    bins_of,
    chosen,
    growing,
    interval,
    mistakes,
    separations,
    soon,
    trust_in,
    unknown_by,
)
from scroll_tactile.live.decision import DecisionRule, decision_rule
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.fitting import rehearse
from scroll_tactile.prediction.judging import HeldOutTouch, held_out_touches
from scroll_tactile.results import Prediction
from scroll_tactile.signals.levels import levels_of, stream_of
from scroll_tactile.simulation.scene import Scene

SENSOR = known.BIOTAC
SCENE = Scene(sensor=SENSOR)
NAMES = SCENE.materials[:4]


@functools.cache  # a memory that two tests compare with is made once
def taught(leave=None, repetitions=6):
    learner = TactileLearner(sensor=SENSOR, embedding=Kernels(dimension=64))
    for i in range(repetitions):
        for name in NAMES:
            if (name, i) != leave:
                learner.observe(name, SCENE.touch(name, i, seconds=1.0))
    return learner


@pytest.fixture(scope="module")
def learner():
    return taught()


def test_a_touch_left_out_is_judged_as_if_it_had_never_been_observed(learner):
    held_out = {touch.key: touch for touch in held_out_touches(learner.model(), 0.05)}
    assert len(held_out) == 24
    for name, i in [(NAMES[1], 3), (NAMES[2], 1)]:
        touch = SCENE.touch(name, i, seconds=1.0)
        answer = taught(leave=(name, i)).predict(touch)
        judged = held_out[touch.key]
        assert judged.material == name
        assert judged.said.material == answer.material
        # The calibration is that of all, and not of all others.
        assert judged.said.probability == pytest.approx(answer.probability, abs=0.05)
        assert sum(share for _, share in judged.said.ranking) == pytest.approx(1)


def grown(learner, touches, rule=None):
    model = learner.model()
    extractor = FeatureExtractor(SENSOR, learner.embedding, learner.plan)
    streams = {touch.key: stream_of(touch.levels, SENSOR) for touch in learner.memory.kept.touches()}
    held_out = [(touch, streams[touch.key]) for touch in held_out_touches(model, 0.05) if touch.key in touches]
    return model, growing(model, learner.memory, extractor, rule or decision_rule(model, 0.05), 0.05, held_out)


def test_answers_grow_as_those_of_a_memory_without_the_touch(learner):
    name, i = NAMES[2], 1
    touch = SCENE.touch(name, i, seconds=1.0)
    model, found = grown(learner, [touch.key])
    assert found[0].material == name
    assert found[0].predictions[-1].seconds == 1.0
    other = taught(leave=(name, i))
    for prediction in found[0].predictions:
        expected = dict(other.predict(touch.first(prediction.seconds)).ranking)
        assert dict(prediction.ranking)[name] == pytest.approx(expected[name], abs=0.3)
    # The model has not lost the touch.
    assert (name, touch.key) in model.matcher.kept.touches
    assert len(model.matcher.kept) == 24


def test_the_moment_of_decision_is_the_first_that_the_rule_decides(learner):
    key = SCENE.touch(NAMES[0], 0, seconds=1.0).key
    _, found = grown(learner, [key], DecisionRule((10, 30, 50), 0.05, sure=0.0, together=0.0, least_new=0.0))
    assert [at.seconds for at in found[0].predictions] == [0.1, 0.3, 0.5, 1.0]
    assert found[0].decided == 0
    _, found = grown(learner, [key], DecisionRule((10, 30, 50), 0.0, sure=1.1, together=1.1, least_new=1e9))
    assert found[0].decided is None


def test_a_few_touches_of_different_materials_are_chosen(learner):
    held_out = held_out_touches(learner.model(), 0.05)
    few = chosen(held_out, [touch.key for touch in held_out], camera=False)
    assert len(few) == 6
    assert {touch.material for touch in few} == set(NAMES)
    least = min(held_out, key=lambda touch: dict(touch.said.ranking)[touch.material])
    assert few[0].key == least.key
    assert chosen(held_out, [], camera=False) == []


def test_how_soon_answers_come_is_counted(learner):
    model = learner.model()
    rehearse(model)
    extractor = FeatureExtractor(SENSOR, learner.embedding, learner.plan)
    counted = soon(model, extractor, DecisionRule((1,), 0.05, sure=0.0, together=0.0, least_new=0.0), 0.05)
    assert 0 < counted.decided[0] <= counted.decided[-1] and sorted(counted.decided) == [*counted.decided]
    assert all(wrong <= share for wrong, share in zip(counted.wrong, counted.decided, strict=True))
    never = soon(model, extractor, DecisionRule((1,), 0.0, sure=1.1, together=1.1, least_new=1e9), 0.05)
    assert never.decided == never.wrong == (0.0,) * len(counted.seconds)
    assert never.median is None
    assert never.right == counted.right


def test_separations_are_the_log_odds_between_means(learner):
    model = learner.model()
    names, apart = separations(learner.memory.statistics, model)
    assert names == sorted(NAMES)
    assert np.array_equal(apart, apart.T)
    assert (np.diagonal(apart) == 0).all()
    complete, total = model.fitted.complete, 0.0
    for scale, weight in zip(complete.scales, complete.calibration.weights, strict=True):
        readout, statistics = model.readouts[scale], learner.memory.statistics
        mean = statistics.sums(scale, names[:1])[0] / statistics.counts(scale, names[:1])[0]
        scores = readout.scores(mean, [readout.places[name] for name in names[:2]], "lda")
        total += weight * (scores[0] - scores[1])
    assert apart[0, 1] == pytest.approx(total, rel=1e-6)


def touch(material, answer, confidence, known=True):
    said = Prediction(answer, confidence, ((answer, confidence),), novelty=0.0, known=known, seconds=1.0)
    return HeldOutTouch(material, material.encode(), said)


def test_trust_is_counted():
    touches = [touch("a", "a", 0.95) for _ in range(18)] + [touch("a", "b", 0.9), touch("b", "b", 0.6, known=False)]
    trust = trust_in(touches)
    assert trust.count == 20
    assert trust.right == 0.95
    assert trust.unknown == 0.05
    right = [one.said.material == one.material for one in touches]
    assert trust.error == pytest.approx(calibration_error([one.said.probability for one in touches], right, bins=10))
    assert [(one.material, one.answer, one.count, one.tested) for one in mistakes(touches)] == [("a", "b", 1, 19)]
    several = [touch("b", "a", 0.9), *[touch("a", "b", 0.9)] * 2]
    assert [(one.material, one.count) for one in mistakes(several)] == [("a", 2), ("b", 1)]
    assert unknown_by(touches) == [("b", 1, 1), ("a", 0, 19)]
    assert sum(found.count for found in bins_of(touches)) == 20
    assert interval(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)


def test_overconfidence_is_more_than_chance():
    wrong = [touch("a", "b" if i % 2 else "a", 0.99) for i in range(60)]
    assert trust_in(wrong).miscalibrated
    assert not trust_in([touch("a", "a", 0.99) for _ in range(60)]).miscalibrated


def faults(spoil, count=60):
    """The faults of each channel of parts of a recording that `spoil` changed."""
    random = np.random.default_rng(0)
    touches = []
    for i in range(count):
        readings = 100 + 10 * random.standard_normal((80, 4))
        spoil(i / count, readings)
        touches.append(levels_of(readings, SENSOR.model_copy(update={"channels": 4, "name": "four"})))
    found = channels_of(touches, np.zeros(4, bool), ordered=True)
    return [channel.faults for channel in found]


def test_faults_of_channels_are_found():
    def spoil(part, readings):
        readings[:, 0] = 3.0
        readings[::8, 1] = 400.0
        readings[:, 2] += 60 * part
        readings[::8, 3] = 0.0  # at rest: the end of a range that begins at zero

    assert faults(spoil) == [["dead"], ["saturated"], ["drifting"], []]

    def died(part, readings):
        if part > 0.6:
            readings[:, 3] = 90.0

    assert faults(died)[3] == ["died lately"]
    assert faults(lambda part, readings: None) == [[]] * 4

    def lost(part, readings):
        readings[:20, 1] = np.nan

    assert faults(lost)[1] == ["missing readings"]


def test_a_signed_channel_saturates_at_both_ends():
    readings = np.random.default_rng(0).normal(0, 2, (400, 27))
    readings[::4, 5] = -30.0
    found = channels_of([levels_of(readings, known.CONTACTILE)], np.ones(27, bool), ordered=False)
    assert [channel.number for channel in found if channel.faults] == [5]
