"""Other libraries' learners, which are fed one feature vector at a time.

Each is called as its documentation has it, with its own defaults where nothing else is said. None is needed to run a
robot: what is not installed is named in a report as not measured.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch

__all__ = [
    "GradientSteps",
    "PseudoInverse",
    "Refitted",
    "VectorPeer",
    "lacking",
]

FloatArray = npt.NDArray[np.float64]


class VectorPeer(Protocol):
    """Learns feature vectors of shape (d,) of classes that are numbered from 0, and says which one a vector is of."""

    def observe(self, place: int, row: FloatArray) -> None:
        """Learn one vector of the class at a place."""
        ...

    def predict(self, row: FloatArray) -> int:
        """The place of the class that a vector is most like."""
        ...


def lacking(package: str) -> str:
    """In words what has to be installed for a peer; empty where it is."""
    if find_spec(package) is not None:
        return ""
    return f"{'scikit-learn' if package == 'sklearn' else package} is not installed"


class PseudoInverse:
    """Deep SLDA's recursion (Hayes and Kanan 2020) with the pseudo-inverse at each prediction, in torch's float32.

    So Avalanche's StreamingLDA runs it when asked after every example. It is Avalanche's recursion and not its code,
    which cannot be imported beside the torch that is needed here.
    """

    def __init__(self, classes: int, dimension: int) -> None:
        self.means = torch.zeros(classes, dimension)
        self.counts = torch.zeros(classes)
        self.covariance = torch.ones(dimension, dimension)
        self.seen = 0
        self._weights: torch.Tensor | None = None

    def observe(self, place: int, row: FloatArray) -> None:
        """Update the covariance, then the mean."""
        x = torch.from_numpy(row.astype(np.float32))
        delta = x - self.means[place]
        self.covariance = (self.seen * self.covariance + self.seen / (self.seen + 1) * torch.outer(delta, delta)) / (
            self.seen + 1
        )
        self.means[place] += delta / (self.counts[place] + 1)
        self.counts[place] += 1
        self.seen += 1
        self._weights = None

    def predict(self, row: FloatArray) -> int:
        """The largest discriminant; the pseudo-inverse is formed where something was observed since the last."""
        if self._weights is None:
            shrunk = (1 - 1e-4) * self.covariance + 1e-4 * torch.eye(len(self.covariance))
            self._weights = torch.linalg.pinv(shrunk) @ self.means.T
        weights = self._weights
        scores = torch.from_numpy(row.astype(np.float32)) @ weights - 0.5 * (self.means * weights.T).sum(dim=1)
        return int(scores.argmax())


class Refitted:
    """scikit-learn's RidgeClassifier, fitted to all rows so far at each prediction that follows an observation."""

    def __init__(self) -> None:
        from sklearn.linear_model import RidgeClassifier

        self.rows: list[FloatArray] = []
        self.places: list[int] = []
        self.model = RidgeClassifier(alpha=1.0)
        self._fitted = 0

    def observe(self, place: int, row: FloatArray) -> None:
        """Keep the row."""
        self.rows.append(row)
        self.places.append(place)

    def predict(self, row: FloatArray) -> int:
        """Fit if there are new rows, and predict."""
        if self._fitted < len(self.rows):
            self.model.fit(np.stack(self.rows), self.places)
            self._fitted = len(self.rows)
        return int(self.model.predict(row[None])[0])


class GradientSteps:
    """scikit-learn's SGDClassifier behind its StandardScaler, one `partial_fit` of each a row."""

    def __init__(self, classes: int, seed: int) -> None:
        from sklearn.linear_model import SGDClassifier
        from sklearn.preprocessing import StandardScaler

        self.scaler = StandardScaler()
        self.model = SGDClassifier(loss="log_loss", random_state=seed)
        self.classes = np.arange(classes)

    def observe(self, place: int, row: FloatArray) -> None:
        """One step."""
        scaled = self.scaler.partial_fit(row[None]).transform(row[None])
        self.model.partial_fit(scaled, [place], classes=self.classes)

    def predict(self, row: FloatArray) -> int:
        """The class with the highest score."""
        return int(self.model.predict(self.scaler.transform(row[None]))[0])
