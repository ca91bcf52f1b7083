"""`fabric gelsight`: everyday objects under a camera: which it is, and what those never touched before are like.

PhysiCLeAR's videos of a GelSight, each a stream of four frames in contact. Objects that are known are classified in
folds of their videos. Attributes (hardness, roughness, texture, each of three values) are graded of objects held out:
they are left out in groups, and graded by heads over the others (`unseen`); beside it, by `compose`, to which each
value is a constituent that the others were described to have or not.
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

from examples.paper.fabric.unseen import fit_heads
from examples.paper.readers import physiclear
from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.runs.cached import Cached
from examples.paper.runs.cells import Cell, Figures, learn, over_folds, require_folds, run_cells, silent
from examples.paper.runs.options import Data, Folds, Json, Quick, Run, Seed, Weights, folds_of, read
from examples.paper.runs.results import show, write
from examples.paper.runs.study import weights_digest
from scroll_tactile import Embedding, Frames
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.clients.learning.metrics import accuracy
from scroll_tactile.embeddings.protocol import embed_windows
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.learner import TactileLearner
from scroll_tactile.libraries import optional
from scroll_tactile.results import Composition
from scroll_tactile.signals.contact import image_of
from scroll_tactile.signals.stream import Stream
from scroll_tactile.signals.windows import FRAMES, Scale
from scroll_tactile.statistics.grid import in_units

__all__ = ["COSINES", "TREES", "VALUES", "Objects", "gelsight", "most_often", "object_groups", "summary"]

FloatArray = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

NEW = "never touched"
VALUES = (0, 1, 2)
"""Of every attribute."""
COSINES = 700
"""Of the surface's counts, by which attributes are graded."""
TREES = 100
"""Of the baseline, scikit-learn's extremely randomised trees on the counts and the light of each frame."""


