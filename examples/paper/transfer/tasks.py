"""Transfer between tasks: an embedding fine-tuned on one data set, frozen, and read out in closed form on another.

Beside it stand the vision model as it was before any fine-tuning, and kernels, with the same draws of touches.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from examples.paper.readers.labelled import Recordings
from examples.paper.runs.cached import Cached
from examples.paper.runs.cells import Cell, Figures, over_folds, require_data, run_cells, split
from examples.paper.runs.study import weights_digest
from examples.paper.systems.descent import Course, Precision
from examples.paper.systems.networks import ResNetClassifier
from examples.paper.systems.trained import TrainedNetwork, require_device
from examples.paper.transfer.few_touches import COUNTS, candidate_maker, few_touches
from scroll_tactile import Embedding, Kernels, Vision
from scroll_tactile.embeddings.weights import load_network, read_tensors
from scroll_tactile.errors import InputError, WeightsError
from scroll_tactile.finetune.training import Progress
from scroll_tactile.pipelines.runfile import RunFile
from scroll_tactile.signals.image import tactile_image

__all__ = ["TRAINING", "TUNED", "TaskTransfer", "rows", "some_frames"]

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
    epochs, rate: of a fine-tuning; device: where it runs; precision: see `Course`. every: learn every
    so many recordings only when fine-tuning. seed: of all that is drawn.
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
    precision: Precision = "float32"
    every: int = 1
    seed: int = 0
    folder: Path | None = None
    sources: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        names = [item.name for item in self.sets]
        if len(set(names)) < max(2, len(names)):
            raise InputError(f"expected two data sets or more, of different names; came {names}")
        if strange := sorted(set(self.sources or ()) - set(names)):
            raise InputError(f"expected sources out of {names}; came {strange}")
        if not self.folds or not self.counts or min(self.counts) < 1 or self.draws < 1 or self.every < 1:
            raise InputError(
                "expected one fold or more, counts of 1 touch or more, 1 draw or more and every 1 or more; came "
                f"folds {self.folds}, counts {self.counts}, draws {self.draws}, every {self.every}"
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
        names = ("counts", "draws", "epochs", "rate", "device", "precision", "every", "seed")
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

    def run(self, progress: Progress = lambda what, done, of: None) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each cell as it is finished; those finished before are read back.

        Raises InputError for a folder of another run or folds that are not there, WeightsError for a fine-tuned network
        that is damaged, and what learning and training raise.
        """
        notes = RunFile(None if self.folder is None else self.folder / "transfer-tasks.json", self.plan)
        for source, fold in ((item.name, fold) for item in self.sets for fold in self.folds):
            if (figures := notes.notes.get(Cell(source, fold, TRAINING).key)) is not None:
                self._noted[source, fold] = figures["digest"]
        for item in self.sets:
            require_data(notes, item)
            for fold in self.folds:
                split(item, fold, self.seed, every=self.every)  # what is refused is refused before anything is measured
        yield from run_cells(notes, self.cells(), self._measure, progress)

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
        touches = split(recordings, fold, self.seed, every=self.every)
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
    chosen = []
    for i, (name, fold) in enumerate(zip(recordings.materials, recordings.fold.tolist(), strict=True)):
        video = (name, fold, int(recordings.repetition[i]))
        seen[video] = seen.get(video, 0) + 1
        if seen[video] <= frames:
            chosen.append(i)
    return replace(
        recordings,
        streams=[recordings.streams[i] for i in chosen],
        materials=[recordings.materials[i] for i in chosen],
        repetition=recordings.repetition[chosen],
        fold=recordings.fold[chosen],
    )


def rows(results: Sequence[tuple[Cell, Figures]]) -> list[dict[str, Any]]:
    """A row for each data set that is tested and each embedding.

    points: count of touches → mean accuracy over draws and folds, its standard deviation, and the mean and standard
    deviation of the difference to the vision model of the same draws (None where that was not measured).
    """
    shares: dict[tuple[str, str], dict[str, list[float]]] = {}
    for cell, figures in results:
        if cell.system == TRAINING:
            continue
        of_row = shares.setdefault((cell.dataset, cell.system), {})
        for count, right in figures["right"].items():
            of_row.setdefault(count, []).extend(hits / figures["tested"] for hits in right)
    found = []
    for (dataset, system), own in shares.items():
        points = {}
        for count, values in own.items():
            point = over_folds(values) | {"gain": None, "gain sd": None}
            plain = shares.get((dataset, "vision"), {}).get(count, [])
            if len(plain) == len(values):
                gain = over_folds(np.subtract(values, plain).tolist())
                point |= {"gain": gain["mean"], "gain sd": gain["sd"]}
            points[count] = point
        tuned = system.removeprefix(TUNED) if system.startswith(TUNED) else None
        found.append({"dataset": dataset, "system": system, "tuned on": tuned, "points": points})
    return found


def _digest(tensors: Tensors) -> str:
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()
