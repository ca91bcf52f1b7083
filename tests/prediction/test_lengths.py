"""Touches longer than those learned."""

from dataclasses import replace

import numpy as np
from touches import Windowed

from examples.paper.readers import biotac_slide
from scroll_tactile import Kernels, TactileLearner, sensors
from scroll_tactile.embeddings.protocol import window_plan
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.simulation.scene import Scene

SCENE = Scene(sensor=sensors.BIOTAC, seed=3)


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


def test_learned_from_half_streams_whole_ones_are_distinguished(real_data):
    recordings = biotac_slide.load(real_data, "roboskin")
    learner = TactileLearner(sensor=recordings.sensor, embedding=Kernels(dimension=256))
    names = sorted(set(recordings.materials))[:4]
    every = zip(recordings.materials, recordings.streams, recordings.fold, strict=True)
    touches = [one for one in every if one[0] in names][::2]
    for material, stream, fold in touches:
        if fold:
            learner.observe(material, stream.first(stream.seconds / 2))
    right = [learner.predict(stream).material == material for material, stream, fold in touches if not fold]
    assert np.mean(right) >= 0.9  # 97.2 % over five folds of twenty materials
