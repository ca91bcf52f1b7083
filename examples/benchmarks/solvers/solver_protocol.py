"""What every solver of the ridge regression is, and the checks that all of them share."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError, ScrollTactileError

__all__ = ["RidgeBase", "SingularError"]

FloatArray = npt.NDArray[np.float64]


class SingularError(ScrollTactileError, ArithmeticError):
    """The rows, with this λ, do not determine the weights, or not in this arithmetic: raise λ."""


class RidgeBase:
    """One way to W = argmin Σ ‖y − Wᵀ x‖² + λ ‖W‖² over rows x ∈ R^d with targets y ∈ R^C that come in batches.

    It has d, C, λ and the checks of what comes in; a subclass adds `_begin`, `_take` and `weights`.
    diagnosis: what is to be said of the weights that were asked for last; empty where nothing is wrong.
    """

    def __init__(self) -> None:
        self.dimension = 0
        self.outputs = 0
        self.penalty = 0.0
        self.diagnosis = ""

    def start(self, dimension: int, outputs: int, penalty: float) -> None:
        """Begin with no rows: d features, C outputs and λ ≥ 0. Raises InputError for others."""
        if dimension < 1 or outputs < 1:
            raise InputError(f"expected at least one feature and one output; came {dimension} and {outputs}")
        if not (np.isfinite(penalty) and penalty >= 0):
            raise InputError(f"expected a finite λ ≥ 0; came {penalty}")
        self.dimension, self.outputs, self.penalty = dimension, outputs, float(penalty)
        self.diagnosis = ""
        self._begin()

    def update(self, rows: npt.ArrayLike, targets: npt.ArrayLike) -> None:
        """Take in rows of shape (n, d) with targets of shape (n, C); none are taken where any is refused.

        Raises InputError for other shapes, and for values that are not finite, naming the first.
        """
        self._require_start()
        x = _table("rows", rows, self.dimension)
        y = _table("targets", targets, self.outputs)
        if len(x) != len(y):
            raise InputError(f"expected as many targets as rows; came {len(x)} rows and {len(y)} targets")
        if len(x):
            self._take(x, y)

    def weights(self) -> FloatArray:
        """W of shape (d, C), of all rows so far. Raises SingularError where they and λ do not determine it."""
        raise NotImplementedError

    def settle(self) -> None:
        """Bring rows that wait into the sums; `weights` does so by itself, but whoever measures asks for it first."""

    def _require_start(self) -> None:
        if not self.dimension:
            raise InputError("the solver was not started: call start(dimension, outputs, penalty) first")

    def _begin(self) -> None:
        raise NotImplementedError

    def _take(self, x: FloatArray, y: FloatArray) -> None:
        raise NotImplementedError


def _table(what: str, values: npt.ArrayLike, columns: int) -> FloatArray:
    try:
        table = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"expected {what} of real numbers; came {type(values).__name__}: {error}") from error
    if table.ndim != 2 or table.shape[1] != columns:
        raise InputError(f"expected {what} of shape (n, {columns}); came {table.shape}")
    if not np.isfinite(table).all():
        row, column = np.argwhere(~np.isfinite(table))[0].tolist()
        raise InputError(
            f"expected finite {what}; row {row}, column {column} is {table[row, column]}. Leave that row out"
        )
    return table
