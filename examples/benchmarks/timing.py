"""Timing of calls as a user makes them, by the clock on the wall.

A figure is the median of many calls with the 99th percentile beside it. Milliseconds do not carry over to another
machine, ratios of one run do.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["Timing", "timed"]


@dataclass(frozen=True)
class Timing:
    """Milliseconds of calls that were timed one by one.

    median, p99: over the calls; with fewer than a hundred p99 is near the largest.
    """

    median: float
    p99: float
    mean: float
    calls: int

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Timing:
        """Of the seconds that each call took."""
        taken = 1e3 * np.asarray(seconds, dtype=np.float64)
        return cls(float(np.median(taken)), float(np.percentile(taken, 99)), float(taken.mean()), len(seconds))

    def record(self, prefix: str = "") -> dict[str, float]:
        """Median and p99 for a record, their names with a prefix."""
        return {f"{prefix}median_milliseconds": self.median, f"{prefix}p99_milliseconds": self.p99}


def timed(call: Callable[[], object]) -> float:
    """The seconds of one call."""
    begun = time.perf_counter()
    call()
    return time.perf_counter() - begun
