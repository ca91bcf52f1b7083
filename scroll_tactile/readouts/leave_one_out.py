"""Leave-one-out scores: each sampled touch is scored by a readout that never observed it.

A touch of k rows with mean x̄, of a material of n rows with mean m, adds to S_w the columns U: its rows about their mean
and the scaled shift √(n k / (n − k)) (x̄ − m). Without it K' = K − U Uᵀ, and m' = m − k / (n − k) (x̄ − m). Without its
whole material, but with what that scatters, the total scatter T = K + N Σ_y p_y (m_y − μ)(m_y − μ)ᵀ about the mean μ
loses U and a further column along m − μ; with what is left of the material it gains one along m' again. P and γ stay
as they are. From K', T' and the means left all scores follow by the definitions of `readout`, with

    ridge:     s_y = p_y + N p_y (m_y − μ)ᵀ T⁻¹ (x − μ),
    distance:  γ (x − m_y)ᵀ K⁻¹ (x − m_y) − γ (x − μ)ᵀ T⁻¹ (x − μ).

Where K = L Lᵀ the vectors L⁻¹ x of the R means and of a touch span few dimensions: all is taken between coordinates
there, in which K is the identity, and, of T, in those where T is. There columns change the inverse in one small
product, by Sherman, Morrison and Woodbury (1950; Bartlett 1951 for a row).

A held-out touch lies further from its own material than a new touch will. The squared distance to the mean of n touches
is expected to be (1 + 1/n) times the scatter for a new touch, and (1 + 1/(n − 1)) times for a held-out one of the n. So
it is multiplied by their ratio, 1 − 1/n²: calibration would otherwise expect new touches to look less like their own
material than they do. A heavily shrunk ridge returns little but the shares, so these stay those of all touches: without
the held-out one its material's would be lower, and calibration would give such scores no weight.

Where windows are learned one by one, the sample has fewer rows of a touch: these stand for all of them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.readout import Readout, ReadoutName
from scroll_tactile.readouts.triangle import contrasts
from scroll_tactile.signals.windows import Scale, measuring
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.sample import SampledTouch

__all__ = ["HeldOutScores", "Sampled", "StageScores", "held_out_scores", "rows_at"]

FloatArray = npt.NDArray[np.float64]
Sampled = Iterable[tuple[str, bytes, SampledTouch]]
"""Material, key and rows of the touches that readouts are calibrated on: a `TouchSample`, or what was copied of it."""

TOGETHER = 64  # touches: what is made of them and 256 materials takes some 100 MB


@dataclass(frozen=True)
class HeldOutScores:
    """Scores by one scale of the sampled touches, each held out: N rows, R reference materials.

    rows: (touch by its place in the sample, stage) → row. names: the reference materials. scores, z: shape (N, R), z
    about the mean. distances: shape (N, R), the relative Mahalanobis distance if that material is the nearest.
    distances_if_new: shape (N,), that of the nearest other material, had its own never been observed.
    diagonal_distances: shape (N,), see `Readout.diagonal_distance`, from the material of the highest score.
    """

    scale: Scale
    rows: dict[tuple[int, int], int]
    names: list[str]
    scores: FloatArray
    z: FloatArray
    distances: FloatArray
    distances_if_new: FloatArray
    diagonal_distances: FloatArray


class StageScores:
    """Scores by S scales at one stage of the N sampled touches that all of them held out.

    names: the C materials that are references of all scales, in alphabetical order. places: of the touches in the
    sample, ascending; none where there are fewer than two materials. keys: their content hashes. targets: the place of
    each one's material among the names, (N,).
    """

    def __init__(self, stage: int, sample: Sampled, held_out: Sequence[HeldOutScores]) -> None:
        self._held_out, touches = held_out, list(sample)
        self.names = sorted(set.intersection(*(set(one.names) for one in held_out)))
        reached = [{touch for touch, number in one.rows if number == stage} for one in held_out]
        self.places = sorted(set.intersection(*reached)) if len(self.names) > 1 else []
        self.keys = [touches[place][1] for place in self.places]
        self.targets = np.array([self.names.index(touches[place][0]) for place in self.places], dtype=np.intp)
        self._rows = [np.array([one.rows[place, stage] for place in self.places], dtype=np.intp) for one in held_out]
        self._columns = [np.array([one.names.index(name) for name in self.names], dtype=np.intp) for one in held_out]

    def scores(self) -> FloatArray:
        """Scores of the materials, (N, S, C)."""
        return self._picked([one.scores for one in self._held_out])

    def z(self) -> FloatArray:
        """z of the materials about their mean, (N, S, C)."""
        return self._picked([one.z for one in self._held_out])

    def distances(self) -> FloatArray:
        """The relative Mahalanobis distance if that material is the nearest, at the scales that measure novelty."""
        picked = self._picked([one.distances for one in self._held_out])
        # In one order in memory: the bits of a mean over touches depend on it.
        return np.ascontiguousarray(picked[:, measuring([one.scale for one in self._held_out])])

    def distances_if_new(self) -> FloatArray:
        """The relative distance had its own material never been observed; scales as of `distances`, (N, S')."""
        places = measuring([one.scale for one in self._held_out])
        return np.stack([self._held_out[i].distances_if_new[self._rows[i]] for i in places], axis=1)

    def diagonal_distances(self) -> FloatArray:
        """Diagonal distances from the material of the highest score, (N, S)."""
        found = [one.diagonal_distances[rows] for one, rows in zip(self._held_out, self._rows, strict=True)]
        return np.stack(found, axis=1)

    def _picked(self, values: Sequence[FloatArray]) -> FloatArray:
        found = zip(values, self._rows, self._columns, strict=True)
        return np.stack([own[np.ix_(rows, columns)] for own, rows, columns in found], axis=1)


def held_out_scores(
    readout: Readout,
    sample: Sampled,
    stages: Sequence[Sequence[Scale]],
    kind: ReadoutName,
    queries: Mapping[int, Mapping[int, FloatArray]] | None = None,
) -> HeldOutScores:
    """Leave each sampled touch out of the readout of a scale, as it was solved: no touch came to it since.

    stages: the scales that judge at each stage, ascending. queries: place of the touch in the sample →
    any number → mean features in grid units, (d,), scored in place of its own rows; the numbers then stand for stages.
    The result lacks touches that are the only one of their material.
    """
    names = readout.reference
    own = {name: place for place, name in enumerate(names)}
    index: dict[tuple[int, int], int] = {}
    groups = defaultdict[tuple[int, int], list[tuple[FloatArray, list[float], int, list[int]]]](list)
    for place, (material, _, touch) in enumerate(sample):
        judged = rows_at(touch, stages, readout.scale)
        asked = {} if queries is None else queries.get(place, {})
        numbers = touch.pairs[judged, 0].tolist() if queries is None else sorted(asked)
        if not judged or not numbers or material not in own:
            continue
        weight = float(max(touch.pairs[judged[0], 2], len(judged)))
        if readout.counts[own[material]] > weight:
            vectors = np.stack([*touch.rows[judged], *(asked[number] for number in numbers if asked)])
            at = [index.setdefault((place, number), len(index)) for number in numbers]
            groups[len(judged), len(at)].append((vectors - readout.origin, [weight], own[material], at))
    wide, flat = np.zeros((3, len(index), len(names))), np.zeros((2, len(index)))
    leaving = _Leaving(readout, kind, max((len(group[0][0]) for group in groups.values()), default=0))
    for (count, _), group in groups.items():
        for first in range(0, len(group), TOGETHER):
            vectors, weights, owners, at = map(np.array, zip(*group[first : first + TOGETHER], strict=True))
            wide[:, at], flat[:, at] = leaving.out(vectors, count, weights, owners)
    return HeldOutScores(readout.scale, index, names, *wide, *flat)


def rows_at(touch: SampledTouch, stages: Sequence[Sequence[Scale]], scale: Scale) -> list[int]:
    """The indices of a sampled touch's rows at a scale. stages: the scales that judge at each, ascending."""
    return [
        i for i, (stage, place, _) in enumerate(touch.pairs.tolist())
        if stage < len(stages) and place < len(stages[stage]) and stages[stage][place] == scale
    ]  # fmt: skip


class _Leaving:
    """Takes touches out of one readout as it was solved: M touches at once, in D coordinates.

    The first are in a basis of the whitened means, the others a touch's own, for so many vectors at most. whole: takes
    coordinates to those in which T is the identity.
    """

    def __init__(self, readout: Readout, kind: ReadoutName, vectors: int) -> None:
        self.readout, self.kind, self.plain = readout, kind, readout.means(slice(len(readout.reference)))
        self.counts = readout.counts[: len(self.plain)].astype(np.float64)
        # The total scatter is that of the reference materials, scaled to the rows of all materials.
        self.excess = float(readout.counts.sum() / self.counts.sum())
        with one_thread():
            self.basis, upper = np.linalg.qr(readout.triangle.times(self.plain).T)
            self.means = np.pad(upper.T, ((0, 0), (0, vectors)))
            self.center = readout.shares @ self.means
            spread = np.sqrt(self.excess * self.counts)[:, None] * (self.means - self.center)
            self.whole = np.linalg.inv(np.linalg.cholesky(np.eye(spread.shape[1]) + spread.T @ spread)).T

    def out(
        self, vectors: FloatArray, count: int, weights: FloatArray, own: npt.NDArray[np.intp]
    ) -> tuple[list[FloatArray], list[FloatArray]]:
        """Scores, z and distances without each touch, (M, q, R); its distance if new and the diagonal one, (M, q).

        vectors: about the origin, (M, n, d): so many rows that each touch added, then the q that are scored, or none
        where those rows are. weights: the rows of the statistics that it stands for, (M, 1). own: its material, (M,).
        """
        gamma, shares, is_own = self.readout.gamma, self.readout.shares, own[:, None] == np.arange(len(self.means))
        counts = self.counts[own, None]
        left, others = counts - weights, self.counts.sum() - counts
        with one_thread():
            x = self._coordinates(vectors)
            middle, mean = x[:, :count].mean(axis=1), self.means[own]
            back, away = weights / left * (middle - mean), mean - self.center
            means = self.means - is_own[:, :, None] * back[:, None]
            inner = np.sqrt(weights / count)[:, :, None] * (contrasts(count) @ x[:, :count])
            gone = np.concatenate([inner, (np.sqrt(counts * left / weights) * back)[:, None]], axis=1)
            solved, sizes = _without(gone, x), _products(means, _without(gone, means))
            z, length = solved @ means.transpose(0, 2, 1), _products(x, solved)
            # T loses what the mean of the touch's material adds, and gets what it adds without the touch.
            past = counts / np.maximum(others, 1) * away  # from the mean of the other materials to that of all
            lost = np.sqrt(counts * (1 + counts / np.maximum(others, 1))) * away
            stays = np.sqrt(left * others / (left + others)) * (away + past - back)
            changes = np.concatenate([gone, self.excess**0.5 * np.stack([lost, stays], axis=1)], axis=1) @ self.whole
            center = self.center - weights / (left + others) * (middle - self.center)
            of_all, of_others = ((x - part[:, None]) @ self.whole for part in (center, self.center - past))
            onto = _without(changes, of_all, come=1)
            if_new = length - _products(of_others, _without(changes[:, :-1], of_others))
            scores = lda = gamma * (z - sizes[:, None] / 2)
            if self.kind == "ridge":
                fitted = (onto @ self.whole.T) @ (means - center[:, None]).transpose(0, 2, 1)
                scores = shares + self.excess * (self.counts - is_own * weights)[:, None] * fitted
        distances = (gamma * (length - _products(of_all, onto)))[:, :, None] - 2 * lda
        if_new = gamma * if_new - 2 * np.where(is_own[:, None], -np.inf, lda).max(axis=2)
        if self.kind == "lda":
            nearer = np.square(weights / counts) * (gamma * length / 2 - (is_own[:, None] * lda).sum(axis=2))
            if vectors.shape[1] > count:  # what is scored counts as the complete touch
                nearer[:, count:] = nearer[:, count - 1 : count]
            scores = lda + is_own[:, None] * nearer[:, :, None]
        towards = gamma * (self.means - self.center) @ self.center
        z = gamma * (z - (z @ shares)[:, :, None]) - towards
        scored = slice(count if vectors.shape[1] > count else 0, None)
        diagonal = self._diagonal_distances(vectors[:, :count].mean(axis=1), vectors[:, scored], weights, own, scores[:, scored].argmax(axis=2))
        return [scores[:, scored], z[:, scored], distances[:, scored]], [if_new[:, scored], diagonal]

    def _coordinates(self, vectors: FloatArray) -> FloatArray:
        """The coordinates of each touch's vectors about the origin, (M, n, d) to (M, n, D)."""
        white = self.readout.triangle.times(vectors.reshape(-1, vectors.shape[2]))
        near = white @ self.basis
        # The triangle of a QR, which equal rows do not make singular, as they make their Gram matrix.
        own = np.linalg.qr((white - near @ self.basis.T).reshape(vectors.shape).transpose(0, 2, 1), mode="r")
        found = np.concatenate([near.reshape(*vectors.shape[:2], -1), np.asarray(own).transpose(0, 2, 1)], axis=2)
        return np.pad(found, ((0, 0), (0, 0), (0, self.means.shape[1] - found.shape[2])))

    def _diagonal_distances(self, middle, scored, weights, own, best) -> FloatArray:
        """Diagonal distances of queries (M, q, d) from the material `best` of each, (M, q), without their touch."""
        counts, is_own = self.counts[own, None], best == own[:, None]
        back = weights / (counts - weights) * (middle - self.plain[own])
        away = scored - self.plain[best] + is_own[:, :, None] * back[:, None]
        return np.where(is_own, 1 - np.square(weights / counts), 1.0) * (np.square(away) @ self.readout.precision)


def _without(columns: FloatArray, vectors: FloatArray, come: int = 0) -> FloatArray:
    """Vectors (M, n, D) under the inverse of the identity without columns (M, k, D), of which the last `come` come."""
    signs = np.where(np.arange(columns.shape[1]) < columns.shape[1] - come, 1.0, -1.0)
    across = columns.transpose(0, 2, 1)
    return np.asarray(vectors - vectors @ across @ np.linalg.inv(columns @ across - np.diag(signs)) @ columns)


def _products(left: FloatArray, right: FloatArray) -> FloatArray:
    """The products of vectors (M, n, D), one by one, (M, n)."""
    return np.einsum("mnd,mnd->mn", left, right)
