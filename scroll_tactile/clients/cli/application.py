"""The commands, put together."""

from __future__ import annotations

from typing import Annotated

import typer

from scroll_tactile import __version__, native
from scroll_tactile.clients.cli.adapting import adapt
from scroll_tactile.clients.cli.bulk import evaluate, fleet, learn
from scroll_tactile.clients.cli.everyday import compose, describe, inspect, observe, predict
from scroll_tactile.clients.cli.replay import live
from scroll_tactile.clients.cli.robot import PASSED_ON, mcp, ros2
from scroll_tactile.clients.cli.showing import demo, report
from scroll_tactile.clients.cli.terminal import Commands
from scroll_tactile.clients.cli.upkeep import memory

__all__ = ["app"]

app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="A robot's memory of how things feel. It learns a material from one touch, forgets nothing, and says when "
    "it has never felt something. Start with: scroll-tactile demo",
)


def _show_version(requested: bool) -> None:
    if requested:
        typer.echo(f"scroll-tactile {__version__}, kernels {native.described()}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version, and exit.")
    ] = False,
) -> None:
    """Take the options that belong to no command."""


COMMANDS = (demo, observe, learn, fleet, predict, evaluate, live, inspect, describe, compose, report, mcp)
for command in COMMANDS:
    app.command()(command)
app.command(context_settings=PASSED_ON)(ros2)
memory.command()(adapt)
app.add_typer(memory, name="memory")
