"""The options that several commands share, and how the commands of the paper's systems begin and end."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

from examples.paper.commands.sets import command_line, leave_out, named, origin, parse_folds, write_result
from examples.paper.readers import physiclear
from examples.paper.readers.biotac_slide import load
from examples.paper.readers.labelled import Recordings
from examples.paper.runs.cells import Cell, Figures, thinned
from examples.paper.runs.study import SystemStudy
from examples.paper.studies.table1 import blocked
from examples.paper.systems.catalogue import EPOCHAL, NEED_WEIGHTS, SYSTEMS, library_of, name_of
from examples.paper.systems.own import is_own, require_own
from scroll_tactile.cli.terminal import say
from scroll_tactile.errors import DatasetError

__all__ = [
    "QUICK_EPOCHS",
    "QUICK_EVERY",
    "QUICK_SETS",
    "SETS",
    "Device",
    "PrecisionChoice",
    "choose_folds",
    "choose_systems",
    "close",
    "machine",
    "own_keys",
    "read_sets",
    "say_conditions",
    "spelled",
    "systems_of",
]


class Device(StrEnum):
    """Where networks are trained."""

    CPU = "cpu"
    CUDA = "cuda"


class PrecisionChoice(StrEnum):
    """What the residual networks are trained in."""

    FLOAT32 = "float32"
    BFLOAT16 = "bfloat16"


SETS: dict[str, Callable[[Path, int], Recordings]] = {
    "biotac-20": lambda data, seed: load(data, "biotac", seed),
    "biotac-20-blocked": lambda data, seed: blocked(load(data, "biotac", seed)),
    "roboskin-20": lambda data, seed: load(data, "roboskin", seed),
    "roboskin-20-unmixed": lambda data, seed: load(data, "roboskin", seed, unmixed=True),
    "gelsight": physiclear.load,
}
QUICK_SETS = ("biotac-20", "roboskin-20")
QUICK_EPOCHS = 15  # of five steps; after six the ResNets were at chance
QUICK_EVERY = 5

Data = Annotated[Path, typer.Option(help="The folder of the published set, or the one that the sets' folders lie in.")]
Weights = Annotated[
    str | None,
    typer.Option(help="Of a trained ResNet: a file, or a published name such as resnet18. Without, rows are left out."),
]
Sets = Annotated[str | None, typer.Option(help=f"Which data sets, of {', '.join(SETS)}.")]
Systems = Annotated[str | None, typer.Option(help=f"Which systems, of {', '.join(SYSTEMS)}.")]
OwnSystems = Annotated[
    list[str] | None, typer.Option("--system", help="One's own, as module:factory, see examples/own_system.py; again.")
]
OwnEmbeddings = Annotated[
    list[str] | None, typer.Option("--embedding", help="Ours on an embedding of one's own, as module:factory; again.")
]
Folds = Annotated[str | None, typer.Option(help='Which folds: "all", or numbers from 0, such as 0 or 0,1.')]
Epochs = Annotated[int | None, typer.Option(min=1, help="Of the networks' training.")]
Where = Annotated[Device, typer.Option(help="Where networks are trained.")]
InPrecision = Annotated[
    PrecisionChoice, typer.Option("--precision", help="Of the ResNets' training; bfloat16 is up to twice as fast.")
]
Seed = Annotated[int, typer.Option(min=0, help="Of all that is drawn.")]
Quick = Annotated[
    bool,
    typer.Option("--quick", help=f"One fold of every fifth touch, small images, {QUICK_EPOCHS} epochs: for a look."),
]
Run = Annotated[
    Path | None,
    typer.Option("--run", help="Note finished parts in this folder; the same command resumes from them."),
]
Json = Annotated[Path | None, typer.Option(help="Write all figures into this JSON file.")]
Plot = Annotated[Path | None, typer.Option(help="Draw the figure into this file.")]
FewMaterials = Annotated[int, typer.Option("--materials", hidden=True, min=2)]


def own_keys(systems: Sequence[str] | None, embeddings: Sequence[str] | None) -> tuple[str, ...]:
    """The keys of --system and --embedding. Raises InputError where one makes no system, or no embedding."""
    keys = (*(systems or ()), *(f"{spelled}-lda" for spelled in embeddings or ()))
    for key in keys:
        require_own(key)
    return keys


def spelled(option: str, asked: str, known: Collection[str]) -> tuple[str, ...]:
    """The systems that an option asks for, with commas between, one's own among them. Raises InputError for others."""
    parts = dict.fromkeys(part.strip() for part in asked.split(","))
    own = own_keys([part for part in parts if is_own(part)], None)
    if len(own) == len(parts):
        return own
    return (*named(option, ",".join(part for part in parts if part not in own), known), *own)


