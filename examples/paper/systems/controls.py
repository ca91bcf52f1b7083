"""Controls beside ours: plain rules on the features that ours reads."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from examples.paper.studies.peers import ContinualPeer, touch_features
from examples.paper.systems.system_protocol import Watch, require_touches, silent, unwatched
from scroll_tactile import Embedding
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.training import Progress
from scroll_tactile.pipelines.classification import Labelled
from scroll_tactile.signals.stream import Stream

__all__ = ["OnFeatures"]


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
