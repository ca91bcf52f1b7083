"""This checkout beside an older one in one run: the same calls of a learner on disk, in turns, and their ratios.

Milliseconds that were taken on different days, or machines, say nothing of a change; ratios of one run do.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from examples.benchmarks.timing import Timing
from scroll_tactile import sensors
from scroll_tactile.datasets.simulator import Scene
from scroll_tactile.errors import InputError

__all__ = ["run_before"]

Record = dict[str, Any]
HERE = Path(__file__).resolve().parent
AGAIN = 5  # predictions of other touches after the one that follows an observation


def run_before(before: Path, *, seed: int, touches: int, pairs: int) -> list[Record]:
    """Records of observe, predict right after an observe, and predict again: now, before, and the ratio of medians.

    before: a checkout of the project. touches: of each of twenty materials, learned first; pairs: of an observation
    and a prediction, timed then. Raises InputError for a folder that is none.
    """
    if not (before / "scroll_tactile" / "__init__.py").is_file():
        raise InputError(f"expected a checkout of the project in {before}; it has no scroll_tactile/__init__.py")
    taken: dict[str, dict[str, list[tuple[float, float]]]] = {name: {} for name in ("now", "before")}
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        places = _write_touches(Path(folder, "touches.npz"), seed, touches, pairs)
        checkouts = {"now": HERE.parents[1], "before": before.resolve()}
        workers = {
            name: stack.enter_context(_Worker(checkout, Path(folder, "touches.npz"), Path(folder, name)))
            for name, checkout in checkouts.items()
        }
        for i in range(places):
            calls = [("observe", "observe", i)]
            if i >= places - pairs:
                calls.append(("predict right after an observe", "predict", i - pairs))
                calls += [("predict again", "predict", i - pairs - 1 - k) for k in range(AGAIN)]
            # Each goes first in turn: the second finds its data pushed out of the processor's cache.
            for name in sorted(workers, reverse=i % 2 == 0):
                for case, verb, touch in calls:
                    taken[name].setdefault(case, []).append(workers[name].time(verb, touch))
    return [_record(case, taken["now"][case], taken["before"][case]) for case in taken["now"]]


def _record(case: str, now: list[tuple[float, float]], before: list[tuple[float, float]]) -> Record:
    """Wall clock, and the ratio of the processor's time too: on a busy machine that is the steadier one."""
    wall, before_wall = (Timing.of([seconds for seconds, _ in taken]) for taken in (now, before))
    spent, before_spent = (Timing.of([seconds for _, seconds in taken], "processor") for taken in (now, before))
    return {
        "case": case,
        **wall.record(),
        **before_wall.record("before_"),
        "ratio": wall.median / before_wall.median,
        "processor_ratio": spent.median / before_spent.median,
        "calls": wall.calls,
        "clock": wall.clock,
    }


def _write_touches(path: Path, seed: int, touches: int, pairs: int) -> int:
    """Simulated touches of BioTac into a file; their number."""
    scene = Scene(sensor=sensors.BIOTAC, seed=seed)
    total = touches * len(scene.materials) + pairs
    names = [scene.materials[i % len(scene.materials)] for i in range(total)]
    readings = [scene.touch(name, i // len(scene.materials)).readings for i, name in enumerate(names)]
    np.savez(path, readings=np.stack(readings), materials=np.array(names))
    return total


class _Worker:
    """A process of `worker` with a checkout's path, ready for calls."""

    def __init__(self, checkout: Path, touches: Path, folder: Path) -> None:
        # -P: beside the checkout's own path nothing of this folder's is to be imported.
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(HERE / "worker.py"), str(touches), str(folder)],
            env={**os.environ, "PYTHONPATH": str(checkout)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> _Worker:
        self._answer()
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def time(self, verb: str, touch: int) -> tuple[float, float]:
        """The seconds of a call with a touch: by the clock on the wall, and of the processor."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{verb} {touch}\n")
        self._process.stdin.flush()
        wall, processor = map(float, self._answer().split())
        return wall, processor

    def _answer(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise InputError(f"expected an answer of {self._process.args!r}; it ended with {self._process.wait()}")
        return line
