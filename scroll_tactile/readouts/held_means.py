"""The means m of the materials that a readout holds in memory, and K⁻¹ m."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from scroll_tactile.statistics.moments import Sums

__all__ = ["HeldMeans", "class_means"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Places = npt.NDArray[np.intp]


class HeldMeans:
    """The held materials of a readout.

    rows: place in the readout → row here. means: m about the readout's origin, solved: K⁻¹ m, both (H, d).
    sizes: mᵀ K⁻¹ m, (H,).
    """

    def __init__(self, places: Sequence[int], pairs: FloatArray, sizes: FloatArray) -> None:
        """pairs: m and K⁻¹ m of the materials at some places, (H, 2, d), taken over."""
        self.rows = {int(place): row for row, place in enumerate(places)}
        self._room, self.sizes = pairs, sizes
        self._cut(len(self.rows))

    @classmethod
    def none(cls, dimension: int) -> HeldMeans:
        """No materials yet."""
        return cls((), np.empty((0, 2, dimension)), np.empty(0))

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def places(self) -> list[int]:
        """The places of the materials, in the order of the rows."""
        return sorted(self.rows, key=self.rows.__getitem__)

    @property
    def pairs(self) -> FloatArray:
        """m and K⁻¹ m, (H, 2, d)."""
        return self._room[: len(self)]

    def _cut(self, count: int) -> None:
        self.means, self.solved = self._room[:count, 0], self._room[:count, 1]

    def add(self, places: Sequence[int] | Places, means: FloatArray, solved: FloatArray) -> None:
        """Add materials, with their means and K⁻¹ times these, (k, d) each."""
        first = len(self.rows)
        last = first + len(means)
        if last > len(self._room):
            # Requested materials come one by one, so room is made for half as many more. It is allocated before
            # anything changes: that may fail for lack of memory.
            room = np.empty((last if not first else last + last // 2, 2, means.shape[1]))
            room[:first] = self._room[:first]
            self._room = room
        self._room[first:last, 0], self._room[first:last, 1] = means, solved
        self.sizes = np.append(self.sizes[:first], np.einsum("hd,hd->h", means, solved))
        self._cut(last)
        self.rows |= {int(place): first + i for i, place in enumerate(places)}

    def keep(self, first: Places) -> None:
        """Keep the first rows, which are at these places, and drop the others."""
        self.rows = {int(place): i for i, place in enumerate(first)}
        self._cut(len(first))
        self.sizes = self.sizes[: len(first)]

    def copy(self) -> HeldMeans:
        """A copy that changes independently."""
        return HeldMeans(self.places, np.stack([self.means, self.solved], axis=1), self.sizes.copy())


def class_means(counts: IntArray | FloatArray, sums: Sums, origin: FloatArray) -> FloatArray:
    """The means of materials about an origin, shape (C, d), in grid units."""
    # Sums about the integers nearest to the origin are exact, so a mean close to the origin loses no digits.
    near = np.rint(origin)
    means: FloatArray = (sums - np.outer(counts.astype(np.int64), near.astype(np.int64))) / counts[:, None]
    means -= origin - near
    return means
