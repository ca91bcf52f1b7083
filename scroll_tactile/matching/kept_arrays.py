"""Kept touches in rows, with the arrays that a matcher compares a touch with, made once for each touch.

And levels between those that were read: between the steps of a touch, and over blocks of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile import native
from scroll_tactile.errors import InputError
from scroll_tactile.matching.likelihood import Table
from scroll_tactile.signals.levels import LEVELS, MISSING, LevelArray
from scroll_tactile.statistics.annotations import NO_ANNOTATION, Annotation

__all__ = ["Blocks", "KeptArrays", "KeptTouch", "at_places", "first_changes", "mean_distances"]

FloatArray = npt.NDArray[np.float64]
Known = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]
Steps = npt.NDArray[np.float32]

BLOCK_VALUES = 2400  # means of a kept touch that the shortlist is made by; 1200 lose 3 in 100 through noise
COARSER = 8  # times wider blocks, that say which touches are near at all; and of touches of another speed no more
ENOUGH = 32  # blocks that a touch reaches: with fewer there are no wider ones
GUESSED = (-256.0, 510.0)  # levels: a guess of what was before noise may lie beyond the range
QUARTERS = 4  # steps of a guess in one level
BLOCKS, EARLIER = 25, 1.5  # of a touch, in time: their edges grow with this power, for touches differ early
MOST_VALUES = 1024  # of a touch: sums of the squares of so many steps are below 2²⁴, and exact in single precision
STEPS = 63  # of a block's mean, log(1 + level) over all levels


@dataclass(frozen=True)
class KeptTouch:
    """A kept touch: its material, its content hash, its levels, uint8 of shape (C, T), and how it was annotated."""

    material: str
    key: bytes
    levels: LevelArray
    annotation: Annotation = NO_ANNOTATION


class _Parts(NamedTuple):
    """What is made of each kept touch, row by row.

    fine, wide: means of its blocks as levels, (touches, B, C). relative: of wide blocks of its own length. steps,
    squares: see `log_steps`. columns: its length. first: see `first_changes`.
    """

    fine: LevelArray
    wide: LevelArray
    relative: LevelArray
    steps: Steps
    squares: Steps
    columns: Rows
    first: Rows

    @classmethod
    def of(cls, levels: LevelArray, fine: Rows, wide: Rows, early: Rows) -> _Parts:
        """Those of touches of one length, (touches, C, T): together they take a third of the time of one by one."""
        columns, coarse = levels.shape[2], _coded(levels, wide)
        relative = coarse if columns == wide[-1] else _coded(levels, wide * columns // wide[-1])
        blocks = _coded(levels, fine), coarse, relative
        return cls(*blocks, *log_steps(levels, early), np.full(len(levels), columns), first_changes(levels))


@dataclass(frozen=True)
class Blocks:
    """Block means of a touch beside those of all kept touches.

    means: levels, (B, C), 0 where nothing was read. known: where something was. kept: (touches, B'', C), B'' ≥ B.
    """

    means: FloatArray
    known: Known
    kept: LevelArray

    def distances(self, tables: Sequence[Table], rows: Rows) -> FloatArray:
        """Mean squared distances of kept touches from the touch before each noise, (rows, tables)."""
        guesses = np.stack([(self.means - table.offset) / table.slope for table in tables]).reshape(len(tables), -1)
        steps = np.rint(np.clip(guesses, *GUESSED) * QUARTERS).astype(np.int16)
        kept = self.kept[rows, : len(self.means)].reshape(len(rows), self.means.size)
        return mean_distances(kept, steps, self.known.ravel())


class KeptArrays:
    """Kept touches of one number of channels, in the order of their keys; lengths may differ.

    touches: material and key of each → its row. levels: of each, (C, T). longest: columns of the longest. materials: in
    alphabetical order; labels: the place of each row's material among them. parts: what was made of each; columns: its
    length. early: edges of the blocks of its steps. All is a function of the set of touches, to the bit.
    """

    def __init__(self, touches: Iterable[KeptTouch], before: KeptArrays | None = None) -> None:
        """before: others, of which those rows are taken that are still kept, unless the longest has another length.

        Raises InputError for touches of different channels, and for none.
        """
        kept = sorted(touches, key=lambda touch: (touch.key, touch.material))
        if len({len(touch.levels) for touch in kept}) != 1:
            raise InputError("expected kept touches, one or more, all of the same number of channels")
        names, self.levels = [(touch.material, touch.key) for touch in kept], [touch.levels for touch in kept]
        self.touches = {name: row for row, name in enumerate(names)}
        lengths = [levels.shape[1] for levels in self.levels]
        self.channels, self.longest = len(self.levels[0]), max(lengths)
        self._fine, self._wide, self.early = edges = _edges(self.longest, self.channels)
        made, parts = dict[tuple[str, bytes], int](), list[_Parts]()
        if before is not None and before.longest == self.longest:
            made, parts = dict(before.touches), [before.parts]
        new = sorted((row for row, name in enumerate(names) if name not in made), key=lengths.__getitem__)
        for _, rows in groupby(new, lengths.__getitem__):
            parts.append(_Parts.of(np.stack([self.levels[row] for row in rows]), *edges))
        made |= {names[row]: len(made) + i for i, row in enumerate(new)}
        order = np.array([made[name] for name in names])
        self.parts: _Parts = _Parts(*(np.concatenate(each)[order] for each in zip(*parts, strict=True)))
        self.columns = self.parts.columns
        self.materials = sorted({material for material, _ in names})
        self._places = {name: i for i, name in enumerate(self.materials)}
        self.labels = np.array([self._places[material] for material, _ in names], dtype=np.intp)

    def __len__(self) -> int:
        return len(self.touches)

    def rows(self) -> dict[bytes, int]:
        """Key → row of what is kept."""
        return {key: row for (_, key), row in self.touches.items()}

    def by_name(self, values: FloatArray, names: Sequence[str], other: Any) -> FloatArray:
        """Values of the materials, (M, …), as those of some names, (C, …); `other` where nothing of a name is kept."""
        return np.concatenate([values, [other]])[[self._places.get(name, -1) for name in names]]

    def blocks(self, levels: LevelArray, whole: bool) -> list[Blocks]:
        """A touch's blocks beside those of kept prefixes, the wider first; or wide ones beside those of whole ones."""
        if whole:
            edges = self._wide * levels.shape[1] // self.longest
            return [Blocks(*_block_means(levels, edges), self.parts.relative)]
        near = Blocks(*_block_means(levels, self._fine), self.parts.fine)
        wide = [Blocks(*_block_means(levels, self._wide), self.parts.wide)] if len(near.means) >= ENOUGH else []
        return [*wide, near]

    def beginnings(self, rows: Sequence[int] | Rows, columns: int) -> LevelArray:
        """The levels of some touches up to a column one below the other, (rows, C, columns)."""
        found = np.full((len(rows), self.channels, columns), MISSING, dtype=np.uint8)
        for row, into in zip(rows, found, strict=True):
            into[:, : self.columns[row]] = self.levels[row][:, :columns]
        return found

    def at_shares(self, rows: Rows, shares: FloatArray) -> LevelArray:
        """The levels of some touches at these shares of each one's length, (rows, C, shares)."""
        found = np.empty((len(rows), self.channels, len(shares)), np.uint8)
        for length in np.unique(self.columns[rows]).tolist():  # touches of one length are brought alike
            same = np.flatnonzero(self.columns[rows] == length)
            found[same] = at_places(self.beginnings(rows[same], length), shares * (length - 1))
        return found

    def nearest_alike(self, row: int) -> int | None:
        """The row of the nearest other touch of the material of one; None where there is no other."""
        others = np.flatnonzero((self.labels == self.labels[row]) & (np.arange(len(self)) != row))
        if not len(others):
            return None
        blocks = self.parts.fine.reshape(len(self), -1)
        guess = QUARTERS * blocks[row][None].astype(np.int16)
        return int(others[mean_distances(blocks[others], guess, blocks[row] != MISSING).argmin()])


