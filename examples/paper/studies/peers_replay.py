"""Peers that keep touches in a buffer, or would: a linear softmax trained on what they hold. See `peers`."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import softmax

from examples.paper.studies.peers import ContinualPeer
from scroll_tactile.errors import InputError

__all__ = ["GDumb", "Replaying"]

FloatArray = npt.NDArray[np.float64]


class GDumb(ContinualPeer):
    """A greedily balanced buffer, and a linear softmax trained from scratch on it alone (Prabhu et al. 2020, ECCV).

    Features are standardised by the buffer; the softmax is fitted to convergence with a penalty of |W|²/2 beside the
    summed losses, in place of the authors' network and epochs.

    capacity: of the buffer, in touches, 1 or more. seed: draws what is dropped.
    """

    def __init__(self, capacity: int, seed: int = 0) -> None:
        super().__init__()
        if capacity < 1:
            raise InputError(f"expected a buffer of 1 touch or more; came {capacity}")
        self.capacity = capacity
        self._random = np.random.default_rng([seed, 2])
        self._buffer: dict[int, list[FloatArray]] = {}

    @property
    def held(self) -> dict[str, int]:
        """Material → touches of it in the buffer."""
        return {self.materials[place]: len(rows) for place, rows in self._buffer.items()}

    def observe(self, features: FloatArray, material: str) -> None:
        """Take the touch where its material has less than an equal share; where it is full, the largest gives way."""
        rows = self._buffer.setdefault(self._place(material), [])
        if len(rows) >= self.capacity / len(self._buffer):
            return
        if sum(map(len, self._buffer.values())) >= self.capacity:
            largest = max(self._buffer.values(), key=len)
            largest.pop(int(self._random.integers(len(largest))))
        rows.append(features)

    def scores(self, features: FloatArray) -> FloatArray:
        """Log-probabilities of the softmax. Needs scikit-learn."""
        from sklearn.linear_model import LogisticRegression

        rows = np.stack([row for held in self._buffer.values() for row in held])
        places = np.array([place for place, held in self._buffer.items() for _ in held])
        mean, spread = rows.mean(axis=0), rows.std(axis=0)
        spread[spread < 1e-9] = 1.0
        if len(self.materials) == 1:
            return np.zeros((len(features), 1))
        model = LogisticRegression(tol=1e-6, max_iter=5000).fit((rows - mean) / spread, places)
        logits: FloatArray = model.predict_log_proba((features - mean) / spread)
        return logits


class Replaying(ContinualPeer):
    """A linear softmax by gradient descent in the order of the stream, replaying from a reservoir.

    Experience replay (Chaudhry et al. 2019, arXiv 1902.10486); with capacity 0, naive fine-tuning. One step for
    each touch, on it and as many as `drawn` of the buffer. Features are standardised by the running mean and spread of
    all touches so far, and divided by √d.

    capacity: of the reservoir, in touches. seed: draws what is replayed and replaced. rate: of a step; the default was
    best of 0.3 to 100 for replay on the test folds themselves, which favours this peer. drawn: replayed at each step.
    """

    def __init__(self, capacity: int, seed: int = 0, rate: float = 10.0, drawn: int = 10) -> None:
        super().__init__()
        self.capacity = capacity
        self.rate = rate
        self.drawn = drawn
        self._random = np.random.default_rng([seed, 3])
        self._buffer: list[tuple[FloatArray, int]] = []
        self._seen = 0
        self._mean: FloatArray = np.zeros(0)
        self._squares: FloatArray = np.zeros(0)
        self._weights: FloatArray = np.zeros((0, 0))

    def observe(self, features: FloatArray, material: str) -> None:
        """Take one step, then offer the touch to the reservoir."""
        place = self._place(material)
        self._seen += 1
        if self._seen == 1:
            self._mean, self._squares = np.zeros_like(features), np.zeros_like(features)
            self._weights = np.zeros((len(features) + 1, 0))
        off = features - self._mean
        self._mean += off / self._seen
        self._squares += off * (features - self._mean)  # Welford's
        if place == self._weights.shape[1]:
            self._weights = np.pad(self._weights, ((0, 0), (0, 1)))
        chosen = self._random.permutation(len(self._buffer))[: self.drawn]
        batch = [(features, place), *(self._buffer[i] for i in chosen)]
        rows = self._standardised(np.stack([row for row, _ in batch]))
        errors = softmax(rows @ self._weights, axis=1)
        errors[np.arange(len(batch)), [i for _, i in batch]] -= 1
        self._weights -= self.rate * rows.T @ errors / len(batch)
        self._offer(features, place)

    def _offer(self, features: FloatArray, place: int) -> None:
        if len(self._buffer) < self.capacity:
            self._buffer.append((features, place))
        elif self.capacity and (i := int(self._random.integers(self._seen))) < self.capacity:
            self._buffer[i] = (features, place)

    def _standardised(self, features: FloatArray) -> FloatArray:
        spread = np.sqrt(self._squares / self._seen)
        standard = (features - self._mean) / np.where(spread < 1e-9, 1.0, spread)
        # While few were met a spread can be far too small.
        rows = np.clip(standard, -5, 5) / np.sqrt(len(self._mean))
        return np.pad(rows, ((0, 0), (0, 1)), constant_values=1.0 / np.sqrt(len(self._mean)))

    def scores(self, features: FloatArray) -> FloatArray:
        """Logits of the softmax."""
        logits: FloatArray = self._standardised(features) @ self._weights
        return logits
