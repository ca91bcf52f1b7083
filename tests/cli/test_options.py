"""Errors speak of the options of the command that was typed, and not of Python's arguments."""

import contextvars
import json
import pickle
import re
import sqlite3

import bags
import h5py
import numpy as np
import pytest
from commands import refused, run
from rosbags.typesys import get_types_from_msg

from scroll_tactile import TactileLearner, recordings, sensors
from scroll_tactile.clients.cli import terminal
from scroll_tactile.clients.learning.sources import SourceOptions
from scroll_tactile.errors import InputError, ScrollTactileError
from scroll_tactile.results import Prediction
from scroll_tactile.settings import GONE, Settings
from scroll_tactile.simulation.scene import Scene

SCENE = Scene(sensors.BIOTAC)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Touches of 44 columns in folders by material, those of the sensor behind 25 others; one of 19."""
    folder = tmp_path_factory.mktemp("wording")
    for name in ("oak", "felt"):
        (folder / "rec" / name).mkdir(parents=True)
        readings = SCENE.touch(name, 0).readings
        np.save(folder / "rec" / name / "0.npy", np.column_stack([np.zeros((len(readings), 25)), readings]))
    np.save(folder / "touch.npy", readings)
    np.savetxt(folder / "comma.csv", 1 + readings[:3] % 9, delimiter=";", fmt="%.3f")
    text = (folder / "comma.csv").read_text().replace(".", ",")
    (folder / "comma.csv").write_text(text)
    (folder / "table.csv").write_text("file,begin,end,material\noak/0,0,2,oak\nfelt/0,1,3,felt\n")
    return folder


BIOTAC = ("--preset", "biotac", "--columns", "25:44")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("observe", "new", "oak", "touch.npy"), "say which sensor it is for: --sensor or --preset"),
        (("learn", "new", "rec"), "say which sensor it is for: --sensor or --preset"),
        (("learn", "new", "rec", *BIOTAC, "--label-by", "file", "--label", "a"), "one of --label, --label-by and"),
        (("learn", "new", "rec", *BIOTAC, "--cut", "intervals"), "--cut 'intervals' takes --labels, a table"),
        (("learn", "new", "rec", *BIOTAC, "--labels", "t.csv", "--label-topic", "x"), "give --labels or --label-topic"),
        (("fleet", "new", "rec", "--label-by", "folder"), "say which sensor it is for: --sensor or --preset"),
        (("predict", "new", "touch.npy"), "scroll-tactile observe or learn makes one"),
        (("live", "new", "touch.npy"), "scroll-tactile observe or learn makes one"),
        (("inspect", "new"), "scroll-tactile observe or learn makes one"),
        (("observe", "new", "oak", "touch.npy", "--topic", "/x", "--sensor", "biotac"), "came --topic '/x': give"),
        (("observe", "new", "oak", "rec/oak/0.npy", "--sensor", "biotac"), "taken by --columns '0:19'"),
    ],
    ids=lambda each: each[0] if isinstance(each, tuple) else "",
)
def test_an_error_names_this_commands_options(folder, monkeypatch, words, said):
    monkeypatch.chdir(folder)
    assert said in refused(*words)
    assert not (folder / "new").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ((), "taken by --columns '0:19'"),
        (("--columns", "25:44"), "give --label for all, --label-by 'folder', --label-by 'file' or --labels"),
        (("--columns", "25:50"), "columns 25:50 are not there: expected places from 0 to 43"),
        (
            ("--columns", "25:44", "--label-by", "folder", "--cut", "contact"),
            "For a file of one touch take --cut 'none'",
        ),
        (("--columns", "25:44", "--label-by", "folder", "--cut", "episodes"), "cut it by --labels, or not"),
    ],
)
def test_so_does_what_is_refused(folder, monkeypatch, options, said):
    monkeypatch.chdir(folder)
    result = run("learn", "new", "rec", "--preset", "biotac", *options)
    assert result.exit_code == 1 and said in result.stderr and result.stderr.count("refused:") == 2
    assert not (folder / "new").exists()


ABSENT = "(decimal=: from Python alone)"


@pytest.mark.parametrize(
    ("text", "argument", "said"),
    [
        ("take cut='none'", "cut", "take --cut 'none'"),
        ("material=, by='x' and by=", "material by", "--label, --label-by 'x' and --label-by"),
        ('(by="it\'s")', "by", '(--label-by "it\'s")'),
        ("or add=True, to add", "add", "or --add, to add"),
        ("pass decimal=','", "decimal", f"pass decimal=',' {ABSENT}"),
        ("there is none", "decimal", "there is none"),
        ("s3://a/by=x is not there", "by", "s3://a/by=x is not there"),
        ("a by='x'.npy is not there", None, "a by='x'.npy is not there"),
    ],
)
def test_the_arguments_that_an_error_names_are_options(text, argument, said):
    options = {"cut": "--cut", "material": "--label", "by": "--label-by", "add": "--add"}
    context = contextvars.copy_context()
    context.run(terminal._options.set, options)
    assert context.run(terminal.in_options, text, argument) == said


@pytest.mark.parametrize(
    ("made", "argument"),
    [
        (lambda: SourceOptions(material="a", by="file"), "material by intervals"),
        (lambda: SourceOptions(cut="intervals"), "cut intervals"),
        (lambda: SourceOptions(cut="none", intervals=()), "intervals cut"),
        (lambda: SourceOptions(annotate=["slip [label]"] * 2), "annotate"),
        (lambda: SourceOptions(columns="x"), "columns"),
        (lambda: SourceOptions(preset="nose"), "preset"),
        (lambda: SourceOptions(material=""), "material"),
        (lambda: recordings.read("touch.npy", topic="/x"), "topic field"),
        (lambda: recordings.read("touch.npy", labels="/x"), "labels field"),
        (lambda: recordings.read("touch.npy", annotate=["slip [label]"]), "annotate intervals"),
        (lambda: recordings.read("touch.npy", clock="/x"), "clock rate"),
        (lambda: recordings.read("touch.npy", columns="0:90"), "columns"),
        (lambda: recordings.read("comma.csv"), "decimal"),
        (lambda: recordings.read("touch.npy").stream(sensors.ROBOSKIN), "columns"),
        (lambda: recordings.touches(recordings.read("touch.npy"), "episodes"), "intervals"),
        (lambda: TactileLearner(sensor=sensors.BIOTAC, readout="x"), "readout"),
    ],
)
def test_an_error_says_which_argument_is_wrong_also_when_it_comes_from_another_process(
    folder, monkeypatch, made, argument
):
    monkeypatch.chdir(folder)
    with pytest.raises(ScrollTactileError) as raised:
        made()
    assert raised.value.argument == argument
    came = pickle.loads(pickle.dumps(raised.value))
    assert (type(came), str(came), came.argument) == (raised.type, str(raised.value), argument)


def test_topics_and_fields_that_there_are_become_options_to_copy(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for key in ("tip", "pad"):
            file[f"data/demo_0/obs/{key}"] = np.zeros((9, 19))
    assert "such as --field 'obs/pad'" in refused(
        "observe", tmp_path / "m", "a", tmp_path / "a.h5", "--sensor", "biotac"
    )


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("annotate", "data", "--memory", "m"), "annotate"),
        (("observe", "m", "oak", "t.npy", "--again"), "again"),
        (("memory", "merge", "m", "n", "--shared", "once"), "shared"),
        (("live", "m", "t.npy", "--mcap", "a.mcap"), "mcap"),
        (("live", "m", "t.npy", "--rerun", "viewer"), "rerun"),
        (("ros2", "--finger", "thumb"), "finger"),
    ],
)
def test_a_command_or_option_that_is_gone_is_told_what_replaces_it(words, name):
    result = run(*words)
    assert result.exit_code == (1 if name == "finger" else 2)
    said = " ".join(re.sub("[│╭╮╰╯─]", " ", result.stderr).split())
    assert GONE[name] in said


@pytest.mark.parametrize("name", GONE)
def test_a_setting_that_is_gone_is_told_what_replaces_it(name):
    with pytest.raises(InputError, match=re.escape(f"{name!r} is gone. {GONE[name]}")):
        Settings(**{name: 1})


def test_readmes_line_learns_wide_arrays_with_columns(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(folder)
    learned = run("learn", tmp_path / "m", "rec", *BIOTAC, "--label-by", "folder", "--json")
    assert json.loads(learned.stdout)["learned"] == {"felt": 1, "oak": 1}
    again = run("learn", tmp_path / "m", "rec/oak/0.npy", *BIOTAC, "--label", "oak", "--json")
    assert json.loads(again.stdout)["skipped"] == 1
    assert "oak" in run("predict", tmp_path / "m", "rec/oak/0.npy", "--columns", "25:44").stdout
    assert run("live", tmp_path / "m", "rec/oak/0.npy", "--columns", "25:44", "--touch").exit_code == 0


def test_a_table_cuts_what_has_no_clock_at_the_sensors_rate(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(folder)
    learned = run("learn", tmp_path / "m", "rec", *BIOTAC, "--labels", "table.csv")
    assert learned.exit_code == 0, learned.output
    listed = [json.loads(line) for line in run("memory", "list", tmp_path / "m", "--json").stdout.splitlines()]
    assert [each["source"] for each in listed] == ["rec/felt/0.npy[100:300] 25:44", "rec/oak/0.npy[0:200] 25:44"]


def test_a_decimal_comma_is_said_by_the_option_that_is_proposed(folder, monkeypatch):
    monkeypatch.chdir(folder)
    words = ("learn", "new", "comma.csv", "--sensor", "biotac", "--label", "oak")
    assert "if it is before decimals, pass --decimal ','" in run(*words).stderr
    assert "before decimals" not in run(*words, "--decimal", ",").stderr


def test_probabilities_are_written_with_six_digits():
    ranking = (("felt", 0.123456789), ("oak", 8.06e-98), ("silk", 3.0000000001e-9))
    prediction = Prediction("felt", 0.123456789, ranking, 12.3456789, True, 1.0)
    assert prediction.as_json() == {"material": "felt", "probability": 0.123457, "known": True, "novelty": 12.3457}
    assert prediction.ranking_as_json() == [["felt", 0.123457], ["oak", 0.0], ["silk", 3e-9]]
    assert prediction.ranking_as_json(1) == [["felt", 0.123457]]
    assert Prediction(None, 0.0, (), float("inf"), False, 0.0).as_json()["novelty"] is None


def test_the_definitions_that_an_error_asks_for_are_taken(tmp_path, monkeypatch):
    """A bag of ROS 2 Humble, of a driver that no preset knows."""
    store, kind = bags.typestore(2), "my/msg/Pad"
    store.register(get_types_from_msg("float32[] values", kind))
    values = np.random.default_rng(0).uniform(0, 4095, (200, 19)).astype(np.float32)
    messages = [(bags.START + i / 100, store.types[kind](row)) for i, row in enumerate(values)]
    path = bags.write(tmp_path / "b", store, {"/pad": messages}, form="db3")
    with sqlite3.connect(path / "b.db3") as base:
        base.execute("DROP TABLE message_definitions")
    words = ("b", "--sensor", "biotac", "--topic", "/pad", "--field", "values")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "FOLDER").mkdir()
    (tmp_path / "FOLDER" / "Pad.msg").write_text("float32[] values")
    for line in (("learn", "m", *words, "--label", "felt"), ("report", words[0], "page.html", *words[1:])):
        result = run(*line)
        assert result.exit_code == 1 and "Give --definitions 'FOLDER', a folder with Pad.msg" in result.stderr
        assert run(*line, "--definitions", "FOLDER").exit_code == 0
    assert "--definitions FOLDER" in (tmp_path / "page.html").read_text()
