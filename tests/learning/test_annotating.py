"""Answers written back into LeRobot data sets: what a robot would have known at each frame."""

import json
import os
from pathlib import Path

import live_touches
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from live_touches import slide
from robot_sets import FIELD, contents, robot_set, whole
from touches import PAD, SMALL

from scroll_tactile import Annotated, AnswerLog, Quantity, TactileLearner, annotate
from scroll_tactile.clients.learning.annotating import annotation_run, rewriting
from scroll_tactile.clients.learning.annotating.touch_columns import EVENTS
from scroll_tactile.errors import ChannelCountError, FieldError, InputError, RecordingError
from scroll_tactile.recordings import read

TOUCH = "observation.touch."
NUMBERS = [TOUCH + name for name in ("material", "probability", "known")]


def touched(seed=5, lengths=(50, 40, 60)):
    random = np.random.default_rng(seed)
    return [(f"slide {m}", slide(m, n, random).astype(np.float32)) for m, n in zip("bca", lengths, strict=True)]


@pytest.fixture(scope="module")
def learner():
    return live_touches.learner()


@pytest.fixture(scope="module")
def before(tmp_path_factory):
    return robot_set(tmp_path_factory.mktemp("robot") / "set", touched(), files=(0, 0, 1))


@pytest.fixture(scope="module")
def after(learner, before, tmp_path_factory):
    folder = tmp_path_factory.mktemp("annotated") / "out"
    return annotate(learner, before, output=folder, field="pad")


def test_a_frame_has_the_answer_of_a_live_session_that_knows_no_later_one(learner, after):
    table, names = whole(after.output), sorted(learner.materials)
    material, probability = (table[name].to_numpy() for name in NUMBERS[:2])
    begin = 0
    for _, readings in touched():
        session = learner.live(contact="manual")
        session.begin()
        for frame, reading in enumerate(readings):
            answer = session.push(reading, np.float32(frame / 50)).prediction
            if frame + 1 == len(readings):
                answer = learner.predict(readings)  # of the whole touch
            place = begin + frame
            assert material[place] == (-1 if answer is None else names.index(answer.material))
            assert probability[place] == np.float32(0 if answer is None else answer.probability)
        begin += len(readings)
    assert (material == -1).any() and {*names} == {*"abc"}
    assert [names[material[end - 1]] for end in (50, 90, 150)] == [*"bca"]


def test_later_frames_change_no_earlier_answer(learner, tmp_path):
    random = np.random.default_rng(9)
    same = slide("a", 30, random)
    tables = []
    for number, then in enumerate("bc"):
        episode = np.concatenate([same, slide(then, 30, random)])
        folder = robot_set(tmp_path / f"set{number}", [("one", episode)])
        tables.append(whole(annotate(learner, folder, field="pad").output).select([*NUMBERS, EVENTS]))
    assert tables[0][:30].equals(tables[1][:30]) and not tables[0].equals(tables[1])


def test_an_event_stands_on_the_frame_at_which_a_touch_is_decided_or_ends_without(learner, before, tmp_path):
    done = annotate(learner, before, output=tmp_path / "out", field="pad", risk=0.3)
    begin, events = 0, whole(done.output)[EVENTS].to_pylist()
    expected = {}
    for _, readings in touched():
        session = learner.live(contact="manual", risk=0.3)
        session.begin()
        states = [session.push(reading) for reading in readings]
        end = session.end().touches[0]
        first = next((i for i, state in enumerate(states) if state.decided), len(states) - 1)
        answer, how = states[first].prediction, "decided" if end.decided else "undecided"
        expected[begin + first] = [f"felt: {answer.material}, {answer.probability:.2f}, {how}"]
        if end.revised is not None:
            answer, last = end.prediction, begin + len(states) - 1
            expected[last] = [*expected.get(last, []), f"felt: {answer.material}, {answer.probability:.2f}, revised"]
        begin += len(readings)
    found = {place: [row["content"] for row in rows] for place, rows in enumerate(events) if rows}
    assert found == expected and done.events == len(expected)
    assert any(place + 1 not in (50, 90, 150) for place in found)  # one is decided before its touch ends
    row = next(rows[0] for rows in events if rows)
    del row["content"]
    assert row == {"role": "tool", "style": "interjection", "camera": None, "tool_calls": None}
    assert events.count(None) == 150 - len(found)


