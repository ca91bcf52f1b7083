"""The smaller benchmarks, run small: each fills its table, and its figures are of what was asked for."""

import json
import sqlite3
from contextlib import closing, nullcontext
from importlib.util import find_spec

import numpy as np
import pytest
from commands import run
from scroll_tactile_store.log import Log, refuse
from scroll_tactile_store.rows import decode_row

from examples.benchmarks import appending, health, health_peers, live_shift
from examples.benchmarks.interleaved import AsIs
from examples.benchmarks.live_shift import _scored
from scroll_tactile import sensors
from scroll_tactile.errors import InputError
from scroll_tactile.live.answers import LiveTouch
from scroll_tactile.results import Prediction
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.simulation.shift import Shift, Truth, quiet_noise, resting_level, shift_of
from scroll_tactile.testing import check_embedding


def measured(tmp_path, *words):
    """What a benchmark printed, and wrote as JSON."""
    result = run("bench", *words, "--json", tmp_path / "r.json")
    assert result.exit_code == 0, result.output
    return result.output, json.loads((tmp_path / "r.json").read_text())


def test_a_study_of_changed_sensors_goes_on_from_its_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(health, "ONE", ("dead",))
    for cases in ("MANY", "AT_REST", "NONE"):
        monkeypatch.setattr(health, cases, ())
    words = ("health", "--orders", 1, "--cache", tmp_path / "cache")
    _, result = measured(tmp_path, *words)
    (record,) = result["records"]
    assert (record["case"], record["false"], record["found"], record["named"], record["kind"]) == ("dead", 0, 1, 1, 1)
    assert record["median"] <= 30
    assert measured(tmp_path, *words)[1]["records"] == result["records"]


class Above:
    """A detector that alarms above a value."""

    def __init__(self, most):
        self.most, self.drift_detected = most, False

    def update(self, value):
        self.drift_detected = value > self.most


def test_a_detector_takes_its_most_sensitive_setting_that_has_no_more_false_alarms(monkeypatch):
    calm, late = np.full((20, 5), 0.6), np.full((20, 5), 0.6)
    late[12:, 3] = 0.9
    orders = {
        "none": [health_peers.Order(calm, list(range(20)), 10, None, calm)],
        "dead": [health_peers.Order(late, list(range(20)), 10, 14, late)],
    }
    above = health_peers.Peer("above", "numpy", (0.5, 0.7, 0.95), lambda _, most: Above(most))
    monkeypatch.setattr(health_peers, "PEERS", (above,))
    monkeypatch.setattr(health_peers, "MODULES", {"numpy": "numpy"})
    own, other = health_peers.peer_records("pad", orders)
    assert (own["peer"], own["median"], own["false"], own["found"]) == ("health", 5, 0, 1)
    assert (other["setting"], other["median"], other["false"], other["found"]) == (0.7, 3, 0, 1)
    orders["none"][0] = health_peers.Order(late, list(range(20)), 10, None, late)
    own, other = health_peers.peer_records("pad", orders)
    assert (other["setting"], other["found"]) == (0.95, 0)  # the next one would be a false alarm


def test_the_martingales_of_others_are_ours():
    values = np.random.default_rng(0).random((40, 5))
    order = health_peers.Order(values, list(range(40)), 20, None, values)
    found = health_peers.oracle_difference(order)
    assert all(difference < 1e-12 for difference in found.values())
    assert "crepes" in found or find_spec("crepes") is None


def test_each_way_of_appending_keeps_the_rows(tmp_path, monkeypatch):
    monkeypatch.setattr(appending, "ROWS", 5)
    monkeypatch.setattr(appending, "TemporaryDirectory", lambda dir: nullcontext(tmp_path))
    output, result = measured(tmp_path, "log", "--rounds", 3)
    cases = [record["case"].split(",")[0] for record in result["records"]]
    assert cases == ["SQLite", "the log", "a bare file that grows"] and "times SQLite's" in output
    assert result["rows"] == 15 and result["records"][0]["times_sqlite"] == 1.0
    with closing(sqlite3.connect(tmp_path / "rows.sqlite")) as database:
        kept = [data for (data,) in database.execute("SELECT bytes FROM row ORDER BY sequence")]
    with Log(tmp_path / "log") as log:
        rows = [log.read(frame.offset, frame.size) for batch in log.scan(refuse) for frame in batch]
    assert kept == rows and [decode_row(row)[0].sequence for row in rows] == list(range(1, 16))
    assert (tmp_path / "bare").stat().st_size == 15 * appending.ROW_BYTES


def test_the_embedding_of_vectors_keeps_the_promises_of_one():
    check_embedding(AsIs(), columns=(8,))


def test_every_learner_is_trained_and_timed_in_turns(tmp_path):
    pytest.importorskip("sklearn")
    output, found = measured(tmp_path, "interleaved", "--streams", 100, "--pairs", 10)
    assert [record["measured"] for record in found["records"]] == [True] * 5
    for record in found["records"]:
        assert 0 < record["median_milliseconds"] <= record["p99_milliseconds"]
        assert record["observe_median_milliseconds"] + record["predict_median_milliseconds"] > 0
        assert record["times_ours"] > 0
    for i, name in enumerate(("times_ours", "times_ours_in_memory")):
        assert found["records"][i][name] == pytest.approx(1)
    assert {"date", "versions", "machine", "seed"} <= found.keys()
    assert "pseudo-inverse" in output


def test_shifts_are_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(live_shift, "LEARNED", 2)
    records = measured(tmp_path, "live", "--hours", "0.01")[1]["shifts"]
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


def test_a_shift_of_anybody_s_touches():
    scene = Scene(sensor=sensors.ROBOSKIN)
    streams = [scene.touch("oak", repetition) for repetition in range(8)]
    noise, level = quiet_noise(streams), resting_level(streams)
    touches = [("oak", stream.readings) for stream in streams]
    made = shift_of(touches, sensors.ROBOSKIN, level, noise, seconds=30, lost=0, gaps=1, jitter=0.0, drift=0.0)
    assert len(made.readings) == len(made.times) == 1500
    first = int(np.searchsorted(made.times, made.touches[0].begin))
    assert np.array_equal(made.readings[first : first + 75], streams[0].readings)
    assert (np.diff(made.times) > 0.2).sum() == 1
    with pytest.raises(InputError, match="hold"):
        shift_of(touches, sensors.ROBOSKIN, level, noise, seconds=1)
