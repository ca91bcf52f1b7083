"""`metrics`: continual learning by the field's own metrics, class by class and in Si-Blurry streams, and by fleets.

Every method learns the same touches in the same order, and is tested on what it has met so far. `f` reads streams; a
peer reads one vector a touch, see `touch_features`. Features are embedded once, before anything is timed.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.runs.cached import Cached
from examples.paper.runs.cells import Cell, Figures, over_folds, require_folds, run_cells, silent
from examples.paper.runs.options import Data, Dataset, Folds, Json, Quick, Run, Seed, folds_of, numbers, read
from examples.paper.runs.results import show, write
from examples.paper.runs.study import OwnSystems, sensors_of
from examples.paper.studies.continual_metrics import METRICS, Points, accuracy_of, metrics_of, tally
from examples.paper.studies.fleet_study import Fleet
from examples.paper.studies.peers import (
    ACIL,
    ContinualPeer,
    NearestMean,
    NearestNeighbour,
    RanPAC,
    StreamingLDA,
    touch_features,
)
from examples.paper.studies.peers_replay import GDumb, Replaying
from examples.paper.studies.random_convolution import random_convolution
from examples.paper.studies.schedules import arrange, part_ends, si_blurry
from examples.paper.systems.coming import Coming, code_of, require_systems
from scroll_tactile import Embedding, Kernels
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.clients.learning.metrics import Labelled
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.learner import TactileLearner

__all__ = ["METHODS", "STREAMS", "ContinualMetrics", "metrics", "summary"]

ALPHAS = (0.1, 1.0, 10.0)
STREAMS = ("class by class", "Si-Blurry")
"""In which order touches come: a task is a material, or one of five tasks with blurred edges."""

_PEERS: dict[str, Callable[[int, int], ContinualPeer]] = {
    "nearest neighbour": lambda capacity, seed: NearestNeighbour(),
    "nearest mean": lambda capacity, seed: NearestMean(),
    "streaming LDA": lambda capacity, seed: StreamingLDA(),
    "RanPAC": lambda capacity, seed: RanPAC(seed),
    "ACIL": lambda capacity, seed: ACIL(seed),
    "GDumb": GDumb,
    "experience replay": Replaying,
    "naive fine-tuning": lambda capacity, seed: Replaying(0, seed),
}
OURS, CONTROL = "f", "f on a random Conv1d"
METHODS = (OURS, CONTROL, *_PEERS)
"""Ours, the default learner without fine-tuning; the same on features that nobody designed; and the peers."""


@dataclass(frozen=True)
class ContinualMetrics:
    """What is measured, and where finished cells are noted.

    every: measure after so many touches, and at the end of each task. capacity: touches in the peers' buffers.
    robots: of the fleets, beside one robot that has everything. alphas: of their Dirichlet splits. seed: of all that is
    drawn. features: of the kernels. systems: of one's own, beside METHODS. folder: of the notes, so that a run that was
    killed resumes; or None.

    Raises InputError for fewer touches than one between two measurements, or fewer robots than one.
    """

    recordings: Recordings
    seed: int = 0
    every: int = 40
    capacity: int = 200
    robots: tuple[int, ...] = (10, 100)
    alphas: tuple[float, ...] = ALPHAS
    features: int = 1008
    folder: Path | None = None
    systems: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.every < 1:
            raise InputError(f"expected to measure after every 1 or more touches; came {self.every}")
        if any(robots < 1 for robots in self.robots):
            raise InputError(f"expected fleets of 1 or more robots; came {list(self.robots)}")

    @property
    def plan(self) -> dict[str, Any]:
        """All that a figure depends on, in JSON's types."""
        options = {name: getattr(self, name) for name in ("seed", "every", "capacity", "features")}
        return {"run": "metrics", "dataset": self.recordings.name, **options}

    def run(self, folds: Sequence[int], progress: Progress = silent) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each fold's methods and fleets, as they are finished; those finished before are read back.

        Raises InputError for a fold that is not there or a folder of another run, and what learning raises.
        """
        require_folds(self.recordings.fold, folds)
        for fold in folds:
            measured = _MetricsFold(self, fold)
            cells = [Cell(self.recordings.name, fold, key) for key in measured.measures]
            code = code_of(self.systems)
            yield from run_cells(self.folder, self.plan, [self.recordings], cells, measured.measure, progress, code)

    @cached_property
    def kernels(self) -> Embedding:
        """Of ours and, at the widest scale, of the peers."""
        return Cached(Kernels(dimension=self.features))

    @cached_property
    def control(self) -> Embedding:
        """The random convolution."""
        return Cached(random_convolution(self.recordings.sensor.channels, self.seed, dimension=self.features))


@dataclass(frozen=True)
class _Method:
    """A learner as the study sees it: touches are known by their places among those of the fold."""

    observe: Callable[[int], object]
    boundary: Callable[[], object]
    predict: Callable[[Sequence[int]], Sequence[str | None]]


class _MetricsFold:
    """One fold: what is learned in which order, what is tested, and how each cell is measured."""

    def __init__(self, task: ContinualMetrics, fold: int) -> None:
        self.task = task
        self.train, self.test = hold_out(task.recordings, task.recordings.fold == fold)
        self.truth = [name for name, _ in self.test]
        self.measures: dict[str, Callable[[Progress], Figures]] = {
            f"{stream}, {method}": partial(self._pass, stream, method)
            for stream in STREAMS
            for method in (*METHODS, *task.systems)
        }
        fleets = [(1, 1.0), *((robots, alpha) for robots in task.robots for alpha in task.alphas)]
        self.measures |= {
            f"fleet of {robots}, alpha {alpha:g}": partial(self._fleet, robots, alpha) for robots, alpha in fleets
        }

    def measure(self, cell: Cell, progress: Progress) -> Figures:
        """The figures of a cell."""
        return self.measures[cell.system](progress)

    @cached_property
    def vectors(self) -> tuple[np.ndarray, np.ndarray]:
        """One vector for each touch that is learned, and for each of the test."""
        both = [[stream for _, stream in touches] for touches in (self.train, self.test)]
        trained, tested = (touch_features(self.task.kernels, streams) for streams in both)
        return trained, tested

    @cached_property
    def _fleets(self) -> Fleet:
        return Fleet(self.task.recordings.sensor, self.task.kernels, self.train, self.test, *self.vectors)

    def _fleet(self, robots: int, alpha: float, progress: Progress) -> Figures:
        return self._fleets.measure(robots, alpha, self.task.seed, progress)

    def _pass(self, stream: str, name: str, progress: Progress) -> Figures:
        order, ends = self._order(stream)
        make = self._maker(name, progress)
        return {"ends": ends, **self._accuracies(make(), order, ends, progress), **_memory(make(), order, ends)}

    def _order(self, stream: str) -> tuple[list[int], list[int]]:
        names = [name for name, _ in self.train]
        if stream == "Si-Blurry":
            return si_blurry(names, self.task.seed)
        order = arrange("class-by-class", names, self.task.seed)
        return order, part_ends("class-by-class", [names[i] for i in order])

    def _maker(self, name: str, progress: Progress) -> Callable[[], _Method]:
        if name in self.task.systems:
            return lambda: _of_system(Coming(name, self.task.seed), self.train, self.test)
        if name in _PEERS:
            trained, tested = self.vectors
            return lambda: _of_vectors(
                _PEERS[name](self.task.capacity, self.task.seed), [name for name, _ in self.train], trained, tested
            )
        embedding = self.task.kernels if name == OURS else self.task.control
        self._embed(embedding, progress)
        return lambda: _of_streams(self._learner(embedding), self.train, self.test)

    def _learner(self, embedding: Embedding) -> TactileLearner:
        return TactileLearner(sensor=self.task.recordings.sensor, embedding=embedding, exemplars=0)

    def _embed(self, embedding: Embedding, progress: Progress) -> None:
        """Have all touches embedded, as an observation does and as an answer does, before anything is timed."""
        learner = self._learner(embedding)
        for done, (material, stream) in enumerate(self.train):
            learner.observe(material, stream)
            progress("embedding", done, len(self.train) + len(self.test))
        for done, (_, stream) in enumerate(self.test, start=len(self.train)):
            learner.predict(stream)
            progress("embedding", done, len(self.train) + len(self.test))

    def _accuracies(self, method: _Method, order: list[int], ends: list[int], progress: Progress) -> Figures:
        points: Points = {}
        met: set[str] = set()
        learning = [0.0] * len(ends)
        answering = [0.0] * len(ends)
        stops = {*range(self.task.every, len(order) + 1, self.task.every), *ends}
        for done, i in enumerate(order, start=1):
            place = int(np.searchsorted(ends, done))
            met.add(self.train[i][0])
            begun = time.process_time()
            method.observe(i)
            if done in ends:
                method.boundary()
            learning[place] += time.process_time() - begun
            if done in stops:
                asked = [i for i, name in enumerate(self.truth) if name in met]
                begun = time.process_time()
                predicted = method.predict(asked)
                if done in ends:
                    answering[place] = time.process_time() - begun
                points[str(done)] = tally([self.truth[i] for i in asked], predicted)
                progress("learning", done, len(order))
        curve = [[int(key), accuracy_of(point)] for key, point in points.items()]
        seconds = {"learning_seconds": learning, "answering_seconds": answering}
        return {"tested": len(self.test), **metrics_of(points, ends), "curve": curve, **seconds}


def _memory(method: _Method, order: list[int], ends: list[int]) -> Figures:
    """The peak of what was allocated and held during each task, bytes, in a pass of its own, as tracemalloc sees it.

    It sees Python's objects and numpy's arrays: not LAPACK's own working space, nor the features, which all share.
    """
    peaks = []
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for done, i in enumerate(order, start=1):
            method.observe(i)
            if done in ends:
                method.boundary()
                method.predict([0])  # what is put off to the first answer counts, too
                peaks.append(tracemalloc.get_traced_memory()[1] - before)
                tracemalloc.reset_peak()
    finally:
        tracemalloc.stop()
    return {"peak_bytes": peaks}


def _of_vectors(peer: ContinualPeer, names: Sequence[str], trained: np.ndarray, tested: np.ndarray) -> _Method:
    def observe(i: int) -> None:
        peer.observe(trained[i].copy(), names[i])  # a copy: what a peer keeps is its own memory

    return _Method(observe, peer.boundary, lambda places: peer.predict(tested[list(places)]))


def _of_system(system: Coming, train: Sequence[Labelled], test: Sequence[Labelled]) -> _Method:
    return _Method(
        lambda i: system.observe(i, train[i]),
        lambda: None,
        lambda places: system.predict([test[i][1] for i in places]),
    )


def _of_streams(learner: TactileLearner, train: Sequence[Labelled], test: Sequence[Labelled]) -> _Method:
    return _Method(
        lambda i: learner.observe(*train[i]),
        lambda: None,
        lambda places: [learner.predict(test[i][1]).material for i in places],
    )


def summary(cells: Sequence[tuple[Cell, Figures]]) -> dict[str, dict[str, Any]]:
    """Of each method in each stream, and of each fleet, by name: means and spreads over the folds of its figures.

    Seconds are the processor's in a task, the mean over tasks, of all threads; megabytes the largest of the tasks'
    peaks.
    """
    found: dict[str, list[Figures]] = {}
    for cell, figures in cells:
        found.setdefault(cell.system, []).append(figures)
    return {system: _means([_flat(figures) for figures in folds]) for system, folds in found.items()}


def _flat(figures: Mapping[str, Any]) -> dict[str, float | None]:
    if "robots" in figures:
        averaged = {f"{net}, {when}": share for net, by in figures["averaged"].items() for when, share in by.items()}
        flags = {name: float(figures[name]) for name in ("accuracy", "same_bytes", "same_answers", "busy")}
        return flags | averaged
    return {name: figures[name] for name in METRICS} | {
        "learning": float(np.mean(figures["learning_seconds"])),
        "answering": float(np.mean(figures["answering_seconds"])),
        "megabytes": max(figures["peak_bytes"]) / 1e6,
    }


def _means(folds: Sequence[Mapping[str, float | None]]) -> dict[str, Any]:
    columns = {name: [x for fold in folds if (x := fold[name]) is not None] for name in folds[0]}
    return {name: over_folds(values) for name, values in columns.items() if len(values) == len(folds)}


def metrics(
    context: typer.Context,
    dataset: Dataset,
    data: Data,
    folds: Folds = "all",
    seed: Seed = 0,
    every: Annotated[int, typer.Option(min=1, help="Measure after every so many touches.")] = 40,
    buffer: Annotated[int, typer.Option(min=1, help="Touches in the peers' buffers.")] = 200,
    robots: Annotated[str, typer.Option(help="Of the fleets, beside one robot.")] = "10,100",
    own_systems: OwnSystems = None,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
) -> None:
    """Learn a recorded set class by class and in a Si-Blurry stream; measure on the way what the field measures.

    Accuracy at the end, over tasks and at any time, forgetting, backward transfer, seconds and peak memory a task: of
    ours and of other continual learners. Then deal the touches to fleets, and merge what their robots learned.
    """
    own = require_systems(own_systems)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        (recordings,) = read("DATASET", dataset, data, seed, quick=quick).values()
        fleets = tuple(numbers("--robots", robots))[: 1 if quick else None]
        alphas = ALPHAS[: 1 if quick else None]
        task = ContinualMetrics(recordings, seed, every, buffer, fleets, alphas, folder=run, systems=own)
        results = list(task.run(folds_of(folds, recordings, quick=quick), progress))
    means = summary(results)
    columns = {"stream, method": "{./name}"} | {f"{name}, %": f"{{?./{name}|±}}" for name in METRICS}
    columns |= {"seconds a task": "{./learning/mean|.2f}", "MB": "{./megabytes/mean|.0f}"}
    named = [{"name": name} | row for name, row in means.items()]
    passes = [row for row in named if "learning" in row]
    show("the processor's seconds; MB: the peak of a task, as tracemalloc sees it", columns, passes)
    nets = [f"{net}, {rounds}" for net in ("linear", "MLP") for rounds in ("1 round", "20 rounds")]
    columns = {"touches dealt to a": "{./name}", "the same bytes": "{./same_bytes/mean|%}", "ours, %": "{./accuracy|±}"}
    columns |= {net: f"{{./{net}|±}}" for net in nets}
    show("memories merged; networks averaged (FedAvg)", columns, [row for row in named if "learning" not in row])
    cells = {cell.key: figures for cell, figures in results}
    sensor = sensors_of([recordings])[recordings.name]
    write(context, task.plan | {"sensor": sensor, "methods": [*METHODS, *own], "means": means, "cells": cells})