def test_what_was_there_stays_as_it_was(before, after):
    old, new = whole(before), whole(after.output)
    assert new.schema.names == [*old.schema.names, *NUMBERS, EVENTS]
    assert new.select(old.schema.names).equals(old, check_metadata=True)
    was, now = contents(before), contents(after.output)
    assert was.keys() == now.keys()
    changed = {name for name in was if was[name] != now[name]}
    metadata = ("info.json", "stats.json")
    frames = ("data/chunk-000/file-", "meta/episodes/chunk-000/file-")
    assert changed == {name for name in was if name.endswith(metadata) or name.startswith(frames)}
    video = "videos/observation.image/chunk-000/file-000.mp4"
    assert (before / video).samefile(after.output / video)
    for path in (before, after.output):
        groups = [pq.ParquetFile(p).num_row_groups for p in sorted(path.glob("data/*/*.parquet"))]
        assert groups == [2, 1]
    ours, theirs = read(after.output, field="pad"), read(before, field="pad")
    assert ours.readings.tobytes() == theirs.readings.tobytes() and ours.episodes == theirs.episodes


def test_the_metadata_describe_the_answers(learner, before, after):
    was, now = (json.loads((path / "meta/info.json").read_text()) for path in (before, after.output))
    features = now.pop("features")
    assert {name: features.pop(name) for name in was["features"]} == was.pop("features") and now == was
    assert list(features) == [*NUMBERS, EVENTS]
    assert [features[name]["dtype"] for name in features] == ["int64", "float32", "int64", "language"]
    assert features[NUMBERS[0]]["info"]["materials"] == ["a", "b", "c"]
    assert features[NUMBERS[0]]["info"]["memory"] == learner.digest()
    columns = {name: whole(after.output)[name].to_numpy().astype(np.float64) for name in NUMBERS}
    stats = json.loads((after.output / "meta/stats.json").read_text())
    assert stats.pop(FIELD) == json.loads((before / "meta/stats.json").read_text())[FIELD]
    assert list(stats) == NUMBERS
    for name, column in columns.items():
        assert list(stats[name]) == ["min", "max", "mean", "std", "count"]  # those that this set keeps
        expected = [column.min(), column.max(), column.mean(), column.std(), 150]
        np.testing.assert_allclose([value[0] for value in stats[name].values()], expected, rtol=1e-6, atol=1e-9)
    episodes = pq.read_table(after.output / "meta/episodes/chunk-000/file-000.parquet")
    theirs = pq.read_table(before / "meta/episodes/chunk-000/file-000.parquet")
    assert episodes.select(theirs.schema.names).equals(theirs)
    assert episodes[f"stats/{NUMBERS[0]}/min"].type == pa.list_(pa.int64())
    assert episodes[f"stats/{NUMBERS[1]}/max"].to_pylist()[1] == [columns[NUMBERS[1]][50:90].max()]


def test_equal_memories_write_equal_columns(before, after, tmp_path):
    random = np.random.default_rng(1)
    observed = [(material, slide(material, 50, random)) for _ in range(6) for material in "abc"]
    with TactileLearner.open(tmp_path / "memory", sensor=PAD, embedding=SMALL) as made:
        for touch in observed[::-1]:
            made.observe(*touch)
        written = contents(annotate(made, before, output=tmp_path / "one", field="pad").output)
    with TactileLearner.open(tmp_path / "memory", mode="read") as again:
        assert contents(annotate(again, before, output=tmp_path / "two", field="pad").output) == written
    assert contents(after.output) == written


