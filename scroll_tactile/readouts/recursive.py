"""Readouts that follow the statistics from row to row, between two factorisations of the exact ones.

`WoodburyReadout`: a row changes the scatter within classes by a matrix of rank one. With K₀ = S_w + P factorised once
(P: the penalties, diagonal) and U the columns that came since, Woodbury's identity (Woodbury 1950) solves
S_w + U Uᵀ + P:

    K⁻¹ = K₀⁻¹ − V S⁻¹ Vᵀ,    V = K₀⁻¹ U,    S = I + Uᵀ V,

at 2 d² operations a row, where a factorisation takes d³ / 3 and forming S_w from its integers some d² more. Nothing
drifts: U only grows to a small part of d, and then all is factorised again, from the exact statistics.

`RecursiveLeastSquares`: the paper's recursion on 0/1 targets. With x̃ = [1, (x − o) / √p], o the mean of all rows when
it began and p the penalties, a row with target y does

    K = P x̃ (1 + x̃ᵀ P x̃)⁻¹,   W ← W + K (yᵀ − x̃ᵀ W),   P ← P − K x̃ᵀ P        (Sherman & Morrison 1950)

from P and W of a dense solve. What a readout needs beside W follows from it and the class means M (about the mean of
all rows) with their shares p_y: H = diag(p_y) (I − M W), and the discriminants' weights are W H⁻¹ (`readouts`).
Nothing brings P and W back to the exact statistics until the next fit, so rounding adds up: it is there to be
compared with.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.readout import Readout, centred_means, require_definite
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import one_thread, within_scatter
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["RecursiveLeastSquares", "RecursiveReadout", "WoodburyReadout"]

FloatArray = npt.NDArray[np.float64]

# Of d, and at least so many rows: beyond it what the rows since cost is more than a factorisation (d = 512, 50 classes:
# an update takes 0.3 ms with none, 0.9 ms with 64, a factorisation from the integers 6).
LARGEST_RANK = 8
LEAST_RANK = 32
FEW = 4  # columns that are solved for one by one


class RecursiveReadout(ABC):
    """The readout of one scale as rows come, with the penalties of the readout that it starts from.

    statistics: exact, of all rows so far. scale: the one that it reads. start: the readout fitted to them.
    """

    def __init__(self, statistics: Statistics, scale: Scale, start: Readout) -> None:
        self._scale = scale
        self._penalty = start.penalty
        # A feature that never varied was given a variance of 1, in codes²; should it begin to, that is no penalty.
        varied = start.weights.any(axis=1)
        self._penalties = np.where(varied, start.penalties, start.penalties[varied].mean() if varied.any() else 1.0)
        self.anchor(statistics)

    @abstractmethod
    def anchor(self, statistics: Statistics) -> None:
        """Start again from the exact statistics.

        Raises numpy.linalg.LinAlgError where the system is not positive definite to working precision.
        """

    @abstractmethod
    def add(self, rows: npt.NDArray[np.integer], place: int) -> bool:
        """Add rows of codes, shape (k, d), of the class at a place; False, and nothing done, where it cannot."""

    @abstractmethod
    def readout(self) -> Readout:
        """The readout of all rows so far."""


class WoodburyReadout(RecursiveReadout):
    """A recursive readout by Woodbury's identity.

    Equal, but for rounding, to a fresh solve of (S_w + P) W = M on the statistics with all rows added. Its products are
    small: whoever calls it with BLAS on one thread (`one_thread`) is answered soonest.
    """

    def anchor(self, statistics: Statistics) -> None:
        """Start again from the exact statistics.

        Raises numpy.linalg.LinAlgError where S_w + P is not positive definite to working precision.
        """
        from scipy.linalg.lapack import dpotrf, dpotrs

        counts, sums = statistics.totals(self._scale)
        system = within_scatter(statistics.total_second(self._scale), counts, sums)
        system[np.diag_indices_from(system)] += self._penalties
        center, means = centred_means(counts, sums)
        with one_thread():
            self._factor, failed = dpotrf(system, lower=0, overwrite_a=1)
            require_definite(self._penalty, failed)
            # About a fixed point, the mean of all rows when this began: about zero the digits of a large mean are lost.
            self._origin = center
            self._counts = counts.astype(np.float64)
            self._means = means
            # Of shape (C, d), class by class, as all that is added to it.
            self._solved = np.ascontiguousarray(dpotrs(self._factor, self._means.T, lower=0)[0].T)
            self._gram = self._means @ self._solved.T
        classes, dimension = self._solved.shape
        self._rank = 0
        room = max(LEAST_RANK, dimension // LARGEST_RANK)
        self._u, self._v = np.empty((room, dimension)), np.empty((room, dimension))
        self._b, self._s = np.empty((room, classes)), np.eye(room)

    def add(self, rows: npt.NDArray[np.integer], place: int) -> bool:
        """Add rows of codes, shape (k, d), of the class at a place; False where `anchor` is due instead.

        Nothing has changed then, and it has to be anchored to statistics that have these rows.
        """
        new = self._columns(rows, place)
        first, last = self._rank, self._rank + len(new)
        if last > len(self._u):
            return False
        before, count = self._counts[place], len(rows)
        solved = self._solve(new)
        self._u[first:last], self._v[first:last] = new, solved
        # The last column is the way of the class mean, so the mean's own solution follows from it.
        share = np.sqrt(count / (before * (before + count)))
        self._means[place] += share * new[-1]
        self._solved[place] += share * solved[-1]
        self._counts[place] += count
        column = self._means @ self._solved[place]
        self._gram[place], self._gram[:, place] = column, column
        self._b[first:last] = new @ self._solved.T
        self._b[:last, place] = self._u[:last] @ self._solved[place]
        cross = self._u[:last] @ solved.T
        self._s[:last, first:last] = cross
        self._s[first:last, :last] = cross.T
        self._s[range(first, last), range(first, last)] += 1.0
        self._rank = last
        return True

    def _solve(self, new: FloatArray) -> FloatArray:
        """K₀⁻¹ times each of the rows, shape (k, d)."""
        from scipy.linalg.blas import dtrsv
        from scipy.linalg.lapack import dpotrs

        if len(new) > FEW:
            solved: FloatArray = dpotrs(self._factor, new.T, lower=0)[0].T
            return solved
        # A triangle against one vector is read once; as a matrix of one column LAPACK takes four times as long.
        return np.stack([dtrsv(self._factor, dtrsv(self._factor, column, trans=1)) for column in new])

    def _columns(self, rows: npt.NDArray[np.integer], place: int) -> FloatArray:
        """What is to be added to U for these rows, transposed, (k, d): Σ over them of the scatter's change.

        (x − x̄)(x − x̄)ᵀ over the rows, of rank k − 1, and n k / (n + k) (x̄ − m)(x̄ − m)ᵀ.
        """
        values = rows - self._origin
        mean = values.mean(axis=0)
        before, count = self._counts[place], len(rows)
        way = np.sqrt(before * count / (before + count)) * (mean - self._means[place])
        if count == 1:
            return np.asarray(way[None])
        columns: FloatArray = np.vstack([values - mean, way])
        return columns

    def readout(self) -> Readout:
        """The readout of all rows so far."""
        rank, total = self._rank, self._counts.sum()
        shares = self._counts / total
        inner = np.linalg.solve(self._s[:rank, :rank], self._b[:rank])
        solved = self._solved - inner.T @ self._v[:rank]
        gram = self._gram - self._b[:rank].T @ inner
        offset = shares @ self._means
        weights = total * (solved - shares @ solved).T
        towards = gram @ shares
        gram = total * (gram - towards[:, None] - towards + shares @ towards)
        gram = (gram + gram.T) / 2
        ridge = np.linalg.inv(np.diag(1.0 / shares) + gram)
        center = self._origin + offset
        return Readout(self._penalty, center, weights, gram, (ridge + ridge.T) / 2, shares, self._penalties)


class RecursiveLeastSquares(RecursiveReadout):
    """A recursive readout by the paper's recursion."""

    def anchor(self, statistics: Statistics) -> None:
        """Start again from a dense solve of the exact statistics.

        Raises numpy.linalg.LinAlgError where S + P is not positive definite to working precision.
        """
        from scipy.linalg.lapack import dpotrf, dpotri

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
        """Take in rows of codes, shape (k, d), of the class at a place, one by one; always True."""
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
        from scipy.linalg.blas import dger

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
