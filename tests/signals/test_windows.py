"""Which windows are read of a touch of any length."""

from itertools import pairwise

import pytest

from scroll_tactile import Frames
from scroll_tactile.embeddings.protocol import window_plan
from scroll_tactile.sensors import BIOTAC, CONTACTILE, GELSIGHT, ROBOSKIN, Sensor
from scroll_tactile.signals.windows import (
    MOST_STEPS,
    MOST_WINDOWS,
    Scale,
    WindowPlan,
    scales,
    whole_steps,
)


def sensor(rate, duration, **settings):
    fields = {"name": "mine", "channels": 3, "low": 0.0, "high": 1.0, "unit": "N"} | settings
    return Sensor(rate=rate, duration=duration, **fields)


SLOW, FAST, SHORT = sensor(10.0, 4.0), sensor(2000.0, 4.0), sensor(100.0, 0.5)
CAMERA = sensor(25.0, 1.0, channels=24 * 32 * 3, layout=(24, 32, 3), camera=True)
ALL = [BIOTAC, ROBOSKIN, CONTACTILE, GELSIGHT, SLOW, FAST, SHORT, CAMERA, sensor(1.0, 1.0)]


def named(one):
    return f"{one.name} {one.rate:g} Hz"


def test_the_shortest_scale_is_a_third_of_a_second_and_a_camera_has_one():
    assert scales(BIOTAC)[0] == 30
    assert scales(ROBOSKIN)[0] == 15
    assert scales(SLOW)[0] == 9  # no fewer than a kernel has taps
    assert scales(GELSIGHT) == (160,)
    assert scales(CAMERA) == (32,)
    assert scales(SHORT) == (30,)


@pytest.mark.parametrize("one", ALL, ids=named)
def test_windows_of_all_lengths_lie_within_begin_at_the_beginning_and_are_few(one):
    widths = scales(one)
    assert list(widths) == sorted(set(widths))
    assert all(0 < width <= one.readings for width in widths[1:])
    for columns in [*range(1, 500), 2000, 10_000, 10**6, 2**28]:
        read = WindowPlan(widths).extent(columns)
        assert list(read) == WindowPlan(widths).fitting(columns)
        assert widths[0] in read
        assert {width for width in widths if width <= columns} <= read.keys()
        for width, begin in read.items():
            assert begin[0] == 0
            assert begin == sorted(set(begin))
            assert len(begin) <= MOST_WINDOWS == 64
            assert begin[-1] + min(width, columns) <= columns
            if columns < width:
                assert begin == [0]


@pytest.mark.parametrize("one", [BIOTAC, ROBOSKIN, SLOW], ids=named)
def test_a_long_touch_is_read_to_its_end(one):
    for columns in (one.readings, 3 * one.readings, 10**6):
        for width, begin in WindowPlan(scales(one)).extent(columns).items():
            assert begin[-1] + 2 * width > columns


@pytest.mark.parametrize("one", ALL, ids=named)
def test_scored_windows_lie_within_what_was_observed(one):
    widths = scales(one)
    for columns in [*range(1, 400), 977, 2000]:
        plan = WindowPlan(widths)
        read = plan.extent(columns)
        for length in plan.stages(columns):
            chosen = plan.scored(columns, length)
            assert [scale.width for scale in chosen] == plan.fitting(length)
            for width, places in ((scale.width, places) for scale, places in chosen.items()):
                starts = [read[width][place] for place in places]
                assert starts[0] == 0
                assert all(start + width <= length for start in starts[1:])
                assert starts == sorted(set(starts))
                if width == widths[0]:
                    assert all(b - a >= width // 2 for a, b in pairwise(starts))


def test_of_the_shortest_those_are_scored_that_begin_half_a_width_apart():
    plan = WindowPlan((30, 300))
    places = plan.scored(100, 100)[Scale("window", 30)]
    assert [plan.extent(100)[30][place] for place in places] == [0, 15, 34, 60]


def test_views_have_as_many_columns_as_a_usual_touch_within_bounds():
    assert [whole_steps(one) for one in (BIOTAC, sensor(1.0, 1.0), sensor(10_000.0, 4.0))] == [400, 9, MOST_STEPS]


def test_milestones_ascend_from_the_shortest_scale_to_where_the_longest_fits():
    for widths in ((30, 200), (80,), (9, 20, 1000), (15, 56)):
        plan = WindowPlan(widths)
        reached = plan.milestones()
        assert list(reached) == sorted(set(reached))
        assert reached[0] == widths[0]
        assert len(reached) == 2 * len(widths) - 1
        assert plan.fitting(reached[-1]) == list(widths) != plan.fitting(reached[-1] - 1) or len(widths) == 1


@pytest.mark.parametrize("one", ALL, ids=named)
def test_the_stages_of_a_touch_end_with_its_own_length(one):
    plan = WindowPlan(scales(one))
    for columns in range(1, 700):
        reached = plan.stages(columns)
        assert reached[-1] == columns
        assert reached == sorted(set(reached))
        assert len(reached) == max(1, sum(length <= columns for length in plan.milestones()))


@pytest.mark.parametrize("rate", [5.0, 33.0, 100.0])
def test_at_each_stage_a_touch_has_the_scales_by_which_the_stage_is_judged(rate):
    """Calibration and model know a stage by its number, and take its scales from its milestone."""
    for tenths in range(2, 40, 3):
        plan = WindowPlan(scales(sensor(rate, tenths / 10)))
        for columns in range(1, int(rate * tenths / 5)):
            for stage, length in enumerate(plan.stages(columns)):
                assert plan.fitting(length) == plan.fitting(plan.milestones()[stage]), (plan, columns)


@pytest.mark.parametrize("frames", [1, 2, 7, 64, 65, 1000])
def test_the_windows_of_a_camera_are_its_frames(frames):
    reading = window_plan(CAMERA, Frames())
    starts = reading.extent(32 * frames)[32]
    assert len(starts) == min(frames, MOST_WINDOWS)
    assert starts[0] == 0
    assert starts[-1] == 32 * (frames - 1)
    assert all(start % 32 == 0 for start in starts)
    assert reading.scored(32 * frames, 32 * frames) == {Scale("window", 32): list(range(len(starts)))}
