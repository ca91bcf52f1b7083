"""A sensor is guessed from recordings of it, and what is guessed learns them."""

import json

import numpy as np
import pytest
from commands import run

from scroll_tactile.errors import ChannelCountError, InputError
from scroll_tactile.recordings import read
from scroll_tactile.recordings.guessing import guessed_sensor
from scroll_tactile.sensors import Sensor

RNG = np.random.default_rng(0)


@pytest.fixture
def guess(tmp_path):
    def guessed(*arrays, header="", rate=None):
        paths = []
        for number, rows in enumerate(arrays):
            paths.append(tmp_path / f"{number}.csv")
            table = rows if rate is None else np.column_stack([np.arange(len(rows)) / rate, rows])
            head = header if rate is None else f"time,{header}"
            np.savetxt(paths[-1], table, delimiter=",", header=head, comments="", fmt="%.9g")
        return guessed_sensor([read(path) for path in paths])

    return guessed


@pytest.mark.parametrize(
    ("rows", "header", "rate", "fields", "said"),
    [
        (RNG.uniform(103, 396, (200, 2)), "a,b", 49.98, {"rate": 50, "low": 100, "high": 400, "duration": 4}, "sure"),
        (RNG.uniform(0, 1, (200, 2)), "a [N],b [N]", None, {"rate": 100, "unit": "N"}, "no recording has times"),
        (RNG.uniform([0, 900], [1, 901], (200, 2)), "a,b", 20, {"low": (0, 900), "high": (1, 901)}, "its own"),
        (RNG.uniform(0, 1, (4000, 2)), "a,b", 50, {"duration": 80}, "unsure: they may hold several touches"),
        (np.where(RNG.random((99, 2)) < 0.1, np.nan, RNG.random((99, 2))), "a,b", 50, {"non_finite": "missing"}, "NaN"),
    ],
)  # fmt: skip
def test_each_field_is_guessed_with_how_sure(guess, rows, header, rate, fields, said):
    sensor, sentences = guess(rows, header=header, rate=rate)
    assert {name: getattr(sensor, name) for name in fields} == fields
    assert (sensor.channels, sensor.columns) == (2, tuple(header.split(",")))
    assert any(said in sentence for sentence in sentences) and len(sentences) >= 7
    assert Sensor.model_validate_json(sensor.model_dump_json(exclude_defaults=True)).columns == sensor.columns


def test_what_cannot_be_guessed_is_said(guess):
    with pytest.raises(InputError, match="there are none"):
        guessed_sensor([])
    with pytest.raises(InputError, match="nothing moves"):
        guess(np.full((50, 3), 7.0), header="a,b,c")
    with pytest.raises(ChannelCountError, match=r"several shapes: \(3,\) in .*0\.csv; \(2,\) in .*1\.csv"):
        guess(RNG.random((50, 3)), RNG.random((50, 2)), header="")


def test_the_command_prints_what_learn_takes(tmp_path):
    for name, number in (("felt", 1), ("felt", 2), ("oak", 5)):
        (tmp_path / "in" / name).mkdir(parents=True, exist_ok=True)
        rows = np.column_stack([np.arange(150) / 50, 200 + 50 * np.sin(np.arange(150)[:, None] * [number, 2, 3])])
        np.savetxt(tmp_path / "in" / name / f"{number}.csv", rows, delimiter=",", header="t,a,b,c", comments="")
    result = run("sensor", tmp_path / "in")
    assert json.loads(result.stdout)["columns"] == ["a", "b", "c"] and "rate: 50 Hz, sure" in result.stderr
    words = ("learn", tmp_path / "m", tmp_path / "in", "--label-by", "folder")
    assert "`scroll-tactile sensor FILES > sensor.json` guesses it" in run(*words).stderr
    (tmp_path / "my.json").write_text(result.stdout)
    assert run(*words, "--sensor", tmp_path / "my.json").exit_code == 0
    assert run("sensor", tmp_path / "none").exit_code == 1
