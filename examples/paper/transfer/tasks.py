"""`transfer tasks`: an embedding fine-tuned on one data set, frozen, and read out in closed form on another.

Beside it stand the vision model as it was before any fine-tuning, and kernels, with the same draws of touches.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer

from examples.paper.readers.labelled import Recordings, chosen
from examples.paper.runs.cached import Cached
from examples.paper.runs.cells import Cell, Figures, run_cells, silent, split
from examples.paper.runs.options import (
    Data,
    Device,
    Folds,
    InPrecision,
    Json,
    Plot,
    Quick,
    Run,
    Seed,
    folds_of,
    named,
    numbers,
    read,
)
from examples.paper.runs.pictures import draw_into, logarithmic, picture
from examples.paper.runs.results import show, write
from examples.paper.runs.study import sensors_of, weights_digest
from examples.paper.systems.descent import Course
from examples.paper.systems.networks import ResNetClassifier
from examples.paper.systems.trained import TrainedNetwork, require_device
from examples.paper.transfer.few_touches import COUNTS, candidate_maker, few_touches, points_of
from scroll_tactile import Embedding, Kernels, Vision
from scroll_tactile.clients.cli.terminal import percent, progress_bar, say
from scroll_tactile.embeddings.weights import load_network, read_tensors
from scroll_tactile.errors import InputError, WeightsError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.signals.image import tactile_image

__all__ = ["TRAINING", "TUNED", "TaskTransfer", "rows", "some_frames", "tasks"]

OF_TASKS = ("biotac-20", "roboskin-20", "letter-spike", "fabric-slide", "gelsight")
TRAINING = "fine-tuning"
TUNED = "vision tuned on "
"""Before the name of the data set that the embedding of a row was fine-tuned on."""

RATE = 0.001
"""Of a fine-tuning, for a few epochs. Six of RoboSkin at 0.001, 0.003 and 0.01 bring the validation's cross-entropy to
0.39, 1.22 and 1.93 nats; the paper's 0.01 is for a hundred."""

Tensors = Mapping[str, torch.Tensor]


