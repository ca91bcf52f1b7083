"""Touches out of recordings: how they are cut, and what names them."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scroll_tactile.errors import FieldError, InputError, RecordingError
from scroll_tactile.recordings import (
    Episode,
    Interval,
    Recording,
    Report,
    declared_quantities,
    read_intervals,
    resampled,
    touches,
)
from scroll_tactile.recordings.delimited import LONGEST
from scroll_tactile.recordings.touches import require_found


def recording(source="/data/felt/run.1.mcap", start=0.0, episodes=(), count=100, topic="/rh/denim"):
    readings = np.arange(count * 2.0).reshape(count, 2)
    times = start + np.arange(count) / 10
    return Recording(source, topic, "data", readings, times, tuple(episodes), Report(count, "log", rate=10.0))


EPISODES = (Episode(0, 40, "slide over cork"), Episode(40, 90, None))


@pytest.mark.parametrize(
    ("cut", "label", "spans"),
    [
        ("whole", None, [(0, 100, None)]),
        ("whole", "file", [(0, 100, "run")]),
        ("whole", "folder", [(0, 100, "felt")]),
        ("whole", "topic", [(0, 100, "denim")]),
        ("episodes", None, [(0, 40, "slide over cork"), (40, 90, None)]),
        ("episodes", "folder", [(0, 40, "felt"), (40, 90, "felt")]),
        (lambda r: [(10, 20), (45, 60)], None, [(10, 20, "slide over cork"), (45, 60, None)]),
        (lambda r: [(10, 20)], "task", [(10, 20, "slide over cork")]),
    ],
)
def test_every_cut_with_every_label(cut, label, spans):
    whole = recording(episodes=EPISODES)
    found = touches(whole, cut, label)
    assert [(t.begin, t.end, t.material) for t in found] == spans
    for touch in found:
        np.testing.assert_array_equal(touch.readings, whole.readings[touch.begin : touch.end])
        np.testing.assert_array_equal(touch.times, whole.times[touch.begin : touch.end])
    assert found[0].name == f"run.1.mcap[{found[0].begin}:{found[0].end}]"


@pytest.mark.parametrize("start", [0.0, 1_760_000_000.0])
def test_intervals_cut_by_the_clock_or_from_the_first_reading(start):
    whole = recording(start=start)
    intervals = [
        Interval("run.1.mcap", 1, 2, "felt"),
        Interval("other.mcap", 0, 9, "cork"),
        Interval("run.1", 5, 5.5, "wool"),
    ]
    if start:
        intervals.append(Interval("felt/run.1.mcap", start + 7, start + 8, "silk"))
    found = [(t.begin, t.end, t.material) for t in touches(whole, intervals)]
    assert found[:2] == [(10, 20, "felt"), (50, 55, "wool")]
    assert found[2:] == ([(70, 80, "silk")] if start else [])


@pytest.mark.parametrize(
    ("change", "cut", "label", "message"),
    [
        ({"episodes": ()}, "episodes", None, "no episodes"),
        ({}, "episodes", "task", "readings 40 to 90, has no task"),
        ({"topic": None}, "whole", "topic", "has no topic"),
        ({"source": "/run.mcap"}, "whole", "folder", "has no folder"),
        ({}, "halves", None, "'halves'"),
        ({}, "whole", "colour", "'colour'"),
        ({}, [Interval("run.2.mcap", 0, 1, "felt")], None, "no interval is of .*nearest is 'run.2.mcap'"),
        ({}, [Interval("run.1.mcap", 20, 30, "felt", 4)], None, "row 4 .* holds no reading .* lasts from 0 to 9.9 s"),
        ({}, [Interval("run.1.mcap", 2, 30, "felt", 4)], None, "row 4 .* lies outside .* lasts from 0 to 9.9 s"),
        ({}, [Interval("run.1.mcap", -1, 3, "felt", 4)], None, "row 4 .* lies outside .* lasts from 0 to 9.9 s"),
        (
            {},
            [Interval("run.1", 6, 7, "oak", 2), Interval("run.1", 1, 9, "felt", 3), Interval("run.1", 2, 3, "felt", 4)],
            None,
            "rows 3 and 2 .* overlap .* 'felt' until 9 s, 'oak' from 6 s",
        ),
        ({"times": np.full(100, np.nan)}, [Interval("run.1", 0, 1, "a")], None, "no clock"),
        ({"times": np.arange(100.0)[::-1]}, [Interval("run.1", 0, 1, "a")], None, "time goes back"),
        ({}, lambda r: [(5, 5)], None, "a cut gave readings 5 to 5 of 100"),
        ({}, lambda r: [(0, 101)], None, "a cut gave"),
    ],
)
def test_what_cannot_be_cut_or_named(change, cut, label, message):
    with pytest.raises(InputError, match=message):
        touches(replace(recording(episodes=EPISODES), **change), cut, label)


def test_a_table_of_intervals(tmp_path):
    path = tmp_path / "labels.csv"
    path.write_text("\ufeffend;Label;file;begin\n2.5; felt ;a.bag;1\n\n9;cork;b/c.bag;8\n", encoding="utf-8")
    assert read_intervals(path) == [
        Interval("a.bag", 1, 2.5, "felt", 2),
        Interval("b/c.bag", 8, 9, "cork", 4),
    ]
    for text, error, message in [
        ("file,begin,end\na,1,2\n", FieldError, "no column 'material'"),
        ("", FieldError, "no column 'file'"),
        (
            "file,begin,end,material\na.bag,1,2,\n",
            InputError,
            "row 2: expected a file and a material; came 'a.bag' and ''",
        ),
        ("file,begin,end,material\na.bag,1\n", InputError, "row 2: expected a file and a material"),
        ("file,begin,end,material\na.bag,1,x,felt\n", InputError, "row 2: expected begin and end in seconds"),
        ("file,begin,end,material\na.bag,3,2,felt\n", InputError, "row 2: expected begin before end"),
        (
            "file,begin,end,material\na.bag,1,2,felt,wool\n",
            InputError,
            "row 2: expected 4 cells.*came 5, the last 'wool'",
        ),
    ]:
        path.write_text(text)
        with pytest.raises(error, match=message):
            read_intervals(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_intervals(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("b.bag", "row 7 .*'b.bag' is none of the recordings.*felt/0.bag"),
        ("0.bag", r"row 7 .*'0.bag' fits 2 recordings, rec/felt/0.bag, rec/oak/0.bag: write .* such as felt/0.bag"),
        ("felt/0", None),
        ("rec\\\\oak\\\\0.bag", None),
    ],
)
def test_an_interval_is_of_one_recording(file, message):
    files, intervals = ["rec/felt/0.bag", "rec/oak/0.bag", "rec/oak/1.bag"], [Interval(file, 0, 1, "felt", 7)]
    if message is None:
        require_found(intervals, files)
        return
    with pytest.raises(InputError, match=message):
        require_found(intervals, files)


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir])
def test_a_table_of_intervals_is_a_file(tmp_path, make):
    make(tmp_path / "labels.csv")
    with pytest.raises(RecordingError, match=r"labels.csv is a [A-Za-z]+; expected a file"):
        read_intervals(tmp_path / "labels.csv")
    with pytest.raises(RecordingError, match="/dev/zero is a device; expected a file"):
        declared_quantities("/dev/zero")


def test_a_table_of_intervals_is_no_longer_than_one_is(tmp_path, monkeypatch):
    path = tmp_path / "labels.csv"
    names, row = "file,begin,end,material\n", "a.bag,1,2,felt\n"
    path.write_text(names.strip() + "," * 65536)
    with pytest.raises(RecordingError, match=r"a line of 65536 characters and more; expected a table of intervals"):
        read_intervals(path)
    path.write_text(names + "a.bag,1,2," + "," * LONGEST)
    with pytest.raises(RecordingError, match=f"a line of {LONGEST} characters and more; expected a table"):
        read_intervals(path)
    monkeypatch.setattr(sys.modules[Interval.__module__], "_MOST", len(names + row * 9))
    path.write_text(names + row * 9)
    assert len(read_intervals(path)) == 9
    path.write_text(names + row * 10)
    with pytest.raises(RecordingError, match=f"more than {len(names + row * 9)} characters; expected a table"):
        read_intervals(path)


def test_resampling_is_linear_and_leaves_gaps_open():
    whole = recording(count=10)
    even = resampled(whole, 40.0)
    np.testing.assert_allclose(even.times, np.arange(37) / 40)
    np.testing.assert_allclose(even.readings[:, 0], np.arange(37) / 2)
    gap = replace(whole, times=np.concatenate([np.arange(5) / 10, 10 + np.arange(5) / 10]))
    even = resampled(gap, 10.0)
    assert np.isnan(even.readings[5:100]).all()
    assert np.isfinite(even.readings[:5]).all()
    assert np.isfinite(even.readings[100:]).all()
    np.testing.assert_allclose(even.readings[-1], whole.readings[-1])
    for change, rate, message in [
        ({}, 0.0, "positive rate"),
        ({}, float("nan"), "positive rate"),
        ({}, 1e9, "give a lower rate"),
        ({"times": np.full(10, np.nan)}, 10.0, "no clock"),
        ({"readings": np.zeros((10, 2, 2, 3))}, 10.0, "pictures"),
    ]:
        with pytest.raises(InputError, match=message):
            resampled(replace(whole, **change), rate)
