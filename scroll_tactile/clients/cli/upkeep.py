"""`scroll-tactile memory …`, `ros2` and `mcp`: what looks after a memory on disk, and what serves one."""

from __future__ import annotations

from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from scroll_tactile_store import Store, StoreError, repair_store
from typer import Argument, Option

from scroll_tactile.clients.cli.terminal import (
    AsJson,
    Axis,
    Commands,
    MemoryFolder,
    Named,
    Risk,
    Scene,
    Sources,
    counted,
    materials_of,
    opened,
    opened_for_upkeep,
    progress_bar,
    say,
    say_json,
    say_refused,
    shown,
    with_options,
)
from scroll_tactile.errors import InputError, ScrollTactileError
from scroll_tactile.settings import GONE

__all__ = ["PASSED_ON", "mcp", "memory", "ros2"]

PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True}
"""What `ros2` is made with, so that --ros-args and what follows reach ROS."""

ExportForm = StrEnum("ExportForm", ["plain", "c"])

memory = typer.Typer(cls=Commands, no_args_is_help=True, help="Look after a memory on disk.")


@memory.command()
def reembed(
    folder: MemoryFolder,
    default: Annotated[bool, Option("--default", help="With the default embedding of its sensor.")] = False,
) -> None:
    """Embed all readings again, with the memory's own embedding as it is now.

    Interrupted, start it again to go on.
    """
    from scroll_tactile.memory.gate import finish_interrupted
    from scroll_tactile.memory.identity import Identity
    from scroll_tactile.prediction.predictor import reembed_memory
    from scroll_tactile.recipe import default_embedding

    finish_interrupted(folder)
    with Store.open(folder, mode="read") as store:
        chosen = default_embedding(Identity.read(store).sensor) if default else None
    with progress_bar() as progress:
        before = reembed_memory(folder, chosen, progress=progress)
    say(f"the memory before is in {shown(before)}: remove it once the new one is as you want it")


@memory.command()
def check(folder: MemoryFolder, as_json: AsJson = False) -> None:
    """Verify all that is in a memory, in a process that may die of it; change nothing.

    The exit code is 1 where something is damaged.
    """
    from scroll_tactile.clients.learning.checking import check_in_process

    with progress_bar() as progress:
        problems = check_in_process(folder, progress=progress)
    damaged = [problem for problem in problems if problem.kind != "leftover"]
    if as_json:
        say_json({"sound": not damaged, "problems": [vars(each) | {"path": str(each.path)} for each in problems]})
    else:
        for problem in problems:
            colour = {"lost": "red", "spare": "yellow"}.get(problem.kind, "dim")
            say(f"[{colour}]{problem.kind}:[/] {shown(problem.what)}")
        if damaged:
            say(
                f"[red]{len(damaged)} damaged[/]",
                "it is not to be used as it is. To trust it again, put back a copy from before; or copy the folder, "
                f"then: scroll-tactile memory repair {shown(folder)} (it keeps the rows up to the first that is "
                "lost, and names the others), and check it again",
            )
        else:
            say(
                "[green]sound:[/] every checksum holds",
                "it can be opened and merged without harm. Nobody signed it: of a memory from elsewhere the rows count "
                "for as much as you trust who gave it to you",
            )
    if damaged:
        raise typer.Exit(1)


@memory.command()
def health(
    folder: MemoryFolder,
    source: Annotated[str | None, Option(help="Only touches from there, such as one robot's.")] = None,
    after: Annotated[int, Option(min=0, help="Only touches behind this observation.")] = 0,
    bound: Annotated[float, Option(help="Of the probability of a false alarm, over all time.")] = 0.01,
    as_json: AsJson = False,
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
        say(f"[red]changed:[/] {shown(in_words(found))}", shown(advice(found)))
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
    keep: Annotated[int, Option(min=0, help="The newest so many observations can still be retracted.")] = 0,
    yes: Annotated[bool, Option("--yes", help="Do not ask.")] = False,
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
    target: Annotated[Path, Argument(help="The copy: a folder that is not there yet.", show_default=False)],
) -> None:
    """Copy a memory, also while it is used: verified, whole, on the disk when it appears, or not there at all."""
    with Store.open(folder, mode="read") as store, progress_bar() as progress:
        store.backup(target, progress=progress)
    with Store.open(target, mode="read") as copy:
        say(f"written: {shown(target)}, with rows 1 to {copy.last}; every checksum holds")


@memory.command()
def export(
    folder: MemoryFolder,
    target: Annotated[Path, Argument(help="A new or empty folder.", show_default=False)],
    form: Annotated[
        ExportForm,
        Option("--format", help="plain: all it holds, as CSV, JSON and NumPy files. c: a judge for a microcontroller."),
    ] = ExportForm.plain,
    scene: Annotated[
        str | None, Option(help="Of c: the materials that can be there, with commas between; all unless given.")
    ] = None,
) -> None:
    """Write a memory so that it is read without scroll-tactile: all that it holds, or its judge as C for a chip."""
    if form is ExportForm.c:
        _export_c(folder, target, scene)
        return
    if scene is not None:
        raise InputError("--scene is for --format c; all that a memory holds is of all materials")
    from scroll_tactile.clients.learning.plain_export import export_plain

    with opened_for_upkeep(folder, mode="read") as learner, progress_bar() as progress:
        export_plain(learner, target, progress)
    say(f"written: {shown(target)}")


