"""The documentation runs: README's session, the examples, and the commands that it names."""

import doctest
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


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


SHOWN = {
    "quickstart": "known False",
    "own_sensor": "right: 3 of 3",
    "own_embedding": "right: 5 of 5",
    "own_system": "NearestMean: right",
    "camera": "refused: expected frames",
    "live": "10 of 10 touches found",
    "fleet": "the bytes of one process: True",
    "two_robots": "a slip retracted, the same bytes: True",
}


def test_every_example_is_short_and_among_those_that_run():
    scripts = {path.stem: path for path in (ROOT / "examples").glob("*.py") if path.stem not in ("__init__", "tables")}
    assert set(scripts) == {*SHOWN, "ros2_node"}  # which tests/ros2 runs
    assert all(len(path.read_text().splitlines()) < 60 for path in scripts.values())


@pytest.mark.parametrize("name", SHOWN)
def test_examples_run(name, capsys):
    runpy.run_path(str(ROOT / "examples" / f"{name}.py"), run_name="__main__")
    assert SHOWN[name] in capsys.readouterr().out


@pytest.mark.parametrize("path", ["README.md", "scroll_tactile/ARCHITECTURE.md"])
def test_pages_are_pages_and_their_links_lead_somewhere(path):
    text = (ROOT / path).read_text()
    assert len(text.encode()) <= 8192
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in link]
    assert links
    assert all(((ROOT / path).parent / link).exists() for link in links)


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
