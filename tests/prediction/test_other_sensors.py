"""The default learner on two simulated sensors that nothing was tuned on: what it says of them is about true."""

import numpy as np
import pytest

from scroll_tactile import TactileLearner
from scroll_tactile.clients.learning.metrics import accuracy, calibration_error
from scroll_tactile.simulation.scene import EVENT_SKIN, LIGHT_PAD, MATERIALS, Scene

TOUCHES, TESTS = 10, 4


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
