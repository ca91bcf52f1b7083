"""Sets that hold the truth: how typical a touch is of each material, by the touches that are kept of it.

A touch x conforms less to a material y the further it lies from the nearest kept touch of y, and the nearer to one of
another material (nearest-neighbour nonconformity; Vovk, Gammerman and Shafer 2005):

    α(x, y) = log(d_y(x) + 1) + 2 (log(d_y(x) + 1) − log(d_other(x) + 1)),

d squared distances of the prefixes that both have. If x is of y, then x and the n touches kept of y could have come
in any order, so the share of these n + 1 that conform no better than x,

    p_y = (#{i kept of y : α(i, y) ≥ α(x, y)} + 1) / (n + 1),    each i compared with all others and with x,

is at most ε in no more than ε of cases: for each material, for every n. It is the full, class-conditional conformal
predictor. By the touches of all materials, in place of those of y, it holds of all cases together. The values compared
are whole numbers, and sums of their squares are exact: any order gives the same bits.
"""

from __future__ import annotations

import copy
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.likelihood import LEVELS, MISSING, LevelArray
from scroll_tactile.matching.match import KeptTouch

__all__ = ["Conformal", "Typicality"]

FloatArray = npt.NDArray[np.float64]

BLOCKS, EARLIER = 25, 1.5  # of a touch, in time: their edges grow with this power, for touches differ early
MOST_VALUES = 1024  # of a touch: sums of the squares of so many steps are below 2²⁴, and exact in single precision
STEPS, UNREAD = 63, 255  # of a block's mean, log(1 + level) over all levels; and where nothing was read
AT_ONCE = 128  # touches: of their distances from a thousand a step takes 1 MB
OTHER_WEIGHT = 2.0  # times that a touch's being nearer to another material counts


class Typicality(NamedTuple):
    """How typical a touch is of a material.

    share: p, by the touches of the material. least: the least that it can be. of_all: by all touches, each compared as
    one of its own material. least_of_all: the least that this can be.
    """

    share: float
    least: float
    of_all: float
    least_of_all: float


