"""`fabric letters`: Braille letters, whose six dots are constituents that are there or not.

Known letters in five folds, and letters never touched, left out in groups: real data that stand in for the paper's
fabrics.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from examples.paper.fabric.fabric_protocol import score
from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.readers.letter_spike import DOTS, GRID, dots_of, letter_folds
from examples.paper.runs.cached import Cached
from examples.paper.runs.cells import Cell, Figures, learn, over_folds, require_folds, run_cells, silent
from examples.paper.runs.options import Data, Folds, Json, Quick, Run, Seed, folds_of, read
from examples.paper.runs.results import show, write
from examples.paper.systems.constituents import estimates_of
from examples.paper.transfer.maps import Maps
from scroll_tactile import Embedding
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.clients.learning.metrics import accuracy
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.learner import TactileLearner

__all__ = ["FIGURES", "Letters", "letters", "summary"]

FIGURES = ("score", "exact", "accuracy", "likeliest", "inferred", "always", "calibration_error")
"""Of each fold: mean score per constituent, exact matches, materials right; the score of saying the dots of the
likeliest letter (all right wherever the letter is), that where novelty is inferred, not given: the touches are of
letters never touched, and that of always saying what is more common among the letters learned; and expected calibration
error of the presences."""

KNOWN, NEW = "known", "never touched"


@dataclass(frozen=True)
class Letters:
    """Braille letters and their dots.

    recordings: of `letter_spike`, or any whose materials are its letters. groups: into which the letters are dealt, one
    of which is never touched; seed: deals them.
    cosines: features by which known letters are classified. Letters held out are composed by the maps alone (see
    `Maps`). folder: where finished parts are noted, so that an interrupted run resumes; or None.
    """

    recordings: Recordings
    groups: int = 9
    seed: int = 0
    cosines: int = 3000
    folder: Path | None = None

    @property
    def plan(self) -> dict[str, Any]:
        """All that the figures depend on, beside the data."""
        return {"run": "letters", "groups": self.groups, "seed": self.seed, "cosines": self.cosines}

    def run(self, folds: Sequence[int], progress: Progress = silent) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each of these folds of presses, then of each group of letters, as they are finished.

        Raises InputError for a fold that is not there, and what learning raises.
        """
        require_folds(self.recordings.fold, folds)
        cells = [Cell(self.recordings.name, fold, KNOWN) for fold in folds]
        names = set(self.recordings.materials)
        groups = [i for i, group in enumerate(letter_folds(self.groups, self.seed)) if names & set(group)]
        cells += [Cell(self.recordings.name, i, NEW) for i in groups]
        yield from run_cells(self.folder, self.plan, [self.recordings], cells, self._measure, progress)

    @cached_property
    def _embeddings(self) -> dict[str, Embedding]:
        return {
            KNOWN: Cached(Maps(layout=GRID, parts=4, views=["as-felt", "corner"], cosines=self.cosines)),
            NEW: Cached(Maps(layout=GRID, parts=1, views=["corner"])),
        }

    def _tested(self, cell: Cell) -> npt.NDArray[np.bool_]:
        if cell.system == KNOWN:
            return np.asarray(self.recordings.fold == cell.fold)
        return np.isin(self.recordings.materials, letter_folds(self.groups, self.seed)[cell.fold])

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        train, test = hold_out(self.recordings, self._tested(cell))
        embedding = self._embeddings[cell.system]
        learner = TactileLearner(sensor=self.recordings.sensor, embedding=embedding, exemplars=0)
        learn(learner, train, progress)
        for letter in learner.materials:
            learner.describe(letter, dots_of(letter))
        # Whether the tested touches are of letters held out: the caller knows, and then infers.
        given = 0.0 if cell.system == KNOWN else 1.0
        predicted = [learner.compose(stream, unfamiliar=given) for _, stream in test]
        inferred = [learner.compose(stream) for _, stream in test]
        truth = [letter for letter, _ in test]
        there = [list(dots_of(letter).values()) for letter in truth]
        likeliest = [list(dots_of(answer.prediction.material or "space").values()) for answer in predicted]
        often = np.mean([list(dots_of(letter).values()) for letter, _ in train], axis=0)
        return {
            "learned": len(train),
            "accuracy": accuracy(truth, [answer.prediction.material for answer in predicted]),
            "unfamiliar": float(np.mean([answer.unfamiliar for answer in inferred])),
            **score(DOTS, there, estimates_of(DOTS, predicted).presence),
            "likeliest": score(DOTS, there, likeliest)["score"],
            "always": score(DOTS, there, np.tile(often, (len(test), 1)))["score"],
            "inferred": score(DOTS, there, estimates_of(DOTS, inferred).presence)["score"],
            "digest": learner.digest(),
        }


def summary(results: Sequence[tuple[Cell, Figures]]) -> dict[str, dict[str, dict[str, Any]]]:
    """Of each kind of part: mean over its touches, and standard deviation over its folds or groups, of each figure."""
    means: dict[str, dict[str, dict[str, Any]]] = {}
    for kind in dict.fromkeys(cell.system for cell, _ in results):
        those = [figures for cell, figures in results if cell.system == kind]
        weights = [figures["tested"] for figures in those]
        for name in FIGURES:
            values = [figures[name] for figures in those if figures[name] is not None]
            if len(values) == len(those):
                means.setdefault(kind, {})[name] = over_folds([float(value) for value in values], weights)
    return means


def letters(
    context: typer.Context,
    data: Data,
    folds: Folds = "all",
    groups: Annotated[int, typer.Option(min=2, max=27, help="The letters are held out in so many groups.")] = 9,
    seed: Seed = 0,
    cosines: Annotated[int, typer.Option(min=64, help="Features by which known letters are classified.")] = 3000,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
) -> None:
    """Compose Braille letters of their dots: known letters, and letters held out."""
    with progress_bar() as progress:
        progress("reading", 0, 1)
        (recordings,) = read("--data", "letter-spike", data, seed, known=["letter-spike"], quick=quick).values()
        task = Letters(recordings, groups, seed, cosines, run)
        results = list(task.run(folds_of(folds, recordings, quick=quick), progress))
    means = summary(results)
    columns = {"percent": "{./figure}"} | {kind: f"{{?./{kind}|±}}" for kind in means}
    show("letter-spike, mean over touches", columns, _turned(means))
    dots: list[Mapping[str, Any]] = [
        {"dot": dot, "part": cell.key} | figures["constituents"][dot] for cell, figures in results for dot in DOTS
    ]
    columns = {name: f"{{?./{name}|%}}" for name in ("there", "correct", "precision", "recall")}
    show("dot by dot", {"dot": "{./dot}", "part": "{./part}"} | columns, dots)
    parts = [{"part": cell.system, "number": cell.fold} | figures for cell, figures in results]
    write(context, task.plan | {"means": means, "parts": parts})


def _turned(means: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A row for each figure, with what each kind of part has of it."""
    return [{"figure": name} | {kind: own[name] for kind, own in means.items() if name in own} for name in FIGURES]
