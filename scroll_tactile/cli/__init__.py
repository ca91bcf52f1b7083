"""The command line: `scroll-tactile`, or `python -m scroll_tactile.cli`."""

from __future__ import annotations

import typer

from scroll_tactile.cli.bench import bench
from scroll_tactile.cli.composition import compose, describe
from scroll_tactile.cli.continual import continual
from scroll_tactile.cli.demo import demo
from scroll_tactile.cli.fabric import fabric
from scroll_tactile.cli.memory import inspect, observe, predict
from scroll_tactile.cli.replay import replay
from scroll_tactile.cli.reproduce import reproduce
from scroll_tactile.cli.robustness import robustness
from scroll_tactile.cli.schedules import schedules
from scroll_tactile.cli.terminal import Commands
from scroll_tactile.cli.transfer import transfer
from scroll_tactile.cli.upkeep import memory

__all__ = ["app"]

app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="A robot's memory of how things feel. It learns a material from one touch, forgets nothing, and says when "
    "it has never felt something. Start with: scroll-tactile demo",
)
for command in (demo, observe, predict, inspect, describe, compose, replay, continual, robustness, schedules):
    app.command()(command)
app.add_typer(memory, name="memory")
app.add_typer(bench, name="bench")
app.add_typer(reproduce, name="reproduce")
app.add_typer(fabric, name="fabric")
app.add_typer(transfer, name="transfer")
