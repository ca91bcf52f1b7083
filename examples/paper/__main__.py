"""`python -m examples.paper`: the paper's tables and figures."""

from __future__ import annotations

from collections.abc import Callable

import typer

from examples.paper.fabric.attributes import attributes
from examples.paper.fabric.contactile import contactile
from examples.paper.fabric.letters import letters
from examples.paper.fabric.objects import gelsight
from examples.paper.fabric.quantities import quantities
from examples.paper.fabric.slides import slide
from examples.paper.runs.everything import everything
from examples.paper.studies.activation import activation
from examples.paper.studies.continual import continual
from examples.paper.studies.efficiency import efficiency
from examples.paper.studies.metrics import metrics
from examples.paper.studies.replay import replay
from examples.paper.studies.robustness import robustness
from examples.paper.studies.strengths import strengths
from examples.paper.studies.table1 import table1
from examples.paper.studies.unlearning import unlearning
from examples.paper.transfer.sensors import sensors
from examples.paper.transfer.tasks import tasks
from scroll_tactile.clients.cli.terminal import Commands

__all__ = ["app"]

app = typer.Typer(
    name="examples.paper",
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    help="Measure what the paper measured, and ours beside it, on your copy of the data; figures: RESULTS.md.",
)
STUDIES: tuple[Callable[..., None], ...] = (
    *(table1, efficiency, activation, robustness, strengths),
    *(replay, continual, metrics, unlearning),
)
for study in STUDIES:
    app.command()(study)

fabric = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    help="What a touch is made of: fabrics, letters of dots, attributes, objects; fabrics slid over otherwise.",
)
OF_FABRIC: tuple[Callable[..., None], ...] = (contactile, letters, slide, quantities, attributes, gelsight)
for study in OF_FABRIC:
    fabric.command()(study)
app.add_typer(fabric, name="fabric")

transfer = typer.Typer(cls=Commands, no_args_is_help=True, help="Train with one task or sensor, test with another.")
transfer.command()(tasks)
transfer.command()(sensors)
app.add_typer(transfer, name="transfer")

app.command(name="all")(everything)

if __name__ == "__main__":
    app(prog_name="python -m examples.paper")
