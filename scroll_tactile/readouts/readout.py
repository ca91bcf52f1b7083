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

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.held_means import HeldMeans, class_means
from scroll_tactile.readouts.pruning import ManyMaterials
from scroll_tactile.readouts.system import System, columns_of
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.statistics import Snapshot, Statistics

__all__ = ["EAGER", "Change", "Numbers", "Readout", "ReadoutName", "held_at_first"]

FloatArray = npt.NDArray[np.float64]
Places = npt.NDArray[np.intp]
ReadoutName = Literal["lda", "ridge"]
Change = tuple[str, npt.NDArray[np.int32], int]
"""A material, the rows of codes (k, d) of a touch of it at one scale, and 1 where they came or -1 where they went."""

EAGER = 1024  # materials: of no more than these all are solved for at once, of others the requested ones
MOST_HELD = 2 * EAGER  # then the requested ones are let go


def held_at_first(reference: Places, count: int) -> Places:
    """The places that a readout of so many materials holds at first: the reference, and all where they are few."""
    every: Places = np.arange(count if count <= EAGER else 0)
    return np.concatenate([reference, np.setdiff1d(every, reference)])


class Numbers(NamedTuple):
    """The numbers that a readout was solved with.

    reference: places. origin: shape (d,), in grid units. counts: rows, shape (C,). share: ρ. penalty: P. precision: one
    over the variance of each feature within materials as it was solved, shape (d,).
    """

    reference: Places
    origin: FloatArray
    counts: FloatArray
    share: float
    penalty: float
    precision: FloatArray


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

    names: the materials; a place is an index into them. The other attributes are those of `Numbers`.

    Any number of threads may read a readout of at most EAGER materials at once, a larger one only one thread. `follow`
    changes it in place: while any thread reads it, a copy follows.

    It holds the means of some materials, the reference first, and reads those of the others from `statistics`.
    """

    def __init__(
        self,
        scale: Scale,
        names: Sequence[str],
        statistics: Statistics | Snapshot,
        system: System,
        held_means: HeldMeans,
        numbers: Numbers,
        places: dict[str, int] | None = None,
    ) -> None:
        """places: material → its place, taken over like all arrays; of the names unless given."""
        self.scale, self.names, self.statistics, self.system = scale, list(names), statistics, system
        self.places = {name: place for place, name in enumerate(names)} if places is None else places
        self.held_means = held_means
        self.reference, self.origin, self.counts, self.share, self.penalty, self.precision = numbers
        self._derived: Derived | None = None
        self._many: ManyMaterials | None = None

    @property
    def holds_all(self) -> bool:
        """Whether its materials are few enough to be held, all of them."""
        return len(self.names) <= EAGER

    @property
    def gamma(self) -> float:
        """γ, by which K⁻¹ becomes Σ⁻¹."""
        return float(self.counts.sum()) / (1 - self.share)

    @property
    def shares(self) -> FloatArray:
        """p of the reference materials, shape (R,)."""
        counts = self.counts[self.reference]
        return np.asarray(counts / counts.sum())

    @property
    def nearly_full(self) -> bool:
        """Whether the system has taken in more than three quarters of the columns that it has room for."""
        return self.system.rank > 3 * self.system.room

    def means_solved(self) -> tuple[FloatArray, FloatArray]:
        """The means of the reference materials about the origin, and K⁻¹ times them, each of shape (R, d)."""
        count = len(self.reference)
        return self.held_means.means[:count], self.held_means.solved[:count]

    def _hold(self, places: Sequence[int] | Places, means: FloatArray) -> None:
        """Hold more materials, whose means about the origin are these, shape (k, d)."""
        self.held_means.add(places, means, self.system.solve(means))

    def held(self, places: Sequence[int] | Places) -> Places:
        """The rows of some materials among the held ones; holds those that were not held yet."""
        absent = [int(place) for place in places if int(place) not in self.held_means.rows]
        if absent:
            if len(self.held_means.rows) + len(absent) > MOST_HELD:
                self.held_means.keep(self.reference)
                absent = [int(place) for place in places if int(place) not in self.held_means.rows]
            with one_thread():
                self._hold(absent, self.read_means(absent))
        return np.array([self.held_means.rows[int(place)] for place in places], dtype=np.intp)

    def follow(self, changes: Sequence[Change]) -> bool:
        """Take in touches that came and went, which the statistics have already.

        Returns False where all has to be solved again: the touches are too many, they outweigh the scatter that it was
        solved from, or a material lost its last one.
        """
        if sum(len(rows) for _, rows, _ in changes) > self.system.room:
            return False
        self._derived = None
        if self._many is not None:
            self._many.forget()
        come: dict[str, list[FloatArray]] = {}
        for material, rows, sign in changes:
            if sign > 0:
                come.setdefault(material, []).append(rows - self.origin)
        try:
            with one_thread():
                self._hold_before(changes)
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
        other = self._branch()
        other._derived, other._many = self._derived, None if self._many is None else self._many.copy(other)
        return other

    def without(self, material: str, rows: npt.NDArray[np.float64]) -> Readout:
        """A copy that never observed a touch of these rows, codes (k, d); its material has other touches.

        The caller has set BLAS to one thread.
        """
        other = self._branch()
        other.held([other.places[material]])
        other._follow({material: rows - self.origin}, -1)
        return other

    def _branch(self) -> Readout:
        """A copy without derived matrices that follows independently."""
        numbers = Numbers(self.reference, self.origin, self.counts.copy(), self.share, self.penalty, self.precision)
        system, held = self.system.branch(), self.held_means.copy()
        return Readout(self.scale, self.names, self.statistics, system, held, numbers, dict(self.places))

    def _hold_before(self, changes: Sequence[Change]) -> None:
        """Hold the materials that will change, as they were before."""
        absent: dict[str, list[Change]] = {}
        for change in changes:
            place = self.places.get(change[0])
            if place is not None and place not in self.held_means.rows:
                absent.setdefault(change[0], []).append(change)
        for name, pending in absent.items():
            later = sum((sign * rows.sum(axis=0, dtype=np.int64) for _, rows, sign in pending), np.int64(0))
            total, place = self.statistics.sums(self.scale, [name]) - later, self.places[name]
            self._hold([place], class_means(self.counts[[place]], total, self.origin))

    def _follow(self, changed: Mapping[str, FloatArray], sign: int) -> None:
        """Take in rows of several materials, (k, d) about the origin, in one product: that is faster."""
        held_means = self.held_means
        columns, known, fresh = [], [], []
        for material, came in changed.items():
            place, mean = self.places.get(material), came.mean(axis=0)
            if place is None:
                columns.append(columns_of(came, None))
                fresh.append((material, mean, len(came)))
                continue
            held, before = held_means.rows[place], self.counts[place]
            self.counts[place] = after = before + sign * len(came)
            step = mean - held_means.means[held]
            columns.append(columns_of(came, np.sqrt(before * len(came) / after) * step))
            known.append((place, held, sign * len(came) / after * step))
        self._border(np.concatenate([held_means.means[:0], *columns]), sign)
        for _, held, step in known:
            held_means.means[held] += step
        rows = [held for _, held, _ in known]
        held_means.solved[rows] = self.system.solve(held_means.means[rows])
        held_means.sizes[rows] = np.einsum("hd,hd->h", held_means.means[rows], held_means.solved[rows])
        for material, mean, count in fresh:
            self._hold([self._new_place(material, count)], mean[None])
        if self._many is not None:
            places = np.array([self.places[material] for material in changed], dtype=np.intp)
            self._many.put(places, self.system.whiten(held_means.means[self.held(places)]))

    def _new_place(self, material: str, count: int) -> int:
        place = self.places[material] = len(self.names)
        if len(self.reference) == place:  # the reference is all materials, so this one joins it
            self.reference = np.append(self.reference, place)
        self.names.append(material)
        self.counts = np.append(self.counts, float(count))
        return place

    def _border(self, columns: FloatArray, sign: int) -> None:
        """Add columns to K, and update all that was solved with it."""
        if not len(columns):
            return
        leaving, corner = self.system.border(columns, sign)
        onto = self.held_means.means @ leaving.T
        moved = onto @ corner
        self.held_means.solved -= moved @ leaving
        self.held_means.sizes -= (moved * onto).sum(axis=1)

    @property
    def many(self) -> ManyMaterials:
        """Bounds of the scores of all materials, where these are too many to hold."""
        if self._many is None:
            self._many = ManyMaterials(self)
        return self._many

    @many.setter
    def many(self, many: ManyMaterials) -> None:
        self._many = many

    def derived(self) -> Derived:
        """The matrices of the present state, made again after a change."""
        if self._derived is None:
            shares, (means, solved) = self.shares, self.means_solved()
            with one_thread():
                gram = self.gamma * (means @ solved.T)
                gram = (gram + gram.T) / 2
                onto = gram @ shares
                size = float(shares @ onto)
                gram = gram - onto[:, None] - onto + size
                background = np.linalg.inv(np.diag(1.0 / ((1 - self.share) * shares)) + gram)
            self._derived = Derived(gram, (background + background.T) / 2, onto - size)
        return self._derived

    def _reference_z(self, features: FloatArray) -> FloatArray:
        """z of the reference materials about the origin, shape (R,)."""
        return np.asarray(self.gamma * (self.held_means.solved[: len(self.reference)] @ (features - self.origin)))

    def scores(self, features: FloatArray, places: Sequence[int] | Places, kind: ReadoutName) -> FloatArray:
        """The scores of the materials at some places, not too many to hold, for features of shape (d,), shape (k,)."""
        if kind == "ridge":
            near, beyond = self._beyond_nearest(features)
            scores = self.derived().background @ beyond
            scores[near] += 1.0
            return np.asarray(scores[self.held(places)])
        return np.asarray(self.gamma * self._scores(features, self.held(places)))

    def _scores(self, features: FloatArray, held: Places) -> FloatArray:
        every, sizes = self.held_means.solved, self.held_means.sizes
        row = features - self.origin
        z = (every @ row)[held] if 4 * len(held) > len(every) else every[held] @ row  # picking rows copies them
        return np.asarray(z - sizes[held] / 2)

    def diagonal_distance(self, features: FloatArray, place: int) -> float:
        """The squared Mahalanobis distance of features (d,) from a material's mean, by diagonal scatter as fitted.

        It grows with whatever was never learned, where the relative distance of `novelty` leaves out what no material
        differs in.
        """
        held = self.held_means.rows.get(place)
        mean = self.read_means([place])[0] if held is None else self.held_means.means[held]
        away = features - self.origin - mean
        return float(np.square(away) @ self.precision)

    def linear(self, names: Sequence[str], kind: ReadoutName) -> tuple[FloatArray, FloatArray]:
        """The scores of materials as weights (d, k) of features about the origin, and offsets (k,); see `scores`."""
        held = self.held([self.places[name] for name in names])
        if kind == "lda":
            return self.gamma * self.held_means.solved[held].T, -self.gamma * self.held_means.sizes[held] / 2
        derived, weights = self.derived(), self.gamma * self.held_means.solved[: len(self.reference)].T
        background = derived.background[held]
        mixing = background - np.outer(background.sum(axis=1), self.shares)
        return weights @ mixing.T, np.asarray(self.shares[held] - background @ derived.towards)

    def centred(self, features: FloatArray) -> FloatArray:
        """z of the reference materials about their mean, shape (R,)."""
        z = self._reference_z(features)
        return np.asarray(z - self.shares @ z - self.derived().towards)

    def novelty(self, features: FloatArray, places: Sequence[int] | Places) -> float:
        """Relative Mahalanobis distance of features (d,), the nearest material taken among those at `places`."""
        near, beyond = self._beyond_nearest(features)
        ahead = self.nearest(features, places)[1] - float(self.scores(features, self.reference[[near]], "lda")[0])
        weighed = beyond @ self.derived().background @ beyond
        return float(weighed - (1 / self.shares[near] - 1) / (1 - self.share) - 2.0 * ahead)

    def _beyond_nearest(self, features: FloatArray) -> tuple[int, FloatArray]:
        """The nearest of the reference materials, by its place among them, and v, shape (R,)."""
        count, row = len(self.reference), features - self.origin
        near = int((self.held_means.solved[:count] @ row - self.held_means.sizes[:count] / 2).argmax())
        beyond = self.gamma * (self.held_means.solved[:count] @ (row - self.held_means.means[near]))
        beyond[near] -= 1 / ((1 - self.share) * self.shares[near])
        return near, np.asarray(beyond - self.shares @ beyond)

    def nearest(self, features: FloatArray, places: Sequence[int] | Places) -> tuple[int, float]:
        """Of the materials at some places the one of the highest score "lda", by its place, and that score."""
        if len(places) > EAGER:
            return self.many.nearest(features, np.asarray(places))
        chosen = np.asarray(places)
        scores = self.scores(features, chosen, "lda")
        best = int(scores.argmax())
        return int(chosen[best]), float(scores[best])

    def read_means(self, places: Iterable[int]) -> FloatArray:
        """The means of materials at some places about the origin, (k, d), from the memory."""
        names = [self.names[place] for place in places]
        counts, sums = self.statistics.counts(self.scale, names), self.statistics.sums(self.scale, names)
        return class_means(counts, sums, self.origin)
