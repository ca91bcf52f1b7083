"""`python -m examples.benchmarks speed`: what a user waits for, and what a memory takes, by the public interface alone.

Each learner has a process of its own and a memory on disk; each call has a touch of its own. An older checkout, where
one is given, is called in turns with this one. All by the clock on the wall: nothing is subtracted, and importing torch
stands apart. A bare forward pass of a ResNet-18 stands beside the milliseconds of the default learner.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import torch
import typer
from torch.nn.functional import adaptive_avg_pool2d

from examples.benchmarks.checkouts import Worker, checkouts, disk_bytes, in_turns, write_touches
from examples.benchmarks.many_materials import filled, run_many
from examples.benchmarks.speed_bench import Bench, Note, Record, Sides, Sizes
from examples.benchmarks.speed_touches import SHORT, Touch, biotac_touches
from examples.benchmarks.timing import Timing, timed
from examples.paper.runs.options import Json, Seed
from examples.paper.runs.results import show, write
from scroll_tactile import sensors
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.embeddings.steady import one_torch_thread
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import validate
from scroll_tactile.simulation.scene import Scene

__all__ = ["Sizes", "run_speed", "speed"]

MEGABYTE = 1e6
REPLAYED = 255  # observations that no close and no checkpoint follows: one more, and a checkpoint is written


def run_speed(
    *,
    seed: int = 0,
    data: Path | None = None,
    before: Path | None = None,
    sizes: Sizes | None = None,
    note: Note = lambda _: None,
) -> Record:
    """Measure everything; `note` is told what is being done. Returns a list of records.

    data: folder of BioTac_slide_20_50, of whose first fold's training part the everyday memory is made; simulated
    touches where it is None. before: an older checkout of the project.

    Raises InputError for a `before` that is no checkout, DatasetError for data that are not laid out as published.
    """
    sides = checkouts(before)
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(sides, Path(folder), sizes or Sizes(), seed, note)
        result = {"bench": "speed", "touches": "simulated" if data is None else "BioTac-20"}
        forward = _everyday(bench, data)
        counts = {bench.sizes.materials: bench.only_now()}
        if before is not None and bench.sizes.before_materials:
            counts[bench.sizes.before_materials] = sides
        for materials, own in counts.items():
            run_many(bench, own, materials)
        _opening(bench)
    return result | {"resnet_forward": forward, "records": bench.records}


def _everyday(bench: Bench, data: Path | None) -> Record:
    """The default learner's memory of twenty materials; returns what a bare forward pass took."""
    train, test = biotac_touches(bench.sizes.touches, bench.sizes.asked, data, bench.seed)
    touches = write_touches(bench.folder / "biotac", sensors.BIOTAC, [*train, *test], len(train[0][1]))
    memory = f"{len(train)} touches of {len({name for name, _ in train})} materials, BioTac"
    _fill_one_by_one(bench, memory, touches, len(train))
    forward = _forward(bench.seed, test[0][1])
    with ExitStack() as stack:
        workers = _start(bench, memory, touches, len(train), stack)
        passes = _predict_again(bench, memory, workers, len(train), test, forward)
        asked = _pairs(bench, memory, workers, len(train), len(test))
        _refresh(bench, memory, touches, workers, len(train), len(test))
        for name in workers:
            for i in range(asked + REFRESHES, REPLAYED):
                workers[name].call("observe", touch=len(train) + i % len(test))
    _open_killed(bench, memory, touches, len(train), REPLAYED)
    for record in bench.records:
        if record["unit"] == "ms":
            record["of_forward"] = record["median"] / passes.median
    return passes.record()


REFRESHES = 20


def _fill_one_by_one(bench: Bench, memory: str, touches: Path, number: int) -> None:
    bench.note(f"{memory}: observing")
    taken: dict[str, list[float]] = {name: [] for name in bench.sides}
    with ExitStack() as stack:
        workers = in_turns(stack, bench.sides, touches)
        for name, worker in workers.items():
            worker.call("open", path=str(bench.folder / name))
        for i in range(number):
            for name in _turn(workers, i):
                taken[name].append(workers[name].wall("observe", touch=i))
        for worker in workers.values():
            worker.call("close")
    bench.seconds(memory, "observe, durable", taken, "≤ 4")
    _disk(bench, memory, bench.sides, number, "≤ 16", "≤ 10")


def _disk(bench: Bench, memory: str, sides: Sides, touches: int, whole: str, row: str = "") -> None:
    paths = {name: bench.folder / name for name in sides}
    taken = {name: disk_bytes(path) / MEGABYTE for name, path in paths.items()}
    bench.size(memory, "disk after closing", "MB", taken, whole)
    rows = {name: disk_bytes(path, "log-*") / touches / 1e3 for name, path in paths.items()}
    bench.size(memory, "journal, a touch with its readings", "kB", rows, row)


