"""Attributes of materials never touched before, such as stiffness, by heads over those that were.

A grade, 0, 1 or 2, is graded by two constituents, "at least 1" and "at least 2" (Frank and Hall 2001): what lies
between is between. Each material is left out in turn, with all its touches.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from examples.paper.readers.labelled import Recordings
from examples.paper.runs.cached import Cached
from examples.paper.runs.cells import require_data
from examples.paper.studies.replay import Progress
from scroll_tactile import Embedding, Kernels
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.libraries import optional
from scroll_tactile.pipelines.metrics import mean_and_spread
from scroll_tactile.pipelines.runfile import RunFile
from scroll_tactile.results import Composition

__all__ = ["FIGURES", "Attributes", "summary"]

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
        digest = blake2b(json.dumps(listed).encode(), digest_size=8).hexdigest()
        grades = {"attributes": list(self.grades), "digest": digest}
        settings = {"dimension": self.dimension, "seed": self.seed, "trees": TREES}
        size = {"dataset": self.recordings.name, "streams": len(self.recordings)}
        return {"run": "attributes", "grades": grades} | size | settings

    def run(self, progress: Progress = lambda what, done, of: None) -> Iterator[dict[str, Any]]:
        """The figures of each material left out, as they are finished. Raises InputError without scikit-learn."""
        name = f"attributes-{self.recordings.name}.json".lower()
        notes = RunFile(None if self.folder is None else self.folder / self.recordings.name.lower() / name, self.plan)
        require_data(notes, self.recordings)
        embedding = Cached(Kernels(dimension=self.dimension))
        plain = np.stack([_simple(stream.readings) for stream in self.recordings.streams])
        for material in dict.fromkeys(self.recordings.materials):
            if material not in notes.notes:
                notes.note(material, {"part": material} | self._part(embedding, plain, material, progress))
            yield notes.notes[material]

    def _part(self, embedding: Embedding, plain: FloatArray, out: str, progress: Progress) -> dict[str, Any]:
        begun = time.perf_counter()
        recordings, names = self.recordings, self.recordings.materials
        what = f"{recordings.name} without {out}"
        learner = TactileLearner(sensor=recordings.sensor, embedding=embedding, exemplars=0)
        train = [i for i, name in enumerate(names) if name != out]
        test = [i for i, name in enumerate(names) if name == out]
        for done, i in enumerate(train):
            learner.observe(names[i], recordings.streams[i])
            progress(what, done + 1, len(names))
        for name in learner.materials:
            learner.describe(name, self._steps(name))
        given = [learner.compose(recordings.streams[i], unfamiliar=1.0) for i in test]
        inferred = [learner.compose(recordings.streams[i]) for i in test]
        progress(what, len(names), len(names))
        figures: dict[str, Any] = {}
        for attribute, of in self.grades.items():
            usual = Counter(of[name] for name in learner.materials)
            # Ties go to the lower grade.
            always = min(usual, key=lambda grade: (-usual[grade], grade))
            trees = _forest(plain[train], [of[names[i]] for i in train], plain[test], self.seed)
            predicted = {
                "ours": self._predict(attribute, given),
                "inferred": self._predict(attribute, inferred),
                "trees": trees,
            }
            right = {way: float(np.mean(np.asarray(grades) == of[out])) for way, grades in predicted.items()}
            figures[attribute] = {**right, "always": float(always == of[out])}
        return {
            "learned": len(train),
            "tested": len(test),
            "attributes": figures,
            "digest": learner.digest(),
            "seconds": time.perf_counter() - begun,
        }

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


def summary(results: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
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
