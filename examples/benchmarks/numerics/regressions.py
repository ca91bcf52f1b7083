"""Regressions that are hard for solvers of any doubles, by name and seeded: no learner meets them.

Decisions are judged on rows of their own (`evaluated`). `size` scales them: 1 is the report, smaller is a quick look.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from examples.benchmarks.numerics.truth import exact_weights

__all__ = ["Case", "make_cases", "updates"]

FloatArray = npt.NDArray[np.float64]
LongArray = npt.NDArray[np.longdouble]


@dataclass(frozen=True, eq=False)
class Case:
    """One regression.

    name: what it is.
    rows: X, shape (n, d); targets: Y, shape (n, C); penalty: λ.
    evaluated: rows whose decisions are compared, shape (m, d); None where there are no decisions to take.
    certified: weights published elsewhere, shape (d,), None where there are none.
    family: what its records are to be found by.
    """

    name: str
    rows: FloatArray
    targets: FloatArray
    penalty: float
    evaluated: FloatArray | None = None
    certified: FloatArray | None = None
    family: str = "regression"

    @cached_property
    def truth(self) -> LongArray:
        """The true weights for these doubles, shape (d, C): the smallest where others fit as well."""
        return exact_weights(self.rows, self.targets, self.penalty)

    @cached_property
    def sizes(self) -> FloatArray:
        """The largest magnitude of each column, a power of two, shape (d,); 1 for columns of zeros."""
        largest = np.abs(self.rows).max(axis=0)
        return np.exp2(np.ceil(np.log2(np.where(largest == 0, 1.0, largest))))


Rng = np.random.Generator
Maker = Callable[[Rng, float], Iterator[Case]]


def _count(wanted: int, size: float, least: int = 8) -> int:
    return max(least, round(wanted * size))


def _labels(rng: Rng, rows: FloatArray, classes: int) -> FloatArray:
    """0/1 targets: the class whose random direction a row has most of, with some noise; shape (n, C)."""
    centred = rows - rows.mean(axis=0)
    typical = np.abs(centred).max(axis=0)
    scores = (centred / np.where(typical == 0, 1.0, typical)) @ rng.normal(size=(rows.shape[1], classes))
    noisy = scores + 0.3 * scores.std() * rng.normal(size=scores.shape)
    return np.asarray(np.eye(classes)[noisy.argmax(axis=1)])


def _parted(rng: Rng, name: str, rows: FloatArray, penalties: list[float], classes: int = 4) -> Iterator[Case]:
    """A case for each λ of rows with decisions: four fifths to learn from, the rest to be evaluated."""
    targets = _labels(rng, rows, classes)
    cut = len(rows) * 4 // 5
    for penalty in penalties:
        full = name if len(penalties) == 1 else f"{name}, λ={penalty:g}"
        yield Case(full, rows[:cut], targets[:cut], penalty, rows[cut:])


def _relu(rng: Rng, size: float) -> Iterator[Case]:
    # Inputs far from zero, as what a layer before gave: a fifth of the features are never on, a fifth are always on
    # and so linear, and more of these than there are inputs.
    inputs = _count(20, size)
    rows = (4 + rng.normal(size=(_count(1000, size), inputs))) @ rng.normal(size=(inputs, _count(100, size)))
    rows = np.maximum(rows, 0)
    yield from _parted(rng, "ReLU random features", rows, [1e-12, 1e-4])


def _geometric(rng: Rng, size: float) -> Iterator[Case]:
    d = _count(60, size)
    left, _ = np.linalg.qr(rng.normal(size=(5 * d, d)))
    right, _ = np.linalg.qr(rng.normal(size=(d, d)))
    yield from _parted(rng, "geometric spectrum", left * np.logspace(0, -12, d) @ right.T, [1e-16, 1e-8], 3)


def _lauchli(rng: Rng, size: float) -> Iterator[Case]:
    for small in (1e-6, 1e-8, 1e-10):
        rows = np.concatenate([np.ones((1, 10)), small * np.eye(10)])
        targets = rows @ rng.normal(size=(10, 2)) + small * rng.normal(size=(11, 2))
        yield Case(f"Läuchli, ε={small:g}", rows, targets, 0.01 * small**2, rng.normal(size=(100, 10)))


def _hilbert(rng: Rng, size: float) -> Iterator[Case]:
    for order, penalty in ((10, 1e-20), (10, 1e-10), (12, 0.0)):
        rows = 1 / (np.arange(order)[:, None] + np.arange(order) + 1.0)
        yield Case(f"Hilbert {order}, λ={penalty:g}", rows, rows @ np.ones((order, 1)), penalty)


def _vandermonde(rng: Rng, size: float) -> Iterator[Case]:
    rows = np.linspace(0, 1, 30)[:, None] ** np.arange(13)
    targets = np.cos(4 * rows[:, 1:2]) + 1e-3 * rng.normal(size=(30, 1))
    for penalty in (0.0, 1e-14):
        yield Case(f"Vandermonde 12, λ={penalty:g}", rows, targets, penalty)


def _duplicates(rng: Rng, size: float) -> Iterator[Case]:
    streams = rng.normal(size=(60, 24))
    twins = np.repeat(streams[:, :8], 2, axis=1) * (1 + 2.0**-40 * rng.normal(size=(60, 16)))
    yield from _parted(rng, "near-duplicate columns", twins, [1e-18])


def _offset(rng: Rng, size: float) -> Iterator[Case]:
    rows = 1e6 + rng.normal(size=(_count(1000, size, 200), 20))
    rows = np.concatenate([np.ones((len(rows), 1)), rows], axis=1)
    yield from _parted(rng, "mean 10⁶ × spread", rows, [1e-6])


def _scales(rng: Rng, size: float) -> Iterator[Case]:
    rows = rng.normal(size=(_count(400, size, 100), 12))
    for power in (-150, 150):
        yield from _parted(rng, f"scale 1e{power}", rows * 10.0**power, [1e-3 * 10.0 ** (2 * power)])
    mixed = rows * np.where(np.arange(12) % 2, 1e150, 1e-150)
    yield from _parted(rng, "scales 1e-150 beside 1e150", mixed, [1e-303])


def _wide(rng: Rng, size: float) -> Iterator[Case]:
    yield from _parted(rng, "d > n, λ=0", rng.normal(size=(25, 30)), [0.0])


def _constant(rng: Rng, size: float) -> Iterator[Case]:
    rows = rng.normal(size=(_count(500, size, 100), 12))
    rows[:, 3], rows[:, 7], rows[:, 9] = 2.5, -1.25, 0.0
    yield from _parted(rng, "constant columns, λ=0", rows, [0.0])


def updates(rng: Rng, dimension: int, distinct: int = 1000) -> tuple[FloatArray, FloatArray, float]:
    """Rows of a stream of one-row updates on the grid of the codes, which repeats after so many, 0/1 targets, and λ."""
    low = rng.normal(size=(distinct, max(4, dimension // 4)))
    rows = np.maximum(low @ rng.normal(size=(low.shape[1], dimension)), 0)
    rows = np.rint(rows / np.abs(rows).max() * 2.0**20) * 2.0**-20
    return rows, _labels(rng, rows, 2), 1000 * 2.0**-24


MAKERS: tuple[Maker, ...] = (
    _relu, _geometric, _lauchli, _hilbert, _vandermonde, _duplicates, _offset, _scales, _wide, _constant,
)  # fmt: skip


def make_cases(seed: int, size: float = 1.0) -> Iterator[Case]:
    """All made-up cases; each kind has a stream of random numbers of its own."""
    for make in MAKERS:
        yield from make(np.random.default_rng([seed, zlib.crc32(make.__name__.encode())]), size)
