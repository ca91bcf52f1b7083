"""Support vector machines on flattened images, of readings or of spikes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from examples.paper.systems.inputs import Image, one_width, picture, usual_columns
from examples.paper.systems.system_protocol import Watch, require_touches, silent, unwatched
from scroll_tactile.clients.learning.metrics import Labelled
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.libraries import optional
from scroll_tactile.signals.stream import Stream

__all__ = ["CHOICES", "Svm"]

CHOICES = (("rbf", 1.0), ("rbf", 10.0), ("rbf", 100.0), ("linear", 0.1), ("linear", 1.0), ("linear", 10.0))
"""(kernel, C), from which the validation chooses; all else is as scikit-learn has it."""


class Svm:
    """scikit-learn's `SVC` on the values of the flattened image, which lie in [-1, 1] and are not scaled further.

    Kernel and C are what is right most often on the validation, the first of equals; then all touches are learned.
    A stream of another length than most is cut, or goes on as its mirror image.

    read: from an image to what is flattened. choices: see `CHOICES`. chosen: what the validation chose.
    """

    def __init__(
        self,
        name: str,
        read: Callable[[Image], Image] = lambda image: image,
        choices: Sequence[tuple[str, float]] = CHOICES,
    ) -> None:
        self.name = name
        self.chosen = choices[0]
        self._read = read
        self._choices = choices
        self._columns = 0
        self._model: Any = None

    def fit(
        self,
        streams: Sequence[Stream],
        materials: Sequence[str],
        validation: Sequence[Labelled],
        seed: int,
        progress: Progress = silent,
        watch: Watch = unwatched,
    ) -> None:
        """See `System.fit`; nothing is drawn, so the seed is of no effect. Without validation it is the first choice.

        Raises InputError where scikit-learn is missing.
        """
        require_touches(streams, materials, validation)
        self._columns = usual_columns([picture(stream) for stream in streams])
        rows, names = self._rows(streams), np.array(materials)
        if validation:
            held = self._rows([stream for _, stream in validation])
            held_names = np.array([name for name, _ in validation])
            right = []
            for done, choice in enumerate(self._choices, start=1):
                right.append(int(np.sum(_machine(*choice).fit(rows, names).predict(held) == held_names)))
                progress("choosing kernel and C", done, len(self._choices))
            self.chosen = self._choices[int(np.argmax(right))]
            rows, names = np.concatenate([rows, held]), np.concatenate([names, held_names])
        self._model = _machine(*self.chosen).fit(rows, names)

    def predict(self, streams: Sequence[Stream]) -> list[str]:
        """See `System.predict`."""
        if self._model is None:
            raise InputError(f"{self.name} has learned nothing yet: call fit first")
        return [str(name) for name in self._model.predict(self._rows(streams))] if streams else []

    def _rows(self, streams: Sequence[Stream]) -> Image:
        return np.stack([self._read(one_width(picture(stream), self._columns)).reshape(-1) for stream in streams])


def _machine(kernel: str, c: float) -> Any:
    with optional("scikit-learn", "bench", "a support vector machine"):
        from sklearn.svm import SVC
    return SVC(kernel=kernel, C=c)
