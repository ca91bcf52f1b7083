"""The tables of the texts are what the results say, and every result says what made it."""

import csv
import io
import json
import re
import shlex

import pytest
import typer

from examples.paper.__main__ import app as paper
from examples.tables import ROOMS, TEXTS, filled, made, main, read_tables, table_of
from scroll_tactile.errors import InputError

TABLES = read_tables()
RESULTS = sorted(file for room in ROOMS for file in room.glob("results/*"))


def test_the_texts_are_what_the_results_say():
    main(["--check"])


def test_every_table_that_is_described_stands_in_a_text():
    marked = re.findall(r"<!-- table: (\S+) -->", "".join(path.read_text() for path in TEXTS))
    assert set(TABLES) - set(marked) <= {"summary"}
    assert set(marked) <= set(TABLES)


def test_a_wrong_figure_is_noticed_and_mended(tmp_path):
    text = TEXTS[1].read_text()
    copy = tmp_path / "RESULTS.md"
    copy.write_text(text.replace("| 99.2 ± 0.7 |", "| 99.9 ± 0.7 |", 1))
    with pytest.raises(SystemExit, match="is not as the results say"):
        main(["--check"], [copy])
    main([], [copy])
    assert copy.read_text() == text


@pytest.fixture
def room(tmp_path):
    (tmp_path / "results").mkdir()
    shares = [{"name": "a, b", "mean": 0.5, "sd": 0.25, "none": None}, {"name": "c", "mean": 1, "sd": 0, "folds": 1}]
    (tmp_path / "results" / "one.json").write_text(json.dumps({"command": "run one", "of": shares, "all": {"x": 1500}}))
    return tmp_path


@pytest.mark.parametrize(
    ("cell", "shown"),
    [
        ("{one:of/0/mean|%}", "50.0"),
        ("{one:of/name=a, b|±}", "50.0 ± 25.0"),
        ("{one:of/name=a, b;sd=0.25|±3}", "0.500 ± 0.250"),
        ("{one:of/1|±}", "100.0"),
        ("{one:of|len} of {one:all|sum|,}", "2 of 1,500"),
        ("{one:all/x|/1000|.2f}", "1.50"),
        ("{one:all/x|*2|.0f}", "3000"),
        ("{?one:all/y}, never", ""),
        ("{one:all/y or one:of/0/none or one:all/x|.0f}", "1500"),
        ("{?one:of/0/none??–} / {one:of/0/sd}", "– / 0.25"),
    ],
)
def test_cells_show_what_they_look_up(room, cell, shown):
    table = {"head": ["x"], "rows": [[cell]], "commands": False}
    assert made("t", {"t": table}, [room]).splitlines()[2:] == [f"| {shown} |".replace("|  |", "| |")]


def test_a_row_of_each_element_and_the_commands_behind(room):
    table = {"each": "one:of", "where": "name=c", "head": ["x", "y"], "cells": ["$name", "{./mean}"]}
    table |= {"above": [["a", "b"]], "below": [["y", "z"]], "text": "{one:all/x} in all."}
    lines = made("t", {"t": table}, [room]).splitlines()
    assert lines[2:5] == ["| a | b |", "| c | 1 |", "| y | z |"]
    assert lines[5:] == ["", "1500 in all.", "", "```sh", "# one.json: time not noted", "run one", "```"]


def test_no_table_without_results_and_no_result_without_its_command_in_its_text():
    shown: dict[str, set[str]] = {"README.md": set()}
    used: dict[str, set[str]] = {}
    for text in TEXTS:
        for name in re.findall(r"<!-- table: (\S+) -->", text.read_text()):
            table = table_of(name, TABLES)
            assert table.used, name
            used.setdefault(str(text), set()).update(table.used)
            shown.setdefault(str(text), set()).update(table.used if table.commands else ())
    pages = [str(text) for text in TEXTS[1:]]
    assert [used[page] - shown[page] for page in pages] == [set(), set()]
    assert used[str(TEXTS[0])] <= set().union(*(shown[page] for page in pages))  # README sends there


def test_every_result_stands_in_a_table():
    used = {stem for name in TABLES for stem in table_of(name, TABLES).used}
    assert {path.stem for path in RESULTS if path.suffix == ".json"} - used == set()


