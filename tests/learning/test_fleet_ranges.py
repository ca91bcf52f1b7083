"""Readings that do not fit their sensor's range: a fleet says what one process says."""

import json
import warnings

import numpy as np
import pytest
from commands import run as command
from scroll_tactile_store import StoreFullError
from test_fleet import BY_FOLDER, TOUCHES, full, run, touch_files
from touches import PAD, SETTINGS

from scroll_tactile import TactileLearner
from scroll_tactile.clients.learning import learning, steps
from scroll_tactile.clients.learning.sources import find_sources
from scroll_tactile.errors import RangeWarning

__all__ = ["full"]  # a fixture


@pytest.fixture
def beyond(tmp_path):
    """A folder of six different touches, all of their values above the pad's range."""
    for number, name in enumerate("abcabc"):
        path = tmp_path / "in" / name / f"{number}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.random.default_rng(number).uniform(5, 9, (60, 2)).astype(np.float32))
    return tmp_path / "in"


def test_it_says_and_refuses_what_one_process_does(tmp_path, beyond):
    with (
        pytest.warns(RangeWarning) as first,
        TactileLearner.open(tmp_path / "one", **SETTINGS) as learner,
    ):
        one = learning.learn_sources(learner, find_sources([str(beyond)])[0], BY_FOLDER)
    with pytest.warns(RangeWarning, match="100 % of the values lie outside the range of sensor 'pad'") as met:
        done = run(tmp_path / "m", [beyond])
    assert [str(each.message) for each in met] == [str(each.message) for each in first] == [done.range_problem]
    assert met[0].filename == run.__code__.co_filename
    assert [(each.source, each.why) for each in done.refused] == [(each.source, each.why) for each in one.refused]
    assert (done.observations, done.repeated, len(done.refused)) == (1, 1, 4)
    for each in done.refused:
        assert "all its values lie outside the sensor's range" in each.why and "relabel" not in each.why
        assert "as 'a' and not as" in each.why and "low and high" in each.why


def test_it_is_of_the_first_source_whatever_the_workers_and_said_also_after_a_cut(tmp_path, beyond, monkeypatch, full):
    paths = touch_files(tmp_path / "sound", TOUCHES[:2])
    np.save(beyond / "b" / "4.npy", np.linspace(0.2, 9, 120).reshape(60, 2))
    sources = [*paths, beyond / "b" / "4.npy", beyond]
    monkeypatch.setattr(steps, "MOST_SOURCES", 2)
    full(0)
    with pytest.raises(StoreFullError):
        run(tmp_path / "m", sources)
    full(None)
    with pytest.warns(RangeWarning, match="91 % of the values"):
        run(tmp_path / "m", sources)


def test_a_range_that_fits_is_not_spoken_of(tmp_path):
    touch_files(tmp_path / "in", TOUCHES[:2])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert run(tmp_path / "m", [tmp_path / "in"]).range_problem is None


def test_the_command_line_says_it_as_one_line(tmp_path, beyond):
    (tmp_path / "pad.json").write_text(PAD.model_dump_json())
    words = [beyond, "--sensor", tmp_path / "pad.json", "--label-by", "folder", "--json"]
    told = [
        command(name, tmp_path / name, *words, *more) for name, more in (("learn", ()), ("fleet", ("--workers", 1)))
    ]
    for result in told:
        assert result.stderr.startswith("Warning: 100 % of the values lie") and len(result.stderr.splitlines()) == 1
    assert told[0].stderr == told[1].stderr
    refused = [json.loads(result.stdout)["refused"] for result in told]
    assert refused[0] == refused[1] and len(refused[0]) == 4
