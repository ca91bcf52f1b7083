"""Kept touches in rows, with the arrays that a matcher compares a touch with: made, written, read and followed.

And levels between those that were read: between the steps of a touch, over blocks of it, and among several touches.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.matching.comparing import QUARTERS, mean_distances
from scroll_tactile.matching.likelihood import LEVELS, MISSING, LevelArray
from scroll_tactile.matching.match import KeptTouch

__all__ = ["KeptArrays", "at_places", "blends", "block_means", "unchanging", "weighted_means"]

FloatArray = npt.NDArray[np.float64]
Rows = npt.NDArray[np.intp]

BLOCK_VALUES = 2400  # means of a kept touch that the shortlist is made by; 1200 lose 3 in 100 through noise
GUESSED = (-256.0, 510.0)  # levels: a guess of what was before noise may lie beyond the range
COARSER = 8  # blocks in one where touches of another speed are compared: finer ones are not side by side


@dataclass
class _Parts:
    """What is made of kept touches, row by row, with room for more.

    blocks: means, rounded to levels, MISSING where nothing was read, (touches, C · B). wide_blocks: means over wider
    blocks of each touch's own length, (touches, C · B'). columns: the length of each. gapless: whether it has a value
    everywhere. unchanging: the channels that never change, (touches, C).
    """

    blocks: LevelArray
    wide_blocks: LevelArray
    columns: Rows
    gapless: npt.NDArray[np.bool_]
    unchanging: npt.NDArray[np.bool_]

    @classmethod
    def empty(cls, count: int, channels: int, edges: Rows) -> _Parts:
        """Room for so many touches."""
        return cls(
            np.empty((count, channels * (len(edges) - 1)), np.uint8),
            np.empty((count, channels * (len(edges[::COARSER]) - 1)), np.uint8),
            np.empty(count, np.intp),
            np.empty(count, np.bool_),
            np.empty((count, channels), np.bool_),
        )

    def take(self, other: _Parts, count: int) -> None:
        for name in PARTS:
            getattr(self, name)[:count] = getattr(other, name)[:count]

    def move(self, row: int, to: int) -> None:
        for name in PARTS:
            getattr(self, name)[to] = getattr(self, name)[row]


PARTS = tuple(field.name for field in fields(_Parts))


class KeptArrays:
    """Kept touches of one number of channels, in rows; lengths may differ.

    touches: material and key of each row. longest: columns of the longest that there may be. labels: the place of each
    row's material among `materials`, which are in alphabetical order. blocks, wide_blocks, columns: as in
    `_Parts`. gapless: whether all touches have values everywhere. quiet: how many have a channel unchanging, (C,).

    Any number of threads may read it at once. It follows where nobody reads: otherwise a copy does.
    """

    def __init__(
        self,
        channels: int,
        longest: int,
        touches: Sequence[tuple[str, bytes]],
        levels: Sequence[LevelArray],
        parts: _Parts | None = None,
    ) -> None:
        """parts: of the touches, which are taken over; without them there are no touches."""
        self.channels, self.longest = channels, longest
        self.touches = list(touches)
        self._edges = _edges(longest, channels)
        self._levels = list(levels)  # the memory's own: of 800 touches of a BioTac a copy is 6 MB
        self._parts = _Parts.empty(0, channels, self._edges) if parts is None else parts
        self._index()

    @classmethod
    def of(cls, touches: Iterable[KeptTouch]) -> KeptArrays:
        """The arrays of some touches, in the order of their keys.

        Raises InputError for touches of different channels, and for none.
        """
        kept = sorted(touches, key=lambda touch: (touch.key, touch.material))
        if len({len(touch.levels) for touch in kept}) != 1:
            raise InputError("expected kept touches, one or more, all of the same number of channels")
        arrays = cls(len(kept[0].levels), max(touch.levels.shape[1] for touch in kept), (), ())
        arrays._make_room(len(kept))
        arrays.follow(kept)
        return arrays

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """`_Parts` of the touches, row by row in the order of `touches`."""
        return {name: getattr(self._parts, name)[: len(self)] for name in PARTS}

    @classmethod
    def from_arrays(
        cls, touches: Sequence[KeptTouch], arrays: Mapping[str, npt.NDArray[Any]], longest: int
    ) -> KeptArrays:
        """The kept touches of which `to_arrays` gave the arrays, which are taken over; of the same order."""
        parts = _Parts(**{name: arrays[name] for name in PARTS})
        own = [(touch.material, touch.key) for touch in touches]
        return cls(len(touches[0].levels), longest, own, [touch.levels for touch in touches], parts)

    @staticmethod
    def parts(count: int, channels: int, longest: int) -> dict[str, tuple[str, tuple[int, ...]]]:
        """Name → dtype and shape of what `to_arrays` gives of so many touches."""
        parts = _Parts.empty(count, channels, _edges(longest, channels))
        return {name: (getattr(parts, name).dtype.name, getattr(parts, name).shape) for name in PARTS}

    def copy(self) -> KeptArrays:
        """Another of the same touches: what comes to it does not come to this one."""
        parts = _Parts.empty(len(self._parts.blocks), self.channels, self._edges)
        parts.take(self._parts, len(self))
        return KeptArrays(self.channels, self.longest, self.touches, self._levels, parts)

    def __len__(self) -> int:
        return len(self.touches)

    @property
    def held(self) -> set[tuple[str, bytes]]:
        """What is kept, by material and key."""
        return set(self.touches)

    def levels(self, row: int) -> LevelArray:
        """The levels of a kept touch, (C, T), as many columns as were kept."""
        return self._levels[row]

    def rows(self) -> dict[bytes, int]:
        """Key → row of what is kept."""
        return {key: row for row, (_, key) in enumerate(self.touches)}

    def unchanging(self, row: int) -> npt.NDArray[np.bool_]:
        """The channels of a kept touch that never change, (C,)."""
        return np.asarray(self._parts.unchanging[row])

    def follow(self, added: Iterable[KeptTouch], removed: Iterable[tuple[str, bytes]] = ()) -> bool:
        """Take in touches that came, and let others go. False where all has to be made again:

        a touch is longer than all that were kept, or none is left.
        """
        rows = {touch: row for row, touch in enumerate(self.touches)}
        for row in sorted((rows[touch] for touch in removed), reverse=True):
            last = len(self.touches) - 1
            self._parts.move(last, row)
            self.touches[row], self._levels[row] = self.touches[last], self._levels[last]
            self.touches.pop()
            self._levels.pop()
        for touch in added:
            if touch.levels.shape[1] > self.longest:
                return False
            self._add(touch)
        self._index()
        return bool(self.touches)

    def _make_room(self, count: int) -> None:
        parts = _Parts.empty(count, self.channels, self._edges)
        parts.take(self._parts, len(self))
        self._parts = parts

    def _add(self, touch: KeptTouch) -> None:
        row = len(self)
        if row == len(self._parts.blocks):
            self._make_room(row + max(8, row // 8))
        parts, columns = self._parts, touch.levels.shape[1]
        whole = np.full((self.channels, self.longest), MISSING, dtype=np.uint8)
        whole[:, :columns] = touch.levels
        parts.blocks[row] = _block_levels(whole, self._edges)
        parts.wide_blocks[row] = _block_levels(touch.levels, self.wide_edges(columns))
        parts.columns[row], parts.gapless[row] = columns, not bool((whole == MISSING).any())
        parts.unchanging[row] = unchanging(touch.levels)
        self.touches.append((touch.material, touch.key))
        self._levels.append(touch.levels)

    def _index(self) -> None:
        count, parts = len(self), self._parts
        self.materials = sorted({material for material, _ in self.touches})
        place = {name: i for i, name in enumerate(self.materials)}
        self.labels = np.array([place[material] for material, _ in self.touches], dtype=np.intp)
        self.blocks, self.wide_blocks = parts.blocks[:count], parts.wide_blocks[:count]
        self.columns = parts.columns[:count]
        self.gapless = bool(parts.gapless[:count].all())
        self.quiet = parts.unchanging[:count].sum(axis=0)

    def prefixes(self, rows: Iterable[int], columns: int | None = None) -> LevelArray:
        """The levels of some touches one below the other, (rows, C · T); T: columns, or those of the longest."""
        kept = [self._levels[row] for row in rows]
        found = np.full((len(kept), self.channels, columns or self.longest), MISSING, dtype=np.uint8)
        for levels, into in zip(kept, found, strict=True):
            part = levels[:, : into.shape[1]]
            into[:, : part.shape[1]] = part
        return found.reshape(len(kept), -1)

    def brought_to(self, rows: Rows, columns: int) -> LevelArray:
        """The whole of some touches, each brought to so many columns, one below the other, (rows, C · T)."""
        brought = np.empty((len(rows), self.channels, columns), np.uint8)
        lengths = self.columns[rows]
        for length in np.flatnonzero(np.bincount(lengths)).tolist():  # touches of one length are brought alike
            same = np.flatnonzero(lengths == length)
            places = np.arange(columns) * ((length - 1) / max(columns - 1, 1))
            kept = self.prefixes(rows[same], length).reshape(len(same), self.channels, length)
            brought[same] = at_places(kept, places, np.float32)
        return brought.reshape(len(rows), -1)

    def edges(self, columns: int, whole: bool) -> Rows:
        """The edges of the blocks of a touch of so many columns that is compared as a beginning, or as a whole one."""
        return self.wide_edges(columns) if whole else self._edges

    def wide_edges(self, columns: int) -> Rows:
        """The edges of the blocks of a touch of so many columns that is compared as a whole one."""
        edges: Rows = self._edges[::COARSER] * columns // self.longest
        return edges

    def distances(self, guesses: FloatArray, known: npt.NDArray[np.bool_], whole: bool) -> FloatArray:
        """Mean squared distances of all touches from guesses, (touches, guesses), over the blocks that both have.

        guesses: levels, (guesses, C · B). known: the blocks that they have, (C · B,). Whole numbers of quarters of a
        level, divided once: the same on every machine. The largest float where both have no block.
        """
        steps = np.rint(np.clip(guesses, *GUESSED) * QUARTERS).astype(np.int16)
        return mean_distances(self.wide_blocks if whole else self.blocks, steps, known)

    def nearest_alike(self, row: int) -> tuple[LevelArray, LevelArray] | None:
        """The levels of a touch and of the nearest other one of its material; None where there is no other."""
        others = np.flatnonzero((self.labels == self.labels[row]) & (np.arange(len(self)) != row))
        if not len(others):
            return None
        blocks = self.blocks[row]
        far = mean_distances(self.blocks[others], QUARTERS * blocks[None].astype(np.int16), blocks != MISSING)[:, 0]
        own, other = self.prefixes([row, int(others[np.argmin(far)])])
        return own, other


def _edges(longest: int, channels: int) -> Rows:
    """The edges of the blocks of touches of so many columns at most."""
    blocks = max(1, min(longest, BLOCK_VALUES // channels))
    return np.linspace(0, longest, blocks + 1).astype(np.intp)


def _block_levels(levels: LevelArray, edges: Rows) -> LevelArray:
    """Means of the blocks of a touch, rounded to levels, (C · B,); MISSING where nothing was read."""
    means, known = block_means(levels, edges)
    return np.where(known, np.rint(means), MISSING).astype(np.uint8).ravel()


def at_places(
    levels: LevelArray, places: npt.NDArray[np.floating], precision: npt.DTypeLike = np.float64
) -> LevelArray:
    """Levels (…, T) at places between 0 and T − 1, by linear interpolation; MISSING where a neighbour is.

    precision: of the blends before they are rounded to levels. `signals.image.stretched` is another function: an image
    is no level and lacks no value, and its weights are ratios of integers, the same bits on every machine.
    """
    first = places.astype(np.intp)
    part: npt.NDArray[np.floating] = (places - first).astype(precision)
    low, high = levels[..., first], levels[..., np.minimum(first + 1, levels.shape[-1] - 1)]
    blended = np.rint(low * (1 - part) + high * part).astype(np.uint8)
    return np.where((low == MISSING) | (high == MISSING), np.uint8(MISSING), blended)


def unchanging(levels: LevelArray) -> npt.NDArray[np.bool_]:
    """The channels of a touch that read one level throughout, or nothing, (C,)."""
    read = levels != MISSING
    highest, lowest = np.where(read, levels, 0).max(axis=1), np.where(read, levels, LEVELS).min(axis=1)
    return np.asarray(highest <= lowest)


def block_means(levels: LevelArray, edges: npt.NDArray[np.intp]) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Means of the blocks of a touch between edges, (C, B), 0 where nothing was read; and whether anything was.

    A touch may end before the last edge.
    """
    seen, first = levels != MISSING, edges[:-1][edges[:-1] < levels.shape[1]]
    sums, counts = np.zeros((2, len(levels), len(edges) - 1), dtype=np.int64)
    np.add.reduceat(np.where(seen, levels, 0), first, axis=1, dtype=np.int64, out=sums[:, : len(first)])
    np.add.reduceat(seen, first, axis=1, dtype=np.int64, out=counts[:, : len(first)])
    return sums / np.maximum(counts, 1), counts > 0


def blends(levels: LevelArray, logs: FloatArray, warmths: Sequence[float]) -> LevelArray:
    """Weighted means of touches (n, C · T) of some log-likelihoods (n,), one for each warmth, (warmths, C · T).

    warmths: how steeply the weight of a touch falls with its log-likelihood.
    """
    means = weighted_means(levels, np.exp(np.outer(warmths, logs - logs.max())))
    return np.asarray(np.where(np.isnan(means), MISSING, np.rint(means)), dtype=np.uint8)


def weighted_means(levels: LevelArray, weights: FloatArray) -> npt.NDArray[np.floating]:
    """Means of touches (n, C · T) by weights (means, n); NaN where no touch has a value."""
    single, known = weights.astype(np.float32), levels != MISSING
    if known.all():
        return np.asarray((single / single.sum(axis=1, keepdims=True)) @ levels.astype(np.float32))
    total = single @ known.astype(np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(total > 0, single @ (levels * known).astype(np.float32) / total, np.nan))
