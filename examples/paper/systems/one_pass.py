"""Ours: the library's own learner, one pass over the touches, as a system of the comparison."""

from __future__ import annotations

from collections.abc import Sequence

from examples.paper.systems.system_protocol import Watch, require_touches, silent, unwatched
from scroll_tactile import Embedding
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.training import Progress
from scroll_tactile.learner import TactileLearner
from scroll_tactile.pipelines.classification import Labelled
from scroll_tactile.readouts.readout import ReadoutName
from scroll_tactile.signals.stream import Stream

__all__ = ["OnePass"]


class OnePass:
    """A `TactileLearner` in memory, which meets every touch once; λ comes from its statistics, and no seed is drawn.

    embedding: frozen; a `Cached` one is spared work from fold to fold. readout: "lda" or "ridge".
    """

    def __init__(self, name: str, embedding: Embedding, readout: ReadoutName) -> None:
        self.name = name
        self._embedding = embedding
        self._readout: ReadoutName = readout
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
        learner = TactileLearner(
            sensor=streams[0].sensor, embedding=self._embedding, readout=self._readout, exemplars=0
        )
        train = [*zip(materials, streams, strict=True), *validation]
        for done, (material, stream) in enumerate(train, start=1):
            learner.observe(material, stream)
            progress("learning", done, len(train))
        self._learner = learner

    def predict(self, streams: Sequence[Stream]) -> list[str]:
        """See `System.predict`."""
        if self._learner is None:
            raise InputError(f"{self.name} has learned nothing yet: call fit first")
        return [str(self._learner.predict(stream).material) for stream in streams]
