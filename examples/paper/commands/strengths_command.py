"""`strengths`: systems trained on clean touches, tested on shorter, faster, noisier ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from examples.paper.commands.options import (
    QUICK_EPOCHS,
    QUICK_EVERY,
    QUICK_SETS,
    Data,
    Device,
    Epochs,
    FewMaterials,
    Folds,
    InPrecision,
    Json,
    OwnEmbeddings,
    OwnSystems,
    Plot,
    PrecisionChoice,
    Run,
    Seed,
    Weights,
    Where,
    own_keys,
    spelled,
    systems_of,
)
from examples.paper.commands.sets import (
    Dataset,
    command_line,
    draw_into,
    leave_out,
    named,
    origin,
    parse_folds,
    read,
    require_folders,
    with_spread,
    write_result,
)
from examples.paper.plots import draw_robustness
from examples.paper.readers.labelled import Recordings
from examples.paper.runs.cells import thinned
from examples.paper.runs.study import columns_averaged, weights_digest
from examples.paper.studies.baselines import BASELINES, baseline
from examples.paper.studies.replay import subset
from examples.paper.studies.strengths_study import NAMES, PAPER, SESSION, Make, Strengths, ours, summary
from examples.paper.systems.catalogue import EPOCHAL, NEED_WEIGHTS, Catalogue
from examples.paper.systems.descent import Course
from examples.paper.systems.trained import require_device
from scroll_tactile.cli.terminal import console, percent, progress_bar, say
from scroll_tactile.errors import InputError

__all__ = ["IN_THE_PAPER", "strengths"]

IN_THE_PAPER = ("length", "speed", "noise")
"""The studies that the paper has a figure of."""

OURS = "ours"
CHOICES = (OURS, *BASELINES)


class StudyChoice(StrEnum):
    """The studies, those of the paper, and all of them."""

    LENGTH = "length"
    SPEED = "speed"
    NOISE = "noise"
    DEAD = "dead"
    DRIFT = "drift"
    SESSION = "session"
    PAPER = "paper"
    ALL = "all"


def strengths(
    study: Annotated[
        StudyChoice, typer.Argument(help="How test touches differ; paper: length, speed, noise.", show_default=False)
    ],
    data: Data,
    sets: Annotated[
        str, typer.Option(help=f"Which data sets, of {', '.join(Dataset)}; a picture for each, of each study.")
    ] = ",".join(QUICK_SETS),
    systems: Annotated[str, typer.Option(help=f"Which systems, of {', '.join(CHOICES)}; or all.")] = OURS,
    own_systems: OwnSystems = None,
    own_embeddings: OwnEmbeddings = None,
    weights: Weights = None,
    folds: Folds = "all",
    epochs: Epochs = None,
    device: Where = Device.CPU,
    precision: InPrecision = PrecisionChoice.FLOAT32,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help=f"The first of these folds, every fifth touch, few strengths, {QUICK_EPOCHS} epochs on small images.",
        ),
    ] = False,
    every: Annotated[
        int | None, typer.Option(min=1, help="Learn and test one of so many touches; 5 in a quick run.")
    ] = None,
    seed: Seed = 0,
    run: Run = None,
    json: Json = None,
    plot: Plot = None,
    materials: FewMaterials = 20,
) -> None:
    """Train on clean touches, test on shorter, faster, noisier ones; ours as it is, others with augmentation, too.

    A system learns a fold once, with one setting, for all studies; only another recording session has folds of its own.
    """
    require_folders(json, plot)
    require_device(device.value)
    thin = every or (QUICK_EVERY if quick else 1)
    keys = (*_choose(systems, weights), *own_keys(own_systems, own_embeddings))
    passes = epochs or (QUICK_EPOCHS if quick else 100)
    course = Course.in_proportion(passes, precision.value)
    kept: dict[str, Any] = {}
    means: list[dict[str, Any]] = []
    seconds = 0.0
    with progress_bar() as progress:
        for name in named("--sets", sets, list(Dataset)):
            progress("reading", 0, 1)
            recordings = read(Dataset(name), data, seed)
            if materials < 20:
                recordings = subset(recordings, materials)
            every = columns_averaged(recordings.sensor) if quick else 1
            recordings = thinned(recordings, thin)
            channels = recordings.sensor.channels
            catalogue = Catalogue(weights, course, device.value, every, seed, channels=channels)
            makes, settings = _systems(keys, catalogue, recordings, seed)
            folder = None if run is None else run / recordings.name
            studies = _studies(study, recordings)
            task = Strengths(recordings, makes, settings, studies, plain=(OURS,), seed=seed, quick=quick, folder=folder)
            about = {"dataset": recordings.name}
            chosen = parse_folds(folds or "all", recordings)[: 1 if quick else None]
            found = [about | record for fold in task.run(chosen, progress) for record in fold]
            sensor = recordings.sensor.model_dump(mode="json")
            kept[recordings.name] = {**task.plan, "settings": settings, "sensor": sensor}
            seconds += sum(record["seconds"] for record in found)
            means += [about | row for row in summary(found)]
    for name in kept:
        _show(name, [row for row in means if row["dataset"] == name])
    networks: dict[str, Any] = {}
    if any(key in EPOCHAL for key in keys):
        networks = {"epochs": passes, "device": device.value, "precision": precision.value}
        say(f"networks: {passes} epochs, on {device.value}, ResNets in {precision.value}")
    if quick:
        say(f"[yellow]quick:[/] one fold, few strengths; ResNets' images of about 50 columns; one touch of {thin}")
    if json is not None:
        options: dict[str, Any] = {"data": "DATA", "sets": sets, "systems": ",".join(keys), "folds": folds or "all"}
        options |= {"every": None if thin == 1 and not quick else thin}
        options |= {"seed": seed, "quick": quick, "weights": None if weights is None else Path(weights)}
        made = origin(command_line("strengths", study.value, **options, **networks)) | {"seed": seed, "quick": quick}
        made |= {"systems": systems_of(keys)}
        write_result(json, made | {"seconds": seconds, "sets": kept, "means": means})
    _draw(plot, means)


def _choose(systems: str, weights: str | None) -> tuple[str, ...]:
    """The systems of --systems; of "all" those that can be made, and a word on the others.

    Raises InputError for systems that there are not, and those that need weights which are not given.
    """
    if systems == "all":
        return CHOICES if weights is not None else leave_out(CHOICES, NEED_WEIGHTS, "--weights")
    keys = spelled("--systems", systems, CHOICES)
    if weights is None and (lacking := [key for key in keys if key in NEED_WEIGHTS]):
        raise InputError(f"{', '.join(lacking)} need the weights of a trained ResNet: give --weights")
    return keys


def _systems(
    keys: Sequence[str], catalogue: Catalogue, recordings: Recordings, seed: int
) -> tuple[dict[str, Make], dict[str, Any]]:
    """The systems by name, and what each depends on."""
    needed = {} if catalogue.weights is None else {"weights": weights_digest(str(catalogue.weights))}
    makes: dict[str, Make] = {}
    settings: dict[str, Any] = {}
    for key in keys:
        makes[key], given = ours(recordings.sensor) if key == OURS else baseline(key, catalogue, seed)
        settings[key] = given | (needed if key in NEED_WEIGHTS else {})
    return makes, settings


def _studies(study: StudyChoice, recordings: Recordings) -> list[str]:
    if study is StudyChoice.PAPER:
        return list(IN_THE_PAPER)
    if study is not StudyChoice.ALL:
        return [study.value]
    if not recordings.ordered:
        say(f"[yellow]not measured:[/] {SESSION}: {recordings.name} is published without its order of recording")
    return [name for name in NAMES if name != SESSION or recordings.ordered]


def _draw(plot: Path | None, means: Sequence[Mapping[str, Any]]) -> None:
    """A picture of each study of each set, as the paper has: lines of two sensors in one cannot be distinguished."""
    pictures = dict.fromkeys((row["dataset"], row["study"]) for row in means)
    several = [len(set(names)) > 1 for names in zip(*pictures, strict=True)]
    for name, study in pictures:
        if plot is None:
            return
        told = [word for word, tell in zip((name.lower(), study), several, strict=True) if tell]
        file = plot.with_stem("-".join([plot.stem, *told]))
        rows = [row for row in means if (row["dataset"], row["study"]) == (name, study)]
        if not draw_into(file, partial(draw_robustness, rows=rows, title=f"{name}, trained on clean touches")):
            return


def _show(dataset: str, rows: Sequence[Mapping[str, Any]]) -> None:
    systems = list(dict.fromkeys((row["system"], row["augmented"]) for row in rows))
    folds = max(row["folds"] for row in rows)
    heads = [f"{system}, augmented" if augmented else system for system, augmented in systems]
    title = f"{dataset}, trained on clean touches, {folds} fold{'s' * (folds > 1)}"
    quoted = any((row["study"], row["strength"]) in PAPER for row in rows)
    table = Table("study", "strength", *heads, *(["paper", "ours − paper"] if quoted else []), title=title)
    cells = {(row["study"], row["strength"], row["system"], row["augmented"]): row for row in rows}
    for study in dict.fromkeys(row["study"] for row in rows):
        for strength in dict.fromkeys(row["strength"] for row in rows if row["study"] == study):
            own = [cells[study, strength, *system] for system in systems]
            shown = [with_spread(row) for row in own]
            mine = cells.get((study, strength, OURS, False))
            shown += _beside(dataset, PAPER.get((study, strength), {}), mine) if quoted else []
            table.add_row(study, "" if study == SESSION else f"{strength:g}", *shown)
        table.add_section()
    console().print(table)


def _beside(dataset: str, paper: Mapping[str, float], mine: Mapping[str, Any] | None) -> list[str]:
    """The paper's figure, of this set or, named, of another of the sensor; and the difference where it is this one."""
    sensor = dataset.partition("-")[0]
    for name, share in paper.items():
        if name == dataset:
            return [percent(share), "" if mine is None else f"{100 * (mine['mean'] - share):+.1f}"]
        if name.partition("-")[0] == sensor:
            return [f"{percent(share)} ({name})", ""]
    return ["", ""]
