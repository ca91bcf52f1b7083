"""Controls beside ours: plain rules on the features that ours reads, and features that nobody designed or trained."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from examples.paper.studies.peers import ContinualPeer, touch_features
from examples.paper.systems.system_protocol import Watch, require_touches, silent, unwatched
from scroll_tactile import Embedding
from scroll_tactile.embeddings.modules import ModuleEmbedding
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.training import Progress
from scroll_tactile.pipelines.classification import Labelled
from scroll_tactile.signals.stream import Stream

__all__ = ["NearestNeighbour", "OnFeatures", "random_conv1d"]

FloatArray = npt.NDArray[np.float64]


class OnFeatures:
    """A rule that learns feature vectors one by one, on an embedding's: one vector a touch, see `touch_features`."""

    def __init__(self, name: str, embedding: Embedding, rule: Callable[[], ContinualPeer]) -> None:
        self.name = name
        self._embedding = embedding
        self._rule = rule
        self._learned: ContinualPeer | None = None

    def fit(
        self,
        streams: Sequence[Stream],
        materials: Sequence[str],
        validation: Sequence[Labelled],
        seed: int,
        progress: Progress = silent,
        watch: Watch = unwatched,
    ) -> None:
        """See `System.fit`; the validation is learned like the rest, and nothing is drawn."""
        require_touches(streams, materials, validation)
        self._learned = self._rule()
        train = [*zip(materials, streams, strict=True), *validation]
        for done, (material, stream) in enumerate(train, start=1):
            self._learned.observe(touch_features(self._embedding, [stream])[0], material)
            progress("learning", done, len(train))

    def predict(self, streams: Sequence[Stream]) -> list[str]:
        """See `System.predict`."""
        if self._learned is None:
            raise InputError(f"{self.name} has learned nothing yet: call fit first")
        return self._learned.predict(touch_features(self._embedding, streams)) if streams else []


class NearestNeighbour(ContinualPeer):
    """The material of the nearest touch of all that were met, by the angle between features."""

    def __init__(self) -> None:
        super().__init__()
        self._met: list[FloatArray] = []
        self._places: list[int] = []

    def observe(self, features: FloatArray, material: str) -> None:
        """Keep the touch."""
        self._met.append(_unit(features))
        self._places.append(self._place(material))

    def scores(self, features: FloatArray) -> FloatArray:
        """The cosine of the angle to the nearest touch of each material."""
        likeness = _unit(features) @ np.stack(self._met).T
        places = np.array(self._places)
        return np.stack([likeness[:, places == i].max(axis=1) for i in range(len(self.materials))], axis=1)


def _unit(features: FloatArray) -> FloatArray:
    length = np.linalg.norm(features, axis=-1, keepdims=True)
    unit: FloatArray = features / np.where(length > 0, length, 1.0)
    return unit


CHANNELS = 64  # at most, of a sensor
FILTERS = 256
WIDTH = 9


class _RandomConv1d(nn.Module):
    """Two layers of normally distributed filters along time; their means and maxima over it, through tanh."""

    first: torch.Tensor
    second: torch.Tensor

    def __init__(self, seed: int) -> None:
        super().__init__()
        random = torch.Generator().manual_seed(seed)
        self.register_buffer("first", torch.randn(FILTERS, CHANNELS, WIDTH, generator=random))
        self.register_buffer("second", torch.randn(FILTERS, FILTERS, WIDTH, generator=random))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        channels = image.shape[1]
        # √(2 / inputs): He's scale, at which responses neither die nor grow.
        found = nn.functional.conv1d(image, self.first[:, :channels], padding=WIDTH // 2, stride=2)
        found = torch.relu(found * (2 / (channels * WIDTH)) ** 0.5)
        found = nn.functional.conv1d(found, self.second, padding=WIDTH // 2, stride=2)
        found = torch.relu(found * (2 / (FILTERS * WIDTH)) ** 0.5)
        return torch.tanh(torch.cat([found.mean(dim=-1), found.amax(dim=-1)], dim=1))


def random_conv1d(seed: int = 0) -> ModuleEmbedding:
    """An untrained network as an embedding of 512 features, for sensors of at most 64 channels."""
    return ModuleEmbedding(_RandomConv1d(seed), name="random Conv1d", dimension=2 * FILTERS)