HARD = [["**a** & b_1, 5 %", "1.0 ± 0.1"], ["`f\\*` # $ ~ ^ \\", "– → λ"]]


def test_a_table_as_csv_and_as_latex(room):
    table = {"head": ["of, which", "%"], "rows": HARD, "text": "{one:all/x}"}
    shown = made("t", {"t": table}, [room], "csv")
    assert list(csv.reader(io.StringIO(shown))) == [
        ["of, which", "%"],
        ["a & b_1, 5 %", "1.0 ± 0.1"],
        ["f* # $ ~ ^ \\", "– → λ"],
    ]
    assert made("t", {"t": table}, [room], "latex").splitlines() == [
        "% one.json: time not noted",
        "% run one",
        r"\begin{tabular}{lr}",
        r"\toprule",
        r"of, which & \% \\",
        r"\midrule",
        r"\textbf{a} \& b\_1, 5 \% & 1.0 $\pm$ 0.1 \\",
        r"\texttt{f*} \# \$ \textasciitilde{} \textasciicircum{} \textbackslash{} & -- $\rightarrow$ $\lambda$ \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_a_table_is_printed_of_ones_own_results(room, tmp_path, capsys):
    main(["table1-gelsight", "--format", "csv"])
    printed = capsys.readouterr().out
    assert printed.startswith('"percent, single GelSight frames') and "ours, counts (Frames())" in printed
    with pytest.raises(SystemExit, match=r"expected a result table1-gelsight\.json; there are one"):
        main(["table1-gelsight", "--results", str(room)])
    with pytest.raises(SystemExit, match="expected a table out of"):
        main(["no-table"])


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"head": ["x"], "rows": [["{two:x}"]]}, "expected a result two.json; there are one"),
        ({"head": ["x"], "rows": [["{one:all/y}"]]}, "expected something at {one:all/y}"),
        ({"head": ["x"], "rows": [["{one:of/name=d}"]]}, "expected something at"),
        ({"head": ["x"], "rows": [["a", "b"]]}, "expected rows of 1 cells"),
        ({"head": ["x"], "rows": [["{one:all|%}"]]}, "table 't'"),
    ],
)
def test_tables_that_cannot_be_made_are_named(room, table, message):
    with pytest.raises(InputError, match=re.escape(message)):
        made("t", {"t": table}, [room])


@pytest.mark.parametrize("text", ["<!-- table: t -->\n", "<!-- table: t -->\n<!-- table: t -->\n<!-- /table -->"])
def test_a_mark_without_an_end_is_named(room, text):
    with pytest.raises(InputError, match="/table"):
        filled(text, {"t": {"head": ["x"]}}, [room])


@pytest.mark.parametrize("path", [path for path in RESULTS if path.suffix == ".json"], ids=lambda path: path.stem)
def test_every_result_says_what_made_it_and_names_no_machine(path):
    text = path.read_text()
    made_by = json.loads(text)
    assert {"command", "seed", "versions", "date"} <= made_by.keys()
    assert made_by["command"].startswith(("python -m examples.", "python tests/faults/"))
    assert not re.search(r"/(root|work|tmp|home)/", text)


def require_command(words):
    """Raise where the paper's program has no such command, or no such option."""
    parsed = typer.main.get_command(paper)
    while words and hasattr(parsed, "commands"):
        parsed = parsed.commands[words.pop(0)]
    parsed.make_context("it", words)


@pytest.mark.parametrize("path", sorted(ROOMS[0].glob("results/*.json")), ids=lambda path: path.stem)
def test_the_noted_commands_can_be_given(path):
    for command in json.loads(path.read_text())["command"].split(" && "):
        python, m, program, *words = shlex.split(command)
        assert (python, m, program) == ("python", "-m", "examples.paper")
        require_command(words)


def test_the_results_are_small():
    assert sum(path.stat().st_size for path in RESULTS) <= 1_400_000


def test_the_map_of_the_paper_names_commands_that_can_be_given():
    named = re.findall(r"^\| .* \| \[.*\]\(#\S+\) \| `(.+)` \|$", (ROOMS[0] / "RESULTS.md").read_text(), re.MULTILINE)
    assert len(named) >= 8
    for command in named:
        require_command(command.split())
