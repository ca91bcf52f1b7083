"""Readings with times, put in their places at the sensor's rate."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from live_touches import learner, rest, shift, slide
from touches import PAD

from scroll_tactile.errors import InputError
from scroll_tactile.live.answers import LiveReport
from scroll_tactile.live.clock import Clock

RATE = 50.0


def placed(rows, times, sizes=()):
    """What a clock makes of readings with times: the rows, the breaks before them, and the report."""
    report = LiveReport()
    clock, parts, breaks, first = Clock(RATE, report), [], [], 0
    rows, times = np.asarray(rows, dtype=float).reshape(len(times), -1), list(times)
    for size in [*sizes, len(rows)]:
        some = slice(first, first + size)
        first += size
        for part in clock.places(rows[some], clock.checked(times[some], len(times[some]))):
            breaks += [(len(parts), part.breaks)] if part.breaks else []
            parts += part.rows[:, 0].tolist()
    return parts, breaks, report


def count(n):
    return np.arange(n, dtype=float)


@given(st.lists(st.floats(-0.3, 0.3), min_size=60, max_size=60), st.floats(-1e9, 2e9))
def test_jitter_changes_no_reading(jitter, start):
    rows, breaks, report = placed(count(60), start + (count(60) + jitter) / RATE)
    assert rows == count(60).tolist() and not breaks
    assert report == LiveReport()


@given(st.lists(st.integers(0, 7), max_size=8), st.data())
def test_places_do_not_depend_on_blocks(sizes, data):
    steps = data.draw(st.lists(st.sampled_from([0.02, 0.02, 0.02, 0.0, 0.04, 0.06, -0.01, -0.5, 0.5]), min_size=40))
    times = np.cumsum(steps)
    assert placed(count(len(times)), times, sizes) == placed(count(len(times)), times)


def test_lost_readings_are_the_line_between_their_neighbours():
    for kept in (np.delete(count(30), [10, 11, 20]), count(201)[::2]):
        rows, _, report = placed(kept, kept / RATE)
        assert np.allclose(rows, count(len(rows))) and report.lost == kept[-1] + 1 - len(kept)


def test_a_line_begins_at_its_time_and_at_what_the_callers_buffer_held():
    clock, buffer, parts = Clock(RATE, LiveReport()), np.empty((1, 1)), []
    for value, stamp in ((0, 0.0), (3, 0.02), (9, 0.08)):
        buffer[:] = value
        parts += [(part.time, part.rows.ravel().tolist()) for part in clock.places(buffer, clock.checked(stamp, 1))]
    assert parts == [(0.0, [0]), (0.02, [3]), (pytest.approx(0.04), [5, 7]), (0.08, [9])]


def test_readings_that_come_twice_or_late_are_left_out():
    order = [0, 1, 2, 2, 3, 5, 4, 6, 7, 8]
    rows, _, report = placed(order, np.array(order) / RATE)
    assert rows == count(9).tolist()
    assert (report.repeated, report.late, report.lost) == (1, 1, 1)


@pytest.mark.parametrize(("faster", "off"), [(1.11, "surplus"), (0.9, "lost")])
def test_another_rate_than_the_sensor_s_is_brought_to_it(faster, off):
    times = count(1000) / (RATE * faster)
    rows, breaks, report = placed(count(1000), times)
    assert len(rows) == pytest.approx(1000 / faster, abs=10) and not breaks
    assert getattr(report, off) == pytest.approx(abs(1000 - 1000 / faster), abs=10)
    assert np.all(np.diff(rows) > 0)


@pytest.mark.parametrize(("step", "name", "counted"), [(2.0, "gap", "gaps"), (-3.0, "time went back", "steps_back")])
def test_a_gap_and_a_step_back_begin_anew(step, name, counted):
    times = count(40) / RATE
    times[20:] += step
    rows, breaks, report = placed(count(40), times)
    assert rows == count(40).tolist() and breaks == [(20, name)]
    assert getattr(report, counted) == 1


def test_where_stamps_stand_still_readings_are_taken_as_they_come():
    rows, breaks, report = placed(count(100), np.zeros(100))
    assert rows[-80:] == count(100)[-80:].tolist() and not breaks
    assert report.untimed == len(rows) - 1
    times = np.concatenate([count(30) / RATE, np.full(40, 29 / RATE), (30 + count(30)) / RATE])
    rows, breaks, _ = placed(count(100), times)
    assert rows[:30] == count(30).tolist() and rows[-30:] == count(100)[-30:].tolist() and not breaks


@pytest.mark.parametrize(("unit", "name"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")])
@pytest.mark.parametrize("block", [True, False])
def test_times_in_other_units_are_diagnosed(unit, name, block):
    rows, times = rest(20, np.random.default_rng(0)), (1.7e9 + count(20) / PAD.rate) * unit
    with learner().live() as live, pytest.raises(InputError, match=name):
        if block:
            live.push(rows, time=times.astype(np.int64))
        else:
            for row, time in zip(rows, times, strict=True):
                live.push(row, time=int(time))


@pytest.mark.parametrize("time", ["0.1", ["0.1", "0.2"], [0.1], 0.1, [[0.1, 0.2]], [0.1, np.nan], [None, None]])
def test_times_that_are_none_are_refused_and_nothing_is_taken(time):
    rows = rest(2, np.random.default_rng(0))
    with learner().live() as live:
        with pytest.raises(InputError, match="time"):
            live.push(rows, time=time)
        live.push(rows, time=[0.0, 0.02])
        assert live.report.readings == 2


def test_a_touch_with_times_is_what_a_file_would_hold():
    made = learner()
    rows, _ = shift("ab")
    random = np.random.default_rng(0)
    times = 1.7e9 + (np.arange(len(rows)) + random.uniform(-0.3, 0.3, len(rows))) / PAD.rate
    with made.live() as plain, made.live() as timed:
        expected = plain.push(rows).touches
        found = [touch for row, time in zip(rows, times, strict=True) for touch in timed.push(row, time).touches]
    assert [touch.stream for touch in found] == [touch.stream for touch in expected]
    assert [touch.prediction for touch in found] == [touch.prediction for touch in expected]
    assert np.allclose([touch.at - 1.7e9 for touch in found], [touch.at for touch in expected], atol=0.02)


@pytest.mark.parametrize(("step", "end"), [(2.0, "gap"), (-3.0, "time went back")])
def test_a_gap_or_a_step_back_ends_a_touch(step, end):
    random = np.random.default_rng(1)
    rows = np.concatenate([rest(150, random), slide("a", 80, random)])
    times = np.arange(230) / PAD.rate
    times[190:] += step
    with learner().live() as live:
        now = live.push(rows, time=times)
    assert [touch.end for touch in now.touches] == [end]
    assert len(now.touches[0].stream) == 40
    assert now.contact and now.seconds == 40 / PAD.rate
