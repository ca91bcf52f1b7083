"""Leave-one-out scores: each sampled touch is scored by a readout that never observed it.

The touch's rows are taken out of the statistics. A touch of k rows with mean x̄, of a material of n rows with mean m,
adds to S_w the columns U: its rows about their mean and the scaled shift √(n k / (n − k)) (x̄ − m). Without
it, by Sherman, Morrison and Woodbury (1950; Bartlett 1951 for a row),

    K'⁻¹ = K⁻¹ − K⁻¹ Uᵀ E U K⁻¹,    E = (U K⁻¹ Uᵀ − I)⁻¹,    m' = m − k / (n − k) (x̄ − m),

so that all of its scores follow from products with K⁻¹ of its rows and of the means: one inverse serves for all. The
touch leaves the total scatter T = K + N Σ_y p_y (m_y − μ)(m_y − μ)ᵀ in the same way. It leaves the paper's ridge by
its leverage matrix B: its scores are (I − B)⁻¹ (F − B Y), Y the targets of the rows and F their fitted scores. P and γ
stay as they are.

A held-out touch lies further from its own material than a new touch will. The squared distance to the mean of n touches
is expected to be (1 + 1/n) times the scatter for a new touch, and (1 + 1/(n − 1)) times for a held-out one of the n. So
it is multiplied by their ratio, 1 − 1/n²: calibration would otherwise expect new touches to look less like their own
material than they do.

Where windows are learned one by one, the sample has fewer rows of a touch: these stand for all of them.

With K = L Lᵀ all of these are products between whitened vectors L⁻¹ x, of which the R means and the k rows of a touch
span R + k dimensions. So they are taken between coordinates there: in the orthonormal basis Q of the whitened means,
and, for what lies beyond it, in a basis of the touch's own.
"""

from __future__ import annotations

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

TOGETHER = 256  # touches: of a row of 1008 features each these take 2 MB


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
    own = {name: i for i, name in enumerate(names)}
    groups: dict[tuple[int, int], list[tuple[int, list[int], FloatArray, float, int, FloatArray]]] = {}
    for number, (material, _, touch) in enumerate(sample):
        judged = rows_at(touch, stages, readout.scale)
        if not judged or material not in own or (queries is not None and not queries.get(number)):
            continue
        weight = float(max(touch.pairs[judged[0], 2], len(judged)))
        if readout.counts[own[material]] > weight:
            rows = touch.rows[judged] - readout.origin
            at, scored = touch.pairs[judged, 0].tolist(), rows
            if queries is not None:
                at, scored = sorted(queries[number]), np.stack([queries[number][i] for i in sorted(queries[number])])
                scored = scored - readout.origin
            groups.setdefault((len(judged), len(at)), []).append((number, at, rows, weight, own[material], scored))
    index: dict[tuple[int, int], int] = {}
    parts = []
    beyond = max((judged + asked * (queries is not None) for judged, asked in groups), default=0)
    leaving = _Leaving(readout, kind, beyond) if groups else None
    for members in (group[i : i + TOGETHER] for group in groups.values() for i in range(0, len(group), TOGETHER)):
        for number, at, *_ in members:
            for stage in at:
                index[number, stage] = len(index)
        rows, weights, owners, scored = (np.stack([member[i] for member in members]) for i in (2, 3, 4, 5))
        assert leaving is not None
        parts.append(leaving.out(rows, weights, owners, None if queries is None else scored))
    joined = [np.concatenate([np.zeros((0, len(names))), *(part[i] for part in parts)]) for i in range(3)]
    if_new, diagonal = (np.concatenate([np.zeros(0), *(part[i] for part in parts)]) for i in (3, 4))
    return HeldOutScores(readout.scale, index, names, joined[0], joined[1], joined[2], if_new, diagonal)


