"""Where contact begins and ends, learned from the sensor's own noise at rest; see `rest` for its distance d².

At rest, a contact begins where S, the sum of d² − κ that never falls below 0, passes the alarm. No reading adds more
than a third of the alarm, so that a glitch of one or two is none. The contact began with the first reading since S was
last 0.

In contact, it ended where the last 0.2 s lie about their own mean as the sensor does at rest, and that mean lies where
the rest is, or so near it that 7 % of the contact's amplitude is more: a sensor does not come back to the unit. There
the level of rest goes on.

Two things end what is no contact: a level that moved, where for a second nothing but noise was seen in a contact longer
than any touch (reported as "still"); and a rest that was none. Where the sensor turns out eight times as quiet as it,
something touched it from the first reading on; where a contact outlasts any touch before ten seconds of rest were seen,
its noise was not yet known. Then rest is learned anew.

What comes first is learned as rest only if it is one: not where something begins or ends in it (`Rest.unrest`), nor
where the memory knows it as a touch. Until then the latest stretch counts, and after as long as a level may take to
move the quietest: a sensor that is never at rest is one all the same.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.live.rest import Rest
from scroll_tactile.sensors import Sensor

__all__ = ["ContactDetector", "Event"]

DEBOUNCE = 3  # readings
QUIET = 0.2  # seconds
FEWEST_QUIET = 4  # readings
RESIDUAL = 0.005  # of the contact's mean d²: seven hundredths of its amplitude
STILL = 4  # blocks of noise alone, a second
LONG = 10.0  # seconds, or four usual touches: then a level may have moved
QUIETER = 8.0
YOUNG = 40  # blocks of rest, ten seconds: its noise may not be known yet


@dataclass(frozen=True)
class Event:
    """What happened at a reading.

    kind: contact "began" with the last `readings`, this one included; it "ended", or was "still", before the last
    `readings`; or rest was "relearned", and there was no contact.
    """

    kind: Literal["began", "released", "still", "relearned"]
    readings: int = 0


class ContactDetector:
    """Finds contacts in readings at the sensor's rate.

    false_contacts: an hour that may be at rest. touched: whether readings (k, n) are known as a touch; without it none
    are. restless: whether what came so far was no rest.
    """

    prefix: npt.NDArray[np.float64] | None = None  # what stands before a touch's readings

    def __init__(
        self,
        sensor: Sensor,
        false_contacts: float,
        touched: Callable[[npt.NDArray[np.float64]], bool] = lambda rows: False,
    ) -> None:
        self._touched = touched
        self._rest = Rest(sensor, false_contacts)
        self._long = round(max(LONG, 4 * sensor.duration) * sensor.rate)
        self._block = np.empty((self._rest.block, sensor.channels))
        self._aways = np.empty_like(self._block)
        quiet = max(FEWEST_QUIET, round(QUIET * sensor.rate))
        self._last = np.empty((quiet, sensor.channels))  # readings of a contact, in a ring
        self._last_aways, self._last_distances = np.empty_like(self._last), [0.0] * quiet
        self._learned: deque[npt.NDArray[np.float64]] = deque(maxlen=self._rest.needed // self._rest.block)
        self._filled = self._waited = 0  # readings of the block that is being learned; that came before it was
        self._quietest: tuple[float, npt.NDArray[np.float64]] | None = None
        self.learning, self.restless, self.contact = True, False, False
        self._anew()

    def _anew(self) -> None:
        """Readings that come do not follow those that came."""
        self._sum, self._run = 0.0, 0  # S, and the readings since it was 0
        self._distances: list[float] = []  # of the block that is being filled
        self._pending: tuple[npt.NDArray[np.float64], list[float]] | None = None  # taken as rest if the next one is
        self._recent: deque[npt.NDArray[np.float64]] = deque(maxlen=self._rest.needed // self._rest.block)
        self._still = self._quieter = self._length = 0
        self._energy = 0.0

    def interrupt(self) -> None:
        """Time begins anew: a contact is over, rest stays as it was learned."""
        self.contact = False
        self._filled = 0  # a block that is being learned is of readings that follow each other
        self._anew()

    def feed(self, rows: npt.NDArray[np.float64]) -> tuple[int, Event | None]:
        """Take readings (k, n) up to the first at which something happens; how many, and what."""
        numbers = self._rest.whole(rows)
        if self.learning:
            return self._learn(numbers), None
        taken = 0
        while taken < len(numbers):
            part = numbers[taken : taken + self._rest.block - len(self._distances)]
            aways, distances = self._rest.distances(part)
            used, event = self._contact(part, aways, distances) if self.contact else self._quiet(distances)
            first = len(self._distances)
            self._block[first : first + used], self._aways[first : first + used] = part[:used], aways[:used]
            self._distances += distances[:used]
            taken += used
            if event is None and len(self._distances) == self._rest.block:
                event = self._full()
            if event is not None:
                self.contact = event.kind == "began"
                self._anew()
                return taken, event
        return taken, None

    def _learn(self, numbers: npt.NDArray[np.float64]) -> int:
        block = self._rest.block
        used = min(len(numbers), block - self._filled)
        self._block[self._filled : self._filled + used] = numbers[:used]
        self._filled += used
        if self._filled == block:
            self._filled, self._waited = 0, self._waited + block
            self._learned.append(self._block.copy())
            if len(self._learned) == self._learned.maxlen:
                self._judge(np.concatenate(self._learned))
        return used

    def _judge(self, stretch: npt.NDArray[np.float64]) -> None:
        """Learn a stretch as rest if it is one, or the quietest so far where none has come for long."""
        unrest = self._rest.unrest(stretch)
        self.restless = unrest > 1 or self._touched(self._rest.readings(stretch))
        if self.restless:
            if self._quietest is None or unrest < self._quietest[0]:
                self._quietest = unrest, stretch
            if self._waited < self._long:
                return
            stretch = self._quietest[1]
        self._rest.learn(stretch)
        self._learned.clear()
        self._quietest, self.learning, self.restless = None, False, False

    def _quiet(self, distances: list[float]) -> tuple[int, Event | None]:
        kappa, alarm = self._rest.kappa, self._rest.alarm
        most, total, run = alarm / DEBOUNCE * (1 + 1e-9), self._sum, self._run
        for i, distance in enumerate(distances):
            total += min(distance - kappa, most)
            run += 1
            if total <= 0:
                total, run = 0.0, 0
            elif total > alarm:
                return i + 1, Event("began", run)
        self._sum, self._run = total, run
        return len(distances), None

    def _contact(
        self, numbers: npt.NDArray[np.float64], aways: npt.NDArray[np.float64], distances: list[float]
    ) -> tuple[int, Event | None]:
        ring = len(self._last)
        for i, distance in enumerate(distances):
            place = self._length % ring
            self._last[place], self._last_aways[place], self._last_distances[place] = numbers[i], aways[i], distance
            self._length += 1
            self._energy += distance
            near = max(self._rest.near, RESIDUAL * self._energy / self._length)
            if self._length >= ring and sum(self._last_distances) <= ring * (self._rest.inner + near):
                far, own = self._rest.mean_and_scatter(self._last_aways, self._last_distances)
                if far <= near and own <= self._rest.inner:
                    if far > self._rest.near:
                        self._rest.resume(self._last)
                    return i + 1, Event("released", ring)
        return len(distances), None

    def _full(self) -> Event | None:
        """A block is full: of rest, or of contact."""
        block, distances = self._block.copy(), self._distances
        _, own = self._rest.mean_and_scatter(self._aways, distances)
        self._distances = []
        self._still = self._still + 1 if own <= self._rest.inner else 0
        quieter = 0 < own * QUIETER < self._rest.mean and self._rest.mean > self._rest.channels / 2
        self._quieter = self._quieter + 1 if quieter else 0
        self._recent.append(block)
        young = self.contact and self._length > self._long and self._rest.measured < YOUNG
        if young or self._quieter * self._rest.block >= self._rest.needed:
            self._rest.learn(np.concatenate(self._recent))
            return Event("relearned")
        if self.contact:
            if self._still >= STILL and self._length > self._long:
                self._rest.resume(block)
                return Event("still")
        elif self._sum > 0:
            self._pending = None
        else:
            if self._pending is not None:
                self._rest.follow(*self._pending)
            self._pending = block, distances
        return None
