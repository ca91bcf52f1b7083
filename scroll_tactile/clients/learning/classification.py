"""One pass over labelled streams: what is missing is observed, in order, and can be interrupted at any moment."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from scroll_tactile.clients.learning.metrics import accuracy
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.results import Prediction
from scroll_tactile.signals.stream import Stream

__all__ = ["Answers", "Labelled", "evaluate", "missing", "observe_all"]

Labelled = tuple[str, Stream]
"""A material and a touch of it."""


@dataclass(frozen=True)
class Answers:
    """A learner's answers to streams of known material: N materials, and N predictions."""

    truth: list[str]
    predictions: list[Prediction]

    @property
    def predicted(self) -> list[str | None]:
        """The material of each prediction."""
        return [prediction.material for prediction in self.predictions]

    @property
    def accuracy(self) -> float:
        """The share of right answers."""
        return accuracy(self.truth, self.predicted)

    def of(self, material: str) -> Answers:
        """The answers to streams of one material."""
        places = [i for i, name in enumerate(self.truth) if name == material]
        return Answers([material] * len(places), [self.predictions[i] for i in places])

    def confusions(self) -> list[tuple[str, str, int]]:
        """(truth, predicted, count) of what was taken for something else, the most frequent first."""
        pairs = Counter(
            (truth, predicted)
            for truth, predicted in zip(self.truth, self.predicted, strict=True)
            if predicted and predicted != truth
        )
        return [(*pair, count) for pair, count in sorted(pairs.items(), key=lambda entry: (-entry[1], entry[0]))]


def evaluate(learner: TactileLearner, touches: Sequence[Labelled], *, seconds: float | None = None) -> Answers:
    """Predict every touch, or its first `seconds` only."""
    cut = [(name, stream if seconds is None else stream.first(seconds)) for name, stream in touches]
    return Answers([name for name, _ in cut], [learner.predict(stream) for _, stream in cut])


def missing(touches: Sequence[Labelled], observed: Mapping[str, int]) -> list[Labelled]:
    """Those of `touches` that a memory has still to observe, given how many of each material it has observed.

    A memory that was filled in this very order and interrupted holds the first few of every material.

    Raises InputError where it holds more than these touches: it is another pass's.
    """
    planned = Counter(name for name, _ in touches)
    extra = {name: count for name, count in observed.items() if count > planned[name]}
    if extra:
        raise InputError(
            f"expected a memory that this run began; it holds more than the run would train it on: {extra}. "
            "Take another folder"
        )
    left = dict(observed)
    remaining = []
    for name, stream in touches:
        if left.get(name, 0):
            left[name] -= 1
        else:
            remaining.append((name, stream))
    return remaining


def observe_all(learner: TactileLearner, touches: Sequence[Labelled], each: Callable[[], object] = lambda: None) -> int:
    """Observe, in order, those that the memory does not hold yet, calling `each` after each; returns how many."""
    remaining = missing(touches, learner.materials)
    for _ in range(len(touches) - len(remaining)):
        each()
    for name, stream in remaining:
        learner.observe(name, stream)
        each()
    return len(remaining)
