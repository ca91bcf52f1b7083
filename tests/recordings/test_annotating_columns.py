"""Columns of LeRobot data sets that say what was measured of each touch, and what else it was."""

import json

import numpy as np
import pyarrow as pa
import pytest
from commands import refused, run
from made import RNG, TIP, lerobot

from scroll_tactile import Quantity, Sensor, TactileLearner
from scroll_tactile.clients.learning.learning import learn_sources
from scroll_tactile.clients.learning.sources import SourceOptions
from scroll_tactile.errors import FieldError, InputError
from scroll_tactile.recordings import read, resampled
from scroll_tactile.recordings.headings import Heading

EPISODE = np.repeat([0, 1, 2], 10)
WRENCH = RNG.uniform(0, 5, (30, 3)).astype(np.float32)
WRENCH[:3, 2] = np.nan
WRENCH[20:, 2] = np.nan
MORE = {
    "wrench": ("float32", pa.FixedSizeListArray.from_arrays(pa.array(WRENCH.ravel()), 3)),
    "speed": ("float64", pa.array([*np.linspace(1, 2, 10), *[None] * 20])),
    "slip": ("string", pa.array(["", "north", *["north"] * 8, *["south"] * 10, *[None] * 10])),
    "grade": ("int64", pa.array([*[3] * 20, *[None] * 10])),
    "said": ("string", pa.array(["x" * 300] * 30)),
    "two": ("string", pa.array(["a"] * 24 + ["b"] * 6)),
}
FORCE, SPEED = "force [N] 0..10 step 0.001 from observation.wrench[2]", "speed [m/s] 0..5 step 0.01"
SLIP, GRADE = "slip [label]", "grade [label]"
SENSOR = Sensor(name="tip", channels=19, rate=100, low=-5, high=5, unit="1", duration=0.1)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return str(lerobot(tmp_path_factory.mktemp("robot") / "set", **MORE))


def learned(data, *annotate):
    learner = TactileLearner(sensor=SENSOR)
    return learner, learn_sources(learner, [data], SourceOptions(field="tip", annotate=annotate))


def test_a_value_is_the_mean_over_the_touch_and_a_label_its_one_text(data, tmp_path):
    ours, done = learned(data, FORCE, SPEED, SLIP, GRADE)
    assert (done.learned.total(), done.refused) == (3, [])
    theirs = TactileLearner(sensor=SENSOR)
    for quantity in (FORCE, SPEED):
        theirs.declare(Quantity.parsed(quantity.partition(" from")[0]))
    noted = [
        ({"force": WRENCH[3:10, 2].mean(dtype=np.float64).item(), "speed": 1.5}, {"slip": "north", "grade": "3"}),
        ({"force": WRENCH[10:20, 2].mean(dtype=np.float64).item()}, {"slip": "south", "grade": "3"}),
        ({}, {}),
    ]
    for i, (values, labels) in enumerate(noted):
        name = ["slide over felt", "slide over cork"][i % 2]
        theirs.observe(name, TIP[10 * i : 10 * i + 10], values=values, labels=labels)
    assert ours.digest() == theirs.digest() and ours.quantities == theirs.quantities and ours.axes == theirs.axes


def test_the_command_line_learns_and_a_fleet_of_one_the_same(data, tmp_path):
    (tmp_path / "tip.json").write_text(SENSOR.model_dump_json())
    how = ["--sensor", tmp_path / "tip.json", "--field", "tip", "--annotate", FORCE, "--annotate", SLIP]
    for command, more in (("learn", []), ("fleet", ["--workers", 1])):
        assert run(command, tmp_path / command, data, *how, *more).exit_code == 0
    listed = [run("memory", "list", tmp_path / name, "--json").output.splitlines() for name in ("learn", "fleet")]
    ours, theirs = [[json.loads(line) for line in lines] for lines in listed]
    assert [row.get("labels") for row in ours] == [{"slip": "north"}, {"slip": "south"}, None]
    noted = [[(row.get("values"), row.get("labels")) for row in rows] for rows in (ours, theirs)]
    assert noted[0] == noted[1] and round(noted[0][1][0]["force"], 3) == round(float(WRENCH[10:20, 2].mean()), 3)
    twice = refused("learn", tmp_path / "learn", data, *how, "--annotate", "force [N]")
    assert "each quantity and axis once in --annotate; came 'force' several times" in twice


def test_a_touch_with_two_labels_is_refused_and_the_others_are_learned(data):
    _, done = learned(data, "two [label]")
    assert done.learned.total() == 2 and len(done.refused) == 1
    assert done.refused[0].source.endswith("[20:30] tip")
    assert "one label of a touch in column 'two'; came 'a', and 'b' from reading 24 on" in done.refused[0].why


@pytest.mark.parametrize(
    ("heading", "error", "match"),
    [
        ("wrench [N] 0..9 step 1", FieldError, r"3 numbers a reading; expected one.*from observation.wrench\[0\]"),
        ("wrench [N] 0..9 step 1 from wrench[7]", FieldError, "beyond its 3 columns"),
        ("slip [N] 0..9 step 1", FieldError, "'observation.slip' of .* holds string; expected numbers"),
        ("speed [label]", FieldError, "holds double; expected texts, or whole numbers"),
        ("said [label]", FieldError, "a text of 300 characters; expected labels of at most 200"),
        ("image [label]", FieldError, "holds video; expected texts"),
        ("slop [label]", FieldError, "nearest is 'observation.slip'|there are"),
        ("slip", InputError, r"expected a column as 'force \[N\]'"),
        ("force [N] 9..0 step 1", InputError, "a range whose low"),
    ],
)
def test_a_column_that_cannot_annotate_is_refused(data, tmp_path, heading, error, match):
    with pytest.raises(error, match=match):
        read(data, field="tip", annotate=[heading])


def test_a_heading_is_read_from_its_end_and_a_range_makes_a_unit_of_any_word():
    placed = Heading.parsed("force from left [N] 0..9 step 1 from wrench[2]")
    assert (placed.name, placed.column, placed.quantity.high) == ("force from left", "wrench[2]", 9.0)
    assert Heading.parsed("grip [label] 0..9 step 1").quantity.unit == "label"


def test_other_recordings_have_no_such_columns_and_none_is_resampled(data, tmp_path):
    np.save(tmp_path / "a.npy", TIP)
    with pytest.raises(InputError, match="one array without a name, and no 'slip'"):
        read(tmp_path / "a.npy", annotate=[SLIP])
    (tmp_path / "a.csv").write_text("a,b\n1,2\n3,4\n")
    with pytest.raises(InputError, match="no columns to annotate touches by; expected arrays"):
        read(tmp_path / "a.csv", annotate=[SLIP])
    with pytest.raises(InputError, match="take resample=, or annotate="):
        resampled(read(data, field="tip", annotate=[SLIP]), 50)


@pytest.mark.parametrize("kind", [pa.list_(pa.string()), pa.list_(pa.string(), 1), pa.map_(pa.string(), pa.string())])
def test_a_column_of_lists_is_no_column_of_labels(tmp_path, kind):
    value = [("a", "b")] if hasattr(kind, "key_type") else ["a"]
    path = lerobot(tmp_path / "s", notes=("string", pa.array([value] * 30, kind)))
    said = r"'observation\.notes' of .* holds (fixed_size_)?(list|map)<.*; expected texts, or whole numbers"
    with pytest.raises(FieldError, match=said):
        read(path, field="observation.tactile.tip", annotate=["slip [label] from observation.notes"])
