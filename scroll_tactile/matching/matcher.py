"""Matching: a touch is compared with kept ones, reading by reading, by the likelihood of what happened to it.

A mean over windows forgets where a reading passes the noise's edge; kept touches do not:

    score_c = max over kept i of c of Σ L_a[y, x_i],    a the noise under which a kept touch is likeliest.

The sum is over all values that were read. A channel that never changes, where hardly any kept touch has it so, is
stuck: it says nothing of its own and is left out, as are values that are missing. Where it is often quiet, it says
something by being so, unless the values are likelier without it. Beside the kept touches of a material stand blends of
those that are likely: what is felt lies between them. A touch is compared with the beginnings of kept ones, in their
own time, or with the whole of each brought to its length: made at another speed, it has another length.

All is a function of the set of kept touches, in any order.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.matching.likelihood import CLEAN, LEVELS, MISSING, UNIT, LevelArray, Noise, Table
from scroll_tactile.matching.match import (
    KeptTouch,
    Match,
    NaturalDeviation,
    by_chance,
    shape_of,
    trust_in,
    without_zero,
)

__all__ = ["TouchMatcher"]

FloatArray = npt.NDArray[np.float64]
Rows = npt.NDArray[np.intp]

SHORTLIST = 64  # kept touches that are compared value by value; with all 800 no more is right
BLOCK_VALUES = 2400  # means of a kept touch that the shortlist is made by; 1200 lose 3 in 100 through noise
AT_ONCE = (
    128  # kept touches whose means are multiplied at once: the bits of a product do not depend on how many are kept
)
COARSER = 8  # blocks in one where touches of another speed are compared: finer ones are not side by side
FIRST = 3  # candidates for each rough amplitude, and for the finer ones
FIRST_VALUES = 1000  # of a touch, by which the rough amplitude is found
ROUGH = (CLEAN, *(Noise(step) for step in (420, 632, 784, 880)))
COARSE = tuple(Noise(step) for step in range(120, 924, 32)), tuple(Noise(step, True) for step in range(5, 41, 2))
STRIDE = 4  # coarse amplitudes in one at first: the likelihood has one peak over them
WARMTHS = (0.03, 0.1, 0.3)  # of blends: how steeply a kept touch's part falls with its likelihood
BLENDED = 6  # materials, the likeliest, that have blends
RARELY = 20  # kept touches, of which fewer than one has a channel unchanging: then one that is so is stuck


@dataclass(frozen=True)
class _Query:
    """A touch that is compared: its levels (C, T), as far as the longest kept touch goes where it is not `whole`.

    shifted: 256 · level, flat. seen: which values count, (C, T). stuck: the channels that are. full: the columns that
    it is a part of. values: how many count. share: the part of all that do.
    """

    levels: LevelArray
    shifted: Rows
    seen: npt.NDArray[np.bool_]
    stuck: npt.NDArray[np.bool_]
    full: int
    whole: bool

    @classmethod
    def of(cls, levels: LevelArray, columns: int, whole: bool, quiet: npt.NDArray[np.bool_]) -> _Query:
        """quiet: the channels that are no less whole where they never change, (C,)."""
        full = levels.shape[1] if whole else columns
        grid = levels[:, :full].copy()
        stuck = _unchanging(grid) & ~quiet
        grid[stuck] = MISSING
        return cls(grid, grid.ravel().astype(np.intp) << 8, grid != MISSING, stuck, full, whole)

    @property
    def values(self) -> int:
        return int(np.count_nonzero(self.seen))

    @property
    def share(self) -> float:
        return self.values / (len(self.levels) * self.full)


@dataclass(frozen=True)
class _Pairs:
    """Values of a touch beside those of some others: 256 · level + other level, (others, values).

    weights: of each other's sum: by the same number of values, where some lack, (others,).
    """

    places: Rows
    weights: FloatArray

    def logs(self, table: Table) -> FloatArray:
        """Log-likelihood of the touch by each of the others, (others,)."""
        return np.asarray(table.logs.take(self.places).sum(axis=1, dtype=np.int64) / UNIT * self.weights)


@dataclass
class _Room:
    """What is made of kept touches, row by row.

    blocks: means, rounded to levels, as floats, (touches, C · B). brought: means over wider blocks of each one's own
    length, (touches, C · B'). squares: sums of the squares of blocks by channel, (touches, C). columns: the length of
    each. gapless: whether it has a value everywhere.
    """

    blocks: npt.NDArray[np.float32]
    brought: npt.NDArray[np.float32]
    squares: npt.NDArray[np.float32]
    columns: npt.NDArray[np.intp]
    gapless: npt.NDArray[np.bool_]
    unchanging: npt.NDArray[np.bool_]

    @classmethod
    def of(cls, count: int, channels: int, blocks: int, wider: int) -> _Room:
        return cls(
            np.empty((count, channels * blocks), np.float32),
            np.empty((count, channels * wider), np.float32),
            np.empty((count, channels), np.float32),
            np.empty(count, np.intp),
            np.empty(count, np.bool_),
            np.empty((count, channels), np.bool_),
        )

    def take(self, other: _Room, count: int) -> None:
        for name in PARTS:
            getattr(self, name)[:count] = getattr(other, name)[:count]

    def move(self, row: int, to: int) -> None:
        for name in PARTS:
            getattr(self, name)[to] = getattr(self, name)[row]


PARTS = tuple(field.name for field in fields(_Room))
LEVEL_PARTS = ("blocks", "brought")  # whole numbers, 0 to 254


class TouchMatcher:
    """Kept touches, and what can be asked of them.

    touches: of one number of channels; lengths may differ. measured: of these touches, or of most of them.

    Any number of threads may ask at once. It follows where nobody asks: otherwise a copy does.

    Raises InputError for touches of different channels, and for none.
    """

    def __init__(self, touches: Iterable[KeptTouch], measured: NaturalDeviation) -> None:
        kept = sorted(touches, key=lambda touch: (touch.key, touch.material))
        if len({len(touch.levels) for touch in kept}) != 1:
            raise InputError("expected kept touches, one or more, all of the same number of channels")
        self.measured = measured
        self.channels = len(kept[0].levels)
        self.longest = max(touch.levels.shape[1] for touch in kept)
        self._edges = _edges(self.longest, self.channels)
        self._touches: list[tuple[str, bytes]] = []
        self._levels: list[LevelArray] = []  # the memory's own: of 800 touches of a BioTac a copy is 6 MB
        self._held = self._room(len(kept))
        for touch in kept:
            self._add(touch)
        self._named()

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """What is made of each kept touch, row by row in the order of `touches`; see `_Room`. Levels in a byte each."""
        made = {name: getattr(self._held, name)[: len(self)] for name in PARTS}
        return made | {name: made[name].astype(np.uint8) for name in LEVEL_PARTS}

    @classmethod
    def from_arrays(
        cls,
        touches: Sequence[KeptTouch],
        arrays: Mapping[str, npt.NDArray[Any]],
        longest: int,
        measured: NaturalDeviation,
    ) -> TouchMatcher:
        """The kept touches of which `to_arrays` gave the arrays, which are taken over; of the same order."""
        matcher = cls.__new__(cls)
        matcher.measured, matcher.channels, matcher.longest = measured, len(touches[0].levels), longest
        matcher._edges = _edges(longest, matcher.channels)
        matcher._touches = [(touch.material, touch.key) for touch in touches]
        matcher._levels = [touch.levels for touch in touches]
        floats = {name: arrays[name].astype(np.float32) for name in LEVEL_PARTS}
        matcher._held = _Room(**{name: arrays[name] for name in PARTS} | floats)
        matcher._named()
        return matcher

    @staticmethod
    def parts(count: int, channels: int, longest: int) -> dict[str, tuple[str, tuple[int, ...]]]:
        """Name → dtype and shape of what `to_arrays` gives of so many touches."""
        edges = _edges(longest, channels)
        room = _Room.of(count, channels, len(edges) - 1, len(edges[::COARSER]) - 1)
        types = {name: "uint8" if name in LEVEL_PARTS else getattr(room, name).dtype.name for name in PARTS}
        return {name: (types[name], getattr(room, name).shape) for name in PARTS}

    @property
    def touches(self) -> list[tuple[str, bytes]]:
        """What is kept, by material and key, in its order."""
        return self._touches

    @property
    def held(self) -> set[tuple[str, bytes]]:
        """What is kept, by material and key."""
        return set(self._touches)

    @property
    def materials(self) -> list[str]:
        """The materials of what is kept, in alphabetical order."""
        return self._materials

    def __len__(self) -> int:
        return len(self._touches)

    def material(self, row: int) -> str:
        """The material of a kept touch."""
        return self._touches[row][0]

    def levels(self, row: int) -> LevelArray:
        """The levels of a kept touch, (C, T), as many columns as were kept."""
        return self._levels[row]

    def rows(self) -> dict[bytes, int]:
        """Key → row of what is kept."""
        return {key: row for row, (_, key) in enumerate(self._touches)}

    def follow(self, added: Iterable[KeptTouch], removed: Iterable[tuple[str, bytes]] = ()) -> bool:
        """Take in touches that came, and let others go; what was measured stays. False where it has to be made again:

        a touch is longer than all that were kept, or none is left.
        """
        rows = {touch: row for row, touch in enumerate(self._touches)}
        for row in sorted((rows[touch] for touch in removed), reverse=True):
            last = len(self._touches) - 1
            self._held.move(last, row)
            self._touches[row], self._levels[row] = self._touches[last], self._levels[last]
            self._touches.pop()
            self._levels.pop()
        for touch in added:
            if touch.levels.shape[1] > self.longest:
                return False
            self._add(touch)
        self._named()
        return bool(self._touches)

    def copy(self) -> TouchMatcher:
        """Another of the same touches: what comes to it does not come to this one."""
        other = copy.copy(self)
        other._touches, other._levels = [*self._touches], [*self._levels]
        other._held = self._room(len(self._held.blocks))
        other._held.take(self._held, len(self))
        other._named()
        return other

    def _room(self, count: int) -> _Room:
        return _Room.of(count, self.channels, len(self._edges) - 1, len(self._edges[::COARSER]) - 1)

    def _add(self, touch: KeptTouch) -> None:
        row, held = len(self._touches), self._held
        if row == len(held.blocks):
            held = self._room(row + max(8, row // 8))
            held.take(self._held, row)
            self._held = held
        whole = np.full((self.channels, self.longest), MISSING, dtype=np.uint8)
        whole[:, : touch.levels.shape[1]] = touch.levels
        means = np.rint(_means(whole, self._edges)[0])
        held.blocks[row], held.squares[row] = means.ravel(), (means**2).sum(axis=1)
        held.brought[row] = np.rint(_means(touch.levels, self._wider(touch.levels.shape[1]))[0]).ravel()
        held.columns[row], held.gapless[row] = touch.levels.shape[1], not bool((whole == MISSING).any())
        held.unchanging[row] = _unchanging(touch.levels)
        self._touches.append((touch.material, touch.key))
        self._levels.append(touch.levels)

    def _named(self) -> None:
        count, held = len(self._touches), self._held
        self._materials = sorted({material for material, _ in self._touches})
        place = {name: i for i, name in enumerate(self._materials)}
        self._labels = np.array([place[material] for material, _ in self._touches], dtype=np.intp)
        self._blocks, self._brought, self._squares = held.blocks[:count], held.brought[:count], held.squares[:count]
        self._columns, self._gapless = held.columns[:count], bool(held.gapless[:count].all())
        self._often_quiet = held.unchanging[:count].sum(axis=0)

    def match(
        self, levels: LevelArray, *, whole: bool = False, left_out: int | None = None, noise: Noise | None = None
    ) -> Match:
        """Compare a touch, levels of shape (C, T), with all that are kept, but for the row `left_out`.

        noise: what came over it; the likeliest unless given.

        whole: with each of them brought to its length, and not with their beginnings; then what is beyond the longest
        is left out. Raises InputError for other channels.
        """
        if levels.ndim != 2 or len(levels) != self.channels:
            raise InputError(f"expected levels of shape ({self.channels}, T); came {levels.shape}")
        quiet = self._quiet(left_out)
        asked = _Query.of(levels, self.longest, whole, quiet)
        found = self._compared(asked, left_out, noise, levels.shape[1])
        if not quiet.any():
            return found
        stuck = _Query.of(levels, self.longest, whole, np.zeros_like(quiet))
        if np.array_equal(stuck.stuck, asked.stuck):
            return found
        # Channels that are often quiet are quiet here, too, or dead: as a value is the likelier.
        apart = self._compared(stuck, left_out, noise, levels.shape[1])
        return found if found.likelihood >= apart.likelihood else apart

    def _compared(self, asked: _Query, left_out: int | None, noise: Noise | None, columns: int) -> Match:
        given, noise = noise, self._roughly(asked, left_out) if noise is None else noise
        rows = self._shortlist([noise], asked, SHORTLIST, left_out)[:, 0]
        beside = self._beside(rows, asked)
        pairs = self._pairs(beside, asked)
        logs = pairs.logs(self._table(noise))
        for stride in () if given or noise == CLEAN else (1,) if noise.normal else (8, 2, 1):
            finer = self._finer(rows, beside, logs, asked, noise, stride)
            if finer != noise:
                noise, logs = finer, pairs.logs(self._table(finer))
        return self._result(asked, rows, beside, logs, noise, columns)

    def apart(self, row: int) -> tuple[float, float]:
        """Energy and coherence (see NaturalDeviation) of how a kept touch deviates from the nearest other one."""
        asked = _Query.of(self._levels[row], self.longest, whole=False, quiet=self._quiet(row))
        beside = self._beside(self._shortlist([CLEAN], asked, SHORTLIST, row)[:, 0], asked)
        best = beside[np.argmax(self._pairs(beside, asked).logs(self._table(CLEAN)))]
        return shape_of(*self._deviation(asked, best, CLEAN))

    def nearest(self, row: int) -> tuple[LevelArray, LevelArray] | None:
        """The levels of a kept touch and of the nearest other one of its material; None where there is no other."""
        others = np.flatnonzero((self._labels == self._labels[row]) & (np.arange(len(self)) != row))
        if not len(others):
            return None
        far = self._squares[others].sum(axis=1) - 2 * _product(self._blocks[others], self._blocks[row])
        own, other = self._rows([row, int(others[np.argmin(far)])])
        return own, other

    def _quiet(self, left_out: int | None) -> npt.NDArray[np.bool_]:
        """The channels that never change in one of RARELY kept touches or more, (C,)."""
        own = 0 if left_out is None else self._held.unchanging[left_out]
        return np.asarray(RARELY * (self._often_quiet - own) >= max(len(self) - (left_out is not None), 1))

    def _rows(self, rows: Iterable[int], columns: int | None = None) -> LevelArray:
        """The levels of kept touches one below the other, (rows, C · T); T: columns, or those of the longest."""
        kept = [self._levels[row] for row in rows]
        beside = np.full((len(kept), self.channels, columns or self.longest), MISSING, dtype=np.uint8)
        for levels, into in zip(kept, beside, strict=True):
            part = levels[:, : into.shape[1]]
            into[:, : part.shape[1]] = part
        return beside.reshape(len(kept), -1)

    def _beside(self, rows: Rows, asked: _Query) -> LevelArray:
        """The levels that a touch is compared with, of some kept ones, (rows, C · T)."""
        if not asked.whole:
            return self._rows(rows, asked.levels.shape[1])
        columns = asked.levels.shape[1]
        brought = np.empty((len(rows), self.channels, columns), np.uint8)
        for length in _distinct(self._columns[rows]).tolist():  # touches of one length are brought to another alike
            same = np.flatnonzero(self._columns[rows] == length)
            places = np.arange(columns) * ((length - 1) / max(columns - 1, 1))
            first = places.astype(np.intp)
            part = (places - first).astype(np.float32)
            kept = self._rows(rows[same], length).reshape(len(same), self.channels, length)
            low, high = kept[:, :, first], kept[:, :, np.minimum(first + 1, length - 1)]
            brought[same] = np.rint(low * (1 - part) + high * part)
            brought[same] = np.where((low == MISSING) | (high == MISSING), np.uint8(MISSING), brought[same])
        return brought.reshape(len(rows), -1)

    def _shortlist(self, noises: Sequence[Noise], asked: _Query, count: int, left_out: int | None) -> Rows:
        """Rows of the kept touches nearest to the touch as it was before each noise, (count, noises), ascending."""
        columns = asked.levels.shape[1]
        edges = self._wider(columns) if asked.whole else self._edges
        means, known = _means(asked.levels, edges)
        tables = [self._table(noise) for noise in noises]
        guess = np.stack([(means - table.offset) / table.slope * known for table in tables]).reshape(len(noises), -1)
        far = self._distances(guess.astype(np.float32), known, asked.whole)
        if left_out is not None:
            far[left_out] = np.inf
        count = min(count, len(far) - (left_out is not None))
        return np.sort(np.argsort(far, axis=0, kind="stable")[:count], axis=0)

    def _distances(
        self, guess: npt.NDArray[np.float32], known: npt.NDArray[np.bool_], whole: bool
    ) -> npt.NDArray[np.float32]:
        """Squared distances of all kept touches from guesses (guesses, blocks), but for the guesses' own squares.

        Where some blocks lack, of either, they are means over the others, with the guesses' squares.
        """
        blocks = self._brought if whole else self._blocks
        if self._gapless and not whole and bool((known.all(axis=1) == known.any(axis=1)).all()):
            square = self._squares[:, known[:, 0]].sum(axis=1)[:, None]  # no BLAS: some report a NaN of few columns
            return np.asarray(square - 2 * _product(blocks, guess.T))
        columns = np.flatnonzero(known)
        blocks, guess = blocks[:, columns], guess[:, columns]
        square = np.einsum("nd,nd->n", blocks, blocks, dtype=np.float32)[:, None]
        if self._gapless or whole:
            return np.asarray(square - 2 * _product(blocks, guess.T))
        both = self._read()[:, columns].astype(np.float32)
        far = square - 2 * _product(blocks, guess.T) + both @ np.square(guess).T
        return np.asarray(far / np.maximum(both.sum(axis=1, keepdims=True), 1))

    def _wider(self, columns: int) -> Rows:
        """The edges of the blocks that a touch of so many columns has where it is compared as a whole one."""
        edges: Rows = self._edges[::COARSER] * columns // self.longest
        return edges

    def _read(self) -> npt.NDArray[np.bool_]:
        """Whether a kept touch has any value in a block, (touches, C · B)."""
        values = (self._rows(range(len(self))) != MISSING).reshape(len(self), self.channels, self.longest)
        return np.logical_or.reduceat(values, self._edges[:-1], axis=2).reshape(len(self), -1)

    def _table(self, noise: Noise) -> Table:
        return self.measured.likelihood.table(noise)

    def _pairs(self, beside: LevelArray, asked: _Query, values: slice | Rows = slice(None)) -> _Pairs:
        beside = beside[:, values]
        places = asked.shifted[values] | beside
        if self._gapless:
            return _Pairs(places, np.ones(len(beside)))
        seen = asked.seen.ravel()[values]
        both = np.count_nonzero((beside != MISSING) & seen, axis=1)
        return _Pairs(places, np.count_nonzero(seen) / np.maximum(both, 1))

    def _roughly(self, asked: _Query, left_out: int | None) -> Noise:
        beside = self._beside(_distinct(self._shortlist(ROUGH, asked, FIRST, left_out)), asked)
        values = np.flatnonzero(asked.seen)
        values = values[:: max(1, len(values) // FIRST_VALUES)]
        if not len(values) or not len(beside):
            return CLEAN
        pairs = self._pairs(beside, asked, values)

        def likelihood(noise: Noise) -> float:
            return float(pairs.logs(self._table(noise)).max())

        found = [CLEAN]
        for noises in COARSE:
            best = max(range(0, len(noises), STRIDE), key=lambda i: likelihood(noises[i]))
            found.append(max(noises[max(0, best - STRIDE + 1) : best + STRIDE], key=likelihood))
        return max(found, key=likelihood)

    def _finer(
        self, rows: Rows, beside: LevelArray, logs: FloatArray, asked: _Query, noise: Noise, stride: int
    ) -> Noise:
        """The likeliest amplitude near a noise: by kept touches at first, then by blends, that come nearer."""
        if stride > 2:
            nearest = beside[np.argsort(-logs, kind="stable")[:FIRST]]
        else:
            same = self._labels[rows] == self._labels[rows[np.argmax(logs)]]
            nearest = _blends(beside[same], logs[same], WARMTHS[:2])
        pairs = self._pairs(nearest, asked)
        return max(noise.near(stride), key=lambda near: float(pairs.logs(self._table(near)).max()))

    def _result(
        self, asked: _Query, rows: Rows, beside: LevelArray, logs: FloatArray, noise: Noise, columns: int
    ) -> Match:
        table, measured = self._table(noise), self.measured
        expected = np.full((self.channels, columns), np.nan)
        mean = _mean(beside, np.exp(WARMTHS[1] * (logs - logs.max()))[None])[0].reshape(self.channels, -1)
        expected[:, : mean.shape[1]] = mean[:, :columns]
        best = beside[np.argmax(logs)]
        deviation, both = self._deviation(asked, best, noise)
        usual = table.expected[best.reshape(both.shape)[both]].sum() / max(int(np.count_nonzero(both)), 1)
        got = float(logs.max()) / max(asked.values, 1)
        energy, coherence = shape_of(deviation, both)
        return Match(
            scores=self._scores(asked, rows, beside, logs, noise),
            certainty=table.certainty * asked.share,
            noise=noise,
            stuck=asked.stuck,
            expected=expected,
            trust=trust_in(energy, coherence, measured),
            moved=energy > max(measured.most, 2 * without_zero(deviation, both)),
            likelihood=got,
            evidence=got - by_chance(asked.levels[asked.seen]),
            surprise=float(usual) - got,
        )

    def _deviation(self, asked: _Query, best: LevelArray, noise: Noise) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """How a touch deviates from what a kept one reads through noise, (C, T), 0 where one lacks; and where not."""
        near = best.reshape(asked.seen.shape)
        both = asked.seen & (near != MISSING)
        mean = self._table(noise).mean[np.where(both, near, 0)]
        return np.where(both, asked.levels - mean, 0.0), both

    def _scores(self, asked: _Query, rows: Rows, beside: LevelArray, logs: FloatArray, noise: Noise) -> FloatArray:
        """The best log-likelihood of each material, by its kept touches or blends; the least, where it has none."""
        labels = self._labels[rows]
        best = np.full(len(self._materials), float(logs.min()))
        np.maximum.at(best, labels, logs)
        for material in np.argsort(-best, kind="stable")[:BLENDED].tolist():
            mine = labels == material
            if np.count_nonzero(mine) > 1:
                blends = _blends(beside[mine], logs[mine], WARMTHS)
                pairs = self._pairs(blends, asked)
                best[material] = max(best[material], float(pairs.logs(self._table(noise)).max()))
        return best


def _edges(longest: int, channels: int) -> Rows:
    """The edges of the blocks of touches of so many columns at most."""
    blocks = max(1, min(longest, BLOCK_VALUES // channels))
    return np.linspace(0, longest, blocks + 1).astype(np.intp)


def _distinct(numbers: Rows) -> Rows:
    """Whole numbers from 0 on, each once, ascending; numpy's own imports a fiftieth of a second of masked arrays."""
    return np.flatnonzero(np.bincount(numbers.ravel()))


def _unchanging(levels: LevelArray) -> npt.NDArray[np.bool_]:
    """The channels of a touch that read one level throughout, or nothing, (C,)."""
    read = levels != MISSING
    unchanging: npt.NDArray[np.bool_] = np.where(read, levels, 0).max(axis=1) <= np.where(read, levels, LEVELS).min(
        axis=1
    )
    return unchanging


def _product(blocks: npt.NDArray[np.float32], guess: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """blocks @ guess."""
    parts = [blocks[row : row + AT_ONCE] @ guess for row in range(0, len(blocks), AT_ONCE)]
    return np.concatenate(parts)


def _means(levels: LevelArray, edges: Rows) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Means of the blocks of a touch between edges, (C, B), 0 where nothing was read; and whether anything was.

    A touch may end before the last edge.
    """
    seen, first = levels != MISSING, edges[:-1][edges[:-1] < levels.shape[1]]
    sums, counts = np.zeros((2, len(levels), len(edges) - 1), dtype=np.int64)
    np.add.reduceat(np.where(seen, levels, 0), first, axis=1, dtype=np.int64, out=sums[:, : len(first)])
    np.add.reduceat(seen, first, axis=1, dtype=np.int64, out=counts[:, : len(first)])
    return sums / np.maximum(counts, 1), counts > 0


def _blends(beside: LevelArray, logs: FloatArray, warmths: Sequence[float]) -> LevelArray:
    """Weighted means of touches, one for each warmth, (warmths, C · T)."""
    mean = _mean(beside, np.exp(np.outer(warmths, logs - logs.max())))
    return np.asarray(np.where(np.isnan(mean), MISSING, np.rint(mean)), dtype=np.uint8)


def _mean(beside: LevelArray, parts: FloatArray) -> FloatArray:
    """Means of touches weighted by parts, (blends, touches); NaN where none of them has a value."""
    weights, known = parts.astype(np.float32), beside != MISSING
    if known.all():
        return np.asarray((weights / weights.sum(axis=1, keepdims=True)) @ beside.astype(np.float32))
    total = weights @ known.astype(np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(total > 0, weights @ (beside * known).astype(np.float32) / total, np.nan))
