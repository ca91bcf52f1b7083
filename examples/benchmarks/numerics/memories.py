"""Memories that are hard for the arithmetic of a learner, by name and seeded: touches as features, within a bound of 1.

`below`: whether differences that matter are smaller than the grid of the codes, as no embedding's are that says its
bound as it is. `size` scales the cases: 1 is the report, smaller is a quick look.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from scroll_tactile.statistics.grid import BITS, in_units, to_codes

__all__ = ["JUDGED", "Memory", "make_memories"]

FloatArray = npt.NDArray[np.float64]
Rng = np.random.Generator
UNIT = 2.0**-BITS
JUDGED = 40  # touches


@dataclass(frozen=True, eq=False)
class Memory:
    """Touches of some materials.

    features: of t touches with k rows each, shape (t, k, d). places: the material of each touch, (t,), the first C
    numbers. evaluated: features of touches that are judged, (m, d). below: whether the grid is too coarse for it.
    """

    name: str
    features: FloatArray
    places: npt.NDArray[np.intp]
    evaluated: FloatArray
    below: bool = False

    @property
    def family(self) -> str:
        """In words, whether the grid is too coarse for it."""
        return "below the grid" if self.below else "within the bound"

    @cached_property
    def codes(self) -> npt.NDArray[np.int32]:
        """Of the features, as a learner has them."""
        return to_codes(self.features, 1.0)

    @property
    def units(self) -> FloatArray:
        """The features in the unit of the codes, not rounded."""
        return in_units(self.features, 1.0)

    @cached_property
    def row_places(self) -> npt.NDArray[np.intp]:
        """The material of each row, shape (t k,)."""
        return np.repeat(self.places, self.features.shape[1])


def _within(features: FloatArray) -> FloatArray:
    """All of some features, brought within the bound."""
    return np.asarray(features / np.abs(features).max())


def _drawn(
    rng: Rng, materials: int, touches: int, rows: int = 3, dimension: int = 12
) -> tuple[FloatArray, npt.NDArray[np.intp]]:
    """Touches of overlapping materials, (t, k, d) in [-1, 1], and their places; the last 40 are to be judged."""
    places = np.concatenate([np.tile(np.arange(materials), touches), rng.integers(materials, size=JUDGED)])
    mixing = rng.normal(size=(dimension, dimension)) / np.sqrt(dimension)
    touch = 0.7 * rng.normal(size=(materials, dimension))[places] + rng.normal(size=(len(places), dimension)) @ mixing
    return _within(touch[:, None] + 0.5 * rng.normal(size=(len(places), rows, dimension)) @ mixing), places


def _labelled(rng: Rng, rows: FloatArray, materials: int = 4) -> tuple[FloatArray, npt.NDArray[np.intp]]:
    """Rows (n, d), one a touch, of the material whose random direction each has most of, with some noise."""
    rows = _within(rows)
    sizes = np.abs(rows - rows.mean(axis=0)).max(axis=0)
    scores = (rows - rows.mean(axis=0)) / np.where(sizes == 0, 1, sizes) @ rng.normal(size=(len(sizes), materials))
    return rows[:, None], (scores + 0.3 * scores.std() * rng.normal(size=scores.shape)).argmax(axis=1)


def _parted(name: str, features: FloatArray, places: npt.NDArray[np.intp], below: bool = False) -> Memory:
    return Memory(name, features[:-JUDGED], places[:-JUDGED], features[-JUDGED:].mean(axis=1), below)


def _few(rng: Rng, size: float) -> Iterator[Memory]:
    """Memories in which something is scarce."""
    yield _parted("20 materials", *_drawn(rng, 20, 10, dimension=max(8, round(64 * size))))
    yield _parted("one touch a material, of one row", *_drawn(rng, 8, 1, 1))
    yield _parted("one touch a material, of three", *_drawn(rng, 8, 1, 3))
    yield _parted("two materials", *_drawn(rng, 2, 15))
    yield _parted("one material", *_drawn(rng, 1, 15))
    yield _parted("one feature", *_drawn(rng, 3, 8, dimension=1))
    yield _parted("fewer touches than features", *_drawn(rng, 3, 3, dimension=max(40, round(128 * size))))
    features, places = _drawn(rng, 2, most := max(300, round(10_000 * size)), rows=1)
    kept = (places == 0) | (np.arange(len(places)) == 1) | (np.arange(len(places)) >= len(places) - JUDGED)
    yield _parted(f"{most} touches and one", features[kept], places[kept])
    features, places = _drawn(rng, 5, 1, rows=1)
    again = np.r_[np.tile(np.arange(5), 6), 5 : len(places)]
    yield _parted("the same touches again and again", features[again], places[again])


def _dependent(rng: Rng, size: float) -> Iterator[Memory]:
    """Memories whose features depend on each other, and that have touches much louder than others."""
    features, places = _drawn(rng, 5, 20)
    yield _parted("every feature twice", np.repeat(features, 2, axis=-1), places)
    yield _parted("all features equal", np.repeat(features[..., :1], 12, axis=-1), places)
    twins = np.clip(features + UNIT * rng.integers(-1, 2, size=features.shape), -1, 1)
    yield _parted("features in pairs, a unit of the grid apart", np.concatenate([features, twins], -1), places)
    constant = features.copy()
    constant[..., 3], constant[..., 7], constant[..., 9] = 0.999, -0.3, 0.0
    yield _parted("constant features", constant, places)
    at = np.arange(len(places))[:, None, None]
    yield _parted(
        "the last five touches a hundred thousand times as loud", np.where(at < 95, 1e-5, 1) * features, places
    )
    yield _parted("the first touch a thousand times as loud", np.where(at > 0, 1e-3, 1) * features, places)
    own = np.tile(np.arange(6), 20)
    apart = rng.normal(size=(6, 1, 4))[own] + 1e-3 * rng.normal(size=(len(own), 2, 4))
    yield _parted("six materials of four features, 10³ × as far apart as they scatter", _within(apart), own)
    # Inputs far from zero, as what a layer before gave: a fifth of the features are never on, a fifth always.
    rows = (4 + rng.normal(size=(round(1500 * size), 40))) @ rng.normal(size=(40, max(40, round(300 * size))))
    yield _parted("rectified random features", *_labelled(rng, np.maximum(rows, 0)))


def _below(rng: Rng) -> Iterator[Memory]:
    """Memories of features that the grid is too coarse for."""
    features, places = _drawn(rng, 4, 15)
    yield _parted("mean a million times the spread", 0.9 + 9e-7 * features, places, below=True)
    yield _parted("features a ten thousandth of the bound", 1e-4 * features, places, below=True)
    rows = rng.normal(size=(16, 24))[rng.integers(16, size=400)]
    yield _parted("rows 10⁻⁹ apart", *_labelled(rng, rows + 1e-9 * rng.normal(size=rows.shape)), below=True)
    (left, _), (right, _) = np.linalg.qr(rng.normal(size=(300, 60))), np.linalg.qr(rng.normal(size=(60, 60)))
    yield _parted("spectrum from 1 to 10⁻¹²", *_labelled(rng, left * np.logspace(0, -12, 60) @ right), below=True)


def make_memories(seed: int, size: float = 1.0) -> Iterator[Memory]:
    """All made-up memories."""
    rng = np.random.default_rng([seed, 15])
    yield from _few(rng, size)
    yield from _dependent(rng, size)
    yield from _below(rng)