@dataclass(frozen=True)
class Objects:
    """Objects in folds of their videos, and attributes of objects in groups that are left out.

    recordings: whole videos, see `physiclear.videos`. attributes: object → attribute → value, of those that are known.
    weights: of a trained ResNet, by which objects that are known are classified, too; None: by `Frames`' counts alone.
    Attributes are graded by cosines of the counts. groups: into which the objects with attributes are
    dealt, one of which is never touched; seed: deals them, and grows the trees. trees: of the baseline; 0: none.
    folder: where finished parts are noted, so that an interrupted run resumes; or None.

    Raises InputError for fewer groups than two, or more than objects.
    """

    recordings: Recordings
    attributes: Mapping[str, Mapping[str, int]]
    weights: str | None = None
    groups: int = 5
    seed: int = 0
    trees: int = TREES
    folder: Path | None = None

    def __post_init__(self) -> None:
        if not 2 <= self.groups <= len(self.attributes):
            raise InputError(
                f"expected 2 groups or more, and no more than the {len(self.attributes)} objects with attributes; came "
                f"{self.groups}"
            )

    @property
    def plan(self) -> dict[str, Any]:
        """All that the figures depend on, in JSON's types."""
        settings = {"groups": self.groups, "seed": self.seed, "trees": self.trees, "cosines": COSINES}
        known = {"attributes": {name: dict(answer) for name, answer in self.attributes.items()}}
        weights = None if self.weights is None else weights_digest(self.weights)
        return {"run": "objects", "weights": weights} | settings | known

    def run(self, folds: Sequence[int], progress: Progress = silent) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each of these folds of videos, then of each group of objects, as they are finished.

        Raises InputError for a fold that is not there or where scikit-learn is missing, and what learning raises.
        """
        require_folds(self.recordings.fold, folds)
        name = self.recordings.name
        cells = [Cell(name, fold, f"known, {by}") for by in self._embeddings for fold in folds]
        cells += [Cell(name, i, NEW) for i in range(self.groups)]
        yield from run_cells(self.folder, self.plan, [self.recordings], cells, self._measure, progress)

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        if cell.system == NEW:
            return self._unknown(object_groups(sorted(self.attributes), self.groups, self.seed)[cell.fold], progress)
        return self._known(cell.system.removeprefix("known, "), cell.fold, progress)

    @cached_property
    def _names(self) -> npt.NDArray[np.str_]:
        return np.array(self.recordings.materials)

    @cached_property
    def _embeddings(self) -> dict[str, Embedding]:
        # Every frame is one of contact, and none shows the gel at rest.
        made: dict[str, Embedding] = {"counts": Cached(Frames(rest=None))}
        if self.weights is not None:
            made["network"] = Cached(Frames(self.weights, rest=None))
        return made

    @cached_property
    def _waves(self) -> Embedding:
        return Cached(Frames(rest=None, cosines=COSINES))

    @cached_property
    def _counts(self) -> FloatArray:
        """Of every frame what the trees read: `Frames` without a network, (videos, frames, d)."""
        plain = self._embeddings["counts"]
        return np.stack([self._read(plain, i) for i in range(len(self.recordings))]).astype(np.float64)

    @property
    def _width(self) -> int:
        """Columns of a frame in its tactile image, the one scale of a camera's memory."""
        return min(FRAMES, self.recordings.sensor.shape[1])

    def _read(self, embedding: Embedding, i: int) -> npt.NDArray[np.floating]:
        """Features of each frame of a video, (frames, d)."""
        image, width = image_of(self.recordings.streams[i], None), self._width
        return embed_windows(embedding, image, {width: list(range(0, image.shape[1], width))})[width]

    def _trained(self, embedding: Embedding, tested: Mask, progress: Progress) -> TactileLearner:
        learner = TactileLearner(sensor=self.recordings.sensor, embedding=embedding, exemplars=0)
        return learn(learner, hold_out(self.recordings, tested)[0], progress)

    def _known(self, by: str, fold: int, progress: Progress) -> Figures:
        tested = self.recordings.fold == fold
        learner = self._trained(self._embeddings[by], tested, progress)
        streams = [self.recordings.streams[i] for i in np.flatnonzero(tested)]
        truth = self._names[tested].tolist()
        predicted = [learner.predict(stream) for stream in streams]
        of_frames = [[str(learner.predict(answer).material) for answer in _frames(stream)] for stream in streams]
        votes = [most_often(answers) for answers in of_frames]
        figures = {
            "learned": int((~tested).sum()),
            "tested": len(truth),
            "video": accuracy(truth, [answer.material for answer in predicted]),
            "frame": float(
                np.mean([answer == name for name, answers in zip(truth, of_frames, strict=True) for answer in answers])
            ),
            "vote": accuracy(truth, votes),
            "called unknown": float(np.mean([answer.known is False for answer in predicted])),
            "digest": learner.digest(),
        }
        if self.trees and by == "counts":  # they read nothing else
            progress("trees", 0, 1)
            chances, classes = self._grown(~tested, tested, self._names)
            figures["trees"] = accuracy(truth, classes[chances.mean(axis=1).argmax(axis=1)].tolist())
            graded = [most_often(answer.tolist()) for answer in classes[chances.argmax(axis=2)]]
            figures["trees' vote"] = accuracy(truth, graded)
        return figures

    def _unknown(self, group: Sequence[str], progress: Progress) -> Figures:
        tested = np.isin(self._names, group)
        learner = self._trained(self._waves, tested, progress)
        for name, values in self.attributes.items():
            if name not in group:
                learner.describe(
                    name, {_constituent(key, v): answer == v for key, answer in values.items() for v in VALUES}
                )
        test = np.flatnonzero(tested).tolist()
        predicted = [learner.compose(self.recordings.streams[i], unfamiliar=1.0) for i in test]
        keys = list(next(iter(self.attributes.values())))
        trained = {name: values for name, values in self.attributes.items() if name not in group}
        heads = fit_heads(learner.memory.statistics, Scale("window", self._width), trained, keys)
        means = [in_units(self._read(self._waves, i), self._waves.bound).mean(axis=0) for i in test]
        graded: dict[str, dict[str, Any]] = {}
        for key in keys:
            truth = [self.attributes[self.recordings.materials[i]][key] for i in test]
            composed = [_likeliest(answer, key) for answer in predicted]
            graded[key] = {
                "right": _share(truth, [heads[key](mean) for mean in means]),
                "composed": _share(truth, composed),
                "penalty": heads[key].penalty,
                "gamma": heads[key].gamma,
                **self._baselines(key, truth, tested, progress),
            }
        sizes = {"learned": int((~tested).sum()), "tested": len(test)}
        return {"objects": list(group), **sizes, "attributes": graded, "digest": learner.digest()}

    def _baselines(self, key: str, truth: Sequence[int], tested: Mask, progress: Progress) -> dict[str, float]:
        """Saying always what most videos of the others have; and the trees."""
        values = np.array([self.attributes.get(name, {}).get(key, -1) for name in self.recordings.materials])
        trained = ~tested & (values >= 0)
        often = most_often(values[trained].tolist())
        figures = {"always": _share(truth, [often] * len(truth))}
        if self.trees:
            progress(f"trees of {key}", 0, 1)
            chances, classes = self._grown(trained, tested, values)
            figures["trees"] = _share(truth, classes[chances.mean(axis=1).argmax(axis=1)].tolist())
        return figures

    def _grown(self, trained: Mask, tested: Mask, targets: npt.NDArray[Any]) -> tuple[FloatArray, npt.NDArray[Any]]:
        """Probabilities of each frame of the tested videos, (videos, frames, classes), and the classes."""
        with optional("scikit-learn", "bench", "the baseline of trees", "leave it out with --trees 0"):
            from sklearn.ensemble import ExtraTreesClassifier
        rows, frames = self._counts, self._counts.shape[1]
        forest = ExtraTreesClassifier(self.trees, random_state=self.seed)
        forest.fit(rows[trained].reshape(-1, rows.shape[2]), np.repeat(targets[trained], frames))
        chances: FloatArray = forest.predict_proba(rows[tested].reshape(-1, rows.shape[2]))
        return chances.reshape(-1, frames, chances.shape[1]), forest.classes_


