"""`scroll-tactile robustness`."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from scroll_tactile import plots
from scroll_tactile.cli.results import Dataset, origin, parse_folds, read, require_folders
from scroll_tactile.cli.terminal import console, percent, progress_bar, say, write_json
from scroll_tactile.datasets import Recordings
from scroll_tactile.pipelines.replay import subset
from scroll_tactile.pipelines.robustness import NAMES, SITTING, Robustness, ours, summary
from scroll_tactile.plots_robustness import draw_robustness

__all__ = ["robustness"]


class StudyChoice(StrEnum):
    """The studies, and all of them."""

    LENGTH = "length"
    SPEED = "speed"
    NOISE = "noise"
    DEAD = "dead"
    DRIFT = "drift"
    SITTING = "sitting"
    ALL = "all"


def robustness(
    study: Annotated[StudyChoice, typer.Argument(help="What is done to the test touches.", show_default=False)],
    dataset: Annotated[Dataset, typer.Argument(help="Which recordings.", show_default=False)],
    data: Annotated[Path, typer.Option(help="Folder of biotac_slide_20_50, or the one it lies in.")],
    folds: Annotated[str, typer.Option(help='Which folds: "all", or numbers from 0, such as 0 or 0,1.')] = "all",
    quick: Annotated[bool, typer.Option("--quick", help="The first of these folds, and few strengths.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Draws what is done to touches, and BioTac's folds.")] = 0,
    run: Annotated[
        Path | None, typer.Option(help="Keep finished figures in this folder; an interrupted run goes on from them.")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write all figures into this JSON file.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw accuracy against strength into this PNG.")] = None,
    materials: Annotated[int, typer.Option(hidden=True, min=2)] = 20,
) -> None:
    """Learn from clean touches, and ask about shorter, faster, noisier ones; with augmented observation and without.

    One learner, with one setting, answers all studies of a fold.
    """
    require_folders(json, plot)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        recordings = read(dataset, data, seed)
        if materials < 20:
            recordings = subset(recordings, materials)
        make, settings = ours(recordings.sensor)
        task = Robustness(
            recordings,
            {"ours": make},
            {"ours": settings},
            _studies(study, recordings),
            seed=seed,
            quick=quick,
            folder=run,
        )
        chosen = parse_folds(folds, recordings)[: 1 if quick else None]
        records = [record for fold in task.run(chosen, progress) for record in fold]
    rows = summary(records)
    _show(recordings, rows, len(chosen))
    if json is not None:
        words = ["scroll-tactile", "robustness", study.value, dataset.value, "--data", str(data), "--folds", folds]
        words += ["--seed", str(seed)] + ["--quick"] * quick
        write_json(json, {**origin(shlex.join(words), recordings), **task.plan, "means": rows, "records": records})
        say(f"figures: {json}")
    if plot is not None and plots.available():
        draw_robustness(plot, rows, title=f"{recordings.name}, learned from clean touches")
        say(f"plot: {plot}")
    elif plot is not None:
        say('[yellow]No picture: it needs matplotlib[/] (pip install "scroll-tactile\\[plots]")')


def _studies(study: StudyChoice, recordings: Recordings) -> list[str]:
    if study is not StudyChoice.ALL:
        return [study.value]
    if not recordings.ordered:
        say(f"[yellow]not measured:[/] {SITTING}: {recordings.name} is published without its order of recording")
    return [name for name in NAMES if name != SITTING or recordings.ordered]


def _show(recordings: Recordings, rows: Sequence[Mapping[str, Any]], folds: int) -> None:
    systems = list(dict.fromkeys((row["system"], row["augmented"]) for row in rows))
    count = "1 fold" if folds == 1 else f"{folds} folds"
    heads = [f"{system}, augmented" if augmented else system for system, augmented in systems]
    table = Table("study", "strength", *heads, title=f"{recordings.name}, learned from clean touches, {count}")
    cells = {(row["study"], row["strength"], row["system"], row["augmented"]): row for row in rows}
    for study in dict.fromkeys(row["study"] for row in rows):
        for strength in dict.fromkeys(row["strength"] for row in rows if row["study"] == study):
            said = [cells[study, strength, *system] for system in systems]
            shown = [percent(row["mean"]) + (f" ± {100 * row['sd']:.1f}" if row["folds"] > 1 else "") for row in said]
            table.add_row(study, "" if study == SITTING else f"{strength:g}", *shown)
        table.add_section()
    console().print(table)
