"""A sensor whose range is not that of its readings is named, once a learner."""

import warnings

import numpy as np
import pytest
from commands import run

from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.errors import RangeWarning
from scroll_tactile.signals.ranges import range_problem
from scroll_tactile.signals.stream import validate

SKIN = Sensor(name="skin", channels=3, rate=50, low=0, high=255, unit="counts", duration=1)
RNG = np.random.default_rng(0)
BEYOND = RNG.uniform(0, 1500, (50, 3))  # 83 % of it clipped
CORNER = RNG.uniform(0, 1, (50, 3))  # shares, where counts are expected


@pytest.mark.parametrize(
    ("readings", "said"),
    [(BEYOND, r"8. % of the values lie outside the range of sensor 'skin' \(0 to 255 counts\)"), (CORNER, "0.39 %")],
)
def test_a_range_that_does_not_fit_is_said_with_its_cure_once_a_learner(readings, said):
    with TactileLearner(sensor=SKIN, embedding=Kernels(dimension=64)) as learner:
        with pytest.warns(RangeWarning, match=said) as met:
            learner.observe("oak", readings)
        assert "make a new memory with a Sensor whose low and high are" in str(met[0].message)
        assert met[0].filename == __file__
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            learner.observe("oak", readings + 0.001)
        assert learner.materials == {"oak": 2}


def test_a_range_that_fits_is_not_spoken_of():
    touch = RNG.uniform(0, 255, (50, 3))
    for readings in (touch, touch / 50, np.full((50, 3), 7.0), np.where(touch < 40, 300, touch)):
        assert range_problem(validate(readings, SKIN)) is None


def test_each_channel_counts_by_its_own_range():
    hand = Sensor(name="hand", channels=2, rate=50, low=(0, -4), high=(1, 4), unit=("N", "rad/s"), duration=1)
    assert range_problem(validate(np.column_stack([CORNER[:, 0], np.zeros(50)]), hand)) is None
    problem = range_problem(validate(np.column_stack([CORNER[:, 0] / 500 + 0.5, CORNER[:, 1] / 100]), hand))
    assert problem is not None and "of sensor 'hand' (each channel by its own)" in problem


def test_the_command_line_says_it_as_a_line(tmp_path):
    (tmp_path / "skin.json").write_text(SKIN.model_dump_json())
    np.save(tmp_path / "t.npy", BEYOND)
    result = run("observe", tmp_path / "m", "oak", tmp_path / "t.npy", "--sensor", tmp_path / "skin.json")
    assert result.exit_code == 0
    assert result.stderr.startswith("Warning: 8") and len(result.stderr.splitlines()) == 1
