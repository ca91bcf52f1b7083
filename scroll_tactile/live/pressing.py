"""Where contact begins and ends in a camera's frames: where they differ from the gel at rest, see `signals.contact`."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.live.detector import Event
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.contact import Rest, in_contact
from scroll_tactile.signals.stream import Stream

__all__ = ["PressDetector"]

TURNS = 2  # frames in turn that differ from those before
REST_FOLLOWED = 1.0  # seconds: the resting image is a frame of the last


class PressDetector:
    """Finds contacts in frames. rest: the embedding's resting image; "first" stands for the first frame that comes.

    prefix: the resting frame, (1, height, width, 3), where a touch begins with it; None otherwise.

    Raises InputError where there is no resting image, so that every frame counts.
    """

    learning = restless = False

    def __init__(self, sensor: Sensor, rest: Rest) -> None:
        if rest is None:
            raise InputError(
                f"expected an embedding with a resting image of sensor {sensor.name!r}; it has none, so that every "
                'frame counts. Take contact="manual" with begin() and end(), or Frames(rest="first")'
            )
        self._sensor = sensor
        self._still: npt.NDArray[np.float32] | None = None if isinstance(rest, str) else rest
        self._follows = isinstance(rest, str)
        self._every = max(1, round(REST_FOLLOWED * sensor.rate))
        self.contact = False
        self._turned = self._quiet = 0

    @property
    def prefix(self) -> npt.NDArray[Any] | None:
        """What stands before a touch's frames."""
        return self._still[None] if self._follows and self._still is not None else None

    def interrupt(self) -> None:
        """Time begins anew: a contact is over."""
        self.contact, self._turned = False, 0

    def feed(self, rows: npt.NDArray[Any]) -> tuple[int, Event | None]:
        """Take frames up to the first at which something happens; how many, and what."""
        for i, frame in enumerate(rows):
            picture = np.nan_to_num(np.asarray(frame, dtype=np.float32), nan=float(self._sensor.limits[0]))
            if self._still is None:
                self._still = picture
                continue
            pressed = bool(in_contact(Stream(self._sensor, picture[None]), self._still)[0])
            self._turned = self._turned + 1 if pressed != self.contact else 0
            if self._turned == TURNS:
                self.contact, self._turned, self._quiet = pressed, 0, 0
                return i + 1, Event("began" if pressed else "released", TURNS)
            self._quiet = 0 if pressed or self.contact else self._quiet + 1
            if self._follows and self._quiet == self._every:
                self._still, self._quiet = picture, 0
        return len(rows), None
