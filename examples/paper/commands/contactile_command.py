"""`fabric contactile`: the paper's third task, on a published set of fabrics or on simulated ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from examples.paper.commands.options import Device, Json, Run, Seed, Where, machine
from examples.paper.commands.sets import command_line, leave_out, named, origin, require_folders, write_result
from examples.paper.fabric import fabrics_set as published
from examples.paper.fabric.contactile_rows import EPOCHAL, NEED_BIOTAC, NEED_WEIGHTS, PAPER_EPOCHS, ROWS
from examples.paper.fabric.contactile_study import HAND, PARTS, Contactile, rows, simulated
from examples.paper.fabric.fabrics_set import Fabrics
from examples.paper.readers import biotac_slide
from scroll_tactile.cli.terminal import console, percent, progress_bar, say
from scroll_tactile.errors import InputError

__all__ = ["contactile"]

QUICK = {"epochs": 4, "biotac_epochs": 2, "every": 12, "take": 8}

Data = Annotated[Path | None, typer.Option(help="Folder of a published set: touches and compositions.csv.")]
Simulated = Annotated[bool, typer.Option("--simulated", help="Simulated fabrics in the place of a published set.")]
Size = Annotated[str, typer.Option(help="Of the simulated set: fabrics, touches of each by robot, and by hand.")]
Pattern = Annotated[
    str | None, typer.Option(help="Regular expression for the touches' paths, with groups fabric and protocol.")
]
Limits = Annotated[str | None, typer.Option(help="Least and largest reading of the array, such as -5,5.")]
Constituents = Annotated[str | None, typer.Option(help="Columns of compositions.csv that are constituents; else all.")]
BioTac = Annotated[Path | None, typer.Option(help="Folder with biotac_slide_20_50/, for the rows that begin there.")]
Weights = Annotated[
    str | None, typer.Option(help="Of a trained ResNet: a file, or resnet18. Without, rows are left out.")
]
Rows = Annotated[str | None, typer.Option("--rows", help=f"Which rows, of {', '.join(ROWS)}.")]
Parts = Annotated[str | None, typer.Option(help=f"What is tested, of {', '.join(PARTS)}; both unless given.")]
Epochs = Annotated[int | None, typer.Option(min=1, help=f"Of the networks on fabrics; the paper has {PAPER_EPOCHS}.")]
BioTacEpochs = Annotated[int | None, typer.Option(min=1, help="Of the network on BioTac.")]
Every = Annotated[
    int | None, typer.Option(min=1, help="Average so many columns of the images that the paper's rows read.")
]
Take = Annotated[int | None, typer.Option(min=1, help="Learn one of so many touches.")]
Quick = Annotated[
    bool, typer.Option("--quick", help=f"For a look: {', '.join(f'{name} {value}' for name, value in QUICK.items())}.")
]


def contactile(
    data: Data = None,
    by_simulation: Simulated = False,
    size: Size = "32,40,10",
    pattern: Pattern = None,
    limits: Limits = None,
    constituents: Constituents = None,
    biotac: BioTac = None,
    weights: Weights = None,
    which: Rows = None,
    parts: Parts = None,
    epochs: Epochs = None,
    biotac_epochs: BioTacEpochs = None,
    every: Every = None,
    take: Take = None,
    device: Where = Device.CPU,
    seed: Seed = 0,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
) -> None:
    """Learn fabrics as a robot touches them, and compose what they are made of when a hand does: the paper's Table III.

    50 epochs for each network: hours on a GPU, days without. --rows takes parts of it, --run adds them up.
    """
    require_folders(json)
    if (data is None) != by_simulation:
        raise InputError("expected --data, the folder of a published set, or --simulated, and not both")
    wanted = _choose(which, weights, biotac)
    asked = tuple(PARTS) if parts is None else tuple(dict.fromkeys(part.strip() for part in parts.split(",")))
    usual = QUICK if quick else {"epochs": PAPER_EPOCHS, "biotac_epochs": PAPER_EPOCHS, "every": 1, "take": 1}
    given = {"epochs": epochs, "biotac_epochs": biotac_epochs, "every": every, "take": take}
    settings = {name: usual[name] if value is None else value for name, value in given.items()}
    with progress_bar() as progress:
        progress("reading", 0, 1)
        if data is None:
            fabrics = _simulate(size, seed)
        else:
            names = None if constituents is None else [item.strip() for item in constituents.split(",")]
            fabrics = published.load(data, seed, pattern=pattern, limits=_limits(limits), constituents=names)
        touched = None
        if biotac is not None and any(key in NEED_BIOTAC for key in wanted):
            touched = biotac_slide.load(biotac, "biotac", seed)
        study = Contactile(fabrics, wanted, weights, touched, device=device.value, seed=seed, folder=run, **settings)
        results = list(study.run(asked, progress))
    source: dict[str, Any] = {"simulated": True, "size": size}
    if data is not None:
        source = {"data": data.name, "limits": limits, "pattern": pattern, "constituents": constituents}
    _close(study, results, json, source)


def _choose(asked: str | None, weights: str | None, biotac: Path | None) -> tuple[str, ...]:
    """The rows of --rows; without it all that can be made, and a word on the others."""
    keys = tuple(ROWS) if asked is None else named("--rows", asked, ROWS)
    for option, given, needing in (("--weights", weights, NEED_WEIGHTS), ("--biotac", biotac, NEED_BIOTAC)):
        if given is not None:
            continue
        if asked is None:
            keys = leave_out(keys, needing, option)
        elif without := [key for key in keys if key in needing]:
            raise InputError(f"{', '.join(without)} need {option}")
    return keys


def _simulate(size: str, seed: int) -> Fabrics:
    try:
        count, robot, hand = (int(part) for part in size.split(","))
    except ValueError:
        raise InputError(f"expected --size as three whole numbers, such as 32,40,10; came {size!r}") from None
    return simulated(seed, count, robot, hand)


def _limits(limits: str | None) -> tuple[float, float] | None:
    if limits is None:
        return None
    try:
        low, high = (float(part) for part in limits.split(","))
    except ValueError:
        raise InputError(f"expected --limits as two numbers, such as -5,5; came {limits!r}") from None
    return low, high


def _close(
    study: Contactile, results: Sequence[tuple[Any, Mapping[str, Any]]], json: Path | None, source: Mapping[str, Any]
) -> None:
    found, made_up = rows(results), "simulated" in source
    _show(found, study, made_up)
    if json is None:
        return
    settings = {name: getattr(study, name) for name in ("epochs", "biotac_epochs", "every", "take", "device", "seed")}
    there = {cell.dataset for cell, _ in results}
    options: dict[str, Any] = {
        "rows": ",".join(study.rows),
        "parts": ",".join(key for key, part in PARTS.items() if part in there),
    }
    options |= {**source, "weights": None if study.weights is None else Path(study.weights)}
    options |= {"biotac": None if study.biotac is None else "BIOTAC", **settings}
    made = origin(command_line("fabric", "contactile", **options), study.fabrics.recordings) | study.plan | settings
    made |= {"simulated": made_up} | machine()
    made |= {"seconds": sum(figures["seconds"] for _, figures in results)}
    made |= {"not scored": [name for name in study.shares.names if name not in study.scored]}
    write_result(json, made | {"rows": found, "cells": {cell.key: figures for cell, figures in results}})


def _show(found: Sequence[Mapping[str, Any]], study: Contactile, made_up: bool) -> None:
    for part in dict.fromkeys(part for row in found for part in row["parts"]):
        _show_part(part, study.fabrics.recordings.name, found)
    if any(row["key"] in EPOCHAL for row in found):
        say(
            f"networks: {study.epochs} epochs (the paper has {PAPER_EPOCHS}), on {study.device}, images averaged over "
            f"{study.every} columns; trained on one touch of {study.take}"
        )
    if made_up:
        say(
            "[yellow]simulated:[/] the paper's figures are of real fabrics, and stand here to be compared in order only"
        )


def _show_part(part: str, name: str, found: Sequence[Mapping[str, Any]]) -> None:
    of_paper = part == HAND
    head = ["row", *(["paper", "difference"] if of_paper else []), "score", "all right", "shares off by", "calibration"]
    table = Table(*head, title=f"{name}, {part}")
    for row in found:
        if part not in row["parts"]:
            continue
        figures, paper, apart = row["parts"][part], row["paper"], row["difference"]
        beside = ["" if paper is None else percent(paper), "" if apart is None else f"{100 * apart:+.1f}"]
        off, error = figures["share_error"], figures["calibration_error"]
        table.add_row(
            row["system"],
            *(beside if of_paper else []),
            percent(figures["score"]),
            percent(figures["exact"]),
            "" if off is None else percent(off),
            "" if error is None else f"{error:.3f}",
        )
    table.add_row("always the more common", *([""] * 2 if of_paper else []), percent(figures["always"]))
    console().print(table)
