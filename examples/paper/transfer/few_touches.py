"""Few touches of each material, drawn several times, learned by a closed-form readout, and a test after each number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from examples.paper.readers.labelled import Recordings
from examples.paper.runs.cells import Cell, Figures, over_folds
from scroll_tactile.embeddings.protocol import Embedding, window_plan
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.learner import TactileLearner
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.readouts.readout import Readout
from scroll_tactile.readouts.task import Task
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import Stream
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import in_units, mean_code, to_codes
from scroll_tactile.statistics.statistics import Statistics

__all__ = [
    "COUNTS",
    "FewTouchLearner",
    "WidestFeatures",
    "WidestReadout",
    "candidate_maker",
    "draw_touches",
    "few_touches",
    "points_of",
]

COUNTS = (1, 2, 5, 10, 20)
"""Touches of each material after which the test is taken."""

WHOLE = Scale("window", 1)  # features of a touch as a whole: one row each


class FewTouchLearner(Protocol):
    """What learns touches one by one, and classifies others."""

    def observe(self, material: str, stream: Stream) -> object:
        """Learn a touch."""

    def name_of(self, stream: Stream) -> str:
        """The material of a touch, one of those learned."""


class WidestFeatures:
    """Features of touches at the widest scale, each touch embedded once.

    Raises InputError for an embedding whose answers rest on more than the widest scale that fits.
    """

    def __init__(self, sensor: Sensor, embedding: Embedding) -> None:
        plan = window_plan(sensor, embedding)
        if plan.judged != "widest":
            raise InputError(f"expected an embedding that judges by the widest scale alone; came {embedding!r}")
        self.embedding = embedding
        self._plan = plan
        self._extractor = FeatureExtractor(sensor, embedding, plan)
        self._kept: dict[bytes, npt.NDArray[np.floating]] = {}

    def __call__(self, stream: Stream) -> npt.NDArray[np.floating]:
        """Features of a touch's windows, (windows, d), the widest scale's. Raises InputError for a shorter touch."""
        if stream.key not in self._kept:
            image = tactile_image(stream)
            width = self._plan.widths[-1]
            if image.shape[1] < width:
                raise InputError(f"expected touches of {width} readings or more; came one of {image.shape[1]}")
            scale = self._plan.windows[-1]
            features = self._extractor.features(image, [scale])[scale]
            self._kept[stream.key] = features[self._plan.places(image.shape[1])[scale]]
        return self._kept[stream.key]


class WidestReadout:
    """A `TactileLearner` with LDA, of touches that are all whole, and an embedding that judges by the widest scale.

    It names the same materials: narrower windows do not count there. It spares embedding them, which for a network is
    four fifths of the work, and the calibration, which changes no ranking.

    features: of touches, kept and shared by as many readouts as there are draws.
    """

    def __init__(self, features: WidestFeatures) -> None:
        self._features = features
        self._statistics = Statistics(features.embedding.dimension, (WHOLE,))
        self._readout: Readout | None = None

    def observe(self, material: str, stream: Stream) -> None:
        """See `FewTouchLearner.observe`."""
        codes = to_codes(self._features(stream), self._features.embedding.bound)
        mean = mean_code(codes.sum(axis=0, dtype=np.int64), len(codes)).astype(np.int32)
        self._statistics.add(material, {WHOLE: mean[None]})
        self._readout = None

    def name_of(self, stream: Stream) -> str:
        """See `FewTouchLearner.name_of`. Raises InputError before anything was learned."""
        names = self._statistics.names(WHOLE)
        if not names:
            raise InputError("expected a readout that has learned something; it has not. Call observe first")
        self._readout = self._readout or Task.of(self._statistics, WHOLE, names).solve()
        mean = in_units(self._features(stream), self._features.embedding.bound).mean(axis=0)
        return names[int(self._readout.scores(mean, range(len(names)), "lda").argmax())]


class _LearnerFeeler:
    """A `TactileLearner` as a Feeler."""

    def __init__(self, sensor: Sensor, embedding: Embedding) -> None:
        self._learner = TactileLearner(sensor=sensor, embedding=embedding, exemplars=0)
        self.observe = self._learner.observe

    def name_of(self, stream: Stream) -> str:
        return str(self._learner.predict(stream).material)


def candidate_maker(sensor: Sensor, embedding: Embedding) -> Callable[[], FewTouchLearner]:
    """What makes new learners with an embedding: `TactileLearner`, or `WidestReadout` where that answers the same."""
    if window_plan(sensor, embedding).judged == "widest":
        features = WidestFeatures(sensor, embedding)
        return lambda: WidestReadout(features)
    return lambda: _LearnerFeeler(sensor, embedding)


def draw_touches(recordings: Recordings, fold: int, seed: int, draw: int) -> dict[str, list[list[int]]]:
    """Material → its touches outside a fold, in an order that a seed draws; each the places of its recordings.

    Frames of one video are one touch. Another draw is another order; the same draw is the same whatever is learned.
    Raises InputError for a fold that is not there, or that leaves a material without touches.
    """
    if fold not in recordings.fold:
        there = sorted(set(recordings.fold.tolist()))
        raise InputError(f"expected a fold of {recordings.name} out of {there}; came {fold}")
    touches: dict[str, dict[tuple[int, int], list[int]]] = {name: {} for name in sorted(set(recordings.materials))}
    for i in np.flatnonzero(recordings.fold != fold).tolist():
        mark = (int(recordings.fold[i]), int(recordings.repetition[i]))
        touches[recordings.materials[i]].setdefault(mark, []).append(i)
    drawn: dict[str, list[list[int]]] = {}
    for place, (name, own) in enumerate(touches.items()):
        if not own:
            raise InputError(f"expected touches of {name!r} of {recordings.name} outside of fold {fold}; there is none")
        groups = list(own.values())
        order = np.random.default_rng([seed, fold, draw, place]).permutation(len(groups))
        drawn[name] = [groups[i] for i in order]
    return drawn


def few_touches(
    recordings: Recordings,
    fold: int,
    make: Callable[[], FewTouchLearner],
    counts: Sequence[int],
    draws: int,
    seed: int,
    progress: Progress,
) -> dict[str, Any]:
    """Right answers on a fold after so many touches of each material from the others, for several draws of these.

    Returns tested, the number of recordings tested, and by count: right, one number a draw, and learned, the mean
    number of touches of a material. A count that no material has is left out; a material that has fewer gives all.
    """
    test = np.flatnonzero(recordings.fold == fold).tolist()
    drawn = [draw_touches(recordings, fold, seed, draw) for draw in range(draws)]
    most = max(len(own) for own in drawn[0].values())
    stops = [count for count in sorted(counts) if count <= most]
    right: dict[str, list[int]] = {str(count): [] for count in stops}
    trained = {str(count): float(np.mean([min(count, len(own)) for own in drawn[0].values()])) for count in stops}
    for draw, touches in enumerate(drawn):
        candidate, begun = make(), 0
        for stop in stops:
            train = [(name, i) for name, own in touches.items() for group in own[begun:stop] for i in group]
            total = len(train) + len(test)
            what = f"draw {draw + 1} of {draws}, {stop} touches"
            for done, (name, i) in enumerate(train):
                candidate.observe(name, recordings.streams[i])
                progress(what, done + 1, total)
            hits = 0
            for done, i in enumerate(test):
                hits += candidate.name_of(recordings.streams[i]) == recordings.materials[i]
                progress(what, len(train) + done + 1, total)
            right[str(stop)].append(hits)
            begun = stop
    return {"tested": len(test), "right": right, "learned": trained}


def points_of(
    results: Sequence[tuple[Cell, Figures]], beside: str
) -> dict[tuple[str, str], dict[str, dict[str, float | None]]]:
    """(data set, system) → count of touches → mean accuracy over folds and draws, and its standard deviation.

    "gain", "gain sd": of the difference to the system `beside`, of the same draws; None where it was not measured.
    """
    shares: dict[tuple[str, str], dict[str, list[float]]] = {}
    for cell, figures in results:
        own = shares.setdefault((cell.dataset, cell.system), {})
        for count, right in figures["right"].items():
            own.setdefault(count, []).extend(hits / figures["tested"] for hits in right)
    found: dict[tuple[str, str], dict[str, dict[str, float | None]]] = {}
    for (dataset, system), own in shares.items():
        points = found.setdefault((dataset, system), {})
        for count, values in own.items():
            points[count] = over_folds(values) | {"gain": None, "gain sd": None}
            others = shares.get((dataset, beside), {}).get(count, [])
            if len(others) == len(values):
                gain = over_folds(np.subtract(values, others).tolist())
                points[count] |= {"gain": gain["mean"], "gain sd": gain["sd"]}
    return found
