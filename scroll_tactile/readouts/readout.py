"""Readouts: discriminants of one scale, solved from the exact statistics; between two solutions their means follow.

With class means m_y, the scatter within classes S_w of N rows and its shrinkage ρ (see `task`), Σ⁻¹ = γ K⁻¹ with
K = S_w + P I, P = ρ / (1 − ρ) tr S_w / d and γ = N / (1 − ρ). All that answers need of a row x are

    z_y = γ m_yᵀ K⁻¹ x,    g_y = γ m_yᵀ K⁻¹ m_y,    G = γ M K⁻¹ Mᵀ of some reference materials,

rows and means about a fixed origin, and with p_y the shares of the reference materials and z, G about their mean:

- lda, linear discriminant analysis:      s_y = z_y − g_y / 2;
- ridge on 0/1 targets, the paper's f_t:  s = p + H z,    H = (((1 − ρ) P)⁻¹ + G)⁻¹    (push-through identity);
- relative Mahalanobis distance (Ren et al. 2021, arXiv 2106.09022), the distance to the nearest class less that to the
  whole, whose covariance is Σ + (1 − ρ) Mᵀ P M:  −2 max_y s_y(lda) + zᵀ H z    (Woodbury; xᵀ Σ⁻¹ x cancels).

Materials much further apart than they scatter make G and z as large as the digits of H z and zᵀ H z are small. So both
are taken about the nearest of the reference materials, n: with v the z of x − m_n, less 1 / ((1 − ρ) p_n) at n, about
its mean, the scores are e_n + H v and the distance is −2 (max_y s_y − s_n) + vᵀ H v − (1 / p_n − 1) / (1 − ρ), as
H G = I − H ((1 − ρ) P)⁻¹ and H 1 = (1 − ρ) p.

Between two solutions the means m_y and their shares follow the touches that came and went, exactly; S_w, ρ and N stay
as they were solved. Measured, such a readout is right about as many touches as one that is solved anew.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.triangle import InverseTriangle
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import Sums, one_thread
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["Readout", "ReadoutName"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Places = npt.NDArray[np.intp]
ReadoutName = Literal["lda", "ridge"]

TOGETHER = 128  # materials that are solved for at once


class Derived(NamedTuple):
    """What ridge and novelty need of the R reference materials.

    middle: the mean of their means about the origin, weighed by p, (d,). weights: γ K⁻¹ (m − middle), (R, d). gram: G
    about their mean, (R, R). background: H.
    """

    middle: FloatArray
    weights: FloatArray
    gram: FloatArray
    background: FloatArray


@dataclass(eq=False)
class Readout:
    """The readout of one scale: solved from a task, or the one that followed such a one. It never changes.

    names: the materials; a place is an index into them. reference: the first of them, to which novelty and the ridge
    refer. counts: rows, (C,). sums: of their codes, (C, d). shares: p, (R,). As it was solved stay origin: the mean of
    all rows, (d,), in grid units; triangle: L⁻¹ of K; gamma: γ; share: ρ; penalty: P; precision: one over the variance
    of each feature within materials, (d,).

    A material is solved for when it is first asked for: a scene of few costs what it holds. Any number of threads may
    use it at once.
    """

    scale: Scale
    names: list[str]
    reference: list[str]
    counts: IntArray
    sums: Sums
    origin: FloatArray
    triangle: InverseTriangle
    gamma: float
    share: float
    penalty: float
    precision: FloatArray

    def __post_init__(self) -> None:
        self.places = {name: place for place, name in enumerate(self.names)}
        self._near = slice(len(self.reference))
        self.shares = self.counts[self._near] / self.counts[self._near].sum()
        self._solved = np.empty(self.sums.shape)
        self._sizes = np.full(len(self.names), np.nan)  # not a number where it is not solved for yet
        self._derived: Derived | None = None
        self._scored: tuple[FloatArray, FloatArray] | None = None  # the last touch, and its scores of all materials

    def means(self, places: slice | Sequence[int] | Places = slice(None)) -> FloatArray:
        """m of materials about the origin, (k, d), formed anew each time."""
        counts, near = self.counts[places], np.rint(self.origin)
        # Sums about the integers nearest to the origin are exact, so a mean close to the origin loses no digits.
        away = (self.sums[places] - np.outer(counts, near.astype(np.int64))) / counts[:, None]
        return np.asarray(away - (self.origin - near))

    def solved(self, places: slice | Places = slice(None)) -> tuple[FloatArray, FloatArray]:
        """K⁻¹ m of materials, (k, d), and mᵀ K⁻¹ m, (k,)."""
        missing = np.arange(len(self.names))[places][np.isnan(self._sizes[places])]
        # The same ones are always solved for together: threads that ask at once, each for some, get the same bits.
        for first in sorted({place // TOGETHER * TOGETHER for place in missing.tolist()}):
            own = first + np.flatnonzero(np.isnan(self._sizes[first : first + TOGETHER]))
            means = self.means(own)
            with one_thread():
                self._solved[own] = self.triangle.solve(means)
            self._sizes[own] = np.vecdot(means, self._solved[own])
        return self._solved[places], self._sizes[places]

    def followed(self, statistics: Statistics, changed: Collection[str]) -> Readout | None:
        """The readout of the present statistics, its scatter as it was solved; None without a reference.

        changed: materials of which touches came or went since this one was solved or followed; of others no sum may
        have changed. A new one joins the reference where that is all materials. The caller holds the statistics' lock.
        """
        now = dict(zip(changed, statistics.counts(self.scale, list(changed)).tolist(), strict=True))
        stay = np.array([place for place, name in enumerate(self.names) if now.get(name, 1)], dtype=np.intp)
        come = sorted(name for name, count in now.items() if count and name not in self.places)
        names = [*(self.names[place] for place in stay), *come]
        reference = names[: (stay < len(self.reference)).sum()] if len(self.reference) < len(self.names) else names
        if not reference:
            return None
        counts, sums = statistics.totals(self.scale, names)
        other = replace(self, names=names, reference=reference, counts=counts, sums=sums)
        moved = [other.places[name] for name in now if name in other.places]
        other._sizes[: len(stay)] = self._sizes[stay]
        other._sizes[moved] = np.nan
        np.take(self._solved, stay, axis=0, out=other._solved[: len(stay)], mode="clip")  # without a copy between
        if reference == self.reference and min(moved, default=len(reference)) >= len(reference):
            other._derived = self._derived
        return other

    def derived(self) -> Derived:
        """What ridge and novelty need of the reference materials, made when it is first asked for."""
        if self._derived is None:
            shares, means, (solved, _) = self.shares, self.means(self._near), self.solved(self._near)
            with one_thread():
                middle, weights = shares @ means, self.gamma * (solved - shares @ solved)
                gram = (means - middle) @ weights.T
                gram = (gram + gram.T) / 2
                background = np.linalg.inv(np.diag(1.0 / ((1 - self.share) * shares)) + gram)
            self._derived = Derived(middle, weights, gram, (background + background.T) / 2)
        return self._derived

    def scores(self, features: FloatArray, places: Sequence[int] | Places, kind: ReadoutName) -> FloatArray:
        """The scores of the materials at some places for features of shape (d,), shape (k,)."""
        chosen = np.asarray(places, dtype=np.intp)
        if kind == "ridge":
            near, _, scores = self._beyond_nearest(features)
            scores[near] += 1.0
            return scores[chosen]
        if 4 * len(chosen) <= len(self.names):
            return self._lda(features, chosen)
        if self._scored is None or self._scored[0] is not features:  # each touch is asked about repeatedly
            self._scored = features, self._lda(features, slice(None))
        return self._scored[1][chosen]

    def _lda(self, features: FloatArray, places: slice | Places) -> FloatArray:
        solved, sizes = self.solved(places)
        return np.asarray(self.gamma * (solved @ (features - self.origin) - sizes / 2))

    def diagonal_distance(self, features: FloatArray, place: int) -> float:
        """The squared distance of features (d,) from a material by diagonal scatter: unlike `novelty` it is of all."""
        return float(np.square(features - self.origin - self.means([place])[0]) @ self.precision)

    def linear(self, names: Sequence[str], kind: ReadoutName) -> tuple[FloatArray, FloatArray]:
        """The scores of materials as weights (d, k) of features about the origin, and offsets (k,); see `scores`."""
        places = np.array([self.places[name] for name in names], dtype=np.intp)
        if kind == "lda":
            solved, sizes = self.solved(places)
            return self.gamma * solved.T, -self.gamma * sizes / 2
        derived = self.derived()
        weights = derived.weights.T @ derived.background[:, places]
        return weights, np.asarray(self.shares[places] - derived.middle @ weights)

    def centred(self, features: FloatArray) -> FloatArray:
        """z of the reference materials about their mean, shape (R,)."""
        return np.asarray(self.derived().weights @ (features - self.origin - self.derived().middle))

    def novelty(self, features: FloatArray, places: Sequence[int] | Places) -> float:
        """Relative Mahalanobis distance of features (d,), the nearest material taken among those at `places`."""
        near, beyond, weighed = self._beyond_nearest(features)
        ahead = self.scores(features, places, "lda").max() - self.scores(features, [near], "lda")[0]
        return float(beyond @ weighed - (1 / self.shares[near] - 1) / (1 - self.share) - 2.0 * ahead)

    def _beyond_nearest(self, features: FloatArray) -> tuple[int, FloatArray, FloatArray]:
        """The nearest of the reference materials, by its place, v, and H v, both of shape (R,)."""
        near, derived = int(self._lda(features, self._near).argmax()), self.derived()
        beyond = derived.weights @ (features - self.origin - self.means([near])[0]) + 1 / (1 - self.share)
        beyond[near] -= 1 / ((1 - self.share) * self.shares[near])
        return near, beyond, derived.background @ beyond
