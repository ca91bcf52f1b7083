"""`replay`: a recorded set learned in one pass, fold by fold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from examples.paper import drawing as plots
from examples.paper.commands.options import Data, FewMaterials, Folds, Json, Plot, Run, Seed
from examples.paper.commands.sets import (
    Dataset,
    command_line,
    draw_into,
    origin,
    parse_folds,
    read,
    require_folders,
    with_spread,
    write_result,
)
from examples.paper.readers.labelled import Recordings
from examples.paper.studies.replay import FIGURES, PUBLISHED, Replay, subset, summary
from scroll_tactile.cli.terminal import console, percent, progress_bar, say
from scroll_tactile.pipelines.metrics import confusion_counts

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
    "twice": "… trained on half streams",
    "calibration_error": "expected calibration error, 15 bins",
    "false_alarms": "known touches called unknown",
    "wrong_known": "touches taken for another, and called known",
    "novelty_auroc": "novelty AUROC, 4 of 20 materials held out",
}


def replay(
    dataset: Annotated[Dataset, typer.Argument(help="Which recordings.", show_default=False)],
    data: Data,
    schedule: Annotated[Schedule, typer.Option(help="The order in which touches are learned.")] = Schedule.CLASSES,
    seed: Seed = 0,
    folds: Folds = "all",
    readout: Annotated[ReadoutChoice, typer.Option(help="How materials are classified.")] = ReadoutChoice.LDA,
    blocked: Annotated[
        bool, typer.Option("--blocked", help="Folds of successive repetitions (BioTac only): a harder test.")
    ] = False,
    novelty: Annotated[
        bool, typer.Option("--novelty", help="Also hold out 4 of 20 materials, five times over. Slower.")
    ] = False,
    run: Run = None,
    json: Json = None,
    plot: Plot = None,
    materials: FewMaterials = 20,
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
        task = Replay(recordings, schedule.value, seed, readout.value, blocked, novelty, folder=run)
        chosen = parse_folds(folds or "all", recordings)
        results: list[dict[str, Any]] = []
        for done in task.run(chosen, lambda what, i, of: progress(f"fold {chosen[len(results)]}: {what}", i, of)):
            results.append(done)
    _show(recordings, results, compared=materials == 20)
    if json is not None:
        settings: dict[str, Any] = {
            "schedule": schedule.value,
            "seed": seed,
            "folds": folds or "all",
            "readout": readout.value,
        }
        settings |= {"blocked": blocked, "novelty": novelty, "run": None if run is None else "RUN"}
        command = command_line("replay", dataset.value, data="DATA", **settings)
        write_result(json, origin(command, recordings) | task.plan | {"means": summary(results), "folds": results})
    if plot is not None:
        _plot(plot, recordings, results)


def _show(recordings: Recordings, results: Sequence[Mapping[str, Any]], *, compared: bool) -> None:
    means = summary(results)
    count = "1 fold" if len(results) == 1 else f"{len(results)} folds"
    table = Table("figure", "mean ± sd over folds", title=f"{recordings.name}, one pass, {count}")
    for name in FIGURES:
        if name in means:
            share = name not in ("novelty_auroc", "calibration_error")
            table.add_row(_LABELS[name], with_spread(means[name], share=share))
    if compared and recordings.name in PUBLISHED:
        ridge, tuned = PUBLISHED[recordings.name]
        table.add_section()
        table.add_row("published: ridge on a frozen vision model", percent(ridge))
        table.add_row("published: ResNet fine-tuned offline", percent(tuned))
    console().print(table)
    for result in results:
        same = "[green]yes[/]" if result["equals_offline"] else "[red]no[/]"
        say(
            f"fold {result['fold']}: {percent(result['accuracy'])} of {result['tested']} after learning "
            f"{result['learned']}; equals offline training: {same}; digest {result['digest'][:16]}; "
            f"{result['seconds']:.1f} s"
        )
    worst = sorted(_confusions(results).items(), key=lambda entry: -entry[1])[:3]
    say("worst confusions: " + ("; ".join(f"{a} taken for {b} {n}×" for (a, b), n in worst) or "none"))


def _confusions(results: Sequence[Mapping[str, Any]]) -> dict[tuple[str, str], int]:
    counts: dict[tuple[str, str], int] = {}
    for result in results:
        for truth, predicted, count in result["confusions"]:
            counts[truth, predicted] = counts.get((truth, predicted), 0) + count
    return counts


def _plot(plot: Path, recordings: Recordings, results: Sequence[Mapping[str, Any]]) -> None:
    names = list(dict.fromkeys(recordings.materials))
    confusions = [(truth, predicted, count) for (truth, predicted), count in _confusions(results).items()]
    tested = [sum(result["tested_of"].get(name, 0) for result in results) for name in names]
    counts = confusion_counts(names, tested, confusions)
    draw_into(plot, lambda file: plots.draw(file, names, counts, title=recordings.name))
