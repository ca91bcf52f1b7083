"""`table1`: every system on every data set, fold by fold, with the paper's figures beside ours."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import typer

from examples.paper.runs.cells import Cell, Figures, mean_curve, pooled
from examples.paper.runs.options import (
    QUICK_EPOCHS,
    Data,
    Device,
    Epochs,
    Folds,
    InPrecision,
    Json,
    Quick,
    Run,
    Seed,
    Weights,
    folds_of,
    read,
)
from examples.paper.runs.results import show
from examples.paper.runs.study import OwnEmbeddings, OwnSystems, Systems, SystemStudy, choose_systems, close
from examples.paper.systems.catalogue import SYSTEMS, name_of
from examples.paper.systems.descent import Course
from examples.paper.systems.trained import TrainedNetwork
from scroll_tactile.clients.cli.terminal import progress_bar, say
from scroll_tactile.clients.learning.metrics import accuracy
from scroll_tactile.errors import ScrollTactileError
from scroll_tactile.finetune.fine_tune import Progress

__all__ = ["PAPER", "Table1", "rows", "table1"]

OF_TABLE1 = ("biotac-20", "biotac-20-blocked", "roboskin-20", "roboskin-20-unmixed", "gelsight")

PAPER: dict[str, dict[str, float]] = {
    "svm": {"BioTac-20": 0.942, "RoboSkin-20": 0.505},
    "svm-spikes": {"BioTac-20": 0.935, "RoboSkin-20": 0.633},
    "conv-lstm": {"BioTac-20": 0.945, "RoboSkin-20": 0.935},
    "snn": {"BioTac-20": 0.946, "RoboSkin-20": 0.922},
    "least-squares": {"BioTac-20": 0.938, "RoboSkin-20": 0.848, "GelSight-45": 0.671},
    "resnet": {"BioTac-20": 0.980, "RoboSkin-20": 0.950, "GelSight-45": 0.929},
    "resnet-pretrained": {"BioTac-20": 0.989, "RoboSkin-20": 0.960, "GelSight-45": 0.951},
}
"""Key of a system → data set → accuracy in the paper. GelSight-45 is not public: nothing of ours stands beside it."""


class Table1(SystemStudy):
    """The paper's Table I: each cell a fit and a test."""

    name = "table1"

    @property
    def course(self) -> Course:
        """The whole training, in fewer epochs where there is no time for the paper's hundred."""
        return Course.in_proportion(self.epochs, self.precision)

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        touches, system = self._split(cell), self._system(cell)
        test, truth = touches.test_streams, touches.truth
        curve: list[float] = []
        system.fit(
            touches.streams,
            touches.materials,
            touches.validation,
            self.seed,
            progress,
            watch=lambda: curve.append(accuracy(truth, system.predict(test))),
        )
        predicted = system.predict(test)
        figures = {
            "learned": len(touches.streams),
            "validation": len(touches.validation),
            "tested": len(truth),
            "right": sum(true == guess for true, guess in zip(truth, predicted, strict=True)),
            **_votes(truth, predicted, touches.touch),
        }
        if isinstance(system, TrainedNetwork):
            figures["epochs"] = [
                {"accuracy": share, "loss": e.loss, "validation_loss": e.validation_loss, "rate": e.rate}
                for share, e in zip(curve, system.epochs, strict=True)
            ]
        for chosen in ("chosen", "penalty"):
            if hasattr(system, chosen):
                figures["chosen"] = getattr(system, chosen)
        return figures


def _votes(truth: Sequence[str], predicted: Sequence[str], touch: Sequence[int]) -> Figures:
    """Right answers by the majority of answers for a recording, where recordings have several frames."""
    ballots: dict[int, list[str]] = {}
    for recording, answer in zip(touch, predicted, strict=True):
        ballots.setdefault(recording, []).append(answer)
    if len(ballots) == len(truth):
        return {}
    name_of = dict(zip(touch, truth, strict=True))
    right = sum(max(sorted(set(votes)), key=votes.count) == name_of[recording] for recording, votes in ballots.items())
    return {"recordings": len(ballots), "recordings_right": right}