def rows_at(touch: SampledTouch, stages: Sequence[Sequence[Scale]], scale: Scale) -> list[int]:
    """The indices of a sampled touch's rows at a scale. stages: the scales that judge at each, ascending."""
    return [
        i for i, (stage, place, _) in enumerate(touch.pairs.tolist())
        if stage < len(stages) and place < len(stages[stage]) and stages[stage][place] == scale
    ]  # fmt: skip


class _Leaving:
    """Takes touches out of one readout as it was solved; M touches with k rows each at once.

    All products are taken between whitened vectors, L⁻¹ x with K = L Lᵀ, in the coordinates of the module's docstring:
    D of them, the first of the means' basis. Products of T follow from them (Woodbury): with B = √(N p_y) (m_y − μ)
    and A Aᵀ = I + B Bᵀ, xᵀ T⁻¹ y = x·y − (A⁻¹ B x)·(A⁻¹ B y).

    beyond: the most vectors that a touch has, of rows and of queries: so many coordinates are its own.
    """

    def __init__(self, readout: Readout, kind: ReadoutName, beyond: int) -> None:
        self.readout, self.kind = readout, kind
        self.derived = readout.derived()
        self.counts = readout.counts[: len(readout.near)]
        self.total = float(self.counts.sum())
        # The total scatter is that of the reference materials, scaled to the rows of all materials.
        self.excess = float(readout.counts.sum()) / self.total
        with one_thread():
            self.basis, upper = np.linalg.qr(readout.triangle.times(readout.near.means).T)
            self.means = np.pad(upper.T, ((0, 0), (0, beyond)))
            self.center = readout.shares @ self.means
            spread = (self.means - self.center) * np.sqrt(self.excess * self.counts)[:, None]
            factor = np.linalg.cholesky(spread @ spread.T + np.eye(len(spread)))
            self.onto_spread = np.linalg.solve(factor, spread)

    def _coordinates(self, vectors: FloatArray) -> FloatArray:
        """The coordinates of each touch's vectors about the origin, (M, k, d) to (M, k, D)."""
        white = self.readout.triangle.times(vectors.reshape(-1, vectors.shape[2]))
        near = white @ self.basis
        rest = (white - near @ self.basis.T).reshape(vectors.shape)
        # The triangle of a QR, which equal rows do not make singular, as they make their Gram matrix.
        beyond = np.asarray(np.linalg.qr(rest.transpose(0, 2, 1), mode="r")).transpose(0, 2, 1)
        found = np.zeros((*vectors.shape[:2], self.means.shape[1]))
        found[:, :, : near.shape[1]] = near.reshape(*vectors.shape[:2], -1)
        found[:, :, near.shape[1] : near.shape[1] + beyond.shape[2]] = beyond
        return found

    def out(
        self,
        rows: FloatArray,
        weights: FloatArray,
        own: npt.NDArray[np.intp],
        queries: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Scores, z and distances, (M·q, R) each, without the rows of each touch; then two distances, (M·q,) each.

        These two: the relative distance without the touch's whole material, and the diagonal distance.

        rows: that each touch added, about the origin, (M, k, d). weights: the rows of the statistics that it stands
        for, (M,). own: its material among the reference, (M,). queries: what is scored, about the origin, (M, q, d);
        the rows themselves unless given.
        """
        touches, count = rows.shape[:2]
        with one_thread():
            if queries is None:
                queries, white = rows, self._coordinates(rows)
                scored = white
            else:
                both = self._coordinates(np.concatenate([rows, queries], axis=1))
                white, scored = both[:, :count], both[:, count:]
            counts = self.counts[own]
            stretch = np.sqrt(weights * counts / (counts - weights))[:, None]
            share = np.sqrt(weights / count)[:, None, None]
            columns = _columns(white, share, stretch * (white.mean(axis=1) - self.means[own]))
            inner = np.linalg.inv(columns @ columns.transpose(0, 2, 1) - np.eye(count))
            onto = scored @ columns.transpose(0, 2, 1)  # U K⁻¹ p of what is scored, (M, q, columns)
            classes = (columns @ self.means.T).transpose(0, 2, 1)  # and of the means, (M, R, columns)
            onto_inner, classes_inner = onto @ inner, classes @ inner
            z = scored @ self.means.T - onto_inner @ classes.transpose(0, 2, 1)
            sizes = np.square(self.means).sum(axis=1) - np.einsum("nri,nri->nr", classes, classes_inner)
            i = np.arange(touches)
            change = np.sqrt(weights / (counts * (counts - weights)))
            z[i, :, own] += change[:, None] * onto_inner[:, :, -1]
            sizes[i, own] += 2 * change * classes_inner[i, own, -1] - np.square(change) * (1 + inner[:, -1, -1])
            length = np.square(scored).sum(axis=2) - np.einsum("nki,nki->nk", onto, onto_inner)
            whole, leverage, across = self._whole(white, scored, columns, weights, share)
            whole_if_new = self._whole_without_material(scored, columns, own)
        gamma = self.readout.gamma
        lda = gamma * (z - sizes[:, None, :] / 2)
        distances = gamma * (length - whole)[:, :, None] - 2 * lda
        others = lda.copy()
        others[i, :, own] = -np.inf
        if_new = gamma * (length - whole_if_new) - 2 * others.max(axis=2)
        gain = self._as_new(white, columns, inner, weights, own)
        lda[i, :, own] += gain if queries is rows else gain[:, -1:]  # a query counts as the complete touch
        centred = gamma * (z - (z @ self.readout.shares)[:, :, None]) - self.derived.towards
        scores = lda if self.kind == "lda" else self._ridge(white, scored, own, leverage, across, weights)
        diagonal = self._diagonal_distances(rows, queries, weights, own, scores.argmax(axis=2))
        flat = [part.reshape(scored.shape[0] * scored.shape[1], -1) for part in (scores, centred, distances)]
        return flat[0], flat[1], flat[2], if_new.reshape(-1), diagonal.reshape(-1)

    def _as_new(
        self,
        white: FloatArray,
        leaving: FloatArray,
        inner: npt.NDArray[np.floating],
        weights: FloatArray,
        own: npt.NDArray[np.intp],
    ) -> FloatArray:
        """The rise of each row's own LDA score where its distance is brought to that of a new touch, (M, k).

        white: the rows, whitened, (M, k, D). leaving, inner: the columns that leave K, whitened, and E.
        """
        counts = self.counts[own]
        back = (weights / (counts - weights))[:, None] * (white.mean(axis=1) - self.means[own])
        away = white - (self.means[own] - back)[:, None]
        onto = away @ leaving.transpose(0, 2, 1)
        far = np.square(away).sum(axis=2) - np.einsum("nki,nki->nk", onto, onto @ inner)
        return np.asarray(self.readout.gamma * np.square(weights / counts)[:, None] * far / 2)

    def _diagonal_distances(
        self,
        rows: FloatArray,
        queries: FloatArray,
        weights: FloatArray,
        own: npt.NDArray[np.intp],
        best: npt.NDArray[np.intp],
    ) -> FloatArray:
        """Diagonal distances of queries (M, q, d) from the material `best` of each, (M, q), without their touch."""
        means, counts = self.readout.near.means, self.counts[own]
        nearest = means[best]
        back = (weights / (counts - weights))[:, None] * (rows.mean(axis=1) - means[own])
        nearest -= (best == own[:, None])[:, :, None] * back[:, None]
        distances: FloatArray = np.square(queries - nearest) @ self.readout.precision
        as_new = 1 - np.square(weights / counts)[:, None]
        return np.where(best == own[:, None], as_new * distances, distances)

    def _whole(
        self, white: FloatArray, scored: FloatArray, leaving: FloatArray, weights: FloatArray, share: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The squared length of each query about the total mean, by T without its touch, (M, q).

        Also B of the touch's rows, (M, k, k), and of its queries with them, (M, q, k). leaving: the columns that
        leave K, whitened, shape (M, k, D).
        """
        count, half, queries = white.shape[1], white - self.center, scored - self.center
        rest = (self.total - weights)[:, None]
        middle = half.mean(axis=1)
        columns = np.sqrt(self.excess) * _columns(half, share, np.sqrt(weights[:, None] * self.total / rest) * middle)
        signs = -np.ones(count)
        if self.excess > 1:
            columns = np.concatenate([columns, np.sqrt(self.excess - 1) * leaving], axis=1)
            signs = np.repeat([-1.0, 1.0], count)
        whole = self._length_without(queries + (weights[:, None] / rest * middle)[:, None, :], columns, signs)
        leverage, across = (np.square(share) * (self._products(of, half) + 1 / self.total) for of in (half, queries))
        return whole, leverage, across

    def _whole_without_material(self, scored: FloatArray, leaving: FloatArray, own: npt.NDArray[np.intp]) -> FloatArray:
        """The first result of `_whole`, also without the material's mean, but with its inner scatter, (M, q)."""
        counts, middle = self.counts[own], self.means[own] - self.center
        rest = self.total - counts
        if not rest.all():
            return np.full(scored.shape[:2], np.nan)
        shift = np.sqrt(self.excess * counts * self.total / rest)[:, None] * middle
        columns = np.concatenate([leaving, shift[:, None]], axis=1)
        moved = scored - self.center + (counts / rest)[:, None, None] * middle[:, None]
        return self._length_without(moved, columns, -np.ones(columns.shape[1]))

    def _length_without(self, moved: FloatArray, columns: FloatArray, signs: FloatArray) -> FloatArray:
        """The squared length, (M, q), of whitened vectors (M, q, D) under T changed by signed columns (M, k, D)."""
        inner = np.linalg.inv(self._products(columns, columns) + np.diag(signs))
        onto = self._products(moved, columns)
        length = np.square(moved).sum(axis=2) - np.square(moved @ self.onto_spread.T).sum(axis=2)
        return np.asarray(length - np.einsum("nki,nki->nk", onto, onto @ inner))

    def _products(self, left: FloatArray, right: FloatArray) -> FloatArray:
        """xᵀ T⁻¹ y of whitened vectors, shape (M, a, b)."""
        near = left @ self.onto_spread.T, right @ self.onto_spread.T
        return np.asarray(left @ right.transpose(0, 2, 1) - near[0] @ near[1].transpose(0, 2, 1))

    def _ridge(
        self,
        white: FloatArray,
        scored: FloatArray,
        own: npt.NDArray[np.intp],
        leverage: FloatArray,
        across: FloatArray,
        weights: FloatArray,
    ) -> FloatArray:
        fitted, queries = (self._fitted(rows) for rows in (white, scored))
        targets = np.zeros_like(fitted)
        targets[np.arange(len(own)), :, own] = 1.0
        scores = queries + across @ np.linalg.solve(np.eye(white.shape[1]) - leverage, fitted - targets)
        # The shares of all touches, as for a new touch. A heavily shrunk ridge returns little but the shares: without
        # the held-out touch its material's would be lower, and calibration would give such scores no weight.
        counts = self.counts - weights[:, None] * np.eye(len(self.counts))[own]
        shares = counts / (self.total - weights)[:, None]
        return np.asarray(scores + (self.readout.shares - shares)[:, None, :])

    def _fitted(self, white: FloatArray) -> FloatArray:
        """The scores of the whole ridge."""
        z = self.readout.gamma * (white @ self.means.T)
        z = z - (z @ self.readout.shares)[:, :, None] - self.derived.towards
        return np.asarray(self.readout.shares + z @ self.derived.background)


def _columns(rows: FloatArray, share: FloatArray, shift: FloatArray) -> FloatArray:
    """The contrasts of the rows of each touch and its scaled shift, shape (M, k, d)."""
    return np.concatenate([share * (contrasts(rows.shape[1]) @ rows), shift[:, None]], axis=1)
