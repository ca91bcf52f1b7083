"""Systems that meet every touch once: ours, the library's own learner; and plain rules on its features."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from examples.paper.studies.peers import ContinualPeer, touch_features
from examples.paper.systems.system_protocol import Watch, require_touches, silent, unwatched
from scroll_tactile import Embedding
from scroll_tactile.clients.learning.metrics import Labelled
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.learner import TactileLearner
from scroll_tactile.readouts.readout import ReadoutName
from scroll_tactile.signals.stream import Stream

__all__ = ["OnFeatures", "OneByOne", "OnePass"]

Learner = TypeVar("Learner")


class OneByOne(Generic[Learner]):
    """A system with a learner that is made for a sensor, and fed touch by touch; a subclass says how."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._learner: Learner | None = None

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
        learner = self._made(streams[0])
        train = [*zip(materials, streams, strict=True), *validation]
        for done, (material, stream) in enumerate(train, start=1):
            self._observe(learner, material, stream)
            progress("learning", done, len(train))
        self._learner = learner

    @property
    def learner(self) -> Learner:
        """What has learned. Raises InputError before `fit`."""
        if self._learner is None:
            raise InputError(f"{self.name} has learned nothing yet: call fit first")
        return self._learner

    def _made(self, stream: Stream) -> Learner:
        raise NotImplementedError

    def _observe(self, learner: Learner, material: str, stream: Stream) -> None:
        raise NotImplementedError


class OnePass(OneByOne[TactileLearner]):
    """A `TactileLearner` in memory; λ comes from its statistics.

    embedding: frozen; a `Cached` one is spared work from fold to fold. readout: "lda" or "ridge".
    """

    def __init__(self, name: str, embedding: Embedding, readout: ReadoutName) -> None:
        super().__init__(name)
        self._embedding = embedding
        self._readout: ReadoutName = readout

    def predict(self, streams: Sequence[Stream]) -> list[str]:
        """See `System.predict`."""
        learner = self.learner
        return [str(learner.predict(stream).material) for stream in streams]

    def _made(self, stream: Stream) -> TactileLearner:
        return TactileLearner(sensor=stream.sensor, embedding=self._embedding, readout=self._readout, exemplars=0)

    def _observe(self, learner: TactileLearner, material: str, stream: Stream) -> None:
        learner.observe(material, stream)


class OnFeatures(OneByOne[ContinualPeer]):
    """A rule that learns feature vectors one by one, on an embedding's: one vector a touch, see `touch_features`."""

    def __init__(self, name: str, embedding: Embedding, rule: Callable[[], ContinualPeer]) -> None:
        super().__init__(name)
        self._embedding = embedding
        self._rule = rule

    def predict(self, streams: Sequence[Stream]) -> list[str]:
        """See `System.predict`."""
        rule = self.learner
        return rule.predict(touch_features(self._embedding, streams)) if streams else []

    def _made(self, stream: Stream) -> ContinualPeer:
        return self._rule()

    def _observe(self, learner: ContinualPeer, material: str, stream: Stream) -> None:
        learner.observe(touch_features(self._embedding, [stream])[0], material)
