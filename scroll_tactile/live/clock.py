"""From readings with time stamps to readings at the sensor's rate.

The rule: a reading is the next one as long as its stamp lies within three quarters of a period of where the next is
expected, and so jitter changes no reading. One that lies later follows readings that were lost, whose places are
filled by the line between its neighbours. One that lies earlier is more than the rate has room for, and is left out.
Where the next is expected follows the stamps slowly, so that neither the first one's jitter nor a rate that is off by a
hundredth matters.

A stamp before the last one is late, and its reading is left out. Beyond a gap, of 0.1 s or five periods, whichever is
longer, and after a step back by as much, time begins anew. Where the stamps stand still for as long while readings
come, these are taken as they come.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.live.answers import LiveReport

__all__ = ["Clock", "ClockPart"]

Rows = npt.NDArray[Any]

GAP = 0.1  # seconds
FEWEST_LOST = 5  # periods in a gap, of a slow sensor
WITHIN = 0.75  # periods
FOLLOWED = 0.02  # of how far a stamp lies off, in the next one's place
CLOCK_UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}


class ClockPart(NamedTuple):
    """Rows at the sensor's rate, shape (k, …), and what came before them.

    breaks: "gap" or "time went back", where time began anew before them. time: the stamp of the first row.
    """

    rows: Rows
    breaks: str = ""
    time: float = math.nan


class Clock:
    """Puts readings with times in their places. report: in which it counts what it met."""

    def __init__(self, rate: float, report: LiveReport) -> None:
        self._rate, self._report = rate, report
        self._gap = max(FEWEST_LOST, math.ceil(GAP * rate))  # periods
        self._last = self._expected = math.nan
        self._row: Rows | None = None  # that came last
        self._still = 0  # how many stamps in turn were that of the last
        self._unit = 0.0

    def checked(self, time: Any, count: int) -> list[float]:
        """The stamps of so many readings in seconds, finite.

        Raises InputError for other kinds, for another number of them, and for times in other units than seconds.
        """
        try:
            stamps = np.asarray(time)
            if stamps.dtype.kind not in "fiu":
                raise TypeError
        except (TypeError, ValueError):
            raise InputError(
                f"expected time as numbers, in seconds; came {type(time).__name__} {time!r:.60}. "
                "Of text or dates take the seconds since some moment"
            ) from None
        if stamps.ndim > 1 or stamps.size != count:
            raise InputError(
                f"expected a time for each of {count} readings; came times of shape {stamps.shape}. "
                "A block (k, n) has times (k,)"
            )
        seconds: list[float] = stamps.astype(np.float64).ravel().tolist()
        if not all(map(math.isfinite, seconds)):
            raise InputError(f"expected finite times; came {next(s for s in seconds if not math.isfinite(s))}")
        self._require_seconds(seconds)
        return seconds

    def _require_seconds(self, seconds: list[float]) -> None:
        """Raise InputError where two steps in turn are as long as those of another unit."""
        last, before = self._last, self._unit
        for stamp in seconds:
            step = (stamp - last) * self._rate
            unit = next((unit for unit in CLOCK_UNITS if 0.2 * unit < step < 5 * unit), 0.0)
            if unit and unit == before:
                raise InputError(
                    f"expected times in seconds; those that came differ by {stamp - last:.6g} from reading to reading, "
                    f"and the sensor has {self._rate:g} readings a second. They look like {CLOCK_UNITS[unit]}: "
                    f"divide them by {unit:.0e}"
                )
            last, before = stamp, unit
        self._unit = before

    def places(self, rows: Rows, seconds: list[float]) -> Iterator[ClockPart]:
        """The readings, shape (k, …), in their places."""
        first = 0  # rows[first:i] follow each other and were not yet given
        for i, stamp in enumerate(seconds):
            steps, breaks = self._place(stamp, rows[i])
            if steps != 1 or breaks:
                if i > first:
                    yield ClockPart(rows[first:i], time=seconds[first])
                first = i if steps else i + 1
            if breaks:
                yield ClockPart(rows[i:i], breaks, stamp)
            elif steps > 1 and self._row is not None:
                yield ClockPart(_line(self._row, rows[i], steps), time=stamp - (steps - 1) / self._rate)
            if steps:
                self._row = rows[i]
        if len(rows) > first:
            yield ClockPart(rows[first:], time=seconds[first])
        if self._row is not None:
            self._row = np.array(self._row)  # and not the caller's

    def _place(self, stamp: float, row: Rows) -> tuple[int, str]:
        """How many places after the last reading this one belongs, 0 for nowhere, and whether time begins anew."""
        if stamp == self._last:
            return self._standing(row), ""
        off = (stamp - self._expected) * self._rate
        anew, breaks = math.isnan(off) or self._still > self._gap, ""
        self._still = 0
        if not anew and (self._last - stamp) * self._rate > self._gap:
            self._report.steps_back += 1
            breaks = "time went back"
        elif not anew and off > self._gap:
            self._report.gaps += 1
            breaks = "gap"
        if anew or breaks:
            self._last, self._expected = stamp, stamp + 1 / self._rate
            return 1, breaks
        if stamp < self._last:
            self._report.late += 1
            return 0, ""
        self._last = stamp
        if off < -WITHIN:
            self._report.surplus += 1
            return 0, ""
        lost = round(off) if off > WITHIN else 0
        self._report.lost += lost
        self._expected += (1 + lost + FOLLOWED * (off - lost)) / self._rate
        return 1 + lost, ""

    def _standing(self, row: Rows) -> int:
        """Where a reading belongs that has the stamp of the last."""
        self._still += 1
        if self._still > self._gap:
            self._report.untimed += 1
            return 1
        if self._row is not None and np.array_equal(row, self._row, equal_nan=True):
            self._report.repeated += 1
        else:
            self._report.surplus += 1
        return 0


def _line(before: Rows, after: Rows, steps: int) -> Rows:
    """The rows between two, that lie so many places apart."""
    part = (np.arange(1, steps) / steps).reshape(-1, *[1] * before.ndim)
    return np.asarray(before + (np.asarray(after, dtype=np.float64) - before) * part)
