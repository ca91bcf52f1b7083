"""Hard cases of ridge regression, by name and seeded: rows, targets, λ, and the true weights.

Decisions are judged on rows of their own (`evaluated`). `size` scales them: 1 is the report, smaller is a quick look.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from examples.benchmarks.numerics.truth import TruthError, exact_weights, refined_weights

__all__ = ["FAMILIES", "Case", "make_cases", "updates"]

FloatArray = npt.NDArray[np.float64]
LongArray = npt.NDArray[np.longdouble]


@dataclass(frozen=True, eq=False)
class Case:
    """One regression.

    name, family: what it is, and of which kind.
    rows: X, shape (n, d); targets: Y, shape (n, C); penalty: λ.
    evaluated: rows whose decisions are compared, shape (m, d); None where there are no decisions to take.
    certified: weights published elsewhere, shape (d,), None where there are none.
    """

    name: str
    family: str
    rows: FloatArray
    targets: FloatArray
    penalty: float
    evaluated: FloatArray | None = None
    certified: FloatArray | None = None

    @cached_property
    def truth(self) -> LongArray:
        """The true weights for these doubles, shape (d, C): the smallest where others fit as well."""
        if self.penalty:
            try:
                return refined_weights(self.rows, self.targets, self.penalty)
            except TruthError:
                pass  # too ill conditioned: exact elimination, which such cases are small enough for
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


def _parted(
    rng: Rng, name: str, family: str, rows: FloatArray, penalties: list[float], classes: int = 4
) -> Iterator[Case]:
    """A case for each λ of rows with decisions: four fifths to learn from, the rest to be evaluated."""
    targets = _labels(rng, rows, classes)
    cut = len(rows) * 4 // 5
    for penalty in penalties:
        full = name if len(penalties) == 1 else f"{name}, λ={penalty:g}"
        yield Case(full, family, rows[:cut], targets[:cut], penalty, rows[cut:])


def _gaussian(rng: Rng, size: float) -> Iterator[Case]:
    rows = rng.normal(size=(_count(2500, size), _count(64, size)))
    yield from _parted(
        rng, "unit-norm Gaussian", "gaussian", rows / np.linalg.norm(rows, axis=1, keepdims=True), [1e-3], 10
    )


def _relu(rng: Rng, size: float) -> Iterator[Case]:
    # Inputs far from zero, as what a layer before gave: a fifth of the features are never on, a fifth are always on
    # and so linear, and more of these than there are inputs.
    inputs = _count(40, size)
    rows = (4 + rng.normal(size=(_count(2500, size), inputs))) @ rng.normal(size=(inputs, _count(300, size)))
    rows = np.maximum(rows, 0)
    yield from _parted(rng, "ReLU random features", "relu", rows, [1e-12, 1e-8, 1e-4, 1.0])


def _geometric(rng: Rng, size: float) -> Iterator[Case]:
    d = _count(60, size)
    left, _ = np.linalg.qr(rng.normal(size=(5 * d, d)))
    right, _ = np.linalg.qr(rng.normal(size=(d, d)))
    yield from _parted(
        rng, "geometric spectrum", "geometric", left * np.logspace(0, -12, d) @ right.T, [1e-16, 1e-12, 1e-8], 3
    )


def _lauchli(rng: Rng, size: float) -> Iterator[Case]:
    for small in (1e-6, 1e-8, 1e-10):
        rows = np.concatenate([np.ones((1, 10)), small * np.eye(10)])
        targets = rows @ rng.normal(size=(10, 2)) + small * rng.normal(size=(11, 2))
        yield Case(f"Läuchli, ε={small:g}", "läuchli", rows, targets, 0.01 * small**2, rng.normal(size=(100, 10)))


def _hilbert(rng: Rng, size: float) -> Iterator[Case]:
    for order, penalty in ((10, 1e-20), (10, 1e-10), (12, 0.0)):
        rows = 1 / (np.arange(order)[:, None] + np.arange(order) + 1.0)
        yield Case(f"Hilbert {order}, λ={penalty:g}", "hilbert", rows, rows @ np.ones((order, 1)), penalty)


def _vandermonde(rng: Rng, size: float) -> Iterator[Case]:
    rows = np.linspace(0, 1, 30)[:, None] ** np.arange(13)
    targets = np.cos(4 * rows[:, 1:2]) + 1e-3 * rng.normal(size=(30, 1))
    for penalty in (0.0, 1e-14):
        yield Case(f"Vandermonde 12, λ={penalty:g}", "vandermonde", rows, targets, penalty)


def _duplicates(rng: Rng, size: float) -> Iterator[Case]:
    streams = rng.normal(size=(60, 24))
    again = streams[rng.integers(60, size=_count(3000, size, 300))]
    yield from _parted(rng, "duplicated streams", "duplicates", again, [1e-6])
    few = rng.normal(size=(16, 24))[rng.integers(16, size=len(again))]
    near = few + 1e-9 * rng.normal(size=few.shape)
    yield from _parted(rng, "near-duplicate streams", "duplicates", near, [1e-12])
    twins = np.repeat(streams[:, :8], 2, axis=1) * (1 + 2.0**-40 * rng.normal(size=(60, 16)))
    yield from _parted(rng, "near-duplicate columns", "duplicates", twins, [1e-18])


def _imbalance(rng: Rng, size: float) -> Iterator[Case]:
    many, d = _count(100_000, size, 2000), 16
    rows = np.concatenate([rng.normal(size=(many, d)), 3 + rng.normal(size=(1, d))])
    targets = np.eye(2)[np.r_[np.zeros(many, dtype=int), 1]]
    yield Case(f"{many} rows and 1", "imbalance", rows, targets, 1e-6, 1.5 + rng.normal(size=(500, d)))


def _offset(rng: Rng, size: float) -> Iterator[Case]:
    rows = 1e6 + rng.normal(size=(_count(1000, size, 200), 20))
    rows = np.concatenate([np.ones((len(rows), 1)), rows], axis=1)
    yield from _parted(rng, "mean 10⁶ × spread", "offset", rows, [1e-6])


def _scales(rng: Rng, size: float) -> Iterator[Case]:
    rows = rng.normal(size=(_count(400, size, 100), 12))
    for power in (-150, 150):
        yield from _parted(rng, f"scale 1e{power}", "scales", rows * 10.0**power, [1e-3 * 10.0 ** (2 * power)])
    mixed = rows * np.where(np.arange(12) % 2, 1e150, 1e-150)
    yield from _parted(rng, "scales 1e-150 beside 1e150", "scales", mixed, [1e-303])


def _wide(rng: Rng, size: float) -> Iterator[Case]:
    yield from _parted(rng, "d > n", "d > n", rng.normal(size=(75, _count(200, size, 90))), [1e-8])
    yield from _parted(rng, "d > n, λ=0", "d > n", rng.normal(size=(25, 30)), [0.0])


def _constant(rng: Rng, size: float) -> Iterator[Case]:
    rows = rng.normal(size=(_count(500, size, 100), 12))
    rows[:, 3], rows[:, 7], rows[:, 9] = 2.5, -1.25, 0.0
    yield from _parted(rng, "constant features", "constant", rows, [1e-10, 0.0])


def updates(rng: Rng, dimension: int, distinct: int = 1000) -> tuple[FloatArray, FloatArray, float]:
    """Rows of a stream of one-row updates, which repeats after so many, targets and λ.

    On the 20-bit grid, as codes are. λ / 10³ is a double too, so that the truth after r rounds is that of one round
    with λ / r.
    """
    low = rng.normal(size=(distinct, max(4, dimension // 4)))
    rows = np.maximum(low @ rng.normal(size=(low.shape[1], dimension)), 0)
    rows = np.rint(rows / np.abs(rows).max() * 2.0**20) * 2.0**-20
    return rows, _labels(rng, rows, 2), 1000 * 2.0**-24


FAMILIES: dict[str, Maker] = {
    "gaussian": _gaussian,
    "relu": _relu,
    "geometric": _geometric,
    "läuchli": _lauchli,
    "hilbert": _hilbert,
    "vandermonde": _vandermonde,
    "duplicates": _duplicates,
    "imbalance": _imbalance,
    "offset": _offset,
    "scales": _scales,
    "d > n": _wide,
    "constant": _constant,
}


def make_cases(seed: int, size: float = 1.0) -> Iterator[Case]:
    """All made-up cases, family by family; each family has a stream of random numbers of its own."""
    for family, make in FAMILIES.items():
        yield from make(np.random.default_rng([seed, zlib.crc32(family.encode())]), size)
