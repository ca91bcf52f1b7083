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

from collections.abc import Sequence
from functools import partial

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.kept_arrays import KeptArrays, log_steps
from scroll_tactile.signals.levels import LevelArray

__all__ = ["Conformal"]

FloatArray = npt.NDArray[np.float64]
Steps = npt.NDArray[np.float32]

AT_ONCE = 128  # touches: of their distances from a thousand a step takes 1 MB
OTHER_WEIGHT = 2.0  # times that a touch's being nearer to another material counts


class Conformal:
    """How typical a touch is of the materials of kept touches; for any number of threads.

    before: that of other kept touches. Where all of these are still kept, it has the distances among them.
    """

    def __init__(self, kept: KeptArrays, before: Conformal | None = None) -> None:
        self._kept = kept
        self._near = dict[int, FloatArray]()  # blocks → d_own and d_other of what is kept, (2, n)
        was = before._kept if before is not None else kept
        if before is not None and was.longest == kept.longest and was.touches.keys() <= kept.touches.keys():
            stays = [kept.touches[touch] for touch in was.touches]
            for reach, near in list(before._near.items()):  # any thread may add to it
                self._near[reach] = self._nearest(reach, stays, near)

    def p_rows(self, levels: LevelArray, names: Sequence[str]) -> FloatArray:
        """How typical a touch, levels (C, T), is of some materials: (names, 4).

        Columns: p, by the touches of the material; the least that it can be; p by all touches, each compared as one of
        its own material; the least that this can be. All are 1 of a material of which nothing is kept, and of a touch
        too short to be compared.
        """
        kept, count = self._kept, len(self._kept.materials)
        reach = int(np.searchsorted(kept.early[1:], levels.shape[1], side="right"))
        if not reach:
            return np.ones((len(names), 4))
        if reach not in self._near:
            self._near[reach] = self._nearest(reach, [], np.empty((2, 0)))
        far = self._distances(*log_steps(levels[None, :, : kept.longest], kept.early), reach)[0]
        nearest = np.full(count, np.inf)
        np.minimum.at(nearest, kept.labels, far)
        least, second = np.partition(np.append(nearest, np.inf), 1)[:2]
        asked = _nonconformity(nearest, np.where(np.arange(count) == nearest.argmin(), second, least))
        as_long = kept.columns >= kept.early[reach]
        (own, other), far, labels = self._near[reach][:, as_long], far[as_long], kept.labels[as_long]
        as_own = _nonconformity(np.minimum(own, far), other)  # α of each, if x is of its material
        as_other = _nonconformity(own, np.minimum(other, far))  # and if x is of another
        of_each = partial(np.bincount, minlength=count)
        at_least, of = of_each(labels[as_own >= asked[labels]]) + 1, of_each(labels) + 1
        others = len(labels) - np.searchsorted(np.sort(as_other), asked) - of_each(labels[as_other >= asked[labels]])
        every = len(labels) + 1
        columns = at_least / of, 1 / of, (others + at_least) / every, np.full(count, 1 / every)
        return kept.by_name(np.stack(columns, axis=1), names, np.ones(4))

    def _distances(self, steps: Steps, squares: Steps, reach: int) -> FloatArray:
        """Squared distances of touches from all that are kept, by the blocks both have of the first: (touches, kept).

        steps, squares: see `log_steps`. Where some blocks lack they count as the others do; infinite where all lack.
        """
        width = reach * self._kept.channels
        mine, kept = (each.reshape(len(each), -1)[:, :width] for each in (steps, self._kept.parts.steps))
        summed = squares[:, reach - 1, None] + self._kept.parts.squares[:, reach - 1]
        far = np.asarray(summed - 2 * (mine @ kept.T), dtype=np.float64)
        gaps = np.isnan(far).any(axis=0)
        if gaps.any():
            seen, known = (np.isfinite(each).astype(np.float32) for each in (mine, kept[gaps]))
            a, b = np.nan_to_num(mine), np.nan_to_num(kept[gaps])
            both = (seen @ known.T).astype(np.float64)
            sums = (np.square(a) @ known.T + seen @ np.square(b).T - 2 * (a @ b.T)).astype(np.float64)
            far[:, gaps] = np.where(both > 0, sums * (width / np.maximum(both, 1)), np.inf)
        return far

    def _nearest(self, reach: int, stays: Sequence[int], near: FloatArray) -> FloatArray:
        """d_own and d_other of all that are kept, (2, n), by so many blocks. near: those of rows among each other."""
        kept, found = self._kept, np.full((2, len(self._kept)), np.inf)
        found[:, stays] = near
        new = np.delete(np.arange(len(kept)), stays)
        for first in range(0, len(new), AT_ONCE):
            rows = new[first : first + AT_ONCE]
            far = self._distances(kept.parts.steps[rows], kept.parts.squares[rows], reach)
            far[np.arange(len(rows)), rows] = np.inf
            same = kept.labels[rows][:, None] == kept.labels
            for least, these in zip(found, (np.where(same, far, np.inf), np.where(same, np.inf, far)), strict=True):
                least[rows] = these.min(axis=1)
                least[:] = np.minimum(least, these.min(axis=0))
        return found


def _nonconformity(own: FloatArray, other: FloatArray) -> FloatArray:
    """α of distances from a material and from all others."""
    others = np.where(np.isfinite(other), other, 0.0)
    return np.asarray((1 + OTHER_WEIGHT) * np.log1p(own) - OTHER_WEIGHT * np.log1p(others))
