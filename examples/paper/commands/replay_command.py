"""`scroll-tactile replay`."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from examples.paper.commands.sets import Dataset, draw_into, origin, parse_folds, read, require_folders
from examples.paper.plots import drawing as plots
from examples.paper.studies.replay import FIGURES, PUBLISHED, Replay, subset, summary
from scroll_tactile.cli.terminal import console, percent, progress_bar, say, write_json
from scroll_tactile.datasets import Recordings

__all__ = ["replay"]


class Schedule(StrEnum):
    """The names of `arrange`."""

    CLASSES = "class-by-class"
    REVERSED = "reversed"
    SHUFFLED = "shuffled"
    BATCHES = "batches"
    INTERLEAVED = "interleaved"


class ReadoutChoice(StrEnum):
    """The readouts."""

    LDA = "lda"
    RIDGE = "ridge"


_LABELS = {
    "accuracy": "accuracy after the last material",
    "first": "… from the first 0.3 s",
    "half": "… from half streams",
    "twice": "… learned from half streams",
    "calibration_error": "expected calibration error, 15 bins",
    "false_alarms": "known touches called unknown",
    "novelty_auroc": "novelty AUROC, 4 of 20 materials held out",
}


def replay(
    dataset: Annotated[Dataset, typer.Argument(help="Which recordings.", show_default=False)],
    data: Annotated[Path, typer.Option(help="Folder of biotac_slide_20_50, or the one it lies in.")],
    schedule: Annotated[Schedule, typer.Option(help="The order in which touches are learned.")] = Schedule.CLASSES,
    seed: Annotated[int, typer.Option(min=0, help="Draws the order, and BioTac's folds.")] = 0,
    folds: Annotated[str, typer.Option(help='Which folds: "all", or numbers from 0, such as 0 or 0,1.')] = "all",
    memory: Annotated[
        Path | None, typer.Option(help="Keep each fold's memory here; an interrupted replay goes on from it.")
    ] = None,
    readout: Annotated[ReadoutChoice, typer.Option(help="How materials are told apart.")] = ReadoutChoice.LDA,
    blocked: Annotated[
        bool, typer.Option("--blocked", help="Folds of successive repetitions (BioTac only): a harder test.")
    ] = False,
    novelty: Annotated[
        bool, typer.Option("--novelty", help="Also hold out 4 of 20 materials, five times over. Slower.")
    ] = False,
    curve: Annotated[
        int, typer.Option(min=0, max=20, help="Test after every so many twentieths of the pass; 0: only at its end.")
    ] = 0,
    json: Annotated[Path | None, typer.Option(help="Write all figures into this JSON file.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw confusions, and the curve, into this PNG.")] = None,
    materials: Annotated[int, typer.Option(hidden=True, min=2)] = 20,
) -> None:
    """Learn a recorded set in one pass, fold by fold, and test it on what was held out.

    Nothing is revisited. Afterwards the same touches are learned in another order: the memory must be the same to
    the bit, so that learning one by one loses nothing against training on everything at once.
    """
    require_folders(json, plot)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        recordings = read(dataset, data, seed)
        if materials < 20:
            recordings = subset(recordings, materials)
        task = Replay(recordings, schedule.value, seed, readout.value, blocked, curve, novelty, folder=memory)
        chosen = parse_folds(folds, recordings)
        results: list[dict[str, Any]] = []
        for done in task.run(chosen, lambda what, at, of: progress(f"fold {chosen[len(results)]}: {what}", at, of)):
            results.append(done)
    _show(recordings, results, compared=materials == 20)
    if json is not None:
        command = _command(dataset, data, task, folds)
        write_json(json, _result(command, task, results))
        say(f"figures: {json}")
    if plot is not None:
        _plot(plot, recordings, results)


def _show(recordings: Recordings, results: Sequence[Mapping[str, Any]], *, compared: bool) -> None:
    means = summary(results)
    count = "1 fold" if len(results) == 1 else f"{len(results)} folds"
    table = Table("figure", "mean", "sd over folds", title=f"{recordings.name}, one pass, {count}")
    for name in FIGURES:
        if name in means:
            mean, spread = means[name]["mean"], means[name]["sd"]
            areas = name in ("novelty_auroc", "calibration_error")
            shown = (f"{mean:.4f}", f"{spread:.4f}") if areas else (percent(mean), percent(spread))
            table.add_row(_LABELS[name], shown[0], shown[1] if len(results) > 1 else "")
    if compared and recordings.name in PUBLISHED:
        ridge, tuned = PUBLISHED[recordings.name]
        table.add_section()
        table.add_row("published: ridge on a frozen vision model", percent(ridge), "")
        table.add_row("published: ResNet fine-tuned offline", percent(tuned), "")
    console().print(table)
    for result in results:
        same = "[green]yes[/]" if result["equals_offline"] else "[red]no[/]"
        say(
            f"fold {result['fold']}: {percent(result['accuracy'])} of {result['tested']} after learning "
            f"{result['learned']}; equals offline training: {same}; digest {result['digest'][:16]}; "
            f"{result['seconds']:.1f} s"
        )
        if result["curve"]:
            say("  accuracy over materials met: " + ", ".join(f"{met}: {percent(a)}" for met, a in result["curve"]))
    worst = sorted(_confusions(results).items(), key=lambda entry: -entry[1])[:3]
    say("worst confusions: " + ("; ".join(f"{a} taken for {b} {n}×" for (a, b), n in worst) or "none"))


def _confusions(results: Sequence[Mapping[str, Any]]) -> dict[tuple[str, str], int]:
    counts: dict[tuple[str, str], int] = {}
    for result in results:
        for truth, said, count in result["confusions"]:
            counts[truth, said] = counts.get((truth, said), 0) + count
    return counts


def _command(dataset: Dataset, data: Path, task: Replay, folds: str) -> str:
    words = ["scroll-tactile", "replay", dataset.value, "--data", str(data), "--schedule", task.schedule]
    words += ["--seed", str(task.seed), "--folds", folds, "--readout", task.readout]
    words += ["--blocked"] * task.blocked + ["--novelty"] * task.novelty
    words += ["--curve", str(task.curve)] * bool(task.curve)
    words += ["--memory", str(task.folder)] if task.folder is not None else []
    return shlex.join(words)


def _result(command: str, task: Replay, results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    return {
        **origin(command, task.recordings),
        **task.plan,
        "means": summary(results),
        "folds": list(results),
    }


def _plot(plot: Path, recordings: Recordings, results: Sequence[Mapping[str, Any]]) -> None:
    names = list(dict.fromkeys(recordings.materials))
    confusions = [(truth, said, count) for (truth, said), count in _confusions(results).items()]
    tested = [sum(result["tested_of"].get(name, 0) for result in results) for name in names]
    counts = plots.confusion_counts(names, tested, confusions)
    curves = [result["curve"] for result in results]
    draw_into(plot, lambda file: plots.draw(file, names, counts, title=recordings.name, curves=curves))