def test_quantities_are_a_value_between_the_ends_of_its_interval(tmp_path):
    made, random = TactileLearner(sensor=PAD, embedding=SMALL), np.random.default_rng(3)
    made.declare(Quantity(name="force", unit="N", low=0.0, high=10.0, resolution=0.01))
    for i in range(60):
        made.observe("abc"[i % 3], slide("abc"[i % 3], 50, random) * (0.5 + i / 120), values={"force": i / 10})
    folder = robot_set(tmp_path / "set", touched())
    done = annotate(made, folder, field="pad", forms=("numbers",))
    table = whole(done.output)
    values = np.array(table[TOUCH + "force"].to_pylist(), np.float32)
    assert table[TOUCH + "force"].type == pa.list_(pa.float32(), 3) and EVENTS not in table.schema.names
    np.testing.assert_array_equal(values[0], [5, 0, 10])  # nothing is known yet
    estimate = made.estimate(touched()[0][1], risk=0.05)["force"]
    np.testing.assert_array_equal(values[49], np.array([estimate.value, *estimate.interval], np.float32))
    about = json.loads((done.output / "meta/info.json").read_text())["features"][TOUCH + "force"]
    assert (about["shape"], about["names"]) == ([3], ["value", "low", "high"])
    assert about["info"]["unit"] == "N"


def test_contacts_are_found_in_episodes_that_begin_at_rest(learner, tmp_path):
    readings, places = live_touches.shift("ab")
    done = annotate(learner, robot_set(tmp_path / "set", [("two", readings)]), field="pad", cut="contact")
    assert done.touches == 2 and done.events == 2
    names = np.array(["a", "b", "c", None])[whole(done.output)[NUMBERS[0]].to_numpy()]
    for (begin, end), name in zip(places, "ab", strict=True):
        assert {*names[begin + 25 : end]} == {name} and names[begin - 1] is None
    assert done.answered < len(readings) / 2


@pytest.mark.parametrize("jump", [3, -0.8])
def test_a_gap_makes_two_touches_and_what_is_not_finite_is_left_out(learner, tmp_path, jump):
    random = np.random.default_rng(4)
    readings = np.concatenate([slide("a", 40, random), slide("b", 40, random)])
    readings[60] = np.nan
    folder = robot_set(tmp_path / "set", [("one", readings)])
    path = folder / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    times = (np.arange(80) / 50 + np.where(np.arange(80) >= 40, jump, 0)).astype(np.float32)
    pq.write_table(table.set_column(table.schema.names.index("timestamp"), "timestamp", pa.array(times)), path)
    done = annotate(learner, folder, field="pad")
    material = whole(done.output)[NUMBERS[0]].to_pylist()
    assert (done.touches, done.left_out) == (2, 1)
    assert material[39] == 0 and material[40] == -1 and material[79] == 1 and material[60] == material[59]


def test_an_interrupted_call_is_resumed_by_the_same_one(learner, before, after, tmp_path, monkeypatch):
    written = []

    def interrupted(source, name, *rest):
        if len(written) == 1:
            raise KeyboardInterrupt
        written.append(name)
        return rewriting.write_data(source, name, *rest)

    monkeypatch.setattr(annotation_run, "write_data", interrupted)
    folder = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        annotate(learner, before, output=folder, field="pad")
    assert not folder.exists()
    other = live_touches.learner("own")
    with pytest.raises(InputError, match="belongs to another run"):
        annotate(other, before, output=folder, field="pad")
    done, calls = [], []
    monkeypatch.setattr(annotation_run, "write_data", lambda *how: done.append(how[1]) or rewriting.write_data(*how))
    result = annotate(learner, before, output=folder, field="pad", progress=lambda *how: calls.append(how))
    assert result == Annotated(folder, *list(vars(after).values())[1:])
    assert contents(folder) == contents(after.output) and calls[-1] == ("statistics", 2, 2)
    assert len(done) == 1 and done != written
    assert not (tmp_path / "out.annotating").exists()


