"""`robustness`: the default learner, told nothing, on shorter, faster, noisier touches, and never touched materials."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

from examples.paper.commands.options import Data, FewMaterials, Folds, Json, Run, Seed
from examples.paper.commands.sets import (
    Dataset,
    command_line,
    named,
    origin,
    parse_folds,
    read,
    require_folders,
    with_spread,
    write_result,
)
from examples.paper.studies.default_learner import Answering, Checkout, answers
from examples.paper.studies.replay import subset
from examples.paper.studies.robustness_study import FIGURES, NOW, Robustness, Series, Simulated, summary
from scroll_tactile.cli.terminal import console, percent, progress_bar
from scroll_tactile.errors import InputError

__all__ = ["robustness"]

USUAL = (Dataset.BIOTAC, Dataset.ROBOSKIN, Dataset.UNMIXED)
BEFORE = "before"
OTHERS = {
    "series": "series, split as published, at 100 Hz; a touch usually lasts as long as the median of those learned",
    "simulated": "simulated sensors that nothing was tuned on",
}


def robustness(
    data: Data,
    sets: Annotated[str, typer.Option("--set", "--sets", help=f"Which data sets, of {', '.join(Dataset)}.")] = ",".join(
        USUAL
    ),
    folds: Folds = "all",
    series: Annotated[
        Path | None, typer.Option(help="An .npz of series of other sensors: also measure these, split as published.")
    ] = None,
    before: Annotated[
        Path | None, typer.Option(help="An older checkout of the project, whose default learner is measured beside.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="The first of these sets and folds, no session and no novelty: for a look.")
    ] = False,
    seed: Seed = 0,
    run: Run = None,
    json: Json = None,
    materials: FewMaterials = 20,
) -> None:
    """Train the default learner on clean touches, nothing told to it, and test it on all that can befall a touch.

    Figures of a run's folder are read back: a changed project needs another.
    """
    require_folders(json)
    sides: dict[str, Answering] = {NOW: answers}
    if before is not None:
        sides[BEFORE] = Checkout(before)
    if series is not None and not series.is_file():
        raise InputError(f"expected sets of series in {series}; there is no such file")
    found: dict[str, dict[str, Any]] = {side: {} for side in sides}
    tested: dict[str, str] = {}
    records: list[dict[str, Any]] = []
    with progress_bar() as progress:
        for name in named("--set", sets, list(Dataset))[: 1 if quick else None]:
            progress("reading", 0, 1)
            recordings = read(Dataset(name), data, seed)
            if materials < 20:
                recordings = subset(recordings, materials)
            chosen = parse_folds(folds or "all", recordings)[: 1 if quick else None]
            task = Robustness(recordings, sides, seed, None if run is None else run / recordings.name, quick)
            own = [record for fold in task.run(chosen, progress) for record in fold]
            for side, rows in summary(own).items():
                found[side][name] = rows
            tested[name] = ", ".join(map(str, chosen))
            records += [{"dataset": name} | record for record in own]
        others = _others(series, sides, run, seed, quick=quick, few=materials < 20)
        for kind, study in others.items():
            for record in study.run(progress):
                rows = found[record["side"]].setdefault(kind, {})
                rows[record["name"]] = {figure: record[figure] for figure in FIGURES if figure in record}
                records.append(record)
    for side in sides:
        if "series" in found[side]:
            shares = [row["accuracy"] for row in found[side]["series"].values()]
            found[side]["series"]["mean"] = {"accuracy": float(np.mean(shares))}
    for name, numbers in tested.items():
        _show(name, numbers, {side: rows[name] for side, rows in found.items()})
    for kind in others:
        _show_others({side: rows[kind] for side, rows in found.items()}, OTHERS[kind])
    if json is not None:
        options: dict[str, Any] = {"data": "DATA", "sets": sets, "folds": folds or "all", "series": series}
        options |= {
            "before": None if before is None else "CHECKOUT",
            "seed": seed,
            "quick": quick,
            "run": None if run is None else "RUN",
        }
        made = origin(command_line("robustness", **options)) | {"seed": seed, "folds": tested}
        write_result(json, made | found | {"records": records})


def _others(
    series: Path | None, sides: Mapping[str, Answering], run: Path | None, seed: int, *, quick: bool, few: bool
) -> dict[str, Series | Simulated]:
    """What is measured on other sensors: series where they are given, and simulated ones."""
    folder = {kind: None if run is None else run / kind for kind in OTHERS}
    others: dict[str, Series | Simulated] = {}
    if series is not None:
        others["series"] = Series(series, sides, folder["series"])
    if not quick:
        touches = (2, 1) if few else (12, 10)
        others["simulated"] = Simulated(seed, sides, folder["simulated"], *touches)
    return others


def _show(name: str, folds: str, sides: Mapping[str, Mapping[str, Any]]) -> None:
    heads = [f"{figure}{f', {side}' * (side != NOW)}" for side in sides for figure in ("right", "ECE", "known")]
    table = Table("test touches", *heads, title=f"{name}, trained on clean touches, folds {folds}")
    for row in sides[NOW]:
        cells: list[str] = []
        for rows in sides.values():
            figures = rows[row]
            if "novelty_auroc" in figures:
                cells += [f"AUROC {figures['novelty_auroc']['mean']:.4f}", "", ""]
                continue
            error, known = figures["calibration_error"]["mean"], figures["known"]["mean"]
            cells += [with_spread(figures["accuracy"]), f"{error:.3f}", percent(known)]
        table.add_row(row, *cells)
    console().print(table)


def _show_others(sides: Mapping[str, Mapping[str, Any]], heading: str) -> None:
    heads = [f"{figure}{f', {side}' * (side != NOW)}" for side in sides for figure in ("right", "ECE", "known")]
    table = Table(heading, *heads)
    for name in sides[NOW]:
        cells: list[str] = []
        for rows in sides.values():
            figures = rows[name]
            cells.append(percent(figures["accuracy"]))
            cells += (
                [f"{figures['calibration_error']:.3f}", percent(figures["known"])] if "known" in figures else ["", ""]
            )
        table.add_row(name, *cells)
    console().print(table)
