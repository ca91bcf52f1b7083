"""Calibration: from scores to probabilities, and from distances to novelty, by held-out touches.

Each sampled touch is scored by readouts that never observed it (`leave_one_out`). On these scores s one weight w_k a
scale is fitted, which is a temperature (Platt 1999; Guo et al. 2017,
arXiv 1706.04599):

    p_y = exp(Σ_k w_k s_ky) / Σ_z exp(Σ_k w_k s_kz),    w = argmin_{w ≥ 0} −Σ log p_target + ρ/2 Σ_k (w_k / w⁰_k − 1)²,

w⁰ the prior and ρ the number of touches that it counts as. First one weight common to all scales is fitted, then one
for each scale, with the common one as its prior. Scores of held-out touches are nearly collinear, and by themselves the
weights run into a corner: all on one scale, which a longer touch may distort. Where a touch is viewed in several ways,
a view has less weight the further the touch lies from its nearest material there: the view's scores count as min(1, u_k
/ r_k) s_k, r_k the squared Mahalanobis distance with diagonal scatter (`Readout.diagonal_distance`) and u_k its median
over held-out touches. So a view that a change of speed, zero or length has distorted leaves the decision to the others.

The novelty of known materials' touches is measured likewise, and an alarm's threshold is their conformal quantile (Vovk
et al. 2005). All of these are functions of the statistics and the sample, and so of the set of observed touches.

A second measure of novelty needs no materials, and finds what lies off the sampled touches in features in which no
material differs (`Neighbours`): the distance to the nearest of them beside the distances around that one, as local
outlier factors have it (Breunig, Kriegel, Ng and Sander 2000). With s the nearest sampled touch of x, N(s) its five
nearest others and |·| a distance by diagonal scatter,

    u(x) = log |x − s| − log mean_{r in N(s)} |s − r|.

Novelty is the mean of the relative Mahalanobis distances (Ren et al. 2021), at the scales that measure it, and of u at
the windows, each standardised by held-out touches: weights that were fitted to these gained hardly more.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.leave_one_out import Sampled, StageScores, rows_at
from scroll_tactile.readouts.readout import Readout, ReadoutName
from scroll_tactile.signals.windows import Scale, measuring
from scroll_tactile.statistics.moments import one_thread

__all__ = [
    "AHEAD",
    "FEWEST",
    "PRIOR_WEIGHT",
    "UNMEASURED",
    "Calibration",
    "HeldOutProbabilities",
    "Neighbours",
    "NoveltyThresholds",
    "calibrate_stage",
    "fit_weights",
    "held_out_probabilities",
    "novelty_measures",
    "scale_weights",
]

FloatArray = npt.NDArray[np.float64]

FEWEST = 8  # held-out touches; with fewer, a stage keeps the threshold and the spreads set beforehand
PRIOR_WEIGHT = {
    "lda": 0.1,
    "ridge": 10.0,
}  # of the scores of all scales together, about as fitted on both sensors' data
# Logits by which the mean of a material leads the next one where no touch can be held out, see
# `_weight_without_held_out`. With one touch of each, log loss was least from 1.5 to 2 on fifteen sets (BioTac,
# RoboSkin, letters, simulated events and light contacts, eight series).
AHEAD = 2.0
MOST_STEPS = 100
PRIOR_TOUCHES = 0.5  # the prior counts as so many touches
COMMON_TOUCHES = 2.0  # the common weight counts as so many, as the prior of each scale's
LEAST_COMMON = 1e-3  # of the prior


@dataclass(frozen=True)
class NoveltyThresholds:
    """Up to which novelty a touch counts as one of its material, and below which as one that is known.

    A material has a threshold of its own where OWN of its held-out touches are expected above it, 40 at 5 %. The others
    share one, of all held-out touches, in which each material counts alike: else a material of hundreds of touches sets
    it, and those of a dozen, which are known less well, are called new. Both are conformal quantiles, and hold for
    touches that are exchangeable with the sampled ones: not for another run, speed or sensor.

    names: the materials, ascending. targets: the place of each held-out touch's material among them, (N,). novelties:
    standardised novelty of these touches, (N,). if_new: the same had their own materials never been observed, (N,).
    """

    names: Sequence[str] = ()
    targets: npt.NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    novelties: FloatArray = field(default_factory=lambda: np.zeros(0))
    if_new: FloatArray = field(default_factory=lambda: np.zeros(0))

    def above(self, material: str, false_alarms: float) -> float:
        """The novelty above which a touch that is answered `material` is new: a share `false_alarms` of known ones.

        Of "", and of a material with few touches, that which all share.
        """
        if len(self.novelties) < FEWEST:
            return UNMEASURED
        own = self.novelties[self.targets == (self.names.index(material) if material in self.names else -1)]
        if len(own) * false_alarms >= OWN:
            return _conformal(own, np.ones(len(own)), false_alarms)
        found = _conformal(self.novelties, self._alike, false_alarms)
        return found if np.isfinite(found) else 2 * float(self.novelties.max())

    def below(self, false_alarms: float) -> float:
        """The novelty below which a touch is known: no larger a share of new ones lies there.

        New ones are the held-out touches without their materials. -inf where these are too few, or of one material.
        """
        if len(np.unique(self.targets)) < 2:
            return -np.inf
        return -_conformal(-self.if_new, self._alike, false_alarms)

    def detects(self, false_alarms: float) -> bool:
        """Whether most touches would lie above the shared threshold, had their materials never been observed."""
        return np.isfinite(self.below(false_alarms)) and float(np.median(self.if_new)) > self.above("", false_alarms)

    @cached_property
    def _alike(self) -> FloatArray:
        """Weights of the touches, each material's of one sum and all together of N."""
        counts = np.bincount(self.targets)
        return np.asarray(len(self.targets) / (np.count_nonzero(counts) * counts[self.targets]))


