"""A shift of a robot, made up: touches one after another between rests, with drift, gaps in time, and the truth.

The touches are simulated (`simulated_shift`) or anybody's, such as recorded ones (`shift_of`), with a sensor's noise at
rest between them, made up or taken from quiet parts of recordings (`quiet_noise`). Nothing measured on it is a result
about a robot; it says how well touches are found whose beginnings are known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream
from scroll_tactile.simulation.scene import Scene

__all__ = ["Shift", "Truth", "quiet_noise", "resting_level", "shift_of", "simulated_shift"]

Floats = npt.NDArray[np.float64]
Noise = Callable[[np.random.Generator, int], Floats]

SMOOTH = 9  # readings, over which quiet parts are levelled
TOGETHER = 5  # readings of noise that stay as they were
QUIETEST = 0.02  # of all parts of half a second, those that noise is taken from


@dataclass(frozen=True)
class Truth:
    """One touch of a shift: its material, and when it begins and ends, in seconds on the shift's clock."""

    material: str
    begin: float
    end: float


@dataclass(frozen=True, eq=False)
class Shift:
    """A stream of hours. readings: (T, n). times: (T,), in seconds, as a driver stamps them. touches: in order."""

    sensor: Sensor
    readings: Floats
    times: Floats
    touches: list[Truth]


def shift_of(
    touches: Iterable[tuple[str, npt.NDArray[np.floating]]],
    sensor: Sensor,
    level: Floats,
    noise: Noise,
    *,
    seconds: float,
    rests: tuple[float, float] = (3.0, 8.0),
    drift: float = 0.01,
    gaps: int = 5,
    lost: float = 1e-3,
    jitter: float = 0.2,
    step: float | Floats = 0.0,
    seed: int = 0,
) -> Shift:
    """A shift of some touches, readings (T, n), until the time is full or there are no more.

    level: of each channel at rest, (n,). noise: makes so many readings of noise about it, (k, n). seconds: how long.
    rests: between touches, shortest and longest. drift: of each channel in the whole, as a share of the range, there
    and back on a slow wave; touches drift, too. gaps: in time, of 0.2 to 3 s, each at rest. lost: the share of single
    readings that are missing. jitter: of stamps, as a share of the period either way. step: of the converter.

    Raises InputError where no touch fits.
    """
    random = np.random.default_rng([4, seed])
    low, high = (np.broadcast_to(limit, sensor.shape).astype(np.float64) for limit in sensor.limits)
    count = round(seconds * sensor.rate)
    values, places = _laid_out(touches, rests, sensor.rate, lambda steps: level + noise(random, steps), count, random)
    if not places:
        raise InputError(f"expected {seconds:g} s to hold a rest and a touch; they hold none")
    turns, phases = random.uniform(0.5, 2.0, len(level)), random.uniform(0, 2 * np.pi, len(level))
    values += drift * (high - low) * np.sin(2 * np.pi * turns * np.arange(count)[:, None] / count + phases)
    if np.any(step):
        values = low + np.rint((values - low) / step) * step
    values = np.clip(values, low, high)
    times = np.arange(count) / sensor.rate
    chosen = random.choice(len(places), size=min(gaps, len(places)), replace=False)
    for place in sorted(chosen.tolist()):
        times[places[place][1] - round(rests[0] * sensor.rate / 2) :] += random.uniform(0.2, 3.0)
    begins = times[[begin for _, begin, _ in places]]
    ends = times[[end - 1 for *_, end in places]]
    kept = random.random(count) >= lost
    stamped = times + random.uniform(-jitter, jitter, count) / sensor.rate
    truth = [Truth(name, *when) for (name, *_), *when in zip(places, begins.tolist(), ends.tolist(), strict=True)]
    return Shift(sensor, values[kept], stamped[kept], truth)


def _laid_out(
    touches: Iterable[tuple[str, npt.NDArray[np.floating]]],
    rests: tuple[float, float],
    rate: float,
    at_rest: Callable[[int], Floats],
    count: int,
    random: np.random.Generator,
) -> tuple[Floats, list[tuple[str, int, int]]]:
    """`count` readings of touches with rests between them; and of each touch its material, begin and end.

    rests: the shortest and the longest, in seconds. at_rest: makes so many readings.
    """
    parts, places, at = list[Floats](), [], 0
    for material, readings in touches:
        rest = round(random.uniform(*rests) * rate)
        if at + rest + len(readings) > count:
            break
        parts += [at_rest(rest), np.asarray(readings, dtype=np.float64)]
        places.append((material, at + rest, at + rest + len(readings)))
        at += rest + len(readings)
    parts.append(at_rest(count - at))
    return np.concatenate(parts), places


def simulated_shift(scene: Scene, materials: Sequence[str], *, seconds: float, seed: int = 0) -> Shift:
    """A shift of simulated touches of some materials, in random order, with the simulator's noise between them."""
    random = np.random.default_rng([5, seed])
    sensor = scene.sensor
    low, high = (np.broadcast_to(limit, sensor.shape).astype(np.float64) for limit in sensor.limits)

    def touches() -> Iterable[tuple[str, npt.NDArray[np.floating]]]:
        for repetition in range(10**6):
            name = materials[int(random.integers(len(materials)))]
            yield name, scene.touch(name, 10_000 + repetition).readings

    def noise(random: np.random.Generator, count: int) -> Floats:
        return np.asarray(scene.noise(random, count) * (high - low))

    level = low + scene.rest * (high - low)
    return shift_of(touches(), sensor, level, noise, seconds=seconds, step=scene.step, seed=seed)


def resting_level(streams: Sequence[Stream], share: float = 0.02) -> Floats:
    """Of each channel what only this share of recorded readings lie below: where a touch presses least, (n,)."""
    return np.asarray(np.quantile(np.concatenate([stream.readings for stream in streams]), share, axis=0))


def quiet_noise(streams: Sequence[Stream]) -> Noise:
    """Noise of a sensor, from the quietest half-seconds of recorded touches, as it was over channels and time.

    What is left of them beside their mean over 9 readings, five at a time in random order: no half-second's pattern of
    quiet and noisy channels is the sensor's.
    """
    rate = streams[0].sensor.rate
    length = max(SMOOTH + 1, round(0.5 * rate))
    kernel = np.ones(SMOOTH) / SMOOTH
    parts = []
    for stream in streams:
        smooth = np.apply_along_axis(np.convolve, 0, stream.readings.astype(np.float64), kernel, mode="valid")
        rest = stream.readings[SMOOTH // 2 : SMOOTH // 2 + len(smooth)] - smooth
        parts += [rest[first : first + length] for first in range(0, len(rest) - length + 1, length)]
    parts.sort(key=lambda part: float(np.square(part).sum()))
    # A mean over 9 takes a ninth of white noise's variance with it.
    kept = np.stack(parts[: max(10, round(QUIETEST * len(parts)))]) * np.sqrt(SMOOTH / (SMOOTH - 1))
    quiet = kept[:, : length // TOGETHER * TOGETHER].reshape(-1, TOGETHER, kept.shape[2])

    def noise(random: np.random.Generator, count: int) -> Floats:
        chosen = random.integers(len(quiet), size=-(-count // TOGETHER))
        return np.asarray(quiet[chosen].reshape(-1, quiet.shape[2])[:count])

    return noise
