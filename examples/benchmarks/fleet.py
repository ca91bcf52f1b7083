"""What a fleet's memory costs: by the touch, by worker, and by the size of the packed memory that is merged."""

from __future__ import annotations

import os
import random
import shutil
import tempfile
import time
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scroll_tactile_store import StoreError

from examples.paper.runs.options import Json, Seed
from examples.paper.runs.results import show, write
from scroll_tactile import Kernels, Sensor, TactileLearner, sensors
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.clients.learning import learning
from scroll_tactile.clients.learning.fleet import learn
from scroll_tactile.clients.learning.sources import SourceOptions
from scroll_tactile.errors import MismatchError
from scroll_tactile.simulation.scene import Scene

__all__ = ["DyingExecutor", "fleet", "run_fleet"]

BY_FOLDER = SourceOptions(by="folder")
PAD = Sensor(name="pad", channels=2, rate=50.0, low=0.0, high=1.0, unit="N", duration=1.0)
SMALL: dict[str, Any] = {"sensor": PAD, "embedding": Kernels(seed=0, dimension=64), "exemplars": 4}
MERGED = (1, 16, 256, 1024)  # touches of a packed memory


class DyingExecutor(Executor):
    """Runs jobs here and now. ends: this share of them ends, before or after they ran; but no source ends a second."""

    def __init__(self, ends: float = 0.0, seed: int = 0) -> None:
        self._ends, self._random, self._ended = ends, random.Random(seed), set[str]()

    def submit(self, what: Any, /, *words: Any, **named: Any) -> Future[Any]:
        """As any Executor's."""
        future: Future[Any] = Future()
        ends = self._random.random() < self._ends and self._ended.isdisjoint(words[0].sources)
        try:
            made = None if ends and self._random.random() < 0.5 else what(*words, **named)
            if ends:
                self._ended |= set(words[0].sources)
                raise BrokenProcessPool("a worker died")
            future.set_result(made)
        except Exception as error:
            future.set_exception(error)
        return future


def run_fleet(touches: int, runs: int, flips: int, seed: int, note: Any) -> dict[str, Any]:
    """All measurements; processor seconds are of all processes, and leave out what else runs on the machine."""
    with tempfile.TemporaryDirectory(prefix="fleet-") as name:
        folder = Path(name)
        note("writing recordings")
        paths = _recordings(folder / "in", touches, seed)
        costs = _speed(folder, paths, note)
        costs["merges"] = _merges(folder, paths, note)
        costs["equal_runs"], costs["runs"] = _equal_runs(folder, runs, note), runs
        costs["sound_flips"], costs["flips"] = _sound_flips(folder, flips, note), flips
    return {"study": "fleet", "touches": touches, **costs}


def _recordings(folder: Path, count: int, seed: int) -> list[str]:
    scene, paths = Scene(sensor=sensors.BIOTAC, seed=seed), []
    for number in range(count):
        material = scene.materials[number % 20]
        path = folder / material / f"{number}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.asarray(scene.touch(material, number // 20).readings, np.float32))
        paths.append(str(path))
    return paths


def _speed(folder: Path, paths: list[str], note: Any) -> dict[str, Any]:
    """What learning costs in this process, and by two workers beside it."""
    found: dict[str, Any] = {}
    digests = set()
    for workers in (1, 2):
        note(f"{workers} workers")
        before = os.times()
        done = learn(paths, folder / f"by {workers}", BY_FOLDER, sensor=sensors.BIOTAC, workers=workers)
        spent = [after - then for after, then in zip(os.times(), before, strict=True)]
        own = {"processor": spent[0] + spent[1], "workers_processor": spent[2] + spent[3]}
        found[f"workers_{workers}"] = {"seconds": done.seconds, "touch": done.seconds / len(paths), **own}
        digests.add(done.digest)
    found["ratio"] = found["workers_1"]["seconds"] / found["workers_2"]["seconds"]
    return found | {"equal": len(digests) == 1}


