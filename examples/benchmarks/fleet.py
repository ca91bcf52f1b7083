"""What a fleet's memory costs: by the touch, the partial, the sum and the merge, and what thousands would take."""

from __future__ import annotations

import os
import random
import resource
import tempfile
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from examples.benchmarks.timing import circumstances
from scroll_tactile import Kernels, Sensor, TactileLearner, sensors
from scroll_tactile.datasets.simulator import Scene
from scroll_tactile.errors import MismatchError
from scroll_tactile.pipelines import learning
from scroll_tactile.pipelines.fleet import learn
from scroll_tactile.pipelines.sources import SourceOptions
from scroll_tactile.statistics.moments import MOST_ROWS
from store import StoreError

__all__ = ["DyingExecutor", "plan", "run_fleet"]

BY_FOLDER = SourceOptions(by="folder")
PAD = Sensor(name="pad", channels=2, rate=50.0, low=0.0, high=1.0, unit="N", duration=1.0)
SMALL: dict[str, Any] = {"sensor": PAD, "embedding": Kernels(seed=0, dimension=64), "exemplars": 4}
ROWS_A_TOUCH = 3  # at the scales that have most, of a usual touch
NETWORK = 1.25e8  # bytes a second of a worker's: a gigabit


class DyingExecutor(Executor):
    """Runs jobs here and now. ends: this share of them ends without an answer, before or after they ran."""

    def __init__(self, ends: float = 0.0, seed: int = 0) -> None:
        self._ends, self._random = ends, random.Random(seed)
        self._max_workers = 1 + self._random.randrange(4)

    def submit(self, what: Any, /, *words: Any, **named: Any) -> Future[Any]:
        """As any Executor's."""
        future: Future[Any] = Future()
        ends = self._random.random() < self._ends
        try:
            made = None if ends and self._random.random() < 0.5 else what(*words, **named)
            if ends:
                raise BrokenProcessPool("a worker died")
            future.set_result(made)
        except Exception as error:
            future.set_exception(error)
        return future


def run_fleet(touches: int, partials: int, runs: int, flips: int, seed: int, note: Any) -> dict[str, Any]:
    """All measurements; processor seconds are of all processes, and leave out what else runs on the machine."""
    with tempfile.TemporaryDirectory(prefix="fleet-") as name:
        folder = Path(name)
        note("writing recordings")
        _recordings(folder / "in", touches, seed)
        costs = _speed(folder, note)
        costs["sums"] = _sums(folder, partials, note)
        costs["equal_runs"], costs["runs"] = _equal_runs(folder, runs, note), runs
        costs["refused_flips"], costs["flips"] = _refused_flips(folder, flips, note), flips
    return {"study": "fleet", "touches": touches, **circumstances(seed), **costs, "plan": plan(costs)}


def _recordings(folder: Path, count: int, seed: int) -> None:
    scene = Scene(sensor=sensors.BIOTAC, seed=seed)
    for number in range(count):
        material = scene.materials[number % 20]
        path = folder / material / f"{number}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.asarray(scene.touch(material, number // 20).readings, np.float32))


def _speed(folder: Path, note: Any) -> dict[str, Any]:
    paths = sorted(map(str, (folder / "in").rglob("*.npy")))
    note("a plain loop")
    begun, processor = time.perf_counter(), time.process_time()
    with TactileLearner.open(folder / "plain", sensor=sensors.BIOTAC) as learner:
        learning.learn(learner, paths, BY_FOLDER)
        digest = learner.digest()
    plain = {"seconds": time.perf_counter() - begun, "processor": time.process_time() - processor}
    found: dict[str, Any] = {"plain": plain}
    for workers in (1, 2):
        note(f"{workers} workers")
        done = learn(folder / f"by {workers}", [folder / "in"], BY_FOLDER, sensor=sensors.BIOTAC, workers=workers)
        learned = done.processor["learning"]
        found[f"workers_{workers}"] = {
            "seconds": done.seconds,
            "merge_seconds": done.merging,
            "equal": done.digest == digest,
            **{f"{name}_processor": value for name, value in done.processor.items()},
            # What one worker does after another, and what each of them does by itself.
            "wall_of_idle_cores": learned / workers + done.processor["sums"] + done.processor["merge"],
        }
    one, two = found["workers_1"], found["workers_2"]
    whole = one["learning_processor"] + one["sums_processor"] + one["merge_processor"]
    found["overhead"] = whole / plain["processor"] - 1
    found["speed_up"] = one["wall_of_idle_cores"] / two["wall_of_idle_cores"]
    found["speed_up_wall"] = one["seconds"] / two["seconds"]
    found["merge_share"] = one["merge_processor"] / whole
    found["touch_seconds"] = one["learning_processor"] / len(paths)
    found["merge_touch_seconds"] = one["merge_processor"] / len(paths)
    return found


def _sums(folder: Path, count: int, note: Any) -> dict[str, Any]:
    """The sum of so many partials of a default memory, as a tree, one job after another; files come again and again."""
    scene, files = Scene(sensor=sensors.BIOTAC, seed=1), []
    for number in range(4):
        note(f"partial {number}")
        with TactileLearner.open(folder / f"robot {number}", sensor=sensors.BIOTAC) as robot, robot.batch():
            for i in range(20):
                robot.observe(scene.materials[i], scene.touch(scene.materials[i], number))
        with TactileLearner.open(folder / f"robot {number}", mode="read") as robot:
            files.append(folder / f"robot {number}.part")
            robot.pack(files[-1], rows=False)
            settings = robot.settings
            making = Making(sensors.BIOTAC, robot.embedding, None, settings.exemplars, settings.recall, BY_FOLDER)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:  # whose memory is that of the sums
        found = alone.submit(_sum_all, making, [str(files[i % len(files)]) for i in range(count)], folder).result()
    return {"partials": count, "bytes": files[0].stat().st_size, **found}


