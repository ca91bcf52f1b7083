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

from bisect import bisect_right
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.triangle import InverseTriangle
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import Sums, one_thread
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["BLOCK", "Means", "Readout", "ReadoutName", "Solution"]

FloatArray = npt.NDArray[np.float64]
Floats = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.int64]
Places = npt.NDArray[np.intp]
ReadoutName = Literal["lda", "ridge"]

BLOCK = 512  # materials beyond the reference that are held and solved for together: in single precision 2 MB


class Solution(NamedTuple):
    """What of a readout stays as it was solved.

    origin: the mean of all rows, shape (d,), in grid units. triangle: L⁻¹ of K. rows: N. share: ρ. penalty: P.
    precision: one over the variance of each feature within materials, shape (d,).
    """

    origin: FloatArray
    triangle: InverseTriangle
    rows: int
    share: float
    penalty: float
    precision: FloatArray


class Means:
    """The means m of n materials, n ≥ 0, about a readout's origin, and what is solved for them: it never changes.

    counts: rows, shape (n,), sums: of their codes, (n, d), both exact. single: whether K⁻¹ m is held in single
    precision. It is solved for when it is first asked for; of threads that ask at once each solves, to the same bits.
    """

    def __init__(self, counts: IntArray, sums: Sums, solution: Solution, *, single: bool = False) -> None:
        self.counts, self.sums, self.single = counts, sums, single
        self._solution = solution
        self._solved: tuple[Floats, FloatArray] | None = None

    def __len__(self) -> int:
        return len(self.counts)

    @property
    def means(self) -> FloatArray:
        """m, shape (n, d), formed anew each time."""
        return self.means_at(slice(None))

    @property
    def solved(self) -> Floats:
        """K⁻¹ m, shape (n, d)."""
        return self._solve()[0]

    @property
    def sizes(self) -> FloatArray:
        """mᵀ K⁻¹ m, shape (n,)."""
        return self._solve()[1]

    def means_at(self, rows: slice | Sequence[int]) -> FloatArray:
        """m of some of them, shape (k, d)."""
        return about(self.counts[rows], self.sums[rows], self._solution.origin)

    def scores(self, row: FloatArray, rows: slice | Places = slice(None)) -> FloatArray:
        """mᵀ K⁻¹ x − mᵀ K⁻¹ m / 2 of some of them, for a row x of shape (d,) about the origin."""
        solved, sizes = self._solve()
        return np.asarray(solved[rows] @ row.astype(solved.dtype, copy=False) - sizes[rows] / 2)

    def changed(self, rows: Sequence[int], counts: IntArray, sums: Sums) -> Means:
        """The same with other counts (k,) and sums (k, d) at some rows.

        Rows past the end are appended; materials without rows any more are taken out.
        """
        size, live = max(len(self), *(row + 1 for row in rows)), [row for row, n in zip(rows, counts, strict=True) if n]

        def put(held: npt.NDArray[Any], into: Sequence[int], new: npt.NDArray[Any]) -> npt.NDArray[Any]:
            found = np.empty((size, *held.shape[1:]), np.result_type(held, new))
            found[: len(self)] = held
            found[into] = new
            return found

        other = Means(put(self.counts, rows, counts), put(self.sums, rows, sums), self._solution, single=self.single)
        stay = slice(None) if counts.all() else other.counts > 0
        if self._solved is not None:
            solved, sizes = other._solve_at(live)
            other._solved = put(self._solved[0], live, solved)[stay], put(self._solved[1], live, sizes)[stay]
        other.counts, other.sums = other.counts[stay], other.sums[stay]
        return other

    def _solve(self) -> tuple[Floats, FloatArray]:
        if self._solved is None:
            self._solved = self._solve_at(slice(None))
        return self._solved

    def _solve_at(self, rows: slice | Sequence[int]) -> tuple[Floats, FloatArray]:
        with one_thread():
            means = self.means_at(rows)
            solved = self._solution.triangle.solve(means)
            sizes = np.einsum("nd,nd->n", means, solved)
        return solved.astype(np.float32 if self.single else np.float64, copy=False), sizes


def about(counts: IntArray, sums: Sums, origin: FloatArray) -> FloatArray:
    """Means of materials about an origin, (n, d) in grid units, of their counts (n,) and sums (n, d)."""
    # Sums about the integers nearest to the origin are exact, so a mean close to the origin loses no digits.
    near = np.rint(origin)
    return np.asarray((sums - np.outer(counts, near.astype(np.int64))) / counts[:, None] - (origin - near))


@dataclass(frozen=True)
class Derived:
    """The matrices that ridge and novelty need of a readout.

    gram: G of the reference materials about their mean, shape (R, R). background: H. towards: subtracted from z, after
    its mean, to move its origin to the mean of the reference materials, shape (R,).
    """

    gram: FloatArray
    background: FloatArray
    towards: FloatArray


