"""Commands run as from a shell, for the tests of several of them."""

from typing import Any

from typer.testing import CliRunner

from examples.benchmarks.__main__ import app as benchmarks
from examples.paper.__main__ import app as paper
from scroll_tactile.clients.cli import application

APP = application()
PAPER = {command.name or command.callback.__name__ for command in paper.registered_commands}
PAPER |= {group.name for group in paper.registered_groups}


def run(*words: object) -> Any:
    first, *rest = [str(word) for word in words]
    if first == "bench":
        return CliRunner().invoke(benchmarks, rest)
    if first in PAPER:
        return CliRunner().invoke(paper, [first, *rest])
    return CliRunner().invoke(APP, [first, *rest])


def refused(*words: object) -> str:
    """The one red line of a command that must end with exit code 1."""
    result = run(*words)
    assert result.exit_code == 1, result.output
    assert "Traceback" not in result.output
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("Error: ")
    return lines[0]
