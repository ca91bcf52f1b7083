"""Memories unlike the usual: of touches longer than learned, of thousands of materials, of other sensors."""

from dataclasses import replace

import numpy as np
import pytest
from touches import PAD, Windowed

from scroll_tactile import Kernels, TactileLearner, sensors
from scroll_tactile.clients.learning.metrics import accuracy, calibration_error
from scroll_tactile.embeddings.protocol import window_plan
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.simulation.scene import EVENT_SKIN, LIGHT_PAD, MATERIALS, Scene

SCENE = Scene(sensor=sensors.BIOTAC, seed=3)
TOUCHES, TESTS = 10, 4  # of each material of a sensor that nothing was tuned on


def test_a_longer_touch_is_viewed_whole_and_its_windows_are_read_as_far_as_was_learned():
    embedding = Kernels(dimension=64)
    plan = window_plan(sensors.BIOTAC, embedding)
    features, touch = FeatureExtractor(sensors.BIOTAC, embedding, plan), SCENE.touch(SCENE.materials[0], 9)
    found, part, whole = (
        features.encode(stream, longest, lambda _: plan.scales)
        for stream, longest in ((touch, 200), (touch.first(2.0), 200), (touch, 400))
    )
    assert (found.steps, found.seconds) == (200, 2.0)
    for scale in plan.scales:
        expected = part if scale.kind == "window" else whole
        assert found.means.get(scale, np.zeros(0)).tobytes() == expected.means.get(scale, np.zeros(0)).tobytes()
    assert whole.means[plan.views[0]].tobytes() != part.means[plan.views[0]].tobytes()


def test_without_views_a_longer_touch_is_read_as_far_as_was_learned():
    learner = TactileLearner(sensor=sensors.BIOTAC, embedding=Windowed(dimension=64))
    for name in SCENE.materials[:3]:
        for at in range(3):
            learner.observe(name, SCENE.touch(name, at).first(2.0))
    touch = SCENE.touch(SCENE.materials[0], 9)
    whole, part = learner.predict(touch), learner.predict(touch.first(2.0))
    assert whole == replace(part, unusual=("longer",))
    assert whole.seconds == 2.0
    learner.observe(SCENE.materials[0], SCENE.touch(SCENE.materials[0], 5))
    assert learner.predict(touch).seconds == 4.0


def touch(material, seed, readings=20):
    """A noisy wave whose level, slope and frequency are the material's."""
    random, own = np.random.default_rng([material, seed]), np.random.default_rng(material)
    time = np.arange(readings)[:, None] / readings
    wave = own.uniform(0.2, 0.6, 2) + own.uniform(-0.2, 0.2, 2) * time
    return wave + own.uniform(0, 0.2, 2) * np.sin(own.uniform(3, 60, 2) * time) + random.normal(0, 0.002, (readings, 2))


def test_of_materials_of_one_short_touch_each_the_nearest_answers():
    learner, scene = TactileLearner(sensor=PAD, embedding=Kernels(dimension=64)), ["m0003", "m0400", "m1029"]
    for first, last in ((0, 1030), (1030, 5000)):
        for material in range(first, last):
            learner.observe(f"m{material:04d}", touch(material, 0))
        for material in (0, 5, 517, last - 1):
            prediction = learner.predict(touch(material, 0))
            assert prediction.material == f"m{material:04d}"
            assert len(prediction.ranking) == last
        for material in (3, 400, 1029):
            whole, part = (dict(learner.predict(touch(material, 7), scene=names).ranking) for names in (None, scene))
            assert max(part, key=part.get) == f"m{material:04d}"
            assert sorted(part, key=part.get) == sorted(scene, key=whole.get)


@pytest.mark.parametrize(("response", "sensor", "least"), [("events", EVENT_SKIN, 0.85), ("light", LIGHT_PAD, 0.9)])
def test_most_touches_are_right_as_often_as_is_said_and_few_are_false_alarms(response, sensor, least):
    scene, learner, names = Scene(sensor, response=response), TactileLearner(sensor=sensor), MATERIALS[::4]
    for material in names:
        for repetition in range(TOUCHES):
            learner.observe(material, scene.touch(material, repetition))
    asked = [material for material in names for _ in range(TESTS)]
    answers = [learner.predict(scene.touch(material, 1000 + i)) for material in names for i in range(TESTS)]
    right = [answer.material == material for material, answer in zip(asked, answers, strict=True)]
    assert accuracy(asked, [answer.material for answer in answers]) >= least
    assert calibration_error([answer.probability for answer in answers], right) <= 0.15
    assert np.mean([answer.known is False for answer in answers]) <= 0.15  # of 5 in 100 asked, 20 touches
    held = [material in answer.candidates(0.1) for material, answer in zip(asked, answers, strict=True)]
    assert np.mean(held) >= 0.8
