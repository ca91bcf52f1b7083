"""A network fine-tuned on one sensor's materials, to begin with on another's: trained once for a run, and kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch
from torch import nn

from examples.paper.readers.labelled import Recordings
from examples.paper.runs.cells import split
from examples.paper.systems.descent import Course
from examples.paper.systems.inputs import average_columns
from examples.paper.systems.networks import ResNetClassifier
from examples.paper.systems.trained import TrainedNetwork
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.embeddings.weights import load_network
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.training import Progress
from scroll_tactile.pipelines.metrics import accuracy

__all__ = ["Pretraining"]


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
