"""`scroll-tactile live`, as it is typed."""

import io
import json

import numpy as np
import pytest
from commands import APP, refused, run
from live_touches import slide
from rich.console import Console
from touches import PAD, SMALL
from typer.testing import CliRunner

from scroll_tactile import Kernels, TactileLearner, sensors
from scroll_tactile.clients.cli import everyday
from scroll_tactile.clients.cli.terminal import Reading
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.simulation.shift import simulated_shift

SCENE = Scene(sensors.ROBOSKIN)
SHIFT = simulated_shift(SCENE, ["silk", "wool"], seconds=22)


@pytest.fixture(scope="module")
def memory(tmp_path_factory):
    folder = tmp_path_factory.mktemp("live")
    with TactileLearner.open(folder / "memory", sensor=sensors.ROBOSKIN, embedding=Kernels(dimension=64)) as learner:
        for repetition in range(3):
            for name in ("silk", "wool", "oak"):
                learner.observe(name, SCENE.touch(name, repetition))
    np.save(folder / "timed.npy", np.column_stack([SHIFT.times, SHIFT.readings]))
    np.save(folder / "silk.npy", SCENE.touch("silk", 9).readings)
    return folder


def test_a_recording_is_replayed_with_its_touches(memory):
    result = run("live", memory / "memory", memory / "timed.npy", "--timed")
    assert result.exit_code == 0, result.output
    assert f"touches: {len(SHIFT.touches)}," in result.output
    assert result.output.count("touched for") == len(SHIFT.touches)


@pytest.mark.parametrize("words", [(), ("--json",)])
def test_a_file_without_a_rest_in_front_is_told_of_touch(memory, words):
    result = run("live", memory / "memory", memory / "silk.npy", *words)
    assert "no touch was found" in result.stderr and "--touch" in result.stderr
    long = np.tile(SCENE.touch("silk", 9).readings, (4, 1))
    np.save(memory / "long.npy", long)
    result = run("live", memory / "memory", memory / "long.npy", *words)
    assert json.loads(result.stdout.splitlines()[-1])["event"] == "report" if words else "touches: 0" in result.stdout
    assert "its first 2 s were taken for the sensor at rest" in " ".join(result.stderr.split())
    assert "no touch" not in run("live", memory / "memory", memory / "silk.npy", "--touch", *words).stderr


def test_times_in_a_table_are_those_of_its_column(memory):
    table, header = np.column_stack([SHIFT.readings, SHIFT.times]), ",".join([*map(str, range(60)), "time"])
    np.savetxt(memory / "timed.csv", table, delimiter=",", header=header, comments="", fmt="%.17g")
    expected = run("live", memory / "memory", memory / "timed.npy", "--timed", "--json").stdout
    assert run("live", memory / "memory", memory / "timed.csv", "--timed", "--json").stdout == expected


def test_each_thing_that_happens_is_a_line_of_json(memory):
    result = run("live", memory / "memory", memory / "timed.npy", "--timed", "--json")
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    ended = [line for line in lines if line["event"] == "ended"]
    assert [line["material"] for line in ended] == [touch.material for touch in SHIFT.touches]
    for line, touch in zip(ended, SHIFT.touches, strict=True):
        assert abs(line["at"] - touch.begin) < 0.05
    began = [line["at"] for line in lines if line["event"] == "began"]
    assert began == pytest.approx([touch.begin for touch in SHIFT.touches], abs=0.1)
    assert sum(line["event"] == "prediction" for line in lines) >= len(SHIFT.touches)
    assert lines[-1]["event"] == "report" and lines[-1]["touches"] == len(SHIFT.touches)


def test_lines_on_the_standard_input_are_one_touch(memory):
    text = "\n".join(",".join(map(str, row)) for row in SCENE.touch("silk", 9).readings)
    with TactileLearner.open(memory / "memory", mode="read") as learner:
        expected = learner.predict(SCENE.touch("silk", 9))
    words = ["live", str(memory / "memory"), "-", "--touch", "--json"]
    answer = json.loads(CliRunner().invoke(APP, words, input=text + "\n\n").stdout.splitlines()[-2])
    assert (answer["event"], answer["material"]) == ("ended", expected.material)
    assert answer["probability"] == expected.as_json()["probability"]


def test_on_a_terminal_the_answer_grows(memory, monkeypatch):
    screen = Console(file=io.StringIO(), force_terminal=True, width=80)
    monkeypatch.setattr(everyday, "console", lambda **_: screen)
    run("live", memory / "memory", memory / "silk.npy", "--touch")
    shown = screen.file.getvalue()
    assert "touched for 0.30 s" in shown and "touched for 1.50 s" in shown and "█" in shown


