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

from bisect import bisect_left
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.likelihood import LEVELS, MISSING, LevelArray
from scroll_tactile.matching.match import KeptTouch

__all__ = ["Conformal", "Typicality"]

FloatArray = npt.NDArray[np.float64]
Rows = npt.NDArray[np.intp]
Steps = npt.NDArray[np.float32]

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

    The touches have one number of channels; lengths may differ. Any number of threads may use it at once; nothing of
    it changes but what it has counted before.
    """

    def __init__(self, channels: int, longest: int, touches: Sequence[tuple[str, bytes]], steps: Steps, lengths: Rows):
        """longest: columns of the longest touch that there may be. steps, lengths: of the touches, row by row."""
        self._channels, self._longest = channels, longest
        self._edges = _edges(longest, channels)
        self._touches, self._steps, self._lengths = list(touches), steps, lengths
        self._near: dict[int, tuple[FloatArray, FloatArray]] = {}  # blocks → d_own and d_other of what is kept
        self._squares: dict[int, Steps | None] = {}  # blocks → lengths, squared; None where some lack
        self._materials = sorted({material for material, _ in touches})
        place = {material: i for i, material in enumerate(self._materials)}
        self._places = np.array([place[material] for material, _ in touches], dtype=np.intp)
        self._located: tuple[Sequence[str], Rows, Rows] | None = None

    @classmethod
    def of(cls, touches: Sequence[KeptTouch]) -> Conformal:
        """Those of some kept touches, one or more."""
        channels, longest = len(touches[0].levels), max(touch.levels.shape[1] for touch in touches)
        width = channels * (len(_edges(longest, channels)) - 1)
        nothing = cls(channels, longest, (), np.empty((0, width), np.float32), np.empty(0, np.intp))
        return nothing.followed(touches, ())

    def followed(self, added: Sequence[KeptTouch], removed: Collection[tuple[str, bytes]]) -> Conformal:
        """Those of these touches with others, no longer than the longest, and without those removed."""
        gone = set(removed)
        stays = np.array([touch not in gone for touch in self._touches], dtype=np.bool_)
        steps = [
            self._steps_of([touch.levels for touch in added[i : i + AT_ONCE]]) for i in range(0, len(added), AT_ONCE)
        ]
        other = Conformal(
            self._channels,
            self._longest,
            [touch for touch in self._touches if touch not in gone] + [(one.material, one.key) for one in added],
            np.concatenate([self._steps[stays], *steps], dtype=np.float32),
            np.append(self._lengths[stays], [touch.levels.shape[1] for touch in added]).astype(np.intp),
        )
        if not gone:  # else the nearest one may have gone: all is counted when it is asked for
            for reach, near in list(self._near.items()):  # any thread may add to it
                other._near[reach] = other._nearest(reach, *near)
        return other

    @property
    def materials(self) -> list[str]:
        """The materials of what is kept, in alphabetical order."""
        return self._materials

    def places(self, candidates: Sequence[str]) -> tuple[Rows, Rows]:
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

    def p_rows(self, levels: LevelArray) -> FloatArray:
        """`Typicality` of a touch, levels (C, T), by material in alphabetical order, (materials, 4).

        1 of all where it is too short to be compared.
        """
        places, own_alpha, other_alpha, own = self.scores(levels)

        def by_material(those: Rows) -> Rows:
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

    def scores(self, levels: LevelArray) -> tuple[Rows, FloatArray, FloatArray, FloatArray]:
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

    def _distances(self, steps: npt.NDArray[np.uint8] | Steps, reach: int) -> FloatArray:
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
            self._near[reach] = self._nearest(reach, np.empty(0), np.empty(0))
        return self._near[reach]

    def _nearest(self, reach: int, own: FloatArray, other: FloatArray) -> tuple[FloatArray, FloatArray]:
        """d_own and d_other of all that are kept, where the first ones have them of each other."""
        first, count = len(own), len(self._touches)
        own, other = (np.append(before, np.full(count - first, np.inf)) for before in (own, other))
        for start in range(first, count, AT_ONCE):
            rows = np.arange(start, min(start + AT_ONCE, count))
            far = self._distances(self._steps[rows], reach)
            far[np.arange(len(rows)), rows] = np.inf
            same = self._places[rows][:, None] == self._places
            for near, these in ((own, np.where(same, far, np.inf)), (other, np.where(same, np.inf, far))):
                near[rows] = these.min(axis=1)
                near[:first] = np.minimum(near[:first], these[:, :first].min(axis=0))
        return own, other


def _edges(longest: int, channels: int) -> Rows:
    """The edges of the blocks of touches of so many columns at most."""
    blocks = max(1, min(BLOCKS, MOST_VALUES // channels))
    edges = np.rint(longest * (np.arange(blocks + 1) / blocks) ** EARLIER).astype(np.intp)
    return np.array(sorted(set(edges.tolist())), dtype=np.intp)


def _least(far: FloatArray, places: Rows, count: int) -> FloatArray:
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


def _common(few: Sequence[str], many: Sequence[str]) -> tuple[Rows, Rows]:
    """The places of what is in both of two ascending lists, in each of them."""
    found = []
    for place, name in enumerate(few):
        other = bisect_left(many, name)
        if other < len(many) and many[other] == name:
            found.append((place, other))
    one, two = np.array(found, dtype=np.intp).reshape(-1, 2).T
    return one, two
