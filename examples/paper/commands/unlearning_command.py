"""`unlearning`: touches come and go; our bytes, and the rounding of what is followed in float64."""

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
from examples.paper.studies.replay import subset
from examples.paper.studies.unlearning_study import PENALTIES, WAYS, Unlearning, summary
from scroll_tactile.cli.terminal import console, progress_bar, say

__all__ = ["unlearning"]

QUICK_MATERIALS = 5
QUICK_CHECKPOINTS = (1, 10, 50)


def unlearning(
    dataset: Annotated[Dataset, typer.Argument(help="Which recordings.", show_default=False)],
    data: Data,
    folds: Folds = None,
    seed: Seed = 0,
    quick: Annotated[bool, typer.Option("--quick", help="One fold of five materials, fifty requests.")] = False,
    run: Run = None,
    json: Json = None,
    materials: FewMaterials = 20,
    features: Annotated[int, typer.Option(hidden=True, min=64)] = 1008,
) -> None:
    """Let touches come and go, a thousand requests, and compare what is left with starting anew.

    Ours must have the bytes of a memory that never had what went. Beside it: ridge heads that Woodbury's identity
    follows in float64, as exact federated continual unlearning and ACIL do, and their relative error.
    """
    require_folders(json)
    found: list[tuple[Cell, Figures]] = []
    with progress_bar() as progress:
        progress("reading", 0, 1)
        recordings = read(dataset, data, seed)
        most = min(materials, QUICK_MATERIALS if quick else 20)
        if most < 20:
            recordings = subset(recordings, most)
        settings: dict[str, Any] = {"checkpoints": QUICK_CHECKPOINTS} if quick else {}
        task = Unlearning(recordings, seed=seed, features=features, folder=run, **settings)
        chosen = parse_folds(folds or ("0" if quick else "all"), recordings)
        for cell, figures in task.run(chosen, progress):
            found.append((cell, figures))
    means = summary(found)
    _show(means)
    if json is not None:
        options = {"folds": folds, "seed": seed, "quick": quick, "run": None if run is None else "RUN"}
        command = command_line("unlearning", dataset.value, data="DATA", **options)
        made = origin(command, recordings) | machine() | task.plan | {"folds": chosen}
        write_result(json, made | {"means": means, "cells": {cell.key: figures for cell, figures in found}})


def _show(means: Mapping[str, Any]) -> None:
    after = list(means["same_bytes"])
    table = Table("relative error of the head, the largest over folds", *(f"{count} requests" for count in after))
    table.add_row("ours: the same bytes", *("yes" if means["same_bytes"][count] else "[red]no[/]" for count in after))
    table.add_row("ours", *(f"{means['ours'][count]:.0e}" for count in after))
    for penalty in (f"{penalty:g}" for penalty in PENALTIES):
        table.add_section()
        for way in WAYS:
            errors = [means["peer"][penalty][way][count] for count in after]
            table.add_row(f"λ = {penalty}: {WAYS[way]}", *("diverged" if e is None else f"{e:.0e}" for e in errors))
    console().print(table)
    answers = "the same in every bit" if means["same_answers"] else "[red]other ones[/]"
    took = f"{means['ours_ms']:.0f} of ours, {means['peer_ms']:.0f} of the peer's"
    say(f"answers after the last request: {answers}; the processor's ms a request: {took}")
