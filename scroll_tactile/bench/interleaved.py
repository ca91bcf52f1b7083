"""`scroll-tactile bench interleaved`: observing and asking in turns, one stream at a time, beside other learners.

What is timed is a pair of an observation and a prediction, with all that it sets off: the mean over many pairs for
ours, which factorises again now and then, the mean of a few for the others, which do the same each time.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch

from scroll_tactile.bench.timing import circumstances
from scroll_tactile.learner import TactileLearner
from scroll_tactile.ridge.readouts import fit_readout
from scroll_tactile.ridge.selection import DEFAULT, task_of
from scroll_tactile.ridge.statistics import Statistics
from scroll_tactile.ridge.tracking import Tracked
from scroll_tactile.sensors import Sensor

__all__ = ["run_interleaved"]

FloatArray = npt.NDArray[np.float64]
Record = dict[str, Any]
CHANNELS, READINGS = 64, 8  # a stream is its own feature vector: nothing is embedded
SENSOR = Sensor(name="features", channels=CHANNELS, rate=float(READINGS), low=-1.0, high=1.0, unit="1", duration=1.0)
BAR_SLDA, BAR_RIDGE = 100, 10


class AsIs:
    """An embedding that takes the tactile image, 64 × 8, for the features."""

    name = "as is"
    dimension = CHANNELS * READINGS
    bound = 1.0
    fingerprint = hashlib.sha256(b"the image's values as they are, 1").hexdigest()
    partial_windows = False
    judged_scales = "widest"

    def embed(self, image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """The image's first values, and zeros where there are fewer."""
        features = np.zeros(self.dimension, np.float32)
        values = image.reshape(-1)[: self.dimension]
        features[: len(values)] = values
        return features


class _Learner(Protocol):
    def observe(self, place: int, row: FloatArray) -> None: ...
    def predict(self, row: FloatArray) -> int: ...


class _Ours:
    def __init__(self, refit: float) -> None:
        self.learner = TactileLearner(sensor=SENSOR, embedding=AsIs(), exemplars=0, refit=refit)

    def observe(self, place: int, row: FloatArray) -> None:
        self.learner.observe(f"{place:03d}", row.reshape(CHANNELS, READINGS).T)

    def predict(self, row: FloatArray) -> int:
        return int(self.learner.predict(row.reshape(CHANNELS, READINGS).T).material or -1)


class _PseudoInverse:
    """Deep SLDA's recursion (Hayes and Kanan 2020) with the pseudo-inverse at each prediction, in torch's float32.

    So Avalanche's StreamingLDA runs it when asked after every example.
    """

    def __init__(self, classes: int, dimension: int) -> None:
        self.means = torch.zeros(classes, dimension)
        self.counts = torch.zeros(classes)
        self.covariance = torch.ones(dimension, dimension)
        self.seen = 0

    def observe(self, place: int, row: FloatArray) -> None:
        x = torch.from_numpy(row.astype(np.float32))
        delta = x - self.means[place]
        self.covariance = (self.seen * self.covariance + self.seen / (self.seen + 1) * torch.outer(delta, delta)) / (
            self.seen + 1
        )
        self.means[place] += delta / (self.counts[place] + 1)
        self.counts[place] += 1
        self.seen += 1

    def predict(self, row: FloatArray) -> int:
        shrunk = (1 - 1e-4) * self.covariance + 1e-4 * torch.eye(len(self.covariance))
        inverse = torch.linalg.pinv(shrunk)
        weights = inverse @ self.means.T
        scores = torch.from_numpy(row.astype(np.float32)) @ weights - 0.5 * (self.means * weights.T).sum(dim=1)
        return int(scores.argmax())


class _Refitted:
    """scikit-learn's RidgeClassifier, fitted again to all rows so far at each prediction."""

    def __init__(self) -> None:
        self.rows: list[FloatArray] = []
        self.places: list[int] = []

    def observe(self, place: int, row: FloatArray) -> None:
        self.rows.append(row)
        self.places.append(place)

    def predict(self, row: FloatArray) -> int:
        from sklearn.linear_model import RidgeClassifier

        model = RidgeClassifier(alpha=1.0).fit(np.stack(self.rows), self.places)
        return int(model.predict(row[None])[0])


class _Gradient:
    """scikit-learn's SGDClassifier, one step a row."""

    def __init__(self, classes: int, seed: int) -> None:
        from sklearn.linear_model import SGDClassifier

        self.model = SGDClassifier(loss="log_loss", random_state=seed)
        self.classes = np.arange(classes)

    def observe(self, place: int, row: FloatArray) -> None:
        self.model.partial_fit(row[None], [place], classes=self.classes)

    def predict(self, row: FloatArray) -> int:
        return int(self.model.predict(row[None])[0])


