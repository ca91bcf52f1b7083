"""`fabric attributes`: grades of materials never touched before, such as stiffness, by heads over those that were.

A grade, 0, 1 or 2, is graded by two constituents, "at least 1" and "at least 2" (Frank and Hall 2001): what lies
between is between. Each material is left out in turn, with all its touches.
"""

from __future__ import annotations

import json as json_lines
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from examples.paper.readers.grades import read_grades
from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.runs.cached import Cached
from examples.paper.runs.cells import Cell, Figures, learn, run_cells, silent
from examples.paper.runs.options import Data, Json, Quick, Run, Seed, read
from examples.paper.runs.results import show, write
from scroll_tactile import Embedding, Kernels
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.clients.learning.metrics import mean_and_spread
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.learner import TactileLearner
from scroll_tactile.libraries import optional
from scroll_tactile.results import Composition

__all__ = ["FIGURES", "Attributes", "attributes", "summary"]

FIGURES = ("ours", "inferred", "trees", "always")
"""Shares of touches whose grade is right: ours, given that the material is new; ours, inferring it; of trees on simple
features; and of always saying the grade that most of the materials learned have."""

TREES = 100
Grades = Mapping[str, Mapping[str, int]]
FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Attributes:
    """Each material left out, and its grades predicted from what was learned of the others.

    recordings: of any sensor. grades: attribute → material → grade from 0, for every material. dimension: of the
    kernels. seed: of the trees. folder: where finished parts are noted, so that an interrupted run resumes; or None.

    Raises InputError for a material without a grade, fewer than three materials, or an attribute of one grade.
    """

    recordings: Recordings
    grades: Grades
    dimension: int = 504
    seed: int = 0
    folder: Path | None = None

    def __post_init__(self) -> None:
        names = set(self.recordings.materials)
        if len(names) < 3 or not self.grades:
            raise InputError(f"expected three materials or more, and an attribute; came {len(names)}")
        for attribute, grades in self.grades.items():
            if missing := sorted(names - set(grades)):
                raise InputError(f"expected a grade of {attribute} for every material; {missing[0]!r} has none")
            if len({grades[name] for name in names}) < 2:
                raise InputError(f"expected materials of two grades or more of {attribute}; all have one")

    @property
    def plan(self) -> dict[str, Any]:
        """All that the figures depend on, in JSON's types."""
        # By a hash: a publisher's list is not to be found in a file of results.
        listed = {attribute: dict(sorted(of.items())) for attribute, of in self.grades.items()}
        digest = blake2b(json_lines.dumps(listed).encode(), digest_size=8).hexdigest()
        grades = {"attributes": list(self.grades), "digest": digest}
        return {"run": "attributes", "grades": grades, "dimension": self.dimension, "seed": self.seed, "trees": TREES}

    def run(self, progress: Progress = silent) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each material left out, as they are finished. Raises InputError without scikit-learn."""
        folder = None if self.folder is None else self.folder / self.recordings.name.lower()
        cells = [Cell(self.recordings.name, 0, material) for material in dict.fromkeys(self.recordings.materials)]
        yield from run_cells(folder, self.plan, [self.recordings], cells, self._measure, progress)

    @cached_property
    def _kernels(self) -> Embedding:
        return Cached(Kernels(dimension=self.dimension))

    @cached_property
    def _plain(self) -> FloatArray:
        return np.stack([_simple(stream.readings) for stream in self.recordings.streams])

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        out, names = cell.system, np.array(self.recordings.materials)
        train, test = hold_out(self.recordings, names == out)
        learner = TactileLearner(sensor=self.recordings.sensor, embedding=self._kernels, exemplars=0)
        learn(learner, train, progress)
        for name in learner.materials:
            learner.describe(name, self._steps(name))
        given = [learner.compose(stream, unfamiliar=1.0) for _, stream in test]
        inferred = [learner.compose(stream) for _, stream in test]
        figures: dict[str, Any] = {}
        for attribute, of in self.grades.items():
            usual = Counter(of[name] for name in learner.materials)
            # Ties go to the lower grade.
            always = min(usual, key=lambda grade: (-usual[grade], grade))
            learned, asked = self._plain[names != out], self._plain[names == out]
            predicted = {
                "ours": self._predict(attribute, given),
                "inferred": self._predict(attribute, inferred),
                "trees": _forest(learned, [of[name] for name, _ in train], asked, self.seed),
            }
            right = {way: float(np.mean(np.asarray(grades) == of[out])) for way, grades in predicted.items()}
            figures[attribute] = {**right, "always": float(always == of[out])}
        return {"learned": len(train), "tested": len(test), "attributes": figures, "digest": learner.digest()}

    def _steps(self, material: str) -> dict[str, bool]:
        return {
            _step(attribute, grade): of[material] >= grade
            for attribute, of in self.grades.items()
            for grade in range(1, max(of.values()) + 1)
        }

    def _predict(self, attribute: str, answers: Sequence[Composition]) -> list[int]:
        """The grade of each answer: how many steps are more likely there than not."""
        steps = [_step(attribute, grade) for grade in range(1, max(self.grades[attribute].values()) + 1)]
        return [sum((answer[step].presence or 0.0) > 0.5 for step in steps) for answer in answers]


def _step(attribute: str, grade: int) -> str:
    return f"{attribute} of {grade} or more"


def _simple(readings: npt.NDArray[np.float32]) -> FloatArray:
    """Mean, spread, least, most and mean step of each channel, shape (5 n,), of readings of shape (T, n)."""
    values = readings.astype(np.float64)
    steps = np.abs(np.diff(values, axis=0)).mean(axis=0)
    return np.concatenate([values.mean(axis=0), values.std(axis=0), values.min(axis=0), values.max(axis=0), steps])


def _forest(rows: FloatArray, grades: Sequence[int], asked: FloatArray, seed: int) -> npt.NDArray[np.int64]:
    """The grades that extremely randomised trees (Geurts et al. 2006) predict."""
    with optional("scikit-learn", "bench", "the comparison with trees"):
        from sklearn.ensemble import ExtraTreesClassifier
    forest = ExtraTreesClassifier(TREES, random_state=seed)
    given: npt.NDArray[np.int64] = forest.fit(rows, np.asarray(grades)).predict(asked)
    return given


def summary(results: Sequence[Figures]) -> dict[str, dict[str, dict[str, float]]]:
    """Attribute → figure → mean over materials and its standard error, and of how many most touches are right."""
    means: dict[str, dict[str, dict[str, float]]] = {}
    for attribute in results[0]["attributes"] if results else ():
        for figure in FIGURES:
            values = [float(result["attributes"][attribute][figure]) for result in results]
            mean, spread = mean_and_spread(values)
            given = {
                "mean": mean,
                "error": spread / len(values) ** 0.5,
                "materials": float(sum(v > 0.5 for v in values)),
            }
            means.setdefault(attribute, {})[figure] = given
    return means


def attributes(
    context: typer.Context,
    data: Data,
    grades: Annotated[
        Path, typer.Option(help="A .csv file: material (mat1 to mat20), then a column of grades for each attribute.")
    ],
    sets: Annotated[str, typer.Option(help="Which sensors touch.")] = "biotac-20,roboskin-20",
    dimension: Annotated[int, typer.Option(min=64, help="Of the kernels.")] = 504,
    seed: Seed = 0,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
) -> None:
    """Grade attributes, such as stiffness and roughness, of materials held out."""
    listed, found = read_grades(grades), {}
    with progress_bar() as progress:
        for name, recordings in read("--sets", sets, data, seed, quick=quick).items():
            task = Attributes(recordings, listed, dimension, seed, run)
            results = list(task.run(progress))
            parts = [{"part": cell.system} | figures for cell, figures in results]
            found[name] = task.plan | {"means": summary([figures for _, figures in results]), "parts": parts}
    columns = {"set": "{./set}", "attribute": "{./attribute}"} | {way: f"{{./{way}|±}}" for way in FIGURES}
    means = [(name, attribute, own) for name, of in found.items() for attribute, own in of["means"].items()]
    rows = [{"set": name, "attribute": attribute} | own for name, attribute, own in means]
    show("grades right, of materials held out, % (± standard error)", columns, rows)
    write(context, {"sets": found})
