"""Grades of materials held out are predicted from the others."""

import json

import numpy as np
import pytest
from commands import refused, run

from examples.paper.fabric.attributes_study import Attributes, summary
from examples.paper.readers.grades import read_grades
from examples.paper.readers.labelled import Recordings
from scroll_tactile import Sensor
from scroll_tactile.errors import DatasetError, InputError
from scroll_tactile.signals.stream import validate

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


def test_a_table_of_grades_is_read(tmp_path):
    table = tmp_path / "grades.csv"
    table.write_text("\ufeffmaterial, stiffness,foam\nmat1,2,0\n\nmat2, 0 ,1\n", encoding="utf-8")
    assert read_grades(table) == {"stiffness": {"mat1": 2, "mat2": 0}, "foam": {"mat1": 0, "mat2": 1}}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "cannot be read"),
        ("", "a line for each material"),
        ("material\nmat1\n", "two or more"),
        ("material,foam,foam\nmat1,1,1\n", "different names"),
        ("material,foam\nmat1,1\nmat1,0\n", "line 3"),
        ("material,foam\n,1\n", "came ''"),
        ("material,foam\nmat1,soft\n", "'soft'"),
        ("material,foam\nmat1,-1\n", "'-1'"),
        ("material,thickness\nmat1,1200\n", "from 0 to 20"),
        ("material,foam,wood\nmat1,1\n", "each of 2 columns"),
    ],
)
def test_a_table_that_says_no_grades_is_named(text, said, tmp_path):
    table = tmp_path / "grades.csv"
    if text is not None:
        table.write_text(text)
    with pytest.raises(DatasetError, match=r"grades\.csv") as raised:
        read_grades(table)
    assert said in str(raised.value)


def test_the_command_reports_and_writes(recordings, tmp_path, monkeypatch):
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
    monkeypatch.setattr("examples.paper.commands.sets.load", lambda data, sensor, seed, **more: few)
    grades = tmp_path / "grades.csv"
    grades.write_text("\n".join(["material,shaking", *(f"{name},{grade}" for name, grade in GRADE.items())]))
    words = [
        "fabric",
        "attributes",
        "--data",
        tmp_path,
        "--grades",
        grades,
        "--json",
        tmp_path / "out.json",
        "--dimension",
        "64",
    ]
    result = run(*words, "--sets", "roboskin-20", "--run", tmp_path / "run")
    assert result.exit_code == 0, result.output
    assert "shaking" in result.output
    found = json.loads((tmp_path / "out.json").read_text())
    assert set(found["sets"]) == {"roboskin-20"}
    assert set(found["sets"]["roboskin-20"]["means"]["shaking"]) == {"ours", "inferred", "trees", "always"}
    assert found["command"].startswith("python -m examples.paper fabric attributes --data")
    assert found["sets"]["roboskin-20"]["streams"] == len(kept)
    assert run(*words, "--sets", "roboskin-20", "--quick").exit_code == 0
    quick = json.loads((tmp_path / "out.json").read_text())
    assert "--quick" in quick["command"] and quick["sets"]["roboskin-20"]["streams"] < len(kept)
    assert "gelsight" in refused(*words, "--sets", "gelsight")
