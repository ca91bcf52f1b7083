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


def test_the_tables_come_from_the_results():
    shown = README.split("<!-- results -->")[1].split("<!-- /results -->")[0]
    for name in ("biotac-20", "roboskin-20"):
        result = json.loads((ROOT / "examples" / "results" / f"{name}.json").read_text())
        assert f"{100 * result['means']['accuracy']['mean']:.1f}" in shown
        assert {"command", "seed", "versions", "date"} <= result.keys()
    speed = json.loads((ROOT / "examples" / "results" / "speed.json").read_text())
    table = README.split("<!-- speed -->")[1].split("<!-- /speed -->")[0]
    for record in speed["records"]:
        assert f"{record['ratio']:.2f}" in table


def test_the_continual_and_vision_tables_come_from_their_results():
    shown = README.split("<!-- continual -->")[1].split("<!-- /continual -->")[0]
    for name in ("biotac-20", "roboskin-20"):
        result = json.loads((ROOT / "examples" / "results" / f"{name}-continual.json").read_text())
        for row in result["means"]:
            if row["method"] in ("f", "streaming LDA") or (row["method"], row["size"]) == ("f*", "400"):
                assert f"{100 * row['accuracy']['mean']:.1f} ± {100 * row['accuracy']['sd']:.1f}" in shown
        assert {"command", "seed", "versions", "date"} <= result.keys()
        sizes = README.split("<!-- buffers -->")[1].split("<!-- /buffers -->")[0]
        for row in result["means"] if f"{'BioTac' if name[0] == 'b' else 'RoboSkin'}-20: f" in sizes else ():
            if row["size"] not in (None, "0"):
                assert f"{100 * row['accuracy']['mean']:.1f}" in sizes
    vision = json.loads((ROOT / "examples" / "results" / "vision.json").read_text())
    table = README.split("<!-- vision -->")[1].split("<!-- /vision -->")[0]
    for record in vision["records"]:
        if "400" in record["image"]:
            assert f"| {record['case']} | {record['milliseconds']:.1f} | {record['ratio']:.2f} |" in table