def test_each_episode_has_a_log_of_a_live_sessions_states(learner, before, after, tmp_path):
    done = annotate(learner, before, output=tmp_path / "out", field="pad", forms=["numbers", "language", "mcap"])
    logs = sorted((done.output / "mcap").iterdir())
    assert [log.name for log in logs] == [f"episode_{number:06d}.mcap" for number in range(3)]
    for log, (_, readings) in zip(logs, touched(), strict=True):
        session = learner.live(contact="manual")
        session.begin()
        with AnswerLog(tmp_path / f"own-{log.name}") as own:
            for frame, reading in enumerate(readings):
                time = float(np.float32(frame / 50))
                state = session.push(reading, time)
                own.note(state if frame + 1 < len(readings) else session.end(), time)
        assert log.read_bytes() == (tmp_path / f"own-{log.name}").read_bytes()
    assert contents(done.output) == contents(after.output) | {f"mcap/{log.name}": log.read_bytes() for log in logs}
    with pytest.raises(InputError, match="has a folder 'mcap' already: replace=True"):
        annotate(learner, done.output, field="pad", in_place=True, forms=["mcap"])
    logs[1].unlink()
    again = annotate(learner, done.output, field="pad", in_place=True, forms=["mcap"], replace=True)
    assert len(list((again.output / "mcap").iterdir())) == 3 and again.frames == 150


@pytest.mark.parametrize("cut", range(5))
def test_in_place_the_data_set_is_whole_wherever_the_power_is_cut(learner, before, after, tmp_path, monkeypatch, cut):
    folder = robot_set(tmp_path / "set", touched(), files=(0, 0, 1))
    as_it_was, moved = contents(folder), []
    replace = type(folder).replace

    def cut_off(path, target):
        if annotation_run.WORK in f"{path}" and annotation_run.WORK not in f"{target}":
            moved.append(target)
            if len(moved) > cut:
                raise KeyboardInterrupt
        return replace(path, target)

    monkeypatch.setattr(type(folder), "replace", cut_off)
    with pytest.raises(KeyboardInterrupt):
        annotate(learner, folder, field="pad", in_place=True)
    assert len(moved) == cut + 1 and "info.json" not in [path.name for path in moved[:-1]]
    monkeypatch.setattr(type(folder), "replace", replace)
    done = annotate(learner, folder, field="pad", in_place=True)
    now = contents(folder)
    assert done.kept == folder / "meta.before" and not folder.with_name("set.annotating").exists()
    for name in [name for name in now if name.startswith("meta.before/")]:
        assert now.pop(name) == as_it_was[name.replace("meta.before/", "meta/")]
    assert now == contents(after.output)


def test_answers_that_are_there_give_way_only_where_asked(learner, before, after, tmp_path):
    with pytest.raises(InputError, match=r"has 'observation.touch.known' already: replace=True"):
        annotate(learner, after.output, output=tmp_path / "again", field="pad")
    again = annotate(learner, after.output, output=tmp_path / "again", field="pad", replace=True)
    assert whole(again.output).equals(whole(after.output))
    bold = annotate(learner, before, output=tmp_path / "bold", field="pad", risk=0.3)  # with events on other frames
    again = annotate(learner, bold.output, output=tmp_path / "anew", field="pad", replace=True)
    assert whole(again.output).equals(whole(after.output)) and not whole(bold.output).equals(whole(after.output))
    words = annotate(learner, after.output, output=tmp_path / "words", field="pad", replace=True, forms=["language"])
    assert whole(words.output).select(NUMBERS).equals(whole(after.output).select(NUMBERS))
    with pytest.raises(InputError, match="are answers, and no readings"):
        annotate(learner, after.output, output=tmp_path / "no", field=NUMBERS[1], replace=True)


@pytest.mark.parametrize("calls", [pa.list_(pa.string()), pa.list_(pa.struct([("type", pa.string())]))])
def test_events_of_others_stay(learner, tmp_path, calls):
    kind = pa.list_(
        pa.struct([*((n, pa.string()) for n in ("role", "content", "style", "camera")), ("tool_calls", calls)])
    )
    others = [{"role": "user", "content": "stop", "style": "interjection", "camera": None, "tool_calls": None}]
    column = pa.array([others if i % 10 == 0 else [] if i % 2 else None for i in range(150)], kind)
    about = {"dtype": "language", "shape": [1], "names": None}
    folder = robot_set(tmp_path / "set", touched(), more={EVENTS: (about, column)})
    with pytest.raises(InputError, match="has 'language_events' already"):
        annotate(learner, folder, field="pad")
    done = annotate(learner, folder, field="pad", replace=True)
    twice = annotate(learner, done.output, field="pad", replace=True)
    table = whole(done.output)
    assert table[EVENTS].type == kind and whole(twice.output).equals(table)
    for old, new in zip(column.to_pylist(), table[EVENTS].to_pylist(), strict=True):
        kept = [row for row in new or [] if row["role"] != "tool"]
        assert kept == (old or [])
    assert sum(row["role"] == "tool" for rows in table[EVENTS].to_pylist() for row in rows or []) == done.events > 0


