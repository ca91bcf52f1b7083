"""What kept touches say of a touch, and how far that is to be believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.likelihood import LEVELS, LevelArray, Likelihood, Noise
from scroll_tactile.sensors import Sensor

__all__ = ["KeptTouch", "Match", "NaturalDeviation", "by_chance", "independent", "shape_of", "trust_in", "without_zero"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class KeptTouch:
    """A kept touch: its material, its content hash, and its levels, uint8 of shape (C, T)."""

    material: str
    key: bytes
    levels: LevelArray


@dataclass(frozen=True)
class NaturalDeviation:
    """What a set of kept touches says of itself.

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
    """What kept touches say of a touch.

    scores: log-likelihood of each material, in the order of `KeptArrays.materials`, shape (M,).
    certainty: how far noise leaves it to be seen that values near each other deviate together, 1 of a clean touch.
    noise: what most likely came over it. stuck: the channels that never change, shape (C,).
    expected: levels of all values by the kept touches, shape (C, T); NaN where none of them reaches.
    trust: in [0, 1], which part of how it differs from kept touches is independent noise beyond what is natural.
    moved: whether it is further from them than touches are, and at least half of that is its channels' zeros, which
    may drift.
    likelihood: its logarithm per value. evidence: that beyond the one of values drawn at random from the touch's own;
    not above 0 where nothing that is kept explains the touch. surprise: what is lacking to the one that a touch of the
    set would have.
    """

    scores: FloatArray
    certainty: float
    noise: Noise
    stuck: npt.NDArray[np.bool_]
    expected: FloatArray
    trust: float
    moved: bool
    likelihood: float
    evidence: float
    surprise: float

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


def trust_in(energy: float, coherence: float, measured: NaturalDeviation) -> float:
    """σ⁴ / (σ⁴ + e⁴): σ² the energy of independent noise in a deviation, e² where odds are even."""
    noise = independent(energy, coherence, measured.coherence)
    return noise**2 / (noise**2 + measured.energy**2) if noise else 0.0


def by_chance(levels: LevelArray) -> float:
    """The mean log-likelihood of values drawn from their own frequencies: minus their entropy; 0 of none."""
    shares = np.bincount(levels, minlength=LEVELS) / max(len(levels), 1)
    shares = shares[shares > 0]
    return float((shares * np.log(shares)).sum())
