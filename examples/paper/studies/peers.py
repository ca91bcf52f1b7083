"""Peers without a buffer: how others learn from a stream of features, re-implemented to be compared on the same ones.

None of this is the authors' code; each class names its source and what differs. A touch is one vector here: the mean
of its windows' features at the widest scale. What a peer standardises with is only what it has met so far.
Randomness is each peer's own, from its seed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from examples.paper.studies.recursive_ridge import RecursiveRidge
from scroll_tactile import Embedding
from scroll_tactile.embeddings.protocol import embed_windows
from scroll_tactile.errors import InputError
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import Stream
from scroll_tactile.signals.windows import WindowPlan, scales

__all__ = ["ACIL", "ContinualPeer", "NearestMean", "NearestNeighbour", "RanPAC", "StreamingLDA", "touch_features"]

FloatArray = npt.NDArray[np.float64]


def touch_features(embedding: Embedding, streams: Sequence[Stream]) -> FloatArray:
    """One vector for each of N touches, shape (N, d): the mean of its windows at the sensor's widest scale.

    A touch too short for that scale is one window of it, read as far as it goes.
    """
    rows = []
    for stream in streams:
        widths = scales(stream.sensor)
        image = tactile_image(stream)
        starts = WindowPlan(widths).extent(image.shape[1]).get(widths[-1], [0])
        rows.append(embed_windows(embedding, image, {widths[-1]: starts})[widths[-1]].mean(axis=0, dtype=np.float64))
    return np.stack(rows)


class ContinualPeer(ABC):
    """A learner of feature vectors in one pass, which learns of new materials by meeting them.

    materials: those met, in the order of meeting.
    """

    def __init__(self) -> None:
        self.materials: list[str] = []

    @abstractmethod
    def observe(self, features: FloatArray, material: str) -> None:
        """Learn one touch, features of shape (d,)."""

    @abstractmethod
    def scores(self, features: FloatArray) -> FloatArray:
        """Scores of N touches, shape (N, d), for the materials met, shape (N, C)."""

    def boundary(self) -> None:  # noqa: B027 (it is complete: most peers do nothing then)
        """A task ends here; most have no use for it, and the learner does not know it either."""

    def predict(self, features: FloatArray) -> list[str]:
        """The material of each of N touches, features of shape (N, d). Raises InputError before any was met."""
        if not self.materials:
            raise InputError("expected a peer that has observed something; it has not. Call observe first")
        return [self.materials[i] for i in self.scores(features).argmax(axis=1)]

    def _place(self, material: str) -> int:
        if material not in self.materials:
            self.materials.append(material)
        return self.materials.index(material)


class NearestMean(ContinualPeer):
    """The nearest class mean of features of unit length, iCaRL's classifier (Rebuffi et al. 2017, arXiv 1611.07725)."""

    def __init__(self) -> None:
        super().__init__()
        self._sums: list[FloatArray] = []
        self._counts: list[int] = []

    def observe(self, features: FloatArray, material: str) -> None:
        """Add to the mean of the material."""
        place = self._place(material)
        if place == len(self._sums):
            self._sums.append(np.zeros_like(features))
            self._counts.append(0)
        self._sums[place] += _unit(features)
        self._counts[place] += 1

    def scores(self, features: FloatArray) -> FloatArray:
        """x·μ_y − |μ_y|²/2: the squared distance, negated, halved, less what all materials share."""
        means = np.stack(self._sums) / np.array(self._counts)[:, None]
        nearness: FloatArray = _unit(features) @ means.T - np.square(means).sum(axis=1) / 2
        return nearness


class NearestNeighbour(ContinualPeer):
    """The nearest of all touches met, features of unit length: a control that keeps everything."""

    def __init__(self) -> None:
        super().__init__()
        self._rows: list[FloatArray] = []
        self._places: list[int] = []

    def observe(self, features: FloatArray, material: str) -> None:
        """Keep the touch."""
        self._places.append(self._place(material))
        self._rows.append(_unit(features))

    def scores(self, features: FloatArray) -> FloatArray:
        """The largest cosine with a touch of each material."""
        cosines = _unit(features) @ np.stack(self._rows).T
        places = np.array(self._places)
        return np.stack([cosines[:, places == i].max(axis=1) for i in range(len(self.materials))], axis=1)


class StreamingLDA(ContinualPeer):
    """Deep SLDA (Hayes and Kanan 2020, arXiv 1909.01520) on features as they are, without its initial batch.

    Σ_{k+1} = (k Σ_k + k/(k+1) · r rᵀ) / (k+1), r = x − μ_y before the update; scores xᵀΛμ_y − μ_yᵀΛμ_y / 2 with
    Λ = ((1 − ε)Σ + εI)⁻¹. The factor k/(k+1), k counting touches of all materials, is the authors'. The first touch of
    a material is its mean here (r = 0); the authors' code has means begin at 0, which is worse.

    shrinkage: ε, the authors' 1e-4.
    """

    def __init__(self, shrinkage: float = 1e-4) -> None:
        super().__init__()
        self.shrinkage = shrinkage
        self._means: list[FloatArray] = []
        self._counts: list[int] = []
        self._touches = 0
        self._scatter: FloatArray | None = None
        self._pending: list[FloatArray] = []

    def observe(self, features: FloatArray, material: str) -> None:
        """Update Σ, then the mean."""
        place, k = self._place(material), self._touches
        if place == len(self._means):
            self._means.append(np.array(features, dtype=np.float64))
            self._counts.append(0)
        residual = features - self._means[place]
        self._pending.append(np.sqrt(k / (k + 1)) * residual)
        self._counts[place] += 1
        self._means[place] += residual / self._counts[place]
        self._touches += 1

    @property
    def covariance(self) -> FloatArray:
        """Σ, shape (d, d)."""
        # n Σ_n = Σ_k k/(k+1) r_k r_kᵀ, summed in blocks: one product instead of hundreds of rank one.
        if self._pending:
            rows = np.stack(self._pending)
            self._pending.clear()
            added = rows.T @ rows
            self._scatter = added if self._scatter is None else self._scatter + added
        if self._scatter is None:
            raise InputError("expected a peer that has observed something; it has not. Call observe first")
        return self._scatter / self._touches

    def scores(self, features: FloatArray) -> FloatArray:
        """The linear discriminants of the materials, equal shares assumed, as the authors do."""
        means = np.stack(self._means)
        system = (1 - self.shrinkage) * self.covariance
        system[np.diag_indices_from(system)] += self.shrinkage
        weights = np.linalg.solve(system, means.T)
        discriminants: FloatArray = features @ weights - np.einsum("cd,dc->c", means, weights) / 2
        return discriminants


