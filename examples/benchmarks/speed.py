"""`scroll-tactile bench speed`: what a prediction, a statistics update, λ and a large memory cost, as ratios.

Every pair is timed in turns in one run; the error stands beside the time. Streams are simulated: their content
does not change the cost. Linear algebra is timed on one thread, in processor time.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.linalg.blas import dsyrk

from examples.benchmarks.bare_resnet import resnet18
from examples.benchmarks.timing import Timing, circumstances, take_turns
from scroll_tactile import sensors
from scroll_tactile.datasets.simulator import Scene
from scroll_tactile.learner import TactileLearner
from scroll_tactile.memory.rows import pack_codes
from scroll_tactile.memory.state import OBSERVE
from scroll_tactile.readouts.readout import fit_readout
from scroll_tactile.readouts.shrinkage import PENALTIES, fit_readouts, task_of
from scroll_tactile.signals.image import tactile_image, three_planes
from scroll_tactile.signals.windows import Scale, extent, scales
from scroll_tactile.statistics.grid import to_codes
from scroll_tactile.statistics.moments import SecondMoment, one_thread
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["run_speed"]

Record = dict[str, Any]
WHOLE = Scale("window", 1)  # features of a touch as a whole: one row each
Note = Callable[[str], None]
BLOCK = 64  # rows in which the plain update is fed, and ours


def run_speed(*, seed: int = 0, observations: int = 100_000, rounds: int = 50, note: Note = lambda _: None) -> Record:
    """Measure everything; `note` is told what is being done. Returns circumstances and a list of records."""
    note("a prediction beside a ResNet-18")
    records = [_predict_and_resnet(seed, rounds)]
    note("a statistics update beside a plain dsyrk")
    records.append(_update_and_dsyrk(seed, rounds))
    note("one row beside half of A")
    records.append(_row_and_memory(seed, rounds))
    note("many λ from one factorisation beside one of each")
    records += [_path_and_refits(seed, count, max(3, rounds // 10)) for count in (4, 16)]
    note(f"a memory of {observations} observations beside one of 1000")
    records += _large_and_small(seed, observations, rounds)
    return {"bench": "speed", **circumstances(seed), "threads": torch.get_num_threads(), "records": records}


def _record(case: str, ours: Timing, other: Timing, against: str, error: str, bar: str) -> Record:
    return {
        "case": case,
        "milliseconds": ours.least * 1e3,
        "median_milliseconds": ours.median * 1e3,
        "against": against,
        "against_milliseconds": other.least * 1e3,
        "ratio": ours.least / other.least,
        "error": error,
        "bar": bar,
    }


def _taught(seed: int, touches: int) -> tuple[TactileLearner, Scene]:
    scene = Scene(sensor=sensors.BIOTAC, seed=seed)
    learner = TactileLearner(sensor=sensors.BIOTAC)
    for name in scene.materials:
        for repetition in range(touches):
            learner.observe(name, scene.touch(name, repetition))
    return learner, scene


def _predict_and_resnet(seed: int, rounds: int) -> Record:
    learner, scene = _taught(seed, 3)
    stream = scene.touch(scene.materials[0], 99)
    readings = np.array(stream.readings)
    network = resnet18(seed)
    image = torch.from_numpy(three_planes(tactile_image(stream))[None])

    def forward() -> None:
        with torch.inference_mode():
            network(image)

    calls: dict[str, Callable[[], object]] = {"predict": lambda: learner.predict(readings), "resnet": forward}
    timings = take_turns(calls, rounds)
    tries = [(name, 50 + at) for name in scene.materials for at in range(3)]
    wrong = np.mean([learner.predict(scene.touch(*one)).material != one[0] for one in tries])
    return _record(
        "predict, 4 s of BioTac, end to end",
        timings["predict"],
        timings["resnet"],
        "ResNet-18 forward of the same image, torch",
        f"{100 * wrong:.1f} % of simulated touches wrong",
        "ratio ≤ 0.2",
    )


def _update_and_dsyrk(seed: int, rounds: int) -> Record:
    rng = np.random.default_rng(seed)
    dimension, rows = 1008, 16 * BLOCK
    features = rng.random((rows, dimension))
    codes = to_codes(features, 1.0)
    blocks = [codes[at : at + BLOCK] for at in range(0, rows, BLOCK)]
    plain_blocks = [np.asfortranarray(features[at : at + BLOCK].T) for at in range(0, rows, BLOCK)]

    def ours() -> npt.NDArray[np.int64]:
        moment = SecondMoment(dimension)
        for block in blocks:
            moment.add(block)
        return moment.packed()

    def plain(order: list[int] | None = None) -> npt.NDArray[np.float64]:
        total = np.zeros((dimension, dimension), order="F")
        for at in order or range(len(blocks)):
            total = dsyrk(1.0, plain_blocks[at], beta=1.0, c=total, overwrite_c=1, lower=0)
        return total

    with one_thread():
        calls: dict[str, Callable[[], object]] = {"ours": ours, "plain": plain}
        timings = take_turns(calls, max(3, rounds // 10), warm_up=1, clock=time.process_time)
    backwards = plain(list(range(len(blocks)))[::-1])
    upper = np.triu_indices(dimension)
    differing = float(np.mean(plain()[upper] != backwards[upper]))
    return _record(
        f"statistics update, {rows} rows of {dimension} in blocks of {BLOCK}",
        timings["ours"],
        timings["plain"],
        "plain float64 dsyrk of the same rows",
        f"exact; plain: {100 * differing:.0f} % of entries differ between two orders",
        "ratio ≤ 1.25",
    )


def _row_and_memory(seed: int, rounds: int) -> Record:
    dimension, rows = 1008, 2048
    codes = to_codes(np.random.default_rng(seed).random((rows, dimension)), 1.0)
    half = np.zeros(dimension * (dimension + 1) // 2)

    def ours() -> None:
        moment = SecondMoment(dimension)
        for row in range(rows):
            moment.add(codes[row : row + 1])
        moment.packed()

    def memory() -> None:
        for _ in range(16):
            np.add(half, 1.0, out=half)

    with one_thread():
        calls: dict[str, Callable[[], object]] = {"ours": ours, "memory": memory}
        timings = take_turns(calls, max(3, rounds // 10), warm_up=1, clock=time.process_time)
    each = {
        name: Timing(taken.least / of, taken.median / of)
        for (name, taken), of in zip(timings.items(), (rows, 16), strict=True)
    }
    return _record(
        f"statistics update, one row of {dimension}, mean of {rows}",
        each["ours"],
        each["memory"],
        "half of A read and written once",
        "exact",
        "ratio ≤ 3",
    )


def _path_and_refits(seed: int, count: int, rounds: int) -> Record:
    rng = np.random.default_rng(seed)
    dimension, classes, rows = 1008, 20, 3000
    places = np.arange(rows) % classes
    values = np.clip(rng.normal(0, 0.05, (classes, dimension))[places] + rng.normal(0, 0.2, (rows, dimension)), -1, 1)
    statistics = Statistics(dimension, [WHOLE])
    for place in range(classes):
        statistics.add(f"{place:02d}", 0, {WHOLE: to_codes(values[places == place], 1.0)})
    task, penalties = task_of(statistics, WHOLE), np.geomspace(min(PENALTIES), max(PENALTIES), count).tolist()
    with one_thread():
        calls: dict[str, Callable[[], object]] = {
            "path": lambda: fit_readouts(task, penalties),
            "each": lambda: [fit_readout(task, penalty) for penalty in penalties],
        }
        timings = take_turns(calls, rounds, warm_up=1, clock=time.process_time)
    pairs = zip(fit_readouts(task, penalties), (fit_readout(task, penalty) for penalty in penalties), strict=True)
    worst = max(float(np.abs(one.weights - two.weights).max() / np.abs(two.weights).max()) for one, two in pairs)
    return _record(
        f"readouts of {count} λ, {dimension} features, {classes} materials: one tridiagonalisation",
        timings["path"],
        timings["each"],
        "a Cholesky factorisation for each",
        f"weights differ by {worst:.0e}",
        "no bar",
    )


def _large_and_small(seed: int, observations: int, rounds: int) -> list[Record]:
    scene = Scene(sensor=sensors.BIOTAC, seed=seed)
    stream = np.array(scene.touch(scene.materials[0], 99).readings)
    with tempfile.TemporaryDirectory() as folder:
        small = _filled(Path(folder) / "small", scene, 1000, seed)
        large = _filled(Path(folder) / "large", scene, observations, seed)
        with small, large:
            calls: dict[str, Callable[[], object]] = {
                "observe, small": lambda: small.observe("new", stream),
                "observe, large": lambda: large.observe("new", stream),
            }
            observing = take_turns(calls, rounds)
            calls = {"small": lambda: small.predict(stream), "large": lambda: large.predict(stream)}
            predicting = take_turns(calls, rounds)
    pairs = [
        ("observe", observing["observe, large"], observing["observe, small"]),
        ("predict", predicting["large"], predicting["small"]),
    ]
    return [
        _record(
            f"{verb}, memory of {observations} observations", large_, small_, "memory of 1000", "exact", "ratio ≤ 1.2"
        )
        for verb, large_, small_ in pairs
    ]


def _filled(path: Path, scene: Scene, observations: int, seed: int) -> TactileLearner:
    """A learner on disk with so many touches of one window a scale, of made-up codes: only their number matters."""
    learner = TactileLearner.open(path, sensor=scene.sensor)
    rng = np.random.default_rng([seed, observations])
    widths = scales(scene.sensor)
    one = extent(widths[-1], widths)
    store, memory = learner._ledger.store, learner.memory
    assert store is not None
    for at in range(observations):
        codes = {
            Scale("window", width): rng.integers(0, 23, size=(1, learner.embedding.dimension), dtype=np.int32) * 2**14
            for width in one
        }
        key = rng.bytes(32)
        material = scene.materials[at % len(scene.materials)]
        columns = widths[0]
        record = store.append(OBSERVE, material, key, attributes={"columns": columns}, arrays=pack_codes(codes))
        memory.add(material, key, columns, codes, record.sequence)
    return learner
