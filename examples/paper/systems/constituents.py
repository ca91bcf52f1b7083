"""Networks with one head for each constituent: the paper's way to compose a touch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.nn import functional

from examples.paper.systems.constituent_squares import Estimates, Heads, Shares
from examples.paper.systems.descent import Loss
from examples.paper.systems.networks import ResNetClassifier
from examples.paper.systems.system_protocol import Watch, silent, unwatched
from examples.paper.systems.trained import TrainedNetwork
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.training import Progress
from scroll_tactile.pipelines.classification import Labelled
from scroll_tactile.signals.stream import Stream

__all__ = ["ConstituentNet", "presence_loss"]

FloatArray = npt.NDArray[np.float64]


def presence_loss(logits: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Mean binary cross-entropy in nats over the targets, (B, K), that are known: those that are not NaN."""
    known = torch.isfinite(targets)
    wanted = torch.where(known, targets, torch.zeros_like(targets)).to(logits.dtype)
    each = functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
    return (each * known).sum() / known.sum().clamp(min=1)


class ConstituentNet(TrainedNetwork):
    """A residual network with one head for each constituent, which predicts its presence: a logistic unit.

    Trained as `TrainedNetwork` is. Shares, which the paper's heads do not report, are by ridge regression on the
    features below them, of the touches that the network learned.
    """

    _criterion: Loss = staticmethod(presence_loss)

    def __init__(self, name: str, shares: Shares, *settings: Any, **named: Any) -> None:
        super().__init__(name, *settings, **named)
        self._shares = shares
        self._heads: Heads | None = None

    def fit(
        self,
        streams: Sequence[Stream],
        materials: Sequence[str],
        validation: Sequence[Labelled],
        seed: int,
        progress: Progress = silent,
        watch: Watch = unwatched,
    ) -> None:
        """See `TrainedNetwork.fit`."""
        self._heads = None
        super().fit(streams, materials, validation, seed, progress, watch)
        features, held = self._features(streams), self._features([stream for _, stream in validation])
        self._heads = Heads(features, held, self._shares, materials, [name for name, _ in validation])

    def estimate(self, streams: Sequence[Stream], progress: Progress = silent) -> Estimates:
        """See `ConstituentSystem.estimate`."""
        if self._heads is None:
            raise InputError(f"{self.name} has learned nothing yet: call fit first")
        presence = torch.sigmoid(self.outputs(streams).double()).numpy()
        return Estimates(presence, self._heads(self._features(streams)).share)

    @property
    def _outputs(self) -> int:
        return len(self._shares.names)

    def _targets(self, materials: Sequence[str]) -> torch.Tensor:
        return torch.from_numpy(self._shares.presence(materials)).to(self._device)

    def _features(self, streams: Sequence[Stream]) -> FloatArray:
        """Of unit length, (N, d)."""
        network = self.network
        assert isinstance(network, ResNetClassifier)
        body = _Body(network)
        rows = functional.normalize(self.outputs(streams, body).double(), dim=1) if streams else torch.empty(0, body.d)
        features: FloatArray = rows.double().numpy()
        return features


class _Body(nn.Module):
    """A classifier without its head."""

    def __init__(self, network: ResNetClassifier) -> None:
        super().__init__()
        self.network = network
        self.d = network.head.in_features

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.network.features(images)