@dataclass(frozen=True)
class TaskTransfer:
    """Which embeddings are fine-tuned on what, and how they are tried.

    sets: of different names, two or more, all tested. sources: the names of those fine-tuned on; all unless given.
    weights: of the pre-trained ResNet.
    folds: tested, of each set. counts: touches of each material learned before a test; draws: of those touches.
    epochs, rate: of a fine-tuning; device: where it runs; precision: see `Course`. seed: of all that is drawn.
    folder: where finished cells are noted and fine-tuned networks kept, so that a killed run resumes; or None.

    Raises InputError for what cannot be, WeightsError for weights that cannot be had.
    """

    sets: Sequence[Recordings]
    weights: str
    folds: tuple[int, ...] = (0,)
    counts: tuple[int, ...] = COUNTS
    draws: int = 5
    epochs: int = 10
    rate: float = RATE
    device: str = "cpu"
    precision: str = "float32"
    seed: int = 0
    folder: Path | None = None
    sources: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        names = [item.name for item in self.sets]
        if len(set(names)) < max(2, len(names)):
            raise InputError(f"expected two data sets or more, of different names; came {names}")
        if strange := sorted(set(self.sources or ()) - set(names)):
            raise InputError(f"expected sources out of {names}; came {strange}")
        if not self.folds or not self.counts or min(self.counts) < 1 or self.draws < 1:
            raise InputError(
                "expected one fold or more, counts of 1 touch or more and 1 draw or more; came "
                f"folds {self.folds}, counts {self.counts}, draws {self.draws}"
            )
        if self.seed < 0:
            raise InputError(f"expected a seed of 0 or more; came {self.seed}")
        _ = self.course  # is refused where it cannot be
        require_device(self.device)

    @property
    def course(self) -> Course:
        """Of a fine-tuning."""
        return Course(epochs=self.epochs, rate=self.rate, precision=self.precision)

    @property
    def plan(self) -> dict[str, Any]:
        """All that each figure depends on, beside the data; sets, sources and folds can be added to a run later."""
        names = ("counts", "draws", "epochs", "rate", "device", "precision", "seed")
        options = {name: getattr(self, name) for name in names}
        return {"run": "transfer tasks", **options, "weights": weights_digest(self.weights)}

    def cells(self) -> list[Cell]:
        """Fold by fold: the rows of nothing fine-tuned, then for each set the fine-tuning, and its row on every set."""
        found = []
        names = [item.name for item in self.sets]
        for fold in self.folds:
            found += [Cell(name, fold, system) for system in ("kernels", "vision") for name in names]
            for source in names if self.sources is None else self.sources:
                found.append(Cell(source, fold, TRAINING))
                found += [Cell(name, fold, TUNED + source) for name in names]
        return found

    def run(self, progress: Progress = silent) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each cell as it is finished; those finished before are read back.

        Raises InputError for a folder of another run or folds that are not there, WeightsError for a fine-tuned network
        that is damaged, and what learning and training raise.
        """
        for item in self.sets:
            for fold in self.folds:
                split(item, fold, self.seed)  # what is refused is refused before anything is measured
        for cell, figures in run_cells(self.folder, self.plan, self.sets, self.cells(), self._measure, progress):
            if cell.system == TRAINING:
                self._noted[cell.dataset, cell.fold] = figures["digest"]
            yield cell, figures

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        recordings = self._by_name[cell.dataset]
        if cell.system == TRAINING:
            return self._train(recordings, cell.fold, progress)
        make = candidate_maker(recordings.sensor, self._embedding(cell, progress))
        return few_touches(recordings, cell.fold, make, self.counts, self.draws, self.seed, progress)

    def _embedding(self, cell: Cell, progress: Progress) -> Embedding:
        if cell.system == "kernels":
            return Cached(Kernels())
        if cell.system == "vision":
            return Vision(self.weights)
        return Vision(self._tuned(cell.system.removeprefix(TUNED), cell.fold, progress))

    def _train(self, recordings: Recordings, fold: int, progress: Progress) -> Figures:
        """Fine-tune the whole network on all but a fold, a tenth of which chooses the epoch; how right it is then."""
        touches = split(recordings, fold, self.seed)
        trained = TrainedNetwork(TRAINING, self._network, course=self.course, device=self.device, view=tactile_image)
        trained.fit(touches.streams, touches.materials, touches.validation, self.seed, progress)
        predicted = trained.predict(touches.test_streams)
        assert isinstance(trained.network, ResNetClassifier)
        state = trained.network.net.state_dict()
        tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in state.items()}
        self._keep(recordings.name, fold, tensors)
        return {
            "learned": len(touches.streams),
            "validation": len(touches.validation),
            "tested": len(predicted),
            "right": sum(true == guess for true, guess in zip(touches.truth, predicted, strict=True)),
            "losses": [[item.loss, item.validation_loss] for item in trained.epochs],
            "digest": _digest(tensors),
        }

    def _network(self, shape: tuple[int, ...], count: int, seed: int) -> ResNetClassifier:
        return ResNetClassifier(load_network(self.weights), count, trained=True)

    def _tuned(self, source: str, fold: int, progress: Progress) -> Tensors:
        """A fine-tuned network's tensors: those in hand, those kept, or, where the file is gone, fine-tuned again."""
        if (source, fold) not in self._networks:
            path = self._path(source, fold)
            if path is not None and path.is_file():
                self._networks.clear()
                self._networks[source, fold] = read_tensors(path)
            else:
                self._train(self._by_name[source], fold, progress)
            self._require_noted(source, fold)
        return self._networks[source, fold]

    def _require_noted(self, source: str, fold: int) -> None:
        """Compare the network in hand with what was noted of it when it was trained."""
        noted = self._noted.get((source, fold))
        if noted is not None and noted != _digest(self._networks[source, fold]):
            raise WeightsError(
                f"{self._path(source, fold)} is not the network that was fine-tuned on {source} in this run: it is "
                "damaged, or was trained again elsewhere. Take another folder"
            )

    def _keep(self, source: str, fold: int, tensors: Tensors) -> None:
        self._networks.clear()  # one at a time: the cells of a source follow one another
        self._networks[source, fold] = tensors
        path = self._path(source, fold)
        if path is None:
            return
        from safetensors import SafetensorError
        from safetensors.torch import save_file

        draft = path.with_name(path.name + ".new")
        try:
            save_file(dict(tensors), draft)
            draft.replace(path)
        except (OSError, SafetensorError) as error:  # the latter is no OSError, also where the disk is what failed
            raise InputError(f"{path} cannot be written: {error}. Make room or take another folder") from error

    def _path(self, source: str, fold: int) -> Path | None:
        slug = "-".join(source.lower().split())
        return None if self.folder is None else self.folder / f"tuned-on-{slug}-fold-{fold}.safetensors"

    @cached_property
    def _by_name(self) -> dict[str, Recordings]:
        return {item.name: item for item in self.sets}

    @cached_property
    def _noted(self) -> dict[tuple[str, int], str]:
        """(set, fold) → digest of the network that an earlier start of this run fine-tuned."""
        return {}

    @cached_property
    def _networks(self) -> dict[tuple[str, int], Tensors]:
        return {}


def some_frames(recordings: Recordings, frames: int) -> Recordings:
    """The first few frames of each video of a camera's recordings; those of other sensors as they are.

    Raises InputError for no frames.
    """
    if frames < 1:
        raise InputError(f"expected 1 frame of a video or more; came {frames}")
    if not recordings.sensor.camera:
        return recordings
    seen: dict[tuple[str, int, int], int] = {}
    kept = []
    for i, (name, fold) in enumerate(zip(recordings.materials, recordings.fold.tolist(), strict=True)):
        video = (name, fold, int(recordings.repetition[i]))
        seen[video] = seen.get(video, 0) + 1
        if seen[video] <= frames:
            kept.append(i)
    return chosen(recordings, kept)


