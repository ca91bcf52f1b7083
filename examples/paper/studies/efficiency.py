"""`efficiency`: the test after each epoch of a network, and ours after a few touches of each material."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from examples.paper.runs.cells import Cell, Figures, Split, mean_curve
from examples.paper.runs.options import (
    QUICK_EPOCHS,
    Data,
    Device,
    Epochs,
    Folds,
    InPrecision,
    Json,
    Plot,
    Quick,
    Run,
    Seed,
    Weights,
    folds_of,
    read,
)
from examples.paper.runs.pictures import draw_into, logarithmic, picture
from examples.paper.runs.results import show
from examples.paper.runs.study import OwnEmbeddings, OwnSystems, Systems, SystemStudy, choose_systems, close
from examples.paper.systems.catalogue import EPOCHAL, SYSTEMS, name_of
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.clients.learning.metrics import Labelled, accuracy
from scroll_tactile.finetune.fine_tune import Progress

__all__ = ["STREAMS", "Efficiency", "curves", "efficiency", "first_touches"]

CURVES = ("resnet", "resnet-pretrained", "kernels-lda", "vision-lda", "kernels+vision-lda")

STREAMS = (1, 2, 5, 10, 20, 40)
"""Touches of each material after which one pass is tested; the last is what four of five folds of fifty have."""


@dataclass(frozen=True)
class Efficiency(SystemStudy):
    """Networks: the test after every epoch. All others: the test after so many streams of each material, STREAMS.

    Networks have seen every touch but the validation's once after the first epoch.
    """

    epochs: int = 20

    name = "efficiency"

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        touches, system = self._split(cell), self._system(cell)
        test, truth = touches.test_streams, touches.truth
        points: list[list[float]] = []

        def measure(i: int) -> None:
            points.append([i, accuracy(truth, system.predict(test))])

        if cell.system in EPOCHAL:
            system.fit(
                touches.streams,
                touches.materials,
                touches.validation,
                self.seed,
                progress,
                watch=lambda: measure(len(points) + 1),
            )
            return {"tested": len(truth), "by": "epochs", "points": points}
        most = min(touches.materials.count(name) for name in set(touches.materials))
        most += min(
            (sum(name == touch for touch, _ in touches.validation) for name in set(touches.materials)), default=0
        )
        for count in [count for count in STREAMS if count <= most]:
            train = first_touches(touches, count, self.seed)
            system.fit([touch for _, touch in train], [name for name, _ in train], [], self.seed, progress)
            measure(count)
        return {"tested": len(truth), "by": "streams", "points": points}


def first_touches(touches: Split, count: int, seed: int) -> list[Labelled]:
    """So many touches of each material, the validation's among them; of a larger number a smaller one's are part."""
    every = [*zip(touches.materials, touches.streams, strict=True), *touches.validation]
    order = np.random.default_rng([seed, 1]).permutation(len(every))
    met: dict[str, int] = {}
    kept = []
    for i in order:
        name = every[i][0]
        met[name] = met.get(name, 0) + 1
        if met[name] <= count:
            kept.append(every[i])
    return kept


def curves(results: Sequence[tuple[Cell, Figures]]) -> list[dict[str, Any]]:
    """One curve for each system and set: [epoch or streams, mean accuracy, standard deviation] over the folds."""
    found: list[dict[str, Any]] = []
    for dataset, key in dict.fromkeys((cell.dataset, cell.system) for cell, _ in results):
        cells = [figures for cell, figures in results if (cell.dataset, cell.system) == (dataset, key)]
        points = mean_curve(cell["points"] for cell in cells)
        found.append(
            {"dataset": dataset, "key": key, "system": name_of(key), "by": cells[0]["by"], "folds": len(cells)}
            | {"points": points, "seconds": sum(cell["seconds"] for cell in cells)}
        )
    return found


def efficiency(
    context: typer.Context,
    data: Data,
    weights: Weights = None,
    sets: Annotated[str, typer.Option(help="Which data sets.")] = "biotac-20,roboskin-20",
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
    plot: Plot = None,
) -> None:
    """Learning efficiency: the test after each of 20 epochs of the ResNets; ours after 1 to 40 touches of a material.

    Of the paper's figure there are curves only, no numbers; its final accuracies are those of table1.
    """
    usual = CURVES if systems is None else tuple(SYSTEMS)
    keys = choose_systems(systems, usual, weights, own_systems, own_embeddings)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        sets_read = [*read("--sets", sets, data, seed, quick=quick).values()]
        few = epochs or (QUICK_EPOCHS if quick else 20)
        study = Efficiency(sets_read, keys, weights, few, device, seed, quick, run, precision)
        results = list(study.run({item.name: folds_of(folds, item, quick=quick) for item in sets_read}, progress))
    found = curves(results)
    for dataset, by in dict.fromkeys((curve["dataset"], curve["by"]) for curve in found):
        mine = [curve for curve in found if (curve["dataset"], curve["by"]) == (dataset, by)]
        places = sorted({int(point[0]) for curve in mine for point in curve["points"]})
        columns = {"system": "{./system}"} | {str(i): f"{{?./points/0={i}/1|%}}" for i in places}
        show(f"{dataset}: right, % after so many {by}", columns | {"folds": "{./folds}"}, mine)
    close(context, study, results, {"curves": found})
    draw_into(plot, lambda file: draw_efficiency(file, found))


def draw_efficiency(path: Path, found: Sequence[Mapping[str, Any]]) -> None:
    """Draw accuracy by epoch of the networks (left) and by touches of each material of ours, a row for each data set.

    found: dataset, system, by ("epochs" or "streams") and points [(epoch or touches, mean, standard deviation)].
    """
    sets = list(dict.fromkeys(curve["dataset"] for curve in found))
    with picture(path, 12, 4.5 * len(sets)) as figure:
        panels = np.asarray(figure.subplots(len(sets), 2, squeeze=False, sharey="row"))
        for dataset, (left, right) in zip(sets, panels, strict=True):
            mine = [curve for curve in found if curve["dataset"] == dataset]
            for panel, by in ((left, "epochs"), (right, "streams")):
                for curve in (curve for curve in mine if curve["by"] == by):
                    place, mean, spread = np.nan_to_num(np.asarray(curve["points"], dtype=float)).T
                    panel.errorbar(place, 100 * mean, 100 * spread, marker=".", capsize=2, label=curve["system"])
                panel.grid(alpha=0.3)
                if panel.get_legend_handles_labels()[0]:
                    panel.legend(fontsize=8)
            left.xaxis.get_major_locator().set_params(integer=True)
            left.set(xlabel="epochs over all touches", ylabel="accuracy on the test, %", title=f"{dataset}: trained")
            right.set(xlabel="touches of each material, each met once", title=f"{dataset}: one pass")
            seen = {point[0] for curve in mine if curve["by"] == "streams" for point in curve["points"]}
            logarithmic(right, seen)