def rows(results: Sequence[tuple[Cell, Figures]], *, compared: bool = True) -> list[dict[str, Any]]:
    """One row for each system: data set → accuracy over its folds, the paper's, and the difference where `compared`."""
    found: list[dict[str, Any]] = []
    for key in dict.fromkeys([*SYSTEMS, *(cell.system for cell, _ in results)]):
        sets: dict[str, Any] = {}
        for dataset in dict.fromkeys(cell.dataset for cell, _ in results):
            cells = [figures for cell, figures in results if (cell.system, cell.dataset) == (key, dataset)]
            if not cells:
                continue
            ours = pooled(cells)
            paper = PAPER.get(key, {}).get(dataset)
            sets[dataset] = ours | {
                "paper": paper,
                "difference": None if paper is None or not compared else ours["mean"] - paper,
                "seconds": sum(cell["seconds"] for cell in cells),
            }
            if "epochs" in cells[0]:
                shares = ([epoch["accuracy"] for epoch in cell["epochs"]] for cell in cells)
                sets[dataset]["points"] = mean_curve(enumerate(column, start=1) for column in shares)
            if "recordings" in cells[0]:
                asked = sum(cell["recordings"] for cell in cells)
                sets[dataset]["vote"] = sum(cell["recordings_right"] for cell in cells) / asked
        if sets:
            found.append({"key": key, "system": name_of(key), "sets": sets})
    return found


def table1(
    context: typer.Context,
    data: Data,
    weights: Weights = None,
    sets: Annotated[str, typer.Option(help=f"Which data sets, of {', '.join(OF_TABLE1)}.")] = ",".join(OF_TABLE1),
    systems: Systems = None,
    own_systems: OwnSystems = None,
    own_embeddings: OwnEmbeddings = None,
    folds: Folds = "all",
    epochs: Epochs = None,
    device: Device = "cpu",
    precision: InPrecision = "float32",
    seed: Seed = 0,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
) -> None:
    """Table I: every system on every data set, with the paper's figure beside ours and the difference.

    100 epochs, five folds: hours on a GPU, days without. --systems and --folds take parts of it, --run adds them up.
    """
    keys = choose_systems(systems, tuple(SYSTEMS), weights, own_systems, own_embeddings)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        found = [*read("--sets", sets, data, seed, known=OF_TABLE1, quick=quick).values()]
        few = epochs or (QUICK_EPOCHS if quick else 100)
        study = Table1(found, keys, weights, few, device, seed, quick, run, precision)
        chosen = {item.name: folds_of(folds, item, quick=quick) for item in found}
        results, stopped = _as_far_as_it_goes(study.run(chosen, progress))
    columns = {
        "system": "{./system}",
        "paper": "{?./paper|%}",
        "here, %": "{./here|±}",
    } | ({} if quick else {"apart": "{?./difference|*100|+.1f}"})  # a fifth of a fold is no figure to compare
    columns |= {"of recordings": "{?./here/vote|%}", "folds": "{./here/folds}", "seconds": "{./here/seconds|.0f}"}
    table = rows(results, compared=not quick)
    for name in (item.name for item in found):
        own = [(row, row["sets"][name]) for row in table if name in row["sets"]]
        show(name, columns, [figures | {"system": row["system"], "here": figures} for row, figures in own])
    if stopped is not None:
        say("[yellow]stopped:[/] the rows above are what was done until then")
        raise stopped
    close(context, study, [(cell, _without_losses(figures)) for cell, figures in results], {"rows": table})


def _as_far_as_it_goes(
    cells: Iterator[tuple[Cell, Figures]],
) -> tuple[list[tuple[Cell, Figures]], ScrollTactileError | None]:
    """The cells that are done, and the error that ended them; raises it where none is done."""
    results: list[tuple[Cell, Figures]] = []
    try:
        for cell in cells:
            results.append(cell)
    except ScrollTactileError as error:
        if not results:
            raise
        return results, error
    return results, None


def _without_losses(figures: Figures) -> Figures:
    """The figures of a cell as a result keeps them: of each epoch the accuracy only, which are most of the file."""
    if "epochs" not in figures:
        return figures
    return figures | {"epochs": [epoch["accuracy"] for epoch in figures["epochs"]]}
