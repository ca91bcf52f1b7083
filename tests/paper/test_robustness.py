"""The default learner on every row: resumable, by folds, beside another checkout's, and on series of other sensors."""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import refused, run
from paper_touches import PATCH, recorded, untimed

from examples.paper.readers.labelled import Recordings
from examples.paper.studies.default_learner import Checkout, answers
from examples.paper.studies.robustness_study import (
    NOVELTY,
    PERTURBED,
    SESSION,
    Robustness,
    Series,
    Simulated,
    summary,
)
from scroll_tactile.errors import InputError
from scroll_tactile.simulation.gel import Gel

HERE = Path(__file__).resolve().parents[2]
ROWS = [*PERTURBED, NOVELTY]


def few(*, ordered: bool = False) -> Recordings:
    return recorded(PATCH, materials=5, each=10, folds=5, ordered=ordered)


def test_every_row_has_its_figures_and_what_is_noted_is_read_back(tmp_path):
    def stop(what, done, of):
        if "noise-quarter" in what:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(Robustness(few(), folder=tmp_path / "run").run([0], stop))
    kept = json.loads((tmp_path / "run" / "robustness.json").read_text())["notes"]
    assert "now/noise-half/0" in kept and "now/noise-quarter/0" not in kept
    asked = []
    (resumed,) = Robustness(few(), folder=tmp_path / "run").run([0], lambda what, done, of: asked.append(what))
    assert not any("clean" in what for what in asked)
    (records,) = Robustness(few()).run([0])
    assert untimed(resumed) == untimed(records)
    assert [record["row"] for record in records] == ROWS
    assert records[0]["accuracy"] == 1 and records[0]["tested"] == 10
    assert all(0 <= record["calibration_error"] <= 1 and 0 <= record["known"] <= 1 for record in records[:-1])
    assert all(record["wrong_known"] <= 1 - record["accuracy"] + 1e-9 for record in records[:-1])
    assert 0.5 < records[-1]["novelty_auroc"] <= 1 and records[-1]["tested"] == 50
    (quick,) = Robustness(few(), folder=tmp_path / "run", quick=True).run([0])
    assert quick == resumed[:-1]
    with pytest.raises(InputError, match="another run"):
        list(Robustness(few(), seed=1, folder=tmp_path / "run").run([0]))


def test_the_session_is_successive_repetitions_where_their_order_is_known():
    sets = recorded(PATCH, materials=2, each=50, folds=5, ordered=True)
    _, session, *rotated = Robustness(sets).fits(4)
    assert [*session.tests] == [SESSION]
    last = {stream.key for _, stream in session.tests[SESSION]}
    assert last == {sets.streams[i].key for i in [*range(40, 50), *range(90, 100)]}
    assert last.isdisjoint(stream.key for _, stream in session.train)
    assert [{material for material, _ in fit.train} for fit in rotated] == [{sets.materials[50]}, {sets.materials[0]}]
    assert all(SESSION not in fit.tests for fit in Robustness(few()).fits(0))


def test_means_are_over_folds():
    figures = {"calibration_error": 0.0, "known": 1.0, "tested": 4}
    rows = [{"side": "now", "row": "clean", "fold": i, "accuracy": share} | figures for i, share in enumerate((0.5, 1))]
    assert summary(rows)["now"]["clean"]["accuracy"] == {"mean": 0.75, "sd": pytest.approx(0.125**0.5), "folds": 2}


def test_another_checkout_answers_the_same_touches():
    sets = few()
    train = [(name, stream.readings) for name, stream in zip(sets.materials[::2], sets.streams[::2], strict=True)]
    tests = {"whole": [stream.readings for stream in sets.streams[1::20]], "none": [sets.streams[3].readings[:2]]}
    said = []
    there = dict(Checkout(HERE)(sets.sensor, train, tests, lambda *progress: said.append(progress)))
    assert there == dict(answers(sets.sensor, train, tests, lambda *progress: None))
    assert ("learning", 0, 25) in said
    with pytest.raises(InputError, match="no scroll_tactile"):
        Checkout(HERE / "tests")
    with pytest.raises(InputError, match="ended with 1"):
        list(Checkout(HERE)(sets.sensor, [("", train[0][1])], tests, lambda *progress: None))


