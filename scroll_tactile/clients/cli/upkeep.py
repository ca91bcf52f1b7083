"""`scroll-tactile memory …`: checking, repairing, copying, compacting, merging and retracting."""

from __future__ import annotations

from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from scroll_tactile_store import Store, StoreError, repair_store

from scroll_tactile.clients.cli.options import MemoryFolder, materials_of
from scroll_tactile.clients.cli.terminal import Commands, opened, opened_for_upkeep, progress_bar, say, say_json, shown
from scroll_tactile.clients.cli.wording import counted
from scroll_tactile.errors import InputError, ScrollTactileError

__all__ = ["memory"]

memory = typer.Typer(cls=Commands, no_args_is_help=True, help="Look after a memory on disk.")


class Shared(StrEnum):
    """How streams that both memories observed are counted."""

    ONCE = "once"
    TWICE = "twice"


class ExportForm(StrEnum):
    """As what a memory is written."""

    PLAIN = "plain"
    C = "c"


@memory.command()
def reembed(
    folder: MemoryFolder,
    default: Annotated[bool, typer.Option("--default", help="With the default embedding of its sensor.")] = False,
) -> None:
    """Embed all readings again, with the memory's own embedding as it is now.

    Interrupted, start it again to go on.
    """
    from scroll_tactile.memory.identity import Identity
    from scroll_tactile.prediction.reembedding import reembed_memory
    from scroll_tactile.recipe import default_embedding
    from scroll_tactile.validation.gate import finish_interrupted

    finish_interrupted(folder)
    with Store.open(folder, mode="read") as store:
        chosen = default_embedding(Identity.read(store).sensor) if default else None
    with progress_bar() as progress:
        before = reembed_memory(folder, chosen, progress=progress)
    say(f"the memory before is in {shown(before)}: remove it once the new one is as you want it")


@memory.command()
def check(folder: MemoryFolder, as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False) -> None:
    """Verify all that is in a memory, in a process that may die of it; change nothing.

    The exit code is 1 where something is damaged.
    """
    from scroll_tactile.clients.learning.checking import check_in_process

    with progress_bar() as progress:
        problems = check_in_process(folder, progress=progress)
    damaged = [problem for problem in problems if problem.kind != "leftover"]
    if as_json:
        found = [{"path": str(problem.path), "what": problem.what, "kind": problem.kind} for problem in problems]
        say_json({"sound": not damaged, "problems": found})
    else:
        for problem in problems:
            colour = {"lost": "red", "spare": "yellow"}.get(problem.kind, "dim")
            say(f"[{colour}]{problem.kind}:[/] {shown(problem.what)}")
        say("[green]sound:[/] every checksum holds" if not damaged else f"[red]{len(damaged)} damaged[/]")
        if damaged:
            say(
                "it is not to be used as it is. To trust it again, put back a copy from before; or copy the folder, "
                f"then: scroll-tactile memory repair {shown(folder)} (it keeps the rows up to the first that is "
                "lost, and names the others), and check it again"
            )
        else:
            say(
                "it can be opened and merged without harm. Nobody signed it: of a memory from elsewhere the rows count "
                "for as much as you trust who gave it to you"
            )
    if damaged:
        raise typer.Exit(1)


