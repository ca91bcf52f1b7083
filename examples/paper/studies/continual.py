"""`continual`: f and f* for every size of the exemplar buffer, beside other continual learners.

f is the closed form, which no buffer and no order changes; f* is fine-tuned from it on the exemplars alone. Beside
them, under the same folds and the same order, the ridge floor and the peers on the same features.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.runs.cached import Cached
from examples.paper.runs.cells import Cell, Figures, learn, require_folds, run_cells, silent
from examples.paper.runs.options import Data, Dataset, Device, Folds, Json, Plot, Quick, Run, Seed, folds_of, read
from examples.paper.runs.pictures import draw_into
from examples.paper.runs.results import show, write
from examples.paper.runs.study import OwnSystems, sensors_of
from examples.paper.studies.continual_metrics import (
    Points,
    accuracy_of,
    curve,
    forgetting_of,
    method_row,
    spread_of,
    tally,
)
from examples.paper.studies.continual_picture import draw_continual
from examples.paper.studies.peers import ContinualPeer, NearestMean, RanPAC, StreamingLDA, touch_features
from examples.paper.studies.peers_replay import GDumb, Replaying
from examples.paper.studies.replay import PUBLISHED
from examples.paper.studies.schedules import SCHEDULES, arrange, part_ends
from examples.paper.systems.coming import Coming, code_of, require_systems
from examples.paper.systems.own import frozen_embedding, is_own
from scroll_tactile import Embedding
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.clients.learning.metrics import Labelled
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.learner import TactileLearner
from scroll_tactile.readouts.readout import ReadoutName

__all__ = ["SIZES", "Continual", "Size", "continual", "parse_sizes", "rows"]

Size = int | Literal["all"]
"""Of the buffer: exemplars in all, or every touch learned."""

SIZES: tuple[Size, ...] = (0, 20, 50, 100, 200, 400, "all")

_REPORTED = ("kept", "reason", "mode", "exemplars", "epochs", "held_out")

PEERS: dict[str, Callable[[int, int], ContinualPeer]] = {
    "nearest mean": lambda capacity, seed: NearestMean(),
    "streaming LDA": lambda capacity, seed: StreamingLDA(),
    "RanPAC": lambda capacity, seed: RanPAC(seed),
    "naive fine-tuning": lambda capacity, seed: Replaying(0, seed),
    "GDumb": GDumb,
    "experience replay": Replaying,
}
"""Name → what makes it, of a capacity and a seed; the last two have a buffer."""
WITH_BUFFER = ("GDumb", "experience replay")


@dataclass(frozen=True)
class Continual:
    """What to learn, and what to measure.

    recordings: the streams. embedding: frozen, of `f`, `f*` and the peers; each touch is embedded once.
    schedule, seed: see `arrange`; the seed draws the order, and what fine-tuning and the peers draw.
    sizes: of the buffer. epochs: of a fine-tune; the learner's own choice where it is None. device: of fine-tunes.
    every: measure after every so many parts of the pass, as many as materials (see `part_ends`); 0: at its end only,
    and no forgetting. tuned_curve: measure `f*` there too, each time from a fine-tune of its own.
    peers: whether to run them. systems: of one's own, beside them. folder: where finished parts are noted, so that an
    interrupted run resumes; or None.

    Raises InputError for sizes that cannot be, such as fewer exemplars than materials, or a negative `every`.
    """

    recordings: Recordings
    embedding: Embedding
    schedule: str = "class-by-class"
    seed: int = 0
    sizes: tuple[Size, ...] = SIZES
    every: int = 1
    tuned_curve: bool = False
    epochs: int | None = None
    peers: bool = True
    device: str = "cpu"
    folder: Path | None = None
    systems: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        kinds = len(set(self.recordings.materials))
        if self.every < 0:
            raise InputError(
                f"expected a curve measured after every 1 or more parts of the pass, or 0; came {self.every}"
            )
        if not self.sizes:
            raise InputError("expected at least one size of the buffer; came none")
        for size in self.sizes:
            if size != "all" and (size < 0 or 0 < size < kinds):
                raise InputError(
                    f"expected a buffer of 0, or of an exemplar of each of the {kinds} materials at least; came {size}"
                )

    @property
    def plan(self) -> dict[str, Any]:
        """All that each figure depends on, in JSON's types; sizes, folds and peers can be added to a run later."""
        made = {name: getattr(self.embedding, name) for name in ("name", "dimension", "fingerprint")}
        options = {name: getattr(self, name) for name in ("schedule", "seed", "tuned_curve", "epochs", "device")}
        about = {"run": "continual", "dataset": self.recordings.name, "embedding": made, "curve": self.every}
        return about | options

    def run(self, folds: Sequence[int], progress: Progress = silent) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each method in each fold, as they are finished; those finished before are read back.

        Without a buffer f answers, so that there is no f* of size 0.

        Raises InputError for a fold that is not there or a folder of another run, and what learning raises.
        """
        require_folds(self.recordings.fold, folds)
        sizes = [size for size in self.sizes if size]
        methods = ["f", "ridge", *(f"f* {size}" for size in sizes)]
        if self.peers:
            methods += [name for name in PEERS if name not in WITH_BUFFER]
            methods += [f"{name} {size}" for size in sizes for name in WITH_BUFFER]
        methods += self.systems
        for fold in folds:
            cells = [Cell(self.recordings.name, fold, method) for method in methods]
            measure = _ContinualFold(self, self._cached, fold).measure
            code = code_of(self.systems)
            yield from run_cells(self.folder, self.plan, [self.recordings], cells, measure, progress, code)

    @cached_property
    def _cached(self) -> Embedding:
        return Cached(self.embedding)


class _ContinualFold:
    """One fold: what is learned, what is tested, and how each method is measured."""

    def __init__(self, task: Continual, embedding: Embedding, number: int) -> None:
        self.task = task
        self.embedding = embedding
        recordings = task.recordings
        trained, self.test = hold_out(recordings, recordings.fold == number)
        self.train = [trained[i] for i in arrange(task.schedule, [name for name, _ in trained], task.seed)]
        self.total = len(self.train)
        self.ends = part_ends(task.schedule, [name for name, _ in self.train])
        every = task.every
        self.stops = sorted({self.total, *(self.ends[every - 1 :: every] if every else ())})

    def measure(self, cell: Cell, progress: Progress) -> Figures:
        """The figures of a method, by its name and the size of its buffer."""
        if cell.system == "f":
            learner = self._learner(0)
            points = self._learn(learner, self.stops, lambda test: _predict(learner, test), progress)
            return {"digest": learner.digest(), **_figures(points)}
        if cell.system == "ridge":
            learner = self._offline(self._learner(0, "ridge"), progress)
            floor = accuracy_of(tally([name for name, _ in self.test], _predict(learner, self.test)))
            return {"digest": learner.digest(), "accuracy": floor, "forgetting": None, "curve": []}
        if cell.system in self.task.systems:
            return self._own(Coming(cell.system, self.task.seed), progress)
        if cell.system in PEERS:
            return self._peer(PEERS[cell.system](0, self.task.seed), progress)
        method, _, size = cell.system.rpartition(" ")
        capacity = self.total if size == "all" else int(size)
        if method == "f*":
            return self._tuned(capacity, progress)
        return self._peer(PEERS[method](capacity, self.task.seed), progress)

    def _learner(self, exemplars: int, readout: ReadoutName = "lda") -> TactileLearner:
        sensor = self.task.recordings.sensor
        return TactileLearner(sensor=sensor, embedding=self.embedding, readout=readout, exemplars=exemplars)

    def _offline(self, learner: TactileLearner, progress: Progress) -> TactileLearner:
        """The same touches learned in another order, all at random, as offline training has them."""
        order = np.random.default_rng([self.task.seed, 1]).permutation(self.total)
        return learn(learner, [self.train[i] for i in order], progress, "learning in another order")

    def _tuned(self, capacity: int, progress: Progress) -> Figures:
        learner = self._learner(capacity)

        def tune() -> Any:
            return learner.fine_tune(
                epochs=self.task.epochs,
                seed=self.task.seed,
                device=self.task.device,
                progress=lambda step, done, of: progress(f"fine-tuning ({step})", done, of),
            )

        def answer(test: Sequence[Labelled]) -> list[str | None]:
            if len(learner.materials) > 1:  # with one there is nothing to classify
                tune()
            return _predict(learner, test, tuned=True)

        points = self._learn(learner, self.stops[:-1] if self.task.tuned_curve else [], answer, progress)
        report = tune()
        test = tally([material for material, _ in self.test], _predict(learner, self.test, tuned=True))
        other = self._offline(self._learner(capacity), progress)
        return {
            "digest": learner.digest(),
            "tuned_digest": learner.tuned_digest(),
            "buffer_digest": _buffer_digest(learner),
            "buffer_of_another_order": _buffer_digest(other) == _buffer_digest(learner),
            "bytes_per_exemplar": self._bytes(learner),
            "tuning_seconds": report.seconds,
            **{name: getattr(report, name) for name in _REPORTED},
            **_figures(points | {str(self.total): test}),
        }

    def _bytes(self, learner: TactileLearner) -> float:
        """Bytes of an exemplar's readings, as they are recorded: float32 of shape (T, n)."""
        sizes = {stream.key: stream.readings.nbytes for _, stream in self.train}
        kept = [sizes[key] for keys in learner.exemplars.values() for key in keys]
        return sum(kept) / max(1, len(kept))

    def _learn(
        self,
        learner: TactileLearner,
        stops: Sequence[int],
        answer: Callable[[Sequence[Labelled]], list[str | None]],
        progress: Progress,
    ) -> Points:
        """Learn all training touches, and measure after so many of them."""
        points: Points = {}
        for done, (material, stream) in enumerate(self.train, start=1):
            learner.observe(material, stream)
            progress("learning", done, self.total)
            if done in stops:
                asked = [touch for touch in self.test if touch[0] in learner.materials]
                points[str(done)] = tally([truth for truth, _ in asked], answer(asked))
        return points

    def _own(self, system: Coming, progress: Progress) -> Figures:
        """A system of one's own: it is asked where the others are."""
        points: Points = {}
        for done, touch in enumerate(self.train, start=1):
            system.observe(done, touch)
            progress("learning", done, self.total)
            if done in self.stops:
                met = {material for material, _ in self.train[:done]}
                asked = [touch for touch in self.test if touch[0] in met]
                predicted = system.predict([stream for _, stream in asked])
                points[str(done)] = tally([truth for truth, _ in asked], predicted)
        return {"one_pass": system.one_pass, **_figures(points)}

    @cached_property
    def _vectors(self) -> tuple[np.ndarray, np.ndarray]:
        """Features of the training and of the test touches."""
        trained = touch_features(self.embedding, [stream for _, stream in self.train])
        return trained, touch_features(self.embedding, [stream for _, stream in self.test])

    def _peer(self, peer: ContinualPeer, progress: Progress) -> Figures:
        trained, tested = self._vectors
        truth = [material for material, _ in self.test]
        points: Points = {}
        for done, ((material, _), features) in enumerate(zip(self.train, trained, strict=True), start=1):
            peer.observe(features, material)
            if done in self.ends:
                peer.boundary()
                progress("learning", done, self.total)
            if done in self.stops:
                met = [i for i, material in enumerate(truth) if material in peer.materials]
                points[str(done)] = tally([truth[i] for i in met], peer.predict(tested[met]))
        return _figures(points)


