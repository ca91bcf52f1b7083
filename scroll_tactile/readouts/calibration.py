"""Calibration: from scores to probabilities, and from distances to novelty, by held-out touches.

Each sampled touch is scored by readouts that never observed it (`leave_one_out`). On these scores s one weight w_k a
scale is fitted, which is a temperature (Platt 1999; Guo et al. 2017, arXiv 1706.04599):

    p_y = exp(Σ_k w_k s_ky) / Σ_z exp(Σ_k w_k s_kz),    w = argmin_{w ≥ 0} −Σ log p_target + ρ/2 Σ_k (w_k / w⁰_k − 1)²,

w⁰ the prior, counted as ρ touches: first one weight common to all scales, then one for each, with the common one as its
prior, for scores of several scales are nearly collinear. A view has less weight the further the touch lies from its
nearest material there: its scores count as min(1, u_k / r_k) s_k, r_k the distance by diagonal scatter and u_k its
median over held-out touches. So a view that a change of speed, zero or length has distorted leaves the decision to the
others. Novelty is the mean of its measures (`novelty`), each standardised by held-out touches.

Touches of one material err alike. With ρ the correlation of two, k count as k / (1 + (k − 1) ρ) (the design effect;
Kish 1965) in their log-probabilities and, with ρ', in their standardised novelty:

    log p = Σ_i log p_i / (1 + (k − 1) ρ) + constant,    novelty = Σ_i novelty_i / √(k (1 + (k − 1) ρ')).

ρ is fitted to pairs of held-out touches, by least log loss, and ρ' is their intraclass correlation (Fisher 1925).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.leave_one_out import StageScores
from scroll_tactile.readouts.novelty import FEWEST, TINY, UNMEASURED, Neighbours, NoveltyThresholds, novelty_measures
from scroll_tactile.readouts.readout import Readout, ReadoutName
from scroll_tactile.signals.windows import Scale, measuring

__all__ = [
    "AHEAD",
    "Calibration",
    "Dependence",
    "calibrate_stage",
    "dependence_of",
    "fit_weights",
    "softmax",
    "tempered",
]

FloatArray = npt.NDArray[np.float64]

PRIOR_WEIGHT = {"lda": 0.1, "ridge": 10.0}  # of the scores of all scales together, about as fitted on both sensors
# Logits by which the mean of a material leads the next one where no touch can be held out. With one touch of each, log
# loss was least from 1.5 to 2 on fifteen sets (BioTac, RoboSkin, letters, simulated events, contacts, eight series).
AHEAD = 2.0
MOST_STEPS = 100
PRIOR_TOUCHES = 0.5  # the prior counts as so many touches
COMMON_TOUCHES = 2.0  # the common weight counts as so many, as the prior of each scale's
LEAST_COMMON = 1e-3  # of the prior
CORRELATION = 0.25  # ρ and ρ' where nothing is measured: about that of prefixes of BioTac's touches
PRIOR_PAIRS = 2.0  # the prior of ρ counts as so many


@dataclass(frozen=True)
class Calibration:
    """How the scores and distances of one stage are to be read.

    weights: of the scores of the S scales that judge, (S,), ≥ 0. scale_novelty: mean and spread of the measures of
    novelty of known touches, (S', 2); thresholds: of it, as far as any were held out. median_distances: the median
    diagonal distance of known touches at each scale, (S,); infinite where every touch counts alike.
    """

    weights: FloatArray
    scale_novelty: FloatArray
    median_distances: FloatArray
    thresholds: NoveltyThresholds = field(default_factory=NoveltyThresholds)

    def weights_at(self, distances: FloatArray) -> FloatArray:
        """The weights of the scales for touches at some diagonal distances, both of shape (…, S)."""
        return np.asarray(self.weights * np.minimum(1.0, self.median_distances / np.maximum(distances, TINY)))

    def relative(self, distances: FloatArray) -> FloatArray:
        """Diagonal distances in units of the median of known touches, both of shape (…, S)."""
        with np.errstate(over="ignore"):  # where known touches are all the same
            return np.asarray(distances / np.maximum(self.median_distances, TINY))

    def novelty(self, measures: FloatArray) -> FloatArray:
        """Standardised novelty, shape (…,), by its measures, shape (…, S')."""
        mean, spread = self.scale_novelty.T
        return np.asarray(((measures - mean) / spread).mean(axis=-1))

    def held_out(self, found: StageScores, scales: Sequence[Scale]) -> tuple[FloatArray, FloatArray]:
        """Log-probabilities, (N, C), of touches held out of these scales, and their least relative distance, (N,)."""
        away = found.diagonal_distances()
        logits = np.einsum("ns,nsc->nc", self.weights_at(away), found.scores())
        logits -= logits.max(axis=1, keepdims=True, initial=-np.inf)
        logits -= np.log(np.exp(logits).sum(axis=1, keepdims=True))
        return logits, self.relative(away)[:, measuring(scales)].min(axis=1)


def calibrate_stage(
    found: StageScores,
    readouts: Sequence[Readout],
    kind: ReadoutName,
    *,
    viewed: bool = False,
    neighbours: Sequence[Neighbours] = (),
) -> Calibration:
    """Calibrate one stage by touches held out of some readouts, in their order.

    viewed: whether a scale's weight falls with a touch's diagonal distance. neighbours: of the windows among the
    scales, at the same stage; where too few touches were held out, only distances measure novelty.
    """
    scales, medians = [readout.scale for readout in readouts], np.full(len(readouts), np.inf)
    if found.places:
        scores = found.scores()
        if viewed:
            away = found.diagonal_distances()
            medians = np.median(away, axis=0)
            scores *= np.minimum(1.0, medians / np.maximum(away, TINY))[:, :, None]
        weights = scale_weights(scores, found.targets, PRIOR_WEIGHT[kind] / len(scales))
    else:
        weights = np.full(len(scales), _weight_without_held_out(found.names, readouts, kind))
    if len(found.places) < FEWEST:
        return Calibration(weights, np.array([_assumed(readouts[i]) for i in measuring(scales)]), medians)
    measures, if_new = novelty_measures(found, neighbours)
    mean, spread = measures.mean(axis=0), np.maximum(measures.std(axis=0), 1e-9 * (1 + np.abs(measures).max(axis=0)))
    # The mean over measures that are not fully correlated has a spread below 1: rescale it to 1.
    spread *= max(float(((measures - mean) / spread).mean(axis=1).std()), 1e-9)
    made = Calibration(weights, np.stack([mean, spread], axis=1), medians)
    known = NoveltyThresholds(found.names, found.targets, made.novelty(measures), made.novelty(if_new))
    return replace(made, thresholds=known)


def scale_weights(scores: FloatArray, targets: npt.ArrayLike, prior: float) -> FloatArray:
    """The weights of scales, each drawn to the one that all have in common, as of `fit_weights`; prior: of that one."""
    common = fit_weights(scores.sum(axis=1, keepdims=True), targets, np.array([prior]))
    common = np.maximum(common, LEAST_COMMON * prior)
    return fit_weights(scores, targets, np.repeat(common, scores.shape[1]), COMMON_TOUCHES)


def fit_weights(
    scores: FloatArray,
    targets: npt.ArrayLike,
    prior: FloatArray,
    touches: float = PRIOR_TOUCHES,
    start: FloatArray | float = 1.0,
    least: FloatArray | float = 0.0,
) -> FloatArray:
    """Weights of least log loss, a convex problem, drawn to the prior where touches are few.

    scores: of held-out touches, (touches, scales, classes). targets: the class of each. touches: how many the prior
    counts as. start, least: the prior, and what the weights are at least, in units of `prior`.
    """
    own = np.take_along_axis(scores, np.asarray(targets, np.intp)[:, None, None], axis=2)
    gap = (scores - own) * prior[:, None]

    def loss(weights: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        logits = np.einsum("tsc,s->tc", gap, weights)
        top = logits.max(axis=1, keepdims=True)
        chances = np.exp(logits - top)
        total = chances.sum(axis=1, keepdims=True)
        chances /= total
        mean, pull = np.einsum("tsc,tc->ts", gap, chances), weights - start
        value = float((np.log(total) + top).sum()) + touches * float(pull @ pull) / 2
        curve = np.einsum("tsc,trc,tc->sr", gap, gap, chances, optimize=True) - mean.T @ mean
        return value, mean.sum(axis=0) + touches * pull, curve + touches * np.eye(len(prior))

    # Newton's steps, projected (Bertsekas 1982), in a few weights: scipy.optimize is 20 MB, and a tenth of a second to
    # import of the quarter of one in which a memory that was just opened answers.
    weights = start + np.zeros(len(prior))
    value, slope, curve = loss(weights)
    for _ in range(MOST_STEPS):
        free, step = (weights > least) | (slope < 0), np.zeros(len(prior))
        step[free] = np.linalg.solve(curve[np.ix_(free, free)], slope[free])
        if float(slope @ step) <= 1e-13 * (1 + abs(value)):
            break
        size, tried = 1.0, np.maximum(weights - step, least)
        while (after := loss(tried))[0] > value - 1e-4 * float(slope @ (weights - tried)) and size >= 1e-9:
            size /= 2
            tried = np.maximum(weights - size * step, least)
        weights, (value, slope, curve) = tried, after
    return np.asarray(prior * weights)


def _weight_without_held_out(names: Sequence[str], readouts: Sequence[Readout], kind: ReadoutName) -> float:
    """The weight where no touch can be held out: by it a material's own mean gets AHEAD logits more than the next one.

    Scatter is then that within single touches, and touches of one material differ by far more.
    """
    share = PRIOR_WEIGHT[kind] / len(readouts)
    if kind == "ridge" or len(names) < 2:  # a ridge's scores are of targets of 0 and 1
        return share
    ahead = np.diag(np.full(len(names), np.inf))
    for readout in readouts:
        own = [readout.places[name] for name in names]
        gram = readout.derived().gram[np.ix_(own, own)]
        ahead += (np.diagonal(gram)[:, None] + np.diagonal(gram) - 2 * gram) / 2
    return min(share, AHEAD / max(float(np.median(ahead.min(axis=1))), TINY))


def _assumed(readout: Readout) -> tuple[float, float]:
    """Mean and spread of a distance where too few touches are held out: from those of the class means alone."""
    gram, background = readout.derived().gram, readout.derived().background
    sizes = np.diagonal(gram)
    typical = np.einsum("ri,ij,rj->r", gram, background, gram) - sizes
    return float(typical.mean()), max(float(sizes.mean()), 1e-9) / UNMEASURED


@dataclass(frozen=True)
class Dependence:
    """Correlations of two touches of one material, from 0 to 1: ρ of their log-probabilities, ρ' of their novelties."""

    log_probability: float = CORRELATION
    novelty: float = CORRELATION

    def probability(self, chances: Sequence[FloatArray]) -> FloatArray:
        """The probability of the candidates, (C,), from those by each touch."""
        # math.fsum is exact before it rounds: any order of the touches gives the same bits.
        logs = np.log(np.maximum(np.array(chances), TINY))
        logits = np.array([math.fsum(column) for column in logs.T]) / (1 + (len(logs) - 1) * self.log_probability)
        return softmax(logits)

    def standard(self, novelties: Sequence[float]) -> float:
        """The novelty of all together, in standard deviations of that of known materials' touches."""
        count = len(novelties)
        return math.fsum(novelties) / math.sqrt(count * (1 + (count - 1) * self.novelty))


def dependence_of(
    keys: Sequence[bytes], targets: npt.NDArray[np.intp], logs: FloatArray, novelties: FloatArray
) -> Dependence:
    """Fit both to N held-out touches; fewer than FEWEST may be without novelties. keys: their content hashes."""
    order = np.array(sorted(range(len(keys)), key=keys.__getitem__), dtype=np.intp)
    groups = [order[targets[order] == target] for target in np.unique(targets)]
    several = [group for group in groups if len(group) > 1]
    pairs = np.array([pair for group in several for pair in zip(group[::2], group[1::2], strict=False)], dtype=np.intp)
    if len(pairs) < FEWEST or len(groups) < 2:
        return Dependence()
    prior = np.array([1 / (1 + CORRELATION)])
    weight = float(fit_weights(logs[pairs].sum(axis=1)[:, None], targets[pairs[:, 0]], prior, PRIOR_PAIRS)[0])
    rho = float(np.clip(1 / max(weight, TINY) - 1, 0.0, 1.0))
    return Dependence(rho, _intraclass([novelties[group] for group in several]))


def _intraclass(groups: Sequence[FloatArray]) -> float:
    """The correlation within groups, two values or more in each, from 0 to 1."""
    if len(groups) < 2:
        return CORRELATION
    counts, means = np.array([(len(group), group.mean()) for group in groups]).T
    values, others = np.concatenate(groups), len(groups) - 1
    within = float(np.square(values - np.repeat(means, counts.astype(int))).sum()) / (len(values) - len(groups))
    between = float((counts * np.square(means - values.mean())).sum()) / others
    size = (len(values) - float(np.square(counts).sum()) / len(values)) / others
    share = (between - within) / max(between + (size - 1) * within, TINY)
    return float(np.clip(share, 0.0, 1.0))


def tempered(chances: FloatArray, outliers: float) -> FloatArray:
    """Probabilities (…, C) mixed with a uniform share, the rate of outliers."""
    return np.asarray((1 - outliers) * chances + outliers / chances.shape[-1])


def softmax(logits: FloatArray) -> FloatArray:
    """Probabilities (…, C) of logits."""
    chances = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return np.asarray(chances / chances.sum(axis=-1, keepdims=True))
