"""`scroll-tactile robustness`, and the paper's part of it: `reproduce length`, `speed` and `noise`."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import Annotated

import typer

from examples.paper.commands.options import (
    QUICK_EPOCHS,
    QUICK_SETS,
    Data,
    Device,
    Epochs,
    Folds,
    InPrecision,
    Json,
    Plot,
    PrecisionChoice,
    Run,
    Seed,
    Weights,
    Where,
    read_sets,
)
from examples.paper.commands.perturbed import CHOICES, OURS, Asked, choose, measure, tell
from examples.paper.commands.sets import Dataset, read, require_folders
from examples.paper.studies.replay import subset
from scroll_tactile.cli.terminal import progress_bar

__all__ = ["IN_THE_PAPER", "robustness", "study_command"]

IN_THE_PAPER = {
    "length": "Accuracy against the length of the touch, from 0.1 s on; the paper says that 0.3 s suffices.",
    "speed": "Accuracy against speed, a quarter to four times that learned from.",
    "noise": "Accuracy against uniform noise, up to the whole range.",
}
"""Study → what its command says of itself."""


class StudyChoice(StrEnum):
    """The studies, and all of them."""

    LENGTH = "length"
    SPEED = "speed"
    NOISE = "noise"
    DEAD = "dead"
    DRIFT = "drift"
    SITTING = "sitting"
    ALL = "all"


QuickStudy = Annotated[
    bool,
    typer.Option("--quick", help="The first of these folds, few strengths, networks of 6 epochs on small images."),
]
SensorSets = Annotated[str | None, typer.Option(help=f"Which data sets, of {', '.join(QUICK_SETS)}.")]
Systems = Annotated[
    str | None, typer.Option(help=f"Which systems, of {', '.join(CHOICES)}; without and with augmentation.")
]


def robustness(
    study: Annotated[StudyChoice, typer.Argument(help="What is done to the test touches.", show_default=False)],
    dataset: Annotated[Dataset, typer.Argument(help="Which recordings.", show_default=False)],
    data: Data,
    systems: Systems = OURS,
    weights: Weights = None,
    folds: Folds = "all",
    epochs: Epochs = None,
    device: Where = Device.CPU,
    precision: InPrecision = PrecisionChoice.FLOAT32,
    quick: QuickStudy = False,
    seed: Seed = 0,
    run: Run = None,
    json: Json = None,
    plot: Plot = None,
    materials: Annotated[int, typer.Option(hidden=True, min=2)] = 20,
) -> None:
    """Learn from clean touches, and ask about shorter, faster, noisier ones; with augmented observation and without.

    Each system learns a fold once, with one setting, for all studies; only another sitting has lessons of its own.
    """
    require_folders(json, plot)
    asked = Asked(
        ["scroll-tactile", "robustness", study.value, dataset.value],
        choose(systems, weights),
        weights,
        epochs or (QUICK_EPOCHS if quick else 100),
        device.value,
        precision.value,
        folds or "all",
        seed,
        quick,
        run,
        json,
        plot,
    )
    with progress_bar() as progress:
        progress("reading", 0, 1)
        recordings = read(dataset, data, seed)
        if materials < 20:
            recordings = subset(recordings, materials)
        found = measure(asked, [recordings], [study.value], progress)
    tell(asked, found)


def study_command(study: str) -> Callable[..., None]:
    """The command of `reproduce` for a study of IN_THE_PAPER, on both sensors, ours beside the paper's systems.

    "all" is the three of them: each system learns a fold once for all.
    """

    def command(
        data: Data,
        weights: Weights = None,
        sets: SensorSets = None,
        systems: Systems = None,
        folds: Folds = None,
        epochs: Epochs = None,
        device: Where = Device.CPU,
        precision: InPrecision = PrecisionChoice.FLOAT32,
        seed: Seed = 0,
        quick: QuickStudy = False,
        run: Run = None,
        json: Json = None,
        plot: Plot = None,
    ) -> None:
        require_folders(json, plot)
        asked = Asked(
            ["scroll-tactile", "reproduce", study, *(["--sets", sets] if sets is not None else [])],
            choose(systems, weights),
            weights,
            epochs or (QUICK_EPOCHS if quick else 100),
            device.value,
            precision.value,
            folds or "all",
            seed,
            quick,
            run,
            json,
            plot,
        )
        studies = list(IN_THE_PAPER) if study == StudyChoice.ALL else [study]
        with progress_bar() as progress:
            progress("reading", 0, 1)
            found = measure(asked, read_sets(sets, QUICK_SETS, data, seed, quick), studies, progress)
        tell(asked, found)

    command.__doc__ = f"{IN_THE_PAPER.get(study, '')} Each system with augmentation and without."
    return command
