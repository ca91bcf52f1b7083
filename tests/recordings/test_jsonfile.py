"""JSON lines and documents, as teleoperation and loggers write them."""

import json

import numpy as np
import pytest

from scroll_tactile.errors import FieldError, RecordingError
from scroll_tactile.recordings import describe, find, iterate, read, touches

PAD = np.random.default_rng(0).normal(size=(150, 4)).round(3)
TIMES = np.arange(150) / 50
ROWS = [{"time": time, "pad": row} for time, row in zip(TIMES.tolist(), PAD.tolist(), strict=True)]
HALVES = [{"material": "felt", "data": ROWS[:75]}, {"material": "oak", "data": ROWS[75:]}]


def lines(values):
    return "\n".join(map(json.dumps, values)) + "\n"


def unitree(rows=PAD):
    """An episode as xr_teleoperate writes it, with a Dex3 hand."""
    data = [
        {
            "idx": i,
            "colors": {"color_0": f"colors/{i:06d}_color_0.jpg"},
            "states": {"left_arm": {"qpos": [0.5] * 7, "qvel": []}, "left_ee": {"qpos": [0.1] * 7}},
            "tactiles": {"left_ee": row, "right_ee": row},
            "audios": None,
        }
        for i, row in enumerate(rows.tolist())
    ]
    names = {"left_arm": ["shoulder", "elbow"], "tactile_names": []}
    return {
        "info": {"version": "1.0.0", "image": {"fps": 30.0}, "joint_names": names},
        "text": {"goal": ""},
        "data": data,
    }


@pytest.mark.parametrize(
    ("name", "text", "options", "field", "names"),
    [
        ("a.jsonl", lines(ROWS), {}, "pad", []),
        ("a.json", lines(ROWS), {}, "pad", []),
        ("a.json", json.dumps(ROWS, indent=1), {}, "pad", []),
        ("a.json", json.dumps(PAD.tolist()), {"rate": 50}, "", []),
        ("a.ndjson", lines(PAD.tolist()), {"rate": 50}, "", []),
        ("a.json", json.dumps({"time": TIMES.tolist(), "tactile": PAD.tolist()}), {}, "tactile", [None]),
        ("a.jsonl", lines({"t": i / 50, **dict(zip("abcd", row, strict=True))} for i, row in enumerate(PAD.tolist())),
         {}, "{a,b,c,d}", []),
        ("a.jsonl", lines({"left-hand": row} for row in PAD.tolist()), {"rate": 50}, "left-hand", []),
        ("a.jsonl", lines({"when": row["time"], "pad": row["pad"]} for row in ROWS), {"clock": "when"}, "pad", []),
        ("a.jsonl", lines({"stamp_ns": int(row["time"] * 1e9), "pad": row["pad"]} for row in ROWS), {}, "pad", []),
        ("a.jsonl", lines({"f": [{"v": r[:2]}, {"v": r[2:]}]} for r in PAD.tolist()), {"rate": 50}, "f[*].v", []),
        ("a.json", json.dumps(HALVES), {}, "pad", ["felt", "oak"]),
        ("a.jsonl", lines(HALVES), {"field": "pad"}, "pad", ["felt", "oak"]),
        ("a.json", json.dumps({"trials": {"a": {"label": "felt", "rows": ROWS[:75]}, "b": ROWS[75:]}}), {}, "pad",
         ["felt", None]),
        ("a.json", json.dumps([ROWS[:75], ROWS[75:]]), {}, "pad", [None, None]),
        ("a.jsonl", lines({"what": ("felt", "oak")[i > 74], **row} for i, row in enumerate(ROWS)), {"labels": "what"},
         "pad", ["felt", "oak"]),
        ("a.json", json.dumps(unitree()), {"field": "tactiles.left_ee", "clock": None}, "tactiles.left_ee", [None]),
    ],
)  # fmt: skip
def test_json_in_every_form(tmp_path, name, text, options, field, names):
    (tmp_path / name).write_text(text)
    recording = read(tmp_path / name, **options)
    np.testing.assert_array_equal(recording.readings, PAD)
    assert recording.field == field and [episode.name for episode in recording.episodes] == names
    rate = 30 if "unitree" in name or "tactiles" in field else 50
    assert recording.report.rate == pytest.approx(rate) and not recording.report.cut_off
    assert sum(len(block) for block in iterate(tmp_path / name, **options)) == 150
    assert find(tmp_path) == [tmp_path / name]


