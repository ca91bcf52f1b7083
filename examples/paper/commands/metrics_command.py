"""`metrics`: the field's metrics of continual learning, of ours and its peers, and fleets that share a memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer
from rich.table import Table

from examples.paper.commands.options import Data, FewMaterials, Folds, Json, Run, Seed, machine
from examples.paper.commands.sets import (
    Dataset,
    command_line,
    origin,
    parse_folds,
    read,
    require_folders,
    write_result,
)
from examples.paper.runs.cells import Cell, Figures
from examples.paper.studies.metrics_study import METHODS, STREAMS, ContinualMetrics, summary
from examples.paper.studies.replay import subset
from scroll_tactile.cli.terminal import console, progress_bar, say
from scroll_tactile.errors import InputError

__all__ = ["metrics"]

QUICK_MATERIALS = 5
QUICK_FLEETS: dict[str, Any] = {"robots": (10,), "alphas": (0.1,)}


def metrics(
    dataset: Annotated[Dataset, typer.Argument(help="Which recordings.", show_default=False)],
    data: Data,
    folds: Folds = None,
    seed: Seed = 0,
    every: Annotated[int, typer.Option(min=1, help="Measure after every so many touches.")] = 40,
    buffer: Annotated[int, typer.Option(min=1, help="Touches in the peers' buffers.")] = 200,
    robots: Annotated[str, typer.Option(help="Of the fleets, beside one robot.")] = "10,100",
    quick: Annotated[bool, typer.Option("--quick", help="One fold of five materials, one fleet of ten.")] = False,
    run: Run = None,
    json: Json = None,
    materials: FewMaterials = 20,
    features: Annotated[int, typer.Option(hidden=True, min=64)] = 1008,
) -> None:
    """Learn a recorded set class by class and in a Si-Blurry stream; measure on the way what the field measures.

    Accuracy at the end, over tasks and at any time, forgetting, backward transfer, seconds and peak memory a task: of
    ours and of other continual learners. Then deal the touches to fleets, and merge what their robots learned.
    """
    require_folders(json)
    found: list[tuple[Cell, Figures]] = []
    with progress_bar() as progress:
        progress("reading", 0, 1)
        recordings = read(dataset, data, seed)
        most = min(materials, QUICK_MATERIALS if quick else 20)
        if most < 20:
            recordings = subset(recordings, most)
        fleets = QUICK_FLEETS if quick else {"robots": parse_robots(robots)}
        task = ContinualMetrics(recordings, seed, every, buffer, features=features, folder=run, **fleets)
        chosen = parse_folds(folds or ("0" if quick else "all"), recordings)
        for cell, figures in task.run(chosen, progress):
            found.append((cell, figures))
    means = summary(found)
    _show_streams(means)
    _show_fleets(means)
    if quick:
        say(f"[yellow]quick:[/] {most} materials, one fleet: for a look, not for a report")
    if json is not None:
        options = {"folds": folds, "seed": seed, "every": task.every, "buffer": buffer, "quick": quick}
        options |= {"robots": None if quick else robots}
        command = command_line("metrics", dataset.value, data="DATA", **options, run=None if run is None else "RUN")
        made = origin(command, recordings) | machine() | task.plan | {"folds": chosen, "methods": list(METHODS)}
        write_result(json, made | {"means": means, "cells": {cell.key: figures for cell, figures in found}})


def parse_robots(text: str) -> tuple[int, ...]:
    """The fleets of --robots. Raises InputError for anything but numbers of 1 or more."""
    words = [word.strip() for word in text.split(",")]
    if not all(word.isascii() and word.isdigit() and int(word) for word in words):
        raise InputError(f"expected --robots as numbers, such as 10,100; came {text!r}")
    return tuple(dict.fromkeys(map(int, words)))


def _show_streams(means: Mapping[str, Mapping[str, Any]]) -> None:
    for stream in STREAMS:
        table = Table("method", "A_last", "A_avg", "A_AUC", "forgetting", "seconds", "MB", title=stream)
        for method in METHODS:
            row = means[f"{stream}, {method}"]
            shares = [f"{100 * row[name]['mean']:.1f}" for name in ("last", "average", "anytime")]
            forgetting = f"{100 * row['forgetting']['mean']:.1f}" if "forgetting" in row else ""
            table.add_row(
                method, *shares, forgetting, f"{row['learning']['mean']:.2f}", f"{row['megabytes']['mean']:.0f}"
            )
        console().print(table)
    say("percent; the processor's seconds to learn a task; MB: the peak of a task, as tracemalloc sees it")


def _show_fleets(means: Mapping[str, Mapping[str, Any]]) -> None:
    table = Table("touches dealt to a", "bytes", "ours", "linear, 1 round", "20", "MLP, 1 round", "20")
    for name, row in means.items():
        if name.startswith("fleet"):
            same = "[green]the same[/]" if row["same_bytes"]["mean"] == 1 else "[red]others[/]"
            nets = (f"{net}, {rounds}" for net in ("linear", "MLP") for rounds in ("1 round", "20 rounds"))
            table.add_row(name, same, *(f"{100 * row[figure]['mean']:.1f}" for figure in ("accuracy", *nets)))
    console().print(table)
    say("percent; ours: the robots' memories merged; networks: averaged after so many rounds (FedAvg)")
