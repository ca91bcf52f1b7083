"""A model is fitted once, to touches held out: to their beginnings and to them at other paces."""

import numpy as np
import pytest

from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.clients.report.facts import _without
from scroll_tactile.matching.likelihood import MISSING
from scroll_tactile.prediction.features import FeatureExtractor, stream_of
from scroll_tactile.prediction.fitting import Draft, at_pace
from scroll_tactile.prediction.judging import held_out_touches, judged
from scroll_tactile.readouts.calibration import FEWEST
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.statistics.moments import one_thread

SKIN = Sensor(name="skin", channels=6, rate=50.0, low=0.0, high=100.0, unit="N", duration=1.2, non_finite="missing")
SCENE = Scene(sensor=SKIN, seed=2)
NAMES = SCENE.materials[:4]
TOUCHES = [(name, SCENE.touch(name, i)) for i in range(8) for name in NAMES]
LATER = [(name, SCENE.touch(name, i)) for i in range(50, 56) for name in NAMES]


def learned(touches=TOUCHES, **settings):
    learner = TactileLearner(sensor=SKIN, embedding=Kernels(dimension=84), **settings)
    for name, touch in touches:
        learner.observe(name, touch)
    return learner


@pytest.fixture(scope="module")
def learner():
    made = learned()
    made.settle()
    return made


@pytest.fixture(scope="module")
def model(learner):
    return learner.model()


@pytest.fixture(scope="module")
def extractor(learner):
    return FeatureExtractor(learner.sensor, learner.embedding, learner.plan)


def faster(readings, times):
    places = np.linspace(0, len(readings) - 1, round(len(readings) / times))
    return np.stack([np.interp(places, range(len(readings)), channel) for channel in readings.T], axis=1)


def table(model):
    """All numbers of the table of moments, as bytes."""
    rows = (*model.fusion.moments, *model.fusion.paced)
    said = model.fusion.trajectories
    numbers = [
        [value for name, value in vars(row).items() if name not in ("calibration", "mean_excess_loss", "loss_spread")]
        for row in rows
    ]
    arrays = [said.chances, said.novelty, *(part for row in rows for part in vars(row.calibration).values())]
    return numbers, [array.tobytes() for array in arrays]


def test_what_is_fitted_to_is_what_the_model_says_of_a_touch_that_it_lacks(model, extractor):
    """Of each beginning of a touch that readouts and kept touches never observed, as the table reads it."""
    said, fusion, apart = model.fusion.trajectories, model.fusion, []
    rows = fusion.matcher.kept.rows()
    keys = sorted(rows)  # all of them are held out: they are fewer than that
    assert len(said.targets) == len(keys) == len(TOUCHES)
    for touch in held_out_touches(model, 0.05)[::7]:
        stream = stream_of(fusion.matcher.kept.levels(rows[touch.key]), SKIN)
        with _without(model, touch) as other, one_thread():
            for i, moment in enumerate(fusion.moments[:-1]):
                beginning = stream.first(moment.steps / SKIN.rate)
                encoded = extractor.encode(beginning, model.longest, lambda at: model.scales_for(NAMES, at))
                alone = other.judge(sorted(NAMES), encoded.means, moment.steps, "prefix")
                found = judged(other, extractor, sorted(NAMES), encoded)
                if alone.probability.max() < 0.99:
                    own = said.chances[keys.index(touch.key), i]
                    apart.append(np.abs(found.probability - own).max())
    assert len(apart) > 4
    assert np.median(apart) < 0.05  # a prediction looks for noise in the beginning alone


@pytest.mark.parametrize("order", [slice(None, None, -1), slice(1, None), "shuffled"])
def test_settled_it_is_that_of_a_fresh_learner_to_the_bit(model, order):
    if order == "shuffled":
        places = np.random.default_rng(0).permutation(len(TOUCHES)).tolist()
        again = learned([TOUCHES[i] for i in places])
    elif order.step:
        again = learned(TOUCHES[order])
    else:
        again = learned(TOUCHES[order])
        again.predict(LATER[0][1])
        again.observe(*TOUCHES[0])
        again.predict(LATER[1][1])
    again.settle()
    assert table(again._predictor.current.settle(again._ledger)) == table(model)
    fresh = learned()
    fresh.settle()
    for _, touch in LATER[:4]:
        for asked in (touch, touch.first(0.2), faster(touch.readings, 2.0)):
            assert again.predict(asked) == fresh.predict(asked)


