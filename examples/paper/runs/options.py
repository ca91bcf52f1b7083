"""The options that commands share, and what they choose: data sets, folds, systems."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from examples.paper.readers import fabric_slide, letter_spike, physiclear
from examples.paper.readers.biotac_slide import load
from examples.paper.readers.labelled import Recordings, thinned
from scroll_tactile.clients.cli.terminal import say
from scroll_tactile.errors import DatasetError, InputError

__all__ = ["OF_TOUCHES", "QUICK_EPOCHS", "SETS", "folds_of", "leave_out", "named", "numbers", "read"]

QUICK_EVERY = 5
QUICK_EPOCHS = 15  # of five steps; after six the ResNets were at chance


def _blocked(data: Path, seed: int) -> Recordings:
    recordings = load(data, "biotac", seed)
    return replace(recordings, name=f"{recordings.name} blocked", fold=recordings.blocked())


def _slides(data: Path, seed: int) -> Recordings:
    """FabricSlide over distance, as ratios: how fast and how hard it was slid is no property of the fabric."""
    slides = fabric_slide.load(data, seed=seed).recordings
    streams = [fabric_slide.ratios(stream) for stream in slides.streams]
    return replace(slides, sensor=fabric_slide.CPM_RATIOS, streams=streams)


SETS: dict[str, Callable[[Path, int], Recordings]] = {
    "biotac-20": lambda data, seed: load(data, "biotac", seed),
    "biotac-20-all": lambda data, seed: load(data, "biotac-all", seed),
    "biotac-20-blocked": _blocked,
    "roboskin-20": lambda data, seed: load(data, "roboskin", seed),
    "roboskin-20-unmixed": lambda data, seed: load(data, "roboskin", seed, unmixed=True),
    "letter-spike": letter_spike.load,
    "fabric-slide": _slides,
    "gelsight": physiclear.load,
}
"""Name → reader of the folder of the data, with a seed of folds. BioTac's are its electrodes', or all that it measures;
blocked: in folds of successive repetitions; unmixed: in the order of time, which the published arrays are not in."""

OF_TOUCHES = ("biotac-20", "biotac-20-all", "roboskin-20", "roboskin-20-unmixed")


def _in_a_folder(file: Path | None) -> Path | None:
    """Raise InputError, before anything is measured, where a file could not be written for want of its folder."""
    if file is not None and not file.absolute().parent.is_dir():
        raise InputError(f"expected {file} in a folder that exists; {file.absolute().parent} does not")
    return file


Dataset = Annotated[str, typer.Argument(help=f"Which recordings, of {', '.join(OF_TOUCHES)}.", show_default=False)]
Data = Annotated[Path, typer.Option(help="The folder of the published set, or the one that the sets' folders lie in.")]
Weights = Annotated[
    str | None,
    typer.Option(help="Of a trained ResNet: a file, or a published name such as resnet18. Without, rows are left out."),
]
Folds = Annotated[str, typer.Option(help='Which folds: "all", or numbers from 0, such as 0 or 0,1.')]
Epochs = Annotated[int | None, typer.Option(min=1, help="Of the networks' training.")]
Device = Annotated[str, typer.Option(help="Where networks are trained: cpu or cuda.")]
InPrecision = Annotated[str, typer.Option("--precision", help="Of the ResNets' training: float32 or bfloat16.")]
Seed = Annotated[int, typer.Option(min=0, help="Of all that is drawn.")]
Quick = Annotated[
    bool, typer.Option("--quick", help="For a look: one fold of every fifth touch, few epochs, small images.")
]
Run = Annotated[
    Path | None, typer.Option("--run", help="Note finished parts in this folder; the same command resumes from them.")
]
Json = Annotated[Path | None, typer.Option(help="Write all figures into this JSON file.", callback=_in_a_folder)]
Plot = Annotated[Path | None, typer.Option(help="Draw the figure into this file.", callback=_in_a_folder)]


def read(
    option: str, asked: str, data: Path, seed: int, *, known: Collection[str] = OF_TOUCHES, quick: bool = False
) -> dict[str, Recordings]:
    """The sets of an option by the names that it has, with commas between; a quick run's are `thinned`.

    Raises InputError for other names, DatasetError for a set that is not there.
    """
    names = named(option, asked, known)
    try:
        found = {name: SETS[name](data, seed) for name in names}
    except DatasetError as error:
        if len(names) > 1:
            error.add_note("Or name the sets that are there: --sets biotac-20,roboskin-20")
        raise
    return {name: thinned(item, QUICK_EVERY) if quick else item for name, item in found.items()}


def folds_of(asked: str, recordings: Recordings, *, quick: bool = False) -> list[int]:
    """The folds that --folds asks for: "all", or numbers; of a quick run the first. Raises InputError for others."""
    asked_for = recordings.fold.tolist() if asked == "all" else numbers("--folds", asked, "all, or numbers")
    chosen = sorted(set(asked_for)) if asked == "all" else list(dict.fromkeys(asked_for))
    return chosen[:1] if quick else chosen


def numbers(option: str, asked: str, wanted: str = "numbers") -> list[int]:
    """Whole numbers from 0 with commas between. Raises InputError for anything else."""
    words = [word.strip() for word in asked.split(",")]
    if not all(word.isascii() and word.isdigit() for word in words):
        raise InputError(f"expected {option} as {wanted} such as 0 or 0,1; came {asked!r}")
    return [int(word) for word in words]


def named(option: str, asked: str, known: Collection[str]) -> tuple[str, ...]:
    """The names that an option asks for, with commas between; each once. Raises InputError for unknown ones."""
    names = tuple(dict.fromkeys(part.strip() for part in asked.split(",")))
    if strange := [name for name in names if name not in known]:
        raise InputError(f"expected {option} out of {', '.join(known)}; came {', '.join(map(repr, strange))}")
    return names


def leave_out(keys: Sequence[str], needing: Collection[str], option: str) -> tuple[str, ...]:
    """The keys without those that need an option which was not given; a word on these."""
    if out := [key for key in keys if key in needing]:
        say(f"[yellow]Left out without {option}:[/] {', '.join(out)}")
    return tuple(key for key in keys if key not in out)
