"""The documentation runs: README's session, the examples, and the commands that it names."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from buckets import BUCKETS, served
from commands import run
from readme import TEXT as README
from readme import command_lines, lay_out, promised, run_session, set_up_lines

from scroll_tactile import Kernels, recipe

ROOT = Path(__file__).parents[1]


@pytest.fixture
def cheap_fits(monkeypatch):
    """Fewer features and few kept touches, where others are not asked for: a fit takes a tenth of the time."""
    monkeypatch.setitem(Kernels.__init__.__kwdefaults__, "dimension", 256)
    default = recipe.default_kept_touches
    monkeypatch.setattr(recipe, "default_kept_touches", lambda *of, **given: min(6, default(*of, **given)))


def test_the_session_gives_what_it_shows(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run_session() == 0


def test_every_python_block_is_run():
    # A block that is not a session would be shown without ever being executed.
    for block in re.findall(r"```python\n(.*?)```", README, re.DOTALL):
        assert block.startswith(">>> ")


def test_the_lines_that_set_up_are_those_that_ci_runs():
    demo, tests = set_up_lines()
    script = (ROOT / ".ci" / "run").read_text().splitlines()
    assert tests.endswith("-m pytest") and tests in script
    assert demo.endswith("scroll-tactile demo") and demo.replace(".venv", ".venv-plain") in script


@pytest.mark.parametrize("line", set_up_lines())
def test_an_old_python_is_refused_in_one_sentence_before_anything_is_made(line, tmp_path):
    old = tmp_path / "python3"
    patched = (
        "import runpy, sys; sys.version, sys.version_info = '3.10.13 (main)', (3, 10, 13); runpy.run_path(sys.argv[1])"
    )
    old.write_text(f'#!/bin/sh\ncase "$1" in -*) echo made; exit;; esac\nexec {sys.executable} -c "{patched}" "$1"\n')
    old.chmod(0o755)
    path = {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(["sh", "-c", line], cwd=ROOT, env=path, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and not done.stdout
    assert done.stderr.count("\n") == 1 and "needs Python 3.11 or newer, and python3 is 3.10.13" in done.stderr


@BUCKETS
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_every_command_line_runs_as_it_stands(tmp_path, monkeypatch, cheap_fits):
    lay_out(tmp_path)
    monkeypatch.chdir(tmp_path)
    lines = [words for words in command_lines() if words[1] != "ros2"]  # which tests/ros2 runs
    assert len(lines) >= 6
    with served("robots") as bucket:
        bucket.put("recordings", "robots/today", recursive=True)
        for words in lines:
            done = run(*words[1:])
            assert done.exit_code == 0 and promised(words, tmp_path, done.stdout), (words, done.output)


INDEX = (ROOT / "examples/README.md").read_text()
SHOWN = dict(re.findall(r"^\| \[(\w+)\]\(\1\.py\) \| .* \| `(.+)` \|$", INDEX, re.MULTILINE))
SHOWN.pop("tables")  # a program, of tests/paper/test_tables.py
TOOLS = {"lerobot_annotate": 150, "rerun_live": 120}  # their most lines; tests/learning and tests/live run them


def test_every_example_is_short_and_among_those_that_run():
    scripts = {path.stem: path for path in (ROOT / "examples").glob("*.py") if path.stem not in ("__init__", "tables")}
    assert set(scripts) == {*SHOWN, *TOOLS, "ros2_node"}  # which tests/ros2 runs
    assert all(len(path.read_text().splitlines()) <= TOOLS.get(name, 59) for name, path in scripts.items())


@pytest.mark.parametrize("name", SHOWN)
def test_examples_run(name, capsys, cheap_fits):
    runpy.run_path(str(ROOT / "examples" / f"{name}.py"), run_name="__main__")
    assert SHOWN[name] in capsys.readouterr().out


@pytest.mark.parametrize("path", ["README.md", "scroll_tactile/ARCHITECTURE.md", "examples/README.md"])
def test_pages_are_pages_and_their_links_lead_somewhere(path):
    text = (ROOT / path).read_text()
    assert len(text.encode()) <= 8192
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in link]
    assert links
    assert all(((ROOT / path).parent / link).exists() for link in links)


def test_commands_in_the_readme_exist():
    named = set(re.findall(r"scroll-tactile (\w+)", README))
    helped = subprocess.run(
        [sys.executable, "-m", "scroll_tactile.clients.cli", "--help"],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "COLUMNS": "200"},
    ).stdout
    assert named
    assert all(name in helped for name in named)
