"""Errors speak of the options of the command that was typed, and not of Python's arguments."""

import contextvars
import json
import shlex
from types import SimpleNamespace

import numpy as np
import pytest
from commands import refused, run
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from scroll_tactile import sensors
from scroll_tactile.clients.cli.application import app
from scroll_tactile.clients.cli.wording import in_options, typed
from scroll_tactile.results import Prediction
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
    np.savetxt(folder / "comma.csv", readings[:3], delimiter=";", fmt="%.1f")
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
        (("learn", "new", "rec", *BIOTAC, "--cut", "intervals"), "--cut intervals takes --labels, a table"),
        (("learn", "new", "rec", *BIOTAC, "--labels", "t.csv", "--label-topic", "x"), "give --labels or --label-topic"),
        (("fleet", "new", "rec", "--label-by", "folder"), "a new memory takes a sensor, --sensor:"),
        (("predict", "new", "touch.npy"), "scroll-tactile observe or learn makes one"),
        (("live", "new", "touch.npy"), "scroll-tactile observe or learn makes one"),
        (("inspect", "new"), "scroll-tactile observe or learn makes one"),
        (
            ("observe", "new", "oak", "touch.npy", "--topic", "/x", "--sensor", "biotac"),
            "came --topic /x: give",
        ),
        (("observe", "new", "oak", "rec/oak/0.npy", "--sensor", "biotac"), "taken by --columns 0:19"),
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
        ((), "taken by --columns 0:19"),
        (("--columns", "25:44"), "give --label for all, --label-by folder, --label-by file or --labels"),
        (("--columns", "25:50"), "columns 25:50 are not there: expected places from 0 to 43"),
        (("--columns", "25:44", "--label-by", "folder", "--cut", "contact"), "For a file of one touch take --cut none"),
        (("--columns", "25:44", "--label-by", "folder", "--cut", "episodes"), "cut it by --labels, or not"),
    ],
)
def test_so_does_what_is_refused(folder, monkeypatch, options, said):
    monkeypatch.chdir(folder)
    result = run("learn", "new", "rec", "--preset", "biotac", *options)
    assert result.exit_code == 1 and said in result.stderr and result.stderr.count("refused:") == 2
    assert not (folder / "new").exists()


@pytest.fixture
def words():
    """As if a command with these options had been typed."""
    context = contextvars.copy_context()
    names = ("topic", "columns", "field", "sensor")
    context.run(typed, [SimpleNamespace(name=name, opts=[f"--{name}"]) for name in names])
    return lambda text: context.run(in_options, text)


PIECES = st.sampled_from(
    ["topic=", "field=", "read(", "'", '"', "\\", "\\x", "\\N{", "\0", "\n", " ", "(", ")", "[", "-", "x", "é", "True"]
)
TEXT = st.text() | st.lists(PIECES).map("".join)
BY_EXAMPLE = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)


@BY_EXAMPLE
@given(TEXT)
@example('it\'s "x"')
@example("a\\")
@example("\\x")
def test_any_text_as_a_value_is_the_option_with_that_text(words, text):
    for name in ("topic", "field"):
        said = words(f"there is no {name}={text!r}: give another (sensor=)")
        assert said == f"there is no --{name} {shlex.quote(text)}: give another (--sensor)"


@BY_EXAMPLE
@given(TEXT)
@example("/tmp/a topic='\\x'.npy")
@example("/tmp/a topic='\\d'.npy")
@example("read(x, topic='\\d')")
@example("read(" + "-" * 50_000 + "1)")
def test_any_text_as_a_path_can_be_said(words, text):
    assert words(f"{text} is not there").endswith(" is not there")
    if "='" not in text and '="' not in text and "\n" not in text and "read(" not in text:
        assert words(f"{text}: give topic='it'").endswith(": give --topic it")


def test_a_path_that_looks_like_a_value_and_is_none_stays_as_it_is(words):
    for text in ("/tmp/a topic='\\x'.npy is not there", "/tmp/a topic='\\d' is not there", "a topic='a\\'"):
        assert words(text) == text


def test_a_file_of_such_a_name_is_an_error_as_any_other(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert r"topic='\x'.npy" in refused("observe", "m", "oak", r"a topic='\x'.npy", "--sensor", "biotac")


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


def test_what_no_option_can_do_is_said_to_be_pythons(folder, monkeypatch):
    monkeypatch.chdir(folder)
    result = run("learn", "new", "comma.csv", "--sensor", "biotac", "--label", "oak")
    assert "pass decimal=',' (decimal=: from Python alone)" in result.stderr


def test_a_line_of_python_becomes_options_to_copy():
    typed(_parameters("learn"))
    line = "read('a b.mcap', topic='/rh/tactile', field='tactiles[0].electrodes')"
    assert in_options(f"x has:\n{line}") == "x has:\nsuch as --topic /rh/tactile --field 'tactiles[0].electrodes'"
    assert in_options("by='folder', and s3://a/topic=x/field='y'") == "--label-by folder, and s3://a/topic=x/field='y'"
    typed(_parameters("inspect"))
    assert in_options(line) == f"{line} (topic=, field=: from Python alone)"
    assert in_options("read(__import__('os').getcwd(), topic=1)").startswith("read(__import__")


def _parameters(name):
    from typer.main import get_command

    return get_command(app).commands[name].params


def test_probabilities_are_written_with_six_digits():
    ranking = (("felt", 0.123456789), ("oak", 8.06e-98), ("silk", 3.0000000001e-9))
    prediction = Prediction("felt", 0.123456789, ranking, 12.3456789, True, 1.0)
    assert prediction.as_json() == {"material": "felt", "probability": 0.123457, "known": True, "novelty": 12.3457}
    assert prediction.ranking_as_json() == [["felt", 0.123457], ["oak", 0.0], ["silk", 3e-9]]
    assert prediction.ranking_as_json(1) == [["felt", 0.123457]]
    assert Prediction(None, 0.0, (), float("inf"), False, 0.0).as_json()["novelty"] is None