def _predict(learner: TactileLearner, touches: Sequence[Labelled], *, tuned: bool = False) -> list[str | None]:
    return [learner.predict(stream, tuned=tuned).material for _, stream in touches]


def _figures(points: Points) -> dict[str, Any]:
    last = max(points, key=int)
    return {"accuracy": accuracy_of(points[last]), "forgetting": forgetting_of(points), "curve": curve(points)}


def _buffer_digest(learner: TactileLearner) -> str:
    """Hex, equal for two buffers if and only if they hold the same exemplars in the same ranks."""
    digest = sha256()
    for material, keys in sorted(learner.exemplars.items()):
        digest.update(f"{material}\0{len(keys)}\0".encode())
        digest.update(b"".join(keys))
    return digest.hexdigest()


def rows(results: Sequence[tuple[Cell, Figures]]) -> list[dict[str, Any]]:
    """One row for each method and size of the buffer: means and standard deviations over the folds.

    A row has the method, its size (None: it has no buffer), accuracy and forgetting as {"mean", "sd"} (None: not
    measured), and the mean curve. Rows of `f*` also hold how many folds kept theirs, and the mean seconds of a
    fine-tune, exemplars, and bytes of one. f* of no exemplars is f.
    """
    found = []
    for system in dict.fromkeys(cell.system for cell, _ in results):
        folds = [figures for cell, figures in results if cell.system == system]
        method, _, size = ("", "", system) if system in PEERS or is_own(system) else system.rpartition(" ")
        row = method_row(method or system, size if method and size else None, folds)
        if method == "f*":
            of_each = {
                "seconds": "tuning_seconds",
                "exemplars": "exemplars",
                "bytes_per_exemplar": "bytes_per_exemplar",
            }
            row |= {name: spread_of([fold[key] for fold in folds]) for name, key in of_each.items()}
            row["kept"] = sum(fold["kept"] for fold in folds)
        found.append(row)
        if system == "f":
            found.append(row | {"method": "f*", "size": "0", "kept": 0})
    return found


