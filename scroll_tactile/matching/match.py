"""What matching a touch with kept touches gives: a match; and what the kept touches deviate by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.likelihood import LEVELS, LevelArray, Likelihood, Noise
from scroll_tactile.sensors import Sensor
from scroll_tactile.statistics.annotations import NO_ANNOTATION, Annotation

__all__ = [
    "KeptTouch",
    "Match",
    "NaturalDeviation",
    "independent",
    "negative_entropy",
    "noise_share",
    "shape_of",
    "without_zero",
]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class KeptTouch:
    """A kept touch: its material, its content hash, its levels, uint8 of shape (C, T), and how it was annotated."""

    material: str
    key: bytes
    levels: LevelArray
    annotation: Annotation = NO_ANNOTATION


@dataclass(frozen=True)
class NaturalDeviation:
    """How touches of one material deviate from each other in a set of kept touches.

    likelihood: its tables. coherence: how much larger the deviation of a channel's mean from a kept touch's
    is, squared and times T, than that of a value; 1 for independent noise. energy: of independent
    noise that is even odds to be natural, in squared levels. most: the energy of a deviation that 19 of 20 stay below,
    in squared levels; infinite where too few touches are kept to say.
    """

    likelihood: Likelihood
    coherence: float
    energy: float
    most: float = np.inf


@dataclass(frozen=True)
class Match:
    """A touch beside kept touches.

    scores: log-likelihood of each material, in the order of `KeptArrays.materials`, shape (M,).
    information: Fisher's information on the values that were read, through the noise, in units of the natural spread;
    about 1 of a clean touch as long as the longest kept one.
    noise: what most likely came over it. stuck: the channels that never change, shape (C,).
    expected: levels of all values by the kept touches, shape (C, T); NaN where none of them reaches.
    energy, coherence: of the touch's deviation from the likeliest kept one; see `NaturalDeviation`.
    noise_share: in [0, 1], how much of that deviation is independent noise beyond the natural.
    moved: whether the touch deviates more than touches do, and at least half of that is its channels' zeros, which
    may drift.
    log_likelihood_gain: the log-likelihood per value less the negative entropy of the touch's own values; not above 0
    where nothing that is kept explains the touch. excess_loss: the negative log-likelihood per value less the expected
    one of a touch of the set.
    """

    scores: FloatArray
    information: float
    noise: Noise
    stuck: npt.NDArray[np.bool_]
    expected: npt.NDArray[np.floating]
    energy: float
    coherence: float
    noise_share: float
    moved: bool
    log_likelihood_gain: float
    excess_loss: float

    def filled(self, readings: npt.NDArray[np.floating], sensor: Sensor) -> npt.NDArray[np.float32]:
        """The readings, shape (T, C) in the sensor's unit, with what is missing or stuck as kept touches have it."""
        low, high = sensor.limits
        expected = low + (high - low) * (self.expected.T.astype(np.float32) / np.float32(LEVELS - 1))
        lacking = (np.isnan(readings) | self.stuck) & np.isfinite(expected)
        return np.where(lacking, expected, readings).astype(np.float32)


def shape_of(deviation: FloatArray, seen: npt.NDArray[np.bool_]) -> tuple[float, float]:
    """Energy and coherence (see NaturalDeviation) of a deviation, (C, T) in levels, 0 where a value is not seen."""
    counts = seen.sum(axis=1)
    energy = float(np.square(deviation).sum()) / max(int(counts.sum()), 1)
    if not energy:
        return 0.0, 1.0
    together = float((np.square(deviation.sum(axis=1)) / np.maximum(counts, 1)).sum()) / np.count_nonzero(counts)
    return energy, together / energy


def without_zero(deviation: FloatArray, seen: npt.NDArray[np.bool_]) -> float:
    """The energy of a deviation (see `shape_of`) but for each channel's mean and its straight way up or down."""
    counts = np.maximum(seen.sum(axis=1, keepdims=True), 1)
    time = np.broadcast_to(np.arange(seen.shape[1]), seen.shape)
    away = (time - (time * seen).sum(axis=1, keepdims=True) / counts) * seen
    slope = (deviation * away).sum(axis=1) / np.maximum(np.square(away).sum(axis=1), 1)
    rest = (deviation - deviation.sum(axis=1, keepdims=True) / counts - slope[:, None] * away) * seen
    return float(np.square(rest).sum()) / max(int(seen.sum()), 1)


def independent(energy: float, coherence: float, natural: float) -> float:
    """The energy σ² of independent noise in a deviation of some energy v and coherence w.

    natural: the coherence of natural deviations, of which the rest is made: w v = σ² + natural · (v − σ²).
    """
    if natural <= 1:
        return energy
    return energy * min(max((natural - coherence) / (natural - 1), 0.0), 1.0)


def noise_share(energy: float, coherence: float, natural: NaturalDeviation) -> float:
    """σ⁴ / (σ⁴ + e⁴): σ² the energy of independent noise in a deviation, e² where odds are even.

    0 where too few touches are kept to say what is natural: then the readouts decide.
    """
    if not np.isfinite(natural.most):
        return 0.0
    noise = independent(energy, coherence, natural.coherence)
    return noise**2 / (noise**2 + natural.energy**2) if noise else 0.0


def negative_entropy(levels: LevelArray) -> float:
    """The mean log-likelihood of values drawn from their own frequencies: minus their entropy; 0 of none."""
    shares = np.bincount(levels, minlength=LEVELS) / max(len(levels), 1)
    shares = shares[shares > 0]
    return float((shares * np.log(shares)).sum())
