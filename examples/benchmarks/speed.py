"""`python -m examples.benchmarks speed`: what a user waits for, and what it stands beside, as ratios of one run.

Calls of a learner are timed by the clock on the wall, on a memory on disk, each of a touch of its own. Linear algebra
is timed on one thread, in processor time. Touches are simulated: their content does not change the cost.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.linalg.blas import dsyrk

from examples.benchmarks.before import run_before
from examples.benchmarks.timing import Clock, Timing, circumstances, take_turns, timed
from examples.benchmarks.vision_speed import BareResNet
from scroll_tactile import sensors
from scroll_tactile.datasets.simulator import Scene
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.embeddings.runtimes import one_torch_thread
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
from store import Store

__all__ = ["run_speed"]

Record = dict[str, Any]
Note = Callable[[str], None]
WHOLE = Scale("window", 1)  # features of a touch as a whole: one row each
BLOCK = 64  # rows in which the plain update is fed, and ours
TRAIN_TOUCHES = 20  # touches of each of twenty materials, before a user's calls are timed
FRESH = 20  # observations, each with a prediction after it: a second or more each
PROCESSOR: Clock = "processor"


def run_speed(
    *,
    seed: int = 0,
    observations: int = 100_000,
    rounds: int = 50,
    before: Path | None = None,
    note: Note = lambda _: None,
) -> Record:
    """Measure everything; `note` is told what is being done. Returns circumstances and a list of records.

    rounds: each call is timed five times in a round. before: a checkout of the project to be timed beside this one.
    """
    result = {"bench": "speed", **circumstances(seed), "threads": torch.get_num_threads()}
    note(f"a memory of {TRAIN_TOUCHES} touches of each material: observe, predict, beside a ResNet-18")
    records = _user_calls(seed, rounds)
    note("a statistics update beside a plain dsyrk")
    records.append(_update_and_dsyrk(seed, rounds))
    note("one row beside half of A")
    records.append(_row_and_memory(seed, rounds))
    note("many λ from one factorisation beside one of each")
    records += [_path_and_refits(seed, number, max(3, rounds // 10)) for number in (4, 16)]
    note(f"a memory of {observations} observations beside one of 1000")
    records += _large_and_small(seed, observations, rounds)
    result["records"] = records
    if before is not None:
        note("this checkout beside the one before")
        result["before"] = run_before(before, seed=seed, touches=TRAIN_TOUCHES, pairs=FRESH)
    return result


def _record(case: str, ours: Timing, other: Timing, against: str, error: str, bar: str) -> Record:
    return {
        "case": case,
        **ours.record(),
        "calls": ours.calls,
        "clock": ours.clock,
        "against": against,
        **other.record("against_"),
        "ratio": ours.median / other.median,
        "error": error,
        "bar": bar,
    }


def _touches(scene: Scene, first: int) -> Iterator[tuple[str, npt.NDArray[np.float32]]]:
    """Touches of all materials in turn, without end, from a repetition on: (material, readings)."""
    for repetition in count(first):
        for name in scene.materials:
            yield name, np.array(scene.touch(name, repetition).readings)


def _ready(scene: Scene, first: int, number: int) -> Iterator[tuple[str, npt.NDArray[np.float32]]]:
    """So many touches made beforehand, again and again: making them must not be timed."""
    touches = _touches(scene, first)
    made = [next(touches) for _ in range(number)]
    return (made[i % number] for i in count())


def _user_calls(seed: int, rounds: int) -> list[Record]:
    """Observe, predict, and predict right after an observe, on a memory of the default learner on disk."""
    scene = Scene(sensor=sensors.BIOTAC, seed=seed)
    network = BareResNet(ResNet.random(seed)).eval()
    image = torch.from_numpy(three_planes(tactile_image(scene.touch(scene.materials[0], 99)))[None])
    evaluated, added = _ready(scene, 1000, 200), _ready(scene, 2000, FRESH)

    def forward() -> None:
        # On two threads it waits for whatever else runs on the other core.
        with torch.inference_mode(), one_torch_thread():
            network(image)

    with tempfile.TemporaryDirectory() as folder, TactileLearner.open(folder, sensor=scene.sensor) as learner:
        observing = []
        touches = _touches(scene, 0)
        for _ in range(TRAIN_TOUCHES * len(scene.materials)):
            observing.append(timed(partial(learner.observe, *next(touches))))
        calls: dict[str, Callable[[], object]] = {
            "predict": lambda: learner.predict(next(evaluated)[1]),
            "resnet": forward,
        }
        turns = take_turns(calls, rounds)
        fresh = []
        for name, readings in (next(added) for _ in range(FRESH)):
            observing.append(timed(partial(learner.observe, name, readings)))
            fresh.append(timed(partial(learner.predict, next(evaluated)[1])))
        tries = [next(evaluated) for _ in range(60)]
        wrong = np.mean([learner.predict(readings).material != name for name, readings in tries])
    predict = turns["predict"]
    memory = f"memory of {TRAIN_TOUCHES * len(scene.materials)} touches on disk"
    error = f"{100 * wrong:.1f} % of simulated touches wrong"
    beside = "ResNet-18 forward of the same image, torch, one thread"
    return [
        _record(f"predict, 4 s of BioTac, {memory}", predict, turns["resnet"], beside, error, "ratio ≤ 0.2"),
        _record(f"observe, {memory}", Timing.of(observing), predict, "predict", "exact", "no bar"),
        _record(f"predict right after an observe, {memory}", Timing.of(fresh), predict, "predict", error, "no bar"),
    ]


def _update_and_dsyrk(seed: int, rounds: int) -> Record:
    rng = np.random.default_rng(seed)
    dimension, rows = 1008, 16 * BLOCK
    features = rng.random((rows, dimension))
    codes = to_codes(features, 1.0)
    blocks = [codes[i : i + BLOCK] for i in range(0, rows, BLOCK)]
    plain_blocks = [np.asfortranarray(features[i : i + BLOCK].T) for i in range(0, rows, BLOCK)]

    def ours() -> npt.NDArray[np.int64]:
        moment = SecondMoment(dimension)
        for block in blocks:
            moment.add(block)
        return moment.packed()

    def plain(order: list[int] | None = None) -> npt.NDArray[np.float64]:
        total = np.zeros((dimension, dimension), order="F")
        for i in order or range(len(blocks)):
            total = dsyrk(1.0, plain_blocks[i], beta=1.0, c=total, overwrite_c=1, lower=0)
        return total

    with one_thread():
        calls: dict[str, Callable[[], object]] = {"ours": ours, "plain": plain}
        timings = take_turns(calls, max(3, rounds // 10), warm_up=1, clock=PROCESSOR)
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
        timings = take_turns(calls, max(3, rounds // 10), warm_up=1, clock=PROCESSOR)
    each = {
        name: Timing(taken.median / of, taken.p99 / of, taken.mean / of, taken.calls, taken.clock)
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
        timings = take_turns(calls, rounds, warm_up=1, clock=PROCESSOR)
    pairs = zip(fit_readouts(task, penalties), (fit_readout(task, penalty) for penalty in penalties), strict=True)
    worst = max(
        float(np.abs(ours.weights - theirs.weights).max() / np.abs(theirs.weights).max()) for ours, theirs in pairs
    )
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
    fresh = [_ready(scene, 1000, 5 * rounds + 3) for _ in range(2)]
    evaluated = [_ready(scene, 5000, 100) for _ in range(2)]
    with tempfile.TemporaryDirectory() as folder:
        small = _filled(Path(folder) / "small", scene, 1000, seed)
        large = _filled(Path(folder) / "large", scene, observations, seed)
        with small, large:
            calls: dict[str, Callable[[], object]] = {
                "observe, small": lambda: small.observe("new", next(fresh[0])[1]),
                "observe, large": lambda: large.observe("new", next(fresh[1])[1]),
            }
            observing = take_turns(calls, rounds)
            calls = {
                "small": lambda: small.predict(next(evaluated[0])[1]),
                "large": lambda: large.predict(next(evaluated[1])[1]),
            }
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
    with TactileLearner.open(path, sensor=scene.sensor) as learner:
        dimension = learner.embedding.dimension
    rng = np.random.default_rng([seed, observations])
    widths = scales(scene.sensor)
    of_touch = extent(widths[-1], widths)
    with Store.open(path) as store:
        for i in range(observations):
            codes = {
                Scale("window", width): rng.integers(0, 23, size=(1, dimension), dtype=np.int32) * 2**14
                for width in of_touch
            }
            material = scene.materials[i % len(scene.materials)]
            attributes = {"columns": widths[0]}
            store.append(OBSERVE, material, rng.bytes(32), attributes=attributes, arrays=pack_codes(codes))
    return TactileLearner.open(path)
