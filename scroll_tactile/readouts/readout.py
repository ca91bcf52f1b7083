"""Readouts: discriminants of one scale, solved once from the exact statistics and followed from touch to touch.

With class means m_y, the scatter within classes S_w of N rows and its shrinkage ρ (see `shrinkage`), Σ⁻¹ = γ K⁻¹ with
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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.derived import Derived
from scroll_tactile.readouts.pruning import Compared, PruningTable, likeliest, principal_directions
from scroll_tactile.readouts.shrinkage import shrinkage
from scroll_tactile.readouts.system import System, columns_of
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import Sums, one_thread, within_scatter
from scroll_tactile.statistics.statistics import Snapshot, Statistics

__all__ = ["EAGER", "Change", "Readout", "ReadoutName", "Task"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Places = npt.NDArray[np.intp]
ReadoutName = Literal["lda", "ridge"]
Change = tuple[str, npt.NDArray[np.int32], int]
"""A material, the rows of codes (k, d) of a touch of it at one scale, and 1 where they came or -1 where they went."""

EAGER = 1024  # materials: of no more than these all are solved for at once, of others those that are asked for
FIRST_KNOWN = 256  # materials
AT_ONCE = 64  # materials whose means are read at once: they stay in the processor's cache
MOST_HELD = 2 * EAGER  # then those that were asked for are let go


@dataclass(frozen=True)
class Task:
    """What a readout is solved from: the statistics at one moment, so that solving waits for nobody.

    packed: A, as in SecondMoment. names: the materials with rows, counts: their rows, shape (C,), sums: of their codes,
    shape (C, d). reference: the places of the materials that novelty and calibration rest on. touches: n.
    times: how many times as far as the formula says the scatter is shrunk.
    """

    scale: Scale
    packed: IntArray
    names: list[str]
    counts: IntArray
    sums: Sums
    reference: Places
    touches: int
    times: float = 1.0

    @classmethod
    def of(cls, statistics: Statistics, scale: Scale, reference: Sequence[str], times: float = 1.0) -> Task:
        """The task of a scale that has rows. reference: materials, of which those with rows at the scale count."""
        names = statistics.names(scale)
        places = {name: place for place, name in enumerate(names)}
        # Of no touch that was sampled may any have rows here: then the first materials that have.
        known = [places[name] for name in reference if name in places] or range(min(len(names), FIRST_KNOWN))
        own = np.array(known, dtype=np.intp)
        packed, (counts, sums) = statistics.second(scale).packed(), statistics.totals(scale)
        return cls(scale, packed, names, counts, sums, own, statistics.touches, times)

    @property
    def scatter(self) -> FloatArray:
        """S_w, shape (d, d): the lower triangle, formed anew each time."""
        return within_scatter(self.packed, self.counts, self.sums)

    @property
    def origin(self) -> FloatArray:
        """The mean of all rows, shape (d,)."""
        return np.asarray(
            (self.sums.sum(axis=0, dtype=np.int64).astype(np.longdouble) / self.counts.sum()).astype(np.float64)
        )


def _class_means(counts: IntArray | FloatArray, sums: Sums, origin: FloatArray) -> FloatArray:
    """The means of materials about an origin, shape (C, d), in codes."""
    # About the integers next to the origin, exactly: a class mean keeps the digits that its distance from it needs.
    near = np.rint(origin)
    means: FloatArray = (sums - np.outer(counts.astype(np.int64), near.astype(np.int64))) / counts[:, None]
    means -= origin - near
    return means


class Readout:
    """The readout of one scale: of a task, and of the touches that came and went since.

    names: the materials; one is known by its place among them. reference: places. origin: shape (d,), in codes.
    counts: rows, shape (C,). share: ρ. penalty: P. precision: one over the variance of each feature within materials as
    it was solved, shape (d,).

    Any number of threads may ask one of at most EAGER materials at once, and one thread one of more. It follows where
    nobody asks: otherwise a copy does.

    Some materials are held, with all that scores need: the reference first. The others are read from `statistics`.

    Raises numpy.linalg.LinAlgError where K is not positive definite to working precision.
    """

    def __init__(self, task: Task, statistics: Statistics | Snapshot, like: Readout | None = None) -> None:
        """Solve it. like: an earlier one of the same reference, to which scores stay comparable."""
        self.scale = task.scale
        self.names = list(task.names)
        self.places = {name: place for place, name in enumerate(self.names)}
        self.reference = task.reference
        self.origin = task.origin
        self.counts = task.counts.astype(np.float64)
        self.statistics = statistics
        matrix = task.scatter
        trace, dimension = float(np.trace(matrix)), len(matrix)
        self.share = 0.0
        if trace > 0:
            self.share = shrinkage(matrix, task.touches, task.times) if like is None else like.share
        all_places: Places = np.arange(len(self.names) if len(self.names) <= EAGER else 0)
        places = np.concatenate([task.reference, np.setdiff1d(all_places, task.reference)])
        means = _class_means(task.counts[places], task.sums[places], self.origin)
        # Of single touches there is no scatter: then the nearest mean answers.
        spread = trace / dimension * self.share / (1 - self.share)
        self.penalty = spread if trace > 0 else max(float(np.mean(np.square(means))), 1.0)
        matrix[np.diag_indices(dimension)] += self.penalty
        self.precision: FloatArray = self.counts.sum() / np.diagonal(matrix) if like is None else like.precision
        self._held: dict[int, int] = {}  # place → row of these
        self._room = np.empty((0, 2, dimension))
        self._means, self._solved = self._room[:, 0], self._room[:, 1]  # m about the origin, and K⁻¹ m
        self._sizes = np.empty(0)  # mᵀ K⁻¹ m
        self._derived: Derived | None = None
        self._table: PruningTable | None = None
        self._most_lost: float | None = None
        self._compared: tuple[FloatArray, Compared] | None = None
        with one_thread():
            self.system = System(matrix)
            self._hold(places, means)

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """What the answers for the materials that are held rest on: all but the names and K.

        reference: places, (R,). held: places in the order of what is held, (H,). rows: their means about the origin,
        and K⁻¹ times these, (H, 2, d). sizes: (H,). origin, precision: (d,). counts: (C,). shape: share and penalty.
        """
        return {
            "reference": self.reference,
            "held": np.array(sorted(self._held, key=self._held.__getitem__), dtype=np.int64),
            "rows": self._room[: len(self._held)],
            "sizes": self._sizes,
            "origin": self.origin,
            "precision": self.precision,
            "counts": self.counts,
            "shape": np.array([self.share, self.penalty]),
        }

    @classmethod
    def from_arrays(
        cls, scale: Scale, names: Sequence[str], arrays: Mapping[str, npt.NDArray[Any]], statistics: Statistics
    ) -> Readout:
        """The readout of which `to_arrays` gave the arrays, which are taken over; it can follow nothing."""
        readout = cls.__new__(cls)
        readout.scale, readout.names, readout.statistics = scale, list(names), statistics
        readout.places = {name: place for place, name in enumerate(names)}
        readout.reference, readout.origin, readout.counts = arrays["reference"], arrays["origin"], arrays["counts"]
        readout.share, readout.penalty = arrays["shape"].tolist()
        readout.precision, readout._sizes, readout._room = arrays["precision"], arrays["sizes"], arrays["rows"]
        readout._held = {place: row for row, place in enumerate(arrays["held"].tolist())}
        readout._means, readout._solved = readout._room[:, 0], readout._room[:, 1]
        readout._derived = readout._table = readout._most_lost = readout._compared = None
        readout.system = System.unkept(len(readout.origin))
        return readout

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
    def pressed(self) -> bool:
        """Whether three quarters of them have."""
        return self.system.rank > 3 * self.system.room

    def means_solved(self) -> tuple[FloatArray, FloatArray]:
        """The means of the reference materials about the origin, and K⁻¹ times them, each of shape (R, d)."""
        count = len(self.reference)
        return self._means[:count], self._solved[:count]

    def _hold(self, places: Sequence[int] | Places, means: FloatArray) -> None:
        """Hold more materials, whose means about the origin are these, shape (k, d)."""
        solved, first = self.system.solve(means), len(self._held)
        last = first + len(means)
        if last > len(self._room):
            # Room for half as many more, if there are any: materials that are asked for come one by one. All of it
            # before any is kept: there may be no memory for it.
            room = np.empty((last if not first else last + last // 2, 2, means.shape[1]))
            room[:first] = self._room[:first]
            self._room = room
        self._room[first:last, 0], self._room[first:last, 1] = means, solved
        self._sizes = np.append(self._sizes[:first], np.einsum("hd,hd->h", means, solved))
        self._means, self._solved = self._room[:last, 0], self._room[:last, 1]
        self._held |= {int(place): first + i for i, place in enumerate(places)}

    def held(self, places: Sequence[int] | Places) -> Places:
        """Where the materials at some places are held; those that were not are from now on."""
        absent = [int(place) for place in places if int(place) not in self._held]
        if absent:
            if len(self._held) + len(absent) > MOST_HELD:
                self._let_go()
                absent = [int(place) for place in places if int(place) not in self._held]
            with one_thread():
                self._hold(absent, self._read_means(absent))
        return np.array([self._held[int(place)] for place in places], dtype=np.intp)

    def _let_go(self) -> None:
        count = len(self.reference)
        self._held = {int(place): i for i, place in enumerate(self.reference)}
        self._means, self._solved, self._sizes = self._means[:count], self._solved[:count], self._sizes[:count]

    def follow(self, changes: Sequence[Change]) -> bool:
        """Take in touches that came and went, which the statistics have already.

        Returns False where all has to be solved again: they are too many, outweigh what it was solved from, or a
        material went.
        """
        if sum(len(rows) for _, rows, _ in changes) > self.system.room:
            return False
        self._derived = self._compared = self._most_lost = None
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
        except np.linalg.LinAlgError:  # nearly all that it was solved from went
            return False
        return self.system.sound

    def copy(self) -> Readout:
        """Another readout of the same: what comes to it does not come to this one."""
        other = self._branch()
        other.names, other.places = [*self.names], dict(self.places)
        other._derived, other._table = self._derived, None if self._table is None else self._table.copy()
        return other

    def without(self, material: str, rows: npt.NDArray[np.float64]) -> Readout:
        """Another readout, that never had a touch of these rows, codes (k, d); of a material that has others.

        Whoever calls has BLAS on one thread.
        """
        other = self._branch()
        other.held([other.places[material]])
        other._follow({material: rows - self.origin}, -1)
        return other

    def _branch(self) -> Readout:
        """Another readout, which follows by itself as long as no material is new to it."""
        other = copy.copy(self)
        other.system = self.system.branch()
        other.counts, other._held, other._sizes = self.counts.copy(), dict(self._held), self._sizes.copy()
        other._room = np.stack([self._means, self._solved], axis=1)
        other._means, other._solved = other._room[:, 0], other._room[:, 1]
        other._derived = other._compared = other._table = other._most_lost = None
        return other

    def _hold_before(self, changes: Sequence[Change]) -> None:
        """Hold the materials that will change, as they were before."""
        absent: dict[str, list[Change]] = {}
        for change in changes:
            place = self.places.get(change[0])
            if place is not None and place not in self._held:
                absent.setdefault(change[0], []).append(change)
        for name, pending in absent.items():
            later = sum((sign * rows.sum(axis=0, dtype=np.int64) for _, rows, sign in pending), np.int64(0))
            total, place = self.statistics.sums(self.scale, [name]) - later, self.places[name]
            self._hold([place], _class_means(self.counts[[place]], total, self.origin))

    def _follow(self, changed: Mapping[str, FloatArray], sign: int) -> None:
        """Take in rows of some materials, (k, d) about the origin, at once: one product in place of many thin ones."""
        columns, known, fresh = [], [], []
        for material, rows in changed.items():
            place, mean = self.places.get(material), rows.mean(axis=0)
            if place is None:
                columns.append(columns_of(rows, None))
                fresh.append((material, mean, len(rows)))
                continue
            held, before = self._held[place], self.counts[place]
            self.counts[place] = after = before + sign * len(rows)
            step = mean - self._means[held]
            columns.append(columns_of(rows, np.sqrt(before * len(rows) / after) * step))
            known.append((place, held, sign * len(rows) / after * step))
        self._border(np.concatenate([self._means[:0], *columns]), sign)
        for _, held, step in known:
            self._means[held] += step
        rows_held = [held for _, held, _ in known]
        self._solved[rows_held] = self.system.solve(self._means[rows_held])
        self._sizes[rows_held] = np.einsum("hd,hd->h", self._means[rows_held], self._solved[rows_held])
        for material, mean, count in fresh:
            self._hold([self._new_place(material, count)], mean[None])
        if self._table is not None:
            places = np.array([self.places[material] for material in changed], dtype=np.intp)
            self._table.put(places, self.system.whiten(self._means[self.held(places)]))

    def _new_place(self, material: str, count: int) -> int:
        place = self.places[material] = len(self.names)
        if len(self.reference) == place:  # all materials, and this one too
            self.reference = np.append(self.reference, place)
        self.names.append(material)
        self.counts = np.append(self.counts, float(count))
        return place

    def _border(self, columns: FloatArray, sign: int) -> None:
        """Take columns into K, with all that is solved of it."""
        if not len(columns):
            return
        leaving, corner = self.system.border(columns, sign)
        onto = self._means @ leaving.T
        moved = onto @ corner
        self._solved -= moved @ leaving
        self._sizes -= (moved * onto).sum(axis=1)

    def derived(self) -> Derived:
        """What the answers of this moment need, made again after a change."""
        found = self._derived
        if found is None:
            self._derived = found = Derived.of(self)
        return found

    def _reference_z(self, codes: FloatArray) -> FloatArray:
        """z of the reference materials about the origin, shape (R,)."""
        return np.asarray(self.gamma * (self._solved[: len(self.reference)] @ (codes - self.origin)))

    def scores(self, codes: FloatArray, places: Sequence[int] | Places, kind: ReadoutName) -> FloatArray:
        """The scores of the materials at some places, not too many to hold, for codes of shape (d,), shape (k,)."""
        if kind == "ridge":
            near, beyond = self._beyond_nearest(codes)
            scores = self.derived().background @ beyond
            scores[near] += 1.0
            return np.asarray(scores[self.held(places)])
        return np.asarray(self.gamma * self._scores(codes, self.held(places)))

    def _scores(self, codes: FloatArray, held: Places) -> FloatArray:
        solved = self._solved if 4 * len(held) > len(self._solved) else None  # picking rows copies them
        row = codes - self.origin
        z = self._solved[held] @ row if solved is None else (solved @ row)[held]
        return np.asarray(z - self._sizes[held] / 2)

    def strangeness(self, codes: FloatArray, place: int) -> float:
        """The squared distance of codes (d,) from a material's mean, in variances of each feature as it was fitted.

        It grows with whatever was never learned, where the relative distance of `novelty` leaves out what no material
        differs in.
        """
        held = self._held.get(place)
        mean = self._read_means([place])[0] if held is None else self._means[held]
        away = codes - self.origin - mean
        return float(np.square(away) @ self.precision)

    def linear(self, names: Sequence[str], kind: ReadoutName) -> tuple[FloatArray, FloatArray]:
        """The scores of materials as weights (d, k) of codes about the origin, and offsets (k,); see `scores`."""
        held = self.held([self.places[name] for name in names])
        if kind == "lda":
            return self.gamma * self._solved[held].T, -self.gamma * self._sizes[held] / 2
        derived, weights = self.derived(), self.gamma * self._solved[: len(self.reference)].T
        background = derived.background[held]
        mixing = background - np.outer(background.sum(axis=1), self.shares)
        return weights @ mixing.T, np.asarray(self.shares[held] - background @ derived.towards)

    def centred(self, codes: FloatArray) -> FloatArray:
        """z of the reference materials about their mean, shape (R,)."""
        z = self._reference_z(codes)
        return np.asarray(z - self.shares @ z - self.derived().towards)

    def novelty(self, codes: FloatArray, places: Sequence[int] | Places) -> float:
        """Relative Mahalanobis distance of codes (d,); the materials at `places` are those that may be the nearest."""
        near, beyond = self._beyond_nearest(codes)
        ahead = self.nearest(codes, places)[1] - float(self.scores(codes, self.reference[[near]], "lda")[0])
        weighed = beyond @ self.derived().background @ beyond
        return float(weighed - (1 / self.shares[near] - 1) / (1 - self.share) - 2.0 * ahead)

    def _beyond_nearest(self, codes: FloatArray) -> tuple[int, FloatArray]:
        """The nearest of the reference materials, by its place among them, and v, shape (R,)."""
        count, row = len(self.reference), codes - self.origin
        near = int((self._solved[:count] @ row - self._sizes[:count] / 2).argmax())
        beyond = self.gamma * (self._solved[:count] @ (row - self._means[near]))
        beyond[near] -= 1 / ((1 - self.share) * self.shares[near])
        return near, np.asarray(beyond - self.shares @ beyond)

    def nearest(self, codes: FloatArray, places: Sequence[int] | Places) -> tuple[int, float]:
        """Of the materials at some places the one of the highest score "lda", by its place, and that score."""
        chosen = np.asarray(places)
        if len(chosen) <= EAGER:
            scores = self.scores(codes, chosen, "lda")
        else:
            chosen, scores = likeliest(
                chosen, lambda some, fine: self.bounds(codes, some, fine=fine > 0), lambda some: self.exact(codes, some)
            )
        best = int(scores.argmax())
        return int(chosen[best]), float(scores[best])

    def bounds(self, codes: FloatArray, places: Places, *, fine: bool = False) -> tuple[FloatArray, FloatArray]:
        """Guesses of the scores "lda" of some of many materials, and what they are at most, each of shape (k,)."""
        compared = self._beside(codes)
        if fine:
            compared.refine(places)
        return compared.guess[places], compared.most[places]

    def _beside(self, codes: FloatArray) -> Compared:
        """Codes (d,) beside all of many materials; the latest are kept."""
        if self._compared is None or self._compared[0] is not codes:
            with one_thread():
                if self._table is None:
                    self._table = self._tabled()
                if self._most_lost is None:
                    self._most_lost = self.system.most_lost
                white = self.system.towards((codes - self.origin)[None])
                solved = self.system.solve_whitened(white)[0]
                compared = self._table.compared(white[0], self._most_lost, self.gamma, solved)
            compared.take(self.reference, self.scores(codes, self.reference, "lda"))  # they are held
            self._compared = codes, compared
        return self._compared[1]

    def exact(self, codes: FloatArray, places: Places) -> FloatArray:
        """The scores "lda" of any of many materials, which are not held for it, for codes of shape (d,), shape (k,)."""
        compared = self._beside(codes)
        unknown = places[~compared.known[places]]
        with one_thread():
            for first in range(0, len(unknown), AT_ONCE):
                some = unknown[first : first + AT_ONCE]
                means, sizes = self._read_means(some), compared.table.sizes[some]
                if self.system.rank:
                    sizes = sizes - self.system.lost(self.system.whiten(means))
                compared.take(some, self.gamma * (means @ compared.solved - sizes / 2))
        return compared.guess[places]

    def _read_means(self, places: Iterable[int]) -> FloatArray:
        """The means of materials at some places about the origin, (k, d), from the memory."""
        names = [self.names[place] for place in places]
        counts, sums = self.statistics.counts(self.scale, names), self.statistics.sums(self.scale, names)
        return _class_means(counts, sums, self.origin)

    def _tabled(self) -> PruningTable:
        whiten, count = self.system.whiten, len(self.names)
        blocks = (range(first, min(first + EAGER, count)) for first in range(0, count, EAGER))
        directions = principal_directions(whiten(self.means_solved()[0]))
        return PruningTable(directions, (whiten(self._read_means(block)) for block in blocks), count)
