"""Touches left out, and what is said of their beginnings: as if they had never been observed."""

import copy
import threading
import weakref

import numpy as np
import pytest

from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.datasets.simulator import Scene
from scroll_tactile.prediction import beginnings
from scroll_tactile.prediction.beginnings import early_answers
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.measurement import Beginnings, Measurement

SKIN = Sensor(name="skin", channels=6, rate=50.0, low=0.0, high=100.0, unit="N", duration=1.2)
SCENE = Scene(sensor=SKIN, seed=2)
NAMES = SCENE.materials[:4]
TOUCHES = [(name, SCENE.touch(name, i)) for i in range(8) for name in NAMES]


def learned(touches=TOUCHES, **settings):
    learner = TactileLearner(sensor=SKIN, embedding=Kernels(dimension=84), **settings)
    for name, touch in touches:
        learner.observe(name, touch)
    return learner


@pytest.fixture(scope="module")
def model():
    return learned().model()


@pytest.fixture(scope="module")
def extractor():
    learner = learned(TOUCHES[:1])
    return FeatureExtractor(learner.sensor, learner.embedding, learner.plan, None)


def test_a_readout_without_a_touch_is_one_that_followed_its_going(model, extractor):
    material, touch = TOUCHES[5]
    codes = extractor.codes(extractor.image(touch), touch.key)
    for scale, readout in model.readouts.items():
        before = readout.scores(codes[scale].mean(axis=0), np.arange(len(NAMES)), "lda")
        without = readout.without(material, codes[scale].astype(np.float64))
        followed = copy.deepcopy(readout)
        followed.follow([(material, codes[scale], -1)])
        asked = codes[scale].mean(axis=0)
        places = np.arange(len(NAMES))
        assert without.scores(asked, places, "lda") == pytest.approx(followed.scores(asked, places, "lda"), rel=1e-9)
        assert without.novelty(asked, places) == pytest.approx(followed.novelty(asked, places), rel=1e-7)
        own = NAMES.index(material)
        assert without.scores(asked, places, "lda")[own] < before[own]
        assert readout.scores(asked, places, "lda").tobytes() == before.tobytes()  # it stays as it was


def test_what_is_said_of_touches_left_out_is_what_a_memory_without_them_says(model, extractor, monkeypatch):
    """Within what three touches fewer of thirty-two change in the shrinkage and the weights."""
    monkeypatch.setattr(beginnings, "LEFT_OUT", 3)
    monkeypatch.setattr("scroll_tactile.readouts.early.FEWEST", 2)
    fresh = learned().model()
    early, said = early_answers(fresh, extractor), []
    left = beginnings._left(fresh, fresh.pooled)
    keys = {key for key, row in fresh.recall.rows().items() if row in [touch.row for touch in left]}
    without = learned([(name, touch) for name, touch in TOUCHES if touch.key not in keys])
    without._current.present(without._ledger).beginnings = Measurement(found=Beginnings(early, 0))
    rows = {row: key for key, row in fresh.recall.rows().items()}
    readings = {touch.key: touch for _, touch in TOUCHES}
    for i, one in enumerate(left):
        for k, moment in enumerate(early.moments):
            prediction = without.predict(readings[rows[one.row]].first(moment.columns / SKIN.rate))
            said.append(dict(prediction.ranking)[one.material] - early.fitted.chances[i, k, NAMES.index(one.material)])
    assert np.median(np.abs(said)) < 0.05


def test_all_is_a_function_of_the_set(model, extractor):
    again = learned(TOUCHES[::-1]).model()
    one, other = early_answers(model, extractor), early_answers(again, extractor)
    assert one.fitted.chances.tobytes() == other.fitted.chances.tobytes()
    assert one.fitted.novelty.tobytes() == other.fitted.novelty.tobytes()
    assert [moment.trusted for moment in one.moments] == [moment.trusted for moment in other.moments]


def test_it_is_measured_once(model, extractor):
    assert early_answers(model, extractor) is early_answers(model, extractor)


def test_nothing_is_measured_where_nothing_is_kept(extractor):
    assert early_answers(learned(recall=0).model(), extractor) is None
    assert early_answers(learned(TOUCHES[:2]).model(), extractor) is None


def test_touches_with_gaps_are_left_out_too():
    sensor = SKIN.model_copy(update={"non_finite": "missing"}) if hasattr(SKIN, "model_copy") else SKIN
    learner = TactileLearner(sensor=sensor, embedding=Kernels(dimension=84))
    rng = np.random.default_rng(0)
    for name, touch in TOUCHES:
        readings = touch.readings.copy()
        readings[rng.random(readings.shape) < 0.1] = np.nan
        learner.observe(name, readings)
    extractor = FeatureExtractor(sensor, learner.embedding, learner.plan, None)
    early = early_answers(learner.model(), extractor)
    assert np.isfinite(early.fitted.chances).all()
    assert learner.predict(TOUCHES[0][1].readings[:12]).material in NAMES


def test_measurements_of_copies_let_the_earlier_ones_go():
    """A model that is followed while it is held is copied each time, for as long as a memory lasts."""
    first = newest = Measurement()
    early = first.of(None, 4, lambda _: None)
    gone = weakref.ref(first)
    for _ in range(3):
        newest = Measurement(newest)
        assert newest.found == Beginnings(early, 4)
        assert newest.of(None, 5, lambda _: pytest.fail("measured again")) is early
    del first
    assert gone() is None
    assert newest.found == Beginnings(early, 4)


def test_a_measurement_that_is_under_way_is_waited_for():
    first, under_way, go_on, said = Measurement(), threading.Event(), threading.Event(), []

    def measures(_):
        under_way.set()
        assert go_on.wait(60)

    asking = threading.Thread(target=lambda: said.append(first.of(None, 4, measures)))
    asking.start()
    assert under_way.wait(60)
    second, again = Measurement(first), []
    other = threading.Thread(target=lambda: said.append(second.of(None, 5, again.append)))
    other.start()
    other.join(0.2)  # enough for it to measure, if it did
    go_on.set()
    for thread in (asking, other):
        thread.join(60)
    assert said == [None, None]
    assert not again
    assert second.found == Beginnings(None, 4)
