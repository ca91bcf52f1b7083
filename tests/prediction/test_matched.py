"""What kept touches are for: noise, dead and stuck channels, gaps, other speeds, with nothing told."""

import numpy as np
import pytest

from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.signals.levels import MISSING, stream_of
from scroll_tactile.simulation.scene import Scene

SKIN = Sensor(name="skin", channels=8, rate=50.0, low=0.0, high=100.0, unit="N", duration=1.6, non_finite="missing")
SCENE = Scene(sensor=SKIN, seed=1)
NAMES = SCENE.materials[:5]
ASKED = [(name, SCENE.touch(name, i).readings) for i in range(50, 54) for name in NAMES]
CHANNELS, REACH = SKIN.channels, 100.0


def learned(kept_touches=None, of_each=8, names=NAMES, sensor=SKIN, **settings):
    scene = Scene(sensor=sensor, seed=1)
    learner = TactileLearner(sensor=sensor, embedding=Kernels(dimension=128), kept_touches=kept_touches, **settings)
    for i in range(of_each):
        for name in names:
            learner.observe(name, scene.touch(name, i))
    return learner


@pytest.fixture(scope="module")
def matching():
    return learned()


@pytest.fixture(scope="module")
def alone():
    return learned(kept_touches=0)


def uniform(values, rng, reach=0.5):
    return values + rng.uniform(-reach * REACH, reach * REACH, values.shape)


def normal(values, rng, reach=0.5):
    return values + rng.normal(0, reach * REACH / 3**0.5, values.shape)


def some(values, rng, channels, level):
    return np.where(np.isin(np.arange(CHANNELS), rng.permutation(CHANNELS)[:channels]), level, values)


def lasting(values, times):
    places = np.linspace(0, len(values) - 1, round(len(values) * times))
    return np.stack([np.interp(places, range(len(values)), channel) for channel in values.T], axis=1)


def gapped(values, rng):
    return np.where(rng.random(values.shape) < 0.4, np.nan, values)


LOST = {
    "uniform noise of half the range": (uniform, 0.85, 0.5),
    "normal noise of the same energy": (normal, 0.75, 0.5),
    "half of the channels dead": (lambda values, rng: some(values, rng, 4, 0.0), 0.95, 0.8),
    "half of the channels stuck at the top": (lambda values, rng: some(values, rng, 4, REACH), 0.95, 0.8),
    "half of the channels missing": (lambda values, rng: some(values, rng, 4, np.nan), 0.95, 0.9),
    "twice the speed": (lambda values, rng: lasting(values, 0.5), 0.95, 0.9),
}
HELD = {
    "clean": lambda values, rng: values,
    "half the speed": lambda values, rng: lasting(values, 2),
    "a third of the touch": lambda values, rng: values[:27],
    "two readings of five missing": gapped,
    "a channel dead": lambda values, rng: some(values, rng, 1, 0.0),
}


def right(learner, change):
    rng = np.random.default_rng(0)
    return np.mean([learner.predict(change(values, rng)).material == name for name, values in ASKED])


@pytest.mark.parametrize("kind", LOST)
def test_what_is_lost_without_kept_touches_is_known_with_them(matching, alone, kind):
    change, least, most = LOST[kind]
    assert right(matching, change) >= least
    assert right(alone, change) <= most


@pytest.mark.parametrize("kind", HELD)
def test_what_is_known_without_kept_touches_stays_known(matching, alone, kind):
    assert right(matching, HELD[kind]) >= max(0.9, right(alone, HELD[kind]) - 1 / len(ASKED))


def test_what_was_never_touched_is_unknown_and_through_noise_nothing_is_known(matching):
    rng, strange = np.random.default_rng(0), [SCENE.touch(SCENE.materials[10], i).readings for i in range(10)]
    usual = [values for _, values in ASKED]
    assert [matching.predict(values).known for values in strange] == [False] * 10
    assert np.mean([matching.predict(values).known is True for values in usual]) >= 0.9
    for values in (*(uniform(values, rng) for values in (*strange, *usual)), rng.uniform(0, REACH, (80, CHANNELS))):
        said = matching.predict(values)
        assert said.known is not True
        assert "noisy" in said.unusual


def test_a_touch_that_the_model_is_sure_of_is_its_alone(matching, alone):
    outliers = alone.model().fitted.complete.readout_outliers
    most = 1 - outliers * (1 - 1 / len(NAMES))  # what forty touches can vouch for
    sure = [values for _, values in ASKED if alone.predict(values).probability > 0.999 * most]
    assert len(sure) > len(ASKED) / 2
    same = [matching.predict(values).ranking == alone.predict(values).ranking for values in sure]
    assert np.mean(same) > 0.8


