"""Contacts in readings that are all there, such as a recording's, as a live session would find them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.live.detector import ContactDetector
from scroll_tactile.live.pressing import REST_FOLLOWED, PressDetector
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.contact import Rest
from scroll_tactile.signals.stream import fewest_readings

__all__ = ["contact_spans"]

FALSE_CONTACTS = 1.0  # an hour


def contact_spans(
    sensor: Sensor, rest: Rest, readings: npt.NDArray[Any], gaps: Sequence[int] = ()
) -> list[tuple[int, int]]:
    """Begin and end of each contact that is long enough for a touch; none where nothing was at rest for two seconds.

    rest: a camera's resting image, as of `PressDetector`. readings: (T, n), or a camera's frames, at the sensor's rate.
    gaps: the readings before which time was lost, which ends a contact. A camera's begin in the second before, with the
    gel at rest: frames that are not in contact are no part of a touch.
    """
    rows = readings.reshape(len(readings), *sensor.shape).astype(
        np.float32 if sensor.camera else np.float64, copy=False
    )
    detector = PressDetector(sensor, rest) if sensor.camera else ContactDetector(sensor, FALSE_CONTACTS)
    before = round(REST_FOLLOWED * sensor.rate) if isinstance(rest, str) else 0
    spans: list[tuple[int, int]] = []
    for first, last in pairwise([0, *gaps, len(rows)]):
        detector.interrupt()
        for begin, end in _contacts(detector, rows[first:last]):
            if end - begin >= fewest_readings(sensor):
                free = max(first, spans[-1][1] if spans else 0)
                spans.append((max(first + begin - before, free), first + end))
    return spans


def _contacts(detector: ContactDetector | PressDetector, rows: npt.NDArray[Any]) -> Iterator[tuple[int, int]]:
    """Begin and end of each contact in readings that follow each other."""
    taken, began = 0, None
    while taken < len(rows):
        used, event = detector.feed(rows[taken:])
        taken += used
        if event is not None and event.kind == "began":
            began = taken - event.readings
        elif event is not None:
            if began is not None and event.kind != "relearned":
                yield began, taken - event.readings
            began = None
    if began is not None:
        yield began, len(rows)
