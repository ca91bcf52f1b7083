"""Held-out touches at one moment: what the readouts of some scales say of sampled touches that they never observed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.calibration import Calibration, common_names, judged_touches
from scroll_tactile.readouts.leave_one_out import HeldOutScores, Sampled
from scroll_tactile.signals.windows import Scale

__all__ = ["HeldOutProbabilities", "held_out_probabilities"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class HeldOutProbabilities:
    """What is said of N sampled touches, each held out, of the C materials that all scales know.

    names: the materials, in alphabetical order. places: of the touches in the sample, ascending. keys: their content
    hashes. targets: the place of each one's material among the names, (N,). logs: log-probability of the materials,
    (N, C). distance: the least squared distance beside a usual one at any scale, (N,). novelty: see `Prediction`, (N,).
    """

    names: list[str]
    places: list[int]
    keys: list[bytes]
    targets: npt.NDArray[np.intp]
    logs: FloatArray
    distance: FloatArray
    novelty: FloatArray

    @property
    def margins(self) -> FloatArray:
        """How far each one's own material is ahead of the next, in logits; below 0 where it is behind, (N,)."""
        rows = np.arange(len(self.targets))
        others = self.logs.copy()
        others[rows, self.targets] = -np.inf
        return np.asarray(self.logs[rows, self.targets] - others.max(axis=1, initial=-np.inf))


def held_out_probabilities(
    stage: int,
    scales: Sequence[Scale],
    sample: Sampled,
    held_out: Mapping[Scale, HeldOutScores],
    calibration: Calibration,
) -> HeldOutProbabilities:
    """What some scales say at a stage, as they are calibrated. held_out: what each says of the sampled touches."""
    said = [held_out[scale] for scale in scales]
    names, touches = common_names(said), list(sample)
    own = {name: i for i, name in enumerate(names)}
    places = [place for place in judged_touches(stage, said) if touches[place][0] in own] if len(names) > 1 else []
    materials = [[left.names.index(name) for name in names] for left in said]
    rows = [[left.rows[place, stage] for place in places] for left in said]
    away = np.stack([left.diagonal_distances[at] for left, at in zip(said, rows, strict=True)], axis=1)
    measuring = [scale.measures_novelty for scale in scales]
    weights = calibration.weights_at(away)
    logits = np.zeros((len(places), len(names)))
    distances = []
    for i, (scale, left, at, columns) in enumerate(zip(scales, said, rows, materials, strict=True)):
        logits += weights[:, i, None] * left.scores[np.ix_(at, columns)]
        if places and scale.measures_novelty:
            distances.append(left.distances[np.ix_(at, columns)].min(axis=1))
    logits -= logits.max(axis=1, keepdims=True) if len(names) else 0.0
    logits -= np.log(np.exp(logits).sum(axis=1, keepdims=True))
    return HeldOutProbabilities(
        names,
        places,
        [touches[place][1] for place in places],
        np.array([own[touches[place][0]] for place in places], dtype=np.intp),
        logits,
        calibration.relative(away)[:, measuring].min(axis=1) if places else np.zeros(0),
        np.asarray(calibration.novelty(np.stack(distances, axis=1))) if places else np.zeros(0),
    )
