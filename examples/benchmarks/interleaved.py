"""`python -m examples.benchmarks interleaved`: observing and asking in turns, beside other learners.

Each observation is followed by a prediction, with all that it sets off. Ours is a learner as a user has it, its memory
durable on disk, or in memory only, as the others keep theirs. Times are of the clock on the wall, with one thread for
linear algebra: the median and the 99th percentile of a pair, and the mean, in which fitting again now and then counts.
"""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer
from threadpoolctl import threadpool_limits

from examples.benchmarks.timing import Timing
from examples.benchmarks.vector_peers import GradientSteps, PseudoInverse, Refitted, VectorPeer, lacking
from examples.paper.runs.options import Json, Seed
from examples.paper.runs.results import show, write
from scroll_tactile import Capabilities, Sensor, TactileLearner
from scroll_tactile.clients.cli.terminal import progress_bar

__all__ = ["interleaved", "run_interleaved"]

FloatArray = npt.NDArray[np.float64]
Record = dict[str, Any]
CHANNELS, READINGS = 64, 8  # a stream is its own feature vector: nothing is embedded
SENSOR = Sensor(name="features", channels=CHANNELS, rate=float(READINGS), low=-1.0, high=1.0, unit="1", duration=1.0)


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


class _Ours:
    """A learner as a peer: its memory is on disk until `close`, or in memory only."""

    def __init__(self, *, on_disk: bool) -> None:
        self._folder = tempfile.TemporaryDirectory() if on_disk else None
        if self._folder is None:
            self.learner = TactileLearner(sensor=SENSOR, embedding=AsIs(), exemplars=0)
        else:
            self.learner = TactileLearner.open(self._folder.name, sensor=SENSOR, embedding=AsIs(), exemplars=0)

    def observe(self, place: int, row: FloatArray) -> None:
        self.learner.observe(f"{place:03d}", row.reshape(CHANNELS, READINGS).T)

    def predict(self, row: FloatArray) -> int:
        return int(self.learner.predict(row.reshape(CHANNELS, READINGS).T).material or -1)

    def close(self) -> None:
        self.learner.close()
        if self._folder is not None:
            self._folder.cleanup()


def run_interleaved(
    *,
    streams: int = 2000,
    materials: int = 50,
    pairs: int = 300,
    seed: int = 0,
    note: Callable[[str], object] = lambda what: None,
) -> Record:
    """Train each learner on so many streams, then time pairs; returns records."""
    sizes = {"streams": streams, "materials": materials, "features": AsIs.dimension}
    result: Record = {"bench": "interleaved", **sizes}
    source = _Source(materials, AsIs.dimension, seed)
    train = [(i % materials, source.row(i % materials)) for i in range(streams)]
    test = [(place, source.row(place), source.row(place)) for place in source.places(pairs)]
    records = []
    for name, package, make, number in _learners(materials, pairs, seed):
        if why := lacking(package):
            records.append({"learner": name, "measured": False, "why": why})
            continue
        note(f"{name}: {streams} streams, {number} pairs")
        learner = make()
        for place, row in train:
            learner.observe(place, row)
        learner.predict(test[0][1])  # the first fit is not a pair's
        with threadpool_limits(1):
            records.append({"learner": name, "measured": True} | _pairs(learner, test[:number]))
        if isinstance(learner, _Ours):
            learner.close()
    return result | {"records": _with_ratios(records)}


def _pairs(learner: VectorPeer, test: list[tuple[int, FloatArray, FloatArray]]) -> Record:
    """Times of an observation, of the prediction that follows it, and of both, and the share of wrong answers."""
    observing, predicting, right = [], [], 0
    for place, row, question in test:
        begun = time.perf_counter()
        learner.observe(place, row)
        between = time.perf_counter()
        right += learner.predict(question) == place
        predicting.append(time.perf_counter() - between)
        observing.append(between - begun)
    pair = Timing.of(np.add(observing, predicting).tolist())
    return {
        **pair.record(),
        "mean_milliseconds": pair.mean,
        **Timing.of(observing).record("observe_"),
        **Timing.of(predicting).record("predict_"),
        "pairs": pair.calls,
        "clock": "wall",
        "wrong": 1 - right / len(test),
    }


def _learners(materials: int, pairs: int, seed: int) -> list[tuple[str, str, Callable[[], VectorPeer], int]]:
    """Name, the package that it needs, how it is made, and how many pairs are timed."""
    few, d = max(2, pairs // 5), AsIs.dimension
    return [
        ("ours, durable on disk", "torch", lambda: _Ours(on_disk=True), pairs),
        ("ours, in memory only", "torch", lambda: _Ours(on_disk=False), pairs),
        ("streaming LDA, pseudo-inverse at each prediction", "torch", lambda: PseudoInverse(materials, d), few),
        ("RidgeClassifier, fitted again", "sklearn", Refitted, few),
        ("SGDClassifier.partial_fit", "sklearn", lambda: GradientSteps(materials, seed), pairs),
    ]


def _with_ratios(records: list[Record]) -> list[Record]:
    """How many times as long as ours a learner takes, of means: a factorisation now and then is a part of it."""
    for record in records:
        if record["measured"]:
            record["times_ours"], record["times_ours_in_memory"] = (
                record["mean_milliseconds"] / ours["mean_milliseconds"] for ours in records[:2]
            )
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


def interleaved(
    context: typer.Context,
    streams: Annotated[int, typer.Option(min=100, help="Learned before anything is timed.")] = 2000,
    pairs: Annotated[int, typer.Option(min=10, help="Of an observation and a prediction, timed.")] = 300,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Time observing and predicting in turns, 50 materials and 512 features, beside other learners."""
    with progress_bar() as progress:
        result = run_interleaved(streams=streams, pairs=pairs, seed=seed, note=lambda what: progress(what, 0, 1))
    columns = {"learner": "{./learner}", "not measured": "{?./why}"}
    names = {"ms a pair": "median_", "p99": "p99_", "mean": "mean_", "observe": "observe_median_"}
    columns |= {
        head: f"{{?./{name}milliseconds|.2f}}" for head, name in (names | {"predict": "predict_median_"}).items()
    }
    columns |= {
        "times ours": "{?./times_ours|.2f}",
        "… in memory": "{?./times_ours_in_memory|.2f}",
        "wrong": "{?./wrong|%}",
    }
    show(f"{result['streams']} streams, {result['materials']} materials", columns, result["records"])
    write(context, result)
