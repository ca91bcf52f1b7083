"""Readouts: discriminants of one scale, solved once from the exact statistics and followed from touch to touch.

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

`System` follows K⁻¹ as touches come and go; means and what is solved for them follow with it.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.system import System, columns_of
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import one_thread

__all__ = ["Change", "Means", "Numbers", "Readout", "ReadoutName"]

FloatArray = npt.NDArray[np.float64]
Floats = npt.NDArray[np.floating]
Places = npt.NDArray[np.intp]
ReadoutName = Literal["lda", "ridge"]
Change = tuple[str, npt.NDArray[np.int32], int]
"""A material, the rows of codes (k, d) of a touch of it at one scale, and 1 where they came or -1 where they went."""

FARTHEST = 1e100  # diagonal distance from a mean of another's stored model that is no number


class Numbers(NamedTuple):
    """The numbers that a readout was solved with.

    origin: shape (d,), in grid units. counts: rows, shape (C,). share: ρ. penalty: P. precision: one over the variance
    of each feature within materials as it was solved, shape (d,).
    """

    origin: FloatArray
    counts: FloatArray
    share: float
    penalty: float
    precision: FloatArray


@dataclass
class Means:
    """The means m of n materials about a readout's origin, and what is solved for them.

    means: m, solved: K⁻¹ m, both (n, d), in double or in single precision. sizes: mᵀ K⁻¹ m, (n,).
    """

    means: Floats
    solved: Floats
    sizes: FloatArray

    def __len__(self) -> int:
        return len(self.sizes)

    def put(self, rows: slice | Sequence[int], means: FloatArray, solved: FloatArray) -> None:
        """Replace materials."""
        self.means[rows], self.solved[rows] = means, solved
        self.sizes[rows] = np.einsum("nd,nd->n", means, solved)

    def append(self, mean: FloatArray, solved: FloatArray) -> None:
        """Add a material, shapes (1, d)."""
        kind = self.means.dtype
        self.means = np.concatenate([self.means, mean.astype(kind)])
        self.solved = np.concatenate([self.solved, solved.astype(kind)])
        self.sizes = np.append(self.sizes, np.einsum("nd,nd->n", mean, solved))

    def border(self, leaving: FloatArray, corner: FloatArray) -> None:
        """Follow K⁻¹, which falls by Wᵀ C W; see `System.border`."""
        kind = self.means.dtype
        leaving = leaving.astype(kind, copy=False)
        onto = self.means @ leaving.T
        moved = onto @ corner.astype(kind, copy=False)
        self.solved -= moved @ leaving
        self.sizes -= (moved * onto).sum(axis=1)

    def scores(self, row: FloatArray, rows: slice | Places = slice(None)) -> FloatArray:
        """mᵀ K⁻¹ x − mᵀ K⁻¹ m / 2 of some of them, for a row x of shape (d,) about the origin."""
        return np.asarray(self.solved[rows] @ row.astype(self.solved.dtype, copy=False) - self.sizes[rows] / 2)

    def copy(self) -> Means:
        """A copy that changes independently."""
        return Means(self.means.copy(), self.solved.copy(), self.sizes.copy())


@dataclass(frozen=True)
class Derived:
    """The matrices that ridge and novelty need of a readout in its present state.

    gram: G of the reference materials about their mean, shape (R, R). background: H. towards: subtracted from z, after
    its mean, to move its origin to the mean of the reference materials, shape (R,).
    """

    gram: FloatArray
    background: FloatArray
    towards: FloatArray


class Readout:
    """The readout of one scale: solved from a task, then updated by the touches that came and went since.

    names: the materials; a place is an index into them. near: the reference materials, which are the first. others:
    those after them. The other attributes are those of `Numbers`.

    Any number of threads may read it at once. `follow` changes it in place: while any thread reads it, a copy follows.
    """

    def __init__(
        self, scale: Scale, names: Sequence[str], system: System, near: Means, others: Means, numbers: Numbers
    ) -> None:
        self.scale, self.names, self.system, self.near, self.others = scale, list(names), system, near, others
        self.places = {name: place for place, name in enumerate(names)}
        self.origin, self.counts, self.share, self.penalty, self.precision = numbers
        self._derived: Derived | None = None
        self._scored: tuple[FloatArray, FloatArray] | None = None  # the last touch, and its scores of all materials

    @property
    def reference(self) -> list[str]:
        """The reference materials."""
        return self.names[: len(self.near)]

    @property
    def gamma(self) -> float:
        """γ, by which K⁻¹ becomes Σ⁻¹."""
        return float(self.counts.sum()) / (1 - self.share)

    @property
    def shares(self) -> FloatArray:
        """p of the reference materials, shape (R,)."""
        counts = self.counts[: len(self.near)]
        return np.asarray(counts / counts.sum())

    @property
    def nearly_full(self) -> bool:
        """Whether the system has taken in more than three quarters of the columns that it has room for."""
        return self.system.rank > 3 * self.system.room

    def follow(self, changes: Sequence[Change]) -> bool:
        """Take in touches that came and went.

        Returns False where all has to be solved again: the touches are too many, they outweigh the scatter that it was
        solved from, or a material lost its last one.
        """
        if sum(len(rows) for _, rows, _ in changes) > self.system.room:
            return False
        self._derived = self._scored = None
        come: dict[str, list[FloatArray]] = {}
        for material, rows, sign in changes:
            if sign > 0:
                come.setdefault(material, []).append(rows - self.origin)
        try:
            with one_thread():
                self._follow({material: np.concatenate(rows) for material, rows in come.items()}, 1)
                for material, rows, sign in changes:
                    if sign < 0:
                        place = self.places.get(material)
                        if place is None or self.counts[place] <= len(rows):
                            return False
                        self._follow({material: rows - self.origin}, -1)
        except np.linalg.LinAlgError:  # nearly all touches that it was solved from were retracted
            return False
        return self.system.sound

    def copy(self) -> Readout:
        """A copy that follows independently."""
        other = copy.copy(self)
        other.names, other.places, other.counts = list(self.names), dict(self.places), self.counts.copy()
        other.system, other.near, other.others = self.system.branch(), self.near.copy(), self.others.copy()
        return other

    def without(self, material: str, rows: npt.NDArray[np.float64]) -> Readout:
        """A copy that never observed a touch of these rows, codes (k, d); its material has other touches.

        The caller has set BLAS to one thread.
        """
        other = self.copy()
        other._derived = other._scored = None
        other._follow({material: rows - self.origin}, -1)
        return other

    def _at(self, place: int) -> tuple[Means, int]:
        """Where a material is held, and its row there."""
        return (self.near, place) if place < len(self.near) else (self.others, place - len(self.near))

    def _follow(self, changed: Mapping[str, FloatArray], sign: int) -> None:
        """Take in rows of several materials, (k, d) about the origin, in one product: that is faster."""
        columns, known, fresh = [], [], []
        for material, came in changed.items():
            place, mean = self.places.get(material), came.mean(axis=0)
            if place is None:
                columns.append(columns_of(came, None))
                fresh.append((material, mean, len(came)))
                continue
            (held, row), before = self._at(place), self.counts[place]
            self.counts[place] = after = before + sign * len(came)
            step = mean - held.means[row]
            columns.append(columns_of(came, np.sqrt(before * len(came) / after) * step))
            known.append((held, row, sign * len(came) / after * step))
        added = np.concatenate([self.near.means[:0], *columns])
        if len(added):
            leaving, corner = self.system.border(added, sign)
            for held in (self.near, self.others):
                held.border(leaving, corner)
        for held in (self.near, self.others):
            if moved := [(row, step) for own, row, step in known if own is held]:
                means = np.array([held.means[row] + step for row, step in moved])
                held.put([row for row, _ in moved], means, self.system.solve(means))
        for material, mean, count in fresh:
            # Where the reference is all materials, the new one joins it.
            held = self.near if len(self.near) == len(self.names) else self.others
            held.append(mean[None], self.system.solve(mean[None]))
            self.places[material] = len(self.names)
            self.names.append(material)
            self.counts = np.append(self.counts, float(count))

    def derived(self) -> Derived:
        """The matrices of the present state, made again after a change."""
        if self._derived is None:
            shares, means, solved = self.shares, self.near.means, self.near.solved
            with one_thread():
                gram = self.gamma * (means @ solved.T)
                gram = (gram + gram.T) / 2
                onto = gram @ shares
                size = float(shares @ onto)
                gram = gram - onto[:, None] - onto + size
                background = np.linalg.inv(np.diag(1.0 / ((1 - self.share) * shares)) + gram)
            self._derived = Derived(gram, (background + background.T) / 2, onto - size)
        return self._derived

    def scores(self, features: FloatArray, places: Sequence[int] | Places, kind: ReadoutName) -> FloatArray:
        """The scores of the materials at some places for features of shape (d,), shape (k,)."""
        chosen = np.asarray(places, dtype=np.intp)
        if kind == "ridge":
            near, beyond = self._beyond_nearest(features)
            scores = self.derived().background @ beyond
            scores[near] += 1.0
            return np.asarray(scores[chosen])
        if 4 * len(chosen) > len(self.names):  # picking rows copies them
            return np.asarray(self.gamma * self._scores_of_all(features)[chosen])
        row, near_ones = features - self.origin, chosen < len(self.near)
        if near_ones.all():
            return np.asarray(self.gamma * self.near.scores(row, chosen))
        scores = np.empty(len(chosen))
        scores[near_ones] = self.near.scores(row, chosen[near_ones])
        scores[~near_ones] = self.others.scores(row, chosen[~near_ones] - len(self.near))
        return np.asarray(self.gamma * scores)

    def _scores_of_all(self, features: FloatArray) -> FloatArray:
        """The scores "lda" over γ of all materials; the last ones are kept, as each touch is asked about repeatedly."""
        scored = self._scored
        if scored is None or scored[0] is not features:
            row = features - self.origin
            scored = self._scored = features, np.concatenate([self.near.scores(row), self.others.scores(row)])
        return scored[1]

    def diagonal_distance(self, features: FloatArray, place: int) -> float:
        """The squared Mahalanobis distance of features (d,) from a material's mean, by diagonal scatter as fitted.

        It grows with whatever was never learned, where the relative distance of `novelty` leaves out what no material
        differs in.
        """
        held, row = self._at(place)
        away = features - self.origin - held.means[row]
        return float(np.fmin(np.square(away) @ self.precision, FARTHEST))

    def linear(self, names: Sequence[str], kind: ReadoutName) -> tuple[FloatArray, FloatArray]:
        """The scores of materials as weights (d, k) of features about the origin, and offsets (k,); see `scores`."""
        places = [self.places[name] for name in names]
        if kind == "lda":
            found = [self._at(place) for place in places]
            solved = np.array([held.solved[row] for held, row in found], dtype=np.float64)
            return self.gamma * solved.T, -self.gamma * np.array([held.sizes[row] for held, row in found]) / 2
        derived, weights = self.derived(), self.gamma * self.near.solved.T
        background = derived.background[places]
        mixing = background - np.outer(background.sum(axis=1), self.shares)
        return weights @ mixing.T, np.asarray(self.shares[places] - background @ derived.towards)

    def centred(self, features: FloatArray) -> FloatArray:
        """z of the reference materials about their mean, shape (R,)."""
        z = self.gamma * (self.near.solved @ (features - self.origin))
        return np.asarray(z - self.shares @ z - self.derived().towards)

    def novelty(self, features: FloatArray, places: Sequence[int] | Places) -> float:
        """Relative Mahalanobis distance of features (d,), the nearest material taken among those at `places`."""
        near, beyond = self._beyond_nearest(features)
        nearest = float(self.scores(features, places, "lda").max())
        ahead = nearest - float(self.scores(features, [near], "lda")[0])
        weighed = beyond @ self.derived().background @ beyond
        return float(weighed - (1 / self.shares[near] - 1) / (1 - self.share) - 2.0 * ahead)

    def _beyond_nearest(self, features: FloatArray) -> tuple[int, FloatArray]:
        """The nearest of the reference materials, by its place, and v, shape (R,)."""
        row = features - self.origin
        near = int(self.near.scores(row).argmax())
        beyond = self.gamma * (self.near.solved @ (row - self.near.means[near]))
        beyond[near] -= 1 / ((1 - self.share) * self.shares[near])
        return near, np.asarray(beyond - self.shares @ beyond)
