"""The benchmark of shifts: small, on simulated touches."""

import json

import pytest
from commands import run

from examples.benchmarks import live_shift
from examples.benchmarks.live_shift import _scored
from scroll_tactile import sensors
from scroll_tactile.live.answers import LiveTouch
from scroll_tactile.results import Prediction
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.simulation.shift import Shift, Truth


def test_shifts_are_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(live_shift, "LEARNED", 2)
    result = run("bench", "live", "--hours", "0.01", "--json", tmp_path / "live.json")
    assert result.exit_code == 0, result.output
    records = json.loads((tmp_path / "live.json").read_text())["shifts"]
    assert [record["channels"] for record in records] == [19, 60]
    for record in records:
        assert record["found"] == record["touches"] > 1 and record["false"] == 0
        assert record["onset_ms"]["median"] < 30
        assert 0 < record["milliseconds"]["p50"] <= record["milliseconds"]["p99"] <= record["milliseconds"]["max"]


def test_contacts_are_scored_by_the_truth():
    stream = Scene(sensor=sensors.ROBOSKIN).touch("oak", 0)
    oak = Prediction("oak", 1.0, (("oak", 1.0),), 0.0, True, 1.5)
    found = [LiveTouch(stream, oak, True, at, "released") for at in (10.02, 11.6, 30.0, 39.99)]
    truth = [Truth("oak", 10.0, 13.0), Truth("ash", 20.0, 21.5), Truth("ash", 40.0, 41.5)]
    scored = _scored(Shift(sensors.ROBOSKIN, stream.readings, stream.readings[:, 0], truth), found)
    assert (scored["touches"], scored["found"], scored["in_parts"], scored["false"]) == (3, 2, 1, 1)
    assert scored["named_right"] == 1
    assert scored["onset_ms"]["median"] == pytest.approx(15.0)
