"""Recall: a touch is compared with kept ones, reading by reading, by the likelihood of what happened to it.

A mean over windows forgets where a reading passes the noise's edge; kept touches do not:

    score_c = log mean over kept i of c of exp(β Σ L_a[y, x_i]),    a the noise under which a kept touch is likeliest.

The sum is over all values that were read. A channel that never changes says nothing of its own and is left out, as are
values that are missing. Beside the kept touches of a material stand blends of those that are likely: what is felt lies
between them. Values near each other deviate together, so that β = 1 / (1 + κ · certainty · share of the values): small
where noise does not hide it. κ is measured on touches left out.

All is a function of the set of kept touches, in any order.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.readouts.likelihood import CLEAN, LEVELS, MISSING, UNIT, LevelArray, Noise
from scroll_tactile.readouts.recollection import Kept, Measured, Recollection, by_chance, shape_of, trust_in

__all__ = ["Recall"]

FloatArray = npt.NDArray[np.float64]
Rows = npt.NDArray[np.intp]

SHORTLIST = 64  # kept touches that are compared value by value; with all 800 no more is right
BLOCK_VALUES = 2400  # means of a kept touch that the shortlist is made by: four bytes each
FIRST = 3  # candidates for each rough amplitude, and for the finer ones
FIRST_VALUES = 1000  # of a touch, by which the rough amplitude is found
ROUGH = (CLEAN, *(Noise(step) for step in (420, 632, 784, 880)))
COARSE = (CLEAN, *(Noise(step) for step in range(120, 924, 32)), *(Noise(step, True) for step in range(5, 41, 2)))
WARMTHS = (0.03, 0.1, 0.3)  # of blends: how steeply a kept touch's part falls with its likelihood
BLENDED = 6  # materials, the likeliest, that have blends


@dataclass(frozen=True)
class _Asked:
    """A touch that is compared: `shifted`, 256 · level, flat; which values count, (C, T); and how many do."""

    levels: LevelArray
    shifted: Rows
    seen: npt.NDArray[np.bool_]
    stuck: npt.NDArray[np.bool_]
    values: int

    @property
    def share(self) -> float:
        """The part of the values that count."""
        return self.values / self.levels.size


class Recall:
    """Kept touches, and what can be asked of them.

    touches: of one number of channels; lengths may differ. measured: of these touches, or of most of them. before: one
    with touches in common, whose rows are taken over.

    Raises InputError for touches of different channels, and for none.
    """

    def __init__(self, touches: Iterable[Kept], measured: Measured, before: Recall | None = None) -> None:
        self.kept = sorted(touches, key=lambda touch: (touch.key, touch.material))
        if len({len(touch.levels) for touch in self.kept}) != 1:
            raise InputError("expected kept touches, one or more, all of the same number of channels")
        self.channels = len(self.kept[0].levels)
        self.longest = max(touch.levels.shape[1] for touch in self.kept)
        self.materials = sorted({touch.material for touch in self.kept})
        place = {name: i for i, name in enumerate(self.materials)}
        self._labels = np.array([place[touch.material] for touch in self.kept])
        self._counts = np.bincount(self._labels)
        blocks = max(1, min(self.longest, BLOCK_VALUES // self.channels))
        self._edges = np.linspace(0, self.longest, blocks + 1).astype(np.intp)
        self._levels = np.full((len(self.kept), self.channels * self.longest), MISSING, dtype=np.uint8)
        self._blocks = np.empty((len(self.kept), self.channels * blocks), dtype=np.float32)
        self._place(before)
        self._whole = not bool((self._levels == MISSING).any())
        shape = (len(self.kept), self.channels, blocks)
        self._squares = np.einsum("ncb,ncb->nc", self._blocks.reshape(shape), self._blocks.reshape(shape))
        self.measured = measured

    def _place(self, before: Recall | None) -> None:
        shape = (self.channels, self.longest)
        same = before is not None and (before.channels, before.longest) == shape
        old = {touch.key: row for row, touch in enumerate(before.kept)} if before is not None and same else {}
        for row, touch in enumerate(self.kept):
            levels = self._levels[row].reshape(shape)[:, : touch.levels.shape[1]]
            levels[:] = touch.levels
            self.kept[row] = Kept(touch.material, touch.key, levels)  # what was given need not be kept twice
            if before is not None and touch.key in old:
                self._blocks[row] = before._blocks[old[touch.key]]
            else:
                whole = self._levels[row].reshape(shape)
                self._blocks[row] = self._means(whole, whole != MISSING)[0].ravel()

    def followed(self, added: Iterable[Kept], removed: Iterable[bytes] = ()) -> Recall:
        """The same with touches added, and others removed by their keys; what was measured stays.

        Raises InputError where none is left, and for touches of other channels.
        """
        gone = set(removed)
        return Recall([*(touch for touch in self.kept if touch.key not in gone), *added], self.measured, self)

    def recollect(self, levels: LevelArray, left_out: int | None = None) -> Recollection:
        """Compare a touch, levels of shape (C, T), with all that are kept, but for the row `left_out`.

        What is beyond the longest kept touch is left out too. Raises InputError for other channels.
        """
        asked = self._asked(levels)
        noise = self._roughly(asked, left_out)
        rows = self._shortlist([noise], asked, SHORTLIST, left_out)[:, 0]
        logs = self._logs(rows, asked, noise)
        for stride in () if noise == CLEAN else (1,) if noise.normal else (8, 2, 1):
            finer = self._finer(rows, logs, asked, noise, stride)
            if finer != noise:
                noise, logs = finer, self._logs(rows, asked, finer)
        return self._told(asked, rows, logs, noise, levels.shape[1])

    def apart(self, row: int) -> tuple[FloatArray, npt.NDArray[np.intp], float, float, float]:
        """A kept touch against the others, without noise: log-likelihoods, materials, share, energy, coherence."""
        asked = self._asked(self._levels[row].reshape(self.channels, -1))
        rows = self._shortlist([CLEAN], asked, SHORTLIST, row)[:, 0]
        logs = self._logs(rows, asked, CLEAN)
        return logs, self._labels[rows], asked.share, *shape_of(*self._deviation(asked, rows[np.argmax(logs)], CLEAN))

    def nearest(self, row: int) -> tuple[LevelArray, LevelArray] | None:
        """The levels of a kept touch and of the nearest other one of its material; None where there is no other."""
        others = np.flatnonzero((self._labels == self._labels[row]) & (np.arange(len(self.kept)) != row))
        if not len(others):
            return None
        far = self._squares[others].sum(axis=1) - 2 * (self._blocks[others] @ self._blocks[row])
        return self._levels[row], self._levels[others[np.argmin(far)]]

    def _asked(self, levels: LevelArray) -> _Asked:
        if levels.ndim != 2 or len(levels) != self.channels:
            raise InputError(f"expected levels of shape ({self.channels}, T); came {levels.shape}")
        whole = np.full((self.channels, self.longest), MISSING, dtype=np.uint8)
        columns = min(self.longest, levels.shape[1])
        whole[:, :columns] = levels[:, :columns]
        read = whole != MISSING
        stuck = np.where(read, whole, 0).max(axis=1) <= np.where(read, whole, LEVELS).min(axis=1)
        whole[stuck] = MISSING
        seen = whole != MISSING
        return _Asked(whole, whole.ravel().astype(np.intp) << 8, seen, stuck, int(np.count_nonzero(seen)))

    def _means(
        self, levels: LevelArray, seen: npt.NDArray[np.bool_]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        """Means of the blocks of a touch, (C, B), 0 where nothing was read; and whether anything was."""
        sums = np.add.reduceat(np.where(seen, levels, 0), self._edges[:-1], axis=1, dtype=np.int64)
        counts = np.add.reduceat(seen, self._edges[:-1], axis=1, dtype=np.int64)
        return sums / np.maximum(counts, 1), counts > 0

    def _shortlist(self, noises: Sequence[Noise], asked: _Asked, count: int, left_out: int | None) -> Rows:
        """Rows of the kept touches nearest to the touch as it was before each noise, (count, noises), ascending."""
        means, known = self._means(asked.levels, asked.seen)
        tables = [self.measured.likelihood.table(noise) for noise in noises]
        guess = np.stack([(means - table.offset) / table.slope * known for table in tables]).reshape(len(noises), -1)
        far = self._distances(guess.astype(np.float32), known)
        if left_out is not None:
            far[left_out] = np.inf
        count = min(count, len(far) - (left_out is not None))
        return np.sort(np.argsort(far, axis=0, kind="stable")[:count], axis=0)

    def _distances(self, guess: npt.NDArray[np.float32], known: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
        """Squared distances of all kept touches from guesses (guesses, blocks), but for the guesses' own squares.

        Where some blocks lack, of either, they are means over the others, with the guesses' squares.
        """
        if self._whole and bool((known.all(axis=1) == known.any(axis=1)).all()):
            return np.asarray((self._squares @ known[:, 0].astype(np.float32))[:, None] - 2 * (self._blocks @ guess.T))
        columns = np.flatnonzero(known)
        blocks, guess = self._blocks[:, columns], guess[:, columns]
        square = np.einsum("nd,nd->n", blocks, blocks)[:, None]
        if self._whole:
            return np.asarray(square - 2 * (blocks @ guess.T))
        both = self._read()[:, columns].astype(np.float32)
        far = square - 2 * (blocks @ guess.T) + both @ np.square(guess).T
        return np.asarray(far / np.maximum(both.sum(axis=1, keepdims=True), 1))

    def _read(self) -> npt.NDArray[np.bool_]:
        """Whether a kept touch has any value in a block, (touches, blocks)."""
        values = (self._levels != MISSING).reshape(len(self.kept), self.channels, self.longest)
        return np.logical_or.reduceat(values, self._edges[:-1], axis=2).reshape(len(self.kept), -1)

    def _logs(self, rows: Rows, asked: _Asked, noise: Noise, values: slice | Rows = slice(None)) -> FloatArray:
        """Log-likelihood of the touch by each of some kept ones; by the same number of values, where some lack."""
        beside = self._levels[rows][:, values] if isinstance(values, slice) else self._levels[np.ix_(rows, values)]
        return self._of(beside, asked, noise, values)

    def _of(self, beside: LevelArray, asked: _Asked, noise: Noise, values: slice | Rows = slice(None)) -> FloatArray:
        logs = self.measured.likelihood.table(noise).logs
        sums = logs.take(asked.shifted[values] | beside).sum(axis=1, dtype=np.int64) / UNIT
        if self._whole:
            return np.asarray(sums)
        seen = asked.seen.ravel()[values]
        pairs = np.count_nonzero((beside != MISSING) & seen, axis=1)
        return np.asarray(sums * (np.count_nonzero(seen) / np.maximum(pairs, 1)))

    def _roughly(self, asked: _Asked, left_out: int | None) -> Noise:
        rows = np.unique(self._shortlist(ROUGH, asked, FIRST, left_out))
        values = np.flatnonzero(asked.seen)
        values = values[:: max(1, len(values) // FIRST_VALUES)]
        if not len(values) or not len(rows):
            return CLEAN
        return max(COARSE, key=lambda noise: float(self._logs(rows, asked, noise, values).max()))

    def _finer(self, rows: Rows, logs: FloatArray, asked: _Asked, noise: Noise, stride: int) -> Noise:
        """The likeliest amplitude near a noise: by kept touches at first, then by blends, that come nearer."""
        if stride > 2:
            beside = self._levels[rows[np.argsort(-logs, kind="stable")[:FIRST]]]
        else:
            same = self._labels[rows] == self._labels[rows[np.argmax(logs)]]
            beside = self._blends(rows[same], logs[same], WARMTHS[:2])
        return max(noise.near(stride), key=lambda near: float(self._of(beside, asked, near).max()))

    def _blends(self, rows: Rows, logs: FloatArray, warmths: Sequence[float]) -> LevelArray:
        """Weighted means of kept touches, one for each warmth, (warmths, C · T)."""
        parts = np.exp(np.outer(warmths, logs - logs.max()))
        return np.asarray(np.where(np.isnan(mean := self._mean(rows, parts)), MISSING, np.rint(mean)), dtype=np.uint8)

    def _mean(self, rows: Rows, parts: FloatArray) -> FloatArray:
        """Means of kept touches weighted by parts, (blends, rows); NaN where none of them has a value."""
        levels, weights = self._levels[rows], parts.astype(np.float32)
        if self._whole:
            return np.asarray((weights / weights.sum(axis=1, keepdims=True)) @ levels.astype(np.float32))
        known = (levels != MISSING).astype(np.float32)
        total = weights @ known
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.where(total > 0, weights @ (levels * known) / total, np.nan))

    def _told(self, asked: _Asked, rows: Rows, logs: FloatArray, noise: Noise, columns: int) -> Recollection:
        table, measured = self.measured.likelihood.table(noise), self.measured
        steep = 1 / (1 + measured.doubt * table.certainty * asked.share)
        scores = self._scores(asked, rows, logs, noise, steep)
        expected = np.full((self.channels, columns), np.nan)
        expected[:, : self.longest] = self._mean(rows, np.exp(steep * (logs - logs.max()))[None])[0].reshape(
            self.channels, -1
        )[:, :columns]
        deviation, both = self._deviation(asked, rows[np.argmax(logs)], noise)
        best = self._levels[rows[np.argmax(logs)]].reshape(both.shape)
        usual = table.expected[best[both]].sum() / max(int(np.count_nonzero(both)), 1)
        got = float(logs.max()) / max(asked.values, 1)
        return Recollection(
            scores=scores,
            noise=noise,
            stuck=asked.stuck,
            expected=expected,
            trust=trust_in(*shape_of(deviation, both), measured),
            evidence=got - by_chance(asked.levels[asked.seen]),
            surprise=float(usual) - got,
        )

    def _deviation(self, asked: _Asked, row: np.intp, noise: Noise) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """How a touch deviates from what a kept one reads through noise, (C, T), 0 where one lacks; and where not."""
        beside = self._levels[row].reshape(asked.seen.shape)
        both = asked.seen & (beside != MISSING)
        mean = self.measured.likelihood.table(noise).mean[np.where(both, beside, 0)]
        return np.where(both, asked.levels - mean, 0.0), both

    def _scores(self, asked: _Asked, rows: Rows, logs: FloatArray, noise: Noise, steep: float) -> FloatArray:
        labels = self._labels[rows]
        best = np.full(len(self.materials), -np.inf)
        np.maximum.at(best, labels, logs)
        scores = np.full(len(self.materials), steep * float(logs.min()))
        blended = set(np.argsort(-best, kind="stable")[:BLENDED].tolist())
        for material in np.unique(labels):
            mine = labels == material
            found, count = logs[mine], int(self._counts[material])
            if material in blended and len(found) > 1:
                blends = self._of(self._blends(rows[mine], found, WARMTHS), asked, noise)
                found, count = np.concatenate([found, blends]), count + len(blends)
            top = float(found.max())
            scores[material] = steep * top + float(np.log(np.exp(steep * (found - top)).sum() / count))
        return scores
