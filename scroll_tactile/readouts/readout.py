"""Readouts: discriminants of one scale, solved once from the exact statistics and followed from touch to touch.

With class means m_y, the scatter within classes S_w of N rows and its shrinkage ρ (see `shrinkage`), Σ⁻¹ = γ K⁻¹ with
K = S_w + P I, P = ρ / (1 − ρ) tr S_w / d and γ = N / (1 − ρ). All that answers need of a row x are

    z_y = γ m_yᵀ K⁻¹ x,    g_y = γ m_yᵀ K⁻¹ m_y,    G = γ M K⁻¹ Mᵀ of some reference materials,

rows and means about a fixed origin, and with p_y the shares of the reference materials and z, G about their mean:

- lda, linear discriminant analysis:      s_y = z_y − g_y / 2;
- ridge on 0/1 targets, the paper's f_t:  s = p + H z,    H = (((1 − ρ) P)⁻¹ + G)⁻¹    (push-through identity);
- relative Mahalanobis distance (Ren et al. 2021, arXiv 2106.09022), the distance to the nearest class less that to the
  whole, whose covariance is Σ + (1 − ρ) Mᵀ P M:  −2 max_y s_y(lda) + zᵀ H z    (Woodbury; xᵀ Σ⁻¹ x cancels).

A touch of a known class adds to S_w its rows about their mean and its way √(n k / (n + k)) (x̄ − m). With U all such
columns since K was inverted and D their signs, −1 for what was retracted (Woodbury 1950):

    (K + Uᵀ D U)⁻¹ = K⁻¹ − Vᵀ E V,    V = U K⁻¹,    E = (D + U K⁻¹ Uᵀ)⁻¹,

at 2 d² operations a row. Nothing drifts: U grows to a part of d, and then K is inverted again from the integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.shrinkage import shrinkage
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import one_thread, within_scatter
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["EAGER", "Change", "Readout", "ReadoutName", "Task", "columns_of", "contrasts", "inverted"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Places = npt.NDArray[np.intp]
ReadoutName = Literal["lda", "ridge"]
Change = tuple[str, npt.NDArray[np.int32], int]
"""A material, the rows of codes (k, d) of a touch of it at one scale, and 1 where they came or -1 where they went."""

EAGER = 1024  # materials: of no more than these all are solved for at once, of others those that are asked for
LARGEST_RANK = 4  # d over this: so many columns may come before K is inverted again
LEAST_RANK = 32
FEW = 8  # rows that are solved for one by one: half of the time of a product of matrices


@dataclass(frozen=True)
class Task:
    """What a readout is solved from, copied from the statistics at one moment, so that solving waits for nobody.

    packed: A, as in SecondMoment. names: the materials with rows, counts: their rows, shape (C,), sums: of their codes,
    shape (C, d). reference: the places of the materials that novelty and calibration rest on. touches: n.
    """

    scale: Scale
    packed: IntArray
    names: list[str]
    counts: IntArray
    sums: IntArray
    reference: Places
    touches: int

    @classmethod
    def of(cls, statistics: Statistics, scale: Scale, reference: Sequence[str]) -> Task:
        """The task of a scale that has rows. reference: materials, of which those with rows at the scale count."""
        names = statistics.names(scale)
        places = {name: place for place, name in enumerate(names)}
        own = np.array([places[name] for name in reference if name in places], dtype=np.intp)
        packed, (counts, sums) = statistics.second(scale).packed().copy(), statistics.totals(scale)
        return cls(scale, packed, names, counts, sums, own, statistics.touches)

    @cached_property
    def scatter(self) -> FloatArray:
        """S_w, shape (d, d), upper triangle in Fortran's order."""
        return within_scatter(self.packed, self.counts, self.sums)

    @property
    def origin(self) -> FloatArray:
        """The mean of all rows, shape (d,)."""
        return np.asarray((self.sums.sum(axis=0).astype(np.longdouble) / self.counts.sum()).astype(np.float64))


def class_means(counts: IntArray, sums: IntArray, origin: FloatArray) -> FloatArray:
    """The means of materials about an origin, shape (C, d), in codes."""
    # Long double: a class mean keeps the digits that its distance from the origin needs.
    return (sums.astype(np.longdouble) / counts[:, None] - origin).astype(np.float64)


