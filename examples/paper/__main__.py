"""`python -m examples.paper`: the paper's tables and figures."""

from __future__ import annotations

from examples.paper.commands.continual_command import continual
from examples.paper.commands.fabric_command import fabric
from examples.paper.commands.replay_command import replay
from examples.paper.commands.reproduce import reproduce as app
from examples.paper.commands.robustness_command import robustness
from examples.paper.commands.schedules_command import schedules
from examples.paper.commands.transfer_command import transfer

__all__ = ["app"]

for command in (replay, continual, robustness, schedules):
    app.command()(command)
app.add_typer(fabric, name="fabric")
app.add_typer(transfer, name="transfer")

if __name__ == "__main__":
    app(prog_name="python -m examples.paper")
