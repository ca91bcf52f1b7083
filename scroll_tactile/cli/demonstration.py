"""`scroll-tactile demo`."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.live import Live
from rich.table import Table

from scroll_tactile.cli.terminal import confusion_text, console, percent, say, shown, verdict

if TYPE_CHECKING:
    from scroll_tactile.pipelines.demo import Demo, Outcome

__all__ = ["demo"]


def demo(
    memory: Annotated[
        Path | None,
        typer.Option(help="Keep the memory in this folder. Interrupt the demo, start it again, and it goes on."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the simulated materials.")] = 0,
    sensor: Annotated[str, typer.Option(help="biotac, roboskin, contactile, or a JSON file of one.")] = "biotac",
    features: Annotated[
        int, typer.Option(min=64, help="Features of the embedding: fewer than the usual 1008, which take longer.")
    ] = 504,
    materials: Annotated[int, typer.Option(hidden=True, min=2, max=20)] = 20,
    touches: Annotated[int, typer.Option(hidden=True, min=1)] = 6,
    held_out: Annotated[int, typer.Option(hidden=True, min=1)] = 4,
) -> None:
    """Ten seconds of learning: twenty simulated materials, one by one, nothing forgotten.

    After each material it is tested on held-out touches of all materials learned so far, and in the end on materials
    that it never learned, and on the first 0.3 s of touches. It needs no data, and keeps nothing unless you give
    --memory.
    """
    from scroll_tactile.pipelines.demo import Demo
    from scroll_tactile.sensors import read_sensor

    task = Demo(
        read_sensor(sensor),
        seed,
        materials=materials,
        touches=touches,
        held_out=held_out,
        features=features,
        folder=memory,
    )
    say(
        f"[bold]Simulated[/] {shown(task.sensor.name)} touches, seed {seed}: the names are only names, and nothing "
        f"here is a result.\nEach material is learned from {touches} touches and tested on {held_out} others, "
        f"with {features} features."
    )
    table = Table("#", "learned", "its own touches", "all materials so far", title="accuracy on touches never observed")
    screen = console()
    with Live(table, console=screen, refresh_per_second=10) if screen.is_terminal else nullcontext():
        outcome = task.run(
            lambda step: table.add_row(str(len(table.rows) + 1), step.material, percent(step.own), percent(step.all))
        )
    if not screen.is_terminal:
        screen.print(table)
    _report(task, outcome)


def _report(task: Demo, outcome: Outcome) -> None:
    _show_confusions(task, outcome)
    forgotten = outcome.forgotten()
    say(
        "[bold]forgot:[/] "
        + ("; ".join(f"{name}: {percent(then)} → {percent(now)}" for name, then, now in forgotten) or "none")
        + " (each material's accuracy right after it was learned, against now)"
    )
    name, answer = next(iter(outcome.novel.items()))
    unknown = sum(not prediction.known for prediction in outcome.novel.values())
    say(f"[bold]a material never touched[/] ({name} of another simulated scene): {verdict(answer)}")
    say(f"  of {len(outcome.novel)} such materials it calls {unknown} unknown")
    say(f"[bold]0.3 s of {outcome.short.truth[0]}:[/] {verdict(outcome.short.predictions[0])}")
    say(f"  of 0.3 s of every material it names {percent(outcome.short.accuracy)} right")
    say(f"[bold]observed now:[/] {outcome.observed} touches; [bold]digest:[/] {outcome.digest}")
    if task.folder is not None:
        say(f"kept: try  scroll-tactile inspect {shown(task.folder / 'memory')}")


def _show_confusions(task: Demo, outcome: Outcome) -> None:
    from scroll_tactile.pipelines.metrics import confusion_counts

    names = [step.material for step in outcome.steps]
    confusions = outcome.answers.confusions()
    say(confusion_text(names, confusion_counts(names, [task.held_out] * len(names), confusions)))
    worst = "; ".join(f"{truth} taken for {predicted} {count}×" for truth, predicted, count in confusions[:3])
    say(f"[bold]worst confusions:[/] {worst or 'none'} (of {len(outcome.answers.truth)} touches)")
