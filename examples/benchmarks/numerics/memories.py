"""Memories that are hard for the arithmetic of a learner, by name and seeded: touches as features, within a bound of 1.

`below`: whether differences that matter are smaller than the grid of the codes, as no embedding's are that says its
bound as it is. `size` scales the cases: 1 is the report, smaller is a quick look.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from scroll_tactile.statistics.grid import BITS, in_units, to_codes

__all__ = ["Memory", "make_memories"]

FloatArray = npt.NDArray[np.float64]
Rng = np.random.Generator
UNIT = 2.0**-BITS


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
    rng: Rng, materials: int, touches: int, rows: int = 3, dimension: int = 12, evaluated: int = 40
) -> tuple[FloatArray, npt.NDArray[np.intp]]:
    """Touches of overlapping materials, (t, k, d) in [-1, 1], and their places; the last `evaluated` are to be judged."""
    places = np.concatenate([np.tile(np.arange(materials), touches), rng.integers(materials, size=evaluated)])
    mixing = rng.normal(size=(dimension, dimension)) / np.sqrt(dimension)
    means = 0.7 * rng.normal(size=(materials, dimension))
    touch = means[places] + rng.normal(size=(len(places), dimension)) @ mixing
    return _within(touch[:, None] + 0.5 * rng.normal(size=(len(places), rows, dimension)) @ mixing), places


def _parted(
    name: str, features: FloatArray, places: npt.NDArray[np.intp], evaluated: int = 40, below: bool = False
) -> Memory:
    last = len(places) - evaluated
    return Memory(name, features[:last], places[:last], features[last:].mean(axis=1), below)


def _labelled(rng: Rng, name: str, rows: FloatArray, below: bool = False, materials: int = 4) -> Memory:
    """A memory of rows (n, d), one a touch, of the material whose random direction each has most of, with some noise."""
    rows = _within(rows)
    centred = rows - rows.mean(axis=0)
    sizes = np.abs(centred).max(axis=0)
    scores = centred / np.where(sizes == 0, 1, sizes) @ rng.normal(size=(rows.shape[1], materials))
    scores += 0.3 * scores.std() * rng.normal(size=scores.shape)
    places = scores.argmax(axis=1)
    return _parted(name, rows[:, None], places, min(100, len(rows) // 5), below)


def _memories(rng: Rng, size: float) -> Iterator[Callable[[], Memory]]:
    """One maker a case."""

    def count(wanted: int, least: int = 8) -> int:
        return max(least, round(wanted * size))

    def ordinary() -> Memory:
        return _parted("20 materials", *_drawn(rng, 20, 10, dimension=count(64)))

    yield ordinary

    def duplicated() -> Memory:
        features, places = _drawn(rng, 5, 10)
        return _parted("every feature twice", np.repeat(features, 2, axis=-1), places)

    yield duplicated

    def constant() -> Memory:
        features, places = _drawn(rng, 5, 10)
        features[..., 3], features[..., 7], features[..., 9] = 0.999, -0.3, 0.0
        return _parted("constant features", features, places)

    yield constant

    def collinear() -> Memory:
        features, places = _drawn(rng, 5, 10)
        twins = np.rint(features / UNIT) * UNIT + UNIT * rng.integers(-1, 2, size=features.shape)
        return _parted("features in pairs, a unit of the grid apart", np.clip(np.concatenate([features, twins], -1), -1, 1), places)  # fmt: skip

    yield collinear
    for rows in (1, 3):
        yield lambda rows=rows: _parted(f"one touch a material, of {rows} rows", *_drawn(rng, 8, 1, rows))  # type: ignore[misc]
    yield lambda: _parted("two materials", *_drawn(rng, 2, 15))
    yield lambda: _parted("one material", *_drawn(rng, 1, 15))
    yield lambda: _parted("fewer touches than features", *_drawn(rng, 3, 3, dimension=count(128, 40)))

    def imbalanced() -> Memory:
        features, places = _drawn(rng, 2, count(10_000, 300), rows=1)
        kept = (places == 0) | (np.arange(len(places)) == 1) | (np.arange(len(places)) >= len(places) - 40)
        return _parted(f"{count(10_000, 300)} touches and one", features[kept], places[kept])

    yield imbalanced

    def equal() -> Memory:
        features, places = _drawn(rng, 5, 10)
        return _parted("all features equal", np.repeat(features[..., :1], 12, axis=-1), places)

    yield equal

    def again() -> Memory:
        features, places = _drawn(rng, 5, 1, rows=1)
        return _parted("the same touch again and again", features[np.r_[np.tile(np.arange(5), 6), 5:45]], np.r_[np.tile(places[:5], 6), places[5:]])  # fmt: skip

    yield again
    yield lambda: _parted("one feature", *_drawn(rng, 3, 8, dimension=1))

    def louder() -> Memory:
        features, places = _drawn(rng, 5, 10)
        features[:45] *= 16 * UNIT
        return _parted("quiet at first, and then a hundred thousand times as loud", features, places)

    yield louder

    def outlier() -> Memory:
        features, places = _drawn(rng, 5, 20)
        features[1:] *= 1e-3
        return _parted("one touch a thousand times as loud", features, places)

    yield outlier

    def rectified() -> Memory:
        # Inputs far from zero, as what a layer before gave: a fifth of the features are never on, a fifth always.
        inputs = count(40)
        rows = (4 + rng.normal(size=(count(1500, 200), inputs))) @ rng.normal(size=(inputs, count(300, 40)))
        return _labelled(rng, "rectified random features", np.maximum(rows, 0))

    yield rectified

    def far() -> Memory:
        features, places = _drawn(rng, 4, 15)
        return _parted("mean a million times the spread", 0.9 + 9e-7 * features, places, below=True)

    yield far

    def tiny() -> Memory:
        features, places = _drawn(rng, 4, 15)
        return _parted("features a ten thousandth of the bound", 1e-4 * features, places, below=True)

    yield tiny

    def near() -> Memory:
        rows = rng.normal(size=(16, 24))[rng.integers(16, size=count(1000, 200))]
        return _labelled(rng, "rows 10⁻⁹ apart", rows + 1e-9 * rng.normal(size=rows.shape), below=True)

    yield near

    def geometric() -> Memory:
        d = count(60, 12)
        left, _ = np.linalg.qr(rng.normal(size=(5 * d, d)))
        right, _ = np.linalg.qr(rng.normal(size=(d, d)))
        return _labelled(rng, "spectrum from 1 to 10⁻¹²", left * np.logspace(0, -12, d) @ right.T, below=True)

    yield geometric


def make_memories(seed: int, size: float = 1.0) -> Iterator[Memory]:
    """All made-up memories."""
    rng = np.random.default_rng([seed, zlib.crc32(b"memories")])
    for make in _memories(rng, size):
        yield make()