def inverted(system: FloatArray) -> FloatArray:
    """The inverse of a positive definite system, both upper triangles in Fortran's order; the system is taken over.

    Raises numpy.linalg.LinAlgError where it is not positive definite to working precision.
    """
    from scipy.linalg.lapack import dpotrf, dpotri

    factor, failed = dpotrf(system, lower=0, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError(f"the scatter with its ridge is not positive definite at row {failed}")
    inverse: FloatArray = dpotri(factor, lower=0, overwrite_c=1)[0]
    return inverse


@lru_cache(maxsize=64)
def contrasts(count: int) -> FloatArray:
    """Helmert's orthonormal contrasts of so many rows, shape (count − 1, count): their Gram matrix is the centring."""
    contrasts = np.zeros((count - 1, count))
    for i in range(1, count):
        contrasts[i - 1, :i], contrasts[i - 1, i] = 1.0, -float(i)
        contrasts[i - 1] /= np.sqrt(i * (i + 1.0))
    return contrasts


def columns_of(rows: FloatArray, way: FloatArray | None) -> FloatArray:
    """What rows, shape (k, d), add to the scatter: their contrasts, and the way of the class mean where there is one."""
    own = contrasts(len(rows)) @ rows if len(rows) > 1 else rows[:0]
    return own if way is None else np.vstack([own, way])


class Readout:
    """The readout of one scale: of a task, and of the touches that came and went since.

    names: the materials, in the order of their places. penalty: P. share: ρ. rows: N. Not for several threads at once.

    Raises numpy.linalg.LinAlgError where K is not positive definite to working precision.
    """

    def __init__(self, task: Task, statistics: Statistics) -> None:
        self.scale = task.scale
        self.names = list(task.names)
        self.places = {name: place for place, name in enumerate(self.names)}
        self.reference = task.reference
        self.origin = task.origin
        self.counts = task.counts.astype(np.float64)
        self._statistics = statistics
        dimension = len(self.origin)
        held = np.arange(len(self.names)) if len(self.names) <= EAGER else task.reference
        means = class_means(task.counts[held], task.sums[held], self.origin)
        scatter = task.scatter.copy(order="F")
        trace = float(np.trace(scatter))
        self.share = shrinkage(scatter, task.touches) if trace > 0 else 0.0
        # Of single touches there is no scatter: then the nearest mean answers.
        spread = trace / dimension * self.share / (1 - self.share)
        self.penalty = spread if trace > 0 else max(float(np.mean(np.square(means))), 1.0)
        scatter[np.diag_indices(dimension)] += self.penalty
        room = max(LEAST_RANK, dimension // LARGEST_RANK)
        self._rank = 0
        self._u, self._v = np.empty((room, dimension)), np.empty((room, dimension))
        self._inner = np.empty((room, room))  # E
        self._held: dict[int, int] = {}  # place → row of the next three
        self._means = np.empty((0, dimension))
        self._solved = np.empty((0, dimension))  # K⁻¹ m
        self._crossed = np.empty((room, 0))  # U K⁻¹ m
        self._derived: _Derived | None = None
        with one_thread():
            self._inverse = inverted(scatter)
            self._hold(held, means)

    @property
    def rows(self) -> float:
        """N."""
        return float(self.counts.sum())

    @property
    def gamma(self) -> float:
        """γ, by which K⁻¹ becomes Σ⁻¹."""
        return self.rows / (1 - self.share)

    @property
    def shares(self) -> FloatArray:
        """p of the reference materials, shape (R,)."""
        counts = self.counts[self.reference]
        return np.asarray(counts / counts.sum())

    def solve(self, rows: FloatArray) -> FloatArray:
        """K⁻¹ of the task times each of the rows, shape (k, d), not regarding what came since.

        Whoever calls has BLAS on one thread.
        """
        from scipy.linalg.blas import dsymm, dsymv

        if 0 < len(rows) <= FEW:
            return np.stack([dsymv(1.0, self._inverse, row, lower=0) for row in rows])
        solved: FloatArray = dsymm(1.0, self._inverse, rows.T, lower=0).T
        return solved

    def _hold(self, places: Sequence[int] | Places, means: FloatArray) -> None:
        """Keep the means of more places, shape (k, d), and what follows from them."""
        solved = self.solve(means)
        first = len(self._held)
        self._held |= {int(place): first + i for i, place in enumerate(places)}
        self._means, self._solved = np.vstack([self._means, means]), np.vstack([self._solved, solved])
        crossed = np.zeros((len(self._u), len(means)))
        crossed[: self._rank] = self._u[: self._rank] @ solved.T
        self._crossed = np.hstack([self._crossed, crossed])
        self._derived = None

    def follow(self, changes: Sequence[Change]) -> bool:
        """Take in touches, in the order they came, that the statistics have already; False where it has to be solved
        again: they are too many, or a material went.
        """
        changes = [change for change in changes if len(change[1])]
        if self._rank + sum(len(rows) for _, rows, _ in changes) > len(self._u):
            return False
        with one_thread():
            self._hold_before(changes)
            for material, rows, sign in changes:
                place = self.places.get(material)
                before = 0.0 if place is None else self.counts[place]
                if sign < 0 and before <= len(rows):
                    return False
                if place is None:
                    place = self._new_place(material)
                self._follow(place, rows - self.origin, sign, before)
        self._derived = None
        return True

    def _new_place(self, material: str) -> int:
        place = self.places[material] = len(self.names)
        if len(self.reference) == place:  # all materials, and this one too
            self.reference = np.append(self.reference, place)
        self.names.append(material)
        self.counts = np.append(self.counts, 0.0)
        return place

    def _hold_before(self, changes: Sequence[Change]) -> None:
        """Hold the materials that will change, as they were before."""
        absent: dict[str, list[Change]] = {}
        for change in changes:
            place = self.places.get(change[0])
            if place is not None and place not in self._held:
                absent.setdefault(change[0], []).append(change)
        for name, pending in absent.items():
            later = sum((sign * rows.sum(axis=0, dtype=np.int64) for _, rows, sign in pending), np.int64(0))
            total = self._statistics.sums(self.scale, [name])[0] - later
            mean = total.astype(np.longdouble) / self.counts[self.places[name]] - self.origin
            self._hold([self.places[name]], mean.astype(np.float64)[None])

    def _follow(self, place: int, rows: FloatArray, sign: int, before: float) -> None:
        count, mean = len(rows), rows.mean(axis=0)
        after = before + sign * count
        if before:
            held = self._held[place]
            step = mean - self._means[held]
            stretch = np.sqrt(before * count / after)
            new = columns_of(rows, stretch * step)
        else:
            new = columns_of(rows, None)
        solved = self.solve(new) if len(new) else new
        first, last = self._rank, self._rank + len(new)
        self._u[first:last], self._v[first:last] = new, solved
        self._border(self._u[:last] @ solved.T, sign)
        self.counts[place] = after
        self._crossed[first:last] = new @ self._solved.T
        if not before:
            self._hold([place], mean[None])
            return
        # The last column is the way of the class mean, so the mean's own solution follows from it.
        share = sign * count / after
        self._means[held] += share * step
        self._solved[held] += share / stretch * solved[-1]
        self._crossed[:last, held] = self._u[:last] @ self._solved[held]

    def _border(self, cross: FloatArray, sign: int) -> None:
        """Border E, the inverse of D + U K⁻¹ Uᵀ, by the last columns of that matrix without D, shape (r + k, k)."""
        first, last = self._rank, len(cross)
        inner, above = self._inner[:first, :first], cross[:first]
        onto = inner @ above
        corner = np.linalg.inv(cross[first:] + sign * np.eye(last - first) - above.T @ onto)
        corner = (corner + corner.T) / 2
        beside = -onto @ corner
        inner -= beside @ onto.T
        self._inner[:first, first:last], self._inner[first:last, :first] = beside, beside.T
        self._inner[first:last, first:last] = corner
        self._rank = last

    def derived(self) -> _Derived:
        """What the answers of this moment need, made again after a change."""
        if self._derived is None:
            self._derived = _Derived.of(self)
        return self._derived

    def sizes_of(self, inner: FloatArray) -> FloatArray:
        """γ m_yᵀ K⁻¹ m_y of the materials held, shape (H,). inner: E."""
        crossed = self._crossed[: self._rank]
        sizes = np.einsum("hd,hd->h", self._means, self._solved) - np.einsum("rh,rh->h", crossed, inner @ crossed)
        return np.asarray(self.gamma * sizes)

    def products(self, held: Places, inner: FloatArray) -> FloatArray:
        """γ M K⁻¹ Mᵀ of some of the materials held, about the origin, shape (k, k). inner: E."""
        crossed = self._crossed[: self._rank, held]
        products = self._means[held] @ self._solved[held].T - crossed.T @ (inner @ crossed)
        return np.asarray(self.gamma * (products + products.T) / 2)

    def means_of(self, held: Places) -> tuple[FloatArray, FloatArray]:
        """The means of some materials held, about the origin, and K⁻¹ of the task times them, shape (k, d)."""
        return self._means[held], self._solved[held]

    def inner(self) -> FloatArray:
        """E, shape (r, r): a view, until the next change."""
        return self._inner[: self._rank, : self._rank]

    def held(self, places: Sequence[int] | Places) -> Places:
        """Where the materials at some places are held; those that were not are from now on."""
        absent = [int(place) for place in places if int(place) not in self._held]
        if absent:
            names = [self.names[place] for place in absent]
            counts, sums = self._statistics.counts(self.scale, names), self._statistics.sums(self.scale, names)
            with one_thread():
                self._hold(absent, class_means(counts, sums, self.origin))
        return np.array([self._held[int(place)] for place in places], dtype=np.intp)

    def project(self, codes: FloatArray, held: Places) -> FloatArray:
        """z of codes of shape (d,) for materials that are `held`, about the origin, shape (k,)."""
        row = codes - self.origin
        z = self._solved[held] @ row
        if self._rank:
            z -= (self.derived().inner @ (self._v[: self._rank] @ row)) @ self._crossed[: self._rank, held]
        return np.asarray(self.gamma * z)

    def scores(self, codes: FloatArray, places: Sequence[int] | Places, kind: ReadoutName) -> FloatArray:
        """The scores of the materials at some places for codes of shape (d,), shape (k,)."""
        if kind == "ridge":
            derived = self.derived()
            scores = self.shares + derived.background @ self.centred(codes)
            rank = {int(place): i for i, place in enumerate(self.reference)}
            return np.asarray(scores[[rank[int(place)] for place in places]])
        held = self.held(places)
        return np.asarray(self.project(codes, held) - self.derived().sizes[held] / 2)

    def centred(self, codes: FloatArray) -> FloatArray:
        """z of the reference materials about their mean, shape (R,)."""
        derived = self.derived()
        z = self.project(codes, derived.reference)
        return np.asarray(z - self.shares @ z - derived.towards)

    def novelty(self, codes: FloatArray, places: Sequence[int] | Places) -> float:
        """Relative Mahalanobis distance of codes (d,); the materials at `places` are those that may be the nearest."""
        derived, held = self.derived(), self.held(places)
        derived = self.derived()
        z = self.project(codes, np.concatenate([derived.reference, held]))
        about, own = z[: len(derived.reference)], z[len(derived.reference) :]
        centre = self.shares @ about
        nearest = float((own - derived.sizes[held] / 2).max())
        z = about - centre - derived.towards
        return float(-2.0 * nearest + 2.0 * centre - derived.size + z @ derived.background @ z)


@dataclass(frozen=True)
class _Derived:
    """What follows from a readout at one moment.

    inner: E. sizes: g of the materials held, shape (H,). reference: where the reference materials are held. gram: their
    G, about their mean, shape (R, R). background: H. towards: what is taken off z beside its mean to bring it about
    the mean of the reference materials, shape (R,). size: γ μᵀ K⁻¹ μ of that mean.
    """

    inner: FloatArray
    sizes: FloatArray
    reference: Places
    gram: FloatArray
    background: FloatArray
    towards: FloatArray
    size: float

    @classmethod
    def of(cls, readout: Readout) -> _Derived:
        reference, shares = readout.held(readout.reference), readout.shares
        with one_thread():
            inner = readout.inner()
            gram = readout.products(reference, inner)
            onto = gram @ shares
            size = float(shares @ onto)
            gram = gram - onto[:, None] - onto + size
            background = np.linalg.inv(np.diag(1.0 / ((1 - readout.share) * shares)) + gram)
            sizes = readout.sizes_of(inner)
        return cls(inner, sizes, reference, gram, (background + background.T) / 2, onto - size, size)