def _edges(longest: int, channels: int) -> tuple[Rows, Rows, Rows]:
    """The edges of a touch's blocks, of wider ones, and of those that conformal sets compare."""
    blocks, few = max(1, min(longest, BLOCK_VALUES // channels)), max(1, min(BLOCKS, MOST_VALUES // channels))
    fine, wide = (np.linspace(0, longest, count + 1).astype(np.intp) for count in (blocks, -(-blocks // COARSER)))
    return fine, wide, np.unique(np.rint(longest * (np.arange(few + 1) / few) ** EARLIER).astype(np.intp))


def mean_distances(rows: LevelArray, guesses: npt.NDArray[np.int16], known: Known) -> FloatArray:
    """Mean squared distances of rows of levels (rows, blocks) from guesses in quarters, (rows, guesses).

    Over the blocks that a row has and that are known, (blocks,); the largest float where there is none. By C where that
    was built, else by numpy, to the same bits; C takes guesses of ± 2048.
    """
    if native.available and len(rows):
        sums, seen = np.empty((len(rows), len(guesses)), np.int64), np.empty(len(rows), np.int64)
        native.distances(np.ascontiguousarray(rows), np.ascontiguousarray(guesses), known, sums, seen)
    else:
        both, exact = (rows != MISSING) & known, guesses.astype(np.float64)
        quarters = np.where(both, QUARTERS * rows.astype(np.float64), 0.0)
        squares = np.square(quarters).sum(axis=1)[:, None] + both @ np.square(exact).T
        sums, seen = (squares - 2 * (quarters @ exact.T)).astype(np.int64), both.sum(axis=1)
    return np.where(seen[:, None] > 0, sums / np.maximum(seen, 1)[:, None], np.finfo(np.float64).max)


def log_steps(levels: LevelArray, edges: Rows) -> tuple[Steps, Steps]:
    """Block means (n, B, C) in STEPS of log(1 + level), NaN where nothing was read; sums of squares so far, (n, B)."""
    coded = _coded(levels, edges, lambda means: np.rint(np.log1p(means) * (STEPS / np.log(LEVELS))))
    steps = np.where(coded == MISSING, np.nan, coded).astype(np.float32)
    return steps, np.square(steps).sum(axis=2).cumsum(axis=1)


def _coded(levels: LevelArray, edges: Rows, code: Callable[[FloatArray], FloatArray] = np.rint) -> LevelArray:
    """Means of the blocks of touches (n, C, T) as whole numbers, (n, B, C); MISSING where nothing was read."""
    means, known = _block_means(levels, edges)
    found = np.full((len(levels), len(edges) - 1, levels.shape[1]), MISSING, np.uint8)
    found[:, : means.shape[1]] = np.where(known, code(means), MISSING)
    return found


def _block_means(levels: LevelArray, edges: Rows) -> tuple[FloatArray, Known]:
    """Means of the blocks that begin before touches (…, C, T) end, (…, B, C), 0 where nothing was read; what was."""
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