class Conformal:
    """Kept touches, and how typical another is of each of their materials.

    The touches have one number of channels; lengths may differ. Any number of threads may read it at once. It follows
    where nobody reads it: otherwise a copy does.
    """

    def __init__(
        self,
        channels: int,
        longest: int,
        touches: Sequence[KeptTouch] = (),
        steps: npt.NDArray[np.float32] | None = None,
    ) -> None:
        """longest: columns of the longest touch that there may be. steps: the blocks of the touches, taken over."""
        self._channels, self._longest = channels, longest
        self._edges = _edges(longest, channels)
        self._touches = [(touch.material, touch.key) for touch in touches]
        self._lengths = np.array([touch.levels.shape[1] for touch in touches], dtype=np.intp)
        self._steps = np.empty((0, channels * (len(self._edges) - 1)), np.float32) if steps is None else steps
        self._near: dict[int, tuple[FloatArray, FloatArray]] = {}  # blocks → d_own and d_other of what is kept
        self._squares: dict[int, npt.NDArray[np.float32] | None] = {}  # blocks → lengths, squared; None where some lack
        self._index()

    @classmethod
    def of(cls, touches: Sequence[KeptTouch]) -> Conformal:
        """Those of some kept touches, one or more."""
        conformal = cls(len(touches[0].levels), max(touch.levels.shape[1] for touch in touches))
        conformal.follow(touches, set())
        return conformal

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """What is made of the kept touches in the order of `touches`, and of complete ones of them.

        steps: (n, blocks · C). own, other: d of each from the others, by all blocks, (n,).
        """
        own, other = self._near_by(len(self._edges) - 1)
        return {"steps": self._steps.astype(np.uint8), "own": own, "other": other}

    @classmethod
    def from_arrays(
        cls, touches: Sequence[KeptTouch], arrays: Mapping[str, npt.NDArray[Any]], longest: int
    ) -> Conformal:
        """The kept touches of which `to_arrays` gave the arrays, which are taken over; of the same order."""
        conformal = cls(len(touches[0].levels), longest, touches, arrays["steps"].astype(np.float32))
        conformal._near[len(conformal._edges) - 1] = arrays["own"], arrays["other"]
        return conformal

    @staticmethod
    def parts(count: int, channels: int, longest: int) -> dict[str, tuple[str, tuple[int, ...]]]:
        """Name → dtype and shape of what `to_arrays` gives of so many touches."""
        steps = channels * (len(_edges(longest, channels)) - 1)
        return {"steps": ("uint8", (count, steps)), "own": ("float64", (count,)), "other": ("float64", (count,))}

    @property
    def touches(self) -> list[tuple[str, bytes]]:
        """What is kept, by material and key, in its order."""
        return self._touches

    def follow(self, added: Sequence[KeptTouch], removed: AbstractSet[tuple[str, bytes]]) -> None:
        """Take in touches no longer than the longest that were kept, and let others go, by material and key."""
        if removed:
            staying = [i for i, touch in enumerate(self._touches) if touch not in removed]
            self._touches = [self._touches[i] for i in staying]
            self._steps, self._lengths = self._steps[staying], self._lengths[staying]
            self._near = {}
        first = len(self._touches)
        self._touches = [*self._touches, *((touch.material, touch.key) for touch in added)]
        steps = [
            self._steps_of([touch.levels for touch in added[i : i + AT_ONCE]]) for i in range(0, len(added), AT_ONCE)
        ]
        self._steps, self._squares = np.concatenate([self._steps, *steps], dtype=np.float32), {}
        self._lengths = np.append(self._lengths, [touch.levels.shape[1] for touch in added]).astype(np.intp)
        self._index()
        for reach in list(self._near):
            self._near[reach] = self._nearer(reach, *self._near[reach], first)

    def followed(self, added, removed):  # type: ignore
        """TEMPORARY."""
        if any(t.levels.shape[1] > self._longest for t in added):
            raise NotImplementedError
        other = self.copy()
        other.follow(list(added), set(removed))
        return other

    def _index(self) -> None:
        self._materials = sorted({material for material, _ in self._touches})
        place = {material: i for i, material in enumerate(self._materials)}
        self._places = np.array([place[material] for material, _ in self._touches], dtype=np.intp)
        self._located: tuple[Sequence[str], npt.NDArray[np.intp], npt.NDArray[np.intp]] | None = None

    def copy(self) -> Conformal:
        """Another of the same touches: what comes to it does not come to this one."""
        other = copy.copy(self)
        # All else is replaced when it follows, and never changed.
        other._near, other._squares = dict(self._near), dict(self._squares)
        return other

    @property
    def materials(self) -> list[str]:
        """The materials of what is kept, in alphabetical order."""
        return self._materials

    def places(self, candidates: Sequence[str]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
        """The materials among some, in alphabetical order, that are kept: their places in `p_rows`, and among those.

        Those of the last list are cached: it may be of all that a memory has.
        """
        located = self._located  # any thread may replace it
        if located is None or located[0] is not candidates:
            swap = len(candidates) < len(self._materials)
            found = _common(candidates, self._materials) if swap else _common(self._materials, candidates)
            rows, among = found[::-1] if swap else found
            self._located = located = candidates, rows, among
        return located[1:]

    def p_values(self, levels: LevelArray) -> dict[str, Typicality]:
        """p by material of a touch, levels (C, T); 1 of all where it is too short to be compared."""
        values = (Typicality(*row) for row in self.p_rows(levels).tolist())
        return dict(zip(self._materials, values, strict=True))

    def p_rows(self, levels: LevelArray) -> FloatArray:
        """The same as rows of the materials in alphabetical order, (materials, 4)."""
        places, own_alpha, other_alpha, own = self.scores(levels)

        def by_material(those: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
            return np.bincount(those, minlength=len(own))

        at_least, count = by_material(places[own_alpha >= own[places]]) + 1, by_material(places) + 1
        others = (
            len(other_alpha)
            - np.searchsorted(np.sort(other_alpha), own)
            - by_material(places[other_alpha >= own[places]])
        )
        every = len(places) + 1
        columns = (at_least / count, 1 / count, (others + at_least) / every, np.full(len(own), 1 / every))
        return np.stack(columns, axis=1)

    def scores(self, levels: LevelArray) -> tuple[npt.NDArray[np.intp], FloatArray, FloatArray, FloatArray]:
        """Of each kept touch that is as long its material's place, and α if x is of that material, and if of another.

        Each of shape (n,); and α(x, y) of all materials, (materials,). levels: of x, (C, T). Nothing that is kept is as
        long as one too short to be compared.
        """
        reach = int(np.searchsorted(self._edges[1:], levels.shape[1], side="right"))
        if not reach:
            return np.empty(0, np.intp), np.empty(0), np.empty(0), np.zeros(len(self._materials))
        own, other = self._near_by(reach)
        far = self._distances(self._steps_of([levels]), reach)[0]
        nearest = _least(far, self._places, len(self._materials))
        as_long = self._lengths >= self._edges[reach]
        own, other, far = own[as_long], other[as_long], far[as_long]
        own_alpha, other_alpha = (
            _nonconformity(np.minimum(own, far), other),
            _nonconformity(own, np.minimum(other, far)),
        )
        return self._places[as_long], own_alpha, other_alpha, _nonconformity(nearest, _least_of_others(nearest))

    def _steps_of(self, levels: Sequence[LevelArray]) -> npt.NDArray[np.uint8]:
        """The blocks of touches, in steps, (touches, blocks · C), block by block; UNREAD where nothing was read."""
        whole = np.full((len(levels), self._channels, self._longest), MISSING, dtype=np.uint8)
        for into, own in zip(whole, levels, strict=True):
            reach = min(own.shape[1], self._longest)
            into[:, :reach] = own[:, :reach]
        read, firsts = whole != MISSING, self._edges[:-1]
        counts = np.add.reduceat(read, firsts, axis=2, dtype=np.int32)
        sums = np.add.reduceat(np.where(read, whole, np.uint8(0)), firsts, axis=2, dtype=np.int32)
        means = sums / np.maximum(counts, 1)
        steps = np.rint(np.log1p(means) * (STEPS / np.log(LEVELS)))
        blocks: npt.NDArray[np.uint8] = np.where(counts > 0, steps, UNREAD).astype(np.uint8)
        return blocks.transpose(0, 2, 1).reshape(len(levels), -1)

    def _distances(self, steps: npt.NDArray[np.uint8] | npt.NDArray[np.float32], reach: int) -> FloatArray:
        """Squared distances of touches from all that are kept, by the blocks both have of the first: (touches, kept).

        Where some blocks lack they count as the others do; infinite where all lack.
        """
        mine, kept = (blocks[:, : reach * self._channels] for blocks in (steps, self._steps))
        if reach not in self._squares:
            self._squares[reach] = np.square(kept).sum(axis=1) if (kept != UNREAD).all() else None
        if (squares := self._squares[reach]) is not None and (mine != UNREAD).all():
            a = mine.astype(np.float32)
            return np.asarray(np.square(a).sum(axis=1)[:, None] + squares - 2 * (a @ kept.T), dtype=np.float64)
        seen, known = (mine != UNREAD).astype(np.float32), (kept != UNREAD).astype(np.float32)
        a, b = mine * seen, kept * known
        far = (np.square(a) @ known.T + seen @ np.square(b).T - 2 * (a @ b.T)).astype(np.float64)
        both = (seen @ known.T).astype(np.float64)
        return np.where(both > 0, far * (mine.shape[1] / np.maximum(both, 1)), np.inf)

    def _near_by(self, reach: int) -> tuple[FloatArray, FloatArray]:
        """d_own and d_other of all that are kept, by so many blocks."""
        if reach not in self._near:
            nothing = np.empty(0)
            self._near[reach] = self._nearer(reach, nothing, nothing, 0)
        return self._near[reach]

    def _nearer(self, reach: int, own: FloatArray, other: FloatArray, first: int) -> tuple[FloatArray, FloatArray]:
        """d_own and d_other of all that are kept, where those before the row `first` have them of each other."""
        owns, others = [own], [other]
        own, other = own.copy(), other.copy()
        for start in range(first, len(self._touches), AT_ONCE):
            rows = np.arange(start, min(start + AT_ONCE, len(self._touches)))
            far = self._distances(self._steps[rows], reach)
            far[np.arange(len(rows)), rows] = np.inf
            same = self._places[rows][:, None] == self._places
            with_same, with_other = np.where(same, far, np.inf), np.where(same, np.inf, far)
            owns.append(with_same.min(axis=1))
            others.append(with_other.min(axis=1))
            if first:
                owns[0] = np.minimum(owns[0], with_same[:, :first].min(axis=0))
                others[0] = np.minimum(others[0], with_other[:, :first].min(axis=0))
        return np.concatenate(owns), np.concatenate(others)


def _edges(longest: int, channels: int) -> npt.NDArray[np.intp]:
    """The edges of the blocks of touches of so many columns at most."""
    blocks = max(1, min(BLOCKS, MOST_VALUES // channels))
    edges = np.rint(longest * (np.arange(blocks + 1) / blocks) ** EARLIER).astype(np.intp)
    return np.array(sorted(set(edges.tolist())), dtype=np.intp)


def _least(far: FloatArray, places: npt.NDArray[np.intp], count: int) -> FloatArray:
    """The least distance of each of so many materials, (count,)."""
    least = np.full(count, np.inf)
    np.minimum.at(least, places, far)
    return least


def _least_of_others(nearest: FloatArray) -> FloatArray:
    """For each material the least distance of all others; infinite where there is none."""
    first = int(nearest.argmin())
    others = np.full(len(nearest), nearest[first])
    others[first] = np.delete(nearest, first).min(initial=np.inf)
    return others


def _nonconformity(own: FloatArray, other: FloatArray) -> FloatArray:
    """α of distances from a material and from all others."""
    others = np.where(np.isfinite(other), other, 0.0)
    return np.asarray((1 + OTHER_WEIGHT) * np.log1p(own) - OTHER_WEIGHT * np.log1p(others))


def _common(few: Sequence[str], many: Sequence[str]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """The places of what is in both of two ascending lists, in each of them."""
    found = []
    for place, name in enumerate(few):
        other = bisect_left(many, name)
        if other < len(many) and many[other] == name:
            found.append((place, other))
    one, two = np.array(found, dtype=np.intp).reshape(-1, 2).T
    return one, two