@dataclass(frozen=True)
class Calibration:
    """How the scores and distances of one stage are to be read.

    weights: of the scores of the S scales that fit at the stage, shape (S,), ≥ 0.
    scale_novelty: mean and spread of the measures of novelty over known materials, shape (S', 2): the distance at each
    scale that measures it, then u at each scale that has `Neighbours`.
    median_distances: the median diagonal distance of known touches at each scale, shape (S,); infinite where every
    touch counts alike.
    thresholds: of the novelty of known touches, as far as any were held out.
    """

    weights: FloatArray
    scale_novelty: FloatArray
    median_distances: FloatArray
    thresholds: NoveltyThresholds = field(default_factory=NoveltyThresholds)

    def weights_at(self, distances: FloatArray) -> FloatArray:
        """The weights of the scales for touches at some diagonal distances, both of shape (…, S)."""
        return np.asarray(self.weights * np.minimum(1.0, self.median_distances / np.maximum(distances, TINY)))

    def with_all_touches(self, touches: float) -> Calibration:
        """How touches to come are read; touches: k, the median number of those materials that have two or more.

        Weights are fitted to scores of touches held out, by means of the k − 1 others. New ones are scored by means of
        k, and more surely: their weights are (k / (k − 1))^¾ times as large, a power that was best on average, from two
        touches of a material to ten, on sixteen sets.
        """
        return replace(self, weights=self.weights * (touches / (touches - 1)) ** SURER) if touches > 1 else self

    def relative(self, distances: FloatArray) -> FloatArray:
        """Diagonal distances in units of the median of known touches, both of shape (…, S)."""
        with np.errstate(over="ignore"):  # where known touches are all the same
            return np.asarray(distances / np.maximum(self.median_distances, TINY))

    def novelty(self, distances: FloatArray) -> FloatArray:
        """Standardised novelty, shape (…,), of its measures, shape (…, S')."""
        mean, spread = self.scale_novelty.T
        standard: FloatArray = ((distances - mean) / spread).mean(axis=-1)
        return standard


def _conformal(values: FloatArray, weights: FloatArray, share: float) -> float:
    """The least value above which no more than this share of the weight lies, with a new one's of 1; inf if none is.

    Of weights that are equal it is the conformal quantile: of n + 1 exchangeable values the new one lies above it with
    no larger probability. Weighted ones: Tibshirani, Foygel Barber, Candès and Ramdas 2019, arXiv 1904.06019.
    """
    order = np.argsort(-values, kind="stable")
    above = np.concatenate([[0.0], np.cumsum(weights[order])[:-1]])
    allowed = share * (weights.sum() + 1) - 1
    within = int(np.count_nonzero(above <= allowed + 1e-9 * weights.sum()))
    return float(values[order[within - 1]]) if within else np.inf


