"""`scroll-tactile demo`."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer
from rich.live import Live
from rich.table import Table

from scroll_tactile.cli.terminal import confusion_text, console, percent, say, verdict
from scroll_tactile.errors import InputError
from scroll_tactile.pipelines import drawing as plots
from scroll_tactile.pipelines.demo import Demo, Outcome
from scroll_tactile.recordings.arrays import read_sensor

__all__ = ["demo"]


def demo(
    memory: Annotated[
        Path | None,
        typer.Option(help="Keep the memory in this folder. Interrupt the demo, start it again, and it goes on."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the simulated materials.")] = 0,
    plot: Annotated[Path | None, typer.Option(help="Draw which material was taken for which into this PNG.")] = None,
    sensor: Annotated[str, typer.Option(help="biotac, roboskin, contactile, or a JSON file of one.")] = "biotac",
    features: Annotated[
        int, typer.Option(min=64, help="Features of the embedding: fewer than the usual 1008, which take longer.")
    ] = 504,
    materials: Annotated[int, typer.Option(hidden=True, min=2, max=20)] = 20,
    touches: Annotated[int, typer.Option(hidden=True, min=1)] = 6,
    held_out: Annotated[int, typer.Option(hidden=True, min=1)] = 4,
) -> None:
    """Ten seconds of learning: twenty simulated materials, one by one, nothing forgotten.

    After each material it is asked about touches it never felt of all materials met so far. In the end it is asked
    about materials it has never met, and about the first 0.3 s of a touch. No data is needed, and nothing is kept
    unless you give --memory.
    """
    task = Demo(
        read_sensor(sensor),
        seed,
        materials=materials,
        touches=touches,
        held_out=held_out,
        features=features,
        folder=memory,
    )
    _require_folder(plot)
    say(
        f"[bold]Simulated[/] {task.sensor.name} touches, seed {seed}: the names are only names, and nothing here is a "
        f"result.\nEach material is learned from {touches} touches and tested on {held_out} others, "
        f"with {features} features."
    )
    table = Table("#", "learned", "its own touches", "all materials so far", title="accuracy on touches never felt")
    screen = console()
    with Live(table, console=screen, refresh_per_second=10) if screen.is_terminal else nullcontext():
        outcome = task.run(
            lambda step: table.add_row(str(len(table.rows) + 1), step.material, percent(step.own), percent(step.all))
        )
    if not screen.is_terminal:
        screen.print(table)
    _report(task, outcome, plot)


def _require_folder(plot: Path | None) -> None:
    if plot is not None and not plot.absolute().parent.is_dir():
        raise InputError(f"expected --plot in a folder that exists; {plot.absolute().parent} does not")


def _report(task: Demo, outcome: Outcome, plot: Path | None) -> None:
    _show_confusions(task, outcome, plot)
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
        say(f"kept: try  scroll-tactile inspect {task.folder / 'memory'}")


def _show_confusions(task: Demo, outcome: Outcome, plot: Path | None) -> None:
    names = [step.material for step in outcome.steps]
    confusions = outcome.answers.confusions()
    counts = plots.confusion_counts(names, [task.held_out] * len(names), confusions)
    if plot is not None and plots.available():
        curve = [(at + 1, step.all) for at, step in enumerate(outcome.steps)]
        title = f"Simulated {task.sensor.name}, not a result"
        plots.draw(plot, names, counts, title=title, curve=curve)
        say(f"plot: {plot}")
    else:
        if plot is not None:
            say('[yellow]No picture: it needs matplotlib[/] (pip install "scroll-tactile\\[plots]"). As text:')
        say(confusion_text(names, counts))
    worst = "; ".join(f"{truth} taken for {said} {count}×" for truth, said, count in confusions[:3])
    say(f"[bold]worst confusions:[/] {worst or 'none'} (of {len(outcome.answers.truth)} touches)")