def _merges(folder: Path, paths: list[str], note: Any) -> list[dict[str, Any]]:
    """How long it takes to merge a packed memory of so many touches into one of as many others."""
    with TactileLearner.open(folder / "into", sensor=sensors.BIOTAC) as into:
        learning.learn_sources(into, paths[: len(paths) // 4], BY_FOLDER)
    found = []
    for touches in MERGED:
        if touches > len(paths) // 4:
            break
        note(f"merging {touches} touches")
        part = folder / f"part {touches}"
        with TactileLearner.open(part, sensor=sensors.BIOTAC) as robot:
            learning.learn_sources(robot, paths[-touches:], BY_FOLDER)
            begun = time.perf_counter()
            robot.pack(folder / f"{touches}.part")
            packing = time.perf_counter() - begun
        shutil.copytree(folder / "into", folder / f"into {touches}")
        with TactileLearner.open(folder / f"into {touches}") as into:
            into.digest()
            begun, processor = time.perf_counter(), time.process_time()
            into.merge(folder / f"{touches}.part")
            took = {"seconds": time.perf_counter() - begun, "processor": time.process_time() - processor}
        size = (folder / f"{touches}.part").stat().st_size
        found.append({"touches": touches, "bytes": size, "pack_seconds": packing, **took})
    return found


def _equal_runs(folder: Path, runs: int, note: Any) -> int:
    """How many random runs, of workers that die and touches that come twice, gave the digest."""
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
        done = learn([place / "in"], place / "m", BY_FOLDER, executor=dying, **SMALL)
        truth = TactileLearner(**SMALL)
        for material, touch in sorted(set(touches)):
            truth.observe(material, _noise(touch))
        equal += done.digest == truth.digest() and not done.refused
    return equal


def _noise(seed: int) -> Any:
    return np.random.default_rng(seed).uniform(0, 1, size=(40 + 4 * seed, 2)).astype(np.float32)


def _sound_flips(folder: Path, flips: int, note: Any) -> dict[str, int]:
    """Of packed memories with one flipped bit: how many were refused by name, and merged to the right bytes."""
    with TactileLearner.open(folder / "flipped", **SMALL) as robot:
        for seed in range(3):
            robot.observe("a", _noise(seed))
        robot.pack(folder / "p")
        truth = robot.digest()
    whole, draw, found = (folder / "p").read_bytes(), np.random.default_rng(0), {"refused": 0, "merged": 0}
    for number in range(flips):
        note(f"flip {number}")
        flipped = bytearray(whole)
        flipped[int(draw.integers(len(whole)))] ^= 1 << int(draw.integers(8))
        (folder / "p").write_bytes(bytes(flipped))
        with TactileLearner.open(folder / f"own {number}", **SMALL) as learner:
            try:
                learner.merge(folder / "p")
                found["merged"] += learner.digest() == truth
            except (StoreError, MismatchError) as error:
                found["refused"] += str(folder / "p") in str(error) and not learner.materials
    return found


def fleet(
    context: typer.Context,
    touches: Annotated[int, typer.Option(min=20, help="Recordings, simulated, learned twice.")] = 2000,
    runs: Annotated[int, typer.Option(min=1, help="With workers that die and touches that come twice.")] = 200,
    flips: Annotated[int, typer.Option(min=1, help="Of one bit of a packed memory.")] = 500,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Measure a fleet's memory: two workers beside one, merges by size, and what can go wrong."""
    with progress_bar() as progress:
        result = run_fleet(touches, runs, flips, seed, note=lambda what: progress(what, 0, 1))
    ways = [{"workers": number, **result[f"workers_{number}"]} for number in (1, 2)]
    columns = {"workers": "{./workers}", "s a touch": "{./touch|.4f}", "processor, s": "{./processor|.1f}"}
    show("learning", columns | {"of workers, s": "{./workers_processor|.1f}"}, ways)
    columns = {"touches": "{./touches}", "bytes": "{./bytes}", "merged in, s": "{./seconds|.3f}"}
    show("merging", columns, result["merges"])
    columns = {"two beside one": "{./ratio|.2f} ×", "equal runs": "{./equal_runs} of {./runs}"}
    columns |= {"refused or sound flips": "{./sound_flips|sum} of {./flips}"}
    show("what can go wrong", columns, [result])
    write(context, result)


os.environ.setdefault("OMP_NUM_THREADS", "1")
