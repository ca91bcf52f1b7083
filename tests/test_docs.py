"""The documentation runs: README's session, the examples, and the commands that it names."""

import doctest
import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from commands import run

from examples.paper.tables.tables import SECTIONS, made_from_results
from scroll_tactile.errors import InputError

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
RESULTS = ROOT / "examples" / "paper" / "results"


def test_the_session_gives_what_it_shows(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    examples = doctest.DocTestParser().get_doctest(README, {}, "README.md", "README.md", 0)
    assert len(examples.examples) > 10
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    runner.run(examples)
    assert runner.summarize(verbose=False).failed == 0


def test_every_python_block_is_run():
    # A block that is not a session would be shown without ever being executed.
    for block in re.findall(r"```python\n(.*?)```", README, re.DOTALL):
        assert block.startswith(">>> ")


def test_the_test_command_is_the_one_that_ci_runs():
    command = next(line.strip() for line in README.splitlines() if line.strip().endswith("-m pytest"))
    assert command in (ROOT / ".ci" / "run").read_text().splitlines()


@pytest.mark.parametrize("name", ["first_touch.py", "two_robots.py"])
def test_examples_run(name, capsys):
    runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
    printed = capsys.readouterr().out
    if name == "two_robots.py":
        assert "10 of 10" in printed
        assert printed.count("the same bytes: True") == 3
    else:
        assert "known False" in printed


def test_commands_in_the_readme_exist():
    named = set(re.findall(r"scroll-tactile (\w+)", README))
    helped = subprocess.run(
        [sys.executable, "-m", "scroll_tactile.cli", "--help"],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "COLUMNS": "200"},
    ).stdout
    assert named
    assert all(name in helped for name in named)


def test_the_tables_are_what_the_results_say():
    assert set(re.findall(r"<!-- ([a-z]+) -->", README)) == set(SECTIONS)
    assert made_from_results(README, RESULTS) == README
    result = run("bench", "tables", "--check", "--readme", ROOT / "README.md", "--results", RESULTS)
    assert result.exit_code == 0, result.output


def test_a_table_that_is_not_what_the_results_say_is_noticed_and_mended(tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text(README.replace("| 99.2 ± 0.7 |", "| 99.9 ± 0.7 |"))
    assert readme.read_text() != README
    result = run("bench", "tables", "--check", "--readme", readme, "--results", RESULTS)
    assert result.exit_code != 0
    assert "bench tables" in result.output
    assert run("bench", "tables", "--readme", readme, "--results", RESULTS).exit_code == 0
    assert readme.read_text() == README


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<!-- speed -->\n", "no end"),
        ("<!-- other -->\n<!-- /other -->\n", "nothing makes a section 'other'"),
        ("<!-- speed -->\n<!-- /speed -->", "expected a result in"),
    ],
)
def test_sections_that_cannot_be_made_are_named(text, said, tmp_path):
    with pytest.raises(InputError, match=said):
        made_from_results(text, tmp_path)


def test_a_result_that_lacks_something_is_named(tmp_path):
    (tmp_path / "speed.json").write_text('{"records": [{}]}')
    with pytest.raises(InputError, match="the results for the section 'speed' lack 'case'"):
        made_from_results("<!-- speed -->\n<!-- /speed -->", tmp_path)


@pytest.mark.parametrize("path", sorted(RESULTS.glob("*.json")), ids=lambda path: path.stem)
def test_every_result_says_what_made_it(path):
    assert {"seed", "versions", "date"} <= json.loads(path.read_text()).keys()
