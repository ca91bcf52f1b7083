"""Kept touches in rows, with the arrays that a matcher compares a touch with.

And levels between those that were read: between the steps of a touch, over blocks of it, and among several touches.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.matching.comparing import QUARTERS, mean_distances
from scroll_tactile.matching.likelihood import MISSING, LevelArray
from scroll_tactile.matching.match import KeptTouch

__all__ = ["Blocks", "KeptArrays", "at_places", "first_changes", "weighted_means"]

FloatArray = npt.NDArray[np.float64]
Rows = npt.NDArray[np.intp]

BLOCK_VALUES = 2400  # means of a kept touch that the shortlist is made by; 1200 lose 3 in 100 through noise
COARSER = 8  # times wider blocks, that say which touches are near at all; and of touches of another speed no more
ENOUGH = 32  # blocks that a touch reaches: with fewer there are no wider ones
GUESSED = (-256.0, 510.0)  # levels: a guess of what was before noise may lie beyond the range
NEGLIGIBLE = 1e-6  # of the largest weight in a mean


class _Parts(NamedTuple):
    """What is made of each kept touch, once; row by row.

    blocks: means, rounded to levels, MISSING where nothing was read, (touches, B, C). coarse: the same of wider ones,
    (touches, B', C). relative: of wider ones in each touch's own length. columns: the length of each. gapless: whether
    it has a value everywhere, up to the longest. first: the column of each channel's first change, the touch's length
    where it never changes, (touches, C).
    """

    blocks: LevelArray
    coarse: LevelArray
    relative: LevelArray
    columns: Rows
    gapless: npt.NDArray[np.bool_]
    first: Rows

    @classmethod
    def of(cls, touches: Sequence[LevelArray], longest: int) -> _Parts:
        """Those of some touches; of one length together, which is three times as fast as one by one."""
        fine, wide = _edges(longest, len(touches[0]))
        rows: dict[int, list[int]] = {}
        for row, levels in enumerate(touches):
            rows.setdefault(levels.shape[1], []).append(row)
        parts = []
        for columns, among in rows.items():
            levels = np.stack([touches[row] for row in among])
            parts.append(
                cls(
                    _block_levels(levels, fine),
                    _block_levels(levels, wide),
                    _block_levels(levels, wide * columns // longest),
                    np.full(len(among), columns),
                    (columns == longest) & (levels != MISSING).all(axis=(1, 2)),
                    first_changes(levels),
                )
            )
        return cls.joined(parts, np.argsort([row for among in rows.values() for row in among]))

    @classmethod
    def joined(cls, parts: Sequence[_Parts], rows: Sequence[int] | Rows) -> _Parts:
        """Some rows of all parts one below the other."""
        return cls(*(np.concatenate(of)[rows] for of in zip(*parts, strict=True)))


@dataclass(frozen=True)
class Blocks:
    """Block means of a touch beside those of all kept touches.

    means: levels, (B, C), 0 where nothing was read. known: where something was. kept: (touches, B'', C), B'' ≥ B.
    """

    means: FloatArray
    known: npt.NDArray[np.bool_]
    kept: LevelArray

    def distances(self, lines: Iterable[tuple[float, float]], rows: Rows) -> FloatArray:
        """Mean squared distances of kept touches from the touch before noise, (rows, lines), over what both have.

        lines: offset and slope of a noise, each; see `Table`. Whole numbers of quarters of a level, divided once: the
        same on every machine. The largest float where both have no block.
        """
        guesses = np.stack([(self.means - offset) / slope for offset, slope in lines]).reshape(-1, self.means.size)
        steps = np.rint(np.clip(guesses, *GUESSED) * QUARTERS).astype(np.int16)
        kept = self.kept[rows, : len(self.means)].reshape(len(rows), self.means.size)
        return mean_distances(kept, steps, self.known.ravel())


class KeptArrays:
    """Kept touches of one number of channels, in rows in the order of their keys; lengths may differ.

    touches: material and key of each row. longest: columns of the longest. materials: in alphabetical order; labels:
    the place of each row's material among them. columns, first: as in `_Parts`. gapless: whether all touches have
    values everywhere.

    Nothing of it changes, and it is a function of the set of touches, to the bit.
    """

    def __init__(self, touches: Sequence[tuple[str, bytes]], levels: Sequence[LevelArray], parts: _Parts) -> None:
        """levels, parts: of the touches, which are in order."""
        self.touches = list(touches)
        self._levels = list(levels)  # the memory's own: of 800 touches of a BioTac a copy is 6 MB
        self._parts = parts
        self.columns, self.first = parts.columns, parts.first
        self.channels, self.longest = len(levels[0]), int(parts.columns.max())
        self.gapless = bool(parts.gapless.all())
        self.materials = sorted({material for material, _ in touches})
        place = {name: i for i, name in enumerate(self.materials)}
        self.labels = np.array([place[material] for material, _ in touches], dtype=np.intp)

    @classmethod
    def of(cls, touches: Iterable[KeptTouch]) -> KeptArrays:
        """The arrays of some touches.

        Raises InputError for touches of different channels, and for none.
        """
        kept = sorted(touches, key=lambda touch: (touch.key, touch.material))
        if len({len(touch.levels) for touch in kept}) != 1:
            raise InputError("expected kept touches, one or more, all of the same number of channels")
        levels = [touch.levels for touch in kept]
        parts = _Parts.of(levels, max(each.shape[1] for each in levels))
        return cls([(touch.material, touch.key) for touch in kept], levels, parts)

    def followed(self, added: Iterable[KeptTouch], removed: Collection[tuple[str, bytes]] = ()) -> KeptArrays | None:
        """Those of these touches with others added, and without those removed; None where none is left.

        All is made anew where the longest touch has another length than before.
        """
        gone, came = set(removed), list(added)
        stays = [row for row, touch in enumerate(self.touches) if touch not in gone]
        if not stays and not came:
            return None
        touches = [*(self.touches[row] for row in stays), *((touch.material, touch.key) for touch in came)]
        levels = [*(self._levels[row] for row in stays), *(touch.levels for touch in came)]
        order = sorted(range(len(touches)), key=lambda i: touches[i][::-1])
        touches, levels = [touches[i] for i in order], [levels[i] for i in order]
        if max(each.shape[1] for each in levels) != self.longest:
            return KeptArrays(touches, levels, _Parts.of(levels, max(each.shape[1] for each in levels)))
        new = [_Parts.of([touch.levels for touch in came], self.longest)] if came else []
        rows = np.array([*stays, *range(len(self), len(self) + len(came))], dtype=np.intp)[order]
        return KeptArrays(touches, levels, _Parts.joined([self._parts, *new], rows))

    def __len__(self) -> int:
        return len(self.touches)

    def levels(self, row: int) -> LevelArray:
        """The levels of a kept touch, (C, T), as many columns as were kept."""
        return self._levels[row]

    def rows(self) -> dict[bytes, int]:
        """Key → row of what is kept."""
        return {key: row for row, (_, key) in enumerate(self.touches)}

    def blocks(self, levels: LevelArray, whole: bool) -> list[Blocks]:
        """A touch's blocks beside those of the kept ones, the wider ones first.

        whole: beside the whole of each, and not beside prefixes; then there are wide blocks only.
        """
        (fine, wide), columns, parts = _edges(self.longest, self.channels), levels.shape[1], self._parts
        if whole:
            return [Blocks(*_block_means(levels, wide * columns // self.longest), parts.relative)]
        near = Blocks(*_block_means(levels, fine), parts.blocks)
        if len(near.means) < ENOUGH:
            return [near]
        return [Blocks(*_block_means(levels, wide), parts.coarse), near]

    def beginnings(self, rows: Iterable[int], columns: int) -> LevelArray:
        """The levels of some touches up to a column one below the other, (rows, C, columns)."""
        kept = [self._levels[row][:, :columns] for row in rows]
        found = np.full((len(kept), self.channels, columns), MISSING, dtype=np.uint8)
        for levels, into in zip(kept, found, strict=True):
            into[:, : levels.shape[1]] = levels
        return found

    def at_shares(self, rows: Rows, shares: FloatArray) -> LevelArray:
        """The levels of some touches at these shares of each one's length, (rows, C, shares)."""
        found = np.empty((len(rows), self.channels, len(shares)), np.uint8)
        lengths = self.columns[rows]
        for length in sorted(set(lengths.tolist())):  # touches of one length are brought alike
            same = np.flatnonzero(lengths == length)
            found[same] = at_places(self.beginnings(rows[same], length), shares * (length - 1))
        return found

    def nearest_alike(self, row: int) -> tuple[LevelArray, LevelArray] | None:
        """The levels of a touch and of the nearest other one of its material; None where there is no other."""
        others = np.flatnonzero((self.labels == self.labels[row]) & (np.arange(len(self)) != row))
        if not len(others):
            return None
        blocks = self._parts.blocks.reshape(len(self), -1)
        guess = QUARTERS * blocks[row][None].astype(np.int16)
        far = mean_distances(blocks[others], guess, blocks[row] != MISSING)[:, 0]
        own, other = self.beginnings([row, int(others[np.argmin(far)])], self.longest)
        return own, other


def _edges(longest: int, channels: int) -> tuple[Rows, Rows]:
    """The edges of the blocks, and of the wider ones, of touches of so many columns at most."""
    blocks = max(1, min(longest, BLOCK_VALUES // channels))
    fine, wide = (np.linspace(0, longest, count + 1).astype(np.intp) for count in (blocks, -(-blocks // COARSER)))
    return fine, wide


def _block_levels(levels: LevelArray, edges: Rows) -> LevelArray:
    """Means of the blocks of touches (n, C, T), rounded to levels, (n, B, C); MISSING where nothing was read."""
    means, known = _block_means(levels, edges)
    found = np.full((len(levels), len(edges) - 1, levels.shape[1]), MISSING, np.uint8)
    found[:, : means.shape[1]][known] = np.rint(means[known])
    return found


def _block_means(levels: LevelArray, edges: Rows) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Means of the blocks of touches (…, C, T) between edges, (…, B, C), 0 where nothing was read; and what was.

    Of the blocks that begin before the touches end.
    """
    seen, first = levels != MISSING, edges[:-1][edges[:-1] < levels.shape[-1]]
    if seen.all():
        sums = np.add.reduceat(levels, first, axis=-1, dtype=np.int32)
        counts = np.broadcast_to(np.diff(first, append=levels.shape[-1]), sums.shape)
    else:
        sums = np.add.reduceat(np.where(seen, levels, 0), first, axis=-1, dtype=np.int32)
        counts = np.add.reduceat(seen, first, axis=-1, dtype=np.int32)
    return (sums / np.maximum(counts, 1)).swapaxes(-1, -2), counts.swapaxes(-1, -2) > 0


def at_places(levels: LevelArray, places: FloatArray) -> LevelArray:
    """Levels (…, T) at places between 0 and T − 1, by linear interpolation in steps of 1/256; MISSING where one lacks.

    `signals.image.stretched` is another function: an image is no level and lacks no value.
    """
    first = places.astype(np.intp)
    part = np.rint((places - first) * 256).astype(np.uint16)
    low, high = levels[..., first], levels[..., np.minimum(first + 1, levels.shape[-1] - 1)]
    blended = ((low * (256 - part) + high * part + np.uint16(128)) >> 8).astype(np.uint8)
    blended[(low == MISSING) | (high == MISSING)] = MISSING
    return np.asarray(blended)


def first_changes(levels: LevelArray) -> Rows:
    """The column of each channel's first change, (…, C); T where it reads one level throughout, or nothing."""
    read = levels != MISSING
    first = np.take_along_axis(levels, read.argmax(axis=-1)[..., None], axis=-1)
    changed = read & (levels != first)
    return np.asarray(np.where(changed.any(axis=-1), changed.argmax(axis=-1), levels.shape[-1]), dtype=np.intp)


def weighted_means(levels: LevelArray, weights: FloatArray) -> npt.NDArray[np.float32]:
    """Means of touches (n, C · T) by weights (means, n), of which the largest are 1; NaN where no touch has a value."""
    keep = weights.max(axis=0) > NEGLIGIBLE
    single, levels = weights[:, keep].astype(np.float32), levels[keep]
    known = levels != MISSING
    if known.all():
        return np.asarray((single / single.sum(axis=1, keepdims=True)) @ levels.astype(np.float32))
    total = single @ known.astype(np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(total > 0, single @ (levels * known).astype(np.float32) / total, np.nan))