def rows(results: Sequence[tuple[Cell, Figures]]) -> list[dict[str, Any]]:
    """A row for each data set that is tested and each embedding, with `points_of` it; gains are over vision."""
    tested = [(cell, figures) for cell, figures in results if cell.system != TRAINING]
    found = []
    for (dataset, system), points in points_of(tested, "vision").items():
        tuned = system.removeprefix(TUNED) if system.startswith(TUNED) else None
        found.append({"dataset": dataset, "system": system, "tuned on": tuned, "points": points})
    return found


def _digest(tensors: Tensors) -> str:
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


def tasks(
    context: typer.Context,
    data: Data,
    weights: Annotated[str, typer.Option(help="Of a trained ResNet: a file, or a published name such as resnet18.")],
    sets: Annotated[str, typer.Option(help=f"Two or more of {', '.join(OF_TASKS)}.")] = ",".join(OF_TASKS),
    sources: Annotated[str | None, typer.Option(help="Which of them to fine-tune on; all unless given.")] = None,
    folds: Folds = "0",
    counts: Annotated[str, typer.Option(help="Touches of each material learned before a test.")] = "1,2,5,10,20",
    draws: Annotated[int, typer.Option(min=1, help="Of the touches that are learned.")] = 3,
    frames: Annotated[int, typer.Option(min=1, help="Of each video of a camera.")] = 2,
    epochs: Annotated[int, typer.Option(min=1, help="Of the networks' training.")] = 6,
    device: Device = "cpu",
    precision: InPrecision = "float32",
    seed: Seed = 0,
    quick: Quick = False,
    run: Run = None,
    json: Json = None,
    plot: Plot = None,
) -> None:
    """Fine-tune the vision model on each data set, freeze it, and learn few touches of every other with it."""
    with progress_bar() as progress:
        progress("reading", 0, 1)
        found = read("--sets", sets, data, seed, known=OF_TASKS, quick=quick)
        by_name = {name: some_frames(item, frames) for name, item in found.items()}
        chosen_sources = None if sources is None else named("--sources", sources, by_name)
        study = TaskTransfer(
            [*by_name.values()],
            weights,
            folds=tuple(folds_of(folds, next(iter(by_name.values())), quick=quick)),
            counts=tuple(sorted(set(numbers("--counts", counts)))),
            draws=1 if quick else draws,
            epochs=min(epochs, 3) if quick else epochs,
            device=device,
            precision=precision,
            seed=seed,
            folder=run,
            sources=None if chosen_sources is None else tuple(by_name[name].name for name in chosen_sources),
        )
        results = list(study.run(progress))
    table = rows(results)
    for name in (item.name for item in study.sets):
        mine = [row for row in table if row["dataset"] == name]
        columns = {"embedding": "{./system}"} | {
            f"{count} touches": f"{{./points/{count}|±}}" for count in mine[0]["points"]
        }
        show(f"{name}: right, % after so many touches of each material", columns, mine)
    trained = [(cell, figures) for cell, figures in results if cell.system == TRAINING]
    text = ", ".join(f"{cell.dataset} {percent(figures['right'] / figures['tested'])}" for cell, figures in trained)
    say(f"the fine-tuned networks on their own test, after {study.epochs} epochs: {text}")
    cells = {cell.key: figures for cell, figures in results}
    write(context, study.plan | {"sensors": sensors_of(study.sets), "frames": frames, "rows": table, "cells": cells})
    draw_into(plot, lambda file: draw_transfer(file, table))


def draw_transfer(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw accuracy by touches of each material, a line for each embedding, a panel for each data set tested.

    rows: dataset, system, and points: touches of each material → mean and sd, shares from 0 to 1. Raises InputError
    where there are none.
    """
    if not rows:
        raise InputError("expected rows to draw; came none")
    sets = list(dict.fromkeys(row["dataset"] for row in rows))
    with picture(path, 5 * len(sets), 4.5) as figure:
        panels = np.asarray(figure.subplots(1, len(sets), squeeze=False))[0]
        for dataset, panel in zip(sets, panels, strict=True):
            mine = [row for row in rows if row["dataset"] == dataset]
            for row in mine:
                means = [100 * point["mean"] for point in row["points"].values()]
                spreads = [100 * (point["sd"] or 0) for point in row["points"].values()]
                counts = [int(count) for count in row["points"]]
                panel.errorbar(counts, means, spreads, marker=".", capsize=2, label=row["system"])
            panel.set(xlabel="touches of each material", ylabel="accuracy on the test, %", title=dataset)
            logarithmic(panel, {int(count) for row in mine for count in row["points"]})
            panel.grid(alpha=0.3)
            panel.legend(fontsize=7)