def test_what_cannot_be_replayed_is_one_red_line(memory, monkeypatch):
    assert "it is not there" in refused("live", memory / "memory", memory / "nothing.npy")
    np.save(memory / "narrow.npy", np.zeros((5, 3)))
    assert "(T, 60)" in refused("live", memory / "memory", memory / "narrow.npy")
    monkeypatch.setattr(everyday, "LONGEST_LINE", 400)
    row = b",".join([b"1"] * 60) + b"\n"
    for line, said in (
        (b"3,x\n" * 100, "line 1: expected 60 numbers"),
        (row + b"1" * 401, "of less than 400 characters"),
    ):
        done = CliRunner().invoke(APP, ["live", str(memory / "memory"), "-"], input=line)
        assert done.exit_code == 1 and said in " ".join(done.stderr.split())
    done = CliRunner().invoke(APP, ["live", str(memory / "memory"), "-"], input=b"0.5," + row)
    assert done.exit_code == 1 and "If the first is a time, add --timed" in " ".join(done.stderr.split())


NUMBERS = np.round(np.random.default_rng(0).normal(size=(150, 4)), 3)
TIMES = [str(i / 50) for i in range(150)]
LINES = [",".join(map(str, row)) for row in NUMBERS]
WRITTEN = {
    "commas behind": [f"{row}," for row in LINES],
    "semicolons": [row.replace(",", ";") for row in LINES],
    "decimal commas": [row.replace(",", ";").replace(".", ",") for row in LINES],
    "spaces": [row.replace(",", " ") for row in LINES],
    "tabs and a header": ["a\tb\tc\td", *(row.replace(",", "\t") for row in LINES)],
    "a header with times": ["time,a,b,c,d", *(f"{time},{row}" for time, row in zip(TIMES, LINES, strict=True))],
    "times behind": ["a,b,c,d,t [ms]", *(f"{row},{1e3 * float(t)}" for t, row in zip(TIMES, LINES, strict=True))],
}
BAD = {
    "a half first line": [LINES[5][9:], *LINES],
    "boot text": ["Booting v1.2", *LINES],
    "a lost byte": [*LINES[:80], LINES[80][:-9], *LINES[80:]],
    "no text": [*LINES[:80], "\\xff\\xfe,1", *LINES[80:]],
}


@pytest.mark.parametrize("name", [*WRITTEN, *BAD])
def test_lines_are_read_as_tables_are_and_bad_ones_left_out(monkeypatch, name):
    monkeypatch.setattr(everyday, "_lines", lambda: (f"{line}\n" for line in {**WRITTEN, **BAD}[name]))
    lines = everyday.LiveLines(4, timed=False, how=Reading())
    times, readings = zip(*lines.readings(), strict=True)
    np.testing.assert_array_equal(readings, NUMBERS)
    assert times == pytest.approx([i / 50 for i in range(150)]) if "times" in name else set(times) == {None}
    assert lines.left_out == (name in BAD)


def test_a_session_goes_on_behind_a_bad_line_which_is_counted_and_told(memory):
    rows = [",".join(f"{value:.17g}" for value in row) for row in SHIFT.readings]
    rows = ["x,x2," + ",".join("abc" * 20), "Booting", *(f"7,8,{row}" for row in rows), "7,8,9"]
    words = ["live", str(memory / "memory"), "-", "--columns", "2:62", "--json"]
    done = CliRunner().invoke(APP, words, input="\n".join(rows))
    report = json.loads(done.stdout.splitlines()[-1])
    assert done.exit_code == 0
    assert (report["readings"], report["touches"], report["left_out"]) == (len(rows) - 3, len(SHIFT.touches), 2)
    assert done.stderr.count("left out:") == 1 and "line 2: columns" in " ".join(done.stderr.split())


@pytest.mark.parametrize("option", ["--topic", "--field", "--preset", "--clock"])
def test_lines_have_no_topics_fields_or_clocks(memory, option):
    line = refused("live", memory / "memory", "-", option, "biotac")
    assert f"came {option}" in line and "standard input" in line


def test_a_revised_decision_is_called_one(tmp_path):
    random = np.random.default_rng(1)
    with TactileLearner.open(tmp_path / "m", sensor=PAD, embedding=SMALL) as made:
        for _ in range(12):
            for material in "abc":
                made.observe(material, slide(material, 50, random))
    random = np.random.default_rng(3)
    np.save(tmp_path / "t.npy", np.concatenate([slide("a", 20, random), slide("b", 30, random)]))
    words = ("live", tmp_path / "m", tmp_path / "t.npy", "--touch", "--risk", "0.3")
    shown = run(*words).stdout
    assert "revised: it was decided as a with" in shown and "1 revised" in shown
    ended = json.loads(run(*words, "--json").stdout.splitlines()[-2])
    assert (ended["event"], ended["material"], ended["revised"]) == ("ended", "b", True)
