"""`evaluate` on the command line, of touches whose values and labels a table says."""

import json
import pickle

import numpy as np
import pytest
from commands import refused, run
from test_estimates import SETTINGS, felt

from scroll_tactile import TactileLearner
from scroll_tactile.clients.learning.learning import answers
from scroll_tactile.clients.learning.sources import SourceOptions

HEADING = "file,begin,end,material,force [N] 0..4 step 0.001,way [label]"
LEARNED = [(name, i) for i in range(14) for name in ("felt", "cork", "silk")]
ASKED = [(name, 60 + i) for i in range(6) for name in ("felt", "cork", "oak")]


def way(name, i):
    return ("forth", "back")[i % 2]


def written(folder, asked, heading=HEADING, force="{}"):
    """Touches in files, and their table: its path, and theirs."""
    rows, files = [heading], []
    for name, i in asked:
        touch, value = felt(name, i)
        readings = touch.readings if way(name, i) == "forth" else touch.readings[::-1]
        files.append(folder / f"{name}-{i}.npy")
        np.save(files[-1], readings)
        rows.append(f"{name}-{i}.npy,0,{len(readings) / touch.sensor.rate},{name},{force.format(value)},{way(name, i)}")
    (folder / "table.csv").write_text("\n".join(rows))
    return ["--labels", folder / "table.csv"], files


@pytest.fixture(scope="module")
def memory(tmp_path_factory):
    folder = tmp_path_factory.mktemp("values")
    TactileLearner.open(folder / "m", **SETTINGS, kept_touches=8).close()
    table, files = written(folder, LEARNED)
    assert run("learn", folder / "m", *files, *table).exit_code == 0
    return folder / "m"


def test_the_intervals_of_touches_from_a_table_are_counted(memory, tmp_path):
    table, files = written(tmp_path, ASKED)
    asked = ["evaluate", memory, *files, *table]
    measured = json.loads(run(*asked, "--json").output)["measured"]["force"]
    assert {name: own["touches"] for name, own in measured.items()} == {"learned": 12, "new": 6}
    with TactileLearner.open(memory, mode="read") as learner:
        learner.settle()
        for which, names in (("learned", ("felt", "cork")), ("new", ("oak",))):
            pairs = [
                (value, learner.estimate(np.load(file))["force"])
                for file, (name, i) in zip(files, ASKED, strict=True)
                if name in names
                for value in (felt(name, i)[1],)
            ]
            true, said = np.array([(value, own.value) for value, own in pairs]).T
            assert measured[which]["covered"] == np.mean([own.low <= value <= own.high for value, own in pairs])
            assert measured[which]["width"] == pytest.approx(np.mean([own.width for _, own in pairs]))
            assert measured[which]["mean_error"] == pytest.approx(np.abs(said - true).mean())
            assert measured[which]["r2"] == pytest.approx(
                1 - ((said - true) ** 2).sum() / ((true - true.mean()) ** 2).sum()
            )
    assert measured["learned"]["covered"] > 0.7 and measured["learned"]["unit"] == "N"
    text = " ".join(run(*asked).output.split())
    assert "force, learned materials:" in text and "in their interval, where 90.0 % are asked" in text
    assert " N wide; off by " in text and ", R² " in text


def test_a_touch_is_answered_by_its_label_on_an_axis(memory, tmp_path):
    table, files = written(tmp_path, [*ASKED, ("felt", 70)])
    (tmp_path / "table.csv").write_text((tmp_path / "table.csv").read_text().removesuffix("forth"))
    asked = ["evaluate", memory, *files, *table, "--of", "way"]
    found = json.loads(run(*asked, "--json").output)
    assert (found["of"], found["unlabelled"], found["touches"], found["never_learned"]) == ("way", 1, 18, 0)
    assert found["accuracy"] > 0.8 and "measured" not in found
    lines = run(*asked, "--csv").output.splitlines()
    assert lines[0].endswith("way,right") and len(lines) == 19
    text = " ".join(run(*asked).output.split())
    assert "touches without a label on way: 1, left out touches: 18 of 2 labels on way that it learned" in text
    assert "expected an axis that touches have labels on, out of ['way']" in refused(*asked[:-1], "wey")


def test_a_touch_that_is_encoded_once_has_the_same_answers(memory, tmp_path):
    _, files = written(tmp_path, ASKED[:3])
    with TactileLearner.open(memory, mode="read") as learner:
        observed = [(None, None), (None, ["felt", "silk"]), ("way", None), ("way", ["back"])]
        for of, scene in observed:
            for each in answers(learner, [str(file) for file in files], SourceOptions(), scene=scene, of=of):
                touch = each.touch.stream
                assert pickle.dumps(each.prediction) == pickle.dumps(learner.predict(touch, of=of, scene=scene))
                assert each.estimates == learner.estimate(touch)


def test_what_gives_no_number_says_why(memory, tmp_path):
    table, files = written(tmp_path, ASKED[:2], HEADING.replace("force [N] 0..4 step 0.001", "torque [N m]"))
    assert "torque: not declared in this memory" in run("evaluate", memory, *files, *table).output
    TactileLearner.open(tmp_path / "same", **SETTINGS).close()
    more, learned = written(tmp_path, LEARNED[:6], force="1")
    assert run("learn", tmp_path / "same", *learned, *more).exit_code == 0
    table, files = written(tmp_path, ASKED[:2])
    text = " ".join(run("evaluate", tmp_path / "same", *files, *table).output.split())
    assert "force, learned materials: 2 without a number: every sampled touch has the same value, 1" in text
