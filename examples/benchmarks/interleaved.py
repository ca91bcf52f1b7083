"""`scroll-tactile bench interleaved`: observing and asking in turns, one stream at a time, beside other learners.

What is timed is a pair of an observation and a prediction, with all that it sets off: the mean over many pairs for
ours, which factorises again now and then, the mean of a few for the others, which do the same each time. It is
processor time, on one thread: the machines are shared, and what others do must not count.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from examples.benchmarks.ours import Ours
from examples.benchmarks.timing import circumstances
from examples.benchmarks.vector_peers import GradientSteps, Peer, PseudoInverse, Refitted, lacking
from scroll_tactile.embeddings import Capabilities
from scroll_tactile.learner import TactileLearner
from scroll_tactile.readouts.readout import Readout, fit_readout
from scroll_tactile.readouts.recursive import RecursiveLeastSquares, WoodburyReadout
from scroll_tactile.readouts.shrinkage import DEFAULT, task_of
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.statistics import Statistics

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
    capabilities = Capabilities(partial_windows=False, judged_scales="widest")

    def embed(self, image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """The image's first values, and zeros where there are fewer."""
        features = np.zeros(self.dimension, np.float32)
        values = image.reshape(-1)[: self.dimension]
        features[: len(values)] = values
        return features


class _Learner:
    def __init__(self, **settings: Any) -> None:
        self.learner = TactileLearner(sensor=SENSOR, embedding=AsIs(), exemplars=0, **settings)

    def observe(self, place: int, row: FloatArray) -> None:
        self.learner.observe(f"{place:03d}", row.reshape(CHANNELS, READINGS).T)

    def predict(self, row: FloatArray) -> int:
        return int(self.learner.predict(row.reshape(CHANNELS, READINGS).T).material or -1)


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
    for name, package, make, timed in _learners(materials, pairs, seed):
        if why := lacking(package):
            records.append({"learner": name, "measured": False, "why": why})
            continue
        note(f"{name}: {streams} streams")
        learner = make()
        for place, row in taught:
            learner.observe(place, row)
        learner.predict(asked[0][1])  # the first fit is not a pair's
        note(f"{name}: {timed} pairs")
        right = 0
        with threadpool_limits(1):
            begun = time.process_time()
            for place, row, question in asked[:timed]:
                learner.observe(place, row)
                right += learner.predict(question) == place
            seconds = (time.process_time() - begun) / timed
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


def _learners(materials: int, pairs: int, seed: int) -> list[tuple[str, str, Callable[[], Peer], int]]:
    """Name, the package that it needs, how it is made, and how many pairs are timed."""
    few, d = max(2, pairs // 50), AsIs.dimension
    return [
        ("ours, refit=0.1", "torch", lambda: _Learner(refit=0.1), pairs),
        ("ours, refit=1", "torch", lambda: _Learner(refit=1.0), pairs),
        ("ours, refit=0.1, fed vectors as the others are", "torch", lambda: Ours(d, 0.1), pairs),
        ("ours, refit=1, fed vectors as the others are", "torch", lambda: Ours(d, 1.0), pairs),
        ("ours, refit=0.1, solver='recursive'", "torch", lambda: _Learner(refit=0.1, solver="recursive"), pairs),
        ("ours, refit=0 (λ and calibration at every pair)", "torch", lambda: _Learner(refit=0.0), few),
        ("streaming LDA, pseudo-inverse at each prediction", "torch", lambda: PseudoInverse(materials, d), few),
        ("RidgeClassifier, fitted again", "sklearn", Refitted, few),
        ("SGDClassifier.partial_fit", "sklearn", lambda: GradientSteps(materials, seed), pairs),
    ]


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
    """The largest relative difference, of weights and Gram matrix, between following and solving anew; and of the
    paper's recursion, which is not anchored in between.
    """
    dimension, materials, scale = 64, 5, Scale("window", 1)
    source = _Source(materials, dimension, seed)
    names = [str(place) for place in range(materials)]
    statistics = Statistics(dimension, [scale])

    def codes(place: int) -> npt.NDArray[np.int32]:
        return np.rint(source.row(place)[None] * 2**20).astype(np.int32)

    for at in range(200):
        statistics.add(names[at % materials], at % 3, {scale: codes(at % materials)})
    start = fit_readout(task_of(statistics, scale), DEFAULT)
    tracked, recursive = WoodburyReadout(statistics, scale, start), RecursiveLeastSquares(statistics, scale, start)
    worst = {"exact": 0.0, "recursive": 0.0}
    for at, place in enumerate(source.places(interleavings)):
        rows = codes(place)
        statistics.add(names[place], at % 3, {scale: rows})
        if not tracked.add(rows, place):
            tracked.anchor(statistics)
        recursive.add(rows, place)
        found = {"exact": tracked.readout()}
        if at % max(1, interleavings // 100) == 0 or at + 1 == interleavings:
            anew = WoodburyReadout(statistics, scale, start).readout()
            found["recursive"] = recursive.readout()
            worst = {name: max(worst[name], _difference(readout, anew)) for name, readout in found.items()}
    return {
        "interleavings": interleavings,
        "features": dimension,
        "largest_relative_difference": worst["exact"],
        "of_the_recursion": worst["recursive"],
    }


def _difference(one: Readout, two: Readout) -> float:
    pairs = ((one.weights, two.weights), (one.gram, two.gram))
    return max(float(np.abs(ours - theirs).max() / np.abs(theirs).max()) for ours, theirs in pairs)
