"""The default learner on two simulated sensors that nothing was tuned on: what it says of them is about true.

The bounds are wide of what was measured, with 20 materials of which 12 touches were learned each.
"""

import numpy as np
import pytest

from scroll_tactile import TactileLearner
from scroll_tactile.pipelines.metrics import accuracy, calibration_error
from scroll_tactile.simulation.scene import EVENT_SKIN, LIGHT_PAD, MATERIALS, Scene

SENSORS = {"events": EVENT_SKIN, "light": LIGHT_PAD}
TOUCHES, TESTS = 12, 6


@pytest.fixture(scope="module", params=sorted(SENSORS))
def answered(request):
    """What the learner says of touches of known materials, and the response of their sensor."""
    scene, learner = (
        Scene(SENSORS[request.param], response=request.param),
        TactileLearner(sensor=SENSORS[request.param]),
    )
    for material in MATERIALS:
        for repetition in range(TOUCHES):
            learner.observe(material, scene.touch(material, repetition))
    learner.settle()
    touches = [(material, 1000 + repetition) for material in MATERIALS for repetition in range(TESTS)]
    return request.param, [(material, learner.predict(scene.touch(material, place))) for material, place in touches]


def test_most_touches_are_right(answered):
    response, answers = answered
    share = accuracy([material for material, _ in answers], [answer.material for _, answer in answers])
    assert share >= {"events": 0.86, "light": 0.9}[response]


def test_a_probability_is_the_share_that_is_right(answered):
    _, answers = answered
    right = [answer.material == material for material, answer in answers]
    assert calibration_error([answer.probability for _, answer in answers], right) <= 0.09


def test_false_alarms_are_about_as_many_as_asked(answered):
    _, answers = answered
    assert np.mean([answer.known is False for _, answer in answers]) <= 0.1  # of 5 in 100 asked, 120 touches


def test_sets_of_candidates_hold_the_material(answered):
    _, answers = answered
    assert np.mean([material in answer.candidates(0.1) for material, answer in answers]) >= 0.85
