"""What a frame of a gel shows of a surface, counted in whole numbers: its light, slopes and bumps.

The lamps beside the gel colour a slope by its direction, so the colours show the shape of what is pressed into it, and
their gradients its relief (Yuan, Dong and Adelson 2017, GelSight). The light is averaged over a few cells of the frame.
Gradients are taken at five scales, each the last one's sums over 2 × 2 pixels, and counted: how often each direction
occurs in each strength (after histograms of oriented gradients, Dalal and Triggs 2005), and how often the surface is
bent so much, up or down.

All of it is counts and sums of integers, so the features are the same bits on every machine.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings.banks import LEVELS
from scroll_tactile.embeddings.kernels import angles

__all__ = ["COLOURS", "LIGHT", "SURFACE", "light", "surface"]

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float32]

COLOURS = 3
SCALES = 5
OCTANTS = 8
STRENGTHS = (2, 4, 8, 16, 32)  # of a gradient or a curvature, in 1/255 of the range
STEP = 2 * LEVELS / 255  # levels in 1/255 of the range
CELLS = (6, 8)  # rows and columns that colours are averaged over

_HISTOGRAM = OCTANTS * (len(STRENGTHS) + 1)
_CURVATURES = 2 * 2 * len(STRENGTHS)  # of two kinds, up and down
LIGHT = COLOURS * CELLS[0] * CELLS[1]
"""The number of features of the light."""
SURFACE = COLOURS * SCALES * (_HISTOGRAM + _CURVATURES)
"""The number of features of slopes and bumps."""


def light(frame: IntArray) -> FloatArray:
    """Mean colours of 6 × 8 cells, in [-1, 1], float32 of shape (LIGHT,), of a frame of levels in ±LEVELS, (3, H, W).

    Of a frame with fewer rows or columns than cells some pixels are in several of them.
    """
    (top, under), (left, after) = (_edges(size, count) for size, count in zip(frame.shape[1:], CELLS, strict=True))
    total = np.pad(frame.cumsum(axis=1).cumsum(axis=2), ((0, 0), (1, 0), (1, 0)))
    rows = total[:, under] - total[:, top]
    sums = rows[:, :, after] - rows[:, :, left]
    means: FloatArray = (sums / (LEVELS * np.outer(under - top, after - left))).astype(np.float32).ravel()
    return means


def _edges(size: int, count: int) -> tuple[IntArray, IntArray]:
    first = np.arange(count) * size // count
    return first, np.maximum(first + 1, (np.arange(count) + 1) * size // count)


def surface(frame: IntArray) -> FloatArray:
    """How sloped and bent it is, in [0, 1], float32 of shape (SURFACE,), of a frame of levels in ±LEVELS, (3, H, W).

    A frame may be of any size, down to a single pixel: it goes on beyond its edges as at them.
    """
    parts: list[FloatArray] = []
    sums = frame
    for scale in range(SCALES):
        if scale:
            sums = _halved(sums)
        parts += _at_scale(sums, STEP * 4**scale)
    return np.concatenate([part.ravel() for part in parts])


def _at_scale(sums: IntArray, step: float) -> list[FloatArray]:
    """Counts of one scale; step: what a difference of 1/255 of the range is in these sums."""
    wide = np.pad(sums, ((0, 0), (1, 1), (1, 1)), mode="edge")
    up, down, left, right = wide[:, :-2, 1:-1], wide[:, 2:, 1:-1], wide[:, 1:-1, :-2], wide[:, 1:-1, 2:]
    bump = 4 * sums - up - down - left - right
    saddle = wide[:, 2:, 2:] + wide[:, :-2, :-2] - wide[:, 2:, :-2] - wide[:, :-2, 2:]
    edges = [int(step * strength) for strength in STRENGTHS]
    return [_directions(right - left, down - up, edges), _curvatures(bump, edges), _curvatures(saddle, edges)]


def _directions(along: IntArray, across: IntArray, edges: list[int]) -> FloatArray:
    """How often each octant of directions occurs in each strength: (3, _HISTOGRAM)."""
    squared = along * along + across * across
    octant = (along < 0) * 4 + (across < 0) * 2 + (np.abs(along) < np.abs(across))
    strength = sum((squared > edge * edge).astype(np.int64) for edge in edges)
    kind = (octant * (len(edges) + 1) + strength).reshape(COLOURS, -1)
    counts = np.stack([np.bincount(one, minlength=_HISTOGRAM) for one in kind])
    shares: FloatArray = angles(kind.shape[1])[counts]
    return shares


def _curvatures(bent: IntArray, edges: list[int]) -> FloatArray:
    """How often the surface is bent by more than each edge, up and down: (2 · edges, 3)."""
    counts = [np.count_nonzero(one, axis=(1, 2)) for edge in edges for one in (bent > edge, bent < -edge)]
    shares: FloatArray = angles(bent[0].size)[np.stack(counts)]
    return shares


def _halved(sums: IntArray) -> IntArray:
    """Sums over 2 × 2 pixels; of an odd row or column at the end, twice itself."""
    padded = np.pad(sums, ((0, 0), (0, sums.shape[1] % 2), (0, sums.shape[2] % 2)), mode="edge")
    halved: IntArray = padded[:, ::2, ::2] + padded[:, 1::2, ::2] + padded[:, ::2, 1::2] + padded[:, 1::2, 1::2]
    return halved
