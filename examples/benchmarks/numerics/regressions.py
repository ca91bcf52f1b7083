"""Regressions that are hard for solvers of any doubles, by name and seeded: no learner meets them.

Decisions are judged on rows of their own (`evaluated`).
"""

from __future__ import annotations

from collections.abc import Iterator
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
    def truth(self) -> LongArray | None:
        """The true weights for these doubles, shape (d, C); None where others fit as well."""
        return exact_weights(self.rows, self.targets, self.penalty)

    @cached_property
    def sizes(self) -> FloatArray:
        """The largest magnitude of each column, a power of two, shape (d,); 1 for columns of zeros."""
        largest = np.abs(self.rows).max(axis=0)
        return np.exp2(np.ceil(np.log2(np.where(largest == 0, 1.0, largest))))


Rng = np.random.Generator


def make_cases(seed: int) -> Iterator[Case]:
    """All made-up cases."""
    rng = np.random.default_rng([seed, 16])
    for small in (1e-6, 1e-8, 1e-10):
        rows = np.concatenate([np.ones((1, 10)), small * np.eye(10)])
        targets = rows @ rng.normal(size=(10, 2)) + small * rng.normal(size=(11, 2))
        yield Case(f"Läuchli, ε={small:g}", rows, targets, 0.01 * small**2, rng.normal(size=(100, 10)))
    for order, penalty in ((10, 1e-20), (10, 1e-10), (12, 0.0)):
        rows = 1 / (np.arange(order)[:, None] + np.arange(order) + 1.0)
        yield Case(f"Hilbert {order}, λ={penalty:g}", rows, rows @ np.ones((order, 1)), penalty)
    rows = np.linspace(0, 1, 30)[:, None] ** np.arange(13)
    targets = np.cos(4 * rows[:, 1:2]) + 1e-3 * rng.normal(size=(30, 1))
    for penalty in (0.0, 1e-14):
        yield Case(f"Vandermonde 12, λ={penalty:g}", rows, targets, penalty)
    twins = np.repeat(rng.normal(size=(60, 8)), 2, axis=1) * (1 + 2.0**-40 * rng.normal(size=(60, 16)))
    yield _parted(rng, "near-duplicate columns", twins, 1e-18)
    yield _parted(rng, "mean 10⁶ × spread", np.c_[np.ones(1000), 1e6 + rng.normal(size=(1000, 20))], 1e-6)
    mixed = rng.normal(size=(400, 12)) * np.where(np.arange(12) % 2, 1e150, 1e-150)
    yield _parted(rng, "scales 1e-150 beside 1e150", mixed, 1e-303)
    yield _parted(rng, "fewer rows than columns, λ=0", rng.normal(size=(25, 30)), 0.0)
    constant = rng.normal(size=(500, 12))
    constant[:, 3], constant[:, 7], constant[:, 9] = 2.5, -1.25, 0.0
    yield _parted(rng, "constant columns, λ=0", constant, 0.0)


def _parted(rng: Rng, name: str, rows: FloatArray, penalty: float) -> Case:
    """A case of rows with decisions: four fifths to learn from, the rest to be evaluated."""
    targets, cut = _labels(rng, rows, 4), len(rows) * 4 // 5
    return Case(name, rows[:cut], targets[:cut], penalty, rows[cut:])


def _labels(rng: Rng, rows: FloatArray, classes: int) -> FloatArray:
    """0/1 targets: the class whose random direction a row has most of, with some noise; shape (n, C)."""
    centred = rows - rows.mean(axis=0)
    typical = np.abs(centred).max(axis=0)
    scores = (centred / np.where(typical == 0, 1.0, typical)) @ rng.normal(size=(rows.shape[1], classes))
    noisy = scores + 0.3 * scores.std() * rng.normal(size=scores.shape)
    return np.asarray(np.eye(classes)[noisy.argmax(axis=1)])


def updates(rng: Rng, dimension: int, distinct: int = 1000) -> tuple[FloatArray, FloatArray, float]:
    """Rows of a stream of one-row updates on the grid of the codes, which repeats after so many, 0/1 targets, and λ."""
    low = rng.normal(size=(distinct, max(4, dimension // 4)))
    rows = np.maximum(low @ rng.normal(size=(low.shape[1], dimension)), 0)
    rows = np.rint(rows / np.abs(rows).max() * 2.0**20) * 2.0**-20
    return rows, _labels(rng, rows, 2), 1000 * 2.0**-24