def _turn(workers: dict[str, Worker], i: int) -> list[str]:
    """Each goes first in turn: the second finds its data pushed out of the processor's cache."""
    return sorted(workers, reverse=i % 2 == 0)


def _start(bench: Bench, memory: str, touches: Path, test: int, stack: ExitStack) -> dict[str, Worker]:
    """Open and predict in new processes; those that were started last go on."""
    bench.note(f"{memory}: first predictions of {bench.sizes.starts} processes")
    cases = ("import torch", "open", "first predict after opening", "open and first predict")
    taken: dict[str, dict[str, list[float]]] = {case: {name: [] for name in bench.sides} for case in cases}
    kept: dict[str, Worker] = {}
    for i in range(bench.sizes.starts):
        for name in bench.sides:
            with ExitStack() as own:
                worker = own.enter_context(Worker(bench.sides[name], touches))
                opening = worker.wall("open", path=str(bench.folder / name))
                first = worker.wall("predict", touch=test)
                values = (worker.started["torch"], opening, first, opening + first)
                for case, value in zip(cases, values, strict=True):
                    taken[case][name].append(value)
                if i + 1 == bench.sizes.starts:
                    kept[name] = worker
                    stack.push(own.pop_all())
    for case, bar in zip(cases, ("", "", "≤ 300", ""), strict=True):
        bench.seconds(memory, case, taken[case], bar)
    bench.size(memory, "memory beyond torch, after it", "MB", {name: kept[name].memory() for name in kept})
    return kept


def _forward(seed: int, readings: npt.NDArray[np.float32]) -> Callable[[], object]:
    """A bare forward pass of the touch that `readings` are, on one thread."""
    network = ResNet.random(seed).eval()
    image = torch.from_numpy(np.stack([tactile_image(validate(readings, sensors.BIOTAC))] * 3))[None]

    def forward() -> None:
        with torch.inference_mode(), one_torch_thread():
            adaptive_avg_pool2d(network(image)[-1], 1)

    return forward


def _predict_again(
    bench: Bench,
    memory: str,
    workers: dict[str, Worker],
    first: int,
    test: Sequence[Touch],
    forward: Callable[[], object],
) -> Timing:
    bench.note(f"{memory}: predictions beside a ResNet-18")
    taken: dict[str, list[float]] = {name: [] for name in workers}
    wrong = dict.fromkeys(workers, 0)
    passes = []
    for i, (material, _) in enumerate(test):
        for name in _turn(workers, i):
            answer = workers[name].call("predict", touch=first + i)
            taken[name].append(answer["wall"])
            wrong[name] += answer["said"] != material
        passes.append(timed(forward))
    shares = {f"{'' if name == 'now' else 'before_'}wrong": count / len(test) for name, count in wrong.items()}
    bench.seconds(memory, "predict again", taken, "≤ 2.5", **shares)
    return Timing.of(passes)


def _pairs(bench: Bench, memory: str, workers: dict[str, Worker], first: int, test: int) -> int:
    """Observe and predict in turns; returns how often."""
    bench.note(f"{memory}: {bench.sizes.pairs} observations, each with a prediction after it")
    observing: dict[str, list[float]] = {name: [] for name in workers}
    predicting: dict[str, list[float]] = {name: [] for name in workers}
    for i in range(bench.sizes.pairs):
        for name in _turn(workers, i):
            observing[name].append(workers[name].wall("observe", touch=first + i % test))
            predicting[name].append(workers[name].wall("predict", touch=first + (7 * i + 3) % test))
    bench.seconds(memory, "predict right after an observe", predicting, "≤ 15 / ≤ 60")
    bench.seconds(memory, "observe in these pairs", observing)
    bench.size(
        memory, "memory beyond torch, after them", "MB", {name: workers[name].memory() for name in workers}, "≤ 64"
    )
    bench.size(memory, "the most it held until then", "MB", {name: workers[name].memory("peak") for name in workers})
    return bench.sizes.pairs


def _refresh(bench: Bench, memory: str, touches: Path, workers: dict[str, Worker], first: int, test: int) -> None:
    """A reader in another process takes in what a writer observed."""
    bench.note(f"{memory}: a reader beside it")
    refreshing: dict[str, list[float]] = {name: [] for name in workers}
    predicting: dict[str, list[float]] = {name: [] for name in workers}
    with ExitStack() as stack:
        readers = in_turns(stack, {name: bench.sides[name] for name in workers}, touches)
        for name, reader in readers.items():
            reader.call("open", path=str(bench.folder / name), mode="read")
            reader.call("predict", touch=first)
        for i in range(REFRESHES):
            for name in _turn(workers, i):
                workers[name].call("observe", touch=first + (bench.sizes.pairs + i) % test)
                refreshing[name].append(readers[name].wall("refresh"))
                predicting[name].append(readers[name].wall("predict", touch=first + i % test))
    bench.seconds(memory, "a reader's refresh after one observation", refreshing, "≤ 20")
    bench.seconds(memory, "its predict after that", predicting)


