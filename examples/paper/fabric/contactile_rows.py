"""The rows of the paper's Table III, and ours: what each is, and how it is made."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch
from torch import nn

from examples.paper.fabric.ratios import ratios
from examples.paper.readers.labelled import Recordings
from examples.paper.runs.cached import Cached
from examples.paper.runs.cells import split
from examples.paper.systems.constituents import (
    ConstituentMemory,
    ConstituentNet,
    ConstituentSquares,
    ConstituentSystem,
    Shares,
)
from examples.paper.systems.descent import Course
from examples.paper.systems.inputs import Image, average_columns
from examples.paper.systems.least_squares import LeastSquares
from examples.paper.systems.networks import ResNetClassifier
from examples.paper.systems.trained import TrainedNetwork
from scroll_tactile import Embedding, Joined, Kernels, Vision
from scroll_tactile.clients.learning.metrics import accuracy
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.embeddings.weights import load_network
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.signals.augmentation import Augmentation
from scroll_tactile.signals.stream import Stream

__all__ = [
    "EPOCHAL",
    "NEED_BIOTAC",
    "NEED_WEIGHTS",
    "OURS",
    "PAPER",
    "PAPER_EPOCHS",
    "ROWS",
    "Pretraining",
    "RowMaker",
]

ROWS = {
    "least-squares": "least squares, vision model",
    "least-squares-biotac": "least squares, vision model fine-tuned on BioTac",
    "resnet": "ResNet, a head for each constituent",
    "resnet-augmented": "… and augmentation",
    "resnet-biotac": "… and BioTac pre-training",
    "kernels": "ours, kernels",
    "kernels+vision": "ours, kernels+vision",
    "ratios": "ours, kernels, on ratios of forces",
}
"""Key, as on the command line → name, as in tables."""

PAPER = {
    "least-squares": 0.742,
    "least-squares-biotac": 0.761,
    "resnet": 0.763,
    "resnet-augmented": 0.789,
    "resnet-biotac": 0.806,
}
"""The paper's scores from protocol 1 to 2, on real fabrics, which are not public."""
PAPER_EPOCHS = 50

OURS = ("kernels", "kernels+vision", "ratios")
NEED_WEIGHTS = ("least-squares", "least-squares-biotac", "resnet-biotac", "kernels+vision")
NEED_BIOTAC = ("least-squares-biotac", "resnet-biotac")
EPOCHAL = ("least-squares-biotac", "resnet", "resnet-augmented", "resnet-biotac")


@dataclass(frozen=True)
class Pretraining:
    """A trained ResNet, fine-tuned to classify the materials of some recordings, four folds of them.

    recordings: of materials. weights: what it begins with. course: of the training. device: where. every: columns that
    images are averaged over. seed: of all that is drawn. file: where the network is kept, an .npz of its tensors, so
    that a resumed run does not train it again; or None.
    """

    recordings: Recordings
    weights: str
    course: Course
    device: str
    every: int
    seed: int
    file: Path | None = None

    def network(self, progress: Progress) -> tuple[ResNet, float]:
        """The network, and the accuracy that it has on the first fold, which it did not learn.

        Raises InputError for a file that cannot be read or written, WeightsError and what training raises.
        """
        if self.file is not None and self.file.exists():
            return self._kept(self.file)
        part = split(self.recordings, 0, self.seed)

        def make(shape: tuple[int, ...], outputs: int, seed: int) -> nn.Module:
            return ResNetClassifier(load_network(self.weights), outputs, trained=True)

        name = f"fine-tuned on {self.recordings.name}"
        system = TrainedNetwork(name, make, lambda image: average_columns(image, self.every), self.course, self.device)
        label = f"{name}: "
        system.fit(
            part.streams,
            part.materials,
            part.validation,
            self.seed,
            lambda what, done, of: progress(label + what, done, of),
        )
        right = accuracy(part.truth, [*system.predict(part.test_streams)])
        network = system.network
        assert isinstance(network, ResNetClassifier)
        net = network.net.cpu().eval()
        if self.file is not None:
            self._keep(self.file, net, right)
        return net, right

    def _kept(self, file: Path) -> tuple[ResNet, float]:
        try:
            with np.load(file, allow_pickle=False) as kept:
                tensors = {name: torch.from_numpy(np.array(kept[name])) for name in kept.files if name != "accuracy"}
                right = float(kept["accuracy"])
            net = load_network(self.weights)
            net.load_state_dict(tensors)
        except (OSError, ValueError, KeyError, RuntimeError, EOFError, BadZipFile) as error:
            raise InputError(
                f"expected in {file} the network of this run, fine-tuned on {self.recordings.name}; it cannot be read "
                f"({error}). Remove the file, and it is trained again"
            ) from error
        return net, right

    def _keep(self, file: Path, net: ResNet, right: float) -> None:
        draft = file.with_name("draft.npz")
        tensors = {name: tensor.numpy() for name, tensor in net.state_dict().items()}
        try:
            np.savez(draft, allow_pickle=False, accuracy=np.array(right), **tensors)
            draft.replace(file)
        except OSError as error:
            raise InputError(
                f"{file} cannot be written: {error.strerror}. Make room, or take another folder"
            ) from error


