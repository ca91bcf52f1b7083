"""`scroll-tactile reproduce`: the paper's tables and figures, from one's own copy of the data."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from rich.table import Table

from scroll_tactile import plots
from scroll_tactile.cli.results import origin, parse_folds, require_folders
from scroll_tactile.cli.terminal import Commands, console, percent, progress_bar, say, write_json
from scroll_tactile.datasets import Recordings, physiclear
from scroll_tactile.datasets.biotac_slide import load
from scroll_tactile.errors import InputError
from scroll_tactile.pipelines.cells import Cell, Figures
from scroll_tactile.pipelines.efficiency import Efficiency, curves
from scroll_tactile.pipelines.systems.catalogue import EPOCHAL, NEED_WEIGHTS, SYSTEMS
from scroll_tactile.pipelines.table1 import PAPER, Study, Table1, blocked, rows
from scroll_tactile.plots_efficiency import draw_efficiency

__all__ = ["reproduce"]

reproduce = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    help="Measure what the paper measured, and ours beside it, on one's own copy of the data.",
)


class Device(StrEnum):
    """Where networks are trained."""

    CPU = "cpu"
    CUDA = "cuda"


SETS: dict[str, Callable[[Path, int], Recordings]] = {
    "biotac-20": lambda data, seed: load(data, "biotac", seed),
    "biotac-20-blocked": lambda data, seed: blocked(load(data, "biotac", seed)),
    "roboskin-20": lambda data, seed: load(data, "roboskin", seed),
    "gelsight": physiclear.load,
}
QUICK_SETS = ("biotac-20", "roboskin-20")
CURVES = ("resnet", "resnet-pretrained", "kernels-lda", "vision-lda", "kernels+vision-lda")
QUICK_EPOCHS = 3
EPOCH_COLUMNS = (1, 2, 5, 10, 20)  # of the table of efficiency

Data = Annotated[Path, typer.Option(help="Folder with biotac_slide_20_50/ in it, and physiclear/ for gelsight.")]
Weights = Annotated[
    str | None,
    typer.Option(help="Of a trained ResNet: a file, or a published name such as resnet18. Without, rows are left out."),
]
Sets = Annotated[str | None, typer.Option(help=f"Which data sets, of {', '.join(SETS)}.")]
Systems = Annotated[str | None, typer.Option(help=f"Which systems, of {', '.join(SYSTEMS)}.")]
Folds = Annotated[str | None, typer.Option(help='"all", or numbers from 0, such as 0 or 0,1.')]
Epochs = Annotated[int | None, typer.Option(min=1, help="Of the networks' training.")]
Where = Annotated[Device, typer.Option(help="Where networks are trained.")]
Seed = Annotated[int, typer.Option(min=0, help="Of all that is drawn.")]
Quick = Annotated[
    bool, typer.Option("--quick", help="One fold, every second touch, small images, 3 epochs: minutes, for a look.")
]
Run = Annotated[
    Path | None,
    typer.Option("--run", "--resume", help="Write finished cells into this folder; a killed run goes on from it."),
]
Json = Annotated[Path | None, typer.Option(help="Write all figures into this JSON file.")]
Plot = Annotated[Path | None, typer.Option(help="Draw the curves into this file.")]


@reproduce.command()
def table1(
    data: Data,
    weights: Weights = None,
    sets: Sets = None,
    systems: Systems = None,
    folds: Folds = None,
    epochs: Epochs = None,
    device: Where = Device.CPU,
    seed: Seed = 0,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
) -> None:
    """Table I: every system on every data set, with the paper's figure beside ours and the difference.

    100 epochs, five folds: hours on a GPU, days without. --systems and --folds take parts of it, --run adds them up.
    """
    require_folders(json)
    keys = _systems(systems, tuple(SYSTEMS), weights)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        read = _read(sets, tuple(SETS), data, seed, quick)
        study = Table1(read, keys, weights, epochs or (QUICK_EPOCHS if quick else 100), device.value, seed, quick, run)
        results = list(study.run(_folds(folds, read, quick), progress))
    found = rows(results)
    for recordings in read:
        _show_table(recordings.name, found, study)
    if any(one.sensor.camera for one in read):
        say(
            "GelSight frames are those of PhysiCLeAR, split by video: the paper's GelSight-45 is not public, and its "
            "figures stand beside nothing of ours: "
            + "; ".join(f"{SYSTEMS[k]} {percent(p['GelSight-45'])}" for k, p in PAPER.items() if "GelSight-45" in p)
        )
    _close(study, results, json, {"rows": found}, sets, folds)


@reproduce.command()
def efficiency(
    data: Data,
    weights: Weights = None,
    sets: Sets = None,
    systems: Systems = None,
    folds: Folds = None,
    epochs: Epochs = None,
    device: Where = Device.CPU,
    seed: Seed = 0,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
    plot: Plot = None,
) -> None:
    """Learning efficiency: the test after each of 20 epochs of the ResNets; ours after 1 to 40 touches of a material.

    Of the paper's figure there are curves only, no numbers; its final accuracies are those of table1.
    """
    require_folders(json, plot)
    keys = _systems(systems, CURVES, weights)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        read = _read(sets, QUICK_SETS, data, seed, quick)
        few = epochs or (QUICK_EPOCHS if quick else 20)
        study = Efficiency(read, keys, weights, few, device.value, seed, quick, run)
        results = list(study.run(_folds(folds, read, quick), progress))
    found = curves(results)
    for recordings in read:
        mine = [curve for curve in found if curve["dataset"] == recordings.name]
        _show_curves(f"{recordings.name}: after so many epochs", [one for one in mine if one["by"] == "epochs"])
        title = f"{recordings.name}: one pass, after so many touches of each material"
        _show_curves(title, [one for one in mine if one["by"] == "streams"])
    _close(study, results, json, {"curves": found}, sets, folds)
    if plot is not None and not plots.available():
        say('[yellow]No picture: it needs matplotlib[/] (pip install "scroll-tactile\\[plots]")')
    elif plot is not None:
        draw_efficiency(plot, found)
        say(f"plot: {plot}")


def _systems(asked: str | None, usual: Sequence[str], weights: str | None) -> tuple[str, ...]:
    """The systems of --systems; without it all that can be made, and a word on the others."""
    if asked is not None:
        keys = tuple(dict.fromkeys(part.strip() for part in asked.split(",")))
        if strange := [key for key in keys if key not in SYSTEMS]:  # before anything is read
            raise InputError(f"expected --systems out of {', '.join(SYSTEMS)}; came {', '.join(map(repr, strange))}")
        return keys
    if weights is not None:
        return tuple(usual)
    out = [key for key in usual if key in NEED_WEIGHTS]
    say(f"[yellow]Left out without --weights:[/] {', '.join(out)}")
    return tuple(key for key in usual if key not in out)


def _read(asked: str | None, usual: Sequence[str], data: Path, seed: int, quick: bool) -> list[Recordings]:
    names = list(dict.fromkeys(part.strip() for part in asked.split(","))) if asked is not None else list(usual)
    if asked is None and quick:
        names = [name for name in names if name in QUICK_SETS]
    if strange := [name for name in names if name not in SETS]:
        raise InputError(f"expected --sets out of {', '.join(SETS)}; came {', '.join(map(repr, strange))}")
    return [SETS[name](data, seed) for name in names]


def _folds(asked: str | None, read: Sequence[Recordings], quick: bool) -> dict[str, list[int]]:
    wanted = asked if asked is not None else ("0" if quick else "all")
    return {one.name: parse_folds(wanted, one) for one in read}


def _show_table(dataset: str, found: Sequence[Mapping[str, Any]], study: Study) -> None:
    table = Table("system", "paper", "here", "difference", "folds", "seconds", title=dataset)
    for row in found:
        figures = row["sets"].get(dataset)
        if figures is None:
            continue
        paper, apart = figures["paper"], figures["difference"]
        vote = f" (vote of a recording {percent(figures['vote'])})" if "vote" in figures else ""
        table.add_row(
            row["system"],
            "" if paper is None else percent(paper),
            percent(figures["mean"]) + (f" ± {100 * figures['sd']:.1f}" if figures["folds"] > 1 else "") + vote,
            "" if apart is None else f"{100 * apart:+.1f}",
            str(figures["folds"]),
            f"{figures['seconds']:.0f}",
        )
    console().print(table)
    _say_conditions(study)


def _show_curves(title: str, found: Sequence[Mapping[str, Any]]) -> None:
    if not found:
        return
    places = sorted({int(point[0]) for curve in found for point in curve["points"]})
    if found[0]["by"] == "epochs":
        places = sorted({at for at in places if at in EPOCH_COLUMNS} | {places[-1]})
    table = Table("system", *map(str, places), "folds", title=title)
    for curve in found:
        shares = {int(at): percent(mean) for at, mean, _ in curve["points"]}
        table.add_row(curve["system"], *(shares.get(at, "") for at in places), str(curve["folds"]))
    console().print(table)


def _say_conditions(study: Study) -> None:
    """What the figures have to be read with."""
    if any(key in EPOCHAL for key in study.systems):
        short = "" if study.epochs >= 100 else " where the paper has 100"
        say(f"networks: {study.epochs} epochs{short}, on {study.device}; a tenth of what is learned is the validation")
    if study.quick:
        say(
            "[yellow]quick:[/] learned from every second touch; the ResNets' images averaged to about 50 columns: "
            "for a look, not for a report"
        )


def _close(
    study: Study,
    results: Sequence[tuple[Cell, Figures]],
    json: Path | None,
    found: Mapping[str, Any],
    sets: str | None,
    folds: str | None,
) -> None:
    """Tell of folds of unequal size, and write the JSON."""
    for one in study.sets:
        sizes = {cell.fold: figures["tested"] for cell, figures in results if cell.dataset == one.name}
        if len(set(sizes.values())) > 1:
            say(
                f"{one.name}: folds of unequal size, {', '.join(map(str, sizes.values()))}: every touch counts the same"
            )
    if json is None:
        return
    sensors = {one.name: one.sensor.model_dump(mode="json") for one in study.sets}
    threads = {"processors": os.cpu_count(), "threads": torch.get_num_threads()}
    seconds = {"seconds": sum(figures["seconds"] for _, figures in results)}
    cells = {cell.key: figures for cell, figures in results}
    write_json(
        json,
        origin(_command(study, sets, folds))
        | threads
        | study.plan
        | seconds
        | {"sensors": sensors, **found, "cells": cells},
    )
    say(f"figures: {json}")


def _command(study: Study, sets: str | None, folds: str | None) -> str:
    words = ["scroll-tactile", "reproduce", study.name, "--data", "DATA", "--systems", ",".join(study.systems)]
    words += ["--sets", sets] if sets is not None else []
    words += ["--folds", folds] if folds is not None else []
    words += ["--weights", Path(study.weights).name] if study.weights is not None else []
    words += ["--epochs", str(study.epochs), "--device", study.device, "--seed", str(study.seed)]
    words += ["--quick"] * study.quick + (["--run", "RUN"] if study.folder is not None else [])
    return shlex.join(words)
