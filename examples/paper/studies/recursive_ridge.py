"""Ridge regression that is followed as rows come and go, in float64: what analytic continual learning rests on."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["RecursiveRidge"]

FloatArray = npt.NDArray[np.float64]


class RecursiveRidge:
    """W = (XᵀX + λI)⁻¹ XᵀY, by Woodbury's identity at each change of k rows, without a fresh solve.

    R ← R ∓ R Xᵀ (I ± X R Xᵀ)⁻¹ X R and then W ← W ± R Xᵀ (Y − X W), upper signs for rows that come: the recursion of
    ACIL (Zhuang et al. 2022, arXiv 2205.14922), run backwards for rows that go.

    inverse: R, shape (d, d). weights: W, shape (d, C). sums: XᵀY, so that R XᵀY is another way to W.
    """

    def __init__(self, dimension: int, outputs: int, penalty: float) -> None:
        self.inverse = np.eye(dimension) / penalty
        self.weights = np.zeros((dimension, outputs))
        self.sums = np.zeros((dimension, outputs))

    def add(self, rows: FloatArray, targets: FloatArray) -> None:
        """Rows come, shape (k, d), with targets of shape (k, C); more outputs than before begin at 0."""
        more = ((0, 0), (0, targets.shape[1] - self.weights.shape[1]))
        self.weights, self.sums = np.pad(self.weights, more), np.pad(self.sums, more)
        self._change(rows, targets, 1)

    def remove(self, rows: FloatArray, targets: FloatArray) -> None:
        """Rows go that came before, in exact arithmetic as if they had never been."""
        self._change(rows, targets, -1)

    def _change(self, rows: FloatArray, targets: FloatArray, sign: int) -> None:
        crossed = self.inverse @ rows.T
        inner = np.eye(len(rows)) + sign * (rows @ crossed)
        self.inverse -= sign * (crossed @ np.linalg.solve(inner, crossed.T))
        self.weights += sign * (self.inverse @ (rows.T @ (targets - rows @ self.weights)))
        self.sums += sign * (rows.T @ targets)