def _export_c(folder: Path, target: Path, scene: str | None) -> None:
    from scroll_tactile.clients.firmware.c_files import flash_bytes, kept_levels, write_firmware

    with opened(folder, mode="read") as learner:
        judge = learner.exported(materials_of(scene))
        touches = kept_levels(judge, learner.memory)
    write_firmware(judge, target, touches)
    say(
        f"written: {shown(target)}, {len(judge.materials)} materials, {flash_bytes(judge) / 1024:.0f} kB of tables in "
        f"flash, {judge.ram_bytes / 1024:.0f} kB of RAM; `make` there checks {len(touches)} touches. Left out of it: "
        "kept touches, views of a whole touch, fine-tuning"
    )


@memory.command()
def declare(
    folder: MemoryFolder,
    quantity: Annotated[
        str, Argument(help="Name, unit, range, resolution: 'force [N] 0..10 step 0.01'.", show_default=False)
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
    observation: Annotated[int, Argument(help="Its number, as observe and export give it.", show_default=False)],
) -> None:
    """Take one observation out again, exactly, as if it had never been made; or what `memory adapt` found."""
    with opened_for_upkeep(folder) as learner:
        learner.retract(observation)
        left = sum(learner.materials.values())
    say(f"row {observation} was retracted; {counted(left, 'observation')} left")


@memory.command()
def relabel(
    folder: MemoryFolder,
    observation: Annotated[int, Argument(help="Its number, as list gives it.", show_default=False)],
    material: Annotated[str, Argument(help="What it was a touch of.", show_default=False)],
) -> None:
    """Put a wrong name right: retract one observation and learn it under another name, exactly and as one change."""
    with opened_for_upkeep(folder) as learner:
        sequence = learner.relabel(observation, material)
    say(f"observation {observation} was retracted; as {shown(material)} it is observation {sequence}")


@memory.command("list")
def list_observations(
    folder: MemoryFolder, as_json: Annotated[bool, Option("--json", help="Print JSON, a line for each.")] = False
) -> None:
    """List the observations: number, material, time, what became of it (kept, compacted, retracted), what was noted of
    it, and source.
    """
    from scroll_tactile.clients.learning.plain_export import date_of
    from scroll_tactile.memory.gate import MemoryStore
    from scroll_tactile.persistence.observations import observations

    with MemoryStore.open(folder, mode="read") as store:
        found = observations(store)
    for row in found:
        if as_json:
            told = {name: getattr(row, name) for name in ("sequence", "material", "time", "state", "source")}
            measured = {"values": row.values, "labels": row.labels} if row.values or row.labels else {}
            say_json(told | {"key": row.key.hex()} | measured)
        else:
            state = "" if row.state == "kept" else f"  [yellow]{row.state}[/]"
            noted = "".join(f"  {shown(name)}={shown(what)}" for name, what in {**row.values, **row.labels}.items())
            begin = f"{row.sequence:>6}  {date_of(row.time)}  {shown(row.material)}{state}"
            say(f"{begin}{noted}  {shown(row.source or '')}")


@memory.command()
def forget(
    folder: MemoryFolder,
    material: Annotated[str | None, Argument(help="Its name.", show_default=False)] = None,
    source: Annotated[
        str | None, Option(help="In place of a material: a file, or a folder or address of files, as list shows.")
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
    target: Annotated[Path, Argument(help="The file; one that is there is replaced.", show_default=False)],
    rows: Annotated[
        bool, Option(help="With each touch's readings, so that it can be retracted where the file is merged.")
    ] = True,
    readings: Annotated[bool, Option(help="With anything that shows a touch as it was read.")] = True,
    source: Annotated[str | None, Option(help="The source of touches that name none.")] = None,
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
        Path, Argument(help="The memory that comes in, a folder or packed; it stays as it is.", show_default=False)
    ],
) -> None:
    """Make a memory the one that observed all that both did, exactly; what both observed counts once."""
    with opened_for_upkeep(folder) as learner, progress_bar() as progress:
        done = learner.merge(other, progress=progress)
        with suppress(ScrollTactileError):  # what came in is there: who opens the memory is told
            learner.settle()
        digest, count = learner.digest(), sum(learner.materials.values())
    say(
        f"{counted(done.observations, 'observation')} came in, {counted(done.shared, 'stream')} observed by both; "
        f"{count} are there now",
        f"[bold]digest:[/] {digest}",
    )


@memory.command()
@with_options
def adapt(
    folder: MemoryFolder,
    sources: Sources,
    *,
    until: Annotated[
        int | None, Option(min=0, help="The last observation of the skin before; health says since when.")
    ] = None,
    how: Named,
    as_json: AsJson = False,
) -> None:
    """Take over a changed skin, from about five touches of known materials felt with it; nothing is learned of them.

    Later touches are read through what was found; `memory retract` takes it back. The exit code is 1 where it was not
    kept, or a source was refused, which is named then.
    """
    from scroll_tactile.clients.learning.sources import Refused, find_sources, source_touches

    found, missing = find_sources(sources)
    options = how.options().among(found, sources)
    with opened_for_upkeep(folder) as learner, progress_bar() as progress:
        touches = [touch for address in found for touch in source_touches(learner, address, options)]
        refused = missing + [touch for touch in touches if isinstance(touch, Refused)]
        progress("adapting", 0, 1)
        known = [(str(touch.material), touch.stream) for touch in touches if not isinstance(touch, Refused)]
        done = learner.adapt(known, until=until)
    if as_json:
        say_json(vars(done))
    else:
        say(
            (f"[green]adapted:[/] by row {done.sequence}; " if done.kept else "[yellow]not adapted:[/] ") + done.why,
            f"the touches lie {done.before:.2f} from what was learned, corrected {done.after:.2f}; 1 is usual",
        )
    say_refused(refused)
    if refused or not done.kept:
        raise typer.Exit(1)


def ros2(
    context: typer.Context,
    memory: Annotated[Path | None, Option(help="The folder of the memory; here or as the parameter memory.")] = None,
    topic: Annotated[str, Option(help="Where the readings are sent; a preset may know it.")] = "",
    field: Annotated[
        str, Option(help="The path to a message's numbers, such as tactiles[0].electrodes; a preset may know it.")
    ] = "",
    preset: Annotated[
        str | None, Option(help="A known sensor, which gives sensor, topic and field: biotac, xela-uskin, anyskin, …")
    ] = None,
    kind: Annotated[
        str | None, Option("--type", help="The messages' type, as package/msg/Name; else what the topic says.")
    ] = None,
    risk: Risk = 0.05,
    scene: Scene = None,
    contact: Annotated[
        str, Option(help="auto finds touches, after 2 s at rest; manual waits for the services begin and end.")
    ] = "auto",
    of: Axis = None,
    watch: Annotated[
        bool, Option("--watch", help="Note rest and known touches for the sensor's health, some hundred bytes each.")
    ] = False,
    sensor: Annotated[
        str | None, Option(help="As for observe: whose readings they are. Needed only to make a new memory.")
    ] = None,
) -> None:
    """Run the ROS 2 lifecycle node scroll_tactile until ctrl-C: readings from a topic, answers on ~/answer.

    It comes up active. What follows --ros-args is ROS': --params-file FILE, -p autostart:=false. Each
    option is a parameter, too, and so are mode, qos.reliability, qos.durability and qos.depth; `ros2 param describe`
    explains them. risk, scene and health_after can be set while it runs, the others before it is configured.

    Topics, of which late subscribers get the last: ~/answer (JSON), ~/status (by name, with a header), ~/material,
    ~/probability, ~/novelty and ~/known (plain numbers, for plots), ~/tactile_answer (where scroll_tactile_msgs is
    built), and /diagnostics. Several fingers are several nodes, each in a namespace of its own: -r __ns:=/left

    Services that take a name, as load_namespace of diagnostic_msgs/srv/AddDiagnostics: ~/learn, ~/forget, ~/retract
    (an observation's number), ~/save (a file beside the memory). Services of std_srvs/srv/Trigger: ~/undo, ~/materials,
    ~/predict, ~/again (before another touch of the same thing), ~/begin and ~/end (with --contact manual).

    ros2 service call /scroll_tactile/learn diagnostic_msgs/srv/AddDiagnostics "{load_namespace: silk}"
    """
    if context.args and (first := context.args[0]) != "--ros-args":
        how = GONE.get(first.lstrip("-"), "see --help. Options of ROS follow --ros-args")
        raise InputError(f"there is no option {first!r}: {how}")
    from scroll_tactile.clients.ros2.node import serve

    parameters: dict[str, Any] = {"preset": preset, "type": kind, "risk": risk, "scene": scene, "contact": contact}
    parameters |= {"of": of, "watch": watch, "sensor": sensor}
    met = serve(memory, topic, field, arguments=context.args, **parameters)
    count = met.pop("materials", 0)
    met_in_words = ", ".join(f"{name.replace('_', ' ')}: {value}" for name, value in met.items() if value)
    say(f"{shown(memory or 'the memory')}: {counted(count, 'material')}. {met_in_words}")


def mcp(
    memory: MemoryFolder,
    learn: Annotated[
        bool, Option("--learn", help="Let it observe and retract, too; without it the memory stays as it is.")
    ] = False,
    files: Annotated[Path | None, Option(help="A folder whose recordings it may name in place of readings.")] = None,
) -> None:
    """Serve a memory to a planner over standard input and output, by the Model Context Protocol, until it hangs up.

    Its tools: what_is_felt, what_is_known, what_to_touch_again; with --learn observe and retract.
    """
    from scroll_tactile.clients.planner.server import serve

    with opened(memory, mode="write" if learn else "read") as learner:
        serve(learner, learn=learn, files=files)