def object_groups(names: Sequence[str], groups: int, seed: int) -> list[list[str]]:
    """Names dealt into groups of nearly equal size; the same arguments give the same groups."""
    dealt = np.random.default_rng([seed, groups]).permutation(len(names)) % groups
    return [[name for name, own in zip(names, dealt.tolist(), strict=True) if own == i] for i in range(groups)]


def most_often(predicted: Sequence[Any]) -> Any:
    """What is reported most often; of equals the first in order."""
    return max(sorted(set(predicted)), key=list(predicted).count)


def summary(results: Sequence[tuple[Cell, Figures]]) -> dict[str, dict[str, dict[str, Any]]]:
    """Of each kind of part: mean over its videos, and standard deviation over its folds or groups, of each figure.

    Figures of attributes are named as "hardness", "hardness, composed", "hardness, trees" and "hardness, always".
    """
    means: dict[str, dict[str, dict[str, float]]] = {}
    for kind in dict.fromkeys(cell.system for cell, _ in results):
        answers = [(_flat(figures), figures["tested"]) for cell, figures in results if cell.system == kind]
        weights = [tested for _, tested in answers]
        for name in answers[0][0]:
            means.setdefault(kind, {})[name] = over_folds([figures[name] for figures, _ in answers], weights)
    return means


def _flat(result: Mapping[str, Any]) -> dict[str, float]:
    figures = {name: result[name] for name in ("video", "vote", "frame", "trees", "trees' vote") if name in result}
    for key, answer in result.get("attributes", {}).items():
        figures |= {
            key if what == "right" else f"{key}, {what}": value
            for what, value in answer.items()
            if what not in ("penalty", "gamma")
        }
    return figures


def gelsight(
    context: typer.Context,
    data: Data,
    weights: Weights = None,
    folds: Folds = "all",
    groups: Annotated[int, typer.Option(min=2, help="Objects are left out in so many groups.")] = 5,
    seed: Seed = 0,
    trees: Annotated[int, typer.Option(min=0, help="Of the baseline, scikit-learn's; 0: none.")] = TREES,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
) -> None:
    """Classify everyday objects by a GelSight's videos, and grade how hard and rough held-out objects are."""
    with progress_bar() as progress:
        progress("reading", 0, 1)
        (frames,) = read("--data", "gelsight", data, seed, known=["gelsight"], quick=quick).values()
        recordings, attributes = physiclear.videos(frames), physiclear.read_attributes(data)
        felt = set(recordings.materials)
        known = {name: values for name, values in attributes.items() if name in felt}
        task = Objects(recordings, known, weights, groups, seed, trees, run)
        results = list(task.run(folds_of(folds, recordings, quick=quick), progress))
    means = summary(results)
    columns = {"objects": "{./part}", "figure": "{./figure}", "right by video, %": "{./right|±}"}
    flat = [{"part": part, "figure": name, "right": mean} for part, own in means.items() for name, mean in own.items()]
    show("GelSight", columns, flat)
    parts = [{"part": cell.system, "number": cell.fold} | figures for cell, figures in results]
    write(context, task.plan | {"means": means, "parts": parts})


def _constituent(attribute: str, value: int) -> str:
    return f"{attribute} {value}"


def _share(truth: Sequence[int], predicted: Sequence[int]) -> float:
    return float(np.mean([true == guess for true, guess in zip(truth, predicted, strict=True)]))


def _likeliest(predicted: Composition, attribute: str) -> int:
    """The value of the largest presence; one without a head, which no or every object has, is never reported."""
    chances = [predicted[_constituent(attribute, value)].presence for value in VALUES]
    return int(np.argmax([-1.0 if chance is None else chance for chance in chances]))


def _frames(stream: Stream) -> list[Stream]:
    return [Stream(stream.sensor, stream.readings[i : i + 1]) for i in range(len(stream))]