def test_simulated_sensors_are_measured_and_read_back(tmp_path):
    study = Simulated(folder=tmp_path / "run", learned=2, tested=1)
    records = list(study.run())
    assert [(record["side"], record["name"]) for record in records] == [("now", "events"), ("now", "light")]
    for record in records:
        assert {"accuracy", "calibration_error", "known", "wrong_known", "novelty_auroc"} < set(record)
        assert record["tested"] == 20
    asked = []
    assert list(study.run(lambda what, done, of: asked.append(what))) == records
    assert not asked
    learned = [{material for material, _ in fit.train} for fit in study.fits()["events"]]
    assert len(learned[0]) == 20 and len(learned[1]) == 15
    with pytest.raises(InputError, match="another run"):
        list(Simulated(1, folder=tmp_path / "run", learned=2, tested=1).run())


def made_up_series(path: Path) -> Path:
    rng = np.random.default_rng(0)
    lengths = rng.integers(20, 40, 24)
    label = np.arange(24) % 2
    touches = [
        np.sin(np.arange(n) * (1 + kind) / 3 + rng.uniform(0, 6)) for n, kind in zip(lengths, label, strict=True)
    ]
    arrays = {"lengths": lengths, "label": label, "test": np.arange(24) >= 16, "range": np.array([-1.0, 1.0])}
    readings = np.concatenate(touches).astype(np.float32)[:, None]
    np.savez(path, **{f"Waves/{part}": array for part, array in (arrays | {"readings": readings}).items()})
    return path


def test_series_have_the_split_and_range_that_they_come_with(tmp_path):
    study = Series(made_up_series(tmp_path / "series.npz"))
    fit = study.fits()["Waves"]
    assert (fit.sensor.low, fit.sensor.high, fit.sensor.rate, len(fit.train)) == (-1, 1, 100, 16)
    assert fit.sensor.duration == pytest.approx(np.median([len(stream) for _, stream in fit.train]) / 100)
    (record,) = study.run()
    assert record["name"] == "Waves" and record["tested"] == 8 and record["accuracy"] > 0.8
    (tmp_path / "text.npz").write_text("none")
    with pytest.raises(InputError, match="cannot be read"):
        Series(tmp_path / "text.npz").fits()


def test_the_command(tmp_path, monkeypatch):
    monkeypatch.setattr("examples.paper.commands.robustness_command.read", lambda dataset, data, seed: few())
    words = ("robustness", "--data", tmp_path, "--set", "roboskin-20", "--folds", "0", "--run", tmp_path / "run")
    words = (*words, "--series", made_up_series(tmp_path / "series.npz"), "--materials", 5)
    result = run(*words, "--before", HERE, "--json", tmp_path / "r.json")
    assert result.exit_code == 0, result.output
    assert "folds 0" in result.output and "AUROC" in result.output and "Waves" in result.output
    kept = json.loads((tmp_path / "r.json").read_text())
    assert kept["folds"] == {"roboskin-20": "0"} and "--before CHECKOUT" in kept["command"]
    assert kept["now"] == kept["before"]  # it is this checkout
    assert list(kept["now"]["roboskin-20"]) == ROWS
    assert kept["now"]["series"]["mean"]["accuracy"] == kept["now"]["series"]["Waves"]["accuracy"]
    assert list(kept["now"]["simulated"]) == ["events", "light"]
    assert run(*words).exit_code == 0
    assert "out of [0, 1, 2, 3, 4]" in refused(*words[:6], "7")
    assert "came 'biotac-50'" in refused(*words[:4], "biotac-50")
    assert "no such file" in refused(*words[:3], "--series", tmp_path / "none.npz")


def test_a_cameras_frames_are_refused():
    gel = Gel()
    streams = [gel.touch(name, i) for name in gel.materials[:2] for i in range(4)]
    within = np.tile(np.arange(4), 2)
    frames = Recordings("gel", streams[0].sensor, streams, [*"aaaabbbb"], within, within % 2, ordered=False)
    with pytest.raises(InputError, match="of camera 'gelsight'"):
        Robustness(frames)
    with pytest.raises(InputError, match="0 or more; came -1"):
        Robustness(few(), seed=-1)


def test_the_command_on_real_touches(real_data, tmp_path):
    words = ("robustness", "--set", "biotac-20", "--data", real_data, "--materials", 5, "--folds", 0)
    result = run(*words, "--json", tmp_path / "r.json")
    assert result.exit_code == 0, result.output
    rows = json.loads((tmp_path / "r.json").read_text())["now"]["biotac-20"]
    assert list(rows) == [*PERTURBED, SESSION, NOVELTY]
    assert rows["clean"]["accuracy"]["mean"] > 0.9
