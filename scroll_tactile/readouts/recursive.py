"""The paper's recursion as a way to follow the statistics between two fits: recursive least squares on 0/1 targets.

With x̃ = [1, (x − o) / √p], o the mean of all rows when it began and p the penalties, a row with target y does

    K = P x̃ (1 + x̃ᵀ P x̃)⁻¹,   W ← W + K (yᵀ − x̃ᵀ W),   P ← P − K x̃ᵀ P        (Sherman & Morrison 1950)

from P and W of a dense solve. What a readout needs beside W follows from it and the class means M (about the mean of
all rows) with their shares p_y: H = diag(p_y) (I − M W), and the discriminants' weights are W H⁻¹ (`readouts`).

Nothing brings P and W back to the exact statistics until the next fit, so rounding adds up: this is what `Tracked` is
compared with, and what a learner does with solver="recursive".
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.linalg.blas import dger
from scipy.linalg.lapack import dpotrf, dpotri

from scroll_tactile.readouts.readout import Readout, centred_means, require_definite
from scroll_tactile.readouts.tracking import Follower
from scroll_tactile.statistics.moments import one_thread, within_scatter
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["Recursive"]

FloatArray = npt.NDArray[np.float64]


class Recursive(Follower):
    """A follower by the paper's recursion."""

    def anchor(self, statistics: Statistics) -> None:
        """Start again from a dense solve of the exact statistics.

        Raises numpy.linalg.LinAlgError where S + P is not positive definite to working precision.
        """
        counts, sums = statistics.totals(self._scale)
        scatter = within_scatter(statistics.total_second(self._scale), counts, sums)
        self._origin, self._means = centred_means(counts, sums)
        self._counts = counts.astype(np.float64)
        unit = np.sqrt(self._penalties)
        means = self._means / unit
        system = scatter / np.outer(unit, unit) + (means.T * self._counts) @ means
        system[np.diag_indices_from(system)] += 1.0
        with one_thread():
            factor, failed = dpotrf(np.asfortranarray(system), lower=0, overwrite_a=1)
            require_definite(self._penalty, failed)
            inverse, _ = dpotri(factor, lower=0, overwrite_c=1)
        # The intercept has no penalty, and rows about their mean leave it apart from the rest.
        covariance = np.zeros((len(unit) + 1, len(unit) + 1))
        covariance[0, 0] = 1.0 / counts.sum()
        covariance[1:, 1:] = np.triu(inverse) + np.triu(inverse, 1).T
        weights = np.vstack([self._counts / counts.sum(), covariance[1:, 1:] @ (means.T * self._counts)])
        self._covariance, self._weights = np.asfortranarray(covariance), weights

    def add(self, rows: npt.NDArray[np.integer], place: int) -> bool:
        """Take in rows of codes, shape (k, d), of the class at a place, one by one; False for one without rows."""
        if not self._counts[place]:
            return False
        values = rows - self._origin
        targets = np.zeros(len(self._counts))
        targets[place] = 1.0
        for row in values / np.sqrt(self._penalties):
            self._update(np.concatenate([[1.0], row]), targets)
        self._counts[place] += len(rows)
        self._means[place] += (values - self._means[place]).sum(axis=0) / self._counts[place]
        return True

    def _update(self, row: FloatArray, targets: FloatArray) -> None:
        """One step of the recursion, with x̃ of shape (d + 1,) and y of shape (C,)."""
        # Where P has lost its definiteness numbers grow without bound: the scores show it, not a warning.
        with np.errstate(all="ignore"):
            projected = row @ self._covariance
            gain = projected / (1.0 + projected @ row)
            self._weights += np.outer(gain, targets - row @ self._weights)
            # In place: a product that is subtracted afterwards goes over P three times.
            self._covariance = dger(-1.0, gain, projected, a=self._covariance, overwrite_a=1)

    def readout(self) -> Readout:
        """The readout of all rows so far."""
        shares = self._counts / self._counts.sum()
        offset = shares @ self._means
        means = self._means - offset
        body = self._weights[1:] / np.sqrt(self._penalties)[:, None]
        ridge = shares[:, None] * (np.eye(len(shares)) - means @ body)
        weights = np.linalg.solve(ridge.T, body.T).T
        gram = means @ weights
        return Readout(
            self._penalty,
            self._origin + offset,
            weights,
            (gram + gram.T) / 2,
            (ridge + ridge.T) / 2,
            shares,
            self._penalties,
        )
