"""`fabric`: letters, slides, attributes and objects here, `contactile` in a module of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from examples.paper.commands.contactile_command import contactile
from examples.paper.commands.options import QUICK_EVERY, Data, Folds, Json, Run, Seed, Weights
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
from examples.paper.fabric import objects
from examples.paper.fabric.attributes_study import Attributes
from examples.paper.fabric.attributes_study import summary as summary_of_attributes
from examples.paper.fabric.fabric_study import FIGURES, Letters, SlideTransfer, summary
from examples.paper.readers import fabric_slide, letter_spike, physiclear
from examples.paper.readers.grades import read_grades
from examples.paper.readers.letter_spike import DOTS
from examples.paper.runs.cells import thinned
from scroll_tactile.cli.terminal import Commands, console, percent, progress_bar

__all__ = ["fabric"]

fabric = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    help="What a touch is made of: fabrics, letters of dots, attributes, objects; fabrics slid over otherwise.",
)
fabric.command()(contactile)


_LABELS = {
    "score": "mean score per dot",
    "exact": "all six dots right",
    "accuracy": "letter right",
    "likeliest": "… of the likeliest letter's dots",
    "inferred": "… novelty inferred, not given",
    "always": "score of always the more common",
    "calibration_error": "expected calibration error of the dots",
}


_WAYS = {"ours": "ours", "inferred": "… novelty inferred, not given", "trees": "trees", "always": "most common grade"}


@fabric.command()
def letters(
    data: Data,
    folds: Folds = "all",
    groups: Annotated[int, typer.Option(min=2, max=27, help="The letters are held out in so many groups.")] = 9,
    seed: Seed = 0,
    cosines: Annotated[int, typer.Option(min=64, help="Features by which known letters are classified.")] = 3000,
    json: Json = None,
    run: Run = None,
) -> None:
    """Compose Braille letters of their dots: known letters, and letters held out."""
    require_folders(json)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        recordings = letter_spike.load(data, seed)
        task = Letters(recordings, groups, seed, cosines, run)
        results = list(task.run(parse_folds(folds or "all", recordings), progress))
    _show_letters(results)
    if json is not None:
        settings: dict[str, Any] = {"folds": folds or "all", "groups": groups, "seed": seed, "cosines": cosines}
        command = command_line("fabric", "letters", data="DATA", **settings)
        write_result(json, origin(command, recordings) | task.plan | {"means": summary(results), "parts": results})


@fabric.command()
def slide(
    data: Data,
    seed: Seed = 0,
    json: Json = None,
    run: Run = None,
) -> None:
    """Train on four fabrics at one speed or force, test at another."""
    require_folders(json)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        slides = fabric_slide.load(data, seed=seed)
        task = SlideTransfer(slides, folder=run)
        results = list(task.run(progress))
    table = Table("part", "learned", "tested", "right", "called unknown", title="FabricSlide, four balanced fabrics")
    for result in results:
        shown = (percent(result["accuracy"]), percent(result["unknown"]))
        table.add_row(result["part"], str(result["learned"]), str(result["tested"]), *shown)
    console().print(table)
    if json is not None:
        command = command_line("fabric", "slide", data="DATA", seed=seed)
        write_result(json, origin(command, slides.recordings) | task.plan | {"seed": seed, "parts": results})


@fabric.command()
def attributes(
    data: Data,
    grades: Annotated[
        Path, typer.Option(help="A .csv file: material (mat1 to mat20), then a column of grades for each attribute.")
    ],
    sets: Annotated[str, typer.Option(help="Which sensors touch: biotac-20, roboskin-20.")] = "biotac-20,roboskin-20",
    dimension: Annotated[int, typer.Option(min=64, help="Of the kernels.")] = 504,
    quick: Annotated[bool, typer.Option("--quick", help="One touch of five: for a look.")] = False,
    seed: Seed = 0,
    json: Json = None,
    run: Run = None,
) -> None:
    """Grade attributes, such as stiffness and roughness, of materials held out."""
    require_folders(json)
    asked = named("--sets", sets, list(Dataset))
    found: dict[str, Any] = {}
    with progress_bar() as progress:
        listed = read_grades(grades)
        for name in asked:
            recordings = read(Dataset(name), data, seed)
            if quick:
                recordings = thinned(recordings, QUICK_EVERY)
            task = Attributes(recordings, listed, dimension, seed, run)
            results = list(task.run(progress))
            found[name] = task.plan | {"means": summary_of_attributes(results), "parts": results}
    table = Table("set", "attribute", *_WAYS.values(), title="grades right, of materials held out (standard error)")
    for name, result in found.items():
        for attribute, means in result["means"].items():
            cells = [f"{percent(means[way]['mean'])} ({percent(means[way]['error'])})" for way in _WAYS]
            table.add_row(name, attribute, *cells)
    console().print(table)
    if json is not None:
        settings: dict[str, Any] = {"grades": grades, "sets": sets, "dimension": dimension, "quick": quick}
        settings |= {"seed": seed, "run": None if run is None else "RUN"}
        command = command_line("fabric", "attributes", data="DATA", **settings)
        write_result(json, origin(command) | {"seed": seed, "sets": found})


@fabric.command()
def gelsight(
    data: Data,
    weights: Weights = None,
    folds: Folds = "all",
    groups: Annotated[int, typer.Option(min=2, help="Objects are left out in so many groups.")] = 5,
    seed: Seed = 0,
    trees: Annotated[int, typer.Option(min=0, help="Of the baseline, scikit-learn's; 0: none.")] = objects.TREES,
    json: Json = None,
    run: Run = None,
) -> None:
    """Classify everyday objects by a GelSight's videos, and grade how hard and rough held-out objects are."""
    require_folders(json)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        recordings = physiclear.videos(physiclear.load(data, seed))
        attributes = physiclear.read_attributes(data)
        felt = set(recordings.materials)
        known = {name: values for name, values in attributes.items() if name in felt}
        task = objects.Objects(recordings, known, weights, groups, seed, trees, run)
        results = list(task.run(parse_folds(folds or "all", recordings), progress))
    means = objects.summary(results)
    _show_objects(means)
    if json is not None:
        settings: dict[str, Any] = {"weights": None if weights is None else Path(weights), "folds": folds or "all"}
        settings |= {"groups": groups, "seed": seed, "trees": trees}
        command = command_line("fabric", "gelsight", data="DATA", **settings)
        write_result(json, origin(command, recordings) | task.plan | {"means": means, "parts": results})


