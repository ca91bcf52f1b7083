"""Learning efficiency: accuracy on the test after each epoch of a network, and ours after a few touches of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from examples.paper.runs.cells import Cell, Figures, Split, mean_curve
from examples.paper.runs.study import SystemStudy
from examples.paper.systems.catalogue import EPOCHAL, name_of
from scroll_tactile.finetune.training import Progress
from scroll_tactile.pipelines.classification import Labelled
from scroll_tactile.pipelines.metrics import accuracy

__all__ = ["STREAMS", "Efficiency", "curves", "first_touches"]

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
