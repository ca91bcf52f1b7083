"""`scroll-tactile demo` and `report`: simulated touches, learned and answered; a memory or a recording as a page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from scroll_tactile_store import NotAStoreError

from scroll_tactile.clients.cli.terminal import opened_for_upkeep, percent, progress_bar, say, shown, verdict
from scroll_tactile.errors import InputError

if TYPE_CHECKING:
    from scroll_tactile.clients.learning.demo import Demo, Outcome, Unplugged

__all__ = ["demo", "report"]


def demo(
    memory: Annotated[
        Path | None,
        typer.Option(help="Keep the memory in this folder. Interrupt the demo, start it again, and it goes on."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the simulated materials.")] = 0,
    sensor: Annotated[str, typer.Option(help="biotac, roboskin, contactile, or a JSON file of one.")] = "biotac",
    features: Annotated[
        int, typer.Option(min=64, help="Features of the embedding: fewer than the default, 1008.")
    ] = 504,
    materials: Annotated[int, typer.Option(hidden=True, min=2, max=20)] = 12,
    touches: Annotated[int, typer.Option(hidden=True, min=1)] = 6,
    held_out: Annotated[int, typer.Option(hidden=True, min=1)] = 4,
) -> None:
    """Ten seconds of learning: simulated materials, unknown first, then learned, and none forgotten.

    When half of them are learned, it answers touches of the others, which it has never felt; in the end of all,
    and the first 0.3 s of touches; and a process that learns is killed. It needs no data, and keeps nothing unless
    you give --memory.
    """
    from scroll_tactile.clients.learning.demo import Demo, pull_the_plug
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

        def count(name: str) -> None:
            learned.append(name)
            progress(f"learned {name}", len(learned), materials)

        outcome = task.run(count)
        progress("a process is killed while it learns", len(learned), materials)
        plug = pull_the_plug(task.sensor, seed)
    _report_demo(task, outcome, learned, plug)


def _report_demo(task: Demo, outcome: Outcome, learned: list[str], plug: Unplugged) -> None:
    half, middle, answers, short = outcome.half, max(1, len(learned) // 2), outcome.answers, outcome.short
    first, others = learned[:middle], learned[middle:]
    say(f"[bold]learned[/] {len(first)} materials, {task.touches} touches of each: {', '.join(first)}")
    answer = "never felt this" if half.known is False else f"known, as {half.nearest}"
    say(
        f"[bold]unknown is called unknown:[/] {half.material}, before it was learned: [bold yellow]{answer}[/] "
        f"(nearest is {half.nearest}, novelty {half.novelty:.1f})"
    )
    say(f"  of {half.tested} touches of materials that it had never felt it called {half.unknown} unknown")
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
        f"[bold]survives the power plug:[/] a process was killed when it had reported that {plug.acknowledged} touches "
        f"were learned; its memory has {plug.found}, {bits}"
    )
    say(f"[bold]observed now:[/] {outcome.observed} touches; [bold]digest:[/] {outcome.digest}")
    if task.folder is not None:
        say(f"kept: try  scroll-tactile inspect {shown(task.folder / 'memory')}")


def report(
    source: Annotated[Path, typer.Argument(help="The folder of a memory, or a recording.", show_default=False)],
    page: Annotated[Path, typer.Argument(help="The page to write, such as page.html.", show_default=False)],
    topic: Annotated[str | None, typer.Option(help="Of a recording: which topic.")] = None,
    field: Annotated[str | None, typer.Option(help="Of a recording: where its numbers are.")] = None,
    preset: Annotated[str | None, typer.Option(help="Of a recording: a known sensor, in place of both.")] = None,
    clock: Annotated[str | None, typer.Option(help="Of a recording: whose times.")] = None,
    rate: Annotated[float | None, typer.Option(help="Of a recording without times: readings a second.")] = None,
    sensor: Annotated[
        str | None, typer.Option(help="Of a recording: whose readings they are, a name or a JSON file, for its range.")
    ] = None,
    labels: Annotated[
        Path | None, typer.Option(help="Of a recording: a table that cuts it to touches and names them, as for learn.")
    ] = None,
) -> None:
    """Write a page that shows what a memory knows, or what a recording holds; any browser opens it, without network."""
    from scroll_tactile.clients.report.page import require_page, save

    require_page(page)
    chosen: dict[str, Any] = {"topic": topic, "field": field, "preset": preset, "clock": clock, "rate": rate}
    if _is_memory(source):
        every = {**chosen, "sensor": sensor, "labels": labels}
        given = [f"--{name}" for name, value in every.items() if value is not None]
        if given:
            raise InputError(f"{', '.join(given)}: only of a recording; {source} is a memory")
        from scroll_tactile.clients.report.memory_page import memory_page

        with opened_for_upkeep(source, mode="read") as learner, progress_bar() as progress:
            html = memory_page(learner, progress=progress)
    else:
        from scroll_tactile.clients.report.recording_page import recording_page
        from scroll_tactile.recordings import read_intervals
        from scroll_tactile.sensors import read_sensor

        cut = None if labels is None else read_intervals(labels)
        whose = None if sensor is None else read_sensor(sensor)
        words = {"sensor": sensor, "labels": None if labels is None else str(labels)}
        came_by = {name: word for name, word in words.items() if word is not None}
        html = recording_page(source, sensor=whose, intervals=cut, given=came_by, **chosen)
    save(html, page)
    say(f"written: {shown(page)}, {len(html.encode()) / 1e6:.1f} MB; open it with any browser")


def _is_memory(source: Path) -> bool:
    """Whether a memory lies there, sound or not; what holds no store may be a recording."""
    from scroll_tactile_store.layout import holds_store

    if not source.is_dir():
        return False
    try:
        return holds_store(source)
    except NotAStoreError:
        return False