@memory.command()
def health(
    folder: MemoryFolder,
    source: Annotated[str | None, typer.Option(help="Only touches from there, such as one robot's.")] = None,
    after: Annotated[int, typer.Option(min=0, help="Only touches behind this observation.")] = 0,
    bound: Annotated[float, typer.Option(help="Of the probability of a false alarm, over all time.")] = 0.01,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Tell whether the sensor is still the one that learned, since when not, which channels, and what to do.

    The exit code is 1 where something changed.
    """
    from scroll_tactile.health.diagnosis import advice, in_words

    with opened(folder, mode="read") as learner:
        found = learner.health(bound=bound, after=after, source=source)
    if as_json:
        say_json({name: value for name, value in vars(found).items() if name != "grew"})
    elif found.since is None:
        say(f"{'[green]well:[/]' if found.grew else '[yellow]too few:[/]'} {shown(in_words(found))}")
    else:
        say(f"[red]changed:[/] {shown(in_words(found))}")
        say(shown(advice(found)))
    if found.since is not None:
        raise typer.Exit(1)


@memory.command()
def repair(folder: MemoryFolder) -> None:
    """Keep what verifies of a damaged memory, up to the first row that is lost, and name what is lost."""
    # Where it still opens, closing it writes a checkpoint: a repair may give up the rows that led to it.
    with suppress(ScrollTactileError, StoreError), opened_for_upkeep(folder):
        pass
    with progress_bar() as progress:
        done = repair_store(folder, progress=progress)
    for what in done.lost:
        say(f"[yellow]lost:[/] {shown(what)}")
    if done.aside is not None:
        say(f"the damaged journal was put aside: {shown(done.aside)}")
    whole = done.aside is None and not done.lost
    say(f"nothing was damaged; rows 1 to {done.kept} verify" if whole else f"kept up to row {done.kept}")


@memory.command()
def compact(
    folder: MemoryFolder,
    keep: Annotated[int, typer.Option(min=0, help="The newest so many observations can still be retracted.")] = 0,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Give up the features of old observations for space: they stay learned, and can no longer be retracted."""
    with opened_for_upkeep(folder) as learner:
        count = sum(learner.materials.values())
        question = f"Of {count} observations only the newest {keep} can be retracted or forgotten afterwards. Go on?"
        if not yes and not typer.confirm(question):
            raise typer.Exit(1)
        done = learner.compact(keep=keep)
    before, after = done.bytes_before / 2**20, done.bytes_after / 2**20
    say(f"rows up to {done.last_sequence} are compacted; on disk {before:.1f} MB before, {after:.1f} MB after")


@memory.command()
def backup(
    folder: MemoryFolder,
    target: Annotated[Path, typer.Argument(help="The copy: a folder that is not there yet.", show_default=False)],
) -> None:
    """Copy a memory, also while it is used: verified, whole, on the disk when it appears, or not there at all."""
    with Store.open(folder, mode="read") as store, progress_bar() as progress:
        store.backup(target, progress=progress)
    with Store.open(target, mode="read") as copy:
        say(f"written: {shown(target)}, with rows 1 to {copy.last}; every checksum holds")


@memory.command()
def export(
    folder: MemoryFolder,
    target: Annotated[Path, typer.Argument(help="A new or empty folder.", show_default=False)],
    form: Annotated[
        ExportForm,
        typer.Option(
            "--format",
            help="plain: all it holds, as CSV, JSON and NumPy files. c: a judge for a microcontroller.",
        ),
    ] = ExportForm.PLAIN,
    scene: Annotated[
        str | None, typer.Option(help="Of c: the materials that can be there, with commas between; all unless given.")
    ] = None,
) -> None:
    """Write a memory so that it is read without scroll-tactile: all that it holds, or its judge as C for a chip."""
    if form is ExportForm.C:
        say(f"written: {shown(target)}, {_export_c(folder, target, scene)}")
        return
    if scene is not None:
        raise InputError("--scene is for --format c; all that a memory holds is of all materials")
    from scroll_tactile.clients.learning.plain_export import export_plain

    with opened_for_upkeep(folder, mode="read") as learner, progress_bar() as progress:
        export_plain(learner, target, progress)
    say(f"written: {shown(target)}")


def _export_c(folder: Path, target: Path, scene: str | None) -> str:
    """Write the exported judge of a scene; what it takes, in words."""
    from scroll_tactile.clients.firmware.c_files import flash_bytes, kept_levels, write_firmware

    with opened(folder, mode="read") as learner:
        judge = learner.exported(materials_of(scene))
        touches = kept_levels(judge, learner.memory)
    write_firmware(judge, target, touches)
    return (
        f"{len(judge.materials)} materials, {flash_bytes(judge) / 1024:.0f} kB of tables in flash, "
        f"{judge.ram_bytes / 1024:.0f} kB of RAM; `make` there checks {len(touches)} touches. Left out of it: kept "
        "touches, views of a whole touch, fine-tuning"
    )


@memory.command()
def declare(
    folder: MemoryFolder,
    quantity: Annotated[
        str, typer.Argument(help="Name, unit, range, resolution: 'force [N] 0..10 step 0.01'.", show_default=False)
    ],
) -> None:
    """Have touches carry values of a quantity from now on; its unit and range stay as they are."""
    from scroll_tactile.quantities import Quantity

    declared = Quantity.parsed(quantity)
    with opened_for_upkeep(folder) as learner:
        learner.declare(declared)
    say(f"declared: {shown(str(declared))}, {declared.steps} steps")


@memory.command()
def retract(
    folder: MemoryFolder,
    observation: Annotated[int, typer.Argument(help="Its number, as observe and export give it.", show_default=False)],
) -> None:
    """Take one observation out again, exactly, as if it had never been made; or what `memory adapt` found."""
    with opened_for_upkeep(folder) as learner:
        learner.retract(observation)
        left = sum(learner.materials.values())
    say(f"row {observation} was retracted; {counted(left, 'observation')} left")


@memory.command()
def relabel(
    folder: MemoryFolder,
    observation: Annotated[int, typer.Argument(help="Its number, as list gives it.", show_default=False)],
    material: Annotated[str, typer.Argument(help="What it was a touch of.", show_default=False)],
) -> None:
    """Put a wrong name right: retract one observation and learn it under another name, exactly and as one change."""
    with opened_for_upkeep(folder) as learner:
        sequence = learner.relabel(observation, material)
    say(f"observation {observation} was retracted; as {shown(material)} it is observation {sequence}")


@memory.command("list")
def list_observations(
    folder: MemoryFolder,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, a line for each.")] = False,
) -> None:
    """List the observations: number, material, time, what became of it (kept, compacted, retracted), what was noted of
    it, and source.
    """
    from scroll_tactile.clients.learning.plain_export import date_of
    from scroll_tactile.persistence.observations import observations
    from scroll_tactile.validation.gate import MemoryStore

    with MemoryStore.open(folder, mode="read") as store:
        found = observations(store)
    for row in found:
        if as_json:
            say_json(
                {
                    "sequence": row.sequence,
                    "material": row.material,
                    "time": row.time,
                    "state": row.state,
                    "source": row.source,
                    "key": row.key.hex(),
                    **({"values": row.values, "labels": row.labels} if row.values or row.labels else {}),
                }
            )
        else:
            state = "" if row.state == "kept" else f"  [yellow]{row.state}[/]"
            noted = "".join(
                f"  {shown(name)}={shown(str(told))}" for name, told in {**row.values, **row.labels}.items()
            )
            where = shown(row.source or "")
            say(f"{row.sequence:>6}  {date_of(row.time)}  {shown(row.material)}{state}{noted}  {where}")


@memory.command()
def forget(
    folder: MemoryFolder,
    material: Annotated[str | None, typer.Argument(help="Its name.", show_default=False)] = None,
    source: Annotated[
        str | None, typer.Option(help="In place of a material: a file, or a folder or address of files, as list shows.")
    ] = None,
) -> None:
    """Retract all observations of a material, or from a source, exactly, as if they had never been made."""
    with opened_for_upkeep(folder) as learner:
        count = learner.forget(material, source=source)
        left = len(learner.materials)
    say(f"{shown(material or source)}: {counted(count, 'observation')} retracted; {counted(left, 'material')} left")


@memory.command()
def pack(
    folder: MemoryFolder,
    target: Annotated[Path, typer.Argument(help="The file; one that is there is replaced.", show_default=False)],
    rows: Annotated[
        bool, typer.Option(help="With each touch's readings, so that it can be retracted where the file is merged.")
    ] = True,
    readings: Annotated[bool, typer.Option(help="With anything that shows a touch as it was read.")] = True,
    source: Annotated[str | None, typer.Option(help="The source of touches that name none.")] = None,
) -> None:
    """Write a memory as one file that travels, and that merge takes."""
    with opened_for_upkeep(folder, mode="read") as learner:
        learner.pack(target, rows=rows, readings=readings, source=source)
        count = sum(learner.materials.values())
    say(f"written: {shown(target)}, {counted(count, 'observation')} in {target.stat().st_size / 2**20:.1f} MB")


@memory.command()
def merge(
    folder: MemoryFolder,
    other: Annotated[
        Path,
        typer.Argument(help="The memory that comes in, a folder or packed; it stays as it is.", show_default=False),
    ],
    shared: Annotated[
        Shared | None, typer.Option(help="How a stream that both observed is counted.", show_default=False)
    ] = None,
) -> None:
    """Make a memory the one that observed all that both did, exactly."""
    from scroll_tactile.clients.learning.learning import store_model

    if shared is None:
        raise InputError(
            "say how a stream that both memories observed is counted: --shared once as one touch, such as of two "
            "copies of a memory that both went on; --shared twice as two, if it was observed again on purpose"
        )
    with opened_for_upkeep(folder) as learner, progress_bar() as progress:
        done = learner.merge(other, shared=shared.value, progress=progress)
        store_model(learner, progress)
        digest, count = learner.digest(), sum(learner.materials.values())
    say(
        f"{counted(done.observations, 'observation')} came in, {counted(done.shared, 'stream')} observed by both; "
        f"{count} are there now"
    )
    say(f"[bold]digest:[/] {digest}")
