"""Where contact begins and ends, learned from the sensor's own noise at rest.

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

Of a sensor at rest readings are whole numbers of 2⁻¹⁶ of each channel's range; level and scatter are exact sums of
them, block by block, so that nothing depends on how the readings were dealt out to calls. A reading x lies

    d² = |(x − m) V|²,    V Vᵀ = Σ⁻¹,

from the level m, Σ the mean scatter within blocks of a quarter of a second, pulled to that of a usual channel as far as
there are channels for its readings, and beside it what a usual channel changes by from one reading to the next. V is
rounded, so that d² is an exact sum, too.

Noise is not normal, nor are readings independent: d² is taken to be c χ²_ν, with its mean as it was measured at rest,
and the larger of its variance and that of its sums over blocks. A sum of d² − κ that never falls below 0 passes h at a
rate of exp(−θ h) a reading, where E exp(θ (d² − κ)) = 1 (Page's CUSUM; Lorden 1971), so that h follows from how many
false contacts an hour may have.

A value that is missing lies where the level is. While rest is learned there is no level yet: the value then lies on the
line between its neighbours, and a reading without any value is left out. A channel that said nothing meanwhile has no
say until it is read in a block of rest, which gives it its level.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals import contact
from scroll_tactile.signals.stream import Stream, fewest_readings

__all__ = ["ContactDetector", "Event", "PressDetector", "Rest", "contact_spans"]

Whole = npt.NDArray[np.float64]  # whole numbers, exact

LEVELS = 2.0**16  # of a channel's range
UNITS = 2.0**6  # of a standard deviation
FINE = 2.0**20  # of an entry of V
FARTHEST = 2.0**22  # units of one channel: 60 squares of it are exact
BLOCK = 0.25  # seconds
FEWEST = 8  # readings in a block
LEARNED = 2.0  # seconds, and no fewer readings than twice the channels
FOLLOWED = 8  # blocks whose mean is the level
UNMEASURED = 8  # blocks that the noise as it should be counts for, beside what is measured
MOST_BLOCKS = 2**11  # then all sums are halved: noise changes in days
WIDER = 4.0  # times the variance of normal noise's d², that is assumed of it
MOST = 2.0  # times the mean d², that a block counts for
APART = 3.0  # standard deviations of d² that κ lies beyond its mean
LOUDER = 8.0  # times the median block's scatter, that no block of a rest has
JUMP = 64.0  # times what white noise would make of them, that blocks' means may scatter by: noise hums and drifts

DEBOUNCE = 3  # readings
QUIET = 0.2  # seconds
FEWEST_QUIET = 4  # readings
RESIDUAL = 0.005  # of the contact's mean d²: seven hundredths of its amplitude
STILL = 4  # blocks of noise alone, a second
LONG = 10.0  # seconds, or four usual touches: then a level may have moved
QUIETER = 8.0
YOUNG = 40  # blocks of rest, ten seconds: its noise may not be known yet

TURNS = 2  # frames in turn that differ from those before
REST_FOLLOWED = 1.0  # seconds: the resting image is a frame of the last
FALSE_CONTACTS = 1.0  # an hour


class Rest:
    """What was learned of a sensor at rest. sensor: with channels. false_contacts: an hour that may be."""

    def __init__(self, sensor: Sensor, false_contacts: float) -> None:
        low, high = (np.broadcast_to(limit, sensor.shape).astype(np.float64) for limit in sensor.limits)
        self._low, self._scale = low, LEVELS / (high - low)
        self._log_run = math.log(max(2.0, sensor.rate * 3600 / false_contacts))
        self.channels = sensor.channels
        self.block = max(FEWEST, round(BLOCK * sensor.rate))
        least = max(round(LEARNED * sensor.rate), 2 * sensor.channels, 2 * self.block)  # one block has no scatter
        self.needed = -(-least // self.block) * self.block
        self.level: Whole = np.zeros(sensor.channels)

    def whole(self, rows: npt.NDArray[np.float64]) -> Whole:
        """Readings (k, n) as whole numbers within the range; NaN where a value is missing."""
        numbers = rows - self._low
        numbers *= self._scale
        np.rint(numbers, out=numbers)
        if not math.isfinite(numbers.sum()):
            numbers[~np.isfinite(numbers)] = np.nan
        return np.clip(numbers, 0.0, LEVELS, out=numbers)

    def filled(self, numbers: Whole) -> Whole:
        """Whole numbers (k, n) with the level in place of missing values, and of channels that have no say yet."""
        if self._unread or math.isnan(numbers.sum()):
            numbers = np.where(np.isnan(numbers), self.level, numbers)
            numbers[:, self._unread] = self.level[self._unread]
        return numbers

    def distances(self, numbers: Whole) -> tuple[Whole, list[float]]:
        """How far readings (k, n) lie from the level: in whitened channels, (k, n) in `UNITS`, and d² of each."""
        away = (numbers - self.level) @ self._whiten
        away *= UNITS / FINE
        np.rint(away, out=away)
        np.clip(away, -FARTHEST, FARTHEST, out=away)
        return away, (np.einsum("ij,ij->i", away, away) / UNITS**2).tolist()

    def mean_and_scatter(self, away: Whole, distances: list[float]) -> tuple[float, float]:
        """Of some readings, in whitened channels: d² of their mean, and their own mean d² about it."""
        total, count = away.sum(axis=0), len(away)
        far = float(total @ total) / (count * UNITS) ** 2
        return far, (math.fsum(distances) / count - far) * count / (count - 1)

    def readings(self, numbers: Whole) -> npt.NDArray[np.float64]:
        """Whole numbers (k, n) as the readings that they stand for."""
        return self._low + numbers / self._scale

    def unrest(self, numbers: Whole) -> float:
        """How far from a rest readings are, a whole number of blocks of them; above 1 they are none.

        In a rest no block scatters many times as the median one does, and blocks' means lie where noise brings them;
        both fail where a touch begins or ends, not within one at a steady speed.
        """
        numbers = _interpolated(numbers)
        blocks = numbers.reshape(-1, self.block, self.channels)
        own = blocks.var(axis=1, ddof=1) + _floor(numbers)
        usual = np.median(own, axis=0)
        louder = float((own / usual).mean(axis=1).max())
        jump = float((self.block * blocks.mean(axis=1).var(axis=0, ddof=1) / usual).mean())
        return max(louder / LOUDER, jump / JUMP)

    def learn(self, numbers: Whole) -> None:
        """Begin with readings at rest, a whole number of blocks of them: what was learned before is gone."""
        self._unread: list[int] = np.flatnonzero(np.isnan(numbers).all(axis=0)).tolist()  # channels without a say yet
        numbers = _interpolated(numbers)
        self._floor = _floor(numbers)
        self._scatter: npt.NDArray[np.int64] = np.zeros((self.channels, self.channels), np.int64)
        self._levels: deque[tuple[Whole, int]] = deque(maxlen=FOLLOWED)
        self._blocks = self.measured = 0
        self._sum = self._squares = self._fourths = 0.0  # of d² over blocks, of its square over them and one by one
        blocks = [numbers[first : first + self.block] for first in range(0, len(numbers), self.block)]
        half = -(-len(blocks) // 2)
        for block in blocks[:half]:
            self._take(block)
        self._solve()
        for block in blocks[half:]:  # by what the others say of it, and so as it will be measured
            self._measure(self.distances(block)[1])
            self._take(block)
        self._solve()
        self._due = 2 * self._blocks

    def follow(self, numbers: Whole, distances: list[float]) -> None:
        """Take in one more block of readings at rest, with their d²."""
        if self._unread:
            self._begin_channels(numbers)
        self._take(self.filled(numbers))
        self._measure(distances)
        if self._blocks >= self._due:
            self._solve()
            if self._blocks >= MOST_BLOCKS:
                self._scatter //= 2
                self._blocks, self.measured = self._blocks // 2, self.measured // 2
                self._sum, self._squares, self._fourths = self._sum / 2, self._squares / 2, self._fourths / 2
            self._due = max(self._blocks + 4, self._blocks * 5 // 4)

    def _begin_channels(self, numbers: Whole) -> None:
        """Give the channels that are read at last the level that they have in this block."""
        for channel in list(self._unread):
            read = numbers[:, channel][~np.isnan(numbers[:, channel])]
            if len(read):
                self._unread.remove(channel)
                self.level[channel] = np.floor(np.median(read) + 0.5)
                for total, count in self._levels:
                    total[channel] = self.level[channel] * count

    def resume(self, numbers: Whole) -> None:
        """Follow the level from readings after a contact: it may have moved. The noise stays as it was learned."""
        self._levels.clear()
        self._relevel(numbers)

    def _take(self, numbers: Whole) -> None:
        away = numbers - self.level
        total = away.sum(axis=0)
        # Whole numbers below 2⁵³ times 2: exact in whatever order.
        self._scatter += (len(numbers) * (away.T @ away) - np.outer(total, total)).astype(np.int64)
        self._relevel(numbers)
        self._blocks += 1

    def _measure(self, distances: list[float]) -> None:
        """Note the d² of a block. A touch too light to be noticed must not make the next one harder to notice."""
        total = min(math.fsum(distances), MOST * self.mean * self.block)
        self.measured += 1
        self._sum, self._squares = self._sum + total, self._squares + total**2
        self._fourths += math.fsum(min(distance, self.alarm) ** 2 for distance in distances)

    def _relevel(self, numbers: Whole) -> None:
        self._levels.append((numbers.sum(axis=0), len(numbers)))
        count = sum(count for _, count in self._levels)
        self.level = np.floor(sum(total for total, _ in self._levels) / count + 0.5)

    def _solve(self) -> None:
        """Whiten by the scatter as it is now, and set the thresholds by the d² that were measured."""
        block, channels = self.block, self.channels
        free = self._blocks * (block - 1)
        covariance = self._scatter / (free * block)
        own = np.diagonal(covariance)
        part = channels / (free + channels)
        pulled = covariance * (1 - part)
        pulled[np.diag_indices(channels)] = own * (1 - part) + own.mean() * part + self._floor
        factor = np.linalg.cholesky(pulled)
        self._whiten: Whole = np.rint(np.linalg.inv(factor).T * FINE)
        mean, spread = float(channels), 2.0 * channels  # of d², where noise is normal
        if self.measured:
            count = self.measured + UNMEASURED
            of_block = self._sum / self.measured
            among = (self._squares / self.measured - of_block**2) / block
            alone = self._fourths / (self.measured * block) - (of_block / block) ** 2
            mean = (self._sum / block + UNMEASURED * mean) / count
            spread = (self.measured * max(among, alone) + UNMEASURED * WIDER * spread) / count
        spread = max(spread, 1e-3 * mean**2)
        self.mean, self.kappa = mean, mean + APART * math.sqrt(spread)
        self.alarm = self._log_run / _rate(mean, spread, self.kappa)
        self.inner, self.near = mean + 3 * math.sqrt(spread / block), mean / 2


def _interpolated(numbers: Whole) -> Whole:
    """Whole numbers (k, n) with missing ones on the line between their neighbours; 0 in a channel without any."""
    missing = np.isnan(numbers)
    if not missing.any():
        return numbers
    found = np.where(missing, 0.0, numbers)
    for channel in np.flatnonzero(missing.any(axis=0) & ~missing.all(axis=0)):
        read = np.flatnonzero(~missing[:, channel])
        found[:, channel] = np.rint(np.interp(np.arange(len(found)), read, numbers[read, channel]))
    return found


def _floor(numbers: Whole) -> float:
    """The square of what a usual channel changes by from one reading to the next, where it changes."""
    steps = np.abs(np.diff(numbers, axis=0))
    moving = [float(np.median(column[column > 0])) for column in steps.T if column.any()]
    # Of the channels, not of each: one that hardly ever moves at rest is not known for it.
    return max(float(np.median(moving)) if moving else LEVELS / 1024, 1.0) ** 2


def _rate(mean: float, variance: float, kappa: float) -> float:
    """θ > 0 with E exp(θ (d² − κ)) = 1, d² = c χ²_ν of this mean and variance: by halving, to 2⁻⁴⁰."""
    scale, freedom = variance / (2 * mean), 2 * mean**2 / variance
    low, high = 0.0, 1 / (2 * scale)
    for _ in range(40):
        middle = (low + high) / 2
        if -freedom / 2 * math.log1p(-2 * scale * middle) < middle * kappa:
            low = middle
        else:
            high = middle
    return low


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
            read = self._rest.filled(part)
            aways, distances = self._rest.distances(read)
            used, event = self._contact(read, aways, distances) if self.contact else self._quiet(distances)
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
        read = numbers[:used][~np.isnan(numbers[:used]).all(axis=1)]
        self._block[self._filled : self._filled + len(read)] = read
        self._filled += len(read)
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
                self._rest.resume(self._rest.filled(block))
                return Event("still")
        elif self._sum > 0:
            self._pending = None
        else:
            if self._pending is not None:
                self._rest.follow(*self._pending)
            self._pending = block, distances
        return None


class PressDetector:
    """Finds contacts in frames. rest: the embedding's resting image; "first" stands for the first frame that comes.

    prefix: the resting frame, (1, height, width, 3), where a touch begins with it; None otherwise.

    Raises InputError where there is no resting image, so that every frame counts.
    """

    learning = restless = False

    def __init__(self, sensor: Sensor, rest: contact.Rest) -> None:
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
            pressed = bool(contact.in_contact(Stream(self._sensor, picture[None]), self._still)[0])
            self._turned = self._turned + 1 if pressed != self.contact else 0
            if self._turned == TURNS:
                self.contact, self._turned, self._quiet = pressed, 0, 0
                return i + 1, Event("began" if pressed else "released", TURNS)
            self._quiet = 0 if pressed or self.contact else self._quiet + 1
            if self._follows and self._quiet == self._every:
                self._still, self._quiet = picture, 0
        return len(rows), None


def contact_spans(
    sensor: Sensor, rest: contact.Rest, readings: npt.NDArray[Any], gaps: Sequence[int] = ()
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