def test_nothing_is_fitted_when_it_is_asked_for(learner, monkeypatch):
    learner.settle()
    monkeypatch.setattr(Draft, "fit", lambda *_: pytest.fail("fitted again"))
    for _, touch in LATER[:3]:
        learner.predict(touch)
        learner.predict(touch.first(0.1), touch.first(0.3))
        learner.predict(faster(touch.readings, 1.7))
    with learner.live(contact="manual") as live:
        live.begin()
        live.push(LATER[0][1].readings)
        assert live.end().prediction.material in NAMES


@pytest.mark.parametrize("times", [2.0, 0.5])
def test_a_touch_at_another_pace_is_known_and_right(learner, times):
    said = [(learner.predict(faster(touch.readings, times)), name) for name, touch in LATER]
    assert np.mean([now.material == name for now, name in said]) >= 0.9
    assert np.mean([now.known is not False for now, _ in said]) >= 0.85  # eight of each were held out


def test_beginnings_are_right_sooner_than_later_and_no_surer_than_that(model):
    said = model.fusion.trajectories
    right = (said.chances.argmax(axis=2) == said.targets[:, None]).mean(axis=0)
    assert right[-1] >= max(0.95, right[0])
    assert np.abs(said.chances.max(axis=2).mean(axis=0) - right).max() < 0.12


def test_nothing_is_held_out_where_nothing_is_kept_or_too_few_are(extractor):
    for few in (learned(kept_touches=0), learned(TOUCHES[:2]), learned(TOUCHES[:4]), learned(TOUCHES[:1])):
        fusion = few.model().fusion
        assert len(fusion.trajectories.targets) < FEWEST
        assert fusion.complete.model_weight == 1.0
        assert few.predict(TOUCHES[0][1]).material == TOUCHES[0][0]
        for asked in (LATER[0][1], LATER[0][1].first(0.06), faster(LATER[0][1].readings, 2.0)):
            assert np.isfinite(few.predict(asked).novelty)


@pytest.mark.parametrize("kept_touches", [0, None])
@pytest.mark.parametrize("readings", [2, 3, 5, 9])
def test_touches_too_short_for_any_moment_before_their_end(kept_touches, readings):
    short = learned([(name, touch.first(readings / SKIN.rate)) for name, touch in TOUCHES], kept_touches=kept_touches)
    for _, touch in LATER[:3]:
        for count in range(2, readings + 3):
            prediction = short.predict(touch.first(count / SKIN.rate))
            assert sum(share for _, share in prediction.ranking) == pytest.approx(1.0)


def test_touches_with_gaps_are_held_out_too():
    rng = np.random.default_rng(0)
    learner = TactileLearner(sensor=SKIN, embedding=Kernels(dimension=84))
    for name, touch in TOUCHES:
        readings = touch.readings.copy()
        readings[rng.random(readings.shape) < 0.1] = np.nan
        learner.observe(name, readings)
    assert np.isfinite(learner.model().fusion.trajectories.chances).all()
    assert learner.predict(TOUCHES[0][1].readings[:12]).material in NAMES


def test_a_touch_at_another_pace_is_blended_from_its_neighbours():
    levels = np.array([[0, 10, 20, 30], [5, MISSING, 7, 8]], np.uint8)
    assert at_pace(levels, 0.5).shape == (2, 8)
    assert at_pace(levels, 2.0).tolist() == [[0, 30], [MISSING, 8]]
    slow = at_pace(levels, 0.57)
    assert slow[0].tolist() == [0, 5, 10, 15, 20, 25, 30]
    assert slow[1].tolist() == [MISSING, MISSING, MISSING, MISSING, 7, 8, 8]
    assert at_pace(levels[:1], 1.0).tolist() == levels[:1].tolist()


def test_what_was_fitted_to_single_touches_takes_in_second_ones_after_opening(tmp_path):
    """It had no scatter to shrink: its penalty is no share of one, and without any, K would be singular."""
    names, settings = SCENE.materials[:18], {"sensor": SKIN, "embedding": Kernels(dimension=84)}
    with TactileLearner.open(tmp_path, **settings) as writer:
        for name in names:
            writer.observe(name, SCENE.touch(name, 0))
        writer.settle()
    with TactileLearner.open(tmp_path) as writer:
        writer.observe(names[0], SCENE.touch(names[0], 1))
        assert writer.predict(SCENE.touch(names[0], 2)).material == names[0]
