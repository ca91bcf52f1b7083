"""The clocks and counters of messages: the device's, a header's, when a message was sent, when it was logged."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FieldError
from scroll_tactile.recordings.paths import FieldPath, fields_of
from scroll_tactile.recordings.ros.bagfiles import Message

__all__ = ["CLOCKS", "Stamps"]

CLOCKS = ("device", "header", "publish", "log")
"""The clocks of a message, the one to prefer first."""

_Times = npt.NDArray[np.float64]

# What drivers call their device's own clock and count, beside the numbers or at the top of the message.
_DEVICE = ("tus", "time_us", "timestamp_us", "device_time", "device_timestamp", "hw_timestamp", "timestamp", "time")
_COUNTER = ("message", "seq", "sequence", "counter", "frame_index", "packet_id")
_UNITS = {"us": 1e-6, "ns": 1e-9, "ms": 1e-3}


class Stamps:
    """Collects the clocks and counters of messages, for one block after the other."""

    def __init__(self, clock: str | None, field: str) -> None:
        self.clock = clock
        self.field = field
        self.device: tuple[str, FieldPath] | None = None
        self.counter: FieldPath | None = None
        self.header = False
        self.unit: float | None = None
        self.begun = False
        self._empty()

    def _empty(self) -> None:
        self.times: dict[str, list[int]] = {name: [] for name in ("header", "publish", "log")}
        self.values: list[Any] = []
        self.counts: dict[str, list[int]] = {"message": [], "sequence": [], "all": []}

    def add(self, message: Message, decoded: Any) -> None:
        """Take the stamps of one message."""
        if not self.begun:
            self._begin(decoded)
        self.times["log"].append(message.log)
        if message.publish is not None:
            self.times["publish"].append(message.publish)
        if self.header:
            self.times["header"].append(_nanoseconds(decoded.header.stamp))
        if self.device is not None:
            self.values.append(_stamp(self.device[1], decoded))
        if self.counter is not None:
            self.counts["message"].append(int(self.counter.values(decoded)[0]))
        if message.sequence is not None:  # of the topic, or of all of them: then less the others it goes on by one
            self.counts["sequence"].append(message.sequence)
            self.counts["all"].append(message.sequence - message.others)

    def take(self) -> tuple[dict[str, _Times], dict[str, npt.NDArray[np.int64]]]:
        """The clocks in seconds and the counters since the last time, in the order of preference."""
        clocks = {}
        log = _seconds(self.times["log"])
        if self.device is not None:
            name = "device" if self.clock is None or self.clock in CLOCKS else self.clock
            values = np.array(self.values, np.float64)
            if self.unit is None:
                self.unit = _unit(self.device[0], self.values, values, log)
            clocks[name] = values * self.unit if self.unit >= 1 else values / round(1 / self.unit)
        for name, stamps in self.times.items():
            if stamps:
                clocks[name] = _seconds(stamps)
        counts = {name: np.array(values, np.int64) for name, values in self.counts.items() if values}
        self._empty()
        return clocks, counts

    def _begin(self, decoded: Any) -> None:
        self.begun = True
        stamp = getattr(getattr(decoded, "header", None), "stamp", None)
        self.header = hasattr(stamp, "sec") and hasattr(stamp, "nanosec")
        root = re.match(r"\s*\w+\[-?\d+\]\.", self.field)
        before = ["", *([root.group().strip()] if root else [])]
        if self.clock is not None and self.clock not in CLOCKS:
            path = FieldPath(self.clock)
            _stamp(path, decoded)
            self.device = (self.clock, path)
        else:
            self.device = _first(decoded, [f"{b}{name}" for b in before for name in _DEVICE])
        counter = _first(decoded, ["header.seq", *(f"{b}{name}" for b in before for name in _COUNTER)], counts=True)
        self.counter = None if counter is None else counter[1]


def _first(decoded: Any, texts: list[str], counts: bool = False) -> tuple[str, FieldPath] | None:
    """The first of some paths that leads to a stamp, or to a whole number where it `counts`."""
    names: dict[str, set[str]] = {}  # of what stands before the last dot; an error with the nearest takes long
    for text in texts:
        before, _, name = text.rpartition(".")
        if before not in names:
            names[before] = _names(decoded, before)
        if name.lower() not in names[before]:
            continue
        path = FieldPath(text)
        try:
            value = _stamp(path, decoded)
        except FieldError:
            continue
        if not counts or isinstance(value, int):
            return text, path
    return None


def _names(decoded: Any, text: str) -> set[str]:
    """The fields, in lower case, of the message that a path leads to; none where it leads to none."""
    try:
        found = FieldPath(text).values(decoded) if text else [decoded]
    except FieldError:
        return set()
    return {name.lower() for name in fields_of(found[0])} if len(found) == 1 else set()


def _stamp(path: FieldPath, decoded: Any) -> float:
    found = path.values(decoded)
    value = found[0] if len(found) == 1 else None
    if hasattr(value, "sec") and hasattr(value, "nanosec"):
        return _nanoseconds(value) / 1e9
    if isinstance(value, np.integer | np.floating):
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FieldError(f"clock {path.text!r} leads to {type(value).__name__}; expected a time, or a number of one")
    return value


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _seconds(stamps: list[int]) -> _Times:
    # Whole seconds and their rest each round once; the quotient of nanoseconds as a double would round twice.
    whole = np.array([stamp // 10**9 for stamp in stamps], np.float64)
    return whole + np.array([stamp % 10**9 for stamp in stamps], np.float64) / 1e9


def _unit(text: str, values: list[Any], times: _Times, log: _Times) -> float:
    """Seconds in one step of a device's clock: from its name, or the power of 1000 that fits the time it was logged."""
    name = re.split(r"[.\]]", text)[-1]
    if name[-2:] in _UNITS:
        return _UNITS[name[-2:]]
    if any(isinstance(value, float) for value in values):
        return 1.0
    span, logged = float(np.ptp(times)), float(np.ptp(log))
    if span <= 0 or logged <= 0:
        return 1.0
    return float(10.0 ** (-3 * np.clip(np.round(np.log10(span / logged) / 3), 0, 3)))
