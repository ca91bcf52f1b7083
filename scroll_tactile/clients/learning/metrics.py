"""Answers to touches of known material, and figures of merit, each with its equation, in numpy alone.

>>> accuracy(["felt", "silk"], ["felt", "wool"])
0.5
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.results import Prediction
from scroll_tactile.signals.stream import Stream

__all__ = [
    "Answers",
    "Labelled",
    "accuracy",
    "calibration_error",
    "confusion_counts",
    "evaluate",
    "interval_figures",
    "mean_and_spread",
    "observe_all",
]

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


def observe_all(learner: TactileLearner, touches: Sequence[Labelled]) -> int:
    """Observe, in order, those that the memory does not hold yet; returns how many.

    A memory that was filled in this very order and interrupted holds the first few of every material.

    Raises InputError where it holds more than these touches: it is another pass's.
    """
    left, planned, observed = dict(learner.materials), Counter(name for name, _ in touches), 0
    extra = {name: count for name, count in left.items() if count > planned[name]}
    if extra:
        raise InputError(
            f"expected a memory that this run began; it holds more than the run would train it on: {extra}. "
            "Take another folder"
        )
    for name, stream in touches:
        if left.get(name, 0):
            left[name] -= 1
        else:
            learner.observe(name, stream)
            observed += 1
    return observed


def accuracy(truth: Sequence[str | None], predicted: Sequence[str | None]) -> float:
    """The share of answers that are right: Σ_i [predicted_i = truth_i] / N.

    truth, predicted: N materials each. Raises InputError where N differs or is 0.
    """
    _require_pairs(len(truth), len(predicted))
    return sum(true == guess for true, guess in zip(truth, predicted, strict=True)) / len(truth)


def calibration_error(probability: npt.ArrayLike, right: npt.ArrayLike, bins: int = 15) -> float:
    """Expected calibration error: Σ_b (n_b / N) · |right_b − probability_b|.

    b runs over `bins` intervals of equal width, ((b−1)/bins, b/bins], and the two are means of those that fall in.
    probability: of the answers given, in [0, 1], shape (N,). right: whether they were, shape (N,).
    Raises InputError where the shapes differ, N is 0, or a probability is none.
    """
    chances = np.asarray(probability, dtype=np.float64)
    hits = np.asarray(right, dtype=np.float64)
    _require_pairs(len(chances), len(hits))
    if not ((chances >= 0) & (chances <= 1)).all():
        raise InputError("expected probabilities from 0 to 1; came others")
    place = np.clip(np.ceil(chances * bins).astype(int) - 1, 0, bins - 1)
    gaps = np.zeros(bins)
    np.add.at(gaps, place, hits - chances)  # n_b times the difference of the means
    return float(np.abs(gaps).sum() / len(chances))


def interval_figures(
    truth: npt.ArrayLike, estimates: npt.ArrayLike, low: npt.ArrayLike, high: npt.ArrayLike
) -> dict[str, float | None]:
    """How good N numbers with intervals are, all of shape (N,) and in one unit.

    covered: the share of intervals that hold the truth, Σ_i [low_i ≤ t_i ≤ high_i] / N. width: their mean, in the unit.
    mean_error: Σ_i |s_i − t_i| / N, in the unit. r2: 1 − Σ_i (s_i − t_i)² / Σ_i (t_i − mean t)²; None where all t are
    equal.

    Raises InputError where N differs or is 0.
    """
    true, value, below, above = (np.asarray(one, dtype=np.float64) for one in (truth, estimates, low, high))
    for other in (value, below, above):
        _require_pairs(len(true), len(other))
    spread = float(np.square(true - true.mean()).sum())
    return {
        "covered": float(((below <= true) & (true <= above)).mean()),
        "width": float((above - below).mean()),
        "mean_error": float(np.abs(value - true).mean()),
        "r2": 1 - float(np.square(value - true).sum()) / spread if spread else None,
    }


def mean_and_spread(values: Sequence[float]) -> tuple[float, float]:
    """Mean, and standard deviation Σ(x − mean)² / (N − 1) under the root, 0 where N is 1."""
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
    return float(np.mean(values)), spread


def _require_pairs(expected: int, came: int) -> None:
    if expected != came or not expected:
        raise InputError(f"expected as many answers as truths, and at least one; came {came} and {expected}")


def confusion_counts(
    names: Sequence[str], tested: Sequence[int], confusions: Sequence[tuple[str, str, int]]
) -> np.ndarray:
    """Counts of (truth, predicted), shape (C, C), from the wrong answers.

    names: C materials. tested: touches of each. confusions: (truth, predicted, count) with predicted ≠ truth.
    """
    place = {name: i for i, name in enumerate(names)}
    counts = np.diag(np.asarray(tested, dtype=np.int64))
    for truth, predicted, count in confusions:
        counts[place[truth], place[predicted]] += count
        counts[place[truth], place[truth]] -= count
    return counts
