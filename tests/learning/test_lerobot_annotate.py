"""examples/lerobot_annotate.py: a LeRobot data set written anew, with what a live session would have answered."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from live_touches import learner, shift, slide
from robot_sets import FIELD, contents, robot_set, whole
from touches import PAD, SMALL

from examples.lerobot_annotate import PREFIX, annotate, main
from scroll_tactile import TactileLearner
from scroll_tactile.errors import InputError
from scroll_tactile.recordings import read

NUMBERS = [PREFIX + name for name in ("material", "probability", "known")]
RANDOM = np.random.default_rng(5)
TOUCHED = [(f"slide {m}", slide(m, n, RANDOM).astype(np.float32)) for m, n in zip("bca", (50, 40, 60), strict=True)]


@pytest.fixture(scope="module")
def before(tmp_path_factory):
    return robot_set(tmp_path_factory.mktemp("robot") / "set", TOUCHED, files=(0, 0, 1))


@pytest.fixture(scope="module")
def after(before):
    folder = before.with_name("answered")
    annotate(learner(), before, folder, "pad")
    return folder


def test_a_frame_has_the_answer_of_a_live_session_that_knows_no_later_one(before, after):
    table, names, begin = whole(after), sorted(learner().materials), 0
    material, probability, known = (table[name].to_numpy() for name in NUMBERS)
    for _, readings in TOUCHED:
        session = learner().live(contact="manual")
        session.begin()
        for frame, reading in enumerate(readings, start=1):
            answer = session.push(reading, np.float32((frame - 1) / 50)).prediction
            if frame == len(readings):
                answer = learner().predict(readings)
            place = begin + frame - 1
            assert material[place] == (-1 if answer is None else names.index(answer.material))
            assert probability[place] == np.float32(0 if answer is None else answer.probability)
            assert known[place] == (-1 if answer is None or answer.known is None else answer.known)
        begin += len(readings)
    assert (material == -1).any() and [names[material[end - 1]] for end in (50, 90, 150)] == [*"bca"]


def test_all_else_stays_and_the_readings_are_read_to_the_bit(before, after):
    old, new, was, now = whole(before), whole(after), contents(before), contents(after)
    assert new.schema.names == [*old.schema.names, *NUMBERS]
    assert new.select(old.schema.names).equals(old, check_metadata=True)
    changed = {name for name in was if was[name] != now[name]}
    assert was.keys() == now.keys() and all(name.startswith(("data/", "meta/")) for name in changed)
    ours, theirs = read(after, field="pad"), read(before, field="pad")
    assert ours.readings.tobytes() == theirs.readings.tobytes() and ours.episodes == theirs.episodes
    assert read(after, field=NUMBERS[0]).readings[:, 0].tolist() == new[NUMBERS[0]].to_pylist()


def test_the_metadata_describe_the_answers(before, after):
    was, now = (json.loads((path / "meta/info.json").read_text()) for path in (before, after))
    features = now.pop("features")
    assert {name: features.pop(name) for name in was["features"]} == was.pop("features") and now == was
    assert [(name, about["dtype"], about["shape"]) for name, about in features.items()] == [
        (name, dtype, [1]) for name, dtype in zip(NUMBERS, ("int64", "float32", "int64"), strict=True)
    ]
    assert features[NUMBERS[0]]["info"] == {"materials": ["a", "b", "c"], "memory": learner().digest()}
    stats = json.loads((after / "meta/stats.json").read_text())
    assert stats.pop(FIELD) == json.loads((before / "meta/stats.json").read_text())[FIELD] and list(stats) == NUMBERS
    columns = {name: whole(after)[name].to_numpy().astype(np.float64) for name in NUMBERS}
    for name, column in columns.items():
        assert list(stats[name]) == ["min", "max", "mean", "std", "count"]  # those that this set keeps
        expected = [column.min(), column.max(), column.mean(), column.std(), 150]
        np.testing.assert_allclose([value[0] for value in stats[name].values()], expected, rtol=1e-12)
    theirs, ours = (pq.read_table(path / "meta/episodes/chunk-000/file-000.parquet") for path in (before, after))
    assert ours.select(theirs.schema.names).equals(theirs)
    assert ours[f"stats/{NUMBERS[0]}/min"].type == pa.list_(pa.int64())
    assert ours[f"stats/{NUMBERS[1]}/max"].to_pylist()[1] == [columns[NUMBERS[1]][50:90].max()]


def test_contacts_are_found_and_a_reading_that_is_not_finite_leaves_what_was_known(tmp_path):
    readings, places = shift("ab")
    material = annotate(learner(), robot_set(tmp_path / "s", [("two", readings)]), tmp_path / "c", "pad", contacts=True)
    names = np.array(["a", "b", "c", None])[material[NUMBERS[0]]]
    for (begin, end), name in zip(places, "ab", strict=True):
        assert {*names[begin + 25 : end]} == {name} and names[begin - 1] is None
    spoilt = slide("a", 60, np.random.default_rng(4))
    spoilt[50] = np.nan
    found = annotate(learner(), robot_set(tmp_path / "n", [("one", spoilt)]), tmp_path / "m", "pad")[NUMBERS[1]]
    assert found[50] == found[49] > 0


def test_what_is_there_is_never_written_over(before, after, tmp_path, capsys):
    for there, match in ((after, "expected a new folder"), (before / "inside", "expected a new folder")):
        with pytest.raises(InputError, match=match):
            annotate(learner(), before, there, "pad")
    with pytest.raises(InputError, match=r"has a column 'observation\.touch\.material' already"):
        annotate(learner(), after, tmp_path / "again", "pad")
    slow = robot_set(tmp_path / "slow", TOUCHED, rate=2.0)
    with pytest.raises(InputError, match="expected frames at about the sensor's 50 readings a second"):
        annotate(learner(), slow, tmp_path / "again", "pad")
    with TactileLearner.open(tmp_path / "memory", sensor=PAD, embedding=SMALL) as made:
        made.observe("a", slide("a", 50, RANDOM))
    main(before, tmp_path / "memory", tmp_path / "new", "pad")
    assert "frames have an answer" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="Error: expected a new folder"):
        main(before, tmp_path / "memory", tmp_path / "new", "pad")
    assert {path.name for path in tmp_path.iterdir()} == {"memory", "new", "slow"}
