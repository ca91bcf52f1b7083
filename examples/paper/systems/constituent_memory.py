"""Ours: a memory of touches that is given what fabrics are made of, as a system of the comparison."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from examples.paper.systems.constituent_squares import Estimates, Shares
from examples.paper.systems.system_protocol import Watch, require_touches, silent, unwatched
from scroll_tactile import Embedding
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.training import Progress
from scroll_tactile.learner import TactileLearner
from scroll_tactile.pipelines.classification import Labelled
from scroll_tactile.results import Composition
from scroll_tactile.signals.copies import Augmented
from scroll_tactile.signals.stream import Stream

__all__ = ["ConstituentMemory", "estimates_of"]


class ConstituentMemory:
    """A `TactileLearner` that meets every touch once, is given what fabrics are made of, and composes.

    embedding: frozen. read: from a touch to the stream that is learned or tested. augmentation: copies that
    touches are observed with, or none. unfamiliar: how probable it is beforehand that a touch is of a fabric never
    touched, which the caller knows; see `TactileLearner.compose`.
    """

    def __init__(
        self,
        name: str,
        shares: Shares,
        embedding: Embedding,
        read: Callable[[Stream], Stream] = lambda stream: stream,
        augmentation: Augmented | None = None,
        unfamiliar: float = 0.0,
    ) -> None:
        self.name = name
        self._read = read
        self.unfamiliar = unfamiliar
        self._shares, self._embedding, self._augmentation = shares, embedding, augmentation
        self._learner: TactileLearner | None = None

    def fit(
        self,
        streams: Sequence[Stream],
        materials: Sequence[str],
        validation: Sequence[Labelled],
        seed: int,
        progress: Progress = silent,
        watch: Watch = unwatched,
    ) -> None:
        """See `System.fit`; the validation is learned like the rest."""
        require_touches(streams, materials, validation)
        sensor = self._read(streams[0]).sensor
        learner = TactileLearner(sensor=sensor, embedding=self._embedding, exemplars=0, augmentation=self._augmentation)
        train = [*zip(materials, streams, strict=True), *validation]
        for done, (material, stream) in enumerate(train, start=1):
            learner.observe(material, self._read(stream))
            progress("learning", done, len(train))
        for fabric in learner.materials:
            learner.describe(fabric, dict(self._shares.of[fabric]))
        self._learner = learner

    def compositions(self, streams: Sequence[Stream], unfamiliar: float, progress: Progress) -> list[Composition]:
        """What the learner composes of each. Raises InputError before `fit`."""
        if self._learner is None:
            raise InputError(f"{self.name} has learned nothing yet: call fit first")
        predicted = []
        for done, stream in enumerate(streams, start=1):
            felt = self._read(stream)
            predicted.append(self._learner.compose(felt, constituents=self._shares.names, unfamiliar=unfamiliar))
            progress("asking", done, len(streams))
        return predicted

    def estimate(self, streams: Sequence[Stream], progress: Progress = silent) -> Estimates:
        """See `ConstituentSystem.estimate`."""
        return estimates_of(self._shares.names, self.compositions(streams, self.unfamiliar, progress))


def estimates_of(names: Sequence[str], predicted: Sequence[Composition]) -> Estimates:
    """Compositions as arrays, the constituents in the order of `names`."""
    rows = [[(composition[name].presence, composition[name].share) for name in names] for composition in predicted]
    both = np.array(rows, dtype=np.float64).reshape(-1, len(names), 2)  # None becomes NaN
    return Estimates(both[..., 0], both[..., 1])
