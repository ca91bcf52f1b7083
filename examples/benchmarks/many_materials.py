"""`python -m examples.benchmarks many`: a memory of many materials, and a scene of three of them.

`speed` measures the same for ten thousand; this command is for more, whose memory takes an hour to learn. The memory
lies in `--folder`, where one is given: a run that was ended goes on from it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from examples.benchmarks.checkouts import Worker, checkouts, disk_bytes, write_touches
from examples.benchmarks.speed_bench import Bench, Sides, Sizes
from examples.benchmarks.speed_touches import SKIN, name_of, skin_touch, skin_touches
from examples.paper.runs.options import Json, Seed
from examples.paper.runs.results import show, write
from scroll_tactile.clients.cli.terminal import progress_bar

__all__ = ["filled", "many", "run_many"]

MEGABYTE = 1e6
TOGETHER = 1000  # touches in a batch
SCENE = 3  # materials
COLUMNS = {name: f"{{./{name}}}" for name in ("memory", "case", "unit")} | {
    "p50": "{./median|.4g}",
    "p99": "{?./p99|.4g}",
    "longest": "{./largest|.4g}",
}


def run_many(bench: Bench, sides: Sides, materials: int) -> None:
    """A memory of many materials, and a scene of three of them beside a memory of these three alone."""
    sizes, memory = bench.sizes, f"{materials} materials × {bench.sizes.each} touches (8 channels, 1 s)"
    total, scene = materials * sizes.each, [name_of(place * materials // SCENE) for place in range(SCENE)]
    asked = min(200, materials)
    bench.note(f"{memory}: making the touches")
    made = skin_touches(bench.seed, materials, sizes.each)
    how = {"seed": bench.seed, "each": sizes.each}
    touches = write_touches(bench.folder / f"skin-{materials}", SKIN, made, SKIN.readings, **how)
    few = write_touches(
        bench.folder / f"few-{materials}",
        SKIN,
        [(name, skin_touch(bench.seed, int(name[1:]), i)) for i in range(sizes.each) for name in scene],
        SKIN.readings,
        **how,
    )
    paths = {name: bench.folder / f"{name}-{materials}" for name in sides}
    alone = {name: bench.folder / f"{name}-alone-{materials}" for name in sides}
    for name, checkout in sides.items():
        filled(checkout, touches, paths[name], total, lambda done: bench.note(f"{memory}: {done} of {total} observed"))
        filled(checkout, few, alone[name], SCENE * sizes.each)
    bars = ("≤ 3000", "≤ 8", "≤ 600") if materials == Sizes.materials else ("", "", "")
    taken = {name: disk_bytes(path) / MEGABYTE for name, path in paths.items()}
    bench.size(memory, "disk after closing", "MB", taken, bars[2])
    bench.note(f"{memory}: predicting")
    cases = ("open and first predict", "predict", "scene of 3", "these 3 alone", "first scene of 3")
    times: dict[str, dict[str, list[float]]] = {case: {name: [] for name in sides} for case in cases}
    held, peak = {}, {}
    for name, checkout in sides.items():
        with Worker(checkout, touches) as first:  # a scene is all that this one is ever asked about
            seconds = first.wall("open", path=str(paths[name]))
            times["first scene of 3"][name].append(seconds + first.wall("predict", touch=0, scene=scene))
        with Worker(checkout, touches) as large, Worker(checkout, touches) as small:
            small.call("open", path=str(alone[name]))
            small.call("predict", touch=0)
            seconds = large.wall("open", path=str(paths[name]))
            times["open and first predict"][name].append(seconds + large.wall("predict", touch=total))
            for i in range(asked):
                times["predict"][name].append(large.wall("predict", touch=total + i))
            for i in range(asked):
                times["scene of 3"][name].append(large.wall("predict", touch=total + i, scene=scene))
                times["these 3 alone"][name].append(small.wall("predict", touch=total + i))
            held[name], peak[name] = large.memory(), large.memory("peak")
    for case, bar in zip(cases[:2], bars, strict=False):
        bench.seconds(memory, case, times[case], bar)
    ratio = np.median(times["scene of 3"]["now"]) / np.median(times["these 3 alone"]["now"])
    bench.seconds(memory, "predict, scene of 3", times["scene of 3"], "≤ 1.5 of the next", of_alone=float(ratio))
    bench.seconds(memory, "… a memory of these 3 alone", times["these 3 alone"])
    bench.seconds(memory, "open and first predict, scene of 3", times["first scene of 3"])
    bench.size(memory, "memory beyond torch", "MB", held, bars[2])
    bench.size(memory, "the most it held", "MB", peak)


def filled(
    checkout: Path, touches: Path, path: Path, total: int, note: Callable[[int], object] = lambda _: None
) -> None:
    """A memory of the first touches, made in batches, fitted and closed; note is called with how many it has."""
    with Worker(checkout, touches) as worker:
        worker.call("open", path=str(path))
        for first in range(int(worker.call("learned")["said"]), total, TOGETHER):
            note(first)
            worker.call("fill", first=first, last=min(first + TOGETHER, total))
        worker.call("settle")  # as `scroll_tactile.learn` does, so that whoever opens the memory reads the fitted model
        worker.call("close")


def many(
    context: typer.Context,
    materials: Annotated[int, typer.Option(min=6, help="Of the memory.")] = 100_000,
    each: Annotated[int, typer.Option(min=1, help="Touches of each material.")] = 3,
    folder: Annotated[
        Path | None, typer.Option(help="Where the memory is made, and found again by a run that goes on.")
    ] = None,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Measure a memory of very many materials: opening, predictions, a scene of three of them, disk and memory.

    100000 materials of three touches are learned in about an hour.
    """
    sizes = Sizes(materials=materials, each=each)
    with progress_bar() as progress, tempfile.TemporaryDirectory() as passing:
        bench = Bench(checkouts(None), folder or Path(passing), sizes, seed, lambda what: progress(what, 0, 1))
        run_many(bench, bench.sides, materials)
    show("many materials", COLUMNS, bench.records)
    write(context, {"bench": "many", "records": bench.records})
