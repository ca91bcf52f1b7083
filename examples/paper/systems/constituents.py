"""Systems that estimate what a touch is made of: least squares, a network of heads, and ours.

Each learns touches by the fabric that they are of, as a `System` does, and knows from a `Shares` what fabrics are made
of.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.nn import functional

from examples.paper.systems.descent import Loss
from examples.paper.systems.least_squares import PENALTIES, LeastSquares, Ridge, ridge
from examples.paper.systems.networks import ResNetClassifier
from examples.paper.systems.one_pass import OneByOne
from examples.paper.systems.system_protocol import Watch, require_touches, silent, unwatched
from examples.paper.systems.trained import TrainedNetwork
from scroll_tactile import Embedding
from scroll_tactile.clients.learning.metrics import Labelled
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.learner import TactileLearner
from scroll_tactile.results import Composition
from scroll_tactile.signals.stream import Stream

__all__ = [
    "ConstituentMemory",
    "ConstituentNet",
    "ConstituentSquares",
    "ConstituentSystem",
    "Estimates",
    "Heads",
    "Shares",
    "estimates_of",
]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Shares:
    """What fabrics are made of.

    names: K constituents. of: fabric → constituent → its share by mass; those that are not named are absent.
    """

    names: tuple[str, ...]
    of: Mapping[str, Mapping[str, float]]

    def masses(self, fabrics: Sequence[str]) -> FloatArray:
        """Shares, (N, K), of N fabrics."""
        rows = [[self.of[fabric].get(name, 0.0) for name in self.names] for fabric in fabrics]
        return np.array(rows, dtype=np.float64).reshape(-1, len(self.names))

    def presence(self, fabrics: Sequence[str]) -> FloatArray:
        """1 where a constituent is there, 0 where it is not; (N, K)."""
        return (self.masses(fabrics) > 0).astype(np.float64)


@dataclass(frozen=True)
class Estimates:
    """Estimates for N touches: probability of each of K constituents, and its share; (N, K), NaN where none is."""

    presence: FloatArray
    share: FloatArray


def estimates_of(names: Sequence[str], predicted: Sequence[Composition]) -> Estimates:
    """Compositions as arrays, the constituents in the order of `names`."""
    rows = [[(composition[name].presence, composition[name].share) for name in names] for composition in predicted]
    both = np.array(rows, dtype=np.float64).reshape(-1, len(names), 2)  # None becomes NaN
    return Estimates(both[..., 0], both[..., 1])


class ConstituentSystem(Protocol):
    """A system that estimates constituents."""

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    def fit(
        self,
        streams: Sequence[Stream],
        materials: Sequence[str],
        validation: Sequence[Labelled],
        seed: int,
        progress: Progress = silent,
        watch: Watch = unwatched,
    ) -> None:
        """As `System.fit`."""
        ...

    def estimate(self, streams: Sequence[Stream], progress: Progress = silent) -> Estimates:
        """What each stream is made of. Raises InputError before `fit`."""
        ...


class Heads:
    """Ridge heads of presences and of shares on features.

    λ of the presences is what the validation has the best score with, that of the shares the least squared error, in
    each case the largest of equals, 1e-3 without validation; then all touches are learned.

    features: (N, d) of N touches of `fabrics`, and held: (M, d) of those of the validation, of `asked`.
    penalties: λ of presences and of shares.
    """

    def __init__(
        self, features: FloatArray, held: FloatArray, shares: Shares, fabrics: Sequence[str], asked: Sequence[str]
    ) -> None:
        self.penalties: list[float] = []
        self._heads: list[Ridge] = []
        rows = np.concatenate([features, held])
        for what, lost in ((shares.presence, _wrong), (shares.masses, _apart)):
            learned, tested = what(fabrics), what(asked)
            penalty = 1e-3
            if tested.size:
                losses = [lost(_predict(ridge(features, learned, choice), held), tested) for choice in PENALTIES]
                penalty = max(choice for choice, loss in zip(PENALTIES, losses, strict=True) if loss == min(losses))
            self.penalties.append(penalty)
            self._heads.append(ridge(rows, np.concatenate([learned, tested]), penalty))

    def __call__(self, features: FloatArray) -> Estimates:
        """What touches of these features, (N, d), are made of; their shares sum to one."""
        presence, share = (_predict(head, features) for head in self._heads)
        total = share.sum(axis=1, keepdims=True)
        return Estimates(presence, np.divide(share, total, out=share.copy(), where=total > 0))


def _wrong(predicted: FloatArray, true: FloatArray) -> float:
    return float(((predicted > 0.5) != (true > 0)).sum())


def _apart(predicted: FloatArray, true: FloatArray) -> float:
    return float(np.square(predicted - true).sum())


def _predict(head: Ridge, features: FloatArray) -> FloatArray:
    predicted: FloatArray = np.clip(head(features), 0, 1)
    return predicted


class ConstituentSquares:
    """Ridge regression of presences and shares on a frozen network's features of the whole image.

    squares: whose features these are; what it has embedded it keeps. chosen: λ of presences and of shares.
    """

    def __init__(self, name: str, shares: Shares, squares: LeastSquares) -> None:
        self.name = name
        self.chosen: list[float] = []
        self._shares, self._squares = shares, squares
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
        """See `System.fit`; nothing is drawn, so the seed is of no effect."""
        require_touches(streams, materials, validation)
        features = self._squares.features(streams, progress)
        held = self._squares.features([stream for _, stream in validation], progress)
        self._heads = Heads(features, held, self._shares, materials, [name for name, _ in validation])
        self.chosen = self._heads.penalties

    def estimate(self, streams: Sequence[Stream], progress: Progress = silent) -> Estimates:
        """See `ConstituentSystem.estimate`."""
        if self._heads is None:
            raise InputError(f"{self.name} has learned nothing yet: call fit first")
        return self._heads(self._squares.features(streams, progress))


class ConstituentNet(TrainedNetwork):
    """A residual network with one head for each constituent, which predicts its presence: a logistic unit.

    Trained as `TrainedNetwork` is. Shares, which the paper's heads do not report, are by ridge regression on the
    features below them, of the touches that the network learned.
    """

    _criterion: Loss = staticmethod(functional.binary_cross_entropy_with_logits)

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


class ConstituentMemory(OneByOne[TactileLearner]):
    """Ours: a `TactileLearner` that is given what fabrics are made of, and composes.

    embedding: frozen. read: from a touch to the stream that is learned or tested.
    """

    def __init__(
        self,
        name: str,
        shares: Shares,
        embedding: Embedding,
        read: Callable[[Stream], Stream] = lambda stream: stream,
    ) -> None:
        super().__init__(name)
        self._read = read
        self._shares, self._embedding = shares, embedding

    def compositions(
        self, streams: Sequence[Stream], unfamiliar: float, progress: Progress = silent
    ) -> list[Composition]:
        """What the learner composes of each. Raises InputError before `fit`.

        unfamiliar: how probable it is beforehand that a touch is of a fabric never touched.
        """
        learner, predicted = self.learner, []
        for done, stream in enumerate(streams, start=1):
            felt = self._read(stream)
            predicted.append(learner.compose(felt, constituents=self._shares.names, unfamiliar=unfamiliar))
            progress("composing", done, len(streams))
        return predicted

    def estimate(self, streams: Sequence[Stream], progress: Progress = silent) -> Estimates:
        """See `ConstituentSystem.estimate`; the caller knows that all fabrics were touched before."""
        return estimates_of(self._shares.names, self.compositions(streams, 0.0, progress))

    def _made(self, stream: Stream) -> TactileLearner:
        learner = TactileLearner(sensor=self._read(stream).sensor, embedding=self._embedding, exemplars=0)
        for fabric, shares in self._shares.of.items():
            learner.describe(fabric, {name: shares.get(name, 0.0) for name in self._shares.names})
        return learner

    def _observe(self, learner: TactileLearner, material: str, stream: Stream) -> None:
        learner.observe(material, self._read(stream))
