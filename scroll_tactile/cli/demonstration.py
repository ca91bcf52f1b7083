"""`scroll-tactile demo`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scroll_tactile.cli.terminal import percent, progress_bar, say, shown, verdict

if TYPE_CHECKING:
    from scroll_tactile.pipelines.demo import Demo, Outcome
    from scroll_tactile.pipelines.unplugged import Unplugged

__all__ = ["demo"]


def demo(
    memory: Annotated[
        Path | None,
        typer.Option(help="Keep the memory in this folder. Interrupt the demo, start it again, and it goes on."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the simulated materials.")] = 0,
    sensor: Annotated[str, typer.Option(help="biotac, roboskin, contactile, or a JSON file of one.")] = "biotac",
    features: Annotated[int, typer.Option(min=64, help="Features of the embedding: fewer than the usual 1008.")] = 504,
    materials: Annotated[int, typer.Option(hidden=True, min=2, max=20)] = 12,
    touches: Annotated[int, typer.Option(hidden=True, min=1)] = 6,
    held_out: Annotated[int, typer.Option(hidden=True, min=1)] = 4,
) -> None:
    """Ten seconds of learning: simulated materials, unknown first, then learned, and none forgotten.

    When half of them are learned, it is asked for touches of the others, which it has never felt; in the end for all,
    and for the first 0.3 s of touches; and a process that learns is killed. It needs no data, and keeps nothing unless
    you give --memory.
    """
    from scroll_tactile.pipelines.demo import Demo
    from scroll_tactile.pipelines.unplugged import pull_the_plug
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
        "here is a result."
    )
    learned: list[str] = []
    with progress_bar() as progress:

        def report(name: str) -> None:
            learned.append(name)
            progress(f"learned {name}", len(learned), materials)

        outcome = task.run(report)
        progress("a process is killed while it learns", len(learned), materials)
        plug = pull_the_plug(task.sensor, seed)
    _report(task, outcome, learned, plug)


def _report(task: Demo, outcome: Outcome, learned: list[str], plug: Unplugged) -> None:
    half, middle, answers, short = outcome.half, max(1, len(learned) // 2), outcome.answers, outcome.short
    first, others = learned[:middle], learned[middle:]
    say(f"[bold]learned[/] {len(first)} materials, {task.touches} touches of each: {', '.join(first)}")
    said = "never felt this" if half.known is False else f"known, as {half.nearest}"
    say(
        f"[bold]unknown is called unknown:[/] {half.material}, before it was learned: [bold yellow]{said}[/] "
        f"(nearest is {half.nearest}, novelty {half.novelty:.1f})"
    )
    say(f"  of {half.asked} touches of materials that it had never felt it called {half.unknown} unknown")
    say(f"[bold]then learned[/] {len(others)} more, {task.touches} touches of each: {', '.join(others)}")
    say(f"[bold]learned from {task.touches} touches:[/] {half.material}: {verdict(answers.predictions[outcome.first])}")
    say(f"  of {len(answers.truth)} touches held out, of all materials, it names {percent(answers.accuracy)} right")
    say(
        f"[bold]forgets nothing:[/] the first {len(first)} were named {percent(half.right)} right before the others "
        f"came, and {percent(outcome.still_right)} after"
    )
    say(f"[bold]answers from 0.3 s on:[/] 0.3 s of {short.truth[0]}: {verdict(short.predictions[0])}")
    say(f"  of 0.3 s of a touch of every material it names {percent(short.accuracy)} right")
    bits = "the very bits of a memory that nothing interrupted" if plug.same else "[bold red]not as it was[/]"
    say(
        f"[bold]survives the power plug:[/] a process was killed when it had said that {plug.acknowledged} touches "
        f"were learned; its memory has {plug.found}, {bits}"
    )
    say(f"[bold]observed now:[/] {outcome.observed} touches; [bold]digest:[/] {outcome.digest}")
    if task.folder is not None:
        say(f"kept: try  scroll-tactile inspect {shown(task.folder / 'memory')}")
