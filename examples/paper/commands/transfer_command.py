"""`transfer`: what is learned with one task or sensor, and used with another."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from examples.paper.commands.options import (
    Device,
    Epochs,
    Folds,
    InPrecision,
    Json,
    Plot,
    PrecisionChoice,
    Run,
    Seed,
    Where,
    machine,
)
from examples.paper.commands.sets import (
    command_line,
    draw_into,
    named,
    origin,
    parse_folds,
    require_folders,
    with_spread,
    write_result,
)
from examples.paper.plots import draw_transfer
from examples.paper.readers import fabric_slide, letter_spike, physiclear
from examples.paper.readers.biotac_slide import load
from examples.paper.readers.labelled import Recordings
from examples.paper.runs.cells import Cell, Figures
from examples.paper.transfer.across_sensors import WAYS, SensorTransfer
from examples.paper.transfer.across_sensors import rows as sensor_rows
from examples.paper.transfer.few_touches import COUNTS
from examples.paper.transfer.tasks import TRAINING, TaskTransfer, rows, some_frames
from scroll_tactile.cli.terminal import Commands, console, percent, progress_bar, say
from scroll_tactile.errors import DatasetError, InputError

__all__ = ["transfer"]

transfer = typer.Typer(cls=Commands, no_args_is_help=True, help="Train with one task or sensor, test with another.")


def _slides(data: Path, seed: int) -> Recordings:
    """FabricSlide over distance, as ratios: how fast and how hard it was slid is no property of the fabric."""
    slides = fabric_slide.load(data, seed=seed).recordings
    return replace(
        slides, sensor=fabric_slide.CPM_RATIOS, streams=[fabric_slide.ratios(item) for item in slides.streams]
    )


SETS: dict[str, Callable[[Path, int], Recordings]] = {
    "biotac-20": lambda data, seed: load(data, "biotac", seed),
    "roboskin-20": lambda data, seed: load(data, "roboskin", seed),
    "letter-spike": letter_spike.load,
    "fabric-slide": _slides,
    "gelsight": physiclear.load,
}
QUICK_SETS = ("biotac-20", "roboskin-20")
QUICK = {"epochs": 3, "draws": 2, "every": 2}
EPOCHS, DRAWS = 6, 3

Data = Annotated[Path, typer.Option(help="Folder with the data sets' folders, as published, in it.")]


@transfer.command()
def tasks(
    data: Data,
    weights: Annotated[str, typer.Option(help="Of a trained ResNet: a file, or a published name such as resnet18.")],
    sets: Annotated[str | None, typer.Option(help=f"Which data sets, two or more of {', '.join(SETS)}.")] = None,
    sources: Annotated[str | None, typer.Option(help="Which of them to fine-tune on; all unless given.")] = None,
    folds: Folds = "0",
    counts: Annotated[str, typer.Option(help="Touches of each material learned before a test.")] = "1,2,5,10,20",
    draws: Annotated[int | None, typer.Option(min=1, help="Of the touches that are learned.")] = None,
    frames: Annotated[int, typer.Option(min=1, help="Of each video of a camera.")] = 2,
    epochs: Epochs = None,
    device: Where = Device.CPU,
    precision: InPrecision = PrecisionChoice.FLOAT32,
    seed: Seed = 0,
    quick: Annotated[
        bool, typer.Option("--quick", help="Two sets, 3 epochs on every second touch, 2 draws: minutes, for a look.")
    ] = False,
    run: Run = None,
    json: Json = None,
    plot: Plot = None,
) -> None:
    """Fine-tune the vision model on each data set, freeze it, and learn few touches of every other with it."""
    require_folders(json, plot)
    stops = _counts(counts)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        by_name = {name: some_frames(item, frames) for name, item in _read(sets, data, seed, quick).items()}
        read = [*by_name.values()]
        study = TaskTransfer(
            read,
            weights,
            folds=tuple(parse_folds(folds or "0", read[0])),
            counts=stops,
            draws=draws or (QUICK["draws"] if quick else DRAWS),
            epochs=epochs or (QUICK["epochs"] if quick else EPOCHS),
            device=device.value,
            precision=precision.value,
            every=QUICK["every"] if quick else 1,
            seed=seed,
            folder=run,
            sources=None if sources is None else _named(sources, by_name),
        )
        results = list(study.run(progress))
    found = rows(results)
    _show_tasks(study, results, found)
    if json is not None:
        options = {"weights": Path(weights), "sets": sets, "sources": sources, "counts": counts, "draws": study.draws}
        options |= {"frames": frames, "epochs": study.epochs, "device": study.device, "precision": study.precision}
        _write(json, "tasks", study, results, options | {"quick": quick}, {"frames": frames, "rows": found})
    draw_into(plot, lambda file: draw_transfer(file, found))


@transfer.command()
def sensors(
    data: Annotated[Path, typer.Option(help="Folder with biotac_slide_20_50/ in it.")],
    folds: Folds = "all",
    ways: Annotated[str | None, typer.Option(help=f"Which ways, of {', '.join(WAYS)}.")] = None,
    counts: Annotated[str, typer.Option(help="Touches of each material of the new sensor; 0: none.")] = "0,1,2,5",
    draws: Annotated[int, typer.Option(min=1, help="Of these touches.")] = 5,
    seed: Seed = 0,
    quick: Annotated[bool, typer.Option("--quick", help="The first fold, one draw: for a look.")] = False,
    run: Run = None,
    json: Json = None,
) -> None:
    """Learn twenty materials with BioTac and be tested with RoboSkin, and the reverse, after few touches or none."""
    require_folders(json)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        pair = (load(data, "biotac", seed), load(data, "roboskin", seed))
        study = SensorTransfer(
            pair,
            ways=tuple(WAYS) if ways is None else tuple(dict.fromkeys(part.strip() for part in ways.split(","))),
            folds=(0,) if quick else tuple(parse_folds(folds or "all", pair[0])),
            counts=_counts(counts),
            draws=1 if quick else draws,
            seed=seed,
            folder=run,
        )
        results = list(study.run(progress))
        progress("how far the sensors agree", 0, 1)
        agreement = study.agreement()
    found = sensor_rows(results)
    _show_sensors(study, found, agreement)
    if json is not None:
        options = {"ways": ",".join(study.ways), "counts": counts, "draws": study.draws}
        measured = {"folds": study.folds, "chance": study.chance, "agreement": agreement, "rows": found}
        _write(json, "sensors", study, results, options, measured)


def _counts(asked: str) -> tuple[int, ...]:
    try:
        return tuple(sorted({int(part) for part in asked.split(",")}))
    except ValueError:
        usual = ",".join(map(str, COUNTS))
        raise InputError(f"expected --counts as numbers such as {usual}; came {asked!r}") from None


def _named(asked: str, read: Mapping[str, Recordings]) -> tuple[str, ...]:
    """What the data sets call themselves that are asked for by their names on the command line."""
    return tuple(read[name].name for name in named("--sources", asked, read))


def _read(asked: str | None, data: Path, seed: int, quick: bool) -> dict[str, Recordings]:
    names = named("--sets", asked, SETS) if asked is not None else tuple(QUICK_SETS if quick else SETS)
    try:
        return {name: SETS[name](data, seed) for name in names}
    except DatasetError as error:
        error.add_note(f"Or name the sets that are there: --sets {','.join(QUICK_SETS)}")
        raise


def _show_tasks(
    study: TaskTransfer, results: Sequence[tuple[Cell, Figures]], found: Sequence[Mapping[str, Any]]
) -> None:
    for item in study.sets:
        mine = [row for row in found if row["dataset"] == item.name]
        counts = list(mine[0]["points"])
        title = f"{item.name}: right, after so many touches of each material; {study.draws} draws, folds {study.folds}"
        table = Table("embedding", *counts, title=title)
        for row in mine:
            mark = " (its own)" if row["tuned on"] == item.name else ""
            table.add_row(row["system"] + mark, *(with_spread(row["points"][count]) for count in counts))
        console().print(table)
    trained = [(cell, figures) for cell, figures in results if cell.system == TRAINING]
    text = ", ".join(f"{cell.dataset} {percent(figures['right'] / figures['tested'])}" for cell, figures in trained)
    say(f"the fine-tuned networks on their own test, after {study.epochs} epochs: {text}")


def _show_sensors(
    study: SensorTransfer, found: Sequence[Mapping[str, Any]], agreement: Mapping[str, Mapping[str, float]]
) -> None:
    for direction in dict.fromkeys(row["direction"] for row in found):
        title = f"{direction}: right, after so many touches of each material with the new sensor; {study.draws} draws"
        table = Table("way", *map(str, study.counts), title=title)
        for row in found:
            if row["direction"] == direction:
                points = [row["points"].get(str(count)) for count in study.counts]
                table.add_row(row["name"], *map(with_spread, points))
        console().print(table)
    text = ", ".join(f"{item['correlation']:+.2f} in {kind} ({item['chance']:.2f})" for kind, item in agreement.items())
    say(
        f"chance: {percent(study.chance)}. Which materials feel alike, one sensor against the other: {text} (by chance)"
    )


def _write(
    path: Path,
    part: str,
    study: TaskTransfer | SensorTransfer,
    results: Sequence[tuple[Cell, Figures]],
    options: Mapping[str, Any],
    measured: Mapping[str, Any],
) -> None:
    folds, run = ",".join(map(str, study.folds)), None if study.folder is None else "RUN"
    command = command_line("transfer", part, data="DATA", folds=folds, **options, seed=study.seed, run=run)
    sensors = {recordings.name: recordings.sensor.model_dump(mode="json") for recordings in study.sets}
    cells = {cell.key: figures for cell, figures in results}
    write_result(path, origin(command) | machine() | study.plan | {"sensors": sensors, **measured, "cells": cells})
