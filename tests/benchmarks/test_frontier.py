"""The frontier of speed against error measures what it says, on touches of the simulator."""

import importlib
import json

import numpy as np
import pytest
from commands import run

from examples.benchmarks.frontier import knee, measure_frontier, run_frontier, run_peers
from examples.benchmarks.vector_peers import Ours, lacking
from scroll_tactile import sensors
from scroll_tactile.datasets import Recordings
from scroll_tactile.datasets.simulator import Scene


@pytest.fixture(scope="module")
def recordings():
    """Four materials, observed nine times, in three folds."""
    scene = Scene(sensor=sensors.BIOTAC, seed=3)
    names = [name for name in scene.materials[:4] for _ in range(9)]
    at = np.tile(np.arange(9), 4)
    streams = [scene.touch(name, int(touch)) for name, touch in zip(names, at, strict=True)]
    return Recordings("made up", sensors.BIOTAC, streams, names, at, at % 3, ordered=True)


@pytest.fixture(scope="module")
def records(recordings):
    return run_frontier(recordings, [0, 2], (64, 126))


def test_every_width_readout_and_length_is_measured_once(records):
    found = [(one["width"], one["readout"], one["length"]) for one in records]
    assert found == [
        (width, readout, length)
        for width in (64, 126)
        for readout in ("lda", "ridge")
        for length in ("0.3 s", "1 s", "all")
    ]
    for one in records:
        assert one["touches"] == 24
        assert 0 <= one["wrong"] <= 0.5  # guessing would be wrong in three of four
        assert one["predict_ms"] > 0
        assert one["predict_ms"] <= one["predict_p99_ms"]
        assert one["predict_ms"] < one["first_predict_ms"]
        assert one["observe_ms"] > 0


def test_peers_learn_the_same_vectors(recordings, monkeypatch):
    pytest.importorskip("sklearn")
    found = run_peers(recordings, 1, 0)
    named = {one["learner"]: one for one in found}
    assert len(named) == len(found) == 7
    for one in found:
        if one["measured"]:
            assert one["features"] == 252
            assert one["wrong"] <= 0.5
            assert min(one["observe_ms"], one["predict_ms"], one["fresh_ms"]) > 0
        else:
            assert one["why"] == f"{'river' if 'river' in one['learner'] else 'padasip'} is not installed"
    ours = [one for name, one in named.items() if name.startswith("ours")]
    assert all(one["measured"] for one in ours)


def test_ours_follows_between_fits_and_says_the_same():
    rng = np.random.default_rng(0)
    rows = np.clip(rng.normal(rng.random((3, 16))[np.arange(60) % 3], 0.1), 0, 1)
    following, refitting = Ours(16, 1.0), Ours(16, 0.0)
    for at, row in enumerate(rows):
        for learner in (following, refitting):
            learner.observe(at % 3, row)
        if at > 5:
            assert following.predict(rows[at - 5]) == refitting.predict(rows[at - 5])
    assert following._tracked is not None
    assert refitting._tracked is None


def test_what_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "sklearn", None)
    assert lacking("sklearn") == "scikit-learn is not installed"
    assert lacking("numpy") == ""


def made(width, wrong, touches=1000, **more):
    record = {"width": width, "wrong": wrong, "touches": touches, "predict_ms": width / 100, "observe_ms": 1.0}
    return record | {"dataset": "x", "readout": "lda", "length": "all"} | more


def test_the_knee_is_where_no_wider_one_gains_more_than_chance():
    steps = [made(64, 0.2), made(128, 0.05), made(256, 0.02), made(512, 0.018)]
    others = [made(64, 0.0, readout="ridge"), made(64, 0.0, length="1 s")]
    found = knee([*steps, *others])
    assert found["width"] == 256
    assert [step["gained_by_wider"] for step in found["steps"]] == pytest.approx([0.182, 0.032, 0.002, 0.0])
    assert found["steps"][0]["standard_error"] == pytest.approx(np.sqrt(0.2 * 0.8 / 1000))
    # With ten times as many touches the last gain is no chance any more.
    assert knee([one | {"touches": 100_000} for one in steps])["width"] == 512


def test_the_command_measures_prints_and_draws_it_all(recordings, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    command = importlib.import_module("examples.benchmarks.__main__")
    monkeypatch.setattr(command, "read", lambda *_: recordings)
    monkeypatch.setattr(command, "measure_frontier", lambda sets, **options: measure_frontier(sets[:1], **options))
    result = run(
        *("bench", "frontier", "--data", tmp_path, "--quick"),
        *("--json", tmp_path / "r.json", "--plot", tmp_path / "r.png"),
    )
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "r.json").read_text())
    assert {"frontier", "peers", "knee", "date", "versions", "machine", "seed", "load_average"} <= found.keys()
    assert found["command"] == "python -m examples.benchmarks frontier --data DATA --quick"
    assert (tmp_path / "r.png").read_bytes().startswith(b"\x89PNG")
    assert "the knee is at" in result.output