def test_a_column_of_somebody_else_is_never_taken(learner, tmp_path):
    about = {"dtype": "float32", "shape": [1], "names": None}
    more = {NUMBERS[1]: (about, pa.array(np.zeros(150, np.float32)))}
    folder = robot_set(tmp_path / "set", touched(), more=more)
    with pytest.raises(InputError, match="that no annotation wrote"):
        annotate(learner, folder, field="pad", replace=True)
    info = json.loads((folder / "meta/info.json").read_text())
    del info["features"][NUMBERS[1]]
    (folder / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(FieldError, match=r"which meta/info.json does not name"):
        annotate(learner, folder, field="pad", replace=True)
    assert not (tmp_path / "set-annotated").exists() and not (tmp_path / "set-annotated.annotating").exists()


def test_what_does_not_fit_is_refused_and_leaves_nothing(learner, before, tmp_path):
    out = tmp_path / "out"
    cases = [
        ({"field": None}, FieldError, "expected a field to read"),
        ({"field": "nothing"}, FieldError, "nothing"),
        ({"columns": "0:1"}, ChannelCountError, "expected readings of sensor 'pad', 2 channels"),
        ({"forms": ("sounds",)}, InputError, "expected forms among numbers, language, mcap"),
        ({"cut": "none"}, InputError, "expected cut as 'episodes' or 'contact'"),
        ({"scene": ["x"]}, InputError, "x"),
        ({"output": before / "inside"}, InputError, "lies in the data set"),
        ({"output": tmp_path}, InputError, "is there already"),
        ({"in_place": True}, InputError, "give output= or in_place=True"),
        ({"clock": "nothing"}, FieldError, "has no column 'nothing'"),
    ]
    for how, error, match in cases:
        with pytest.raises(error, match=match):
            annotate(learner, before, **({"output": out, "field": "pad"} | how))
    with pytest.raises(RecordingError, match="there is no such folder"):
        annotate(learner, tmp_path / "none", output=out, field="pad")
    with pytest.raises(InputError, match="this one is empty"):
        annotate(TactileLearner(sensor=PAD, embedding=SMALL), before, output=out, field="pad")
    slow = robot_set(tmp_path / "slow", touched(), rate=2.0)
    with pytest.raises(InputError, match="these come every"):
        annotate(learner, slow, output=out, field="pad")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["slow"]


def test_a_data_set_that_changed_meanwhile_is_not_mixed(learner, tmp_path, monkeypatch):
    folder = robot_set(tmp_path / "set", touched(), files=(0, 0, 1))

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(annotation_run, "statistics_in", full)
    with pytest.raises(RecordingError, match="No space left"):
        annotate(learner, folder, field="pad")
    monkeypatch.undo()
    os.utime(folder / "data/chunk-000/file-000.parquet", (1, 1))
    with pytest.raises(InputError, match="has changed since this annotation began"):
        annotate(learner, folder, field="pad")


def test_a_full_disk_is_named_and_the_same_call_goes_on(learner, before, after, tmp_path, monkeypatch):
    sync = os.fsync

    def full(descriptor):
        if "file-001.parquet" in str(Path(f"/proc/self/fd/{descriptor}").readlink()):
            raise OSError(28, "No space left on device")
        sync(descriptor)

    monkeypatch.setattr(rewriting.os, "fsync", full)
    with pytest.raises(InputError, match=r"file-001.parquet cannot be written: No space left .* make room"):
        annotate(learner, before, output=tmp_path / "out", field="pad")
    monkeypatch.undo()
    assert contents(annotate(learner, before, output=tmp_path / "out", field="pad").output) == contents(after.output)
