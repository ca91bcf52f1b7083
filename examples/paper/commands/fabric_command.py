"""`scroll-tactile fabric`: letters, slides, attributes and objects here, `contactile` in a module of its own."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from examples.paper.commands.fabrics_command import contactile
from examples.paper.commands.sets import Dataset, named, origin, parse_folds, read, require_folders
from examples.paper.studies import objects
from examples.paper.studies.attributes_study import Attributes
from examples.paper.studies.attributes_study import summary as summary_of_attributes
from examples.paper.studies.fabric_study import FIGURES, Letters, SlideTransfer, summary
from scroll_tactile.cli.terminal import Commands, console, percent, progress_bar, say, write_json
from scroll_tactile.datasets import fabric_slide, letter_spike, physiclear
from scroll_tactile.datasets.grades import read_grades
from scroll_tactile.datasets.letter_spike import DOTS

__all__ = ["fabric"]

fabric = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    help="What a touch is made of: fabrics, letters of dots, attributes, objects; fabrics slid over otherwise.",
)
fabric.command()(contactile)

RunFolder = Annotated[
    Path | None,
    typer.Option("--run", "--resume", help="Note finished parts in this folder; an interrupted run goes on from it."),
]
JsonFile = Annotated[Path | None, typer.Option(help="Write all figures into this JSON file.")]

_LABELS = {
    "score": "mean score per dot",
    "exact": "all six dots right",
    "accuracy": "letter right",
    "likeliest": "… of the likeliest letter's dots",
    "untold": "… not told whether letters are new",
    "always": "score of always saying what is more common",
    "calibration_error": "expected calibration error of the dots",
}


_WAYS = {"ours": "ours", "untold": "… not told that it is new", "trees": "trees", "always": "most common grade"}


@fabric.command()
def letters(
    data: Annotated[Path, typer.Option(help="Folder of letter-spike, or the one it lies in.")],
    folds: Annotated[str, typer.Option(help='Which folds of known letters: "all", or numbers such as 0,1.')] = "all",
    groups: Annotated[int, typer.Option(min=2, max=27, help="The letters are left out in so many groups.")] = 9,
    seed: Annotated[int, typer.Option(min=0, help="Deals presses into folds and letters into groups.")] = 0,
    cosines: Annotated[int, typer.Option(min=64, help="Features that tell known letters apart.")] = 3000,
    json: JsonFile = None,
    run: RunFolder = None,
) -> None:
    """Tell Braille letters by their dots: letters that were touched, and letters never touched before."""
    require_folders(json)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        recordings = letter_spike.load(data, seed)
        task = Letters(recordings, groups, seed, cosines, run)
        results = list(task.run(parse_folds(folds, recordings), progress))
    _show_letters(results)
    if json is not None:
        words = ["fabric", "letters", "--data", data, "--folds", folds, "--groups", groups, "--seed", seed]
        command = shlex.join(["scroll-tactile", *map(str, words), "--cosines", str(cosines)])
        write_json(json, origin(command, recordings) | task.plan | {"means": summary(results), "parts": results})
        say(f"figures: {json}")


@fabric.command()
def slide(
    data: Annotated[Path, typer.Option(help="Folder of FabricSlide, or the one it lies in.")],
    parts: Annotated[int, typer.Option(min=1, help="Of a slide, whose mean ratios are the features.")] = 12,
    seed: Annotated[int, typer.Option(min=0, help="Deals slides into folds.")] = 0,
    json: JsonFile = None,
    run: RunFolder = None,
) -> None:
    """Learn four fabrics at one speed or force, and be asked about them at another."""
    require_folders(json)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        slides = fabric_slide.load(data, seed=seed)
        task = SlideTransfer(slides, parts, run)
        results = list(task.run(progress))
    table = Table("part", "learned", "tested", "right", "called unknown", title="FabricSlide, four balanced fabrics")
    for one in results:
        shown = (percent(one["accuracy"]), percent(one["unknown"]))
        table.add_row(one["part"], str(one["learned"]), str(one["tested"]), *shown)
    console().print(table)
    if json is not None:
        words = ["scroll-tactile", "fabric", "slide", "--data", str(data), "--parts", str(parts), "--seed", str(seed)]
        write_json(json, origin(shlex.join(words), slides.recordings) | task.plan | {"seed": seed, "parts": results})
        say(f"figures: {json}")


@fabric.command()
def attributes(
    data: Annotated[Path, typer.Option(help="Folder of BioTac_slide_20_50, or the one it lies in.")],
    grades: Annotated[
        Path, typer.Option(help="A .csv file: material (mat1 to mat20), then a column of grades for each attribute.")
    ],
    sets: Annotated[str, typer.Option(help="Which sensors touch: biotac-20, roboskin-20.")] = "biotac-20,roboskin-20",
    dimension: Annotated[int, typer.Option(min=64, help="Of the kernels.")] = 504,
    seed: Annotated[int, typer.Option(min=0, help="Of the trees.")] = 0,
    json: JsonFile = None,
    run: RunFolder = None,
) -> None:
    """Tell attributes, such as stiffness and roughness, of materials never touched before."""
    require_folders(json)
    asked = named("--sets", sets, list(Dataset))
    found: dict[str, Any] = {}
    with progress_bar() as progress:
        listed = read_grades(grades)
        for name in asked:
            recordings = read(Dataset(name), data, seed)
            task = Attributes(recordings, listed, dimension, seed, run)
            results = list(task.run(progress))
            found[name] = task.plan | {"means": summary_of_attributes(results), "parts": results}
    table = Table(
        "set", "attribute", *_WAYS.values(), title="grades right, of materials never touched (standard error)"
    )
    for name, one in found.items():
        for attribute, means in one["means"].items():
            cells = [f"{percent(means[way]['mean'])} ({percent(means[way]['error'])})" for way in _WAYS]
            table.add_row(name, attribute, *cells)
    console().print(table)
    if json is not None:
        words = [
            "fabric",
            "attributes",
            "--data",
            data,
            "--grades",
            grades,
            "--sets",
            sets,
            "--dimension",
            dimension,
            "--seed",
            seed,
        ]
        command = shlex.join(["scroll-tactile", *map(str, words)])
        write_json(json, origin(command) | {"seed": seed, "sets": found})
        say(f"figures: {json}")


@fabric.command()
def gelsight(
    data: Annotated[Path, typer.Option(help="Folder of physiclear, or the one it lies in.")],
    weights: Annotated[
        str | None,
        typer.Option(
            help="Of a trained ResNet: a file, or a published name such as resnet18. Without, only counts are read."
        ),
    ] = None,
    folds: Annotated[str, typer.Option(help='Which folds of videos: "all", or numbers such as 0,1.')] = "all",
    groups: Annotated[int, typer.Option(min=2, help="Objects are left out in so many groups.")] = 5,
    seed: Annotated[int, typer.Option(min=0, help="Deals videos and objects, and grows the trees.")] = 0,
    trees: Annotated[int, typer.Option(min=0, help="Of the baseline, scikit-learn's; 0: none.")] = objects.TREES,
    json: JsonFile = None,
    run: RunFolder = None,
) -> None:
    """Tell everyday objects by a GelSight's videos, and how hard and rough those are that were never touched."""
    require_folders(json)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        recordings = physiclear.videos(physiclear.load(data, seed))
        attributes = physiclear.read_attributes(data)
        felt = set(recordings.materials)
        known = {name: values for name, values in attributes.items() if name in felt}
        task = objects.Objects(recordings, known, weights, groups, seed, trees, run)
        results = list(task.run(parse_folds(folds, recordings), progress))
    means = objects.summary(results)
    _show_objects(means)
    if json is not None:
        words = ["fabric", "gelsight", "--data", data, *(["--weights", weights] if weights else []), "--folds", folds]
        words += ["--groups", groups, "--seed", seed, "--trees", trees]
        command = shlex.join(["scroll-tactile", *map(str, words)])
        write_json(json, origin(command, recordings) | task.plan | {"means": means, "parts": results})
        say(f"figures: {json}")


