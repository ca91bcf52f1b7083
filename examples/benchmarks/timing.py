"""Timing of calls as a user makes them, on machines that are shared: alternatives take turns in one run.

A figure is the median of many calls with the 99th percentile beside it. Milliseconds do not carry over to another
machine, ratios of one run do.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

__all__ = ["CLOCKS", "Clock", "Timing", "take_turns", "timed"]

Clock = Literal["wall", "processor"]
CLOCKS: dict[Clock, Callable[[], float]] = {"wall": time.perf_counter, "processor": time.process_time}
IN_A_ROW = 5


@dataclass(frozen=True)
class Timing:
    """Milliseconds of calls that were timed one by one.

    median, p99: over the calls; with fewer than a hundred p99 is near the largest. clock: "wall" is what a user waits;
    "processor" leaves out other programs and waiting for a disk, and adds up threads.
    """

    median: float
    p99: float
    mean: float
    calls: int
    clock: Clock

    @classmethod
    def of(cls, seconds: Sequence[float], clock: Clock = "wall", times: int = 1) -> Timing:
        """Of the seconds that each call took; times: how many of what is reported a call does."""
        taken = 1e3 * np.asarray(seconds, dtype=np.float64) / times
        return cls(
            float(np.median(taken)), float(np.percentile(taken, 99)), float(taken.mean()), len(seconds) * times, clock
        )

    def record(self, prefix: str = "") -> dict[str, float]:
        """Median and p99 for a record, their names with a prefix."""
        return {f"{prefix}median_milliseconds": self.median, f"{prefix}p99_milliseconds": self.p99}


def timed(call: Callable[[], object], clock: Clock = "wall") -> float:
    """The seconds of one call."""
    begun = CLOCKS[clock]()
    call()
    return CLOCKS[clock]() - begun


def take_turns(
    calls: Mapping[str, Callable[[], object]], rounds: int, warm_up: int = 3, clock: Clock = "wall"
) -> dict[str, Timing]:
    """Time calls by name; in every round each is called a few times, so that a slow moment of the machine hits all.

    A few, not once: the first call after another's finds its data pushed out of the processor's cache.
    """
    for call in calls.values():
        for _ in range(warm_up):
            call()
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            seconds[name] += [timed(call, clock) for _ in range(IN_A_ROW)]
    return {name: Timing.of(taken, clock) for name, taken in seconds.items()}