class Neighbours:
    """The rows of one scale that sampled touches have at one stage, among which a touch lies near one or near none.

    readout: of the scale. sample: of which the calibration is made. stages: the scales that judge at each. stage: whose
    rows. Rows are scaled to a spread of 1 within materials and held in single precision: 1 MB of 256 touches.

    places: of the touches among the sample that have such a row, ascending. names: their materials.
    """

    def __init__(self, readout: Readout, sample: Sampled, stages: Sequence[Sequence[Scale]], stage: int) -> None:
        self._origin, self._scale, self._read = (
            readout.origin,
            np.sqrt(readout.precision),
            (stages, readout.scale, stage),
        )
        self.places, self.names, rows = self._rows_of(sample)
        self._rows = self._scaled(rows)
        self._sizes = np.square(self._rows).sum(axis=1)
        # Nearer than it is rounded no distance is told from 0.
        self._least = max(1e-6 * float(self._sizes.mean()), TINY) if len(rows) else TINY
        self._between = self._distances(self._rows)
        np.fill_diagonal(self._between, np.inf)
        self._around = np.log(_mean_of_nearest(self._between))

    def _rows_of(self, sample: Sampled) -> tuple[list[int], list[str], npt.NDArray[np.int32]]:
        """The places of touches that have such a row, their materials, and the rows, (N, d)."""
        stages, scale, stage = self._read
        found = [
            (place, material, touch.rows[row])
            for place, (material, _, touch) in enumerate(sample)
            for row in rows_at(touch, stages, scale)
            if touch.pairs[row, 0] == stage
        ]
        rows = np.array([row for *_, row in found], dtype=np.int32).reshape(len(found), len(self._origin))
        return [place for place, *_ in found], [material for _, material, _ in found], rows

    def extended(self, sample: Sampled) -> Neighbours:
        """These and touches that were sampled since, which are never held out."""
        _, names, rows = self._rows_of(sample)
        other, scaled = copy.copy(self), self._scaled(rows)
        other.names, other._rows = [*self.names, *names], np.concatenate([self._rows, scaled])
        other._sizes = np.square(other._rows).sum(axis=1)
        far = other._distances(scaled)
        other._between = np.block([[self._between, far[:, : len(self.names)].T], [far]])
        np.fill_diagonal(other._between, np.inf)
        other._around = np.log(_mean_of_nearest(other._between))
        return other

    def novelty(self, features: FloatArray, names: Collection[str] | None = None) -> float:
        """u of features in grid units, (d,). names: materials of whose touches one is the nearest; all unless given."""
        distances = self._distances(self._scaled(features[None]))
        if names is not None:
            left_out = np.array([[name not in names for name in self.names]])
            return float(self._local(distances, left_out)[0])
        near = int(distances.argmin())
        around = float(self._around[near])
        return math.log(distances[0, near]) - around if math.isfinite(around) else 0.0

    def held_out(self, places: Sequence[int], queries: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """u of sampled touches, each left out, (N,), and the same without all touches of their materials, (N,).

        places: of these touches in the sample. queries: features in grid units that stand for theirs, (N, d).
        """
        at = np.searchsorted(self.places, places)
        distances = self._between[at] if queries is None else self._distances(self._scaled(queries))
        kinds = np.unique(self.names, return_inverse=True)[1]
        itself = at[:, None] == np.arange(len(self.places))
        return self._local(distances, itself), self._local(distances, kinds[at][:, None] == kinds)

    def _local(self, distances: FloatArray, left_out: npt.NDArray[np.bool_]) -> FloatArray:
        """u by distances (N, M) from rows, of which some are left out for each, (N, M); 0 where all are but one."""
        seen = np.where(left_out, np.inf, distances)
        near = seen.argmin(axis=1)
        around = _mean_of_nearest(np.where(left_out, np.inf, self._between[near]))
        least = np.where(np.isfinite(around), seen[np.arange(len(near)), near], 1.0)
        return np.asarray(np.log(least) - np.log(np.where(np.isfinite(around), around, 1.0)))

    def _scaled(self, features: npt.NDArray[np.number]) -> npt.NDArray[np.float32]:
        return np.asarray((features - self._origin) * self._scale, dtype=np.float32)

    def _distances(self, rows: npt.NDArray[np.float32]) -> FloatArray:
        """Distances of scaled rows (N, d) from all rows, (N, M)."""
        with one_thread():
            products = rows @ self._rows.T
        squares = np.square(rows).sum(axis=1)[:, None] + self._sizes - 2 * products
        return np.asarray(np.sqrt(np.maximum(squares, self._least, dtype=np.float64)))


def _mean_of_nearest(distances: FloatArray) -> FloatArray:
    """The mean of the NEAREST least distances of each row that are finite, (N,); infinite where none is."""
    few = np.partition(distances, NEAREST, axis=1)[:, :NEAREST] if distances.shape[1] > NEAREST else distances
    nearest = np.sort(few, axis=1)
    there = np.isfinite(nearest)
    count = there.sum(axis=1)
    mean = np.where(there, nearest, 0.0).sum(axis=1) / np.maximum(count, 1)
    return np.asarray(np.where(count > 0, mean, np.inf))


SURER = 0.75
NEAREST = 5  # sampled touches around the nearest one; with 1, 3 or 10 it told new touches as well
OWN = 2.0  # held-out touches expected above a material's own threshold
TINY = 1e-300
UNMEASURED = 5.0  # spreads: where too few could be held out to measure the distances of known touches


def calibrate_stage(
    found: StageScores,
    readouts: Sequence[Readout],
    kind: ReadoutName,
    *,
    viewed: bool = False,
    neighbours: Sequence[Neighbours] = (),
) -> Calibration:
    """Calibrate one stage.

    found: the scores of held-out touches by each scale that judges. readouts: of these scales, in their order.
    viewed: whether a scale's weight falls with a touch's diagonal distance. neighbours: of the windows among the
    scales, at the same stage; where too few touches were held out, only distances measure novelty.
    """
    scales = len(readouts)
    novel = [readouts[place] for place in measuring([readout.scale for readout in readouts])]
    medians = np.full(scales, np.inf)
    if not found.places:
        unheld = np.full(scales, _weight_without_held_out(found.names, readouts, kind))
        return Calibration(unheld, _assumed(novel), medians)
    scores = found.scores()
    if viewed:
        away = found.diagonal_distances()
        medians = np.median(away, axis=0)
        scores *= np.minimum(1.0, medians / np.maximum(away, TINY))[:, :, None]
    weights = scale_weights(scores, found.targets.tolist(), PRIOR_WEIGHT[kind] / scales)
    if len(found.places) < FEWEST:
        return Calibration(weights, _assumed(novel), medians)
    measures, if_new = novelty_measures(found, neighbours)
    spread = np.maximum(measures.std(axis=0), 1e-9 * (1 + np.abs(measures).max(axis=0)))
    shape = np.stack([measures.mean(axis=0), spread], axis=1)
    unsorted = Calibration(weights, shape, medians).novelty(measures)
    # The mean over measures that are not fully correlated has a spread below 1: rescale it to 1.
    shape[:, 1] *= max(float(unsorted.std()), 1e-9)
    scaled = Calibration(weights, shape, medians)
    known, new = scaled.novelty(measures), scaled.novelty(if_new)
    thresholds = NoveltyThresholds(found.names, found.targets, known, new)
    return replace(scaled, thresholds=thresholds)


def novelty_measures(found: StageScores, neighbours: Sequence[Neighbours]) -> tuple[FloatArray, FloatArray]:
    """What the novelty of N held-out touches is measured by, and the same had their own materials never been observed.

    Both (N, S'): the least distance at each scale that measures novelty, then u among neighbours.
    """
    local = [each.held_out(found.places) for each in neighbours]
    known, new = found.distances().min(axis=2, initial=np.inf), found.distances_if_new()
    return np.column_stack([known, *(u for u, _ in local)]), np.column_stack([new, *(u for _, u in local)])


@dataclass(frozen=True)
class HeldOutProbabilities:
    """Probabilities of the C materials that all scales know, for N sampled touches, each held out.

    names, places, keys, targets: see `StageScores`. logs: log-probability of the materials, (N, C). distance: the least
    diagonal distance at any scale that measures novelty, in units of the median, (N,). novelty: see `Prediction`, (N,).
    """

    names: list[str]
    places: list[int]
    keys: list[bytes]
    targets: npt.NDArray[np.intp]
    logs: FloatArray
    distance: FloatArray
    novelty: FloatArray


def held_out_probabilities(
    found: StageScores, scales: Sequence[Scale], calibration: Calibration, neighbours: Sequence[Neighbours] = ()
) -> HeldOutProbabilities:
    """The probabilities by some scales of the touches held out of them, as they are calibrated; by the same ones."""
    diagonal, scores = found.diagonal_distances(), found.scores()
    weights = calibration.weights_at(diagonal)
    logits, distance, novelty = np.zeros((len(found.places), len(found.names))), np.zeros(0), np.zeros(0)
    for place in range(len(scales)):
        logits += weights[:, place, None] * scores[:, place]
    logits -= logits.max(axis=1, keepdims=True) if found.names else 0.0
    logits -= np.log(np.exp(logits).sum(axis=1, keepdims=True))
    if found.places:
        distance = calibration.relative(diagonal)[:, measuring(scales)].min(axis=1)
        measures, _ = novelty_measures(found, neighbours)
        # With too few held-out touches the calibration has no u.
        novelty = calibration.novelty(measures[:, : len(calibration.scale_novelty)])
    return HeldOutProbabilities(found.names, found.places, found.keys, found.targets, logits, distance, novelty)


def scale_weights(scores: FloatArray, targets: Sequence[int], prior: float) -> FloatArray:
    """The weights of scales, each drawn to the one that all have in common, as of `fit_weights`; prior: of that one."""
    common = fit_weights(scores.sum(axis=1, keepdims=True), targets, np.array([prior]))
    drawn_to = np.repeat(np.maximum(common, LEAST_COMMON * prior), scores.shape[1])
    return fit_weights(scores, targets, drawn_to, COMMON_TOUCHES)


def fit_weights(
    scores: FloatArray, targets: Sequence[int], prior: FloatArray, touches: float = PRIOR_TOUCHES
) -> FloatArray:
    """Weights ≥ 0 of least log loss, a convex problem, drawn to the prior where touches are few.

    scores: of held-out touches, shape (touches, scales, classes). targets: the class of each. touches: how many the
    prior counts as.
    """
    gap = scores - np.take_along_axis(scores, np.array(targets)[:, None, None], axis=2)

    def loss(weights: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        logits = np.einsum("tsc,s->tc", gap, weights)
        top = logits.max(axis=1, keepdims=True)
        chances = np.exp(logits - top)
        total = chances.sum(axis=1, keepdims=True)
        chances /= total
        mean = np.einsum("tsc,tc->ts", gap, chances)
        pull = weights / prior - 1
        value = float((np.log(total) + top).sum()) + touches * float(pull @ pull) / 2
        curve = np.einsum("tsc,trc,tc->sr", gap, gap, chances, optimize=True) - mean.T @ mean
        return value, mean.sum(axis=0) + touches * pull / prior, curve + np.diag(touches / prior**2)

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


def _weight_without_held_out(names: Sequence[str], readouts: Sequence[Readout], kind: ReadoutName) -> float:
    """The weight of each scale where no touch can be held out, most materials having one.

    Within-class scatter is then that within single touches, and touches of one material differ by far more. So only the
    distances between the materials can set the weight: a touch at the mean of its material gets AHEAD logits more than
    the next material, and one halfway between two materials is as likely to be either.
    """
    share = PRIOR_WEIGHT[kind] / len(readouts)
    if kind == "ridge" or len(names) < 2:  # a ridge's scores are of targets of 0 and 1
        return share
    ahead = np.zeros((len(names), len(names)))
    for readout in readouts:
        own = [readout.places[name] for name in names]
        gram = readout.derived().gram[np.ix_(own, own)]
        sizes = np.diagonal(gram)
        ahead += (sizes[:, None] + sizes - 2 * gram) / 2
    np.fill_diagonal(ahead, np.inf)
    return min(share, AHEAD / max(float(np.median(ahead.min(axis=1))), TINY))


def _assumed(readouts: Sequence[Readout]) -> FloatArray:
    """Mean and spread of novelty where too few touches are held out: from the distances of the class means alone."""
    shapes = []
    for readout in readouts:
        derived = readout.derived()
        sizes = np.diagonal(derived.gram)
        typical = np.einsum("ri,ij,rj->r", derived.gram, derived.background, derived.gram) - sizes
        shapes.append([float(typical.mean()), max(float(sizes.mean()), 1e-9) / UNMEASURED])
    return np.array(shapes)