def _show_objects(means: Mapping[str, Mapping[str, Mapping[str, float]]]) -> None:
    def told(figure: Mapping[str, float] | None) -> str:
        return "" if figure is None else f"{percent(figure['mean'])} ({percent(figure['sd'])})"

    counts, network = means.get("known, counts", {}), means.get("known, network", {})
    head = ("counts", "network", "trees")
    table = Table("GelSight, objects that were touched", *head, title="right by video (sd over folds)")
    table.add_row("frames together", *map(told, (counts.get("video"), network.get("video"), counts.get("trees"))))
    table.add_row(
        "majority of frames", *map(told, (counts.get("vote"), network.get("vote"), counts.get("trees' vote")))
    )
    table.add_row("a single frame", *map(told, (counts.get("frame"), network.get("frame"), None)))
    console().print(table)
    new = means.get("never touched", {})
    table = Table(
        "GelSight, objects never touched", "heads", "compose", "trees", "always the commonest", title="right by video"
    )
    for name in physiclear.ATTRIBUTES:
        table.add_row(name, *(told(new.get(name + what)) for what in ("", ", composed", ", trees", ", always")))
    console().print(table)


def _show_letters(results: Sequence[Mapping[str, Any]]) -> None:
    means = summary(results)
    table = Table("figure", *means, title="letter-spike, mean over touches (sd over folds or groups of letters)")
    for name in FIGURES:
        cells = [means[kind].get(name) for kind in means]
        told = [percent(cell["mean"]) + f" ({percent(cell['sd'])})" if cell else "" for cell in cells]
        table.add_row(_LABELS[name], *told)
    console().print(table)
    dots = Table("dot", "there", *(f"{kind}: {what}" for kind in means for what in ("correct", "precision", "recall")))
    for dot in DOTS:
        row = [dot, percent(_mean(results, dot, "there"))]
        for kind in means:
            those = [one for one in results if one["part"] == kind]
            row += [percent(_mean(those, dot, what)) for what in ("correct", "precision", "recall")]
        dots.add_row(*row)
    console().print(dots)


def _mean(results: Sequence[Mapping[str, Any]], dot: str, what: str) -> float:
    """Over touches; parts where a precision or a recall has no meaning are left out."""
    told = [(one["constituents"][dot][what], one["tested"]) for one in results]
    told = [one for one in told if one[0] is not None]
    total = sum(tested for _, tested in told)
    return sum(value * tested for value, tested in told) / total if total else 0.0
