"""Learners that are fed one feature vector at a time: other libraries' and, without streams and store, ours.

Each is called as its documentation has it, with its own defaults where nothing else is said. None is needed to run a
robot: what is not installed is named in a report as not measured.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch

from scroll_tactile.readouts.readout import Readout
from scroll_tactile.readouts.recursive import WoodburyReadout
from scroll_tactile.readouts.shrinkage import select
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import in_units, to_codes
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.statistics import Statistics, fold_of

__all__ = [
    "GradientSteps",
    "OneVsRest",
    "Ours",
    "PseudoInverse",
    "RecursiveFilters",
    "Refitted",
    "VectorPeer",
    "lacking",
]

FloatArray = npt.NDArray[np.float64]
WHOLE = Scale("window", 1)


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


class Ours:
    """The statistics and the readout of a memory, fed feature vectors as the peers are (`VectorPeer`).

    dimension: d, of vectors in [-bound, bound]. λ is chosen again where there is a new class or the rows have grown
    by the share `refit`; in between the readout follows, as a learner's does.
    """

    def __init__(self, dimension: int, refit: float, bound: float = 1.0) -> None:
        self.bound = bound
        self.statistics = Statistics(dimension, [WHOLE])
        self.refit = refit
        self._waiting: list[tuple[str, npt.NDArray[np.int32]]] = []
        self._fitted_at = self._seen = 0
        self._names: dict[str, int] = {}
        self._tracked: WoodburyReadout | None = None
        self._readout: Readout | None = None

    def observe(self, place: int, row: FloatArray) -> None:
        """Learn one vector of the class at a place."""
        name, codes = f"{place:03d}", to_codes(row[None], self.bound)
        self.statistics.add(name, fold_of(codes.tobytes()), {WHOLE: codes})
        self._seen += 1
        self._waiting.append((name, codes))

    def predict(self, row: FloatArray) -> int:
        """The place of the class that a vector is most like."""
        if self._waiting:
            with one_thread():
                self._take_in()
        assert self._readout is not None
        z = self._readout.project(in_units(row[None], self.bound))
        return int(list(self._names)[int(self._readout.scores(z, "lda").argmax())])

    def _take_in(self) -> None:
        new = any(name not in self._names for name, _ in self._waiting)
        if new or self._readout is None or self._seen > (1 + self.refit) * self._fitted_at:
            selection = select(self.statistics, WHOLE, "lda")
            assert selection is not None
            self._names, self._readout = selection.places, selection.readout
            self._fitted_at, self._tracked = self._seen, None
        else:
            if self._tracked is None:
                self._tracked = WoodburyReadout(self.statistics, WHOLE, self._readout)
            elif not all(self._tracked.add(codes, self._names[name]) for name, codes in self._waiting):
                self._tracked.anchor(self.statistics)
            self._readout = self._tracked.readout()
        self._waiting.clear()


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


class OneVsRest:
    """river's LogisticRegression behind its StandardScaler, one against the rest."""

    def __init__(self) -> None:
        from river.linear_model import LogisticRegression
        from river.multiclass import OneVsRestClassifier
        from river.preprocessing import StandardScaler

        self.model = StandardScaler() | OneVsRestClassifier(LogisticRegression())

    @staticmethod
    def _named(row: FloatArray) -> dict[int, float]:
        return dict(enumerate(row.tolist()))

    def observe(self, place: int, row: FloatArray) -> None:
        """One step of each classifier."""
        self.model.learn_one(self._named(row), place)

    def predict(self, row: FloatArray) -> int:
        """The class with the highest score; -1 before anything was learned."""
        said = self.model.predict_one(self._named(row))
        return -1 if said is None else int(said)


class RecursiveFilters:
    """padasip's FilterRLS, one for each class on 0/1 targets, without forgetting: each carries a P of its own."""

    def __init__(self, classes: int, dimension: int) -> None:
        from padasip.filters import FilterRLS

        self.filters = [FilterRLS(n=dimension, mu=1.0, eps=1.0, w="zeros") for _ in range(classes)]

    def observe(self, place: int, row: FloatArray) -> None:
        """Adapt every filter."""
        for i, classifier in enumerate(self.filters):
            classifier.adapt(float(i == place), row)

    def predict(self, row: FloatArray) -> int:
        """The filter with the highest output."""
        return int(np.argmax([classifier.predict(row) for classifier in self.filters]))
