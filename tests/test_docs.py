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
