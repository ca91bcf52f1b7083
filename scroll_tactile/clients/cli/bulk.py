"""`scroll-tactile sensor`, `learn`, `fleet`, `evaluate`, `demo` and `report`: many touches, of files or simulated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from scroll_tactile_store import NotAStoreError
from scroll_tactile_store.layout import holds_store
from typer import Argument, Option

from scroll_tactile.clients.cli.everyday import ANSWER, answer_row
from scroll_tactile.clients.cli.terminal import (
    Annotating,
    AsCsv,
    AsJson,
    Axis,
    MemoryFolder,
    Reading,
    SensorName,
    Sources,
    confusion_text,
    console,
    counted,
    facts_as_json,
    no_memory,
    opened,
    opened_for_upkeep,
    percent,
    progress_bar,
    say,
    say_csv,
    say_facts,
    say_json,
    say_refused,
    sensor_for,
    shown,
    verdict,
    with_options,
)
from scroll_tactile.errors import InputError
from scroll_tactile.libraries import optional

if TYPE_CHECKING:
    from scroll_tactile.clients.learning.demo import Demo, Outcome, Unplugged
    from scroll_tactile.clients.learning.learning import Evaluation
    from scroll_tactile.clients.learning.sources import Refused

__all__ = ["demo", "evaluate", "fleet", "learn", "report", "sensor"]

MOST_SHOWN = 20  # mistakes; JSON and CSV have all
MOST_NAMES = 40  # of a table of confusions
SECONDS = 20  # in which a scheduler answers
MOST_GUESSED = 100  # recordings that a sensor is guessed from


@with_options
def sensor(sources: Sources, *, how: Reading) -> None:
    """Guess a sensor from recordings of it, and print it as JSON: scroll-tactile sensor FILES > my.json.

    How sure each field is comes on the standard error. The file is for --sensor of learn, fleet, observe and report.
    """
    from scroll_tactile.clients.learning.sources import Refused, find_sources
    from scroll_tactile.recordings import read
    from scroll_tactile.recordings.guessing import guessed_sensor

    found, refused = find_sources(sources)
    recordings = []
    with progress_bar() as progress:
        for number, source in enumerate(found[:MOST_GUESSED]):
            progress(source, number, min(len(found), MOST_GUESSED))
            try:
                recordings.append(read(source, **vars(how)))
            except InputError as error:
                refused.append(Refused.by(error, source))
    say_refused(refused)
    guessed, said = guessed_sensor(recordings)
    for line in said:
        console(error=True).print(shown(line))
    typer.echo(guessed.model_dump_json(indent=1, exclude_defaults=True))


@with_options
def learn(
    memory: MemoryFolder, sources: Sources, *, sensor: SensorName = None, how: Annotating, as_json: AsJson = False
) -> None:
    """Learn all touches in files and folders. Interrupt it, type it again, and it goes on: each touch counts once.

    Episodes name themselves where a recording says what they are. Memories are merged. The exit code is 1 where
    something was refused.
    """
    _learn(memory, sources, sensor, how, as_json, workers=1)


@with_options
def fleet(
    memory: MemoryFolder,
    sources: Sources,
    *,
    workers: Annotated[int | None, Option(min=1, help="Processes; as many as there are cores.")] = None,
    scheduler: Annotated[
        str | None, Option(help="A Dask scheduler, such as tcp://host:8786, in place of processes.")
    ] = None,
    sensor: SensorName = None,
    how: Annotating,
    as_json: AsJson = False,
) -> None:
    """Learn recordings and memories, in folders, files and buckets, by many workers into one memory.

    The memory is, to the byte, that of one process which observed each touch once. Interrupt it, type it again, and it
    goes on. The exit code is 1 where something was refused.
    """
    if workers is not None and scheduler is not None:
        raise InputError("give --workers or --scheduler: a scheduler has workers of its own")
    with nullcontext() if scheduler is None else _connected(scheduler) as client:
        if client is not None:
            workers = sum(client.ncores().values()) or None
        executor = None if client is None else client.get_executor()
        _learn(memory, sources, sensor, how, as_json, workers=workers, executor=executor)


def _connected(scheduler: str) -> Any:
    with optional("dask[distributed]", "fleet", "--scheduler"):
        import distributed
    connect: Any = distributed.Client
    try:
        return connect(scheduler, timeout=SECONDS)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(f"no scheduler answers at {scheduler}: {type(error).__name__}: {error!s:.200}") from error


def _learn(
    memory: Path, sources: Sequence[str], sensor: str | None, how: Annotating, as_json: bool, **workers: Any
) -> None:
    """Learn, and say what became of it. workers: who learns, as of `learn` in Python."""
    from scroll_tactile.clients.learning.fleet import learn

    options, chosen = how.options(), sensor_for(memory, sensor, how.preset)
    if chosen is None and not memory.exists():
        raise no_memory(memory, new=True)
    with progress_bar() as progress:
        done = learn(sources, memory, options, sensor=chosen, progress=progress, **workers)
    if as_json:
        learned = {"files": done.sources, "touches": done.observations, "learned": dict(sorted(done.learned.items()))}
        left = {"skipped": done.repeated, "refused": _refusals(done.refused), "deaths": done.deaths}
        left |= {"facts": facts_as_json(done.facts)}
        say_json({**learned, **left, "observations": done.held, "seconds": done.seconds, "digest": done.digest})
    else:
        of = f" of {counted(len(done.learned), 'material')}" if done.learned else ""
        say(
            f"[bold]learned:[/] {counted(done.observations, 'touch')}{of} from {counted(done.sources, 'file')}; the "
            f"memory has {done.held} now",
            *(f"  {touches:>6}  {shown(name)}" for name, touches in sorted(done.learned.items())),
        )
        if done.repeated:
            say(f"[bold]skipped:[/] {counted(done.repeated, 'touch')} that it had already")
        if done.deaths:
            say(f"[bold]begun again:[/] {counted(done.deaths, 'share')} whose worker ended")
        say_refused(done.refused)
        if done.digest:
            say(f"[bold]digest:[/] {done.digest}")
    if done.refused:
        raise typer.Exit(1)


@with_options
def evaluate(
    memory: MemoryFolder,
    sources: Sources,
    *,
    how: Annotating,
    of: Axis = None,
    with_learned: Annotated[
        bool, Option("--with-learned", help="Answer also the touches that the memory has learned.")
    ] = False,
    as_json: AsJson = False,
    as_csv: AsCsv = False,
) -> None:
    """Answer all touches in files and folders, and compare with what they are: accuracy, confusions, calibration.

    Of values that a table or a column gives, how many lie in their intervals, how wide these are, R² and mean error.
    Touches that it has learned are left out. The memory stays as it is. The exit code is 1 where something was refused.
    """
    from scroll_tactile.clients.learning.learning import evaluate_sources
    from scroll_tactile.clients.learning.sources import find_sources

    found, missing = find_sources(sources)
    options = how.options().among(found, sources)
    with opened(memory, mode="read") as learner, progress_bar() as progress:
        done = evaluate_sources(learner, found, options, progress, of=of, with_learned=with_learned)
    refused = [*missing, *done.refused]
    if as_json:
        say_json(_figures(done) | {"refused": _refusals(refused), "facts": facts_as_json(done.facts)})
    elif as_csv:
        say_csv(*ANSWER, of or "material", "right")
        for each in done.answered:
            say_csv(*answer_row(each), done.truth(each), each.prediction.material == done.truth(each))
    else:
        _report_evaluated(done, with_learned)
    if not as_json:
        say_facts(done.facts)
        say_refused(refused)
    if refused:
        raise typer.Exit(1)


def _refusals(refused: Sequence[Refused]) -> list[dict[str, str]]:
    return [{"source": each.source, "why": each.why} for each in refused]


def _figures(done: Evaluation) -> dict[str, Any]:
    learned, never_learned = done.of_learned, done.of_others
    wrong = [dict(zip(ANSWER, answer_row(each), strict=True)) | {"material": done.truth(each)} for each in done.wrong]
    return {
        **({} if done.of is None else {"of": done.of, "unlabelled": done.unlabelled}),
        "touches": len(learned),
        "learned_before": done.seen,
        "accuracy": done.answers.accuracy if learned else None,
        "called_unknown": sum(each.prediction.known is False for each in learned),
        "calibration_error": done.calibration_error,
        "confusions": [list(confusion) for confusion in done.answers.confusions()],
        "never_learned": len(never_learned),
        "never_learned_called_unknown": sum(each.prediction.known is False for each in never_learned),
        "wrong": wrong,
        **({"measured": done.measured} if done.measured else {}),
    }


def _measured_text(figures: Mapping[str, Any]) -> str:
    without = f"; {figures['without']} without a number: {shown(figures['missing'])}" if figures["without"] else ""
    if not figures["touches"]:
        return without.removeprefix("; ")
    unit = shown(figures["unit"])
    r2 = "" if figures["r2"] is None else f", R² {figures['r2']:.3f}"
    return (
        f"{percent(figures['covered'])} of {figures['touches']} in their interval, where "
        f"{percent(1 - figures['risk'])} are asked; {figures['width']:.4g} {unit} wide; "
        f"off by {figures['mean_error']:.4g} {unit}{r2}{without}"
    )


def _report_evaluated(done: Evaluation, with_learned: bool) -> None:
    from scroll_tactile.clients.learning.metrics import confusion_counts

    found, answers = _figures(done), done.answers
    if done.seen:
        what = "answered all the same" if with_learned else "left out; --with-learned answers them, too"
        say(f"[bold]touches that it has learned:[/] {done.seen}, {what}")
    names = "materials" if done.of is None else f"labels on {shown(done.of)}"
    if done.unlabelled:
        say(f"[bold]touches without a label on {shown(str(done.of))}:[/] {done.unlabelled}, left out")
    say(f"[bold]touches:[/] {found['touches']} of {len(set(answers.truth))} {names} that it learned")
    if found["touches"]:
        say(
            f"[bold]accuracy:[/] {percent(found['accuracy'])}",
            f"[bold]calibration error:[/] {found['calibration_error']:.3f}",
            f"[bold]called unknown:[/] {found['called_unknown']}",
        )
    if found["never_learned"]:
        say(
            f"[bold]touches of {names} that it never learned:[/] {found['never_learned']}, of which it calls "
            f"{found['never_learned_called_unknown']} unknown"
        )
    for name, found_of in done.measured.items():
        if not found_of:
            say(f"[bold]{shown(name)}[/]: not declared in this memory, which estimates nothing of it")
        for of, figures in found_of.items():
            say(f"[bold]{shown(name)}[/], {of} materials: {_measured_text(figures)}")
    rows = sorted({*answers.truth, *(name for name in answers.predicted if name)})
    if answers.confusions() and len(rows) <= MOST_NAMES:
        tested = [answers.truth.count(name) for name in rows]
        say(escape(confusion_text(rows, confusion_counts(rows, tested, answers.confusions()))))
    for each in done.wrong[:MOST_SHOWN]:
        say(f"  {shown(each.touch.source)}, {shown(done.truth(each))}: {verdict(each.prediction)}")
    if len(done.wrong) > MOST_SHOWN:
        say(f"  … and {len(done.wrong) - MOST_SHOWN} more, which --json lists")


def demo(
    memory: Annotated[
        Path | None, Option(help="Keep the memory in this folder. Interrupt the demo, start it again, and it goes on.")
    ] = None,
    seed: Annotated[int, Option(help="Seed of the simulated materials.")] = 0,
    sensor: Annotated[str, Option(help="biotac, roboskin, contactile, or a JSON file of one.")] = "biotac",
    features: Annotated[int, Option(min=64, help="Features of the embedding: fewer than the default, 1008.")] = 504,
    materials: Annotated[int, Option(hidden=True, min=2, max=20)] = 12,
    touches: Annotated[int, Option(hidden=True, min=1)] = 6,
    held_out: Annotated[int, Option(hidden=True, min=1)] = 4,
) -> None:
    """Ten seconds of learning: simulated materials, unknown first, then learned, and none forgotten.

    When half of them are learned, it answers touches of the others, which it has never felt; in the end of all,
    and the first 0.3 s of touches; and a process that learns is killed. It needs no data, and keeps nothing unless
    you give --memory.
    """
    from scroll_tactile.clients.learning.demo import Demo, pull_the_plug
    from scroll_tactile.sensors import read_sensor

    size = {"materials": materials, "touches": touches, "held_out": held_out, "features": features}
    task = Demo(read_sensor(sensor), seed, **size, folder=memory)
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
    answer = "never felt this" if half.known is False else f"known, as {half.nearest}"
    bits = "the very bits of a memory that nothing interrupted" if plug.same else "[bold red]not as it was[/]"
    say(
        f"[bold]learned[/] {len(first)} materials, {task.touches} touches of each: {', '.join(first)}",
        f"[bold]unknown is called unknown:[/] {half.material}, before it was learned: [bold yellow]{answer}[/] "
        f"(nearest is {half.nearest}, novelty {half.novelty:.1f})",
        f"  of {half.tested} touches of materials that it had never felt it called {half.unknown} unknown",
        f"[bold]then learned[/] {len(others)} more, {task.touches} touches of each: {', '.join(others)}",
        f"[bold]learned from {task.touches} touches:[/] {half.material}: {verdict(answers.predictions[outcome.first])}",
        f"  of {len(answers.truth)} touches held out, of all materials, it names {percent(answers.accuracy)} right",
        f"[bold]forgets nothing:[/] the first {len(first)} were named {percent(half.right)} right before the others "
        f"came, and {percent(outcome.still_right)} after",
        f"[bold]answers from 0.3 s on:[/] 0.3 s of {short.truth[0]}: {verdict(short.predictions[0])}",
        f"  of 0.3 s of a touch of every material it names {percent(short.accuracy)} right",
        f"[bold]survives the power plug:[/] a process was killed when it had reported that {plug.acknowledged} touches "
        f"were learned; its memory has {plug.found}, {bits}",
        f"[bold]observed now:[/] {outcome.observed} touches; [bold]digest:[/] {outcome.digest}",
    )
    if task.folder is not None:
        say(f"kept: try  scroll-tactile inspect {shown(task.folder / 'memory')}")


@with_options
def report(
    source: Annotated[Path, Argument(help="The folder of a memory, or a recording.", show_default=False)],
    page: Annotated[Path, Argument(help="The page to write, such as page.html.", show_default=False)],
    *,
    how: Reading,
    rate: Annotated[float | None, Option(help="Of a recording without times: readings a second.")] = None,
    sensor: Annotated[
        str | None, Option(help="Of a recording: whose readings they are, a name or a JSON file, for its range.")
    ] = None,
    labels: Annotated[
        Path | None, Option(help="Of a recording: a table that cuts it to touches and names them, as for learn.")
    ] = None,
) -> None:
    """Write a page that shows what a memory knows, or what a recording holds; any browser opens it, without network."""
    from scroll_tactile.clients.report.page import require_page, save

    require_page(page)
    chosen, whose = {**vars(how), "rate": rate}, {"sensor": sensor, "labels": labels}
    is_memory = False
    with suppress(NotAStoreError):  # of what holds no store, and may be a recording
        is_memory = source.is_dir() and holds_store(source)
    if is_memory:
        if given := [f"--{name}" for name, value in {**chosen, **whose}.items() if value is not None]:
            raise InputError(f"{', '.join(given)}: only of a recording; {source} is a memory")
        from scroll_tactile.clients.report.memory_page import memory_page

        with opened_for_upkeep(source, mode="read") as learner, progress_bar() as progress:
            html = memory_page(learner, progress=progress)
    else:
        from scroll_tactile.clients.report.recording_page import recording_page
        from scroll_tactile.recordings import read_intervals
        from scroll_tactile.sensors import read_sensor

        html = recording_page(
            source,
            sensor=None if sensor is None else read_sensor(sensor),
            intervals=None if labels is None else read_intervals(labels),
            given={name: str(word) for name, word in whose.items() if word is not None},
            **chosen,
        )
    save(html, page)
    say(f"written: {shown(page)}, {len(html.encode()) / 1e6:.1f} MB; open it with any browser")
