"""Grades of materials never touched are told by those that were."""

import json

import numpy as np
import pytest
from commands import refused, run

from scroll_tactile import Sensor
from scroll_tactile.datasets import Recordings
from scroll_tactile.datasets.biotac_slide import GRADES, MATERIALS
from scroll_tactile.errors import InputError
from scroll_tactile.pipelines.attributes import Attributes, summary
from scroll_tactile.streams import validate

SKIN = Sensor(name="skin", channels=3, rate=50.0, low=-2.0, high=2.0, unit="N", duration=1.0)
GRADE = {f"{kind}{number}": kind for kind in range(3) for number in range(3)}
TOUCHES = 4


def touch(name, number):
    """A simulated touch: its grade is how strongly a rhythm shakes it, and its own is another."""
    rng = np.random.default_rng([number, *name.encode()])
    time = np.arange(50) / 50
    kind, own = int(name[0]), int(name[1])
    graded = (0.2 + 0.6 * kind) * np.sin(2 * np.pi * (8 * time + rng.uniform()))
    other = 0.5 * np.sin(2 * np.pi * ((3 + own) * time + rng.uniform()))
    return validate(np.stack([graded, other, graded], axis=1) + rng.normal(0, 0.05, (50, 3)), SKIN)


@pytest.fixture(scope="module")
def recordings():
    names = [name for name in GRADE for _ in range(TOUCHES)]
    numbers = np.tile(np.arange(TOUCHES), len(GRADE))
    streams = [touch(name, number) for name, number in zip(names, numbers.tolist(), strict=True)]
    return Recordings("made up", SKIN, streams, names, numbers, numbers % 2, ordered=True)


def test_grades_of_materials_never_touched(recordings, tmp_path):
    pytest.importorskip("sklearn")
    task = Attributes(recordings, {"shaking": GRADE}, dimension=64, folder=tmp_path)
    results = list(task.run())
    assert [one["part"] for one in results] == list(GRADE)
    assert {(one["learned"], one["tested"]) for one in results} == {(32, 4)}
    means = summary(results)["shaking"]
    assert means["ours"]["mean"] > 0.8
    # Of eight materials left the grade that one is missing from is never the most common.
    assert means["always"]["mean"] == 0
    assert means["ours"]["materials"] >= 7
    steps = []
    assert list(task.run(lambda *step: steps.append(step))) == results  # noted, and not done again
    assert steps == []
    with pytest.raises(InputError, match="belongs to another run"):
        list(Attributes(recordings, {"shaking": GRADE}, dimension=65, folder=tmp_path).run())


def test_grades_that_are_missing_or_all_one_are_refused(recordings):
    for grades, said in (
        ({}, "an attribute"),
        ({"a": dict.fromkeys(GRADE, 0)}, "all have one"),
        ({"a": {"00": 1}}, "'01' has none"),
    ):
        with pytest.raises(InputError, match=said):
            Attributes(recordings, grades)


def test_the_published_grades_are_of_all_twenty():
    counts = {name: [list(of.values()).count(grade) for grade in range(3)] for name, of in GRADES.items()}
    assert counts == {"stiffness": [3, 6, 11], "roughness": [8, 6, 6]}
    assert all(tuple(of) == MATERIALS for of in GRADES.values())


def test_a_folder_without_the_data_is_one_red_line(tmp_path):
    assert "Get it from github.com" in refused("fabric", "attributes", "--data", tmp_path, "--sets", "biotac-20")


def test_the_command_tells_and_writes(recordings, tmp_path, monkeypatch):
    pytest.importorskip("sklearn")
    kept = [at for at, name in enumerate(recordings.materials) if name[1] != "2" and name != "11"]
    few = Recordings(
        "made up",
        SKIN,
        [recordings.streams[at] for at in kept],
        [recordings.materials[at] for at in kept],
        recordings.repetition[kept],
        recordings.fold[kept],
        ordered=True,
    )
    monkeypatch.setattr("scroll_tactile.cli.results.load", lambda data, sensor, seed: few)
    monkeypatch.setattr("scroll_tactile.datasets.biotac_slide.GRADES", {"shaking": GRADE})
    words = ["fabric", "attributes", "--data", tmp_path, "--json", tmp_path / "out.json", "--dimension", "64"]
    told = run(*words, "--sets", "roboskin-20", "--run", tmp_path / "run")
    assert told.exit_code == 0, told.output
    assert "shaking" in told.output
    found = json.loads((tmp_path / "out.json").read_text())
    assert set(found["sets"]) == {"roboskin-20"}
    assert set(found["sets"]["roboskin-20"]["means"]["shaking"]) == {"ours", "untold", "trees", "always"}
    assert found["command"].startswith("scroll-tactile fabric attributes --data")
    assert "gelsight" in refused(*words, "--sets", "gelsight")
