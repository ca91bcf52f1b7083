"""Timing on machines that are shared and noisy: alternatives take turns, and the least of many rounds counts."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version

import numpy as np

__all__ = ["Timing", "circumstances", "take_turns"]


IN_A_ROW = 5


@dataclass(frozen=True)
class Timing:
    """Seconds a call: the least, and the median, over the rounds."""

    least: float
    median: float


def take_turns(
    calls: Mapping[str, Callable[[], object]],
    rounds: int,
    warm_up: int = 3,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, Timing]:
    """Time calls by name; in every round each is called a few times, so that a slow moment of the machine hits all.

    A few, not once: the first call after another's finds its data pushed out of the processor's cache. clock: seconds;
    `time.process_time` for what runs on one thread, where others are at work on the machine.
    """
    for call in calls.values():
        for _ in range(warm_up):
            call()
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            for _ in range(IN_A_ROW):
                begin = clock()
                call()
                seconds[name].append(clock() - begin)
    return {name: Timing(min(taken), float(np.median(taken))) for name, taken in seconds.items()}


def circumstances(seed: int) -> dict[str, object]:
    """What a result has to be read with: date, seed, versions, machine."""
    names = ("scroll-tactile", "torch", "numpy", "scipy", "zarr")
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "seed": seed,
        "python": platform.python_version(),
        "machine": f"{platform.machine()}, {platform.processor() or platform.system()}",
        "versions": {name: version(name) for name in names},
    }