def continual(
    context: typer.Context,
    dataset: Dataset,
    data: Data,
    embedding: Annotated[
        str, typer.Option(help="The frozen features: kernels, vision, kernels+vision, or one's own, as module:factory.")
    ] = "kernels",
    weights: Annotated[
        str | None, typer.Option(help="Of the vision embedding: a file, or a published name such as resnet18.")
    ] = None,
    features: Annotated[
        int | None, typer.Option(min=64, help="Of the kernels: 1008 alone and 1260 beside vision, unless given.")
    ] = None,
    schedule: Annotated[str, typer.Option(help=f"The order of learning, {' or '.join(SCHEDULES)}.")] = SCHEDULES[0],
    sizes: Annotated[str, typer.Option(help="Exemplars in the buffer, all: every touch.")] = ",".join(map(str, SIZES)),
    folds: Folds = "all",
    seed: Seed = 0,
    curve: Annotated[
        int, typer.Option(min=0, help="Measure after every so many twentieths of the pass; 0: only at its end.")
    ] = 1,
    device: Device = "cpu",
    epochs: Annotated[
        int | None, typer.Option(min=1, help="Of a fine-tune; the learner's own choice unless given.")
    ] = None,
    tuned_curve: Annotated[
        bool, typer.Option("--tuned-curve", help="Measure f* there too: a fine-tune at each. Slow.")
    ] = False,
    peers: Annotated[bool, typer.Option(help="Measure other methods on the same features.")] = True,
    own_systems: OwnSystems = None,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
    plot: Plot = None,
) -> None:
    """Learn a recorded set in one pass, and measure f and f* for every size of the exemplar buffer.

    f is the closed form, which no buffer and no order changes; f* is fine-tuned from it on the exemplars alone. Beside
    them: the ridge floor, what was published, and other continual learners on the same features and folds.
    """
    frozen, own = frozen_embedding(embedding, weights, features), require_systems(own_systems)
    with progress_bar() as progress:
        progress("reading", 0, 1)
        (recordings,) = read("DATASET", dataset, data, seed, quick=quick).values()
        settings: dict[str, Any] = {"every": curve, "tuned_curve": tuned_curve, "epochs": epochs, "peers": peers}
        settings |= {"systems": own}
        task = Continual(recordings, frozen, schedule, seed, parse_sizes(sizes), device=device, folder=run, **settings)
        results = list(task.run(folds_of(folds, recordings, quick=quick), progress))
    found = rows(results)
    published = PUBLISHED.get(recordings.name, {})
    columns = {"method": "{./method}", "buffer": "{?./size}", "right, %": "{./accuracy|±}"}
    columns |= {"forgetting": "{?./forgetting|±}", "folds that kept f*": "{?./kept}"}
    quoted = [{"method": f"published: {name}", "accuracy": {"mean": m, "sd": None}} for name, m in published.items()]
    show(f"{recordings.name}, one pass", columns, [*found, *quoted])
    checks = [{"cell": cell.key} | figures for cell, figures in results if "digest" in figures]
    columns = {
        "fold, method": "{./cell}",
        "digest": "{./digest}",
        "buffer of another order": "{?./buffer_of_another_order}",
    }
    show("f and its buffers have one digest, whatever the order", columns | {"f*": "{?./reason}"}, checks)
    cells = {cell.key: figures for cell, figures in results}
    sensor = sensors_of([recordings])[recordings.name]
    write(context, task.plan | {"sensor": sensor, "means": found, "cells": cells})
    title = f"{recordings.name}, {frozen.name}, {schedule}"
    draw_into(plot, lambda file: draw_continual(file, found, title=title, lines=published))


def parse_sizes(text: str) -> tuple[Size, ...]:
    """The sizes of --sizes: numbers from 0, or "all". Raises InputError for anything else."""
    sizes: list[Size] = []
    for part in text.split(","):
        word = part.strip()
        if word != "all" and not (word.isascii() and word.isdigit()):
            raise InputError(f"expected --sizes as numbers of exemplars or all, such as 0,20,400,all; came {text!r}")
        sizes.append("all" if word == "all" else int(word))
    return tuple(dict.fromkeys(sizes))