def choose_systems(
    asked: str | None, usual: Sequence[str], weights: str | None, own: Sequence[str] = ()
) -> tuple[str, ...]:
    """The systems of --systems, and one's own; without either all that can be made, and a word on the others."""
    keys = (*(() if asked is None else spelled("--systems", asked, SYSTEMS)), *own)  # before anything is read
    if keys:
        return tuple(dict.fromkeys(keys))
    return tuple(usual) if weights is not None else leave_out(usual, NEED_WEIGHTS, "--weights")


def read_sets(asked: str | None, usual: Sequence[str], data: Path, seed: int, quick: bool) -> list[Recordings]:
    """The sets of --sets; without it the usual ones, of which a quick run has two. A quick run's are `thinned`.

    Raises InputError for other names, DatasetError for a set that is not there.
    """
    if asked is not None:
        names = named("--sets", asked, SETS)
    else:
        names = tuple(name for name in usual if name in QUICK_SETS or not quick)
    try:
        read = [SETS[name](data, seed) for name in names]
    except DatasetError as error:
        error.add_note("Or name the sets that are there: --sets biotac-20,roboskin-20")
        raise
    return [thinned(item, QUICK_EVERY) if quick else item for item in read]


def choose_folds(asked: str | None, read: Sequence[Recordings], quick: bool) -> dict[str, list[int]]:
    """The folds of --folds for each set; without it all, or the first in a quick run."""
    wanted = asked if asked is not None else ("0" if quick else "all")
    return {recordings.name: parse_folds(wanted, recordings) for recordings in read}


def machine() -> dict[str, Any]:
    """How many processors there are, and threads of torch."""
    return {"processors": os.cpu_count(), "threads": torch.get_num_threads()}


def say_conditions(study: SystemStudy) -> None:
    """What the figures have to be read with."""
    if any(key in EPOCHAL for key in study.systems):
        short = "" if study.epochs >= 100 else " where the paper has 100"
        rounded = f", ResNets in {study.precision}" if study.precision != "float32" else ""
        how = f"{study.epochs} epochs{short}, on {study.device}{rounded}"
        say(f"networks: {how}; a tenth of what is learned is the validation")
    if study.quick:
        say(
            "[yellow]quick:[/] every fifth touch, in training and test; ResNets' images averaged to about 50 columns: "
            "for a look, not for a report"
        )


def systems_of(keys: Sequence[str]) -> dict[str, dict[str, str]]:
    """Key → name and library of each system; the libraries' versions stand in what `origin` notes."""
    return {key: {"name": name_of(key), "library": library_of(key)} for key in keys}


def close(
    study: SystemStudy,
    results: Sequence[tuple[Cell, Figures]],
    json: Path | None,
    found: Mapping[str, Any],
    sets: str | None,
    folds: str | None,
) -> None:
    """Report folds of unequal size, and write the JSON."""
    for recordings in study.sets:
        sizes = {cell.fold: figures["tested"] for cell, figures in results if cell.dataset == recordings.name}
        if len(set(sizes.values())) > 1:
            listed = ", ".join(map(str, sizes.values()))
            say(f"{recordings.name}: folds of unequal size, {listed}: every touch counts the same")
    if json is None:
        return
    command = command_line(
        study.name,
        data="DATA",
        systems=None if study.name == "activation" else ",".join(study.systems),  # it has no choice
        sets=sets,
        folds=folds,
        weights=None if study.weights is None else Path(study.weights),
        epochs=study.epochs,
        device=study.device,
        seed=study.seed,
        precision=study.precision,
        quick=study.quick,
        run=None if study.folder is None else "RUN",
    )
    about = (
        machine()
        | study.plan
        | {"systems": systems_of(study.systems)}
        | {"seconds": sum(figures["seconds"] for _, figures in results)}
    )
    sensors = {recordings.name: recordings.sensor.model_dump(mode="json") for recordings in study.sets}
    cells = {cell.key: figures for cell, figures in results}
    write_result(json, origin(command) | about | {"sensors": sensors, **found, "cells": cells})