def test_a_scene_restricts_matching(matching):
    rng = np.random.default_rng(0)
    for name, values in ASKED[:5]:
        scene = sorted({name, NAMES[0], NAMES[1]})
        prediction = matching.predict(uniform(values, rng), scene=scene)
        assert sorted(material for material, _ in prediction.ranking) == scene
        assert sum(share for _, share in prediction.ranking) == pytest.approx(1)
        assert matching.predict(uniform(values, rng), scene=[name]).probability == 1


def test_a_material_without_kept_touches_is_weighed():
    """Where there is room for fewer touches than materials."""
    learner = learned(kept_touches=3)
    kept = {material for material, *_ in learner.memory.kept}
    assert len(kept) == 3 < len(NAMES)
    assert right(learner, HELD["clean"]) >= 0.9
    prediction = learner.predict(uniform(ASKED[0][1], np.random.default_rng(0)))
    assert sorted(material for material, _ in prediction.ranking) == sorted(NAMES)
    assert np.isfinite([prediction.novelty, *(share for _, share in prediction.ranking)]).all()


def test_touches_far_longer_than_usual_are_kept_in_part_and_known(matching):
    learner = learned(of_each=4)
    for i in range(4):
        learner.observe("long", lasting(SCENE.touch(SCENE.materials[7], i).readings, 5))
    assert max(touch.levels.shape[1] for *_, touch in learner.memory.kept) == 160
    rng = np.random.default_rng(0)
    asked = [lasting(SCENE.touch(SCENE.materials[7], i).readings, 5) for i in range(20, 26)]
    assert np.mean([learner.predict(values).material == "long" for values in asked]) >= 0.8
    for values in asked:
        assert np.isfinite(learner.predict(uniform(values, rng)).novelty)
    assert right(learner, HELD["clean"]) >= 0.9


def test_each_channel_has_noise_of_its_own_range():
    sensor = SKIN.model_copy(update={"low": (0.0, -10.0) * 4, "high": (1.0, 400.0) * 4})
    learner, scene, low, high = learned(sensor=sensor), Scene(sensor=sensor, seed=1), *map(np.array, sensor.limits)
    rng = np.random.default_rng(0)
    found = []
    for name, i in [(name, i) for name in NAMES for i in range(50, 54)]:
        values = scene.touch(name, i).readings
        found.append(learner.predict(values + rng.uniform(-0.5, 0.5, values.shape) * (high - low)).material == name)
    assert np.mean(found) >= 0.85


def test_one_channel():
    sensor = SKIN.model_copy(update={"channels": 1})
    learner, scene, rng = learned(sensor=sensor), Scene(sensor=sensor, seed=1), np.random.default_rng(0)
    touches = [(name, scene.touch(name, i).readings) for name in NAMES for i in range(50, 54)]
    assert np.mean([learner.predict(values).material == name for name, values in touches]) >= 0.9
    assert np.mean([learner.predict(uniform(values, rng, 0.25)).material == name for name, values in touches]) >= 0.3
    for flat in (0.0, 50.0, REACH):
        assert np.isfinite(learner.predict(np.full((80, 1), flat)).novelty)


def present(learner):
    """The matcher that answers now."""
    return learner._predictor.present().matcher


def test_a_model_that_followed_keeps_what_one_fitted_anew_does(tmp_path):
    """What was measured and fitted stays until the next fit; what is kept is that of now."""
    with TactileLearner.open(tmp_path / "m", sensor=SKIN, embedding=Kernels(dimension=128)) as learner:
        receipts = [learner.observe(name, SCENE.touch(name, i)) for i in range(8) for name in NAMES]
        learner.settle()
        measured = present(learner).deviation
        receipt = learner.observe("new", SCENE.touch(SCENE.materials[8], 0))
        learner.observe(NAMES[0], SCENE.touch(NAMES[0], 30))
        learner.retract(receipts[3])
        followed = present(learner)
        assert followed.deviation is measured
        kept = {(material, key) for material, key, _ in learner.memory.kept}
        assert set(followed.kept.touches) == kept
        learner.settle()
        assert (set(present(learner).kept.touches), present(learner).kept.materials) == (kept, sorted({*NAMES, "new"}))
        learner.retract(receipt)
        assert "new" not in present(learner).kept.materials
        assert "new" not in {material for material, _ in learner.predict(ASKED[0][1]).ranking}


def test_a_value_that_is_missing_from_the_start_is_the_first_that_was_read():
    pad = Sensor(name="pad", channels=3, rate=50.0, low=0.0, high=254.0, unit="1", duration=1.0)
    levels = np.array([[MISSING, 7, MISSING, 9], [5, MISSING, 6, MISSING], [MISSING] * 4], dtype=np.uint8)
    readings = stream_of(levels, pad).readings
    assert readings.T.tolist() == [[7, 7, 7, 9], [5, 5, 6, 6], [0, 0, 0, 0]]
