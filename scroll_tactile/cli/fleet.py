"""`scroll-tactile fleet`: many recordings and memories, learned by many workers, become one memory."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scroll_tactile.cli.bulk import AsJson, CutBy, Label, LabelBy, Labels, LabelTopic, source_options
from scroll_tactile.cli.everyday import Clock, Columns, Field, MemoryFolder, Preset, Sources, Topic, sensor_for
from scroll_tactile.cli.terminal import progress_bar, say, say_json, say_refused
from scroll_tactile.errors import InputError
from scroll_tactile.libraries import optional

if TYPE_CHECKING:
    from scroll_tactile.pipelines.fleet import FleetReport

__all__ = ["fleet"]

SECONDS = 20  # in which a scheduler answers


def fleet(
    destination: MemoryFolder,
    sources: Sources,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; as many as there are cores.")] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="A Dask scheduler, such as tcp://host:8786, in place of processes.")
    ] = None,
    add: Annotated[bool, typer.Option("--add", help="Add to a memory that was made in another way.")] = False,
    patience: Annotated[
        float | None, typer.Option(min=1, help="Seconds for a job; then its worker is given up, and another begins it.")
    ] = None,
    sensor: Annotated[
        str | None, typer.Option(help="Whose readings they are, as for observe; or give --preset. For a new memory.")
    ] = None,
    preset: Preset = None,
    topic: Topic = None,
    field: Field = None,
    clock: Clock = None,
    columns: Columns = None,
    label: Label = None,
    label_by: LabelBy = None,
    labels: Labels = None,
    label_topic: LabelTopic = None,
    cut: CutBy = None,
    as_json: AsJson = False,
) -> None:
    """Learn recordings and memories, in folders, files and buckets, by many workers into one memory.

    The memory is, to the byte, that of one process which observed each touch once. Interrupt it, type it again, and it
    goes on. The exit code is 1 where something was refused.
    """
    from scroll_tactile.pipelines.fleet import learn

    if workers is not None and scheduler is not None:
        raise InputError("give --workers or --scheduler: a scheduler has workers of its own")
    options = source_options(sources, preset, topic, field, clock, columns, label, label_by, labels, label_topic, cut)
    chosen = sensor_for(destination, sensor, preset)
    with ExitStack() as stack:
        client = None if scheduler is None else stack.enter_context(_connected(scheduler))
        progress = stack.enter_context(progress_bar())
        done = learn(
            destination,
            sources,
            options,
            sensor=chosen,
            workers=workers,
            client=client,
            add=add,
            patience=patience,
            progress=progress,
        )
    _report(done, as_json)
    if done.refused:
        raise typer.Exit(1)


def _connected(scheduler: str) -> Any:
    with optional("dask[distributed]", "fleet", "--scheduler"):
        import distributed
    connect: Any = distributed.Client
    try:
        return connect(scheduler, timeout=SECONDS)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(f"no scheduler answers at {scheduler}: {type(error).__name__}: {error!s:.200}") from error


def _report(done: FleetReport, as_json: bool) -> None:
    if as_json:
        say_json(
            {
                "sources": done.sources,
                "observations": done.observations,
                "repeated": done.repeated,
                "refused": [{"source": each.source, "why": each.why} for each in done.refused],
                "deaths": done.deaths,
                "seconds": done.seconds,
                "held": done.held,
                "digest": done.digest,
            }
        )
        return
    rate = done.observations / done.seconds if done.seconds else 0.0
    say(
        f"[bold]learned:[/] {done.observations} touches from {done.sources} sources in {done.seconds:.1f} s, "
        f"{rate:.0f} a second; {done.held} are in the memory now"
    )
    if done.repeated:
        say(f"[bold]skipped:[/] {done.repeated} touches that came before")
    if done.deaths:
        say(f"[bold]begun again:[/] {done.deaths} jobs whose workers ended")
    say_refused(done.refused)
    say(f"[bold]digest:[/] {done.digest}")
