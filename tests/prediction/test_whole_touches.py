"""What views are for: touches at another speed, of another length, over a small part of the range.

Without kept touches beside them: for those see `test_matched`.
"""

import numpy as np
import pytest
from touches import Windowed

from scroll_tactile import Joined, Kernels, Sensor, TactileLearner
from scroll_tactile.signals.image import stretched
from scroll_tactile.simulation.scene import Scene

PAD = Sensor(name="pad", channels=6, rate=100.0, duration=1.0, low=0.0, high=1.0, unit="V")
SCENE = Scene(sensor=PAD)
NAMES = SCENE.materials[:6]
TOUCHES = [(name, SCENE.touch(name, i)) for i in range(8) for name in NAMES]
ASKED = [(name, SCENE.touch(name, i)) for i in range(20, 24) for name in NAMES]


def learned(touches, embedding):
    learner = TactileLearner(sensor=PAD, embedding=embedding, exemplars=0, kept_touches=0)
    for material, readings in touches:
        learner.observe(material, readings)
    return learner


@pytest.fixture(scope="module")
def viewed():
    return learned(TOUCHES, Kernels(dimension=256))


@pytest.fixture(scope="module")
def windowed():
    return learned(TOUCHES, Windowed(dimension=256))


def right(learner, asked, change=lambda touch: touch):
    """The share of touches, changed, whose material is named."""
    return np.mean([learner.predict(change(touch)).material == material for material, touch in asked])


def lasting(times):
    """The same touch, lasting so many times as long."""

    def change(touch):
        image = np.ascontiguousarray(touch.readings.T)
        return stretched(image, round(len(touch.readings) * times)).T

    return change


@pytest.mark.parametrize("times", [4])
def test_a_slower_touch_longer_than_any_learned_is_known_by_its_views_and_lost_without(viewed, windowed, times):
    assert right(viewed, ASKED, lasting(times)) >= 0.95
    assert right(windowed, ASKED, lasting(times)) <= 0.5


def test_a_faster_touch_is_better_known_with_views(viewed, windowed):
    assert right(viewed, ASKED, lasting(0.5)) > max(0.85, right(windowed, ASKED, lasting(0.5)))


@pytest.mark.parametrize("seconds", [0.3, 0.6])
def test_beginnings_are_judged_as_before(viewed, windowed, seconds):
    beginning = [(material, touch.first(seconds)) for material, touch in ASKED]
    assert right(viewed, beginning) >= right(windowed, beginning) - 1 / len(ASKED) >= 0.9


def test_beginnings_after_one_touch_of_each_are_judged_by_windows_alone():
    """No touch could be left out: how strange a beginning looks is not known, and nothing doubts the views."""
    viewed, windowed = (learned(TOUCHES[: len(NAMES)], kind(dimension=256)) for kind in (Kernels, Windowed))
    for _, touch in ASKED[:8]:
        beginning = touch.first(0.4)
        assert viewed.predict(beginning).ranking == windowed.predict(beginning).ranking
    assert right(viewed, ASKED) >= 0.9


@pytest.mark.filterwarnings("ignore:all readings lie in:scroll_tactile.errors.RangeWarning")
def test_readings_of_a_hundredth_of_the_range_whose_zero_moved():
    def small(touch):
        return 0.5 + 0.01 * (touch.readings - 0.5)

    viewed, windowed = (
        learned([(name, small(touch)) for name, touch in TOUCHES], kind(dimension=256)) for kind in (Kernels, Windowed)
    )
    assert right(viewed, ASKED, small) >= 0.95
    assert right(viewed, ASKED, lambda touch: small(touch) + 0.2) >= 0.95
    assert right(windowed, ASKED, lambda touch: small(touch) + 0.2) <= 0.75


def test_joined_kernels_have_views(viewed):
    joined = learned(TOUCHES, Joined(Kernels(dimension=128), Kernels(seed=2, dimension=128)))
    assert joined.plan.views == viewed.plan.views != ()
    assert right(joined, ASKED, lasting(2)) >= 0.95
    mixed = learned(TOUCHES[:2], Joined(Kernels(dimension=64), Windowed(seed=2, dimension=64)))
    assert mixed.plan.views == ()