def _sum_all(making: Making, waiting: list[str], folder: Path) -> dict[str, float]:
    """Sum up partials, one job after another, and what it took."""
    begun, processor, jobs, count = time.perf_counter(), time.process_time(), 0, len(waiting)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    while len(waiting) > 1:
        parts, waiting = waiting[:FAN], waiting[FAN:]
        jobs += 1
        waiting.append(
            sum_partials(SumJob(making, tuple((path, ()) for path in parts), str(folder / f"sum {jobs}"))).path
        )
        for path in parts:
            if Path(path).name.startswith("sum"):
                Path(path).unlink()
    took = time.process_time() - processor
    return {
        "seconds": time.perf_counter() - begun,
        "processor": took,
        "each": took / max(count + jobs - 1, 1),
        "megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "megabytes_before": before / 1024,
    }


def _equal_runs(folder: Path, runs: int, note: Any) -> int:
    """How many random runs, of workers that die, trees of any shape and touches that come twice, gave the digest."""
    equal = 0
    for seed in range(runs):
        note(f"run {seed}")
        draw, place = random.Random(seed), folder / f"random {seed}"
        own = [(name, 3 * number + i) for i, name in enumerate("abc") for number in range(5)]  # a content each
        touches = [draw.choice(own) for _ in range(draw.randrange(1, 16))]
        for number, (material, touch) in enumerate(touches):
            path = place / "in" / material / f"{number}.npy"
            path.parent.mkdir(parents=True, exist_ok=True)
            np.save(path, _noise(touch))
        dying = DyingExecutor(draw.choice([0.0, 0.2, 0.4]), seed)
        done = learn(place / "m", [place / "in"], BY_FOLDER, client=dying, fan=draw.randrange(2, 6), **SMALL)
        truth = TactileLearner(**SMALL)
        for material, touch in sorted(set(touches)):
            truth.observe(material, _noise(touch))
        equal += done.digest == truth.digest() and not done.refused
    return equal


def _noise(seed: int) -> Any:
    return np.random.default_rng(seed).uniform(0, 1, size=(40 + 4 * seed, 2)).astype(np.float32)


def _refused_flips(folder: Path, flips: int, note: Any) -> int:
    """How many partials with one flipped bit were refused by name, with nothing merged."""
    with TactileLearner.open(folder / "flipped", **SMALL) as robot:
        for seed in range(3):
            robot.observe("a", _noise(seed))
        robot.pack(folder / "p")
    whole, draw, refused = (folder / "p").read_bytes(), np.random.default_rng(0), 0
    with TactileLearner.open(folder / "own", **SMALL) as learner:
        before = learner.digest()
        for number in range(flips):
            note(f"flip {number}")
            flipped = bytearray(whole)
            flipped[int(draw.integers(len(whole)))] ^= 1 << int(draw.integers(8))
            (folder / "p").write_bytes(bytes(flipped))
            try:
                learner.merge(folder / "p", shared="once")
            except (StoreError, MismatchError) as error:
                refused += str(folder / "p") in str(error) and learner.digest() == before
    return refused


def plan(costs: dict[str, Any]) -> list[dict[str, Any]]:
    """What many workers would take for many touches, by a simulation of the tree with these costs.

    Each worker learns jobs of 1024 touches; sums of 16 partials are made by whichever worker is free first, each after
    the partials that it needs; the merge at the end is one process's. Partials of sums travel at a gigabit a worker.
    """
    learned, merged = costs["touch_seconds"], costs["merge_touch_seconds"]
    each, size = costs["sums"]["each"], costs["sums"]["bytes"]
    rows = []
    for touches in (10**6, 10**8, 10**9):
        for workers in (10, 100, 1000):
            jobs = max(workers, -(-touches // 1024))
            seconds, depth, sums = _simulated(jobs, workers, touches / jobs * learned, FAN * (each + size / NETWORK))
            rows.append(
                {
                    "touches": touches,
                    "workers": workers,
                    "learning_hours": touches * learned / workers / 3600,
                    "tree_hours": (seconds - touches * learned / workers) / 3600,
                    "merge_hours": touches * merged / 3600,
                    "depth": depth,
                    "sums": sums,
                    "moved_gigabytes": (jobs + sums) * size / 1e9,
                    "memories": -(-touches * ROWS_A_TOUCH // MOST_ROWS),
                }
            )
    return rows


def _simulated(jobs: int, workers: int, learning: float, summing: float) -> tuple[float, int, int]:
    """Seconds until the last sum, the depth of the tree, and the sums in it: jobs wait for workers and partials."""
    import heapq

    free = [0.0] * workers
    ends = []
    for _ in range(jobs):
        end = heapq.heappop(free) + learning
        heapq.heappush(free, end)
        ends.append(end)
    depth = sums = 0
    while len(ends) > 1:
        ends.sort()
        above = []
        for first in range(0, len(ends), FAN):
            part = ends[first : first + FAN]
            begin = max(heapq.heappop(free), part[-1])
            above.append(begin + summing * len(part) / FAN)
            heapq.heappush(free, above[-1])
            sums += 1
        ends, depth = above, depth + 1
    return ends[0], depth, sums


os.environ.setdefault("OMP_NUM_THREADS", "1")