class Readout:
    """The readout of one scale: solved from a task, or the one that followed such a one. It never changes.

    names: the materials; a place is an index into them. near: the reference materials, which are the first. others:
    those after them, in blocks. counts: rows, shape (C,). The other attributes are those of `Solution`.

    Any number of threads may use it at once.
    """

    def __init__(
        self, scale: Scale, names: Sequence[str], near: Means, others: Sequence[Means], solution: Solution
    ) -> None:
        self.scale, self.names, self.near, self.solution = scale, list(names), near, solution
        self.origin, self.triangle, self.rows, self.share, self.penalty, self.precision = solution
        self.others = tuple(block for block in others if len(block))
        self.places = {name: place for place, name in enumerate(self.names)}
        self.counts = np.concatenate([part.counts for part in self._parts]).astype(np.float64)
        self._firsts = [0, *accumulate(len(part) for part in self._parts)]
        self._derived: Derived | None = None
        self._scored: tuple[FloatArray, FloatArray] | None = None  # the last touch, and its scores of all materials

    @property
    def _parts(self) -> tuple[Means, ...]:
        return (self.near, *self.others)

    @property
    def reference(self) -> list[str]:
        """The reference materials."""
        return self.names[: len(self.near)]

    @property
    def gamma(self) -> float:
        """γ, by which K⁻¹ becomes Σ⁻¹."""
        return self.rows / (1 - self.share)

    @property
    def shares(self) -> FloatArray:
        """p of the reference materials, shape (R,)."""
        counts = self.counts[: len(self.near)]
        return np.asarray(counts / counts.sum())

    def followed(self, statistics: Statistics, changed: Collection[str]) -> Readout | None:
        """The readout of the present statistics, with what `Solution` has as it was solved; None without a reference.

        changed: materials of which touches came or went since this one was solved or followed; of others no sum may
        have changed. A new one joins the reference where that is all materials. The caller holds the statistics' lock.
        """
        names = sorted(set(changed))
        counts = statistics.counts(self.scale, names)
        _, there = statistics.totals(self.scale, [name for name, count in zip(names, counts, strict=True) if count])
        sums = np.zeros((len(names), len(self.origin)), there.dtype)
        sums[counts > 0] = there
        moved: list[dict[int, int]] = [{} for _ in self._parts]  # row → place among the names
        come = []
        for i, name in enumerate(names):
            if name in self.places:
                number, row = self._at(self.places[name])
                part = self._parts[number]
                if part.counts[row] != counts[i] or (part.sums[row] != sums[i]).any():
                    moved[number][row] = i
            elif counts[i]:
                come.append(i)
        room = BLOCK - len(self.others[-1]) if self.others else len(come)
        moved[-1].update(enumerate(come[:room], len(self._parts[-1])))
        parts = [
            part.changed(list(rows), counts[list(rows.values())], sums[list(rows.values())]) if rows else part
            for part, rows in zip(self._parts, moved, strict=True)
        ]
        for own in (come[first : first + BLOCK] for first in range(room, len(come), BLOCK)):
            parts.append(Means(counts[own], sums[own], self.solution, single=parts[-1].single))
        if not len(parts[0]):
            return None
        gone = {name for name, count in zip(names, counts, strict=True) if not count}
        left = [name for name in self.names if name not in gone]
        return Readout(self.scale, [*left, *(names[i] for i in come)], parts[0], parts[1:], self.solution)

    def _at(self, place: int) -> tuple[int, int]:
        """Which part holds a material, and its row there."""
        number = bisect_right(self._firsts, place) - 1
        return number, place - self._firsts[number]

    def _among(self, places: Places) -> Iterator[tuple[npt.NDArray[np.bool_], Means, Places]]:
        """For each part that holds some of the places: which ones, the part, and their rows there."""
        for part, first in zip(self._parts, self._firsts, strict=False):
            own = (places >= first) & (places < first + len(part))
            if own.any():
                yield own, part, places[own] - first

    def derived(self) -> Derived:
        """The matrices that ridge and novelty need, made when they are first asked for."""
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
        row, scores = features - self.origin, np.empty(len(chosen))
        for own, part, rows in self._among(chosen):
            scores[own] = part.scores(row, rows)
        return np.asarray(self.gamma * scores)

    def _scores_of_all(self, features: FloatArray) -> FloatArray:
        """The scores "lda" over γ of all materials; the last ones are kept, as each touch is asked about repeatedly."""
        scored = self._scored
        if scored is None or scored[0] is not features:
            row = features - self.origin
            scored = self._scored = features, np.concatenate([part.scores(row) for part in self._parts])
        return scored[1]

    def diagonal_distance(self, features: FloatArray, place: int) -> float:
        """The squared Mahalanobis distance of features (d,) from a material's mean, by diagonal scatter as fitted.

        It grows with whatever was never learned, where the relative distance of `novelty` leaves out what no material
        differs in.
        """
        number, row = self._at(place)
        away = features - self.origin - self._parts[number].means_at([row])[0]
        return float(np.square(away) @ self.precision)

    def linear(self, names: Sequence[str], kind: ReadoutName) -> tuple[FloatArray, FloatArray]:
        """The scores of materials as weights (d, k) of features about the origin, and offsets (k,); see `scores`."""
        places = [self.places[name] for name in names]
        if kind == "lda":
            found = [(self._parts[number], row) for number, row in map(self._at, places)]
            solved = np.array([part.solved[row] for part, row in found], dtype=np.float64)
            return self.gamma * solved.T, -self.gamma * np.array([part.sizes[row] for part, row in found]) / 2
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
        beyond = self.gamma * (self.near.solved @ (row - self.near.means_at([near])[0]))
        beyond[near] -= 1 / ((1 - self.share) * self.shares[near])
        return near, np.asarray(beyond - self.shares @ beyond)