def _show_objects(means: Mapping[str, Mapping[str, Mapping[str, float]]]) -> None:
    counts, network = means.get("known, counts", {}), means.get("known, network", {})
    head = ("counts", "network", "trees")
    table = Table("GelSight, objects that were touched", *head, title="right by video (± sd over folds)")
    table.add_row(
        "frames together", *map(with_spread, (counts.get("video"), network.get("video"), counts.get("trees")))
    )
    table.add_row(
        "majority of frames", *map(with_spread, (counts.get("vote"), network.get("vote"), counts.get("trees' vote")))
    )
    table.add_row("a single frame", *map(with_spread, (counts.get("frame"), network.get("frame"), None)))
    console().print(table)
    new = means.get("never touched", {})
    table = Table(
        "GelSight, objects never touched", "heads", "compose", "trees", "always the commonest", title="right by video"
    )
    for name in physiclear.ATTRIBUTES:
        table.add_row(name, *(with_spread(new.get(name + what)) for what in ("", ", composed", ", trees", ", always")))
    console().print(table)


def _show_letters(results: Sequence[Mapping[str, Any]]) -> None:
    means = summary(results)
    table = Table("figure", *means, title="letter-spike, mean over touches (± sd over folds or groups of letters)")
    for name in FIGURES:
        cells = [means[kind].get(name) for kind in means]
        table.add_row(_LABELS[name], *map(with_spread, cells))
    console().print(table)
    dots = Table("dot", "there", *(f"{kind}: {what}" for kind in means for what in ("correct", "precision", "recall")))
    for dot in DOTS:
        row = [dot, percent(_mean(results, dot, "there"))]
        for kind in means:
            those = [result for result in results if result["part"] == kind]
            row += [percent(_mean(those, dot, what)) for what in ("correct", "precision", "recall")]
        dots.add_row(*row)
    console().print(dots)


def _mean(results: Sequence[Mapping[str, Any]], dot: str, what: str) -> float:
    """Over touches; parts where a precision or a recall has no meaning are left out."""
    shown = [(result["constituents"][dot][what], result["tested"]) for result in results]
    shown = [result for result in shown if result[0] is not None]
    total = sum(tested for _, tested in shown)
    return sum(value * tested for value, tested in shown) / total if total else 0.0