def test_lists_by_name_label_touches_where_that_is_asked_for(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps({"felt": ROWS[:75], "oak": ROWS[75:]}))
    recording = read(tmp_path / "a.json")
    assert [touch.material for touch in touches(recording, "episodes")] == [None, None]
    assert [touch.material for touch in touches(recording, "episodes", "group:1")] == ["felt", "oak"]


def test_what_there_is_is_listed_and_can_be_typed(tmp_path):
    path = tmp_path / "data.json"
    path.write_text(json.dumps(unitree()))
    with pytest.raises(FieldError, match=r"tactiles.left_ee  \[4\], 150 readings") as raised:
        read(path)
    assert "such as field='tactiles.left_ee'" in str(raised.value)
    assert {entry.field for entry in describe(path).entries} == {
        "tactiles.left_ee", "tactiles.right_ee", "states.left_arm.qpos", "states.left_ee.qpos",
    }  # fmt: skip
    assert "counted at fps, 30.0" in read(path, field="tactiles.left_ee").report.notes[0]
    with pytest.raises(RecordingError, match=r"no readings are at 'tactiles\.left_e'"):
        read(path, field="tactiles.left_e")


@pytest.mark.parametrize("indent", [None, 2])
def test_what_was_cut_off_is_read_to_its_last_whole_reading(tmp_path, indent):
    path = tmp_path / "data.json"
    whole = json.dumps(unitree(), indent=indent)
    for text in (whole[: len(whole) // 2], whole[: len(whole) // 2] + "\0" * 5000):
        path.write_text(text)
        recording = read(path, field="tactiles.left_ee")
        assert 60 < len(recording) < 90 and recording.report.cut_off
        np.testing.assert_array_equal(recording.readings, PAD[: len(recording)])
    for end in ("", "\0" * 9):
        (tmp_path / "a.jsonl").write_text(lines(ROWS)[:-9] + end)
        recording = read(tmp_path / "a.jsonl")
        assert len(recording) == 149 and recording.report.cut_off


@pytest.mark.parametrize("bad", ["Booting", '{"pad": null}', '{"pad": [1, 2]}', '"pad": [1, 2, 3, 4]}', "{}"])
def test_a_line_in_a_hundred_may_be_left_out(tmp_path, bad):
    path = tmp_path / "a.jsonl"
    text = lines(ROWS).split("\n")
    path.write_text("\n".join([*text[:40], bad, *text[40:]]))
    recording = read(path)
    assert len(recording) == 150 and recording.report.notes[0].startswith("1 of 151 rows are left out")
    assert "row 41" in recording.report.notes[0]
    path.write_text("\n".join([*text[:40], bad, bad, *text[40:]]))
    with pytest.raises(RecordingError, match="row 41"):
        read(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "there are none"),
        ('{"name": "pad", "channels": 4}', "has no numbers in it"),
        ('[{"a": [1, 2]}, {"a": [1, 2', "only 1"),
        ('[{"a": [1, 2]}, oops, {"a": [1, 2]}]', "is no JSON: Expecting value"),
        ("[" * 100_000, "cannot be read|is no JSON"),
        ('{"a": "' + "x" * 1000, "is no JSON"),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path, text, said):
    (tmp_path / "a.json").write_text(text)
    if said == "only 1":
        assert len(read(tmp_path / "a.json")) == 1
        return
    with pytest.raises(RecordingError, match=said):
        read(tmp_path / "a.json")
    assert find(tmp_path) == []


def test_tables_and_json_in_a_folder_are_found_where_they_hold_readings(tmp_path):
    np.savetxt(tmp_path / "felt.txt", PAD)
    (tmp_path / "README.txt").write_text("Four taxels, 50 Hz.\n\nMade by hand, 12 times.\n")
    (tmp_path / "labels.dat").write_text("felt 1\noak 2\n" * 9)
    (tmp_path / "pad.json").write_text('{"name": "pad", "channels": 4, "offsets": [1, 2, 3, 4, 5, 6, 7, 8, 9]}')
    (tmp_path / "oak.json").write_text(json.dumps(unitree()))
    assert find(tmp_path) == [tmp_path / "felt.txt", tmp_path / "oak.json"]
