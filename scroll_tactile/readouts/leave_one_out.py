"""Leave-one-out scores: each sampled touch is scored by a readout that never observed it.

A touch of k rows with mean x̄, of a material of n rows with mean m, adds to S_w its rows about their mean and the shift
√(n k / (n − k)) (x̄ − m). K' is K without these columns, and m' = m − k / (n − k) (x̄ − m). The total scatter
T = K + N Σ_y p_y (m_y − μ)(m_y − μ)ᵀ about the mean μ loses them too, and a column along m − μ, which is what the means
make of the material; without the touch, but not if all of the material were new, it gets one along m' again. P and γ
stay as they are. All scores then follow by the definitions of `readout`, with

    ridge:     s_y = p_y + N p_y (m_y − μ)ᵀ T⁻¹ (x − μ),
    distance:  γ (x − m_y)ᵀ K⁻¹ (x − m_y) − γ (x − μ)ᵀ T⁻¹ (x − μ).

With K = L Lᵀ the vectors L⁻¹ x of the R means and of a touch span few dimensions. Between coordinates there K is the
identity, and a few columns change its inverse in a small product (Sherman, Morrison and Woodbury 1950; Bartlett 1951
for a row); so does T between others.

A held-out touch lies further from its own material than a new touch will: its squared distance to the mean of n − 1
touches is expected to be (1 + 1/(n − 1)) times the scatter, that of a new one to the mean of n (1 + 1/n) times. So it
is multiplied by their ratio, 1 − 1/n². And a ridge has the shares of all touches, as for a new one: shrunk heavily it
returns little but these, and without the touch its material's would be lower.

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
Places = npt.NDArray[np.intp]
Sampled = Iterable[tuple[str, bytes, SampledTouch]]
"""Material, key and rows of the touches that readouts are calibrated on: a `TouchSample`, or what was copied of it."""

TOGETHER = 64  # touches: what is made of them and 256 materials takes some 100 MB


@dataclass(frozen=True)
class HeldOutScores:
    """Scores by one scale of the sampled touches, each held out: N rows, R reference materials.

    rows: (touch by its place in the sample, stage) → row. names: the reference materials. scores, z, about the mean,
    and distances, the relative Mahalanobis distance if that material is the nearest: (N, R). distances_if_new: that of
    the nearest other material, had its own never been observed, (N,). diagonal_distances: from the material of the
    highest score, (N,).
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
        touches = list(sample)
        self.names = sorted(set.intersection(*(set(one.names) for one in held_out)))
        reached = [{touch for touch, number in one.rows if number == stage} for one in held_out]
        self.places = sorted(set.intersection(*reached)) if len(self.names) > 1 else []
        self.keys = [touches[place][1] for place in self.places]
        self.targets = np.array([self.names.index(touches[place][0]) for place in self.places], dtype=np.intp)
        rows = [[one.rows[place, stage] for place in self.places] for one in held_out]
        columns = [[one.names.index(name) for name in self.names] for one in held_out]
        self._picked = list(zip(held_out, rows, map(np.ix_, rows, columns), strict=True))
        self._novel = [self._picked[place] for place in measuring([one.scale for one in held_out])]

    def scores(self) -> FloatArray:
        """Scores of the materials, (N, S, C)."""
        return np.stack([one.scores[table] for one, _, table in self._picked], axis=1)

    def z(self) -> FloatArray:
        """z of the materials about their mean, (N, S, C)."""
        return np.stack([one.z[table] for one, _, table in self._picked], axis=1)

    def distances(self) -> FloatArray:
        """The relative distance if that material is the nearest, at the S' scales that measure novelty, (N, S', C)."""
        return np.stack([one.distances[table] for one, _, table in self._novel], axis=1)

    def distances_if_new(self) -> FloatArray:
        """The relative distance had its own material never been observed, at the same scales, (N, S')."""
        return np.stack([one.distances_if_new[rows] for one, rows, _ in self._novel], axis=1)

    def diagonal_distances(self) -> FloatArray:
        """Diagonal distances from the material of the highest score, (N, S)."""
        return np.stack([one.diagonal_distances[rows] for one, rows, _ in self._picked], axis=1)


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
    names, own = readout.reference, {name: place for place, name in enumerate(readout.reference)}
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
    with one_thread():
        leaving = _Leaving(readout, kind, max((len(group[0][0]) for group in groups.values()), default=0))
        for (count, _), group in groups.items():
            for first in range(0, len(group), TOGETHER):
                several, weights, owners, rows = map(np.array, zip(*group[first : first + TOGETHER], strict=True))
                for into, part in zip((*wide, *flat), leaving.out(several, count, weights, owners), strict=True):
                    into[rows] = part[:, -rows.shape[1] :]
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
        self.basis, upper = np.linalg.qr(readout.triangle.times(self.plain).T)
        self.means = np.pad(upper.T, ((0, 0), (0, vectors)))
        self.center = readout.shares @ self.means
        spread = np.sqrt(self.excess * self.counts)[:, None] * (self.means - self.center)
        self.whole = np.linalg.inv(np.linalg.cholesky(np.eye(spread.shape[1]) + spread.T @ spread)).T

    def out(self, vectors: FloatArray, count: int, weights: FloatArray, own: Places) -> tuple[FloatArray, ...]:
        """Scores, z and distances without each touch, (M, n, R); its distance if new and the diagonal one, (M, n).

        vectors: about the origin, (M, n, d): so many rows that each touch added, then those that are scored beside.
        weights: the rows of the statistics that it stands for, (M, 1). own: its material among the reference, (M,).
        """
        gamma, every, counts = self.readout.gamma, np.arange(len(own)), self.counts[own, None]
        left, others = counts - weights, self.counts.sum() - counts
        x = self._coordinates(vectors)
        middle, mean = x[:, :count].mean(axis=1), self.means[own]
        kept = mean - weights / left * (middle - mean)
        means = np.tile(self.means, (len(own), 1, 1))
        means[every, own] = kept
        inner = np.sqrt(weights / count)[:, :, None] * (contrasts(count) @ x[:, :count])
        gone = np.concatenate([inner, (np.sqrt(counts * left / weights) * (mean - kept))[:, None]], axis=1)
        solved = _without(gone, x)
        z, length = solved @ means.transpose(0, 2, 1), np.vecdot(x, solved)
        lda = gamma * (z - _lengths(gone, means)[:, None] / 2)

        rest = self.center - counts / np.maximum(others, 1) * (mean - self.center)  # the mean of the other materials
        center = rest + left / (left + others) * (kept - rest)
        columns = [np.sqrt(n * others / (n + others)) * (m - rest) for n, m in ((counts, mean), (left, kept))]
        changes = np.concatenate([gone, self.excess**0.5 * np.stack(columns, axis=1)], axis=1) @ self.whole
        of_all, of_others = ((x - part[:, None]) @ self.whole for part in (center, rest))
        onto = _without(changes, of_all, come=1)
        distances = gamma * (length - np.vecdot(of_all, onto))[:, :, None] - 2 * lda
        rivals = lda.copy()
        rivals[every, :, own] = -np.inf
        if_new = gamma * (length - _lengths(changes[:, :-1], of_others)) - 2 * rivals.max(axis=2)

        if self.kind == "ridge":
            sizes = self.excess * (self.counts - weights * (own[:, None] == np.arange(len(self.counts))))
            fitted = onto @ self.whole.T @ (means - center[:, None]).transpose(0, 2, 1)
            scores = self.readout.shares + sizes[:, None] * fitted
        else:
            nearer = np.square(weights / counts) * (gamma * length / 2 - lda[every, :, own])
            nearer[:, count:] = nearer[:, count - 1 : count]  # what is scored beside counts as the complete touch
            scores = lda
            scores[every, :, own] += nearer
        z = gamma * (z - (z @ self.readout.shares)[:, :, None] - (self.means - self.center) @ self.center)
        best = scores.argmax(axis=2)
        is_own = best == own[:, None]
        moved = weights / left * (vectors[:, :count].mean(axis=1) - self.plain[own])
        squares = np.square(vectors - self.plain[best] + is_own[:, :, None] * moved[:, None])
        diagonal = np.where(is_own, 1 - np.square(weights / counts), 1.0) * (squares @ self.readout.precision)
        return scores, z, distances, if_new, diagonal

    def _coordinates(self, vectors: FloatArray) -> FloatArray:
        """The coordinates of each touch's vectors about the origin, (M, n, d) to (M, n, D)."""
        white = self.readout.triangle.times(vectors.reshape(-1, vectors.shape[2]))
        near = white @ self.basis
        # The triangle of a QR, which equal rows do not make singular, as they make their Gram matrix.
        own = np.linalg.qr((white - near @ self.basis.T).reshape(vectors.shape).transpose(0, 2, 1), mode="r")
        found = np.concatenate([near.reshape(*vectors.shape[:2], -1), np.asarray(own).transpose(0, 2, 1)], axis=2)
        return np.pad(found, ((0, 0), (0, 0), (0, self.means.shape[1] - found.shape[2])))


def _inner(columns: FloatArray, come: int = 0) -> FloatArray:
    signs = np.where(np.arange(columns.shape[1]) < columns.shape[1] - come, 1.0, -1.0)
    return np.asarray(np.linalg.inv(columns @ columns.transpose(0, 2, 1) - np.diag(signs)))


def _without(columns: FloatArray, vectors: FloatArray, come: int = 0) -> FloatArray:
    """Vectors (M, n, D) under the inverse of the identity without columns (M, k, D), of which the last `come` come."""
    return np.asarray(vectors - vectors @ columns.transpose(0, 2, 1) @ _inner(columns, come) @ columns)


def _lengths(columns: FloatArray, vectors: FloatArray) -> FloatArray:
    """Squared lengths of vectors under the inverse of the identity without columns, (M, n)."""
    onto = vectors @ columns.transpose(0, 2, 1)
    return np.asarray(np.vecdot(vectors, vectors) - np.vecdot(onto, onto @ _inner(columns)))