def _open_killed(bench: Bench, memory: str, touches: Path, touch: int, replayed: int) -> None:
    """Open again what a process left that was ended without a close, and predict."""
    bench.note(f"{memory}: opening after a process that ended without a close")
    opening: dict[str, list[float]] = {name: [] for name in bench.sides}
    predicting: dict[str, list[float]] = {name: [] for name in bench.sides}
    for _ in range(bench.sizes.starts):
        for name in bench.sides:
            with Worker(bench.sides[name], touches) as worker:
                opening[name].append(worker.wall("open", path=str(bench.folder / name)))
                predicting[name].append(opening[name][-1] + worker.wall("predict", touch=touch))
    bench.seconds(memory, f"open, {replayed} observations after the last close", opening, "≤ 1000")
    bench.seconds(memory, "open so and first predict", predicting)


def _opening(bench: Bench) -> None:
    """Memories of many short touches: opened after a close, and after a process that ended without one."""
    scene = Scene(sensor=SHORT, seed=bench.seed)
    for number in bench.sizes.opening:
        sides = bench.sides if number <= bench.sizes.before_opening else bench.only_now()
        memory = f"{number} touches of {len(scene.materials)} materials (8 channels, 0.1 s)"
        bench.note(f"{memory}: observing")
        made = (
            (name, np.array(scene.touch(name, i // len(scene.materials)).readings))
            for i, name in ((i, scene.materials[i % len(scene.materials)]) for i in range(number + REPLAYED))
        )
        touches = write_touches(bench.folder / f"touches-{number}", SHORT, made, SHORT.readings)
        own = Bench(sides, bench.folder / f"short-{number}", bench.sizes, bench.seed, bench.note, bench.records)
        taken: dict[str, list[float]] = {name: [] for name in sides}
        for name, checkout in sides.items():
            filled(checkout, touches, own.folder / name, number)
            for _ in range(bench.sizes.starts):
                with Worker(checkout, touches) as worker:
                    taken[name].append(worker.wall("open", path=str(own.folder / name)))
            with Worker(checkout, touches) as worker:
                worker.call("open", path=str(own.folder / name))
                for i in range(REPLAYED):
                    worker.call("observe", touch=number + i)
        own.seconds(memory, "open after a close", taken, "≤ 1000")
        _open_killed(own, memory, touches, number, REPLAYED)


def speed(
    context: typer.Context,
    data: Annotated[
        Path | None, typer.Option(help="Folder of biotac_slide_20_50, or the one it lies in; else simulated touches.")
    ] = None,
    before: Annotated[
        Path | None, typer.Option(help="An older checkout of the project: the same calls, in turns, and their ratios.")
    ] = None,
    touches: Annotated[int, typer.Option(min=40, help="Of the everyday memory.")] = Sizes.touches,
    pairs: Annotated[int, typer.Option(min=2, help="Of an observation and a prediction.")] = Sizes.pairs,
    materials: Annotated[int, typer.Option(min=20, help="Of the large memory.")] = Sizes.materials,
    opening: Annotated[
        int, typer.Option(min=100, help="Touches of the largest memory opened: 1000000 take an hour.")
    ] = 100_000,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Time a user's calls and measure what a memory takes, by the public interface alone.

    The whole takes half an hour or so, and with an older checkout more.
    """
    opened = tuple(number for number in (10_000, 100_000) if number < opening)
    sizes = Sizes(touches=touches, pairs=pairs, materials=materials, opening=(*opened, opening))
    sizes = replace(sizes, before_materials=min(sizes.before_materials, materials))
    with progress_bar() as progress:
        result = run_speed(seed=seed, data=data, before=before, sizes=sizes, note=lambda what: progress(what, 0, 1))
    columns = {name: f"{{./{name}}}" for name in ("memory", "case", "unit")}
    columns |= {"now": "{./median|.4g}", "p99": "{?./p99|.4g}", "before": "{?./before_median|.4g}"}
    columns |= {"before, p99": "{?./before_p99|.4g}", "times": "{?./times|.4g}"}
    columns |= {"of a ResNet-18": "{?./of_forward|.4g}", "to reach": "{./to_reach}"}
    show("speed", columns, result["records"])
    write(context, result)
