"""`fabric slide`: fabrics trained on at one force or speed and tested at another, the paper's change of protocol.

FabricSlide's slides, real data that stand in for the paper's fabrics.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import typer

from examples.paper.readers import fabric_slide
from examples.paper.readers.fabric_slide import CPM_RATIOS, Slides, ratios
from examples.paper.runs.cached import Cached
from examples.paper.runs.cells import Cell, Figures, learn, run_cells, silent
from examples.paper.runs.options import Data, Json, Run, Seed
from examples.paper.runs.results import show, write
from examples.paper.transfer.maps import Maps
from scroll_tactile import Embedding
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.clients.learning.metrics import Labelled
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.learner import TactileLearner

__all__ = ["SlideTransfer", "directions", "slide"]

Mask = npt.NDArray[np.bool_]


def directions(slides: Slides) -> dict[str, tuple[Mask, Mask]]:
    """What is trained on and what is tested, by name: masks of shape (N,).

    Slow is up to 50 mm/s and fast from 100 on, which parts the six speeds; low is a force of up to 150 and high of 210
    or more, with 180 on neither side.
    """
    speed = np.abs(slides.speed)
    slow, fast = speed <= 50, speed >= 100
    low, high = slides.force <= 150, slides.force >= 210
    return {
        "slow → fast": (slow, fast),
        "fast → slow": (fast, slow),
        "low → high force": (low, high),
        "high → low force": (high, low),
    }


@dataclass(frozen=True)
class SlideTransfer:
    """Fabrics trained on at one force or speed and tested at another.

    slides: of `fabric_slide`. parts: of a slide, whose mean ratios are the features. folder: where finished parts are
    noted, so that an interrupted run resumes; or None.
    """

    slides: Slides
    parts: int = 12
    folder: Path | None = None

    @property
    def plan(self) -> dict[str, Any]:
        """All that the figures depend on, beside the data."""
        return {
            "run": "slide",
            "parts of a slide": self.parts,
            "fabrics": sorted(set(self.slides.recordings.materials)),
        }

    def run(self, progress: Progress = silent) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each direction, then of five folds of all slides, as they are finished."""
        recordings = self.slides.recordings
        cells = [Cell(recordings.name, 0, name) for name in self._splits]
        yield from run_cells(self.folder, self.plan, [recordings], cells, self._measure, progress)

    @cached_property
    def _splits(self) -> dict[str, tuple[Mask, Mask]]:
        fold = self.slides.recordings.fold
        return directions(self.slides) | {f"fold {i}": (fold != i, fold == i) for i in range(5)}

    @cached_property
    def _embedding(self) -> Embedding:
        return Cached(Maps(layout=(CPM_RATIOS.channels,), parts=self.parts))

    @cached_property
    def _touches(self) -> list[Labelled]:
        recordings = self.slides.recordings
        return list(zip(recordings.materials, map(ratios, recordings.streams), strict=True))

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        trained, tested = self._splits[cell.system]
        if not trained.any() or not tested.any():
            raise InputError(f"expected slides on both sides of {cell.system}; there are none on one")
        train, test = ([self._touches[i] for i in np.flatnonzero(mask)] for mask in (trained, tested))
        learner = TactileLearner(sensor=CPM_RATIOS, embedding=self._embedding, exemplars=0)
        learn(learner, train, progress)
        predicted = [learner.predict(stream) for _, stream in test]
        right: dict[str, list[bool]] = {}
        for (name, _), prediction in zip(test, predicted, strict=True):
            right.setdefault(name, []).append(name == prediction.material)
        return {
            "learned": len(train),
            "tested": len(test),
            "accuracy": float(np.mean(np.concatenate([*right.values()]))),
            "of each": {name: float(np.mean(own)) for name, own in right.items()},
            "unknown": float(np.mean([answer.known is False for answer in predicted])),
            "digest": learner.digest(),
        }


def slide(context: typer.Context, data: Data, seed: Seed = 0, run: Run = None, json: Json = None) -> None:
    """Train on four fabrics at one speed or force, test at another."""
    with progress_bar() as progress:
        progress("reading", 0, 1)
        task = SlideTransfer(fabric_slide.load(data, seed=seed), folder=run)
        parts = [{"part": cell.system} | figures for cell, figures in task.run(progress)]
    columns = {"part": "{./part}", "learned": "{./learned}", "tested": "{./tested}"}
    columns |= {"right, %": "{./accuracy|%}", "called unknown, %": "{./unknown|%}"}
    show("FabricSlide, four balanced fabrics", columns, parts)
    write(context, task.plan | {"parts": parts})