class _Expanding(ContinualPeer):
    """A peer that learns φ(x) = relu(xW), W normal, of `size` features, one task after another."""

    def __init__(self, seed: int, size: int) -> None:
        super().__init__()
        self._random = np.random.default_rng([seed, 1])
        self._size = size
        self._projection: FloatArray | None = None
        self._task: list[tuple[FloatArray, int]] = []

    def observe(self, features: FloatArray, material: str) -> None:
        """Add to the task at hand."""
        self._task.append((self._expand(features), self._place(material)))

    def _expand(self, features: FloatArray) -> FloatArray:
        if self._projection is None:
            self._projection = self._random.standard_normal((features.shape[-1], self._size))
        return np.maximum(features @ self._projection, 0.0)

    def _taken(self) -> tuple[FloatArray, FloatArray]:
        """The task at hand, shape (k, size), and its targets, 0 or 1, shape (k, C)."""
        rows = np.stack([row for row, _ in self._task])
        return rows, np.eye(len(self.materials))[[place for _, place in self._task]]


class RanPAC(_Expanding):
    """Ridge on a random projection with RanPAC's rule for λ (McDonnell et al. 2023, arXiv 2307.02251).

    φ(x) = relu(xW), W normal; G = Σ φφᵀ, Q = Σ φyᵀ, W_o = (G + λI)⁻¹Q over all tasks. λ, of 10⁻⁸ … 10⁸, has the least
    squared error on the last fifth of the current task when fitted to the rest of that task alone.

    seed: of W. size: of φ; the authors' 10000 would be 800 MB of G for 800 touches. penalty: the λ of the last task.
    """

    def __init__(self, seed: int = 0, size: int = 2000) -> None:
        super().__init__(seed, size)
        self._gram = np.zeros((size, size))
        self._sums = np.zeros((size, 0))
        self.penalty = 1.0

    def boundary(self) -> None:
        """Add the finished task to G and Q."""
        self._gram, self._sums, self.penalty = self._with_task()
        self._task.clear()

    def _with_task(self) -> tuple[FloatArray, FloatArray, float]:
        """G, Q and λ, as if the task at hand ended here."""
        if not self._task:
            return self._gram, self._sums, self.penalty
        rows, targets = self._taken()
        sums = np.pad(self._sums, ((0, 0), (0, targets.shape[1] - self._sums.shape[1]))) + rows.T @ targets
        return self._gram + rows.T @ rows, sums, self._choose(rows, targets)

    def _choose(self, rows: FloatArray, targets: FloatArray) -> float:
        kept = max(1, int(0.8 * len(rows)))
        fitted, held = rows[:kept], rows[kept:]
        if not len(held):
            return self.penalty  # a task of one touch decides nothing
        # (ΦᵀΦ + λI)⁻¹Φᵀ = Φᵀ(ΦΦᵀ + λI)⁻¹: as many unknowns as touches instead of features.
        values, vectors = np.linalg.eigh(fitted @ fitted.T)
        inner, turned = held @ fitted.T @ vectors, vectors.T @ targets[:kept]
        penalties = 10.0 ** np.arange(-8, 9)
        losses = [
            np.square(inner @ (turned / (np.maximum(values, 0) + penalty)[:, None]) - targets[kept:]).mean()
            for penalty in penalties
        ]
        return float(penalties[int(np.argmin(losses))])

    def scores(self, features: FloatArray) -> FloatArray:
        """The ridge predictions, as if the task at hand ended here; it goes on."""
        gram, sums, penalty = self._with_task()
        weights = np.linalg.solve(gram + penalty * np.eye(self._size), sums)
        predictions: FloatArray = self._expand(features) @ weights
        return predictions


class ACIL(_Expanding):
    """ACIL's recursion (Zhuang et al. 2022, arXiv 2205.14922): ridge on a random expansion, in float64, task by task.

    Equal, but for rounding, to one ridge regression on all touches met, whatever the tasks.

    seed, size: of the expansion. penalty: the authors' γ.
    """

    def __init__(self, seed: int = 0, size: int = 2000, penalty: float = 1.0) -> None:
        super().__init__(seed, size)
        self._ridge = RecursiveRidge(size, 0, penalty)

    def boundary(self) -> None:
        """Let the recursion follow the finished task."""
        if self._task:
            self._ridge.add(*self._taken())
            self._task.clear()

    def scores(self, features: FloatArray) -> FloatArray:
        """The ridge predictions; to a recursion it is all the same where a task ends."""
        self.boundary()
        predictions: FloatArray = self._expand(features) @ self._ridge.weights
        return predictions


def _unit(features: FloatArray) -> FloatArray:
    length = np.linalg.norm(features, axis=-1, keepdims=True)
    unit: FloatArray = features / np.where(length > 0, length, 1.0)
    return unit
