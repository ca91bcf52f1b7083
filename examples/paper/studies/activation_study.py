"""The study behind the paper's last figure: a pre-trained network fine-tuned on each sensor, and what became of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from examples.paper.runs.cells import Cell, Figures
from examples.paper.runs.study import SystemStudy
from examples.paper.studies.activation import SIZE, STEPS, compare, maximise
from examples.paper.systems.networks import ResNetClassifier
from examples.paper.systems.trained import TrainedNetwork
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.embeddings.weights import load_network
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.training import Progress
from scroll_tactile.signals.image import tactile_image

__all__ = ["CONTROL", "START", "ActivationStudy"]

START, CONTROL = "pre-trained", "random weights"
SYSTEM = "resnet-pretrained"
COMPARED = 10  # touches of each set on which first blocks are compared


@dataclass(frozen=True)
class ActivationStudy(SystemStudy):
    """Fine-tune on each set, all folds but those asked for; then `looks` and `likeness` of what came of it.

    tuned: set → the first layers of the network that was fine-tuned on it; they are kept beside the run's notes, too,
    so that a killed run resumes.

    Raises InputError where no weights are given: there would be nothing to be fine-tuned.
    """

    name = "activation"
    tuned: dict[str, dict[str, npt.NDArray[Any]]] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.systems != (SYSTEM,):
            raise InputError(f"expected the one system {SYSTEM}; came {', '.join(self.systems)}")
        if any(recordings.sensor.camera for recordings in self.sets):
            raise InputError("expected sets of streams: a camera's frames are not compared with tactile images")
        super().__post_init__()

    def _file(self, dataset: str) -> Path | None:
        return None if self.folder is None else self.folder / f"activation {dataset}.npz"

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        part = self._split(cell)
        system = self._system(cell)
        assert isinstance(system, TrainedNetwork)
        system.fit(part.streams, part.materials, part.validation, self.seed, progress)
        network = system.network
        assert isinstance(network, ResNetClassifier)
        self._keep(cell.dataset, {name: tensor.cpu().numpy() for name, tensor in network.net.state_dict().items()})
        predicted = system.predict(part.test_streams)
        right = sum(true == guess for true, guess in zip(part.truth, predicted, strict=True))
        return {"right": right, "tested": len(predicted)}

    def _keep(self, dataset: str, tensors: Mapping[str, npt.NDArray[Any]]) -> None:
        first: dict[str, Any] = {
            name: tensor for name, tensor in tensors.items() if name.startswith(("conv1.", "bn1.", "layer1."))
        }
        self.tuned[dataset] = first
        if (file := self._file(dataset)) is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            draft = file.with_name("draft.npz")
            np.savez(draft, **first)
            draft.replace(file)

    def networks(self) -> dict[str, ResNet]:
        """The pre-trained network, those fine-tuned on each set, and the control, by name; after `run` has ended.

        Of the fine-tuned ones only what leads to the first block differs from the pre-trained.

        Raises InputError where the first layers of a set that was finished before are no longer there.
        """
        assert self.weights is not None
        found = {START: load_network(self.weights)}
        for recordings in self.sets:
            net = load_network(self.weights)
            net.load_state_dict(self._first_layers(recordings.name), strict=False)
            found[f"fine-tuned on {recordings.name}"] = net
        return found | {CONTROL: ResNet.random(self.seed, found[START].depth, found[START].stem)}

    def _first_layers(self, dataset: str) -> dict[str, torch.Tensor]:
        if dataset not in self.tuned:
            file = self._file(dataset)
            try:
                assert file is not None
                with np.load(file, allow_pickle=False) as kept:
                    self.tuned[dataset] = {name: kept[name] for name in kept.files}
            except (OSError, ValueError) as error:
                raise InputError(
                    f"the notes of the run say that {dataset} is finished, and its first layers cannot be read from "
                    f"{file} ({error}): take another folder"
                ) from error
        return {name: torch.from_numpy(np.array(tensor)) for name, tensor in self.tuned[dataset].items()}

    def looks(self, networks: Mapping[str, ResNet], progress: Progress) -> dict[str, npt.NDArray[np.floating]]:
        """For each network the images of `maximise`, from the same noise."""
        steps, size = (STEPS // 3, SIZE // 2) if self.quick else (STEPS, SIZE)
        return {
            name: maximise(
                net, seed=self.seed, steps=steps, size=size, report=partial(progress, f"what excites: {name}")
            )
            for name, net in networks.items()
        }

    def likeness(self, networks: Mapping[str, ResNet]) -> list[dict[str, Any]]:
        """`compare` of every two networks, on the same number of touches of each set."""
        random = np.random.default_rng(self.seed)
        images = [
            tactile_image(recordings.streams[i])
            for recordings in self.sets
            for i in random.choice(len(recordings), min(COMPARED, len(recordings)), replace=False)
        ]
        return [asdict(pair) for pair in compare(networks, images, start=START)]
