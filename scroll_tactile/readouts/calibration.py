"""Calibration: from scores to probabilities, and from distances to novelty, by held-out touches.

Each sampled touch is scored by readouts that never observed it (`leave_one_out`). On these scores s one weight w_k a
scale is fitted, which is a temperature (Platt 1999; Guo et al. 2017,
arXiv 1706.04599):

    p_y = exp(Σ_k w_k s_ky) / Σ_z exp(Σ_k w_k s_kz),    w = argmin_{w ≥ 0} −Σ log p_target + ρ/2 Σ_k (w_k / w⁰_k − 1)²,

w⁰ the prior and ρ the touches that it counts as: first one weight is fitted that all scales have in common, and then
one each that is drawn to it. Scores of left-out touches are nearly collinear, and by themselves the weights run into a
corner: all on one scale, that a longer touch may spoil. Where a touch is viewed in several ways, a view has less weight
the further the touch lies from its nearest material there: the view's scores count as min(1, u_k / r_k) s_k, r_k the
squared Mahalanobis distance with diagonal scatter (`Readout.diagonal_distance`) and u_k its median over held-out
touches. So a view that a change of speed, of zero or of length has spoilt leaves the decision to others.

The novelty of known materials' touches is measured likewise, and an alarm's threshold is their conformal quantile (Vovk
et al. 2005). All are functions of the statistics and the sample, so of what was observed and nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.leave_one_out import HeldOutScores
from scroll_tactile.readouts.readout import Readout, ReadoutName

__all__ = [
    "AHEAD",
    "FEWEST",
    "PRIOR_WEIGHT",
    "UNMEASURED",
    "Calibration",
    "calibrate_stage",
    "common_names",
    "fit_weights",
    "judged_touches",
    "scale_weights",
]

FloatArray = npt.NDArray[np.float64]

FEWEST = 8  # left-out touches; with fewer, a stage keeps the threshold and the spreads set beforehand
PRIOR_WEIGHT = {
    "lda": 0.1,
    "ridge": 10.0,
}  # of the scores of all scales together: what both sensors' data come to
# Logits by which the mean of a material is ahead of the next one's where no touch can be left out, see `_unheld`: of
# one touch of each, log loss was least from 1.5 to 2 on fifteen sets (BioTac, RoboSkin, letters, simulated events and
# light contacts, eight series).
AHEAD = 2.0
MOST_STEPS = 100
PRIOR_TOUCHES = 0.5  # the prior counts as much as these
COMMON_TOUCHES = 2.0  # that the weight common to all scales counts as
LEAST_COMMON = 1e-3  # of the prior


@dataclass(frozen=True)
class Calibration:
    """How the scores and distances of one stage are to be read.

    weights: of the scores of the S scales that fit at the stage, shape (S,), ≥ 0.
    scale_novelty: mean and spread of the novelty of known materials at each scale that measures it, shape (S', 2).
    novelties: sorted standardised novelty of known, left-out touches, shape (touches,).
    median_distances: the median diagonal distance of known touches at each scale, shape (S,); infinite where every
    touch counts alike.
    """

    weights: FloatArray
    scale_novelty: FloatArray
    novelties: FloatArray
    median_distances: FloatArray

    def weights_at(self, distances: FloatArray) -> FloatArray:
        """The weights of the scales for touches at some diagonal distances, both of shape (…, S)."""
        return np.asarray(self.weights * np.minimum(1.0, self.median_distances / np.maximum(distances, TINY)))

    def relative(self, distances: FloatArray) -> FloatArray:
        """Diagonal distances in units of the median of known touches, both of shape (…, S)."""
        with np.errstate(over="ignore"):  # where known touches are all the same
            return np.asarray(distances / np.maximum(self.median_distances, TINY))

    def novelty(self, distances: FloatArray) -> FloatArray:
        """Standardised novelty, shape (…,), of distances at the scales that measure it, shape (…, S')."""
        mean, spread = self.scale_novelty.T
        standard: FloatArray = ((distances - mean) / spread).mean(axis=-1)
        return standard

    def measures(self, false_alarms: float) -> bool:
        """Whether enough known touches were left out to say which novelty such a share of them exceeds."""
        return self._rank(false_alarms) <= len(self.novelties)

    def threshold(self, false_alarms: float) -> float:
        """The novelty that a share `false_alarms` of known touches exceeds, by the left-out ones."""
        if len(self.novelties) < FEWEST:
            return UNMEASURED
        if not self.measures(false_alarms):
            return float(2 * self.novelties[-1])
        return float(self.novelties[self._rank(false_alarms) - 1])

    def _rank(self, false_alarms: float) -> int:
        """Of the conformal quantile: of n + 1 exchangeable touches no more than this share lies above it."""
        return int(np.ceil((1 - false_alarms) * (len(self.novelties) + 1)))


TINY = 1e-300
UNMEASURED = 5.0  # spreads: where too little could be left out to measure the distances of known touches


def calibrate_stage(
    stage: int,
    materials: Sequence[str],
    scales: Sequence[tuple[Readout, HeldOutScores]],
    kind: ReadoutName,
    *,
    viewed: bool = False,
) -> Calibration:
    """Calibrate one stage.

    materials: of the sampled touches. scales: of those that judge, ascending, the readout and what it left out.
    viewed: whether a scale's weight falls with a touch's diagonal distance.
    """
    held_out = [left for _, left in scales]
    measuring = [(readout, left) for readout, left in scales if readout.scale.measures_novelty]
    names = common_names(held_out)
    touches = judged_touches(stage, held_out) if len(names) > 1 else []
    medians = np.full(len(held_out), np.inf)
    if not touches:
        unheld = np.full(len(held_out), _unheld(names, scales, kind))
        return Calibration(unheld, _assumed(measuring), np.zeros(0), medians)
    scores = np.stack([_picked(left, left.scores, names, touches, stage) for left in held_out], axis=1)
    measured = [_picked(left, left.distances, names, touches, stage).min(axis=1) for _, left in measuring]
    distances = np.stack(measured, axis=1)
    own = {name: i for i, name in enumerate(names)}
    if viewed:
        rows = [[left.rows[touch, stage] for touch in touches] for left in held_out]
        away = np.stack(
            [left.diagonal_distances[own_rows] for left, own_rows in zip(held_out, rows, strict=True)], axis=1
        )
        medians = np.median(away, axis=0)
        scores *= np.minimum(1.0, medians / np.maximum(away, TINY))[:, :, None]
    weights = scale_weights(scores, [own[materials[touch]] for touch in touches], PRIOR_WEIGHT[kind] / len(held_out))
    if len(distances) < FEWEST:
        return Calibration(weights, _assumed(measuring), np.zeros(0), medians)
    spread = np.maximum(distances.std(axis=0), 1e-9 * (1 + np.abs(distances).max(axis=0)))
    shape = np.stack([distances.mean(axis=0), spread], axis=1)
    unsorted = Calibration(weights, shape, np.zeros(0), medians).novelty(distances)
    # The mean of scales that agree only in part spreads less than one: back to units of its own spread.
    spread = shape[:, 1] * max(float(unsorted.std()), 1e-9)
    shape = np.stack([shape[:, 0], spread], axis=1)
    own_novelty = Calibration(weights, shape, np.zeros(0), medians).novelty(distances)
    return Calibration(weights, shape, np.sort(own_novelty), medians)


def common_names(held_out: Sequence[HeldOutScores]) -> list[str]:
    """The reference materials of all of some scales, in alphabetical order."""
    return sorted(set.intersection(*(set(left.names) for left in held_out)))


def judged_touches(stage: int, held_out: Sequence[HeldOutScores]) -> list[int]:
    """The sampled touches, by their place in the sample, that all of some scales left out at a stage."""
    found = [{touch for touch, reached in left.rows if reached == stage} for left in held_out]
    return sorted(set.intersection(*found))


def _picked(left: HeldOutScores, values: FloatArray, names: list[str], touches: list[int], stage: int) -> FloatArray:
    """The values of some touches at a stage for some of the materials, shape (touches, names)."""
    own = {name: i for i, name in enumerate(left.names)}
    rows = np.array([left.rows[touch, stage] for touch in touches], dtype=np.intp)
    picked: FloatArray = values[np.ix_(rows, np.array([own[name] for name in names]))]
    return picked


def scale_weights(scores: FloatArray, targets: Sequence[int], prior: float) -> FloatArray:
    """The weights of scales, each drawn to the one that all have in common, as of `fit_weights`; prior: of that one."""
    common = fit_weights(scores.sum(axis=1, keepdims=True), targets, np.array([prior]))
    drawn_to = np.repeat(np.maximum(common, LEAST_COMMON * prior), scores.shape[1])
    return fit_weights(scores, targets, drawn_to, COMMON_TOUCHES)


def fit_weights(
    scores: FloatArray,
    targets: Sequence[int],
    prior: FloatArray,
    touches: float = PRIOR_TOUCHES,
    counts: FloatArray | None = None,
) -> FloatArray:
    """Weights ≥ 0 of least log loss, a convex problem, drawn to the prior where touches are few.

    scores: of touches left out, shape (touches, scales, classes). targets: the class of each. touches: that the prior
    counts as. counts: how many touches each of them stands for, shape (touches,); 1 unless given.
    """
    counted = np.ones(len(scores)) if counts is None else counts
    gap = scores - np.take_along_axis(scores, np.array(targets)[:, None, None], axis=2)

    def loss(weights: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        logits = np.einsum("tsc,s->tc", gap, weights)
        top = logits.max(axis=1, keepdims=True)
        chances = np.exp(logits - top)
        total = chances.sum(axis=1, keepdims=True)
        chances /= total
        mean = np.einsum("tsc,tc->ts", gap, chances)
        chances *= counted[:, None]
        pull = weights / prior - 1
        value = float(counted @ (np.log(total) + top)[:, 0]) + touches * float(pull @ pull) / 2
        curve = np.einsum("tsc,trc,tc->sr", gap, gap, chances, optimize=True) - mean.T @ (counted[:, None] * mean)
        return value, counted @ mean + touches * pull / prior, curve + np.diag(touches / prior**2)

    # Newton's steps, projected (Bertsekas 1982), in one to three weights: scipy.optimize is 20 MB and a tenth of a
    # second to import, of the quarter of a second in which a memory that was just opened answers.
    weights = prior
    value, slope, curve = loss(weights)
    for _ in range(MOST_STEPS):
        free = (weights > 0) | (slope < 0)
        step = np.zeros_like(weights)
        step[free] = np.linalg.solve(curve[np.ix_(free, free)], slope[free])
        if float(slope @ step) <= 1e-13 * (1 + abs(value)):
            break
        size = 1.0
        while True:
            tried = np.maximum(weights - size * step, 0.0)
            after = loss(tried)
            if after[0] <= value - 1e-4 * float(slope @ (weights - tried)) or size < 1e-9:
                break
            size /= 2
        weights, (value, slope, curve) = tried, after
    return weights


def _unheld(names: Sequence[str], scales: Sequence[tuple[Readout, HeldOutScores]], kind: ReadoutName) -> float:
    """The weight of each scale where no touch can be left out, most materials having one.

    Within-class scatter is then that within a touch alone, and touches of a material differ by far more: how far the
    scores are to weigh nothing says but the scores between the materials. So a touch that is the mean of its
    material is ahead by so many logits, and what lies between two materials is as likely to be either.
    """
    share = PRIOR_WEIGHT[kind] / len(scales)
    if kind == "ridge" or len(names) < 2:  # a ridge's scores are of targets of 0 and 1
        return share
    ahead = np.zeros((len(names), len(names)))
    for readout, left in scales:
        own = [left.names.index(name) for name in names]
        gram = readout.derived().gram[np.ix_(own, own)]
        sizes = np.diagonal(gram)
        ahead += (sizes[:, None] + sizes - 2 * gram) / 2
    np.fill_diagonal(ahead, np.inf)
    return min(share, AHEAD / max(float(np.median(ahead.min(axis=1))), TINY))


def _assumed(scales: Sequence[tuple[Readout, HeldOutScores]]) -> FloatArray:
    """Without touches left out: the distances of the class means themselves, spread by their own mean size."""
    shapes = []
    for readout, _ in scales:
        derived = readout.derived()
        sizes = np.diagonal(derived.gram)
        typical = np.einsum("ri,ij,rj->r", derived.gram, derived.background, derived.gram) - sizes
        shapes.append([float(typical.mean()), max(float(sizes.mean()), 1e-9) / UNMEASURED])
    return np.array(shapes)
