"""What there is to say of a memory: how alike its materials are, how it judges touches that it never observed."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.clients.report.charts import Bin
from scroll_tactile.prediction.judging import HeldOutTouch
from scroll_tactile.prediction.model import Model
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["MOST_NEAR", "Mistake", "Trust", "bins_of", "interval", "mistakes", "separations", "trust_in", "unknown_by"]

FloatArray = npt.NDArray[np.float64]

MOST_NEAR = 1024  # materials: the separation of each two of more takes minutes
PRIOR = 0.1  # of a readout's scores, where the calibration is that of another kind
BINS = 10


def separations(statistics: Statistics, model: Model) -> tuple[list[str], FloatArray]:
    """The separation of materials: names, and the log-odds that a typical touch of one has over another, (C, C).

    Half the squared Mahalanobis distance of their means, of each scale that judges whole touches, as far as the
    calibration believes it. Materials that were never touched long enough are left out. None are there before a
    calibration is.
    """
    if model.fusion is None:
        return [], np.zeros((0, 0))
    scales = model.scales("complete", len(model.calibrations) - 1)
    weights = (
        model.fusion.complete.calibration.weights if model.kind == "lda" else np.full(len(scales), PRIOR / len(scales))
    )
    names = [name for name in model.names if all(name in model.readouts[scale].places for scale in scales)]
    total = np.zeros((len(names), len(names)))
    with one_thread():
        for scale, weight in zip(scales, weights.tolist(), strict=True):
            readout = model.readouts[scale]
            solved, _ = readout.linear(names, "lda")
            means = statistics.sums(scale, names) / statistics.counts(scale, names)[:, None] - readout.origin
            products = means @ solved
            products = (products + products.T) / 2
            sizes = np.diagonal(products)
            total += weight * np.maximum(sizes[:, None] + sizes - 2 * products, 0.0) / 2
    np.fill_diagonal(total, 0.0)
    return names, total


@dataclass(frozen=True)
class Mistake:
    """Left-out touches of one material that were called another: how many, of how many, and their mean probability."""

    material: str
    answer: str
    count: int
    tested: int
    confidence: float


def mistakes(held_out: Sequence[HeldOutTouch]) -> list[Mistake]:
    """All confusions, the most frequent first."""
    tested = Counter(touch.material for touch in held_out)
    wrong: dict[tuple[str, str], list[float]] = {}
    for touch in held_out:
        if touch.answer != touch.material:
            wrong.setdefault((touch.material, touch.answer), []).append(touch.confidence)
    found = [
        Mistake(material, answer, len(sure), tested[material], float(np.mean(sure)))
        for (material, answer), sure in wrong.items()
    ]
    return sorted(found, key=lambda m: (-m.count, -m.count / m.tested, m.material, m.answer))


def interval(right: int, count: int) -> tuple[float, float]:
    """The 95 % interval of a share (Wilson 1927)."""
    if not count:
        return 0.0, 1.0
    z, share = 1.96, right / count
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return max(0.0, middle - half), min(1.0, middle + half)


@dataclass(frozen=True)
class Trust:
    """How right and how well calibrated answers to left-out touches are.

    count: of touches. right: share, between low and high with 95 %. confidence: the mean probability that was given.
    error: the expected calibration error, of equal steps of probability. chance: what that would be on average of
    answers that are right as often as they say. unknown: share called unknown.
    """

    count: int
    right: float
    low: float
    high: float
    confidence: float
    error: float
    chance: float
    unknown: float

    @property
    def miscalibrated(self) -> bool:
        """Whether the error is more than chance and matters."""
        return self.error > max(0.05, 2 * self.chance)


def trust_in(held_out: Sequence[HeldOutTouch]) -> Trust:
    """How far answers can be believed, by one or more touches left out."""
    confidence = np.array([touch.confidence for touch in held_out])
    right = np.array([touch.answer == touch.material for touch in held_out])
    count = len(held_out)
    low, high = interval(int(right.sum()), count)
    draws = np.random.default_rng(0).random((200, count)) < confidence
    chance = float(np.mean([_error(confidence, drawn) for drawn in draws]))
    unknown = float(np.mean([not touch.known for touch in held_out]))
    mean = float(confidence.mean())
    return Trust(count, float(right.mean()), low, high, mean, _error(confidence, right), chance, unknown)


def _places(confidence: FloatArray) -> npt.NDArray[np.intp]:
    return np.clip(np.ceil(confidence * BINS).astype(np.intp) - 1, 0, BINS - 1)


def _error(confidence: FloatArray, right: npt.NDArray[np.bool_]) -> float:
    """Expected calibration error: Σ_b (n_b / N) · |right_b − confidence_b|."""
    gaps = np.bincount(_places(confidence), right - confidence, BINS)
    return float(np.abs(gaps).sum() / len(confidence))


def bins_of(held_out: Sequence[HeldOutTouch]) -> list[Bin]:
    """Answers by their probability, in equal steps of it."""
    confidence = np.array([touch.confidence for touch in held_out])
    right = np.array([touch.answer == touch.material for touch in held_out])
    places, found = _places(confidence), []
    for place in np.unique(places):
        own = places == place
        count, hits = int(own.sum()), int(right[own].sum())
        found.append(Bin(count, float(confidence[own].mean()), hits / count, *interval(hits, count)))
    return found


def unknown_by(held_out: Sequence[HeldOutTouch]) -> list[tuple[str, int, int]]:
    """Material, its left-out touches that were called unknown, and all of them; the largest share first."""
    tested = Counter(touch.material for touch in held_out)
    unknown_touches = Counter(touch.material for touch in held_out if not touch.known)
    found = [(name, unknown_touches[name], count) for name, count in tested.items()]
    return sorted(found, key=lambda row: (-row[1] / row[2], row[0]))