@dataclass
class RowMaker:
    """What the rows are made with; embeddings are made once, and remember the touches that they have read.

    shares: what fabrics are made of. weights: of a trained ResNet, for those in NEED_WEIGHTS. tuning: the training on
    BioTac, for those in NEED_BIOTAC. course: of the networks' training. device: of all networks but ours. every:
    columns that the images of the paper's rows are averaged over.
    """

    shares: Shares
    weights: str | None
    tuning: Pretraining | None
    course: Course
    device: str
    every: int
    _kept: tuple[ResNet, float] | None = field(default=None, init=False, repr=False)
    _squares_of_tuned: LeastSquares | None = field(default=None, init=False, repr=False)

    def make(self, key: str, progress: Progress) -> ConstituentSystem:
        """A new system of ROWS that has learned nothing; progress: receives the training on BioTac, which comes first.

        Raises KeyError for another key, and what that training raises.
        """
        name = ROWS[key]
        if key in OURS:
            read = ratios if key.startswith("ratios") else _as_it_is
            return ConstituentMemory(name, self.shares, self._embedding(key), read)
        if key == "least-squares":
            return ConstituentSquares(name, self.shares, self._squares)
        if key == "least-squares-biotac":
            return ConstituentSquares(name, self.shares, self._tuned_squares(progress))
        start = self._tuned(progress).state_dict() if key == "resnet-biotac" else None

        def make(shape: tuple[int, ...], outputs: int, seed: int) -> ResNetClassifier:
            net = ResNet.random(seed) if start is None else load_network(start)
            return ResNetClassifier(net, outputs, trained=start is not None)

        changes = None if key == "resnet" else Augmentation()
        return ConstituentNet(name, self.shares, make, self._thinned, self.course, self.device, changes)

    def _thinned(self, image: Image) -> Image:
        return average_columns(image, self.every)

    @cached_property
    def _squares(self) -> LeastSquares:
        assert self.weights is not None
        return LeastSquares(ROWS["least-squares"], Vision(self.weights, stages=(4,)), self.device, self._thinned)

    @property
    def accuracy(self) -> float:
        """Of the network fine-tuned on BioTac, on the fold that it did not learn; NaN before it was needed."""
        return self._kept[1] if self._kept is not None else float("nan")

    def _tuned(self, progress: Progress) -> ResNet:
        if self._kept is None:
            assert self.tuning is not None
            self._kept = self.tuning.network(progress)
        return self._kept[0]

    def _tuned_squares(self, progress: Progress) -> LeastSquares:
        if self._squares_of_tuned is None:
            vision = Vision(self._tuned(progress).state_dict(), stages=(4,))
            name = ROWS["least-squares-biotac"]
            self._squares_of_tuned = LeastSquares(name, vision, self.device, self._thinned)
        return self._squares_of_tuned

    def _embedding(self, key: str) -> Embedding:
        return self._kernels if key != "kernels+vision" else self._both

    @cached_property
    def _kernels(self) -> Embedding:
        return Cached(Kernels())

    @cached_property
    def _both(self) -> Embedding:
        assert self.weights is not None
        return Joined(Cached(Kernels(dimension=1260)), Cached(Vision(self.weights)))


def _as_it_is(stream: Stream) -> Stream:
    return stream
