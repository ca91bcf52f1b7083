"""Calibration: from scores to probabilities, and from distances to "never observed", by touches held out.

The readouts of the folds that a sampled touch is not in score it. On these scores s one weight w_k a scale is fitted,
which says how far each scale is to be believed and is a temperature (Platt 1999; Guo et al. 2017, arXiv 1706.04599):

    p_y = exp(Σ_k w_k s_ky) / Σ_z exp(Σ_k w_k s_kz),    w = argmin_{w ≥ 0} −Σ log p_target + ρ/2 Σ_k (w_k / w⁰_k − 1)²,

w⁰ the prior and ρ the touches that it counts as. The novelty of known materials' touches is measured likewise, and
an alarm's threshold is their conformal quantile (Vovk et al. 2005). All are functions of the statistics and the sample,
so of what was observed and nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.readout import Readout, ReadoutName
from scroll_tactile.readouts.shrinkage import Selection
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.sample import TouchSample
from scroll_tactile.statistics.statistics import fold_of

__all__ = ["FEWEST", "Calibration", "calibrate", "calibrate_stage", "fit_weights"]

FloatArray = npt.NDArray[np.float64]

FEWEST = 8  # held-out touches; with fewer, a stage keeps the threshold and the spreads set beforehand
PRIOR_WEIGHT = {
    "lda": 0.1,
    "ridge": 10.0,
}  # of the scores of all scales together: what both sensors' data come to
PRIOR_TOUCHES = 0.5  # the prior counts as much as these


@dataclass(frozen=True)
class Calibration:
    """How the scores and distances of one stage are to be read.

    weights: of the scores of the S scales that fit at the stage, shape (S,), ≥ 0.
    scale_novelty: mean and spread of each scale's novelty for known materials, shape (S, 2).
    novelties: sorted standardised novelty of known, held-out touches, shape (touches,).
    """

    weights: FloatArray
    scale_novelty: FloatArray
    novelties: FloatArray

    def novelty(self, distances: FloatArray) -> FloatArray:
        """Standardised novelty, shape (…,), of distances by scale, shape (…, S)."""
        mean, spread = self.scale_novelty.T
        standard: FloatArray = ((distances - mean) / spread).mean(axis=-1)
        return standard

    def threshold(self, false_alarms: float) -> float:
        """The novelty that a share `false_alarms` of known touches exceeds, by the held-out ones."""
        if len(self.novelties) < FEWEST:
            return UNMEASURED
        # The conformal quantile: of n + 1 exchangeable touches no more than this share lies above it.
        rank = int(np.ceil((1 - false_alarms) * (len(self.novelties) + 1)))
        return float(self.novelties[rank - 1]) if rank <= len(self.novelties) else float(2 * self.novelties[-1])


UNMEASURED = 5.0  # spreads: where too little could be held out to measure the distances of known touches


def calibrate(
    sample: TouchSample, stages: Sequence[Sequence[Scale]], selections: Mapping[Scale, Selection], kind: ReadoutName
) -> list[Calibration]:
    """Calibrate every stage, given as the scales that fit there, of whose scales all have a readout."""
    return [
        calibrate_stage(stage, sample, [selections[scale] for scale in scales], kind)
        for stage, scales in enumerate(stages)
        if all(scale in selections for scale in scales)
    ]


def calibrate_stage(stage: int, sample: TouchSample, selections: list[Selection], kind: ReadoutName) -> Calibration:
    """Calibrate one stage, by the readouts of the scales that judge there, ascending."""
    scores, targets, distances = _held_out(stage, sample, selections, kind)
    prior = np.full(len(selections), PRIOR_WEIGHT[kind] / len(selections))
    weights = fit_weights(scores, targets, prior)
    if len(distances) < FEWEST:
        return Calibration(weights, _assumed(selections), np.zeros(0))
    spread = np.maximum(distances.std(axis=0), 1e-9 * (1 + np.abs(distances).max(axis=0)))
    shape = np.stack([distances.mean(axis=0), spread], axis=1)
    unsorted = Calibration(weights, shape, np.zeros(0)).novelty(distances)
    # The mean of scales that agree only in part spreads less than one: back to units of its own spread.
    spread = shape[:, 1] * max(float(unsorted.std()), 1e-9)
    shape = np.stack([shape[:, 0], spread], axis=1)
    return Calibration(weights, shape, np.sort(Calibration(weights, shape, np.zeros(0)).novelty(distances)))


def _held_out(
    stage: int, sample: TouchSample, selections: list[Selection], kind: ReadoutName
) -> tuple[list[FloatArray], list[int], FloatArray]:
    """Scores (scales, C') and target place of each held-out touch, and its distances (touches, scales)."""
    scores: list[FloatArray] = []
    targets: list[int] = []
    distances: list[FloatArray] = []
    for material, key, sums in sample:
        means = sums.means(stage)
        judged = None if means is None else _judge(means, material, fold_of(key), selections, kind)
        if judged is not None:
            scores.append(judged[0])
            targets.append(judged[1])
            distances.append(judged[2])
    return scores, targets, np.array(distances).reshape(len(scores), len(selections))


def _judge(
    means: list[FloatArray], material: str, fold: int, selections: list[Selection], kind: ReadoutName
) -> tuple[FloatArray, int, FloatArray] | None:
    if any(fold not in selection.held_out for selection in selections):
        return None
    known = [[selection.names[place] for place in selection.held_out[fold][0]] for selection in selections]
    common = sorted(set.intersection(*map(set, known)))
    if material not in common or len(common) < 2:
        return None
    rows, distances = [], []
    for selection, names, mean in zip(selections, known, means, strict=True):
        readout = selection.held_out[fold][1]
        z = readout.project(mean)
        rows.append(readout.scores(z, kind)[[names.index(name) for name in common]])
        distances.append(float(readout.novelty(z)))
    return np.stack(rows), common.index(material), np.array(distances)


def fit_weights(scores: list[FloatArray], targets: list[int], prior: FloatArray) -> FloatArray:
    """Weights ≥ 0 of least held-out log loss, a convex problem, drawn to the prior where touches are few."""
    if not scores:
        return prior
    groups: dict[int, list[int]] = {}
    for touch, rows in enumerate(scores):
        groups.setdefault(rows.shape[1], []).append(touch)
    # Scores less the target's, (touches, scales, classes), for each number of classes.
    gaps = [np.stack([scores[i] - scores[i][:, [targets[i]]] for i in touches]) for touches in groups.values()]

    def loss(weights: FloatArray) -> tuple[float, FloatArray]:
        value, slope = 0.0, np.zeros_like(weights)
        for gap in gaps:
            logits = np.einsum("tsc,s->tc", gap, weights)
            top = logits.max(axis=1, keepdims=True)
            chances = np.exp(logits - top)
            total = chances.sum(axis=1, keepdims=True)
            value += float((np.log(total) + top).sum())
            slope += np.einsum("tsc,tc->s", gap, chances / total)
        pull = weights / prior - 1
        return value + PRIOR_TOUCHES * float(pull @ pull) / 2, slope + PRIOR_TOUCHES * pull / prior

    from scipy.optimize import minimize  # a third of a second, that whoever only looks at a memory is spared

    fit = minimize(loss, prior, jac=True, bounds=[(0.0, None)] * len(prior), method="L-BFGS-B")
    fitted: FloatArray = fit.x
    return fitted


def _assumed(selections: list[Selection]) -> FloatArray:
    """Without held-out touches: the distances of the class means themselves, spread by their own mean size."""
    shapes = []
    for selection in selections:
        readout: Readout = selection.readout
        # Row y of G is z at the mean of class y.
        typical = float(np.mean(readout.novelty(readout.gram)))
        size = float(np.mean(np.diagonal(readout.gram)))
        shapes.append([typical, max(size, 1e-9) / UNMEASURED])
    return np.array(shapes)
