"""Timings are medians with the 99th percentile beside them, of a memory on disk, and say what made them."""

import json
import re
from itertools import count

import pytest
from commands import refused, run

from examples.benchmarks import speed
from examples.benchmarks.before import HERE, run_before
from examples.benchmarks.timing import CLOCKS, Timing, take_turns
from scroll_tactile.errors import InputError


def test_a_timing_is_the_median_and_the_99th_percentile_of_its_calls():
    timing = Timing.of([0.001] * 98 + [0.5, 1.0])
    assert timing.median == 1.0
    assert 500 < timing.p99 < 1000
    assert timing.mean == pytest.approx(15.98)
    assert timing.record("of_") == {"of_median_milliseconds": 1.0, "of_p99_milliseconds": timing.p99}
    assert Timing.of([0.004, 0.002, 0.003], times=2).median == 1.5


def test_alternatives_take_turns_and_all_calls_count(monkeypatch):
    ticks = count()
    monkeypatch.setitem(CLOCKS, "wall", lambda: next(ticks) / 1000)
    called = []
    found = take_turns({name: lambda name=name: called.append(name) for name in "ab"}, rounds=3, warm_up=1)
    assert "".join(called) == "ab" + "aaaaabbbbb" * 3
    assert {name: (timing.calls, timing.median, timing.clock) for name, timing in found.items()} == {
        "a": (15, pytest.approx(1.0), "wall"),
        "b": (15, pytest.approx(1.0), "wall"),
    }


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(speed, "TRAIN_TOUCHES", 2)
    monkeypatch.setattr(speed, "FRESH", 2)
    monkeypatch.setattr(speed, "take_turns", lambda calls, rounds, **more: take_turns(calls, 1, **more))


def test_the_command_times_a_users_calls_on_disk(tmp_path, small):
    result = run("bench", "speed", "--observations", 1000, "--rounds", 5, "--json", tmp_path / "r.json")
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "r.json").read_text())
    assert found["command"] == "python -m examples.benchmarks speed --observations 1000 --rounds 5"
    assert str(tmp_path) not in (tmp_path / "r.json").read_text()
    assert {"load_average", "load_average_after", "versions", "date"} <= found.keys()
    cases = [re.split(", ", record["case"])[0] for record in found["records"]]
    assert cases[:3] == ["predict", "observe", "predict right after an observe"]
    assert cases[-2:] == ["observe", "predict"]
    for record in found["records"]:
        assert 0 < record["median_milliseconds"] <= record["p99_milliseconds"]
        assert record["ratio"] == pytest.approx(
            record["median_milliseconds"] / record["against_median_milliseconds"], rel=1e-4
        )
    assert {record["clock"] for record in found["records"]} == {"wall", "processor"}


def test_a_checkout_is_timed_beside_another_in_one_run():
    found = run_before(HERE.parents[1], seed=0, touches=1, pairs=2)
    assert [(one["case"], one["calls"]) for one in found] == [
        ("observe", 22),
        ("predict right after an observe", 2),
        ("predict again", 10),
    ]
    for record in found:
        assert record["ratio"] == record["median_milliseconds"] / record["before_median_milliseconds"]
        assert record["processor_ratio"] > 0


def test_a_folder_that_is_no_checkout_is_refused(tmp_path):
    with pytest.raises(InputError, match="checkout"):
        run_before(tmp_path, seed=0, touches=1, pairs=1)


def test_what_cannot_be_written_is_refused_before_anything_is_measured(tmp_path):
    assert "folder" in refused("bench", "speed", "--json", tmp_path / "none" / "n.json")
