"""`python -m examples.paper`: the paper's tables and figures."""

from __future__ import annotations

import typer

from examples.paper.commands.all_command import everything
from examples.paper.commands.continual_command import continual
from examples.paper.commands.fabric_command import fabric
from examples.paper.commands.metrics_command import metrics
from examples.paper.commands.paper_command import activation, efficiency, table1
from examples.paper.commands.replay_command import replay
from examples.paper.commands.robustness_command import robustness
from examples.paper.commands.schedules_command import schedules
from examples.paper.commands.strengths_command import strengths
from examples.paper.commands.transfer_command import transfer
from examples.paper.commands.unlearning_command import unlearning
from scroll_tactile.cli.terminal import Commands

__all__ = ["app"]

app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    help="Measure what the paper measured, and ours beside it, on your copy of the data; figures: RESULTS.md.",
)
for command in (
    table1,
    efficiency,
    activation,
    robustness,
    strengths,
    replay,
    continual,
    metrics,
    unlearning,
    schedules,
):
    app.command()(command)
app.add_typer(fabric, name="fabric")
app.add_typer(transfer, name="transfer")
app.command(name="all")(everything)

if __name__ == "__main__":
    app(prog_name="python -m examples.paper")
