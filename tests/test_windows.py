"""Which windows are read of a touch of any length."""

import pytest

from scroll_tactile.sensors import BIOTAC, CONTACTILE, GELSIGHT, ROBOSKIN, Sensor
from scroll_tactile.windows import MOST_WINDOWS, extent, milestones, scales, scored, stages


def sensor(rate, duration, **settings):
    fields = {"name": "mine", "channels": 3, "low": 0.0, "high": 1.0, "unit": "N"} | settings
    return Sensor(rate=rate, duration=duration, **fields)


SLOW, FAST, SHORT = sensor(10.0, 4.0), sensor(2000.0, 4.0), sensor(100.0, 0.5)
CAMERA = sensor(25.0, 1.0, channels=24 * 32 * 3, layout=(24, 32, 3), camera=True)
ALL = [BIOTAC, ROBOSKIN, CONTACTILE, GELSIGHT, SLOW, FAST, SHORT, CAMERA, sensor(1.0, 1.0)]


def test_the_scales_of_the_known_sensors():
    assert scales(BIOTAC) == (30, 200)
    assert scales(ROBOSKIN) == (15, 37)
    assert scales(GELSIGHT) == (80,)
    assert scales(CAMERA) == (32,)
    assert scales(SHORT) == (30,)


@pytest.mark.parametrize("one", ALL, ids=lambda one: f"{one.name} {one.rate:g} Hz")
def test_scales_ascend(one):
    widths = scales(one)
    assert widths
    assert list(widths) == sorted(set(widths))
    assert all(width > 0 for width in widths)


@pytest.mark.parametrize("one", ALL, ids=lambda one: f"{one.name} {one.rate:g} Hz")
def test_windows_of_all_lengths_lie_within_begin_at_the_beginning_and_are_few(one):
    widths = scales(one)
    for columns in [*range(1, 2001), 10_000, 10**6]:
        read = extent(columns, widths)
        assert sorted(read) == sorted({widths[0], *(width for width in widths if width <= columns)})
        for width, begin in read.items():
            assert begin[0] == 0
            assert begin == sorted(set(begin))
            assert len(begin) <= MOST_WINDOWS == 64
            assert all(isinstance(start, int) for start in begin)
            assert begin[-1] + min(width, columns) <= columns
            if columns < width:
                assert begin == [0]


@pytest.mark.parametrize("one", [BIOTAC, ROBOSKIN, SLOW], ids=lambda one: one.name)
def test_a_long_touch_is_covered_to_its_end(one):
    for columns in (one.readings, 3 * one.readings, 10**6):
        for width, begin in extent(columns, scales(one)).items():
            assert begin[-1] + 2 * width > columns or columns > 60 * width
            assert begin[-1] > columns * 0.4 or len(begin) == 1


@pytest.mark.parametrize("one", ALL, ids=lambda one: f"{one.name} {one.rate:g} Hz")
def test_scored_windows_lie_within_what_was_felt_and_apart(one):
    widths = scales(one)
    for columns in [*range(1, 400), 977, 2000]:
        read = extent(columns, widths)
        for length in {columns, *(reached for reached in stages(columns, widths))}:
            chosen = scored(read, length)
            assert widths[0] in chosen
            assert all(width <= length for width in list(chosen)[1:])
            for width, places in chosen.items():
                starts = [read[width][place] for place in places]
                assert starts[0] == 0
                assert all(start + width <= length for start in starts[1:])
                assert all(b - a >= width // 2 for a, b in zip(starts, starts[1:], strict=False))


def test_milestones():
    assert milestones((30, 200)) == (30, 77, 200)
    assert milestones((80,)) == (80,)
    assert list(milestones((9, 10, 1000))) == sorted(set(milestones((9, 10, 1000))))


@pytest.mark.parametrize("one", ALL, ids=lambda one: f"{one.name} {one.rate:g} Hz")
def test_the_stages_of_a_touch_end_with_its_own_length(one):
    widths = scales(one)
    for columns in range(1, 700):
        reached = stages(columns, widths)
        assert reached[-1] == columns
        assert reached == sorted(set(reached))
        assert len(reached) == max(1, sum(length <= columns for length in milestones(widths)))


def test_a_longer_touch_never_has_fewer_stages_or_scales():
    before = (0, 0)
    for columns in range(1, 900):
        now = (len(stages(columns, (30, 200))), len(extent(columns, (30, 200))))
        assert now >= before
        before = now
