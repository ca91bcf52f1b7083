"""A network that is trained over epochs, as a system of the comparison."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.nn import functional

from examples.paper.systems.descent import AT_ONCE, Batches, Course, Epoch, Loss, descend, logits_of, seeded
from examples.paper.systems.inputs import Image, one_width, picture, usual_columns
from examples.paper.systems.networks import ResNetClassifier
from examples.paper.systems.system_protocol import Watch, require_touches, silent, unwatched
from scroll_tactile.clients.learning.metrics import Labelled
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.signals.augmentation import Augmentation
from scroll_tactile.signals.stream import Stream

__all__ = ["Make", "TrainedNetwork", "require_device"]

Make = Callable[[tuple[int, ...], int, int], nn.Module]
"""(shape of an input, outputs, seed) → a new network, which may draw from torch's generator."""


class TrainedNetwork:
    """A network trained as `descend` does, on images of one width; it classifies images of any.

    make: a new network for each fit. read: from an image to what the network reads, both (…, T). course: of the
    training. device: torch's name of one. augmentation: of every touch in every epoch, drawn anew; none as in the
    paper's table. view: a stream's image; `tactile_image` for a network that is to be an embedding afterwards.

    epochs: what each epoch of the last fit came to. Raises InputError for a device that is not there.

    An output is a material, trained by cross-entropy; a subclass has other targets, outputs and loss (`_targets`,
    `_outputs`, `_criterion`).
    """

    _criterion: Loss = staticmethod(functional.cross_entropy)

    def __init__(
        self,
        name: str,
        make: Make,
        read: Callable[[Image], Image] = lambda image: image,
        course: Course | None = None,
        device: str = "cpu",
        augmentation: Augmentation | None = None,
        view: Callable[[Stream], Image] = picture,
    ) -> None:
        require_device(device)
        self.name = name
        self.course = course or Course()
        self.epochs: list[Epoch] = []
        self._make, self._read, self._view = make, read, view
        self._device = device
        self._augmentation = augmentation
        self._names: list[str] = []
        self._net: nn.Module | None = None
        self._columns = 0

    def fit(
        self,
        streams: Sequence[Stream],
        materials: Sequence[str],
        validation: Sequence[Labelled],
        seed: int,
        progress: Progress = silent,
        watch: Watch = unwatched,
    ) -> None:
        """See `System.fit`. The validation lowers the rate and chooses the epoch, and is not learned.

        Raises TrainingError where the loss is not finite or the device has no memory left.
        """
        self._names = require_touches(streams, materials, validation)
        images = [self._view(stream) for stream in streams]
        columns = self._columns = usual_columns(images)
        random = np.random.default_rng([seed, 0])
        trained = self._batches(images, materials, columns, random if self._augmentation is not None else None)
        held = None
        if validation:
            held = self._batches(
                [self._view(held_stream) for _, held_stream in validation], [name for name, _ in validation], columns
            )
        with seeded(seed, self._device):
            shape = self._read(one_width(images[0], columns)).shape
            self._net = self._make(shape, self._outputs, seed).to(self._device)
            if isinstance(self._net, ResNetClassifier):
                places = np.array_split(np.arange(len(images)), -(-len(images) // AT_ONCE))
                self._net.prepare(trained.fetch(some) for some in places)
            self.epochs = descend(self._net, trained, held, self.course, random, progress, watch, self._criterion)

    @property
    def network(self) -> nn.Module:
        """The network that was trained last, on its device. Raises InputError before any was."""
        if self._net is None:
            raise InputError(f"{self.name} has learned nothing yet: call fit first")
        return self._net

    def predict(self, streams: Sequence[Stream]) -> list[str]:
        """See `System.predict`."""
        return [self._names[place] for place in self.outputs(streams).argmax(dim=1).tolist()]

    def outputs(self, streams: Sequence[Stream], of: nn.Module | None = None) -> torch.Tensor:
        """What the network, or a part `of` it, gives for N streams of any length, (N, outputs), on the processor.

        With augmentation a shorter touch goes on as its mirror image, as those did that were learned: a residual
        network that never met a narrow image is at chance on one.

        Raises InputError before `fit`.
        """
        network = self.network if of is None else of
        given: list[torch.Tensor] = [torch.empty(0)] * len(streams)
        sizes: dict[tuple[int, ...], list[int]] = {}
        images = [self._view(stream) for stream in streams]
        if self._augmentation is not None:
            images = [one_width(image, max(self._columns, image.shape[-1])) for image in images]
        for i, image in enumerate(images):
            sizes.setdefault(image.shape, []).append(i)
        for members in sizes.values():
            inputs = torch.from_numpy(np.stack([self._read(images[i]) for i in members])).to(self._device)
            for i, row in zip(members, logits_of(network, inputs).cpu(), strict=True):
                given[i] = row
        return torch.stack(given) if given else torch.empty(0, 1)

    @property
    def _outputs(self) -> int:
        return len(self._names)

    def _targets(self, materials: Sequence[str]) -> torch.Tensor:
        return torch.tensor([self._names.index(name) for name in materials], device=self._device)

    def _batches(
        self,
        images: Sequence[Image],
        materials: Sequence[str],
        columns: int,
        random: np.random.Generator | None = None,
    ) -> Batches:
        """Images of one width on the device; augmented at each look where there is a generator to draw from."""
        targets = self._targets(materials)
        if random is not None and self._augmentation is not None:
            augmentation = self._augmentation

            def drawn(places: npt.NDArray[np.intp]) -> torch.Tensor:
                changed = [augmentation.augment(images[i], random, steps=columns) for i in places]
                return torch.from_numpy(np.stack([self._read(image) for image in changed])).to(self._device)

            return Batches(drawn, targets)
        inputs = torch.from_numpy(np.stack([self._read(one_width(image, columns)) for image in images]))
        inputs = inputs.to(self._device)
        return Batches(lambda places: inputs[torch.from_numpy(places)], targets)


def require_device(device: str) -> None:
    """Raise InputError for a device that torch cannot use here."""
    try:
        torch.zeros(1, device=torch.device(device)).item()
    except (RuntimeError, AssertionError, TypeError) as error:
        raise InputError(f"expected a device that torch can use here, such as cpu; came {device!r}: {error}") from error