def run_interleaved(
    *,
    streams: int = 2000,
    materials: int = 50,
    pairs: int = 300,
    interleavings: int = 100_000,
    seed: int = 0,
    note: Callable[[str], object] = lambda what: None,
) -> Record:
    """Teach each learner so many streams, then time pairs; returns circumstances, records and the drift.

    interleavings: of the run that shows that nothing drifts, at 64 features.
    """
    source = _Source(materials, AsIs.dimension, seed)
    taught = [(at % materials, source.row(at % materials)) for at in range(streams)]
    asked = [(place, source.row(place), source.row(place)) for place in source.places(pairs)]
    records = []
    for name, make, timed in _learners(materials, pairs, seed):
        note(f"{name}: {streams} streams")
        learner = make()
        if learner is None:
            records.append({"learner": name, "measured": False, "why": "scikit-learn is not installed"})
            continue
        for place, row in taught:
            learner.observe(place, row)
        learner.predict(asked[0][1])  # the first fit is not a pair's
        note(f"{name}: {timed} pairs")
        begun, right = time.perf_counter(), 0
        for place, row, question in asked[:timed]:
            learner.observe(place, row)
            right += learner.predict(question) == place
        seconds = (time.perf_counter() - begun) / timed
        records.append(
            {
                "learner": name,
                "measured": True,
                "milliseconds": seconds * 1e3,
                "pairs": timed,
                "wrong": 1 - right / timed,
            }
        )
    note(f"{interleavings} interleavings")
    sizes = {"streams": streams, "materials": materials, "features": AsIs.dimension}
    return {
        "bench": "interleaved",
        **circumstances(seed),
        **sizes,
        "records": _with_ratios(records),
        "drift": _drift(interleavings, seed),
    }


def _learners(materials: int, pairs: int, seed: int) -> list[tuple[str, Callable[[], _Learner | None], int]]:
    few = max(2, pairs // 50)
    return [
        ("ours, refit=0.1", lambda: _Ours(0.1), pairs),
        ("ours, refit=0 (λ and calibration at every pair)", lambda: _Ours(0.0), few),
        ("streaming LDA, pseudo-inverse at each prediction", lambda: _PseudoInverse(materials, AsIs.dimension), few),
        ("RidgeClassifier, fitted again", _if_there(_Refitted), few),
        ("SGDClassifier.partial_fit", _if_there(lambda: _Gradient(materials, seed)), pairs),
    ]


def _if_there(make: Callable[[], _Learner]) -> Callable[[], _Learner | None]:
    def made() -> _Learner | None:
        try:
            import sklearn  # noqa: F401  # whether it is there
        except ImportError:
            return None
        return make()

    return made


def _with_ratios(records: list[Record]) -> list[Record]:
    ours = records[0]["milliseconds"]
    for record in records:
        if record["measured"]:
            record["times_ours"] = record["milliseconds"] / ours
    return records


class _Source:
    """Rows in [-1, 1] about means that overlap: some rows are told apart, some are not."""

    def __init__(self, materials: int, dimension: int, seed: int) -> None:
        self._random = np.random.default_rng([seed, materials, dimension])
        self._means = self._random.normal(0, 0.05, (materials, dimension))

    def row(self, place: int) -> FloatArray:
        row: FloatArray = np.clip(self._means[place] + self._random.normal(0, 0.2, self._means.shape[1]), -1, 1)
        return row

    def places(self, count: int) -> list[int]:
        found: list[int] = self._random.integers(len(self._means), size=count).tolist()
        return found


def _drift(interleavings: int, seed: int) -> Record:
    """The largest relative difference, of weights and Gram matrix, between following and solving anew."""
    dimension, materials, scale = 64, 5, 1
    source = _Source(materials, dimension, seed)
    names = [str(place) for place in range(materials)]
    statistics = Statistics(dimension, [scale])

    def codes(place: int) -> npt.NDArray[np.int32]:
        return np.rint(source.row(place)[None] * 2**20).astype(np.int32)

    for at in range(200):
        statistics.add(names[at % materials], at % 3, {scale: codes(at % materials)})
    start = fit_readout(task_of(statistics, scale), DEFAULT)
    tracked, worst = Tracked(statistics, scale, start), 0.0
    for at, place in enumerate(source.places(interleavings)):
        rows = codes(place)
        statistics.add(names[place], at % 3, {scale: rows})
        if not tracked.add(rows, place):
            tracked.anchor(statistics)
        found = tracked.readout()
        if at % max(1, interleavings // 100) == 0 or at + 1 == interleavings:
            anew = Tracked(statistics, scale, start).readout()
            pairs = ((found.weights, anew.weights), (found.gram, anew.gram))
            worst = max(worst, *(float(np.abs(one - two).max() / np.abs(two).max()) for one, two in pairs))
    return {"interleavings": interleavings, "features": dimension, "largest_relative_difference": worst}
