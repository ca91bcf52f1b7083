"""Touches as they would have been felt otherwise: shorter, faster, through noise, broken wires or a drifting sensor.

Each perturbation makes a stream of a stream. What is drawn is drawn from a seed and the stream's content hash, so
that it does not depend on which other streams are tested, or in what order. With no strength a stream is returned as
it is. Test streams only are perturbed: what a system learns from is its own affair.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scroll_tactile.errors import InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.augmentation import Image, changed, resize
from scroll_tactile.signals.copies import hiss, silence, wander
from scroll_tactile.signals.stream import Stream, fewest_readings

__all__ = ["STUDIES", "Study", "dead", "drift", "length", "noise", "speed"]

_KINDS = {"noise": 0, "dead": 1, "drift": 2}


def length(stream: Stream, seconds: float, seed: int = 0) -> Stream:
    """The touch broken off after so many seconds, or whole where it is shorter; nothing is drawn.

    Raises StreamTooShortError for less than 0.1 s.
    """
    return stream.first(seconds)


def speed(stream: Stream, factor: float, seed: int = 0) -> Stream:
    """The finger moved `factor` times as fast: the readings resampled along time, T / factor of them.

    The sensor's rate stays, so a slow slide is a longer stream. Linear interpolation, without a filter before it: a
    sensor has none either. What a slide's speed changes beside its time scale (force, friction) is not modelled, and
    nothing is drawn. A stream is made no shorter than 0.1 s.
    """
    if not (math.isfinite(factor) and factor > 0):
        raise InputError(f"expected a finite speed above 0; came {factor}")
    if factor == 1:
        return stream
    least = fewest_readings(stream.sensor) / len(stream)
    return changed(stream, lambda image: resize(image, max(1 / factor, min(1.0, least))))


def noise(stream: Stream, amplitude: float, seed: int = 0) -> Stream:
    """A noisy converter or a bad cable: every value has noise of its own added, uniform in ± amplitude · range.

    amplitude: a share of the sensor's range [low, high], so that 0.5 is a standard deviation of 0.29 of the range. What
    leaves the range is clipped to it, as a converter does.
    """
    return _drawn(stream, "noise", amplitude, seed, lambda image, rng: hiss(image, amplitude, rng))


def dead(stream: Stream, share: float, seed: int = 0) -> Stream:
    """Broken wires: a share of the channels, rounded, reads the low end of the sensor's range from beginning to end.

    Which channels is drawn anew for each touch. Raises InputError for a share above 1.
    """
    if share > 1:
        raise InputError(f"expected a share of channels from 0 to 1; came {share}")
    return _drawn(stream, "dead", share, seed, lambda image, rng: silence(image, share, rng))


def drift(stream: Stream, strength: float, seed: int = 0) -> Stream:
    """A sensor that warms up: each channel's zero and gain change along a straight line until the touch ends.

    strength: the zero by at most this share of the range, and the gain by at most this share of itself, at the end;
    drawn evenly between ± these for each channel. Clipped to the range.
    """
    return _drawn(stream, "drift", strength, seed, lambda image, rng: wander(image, strength, strength, rng))


@dataclass(frozen=True)
class Study:
    """A way in which test touches are perturbed, and how strongly.

    perturb: the perturbation. strengths: those of a full study. quick: those of a quick one. unit: what they are.
    """

    name: str
    perturb: Callable[[Stream, float, int], Stream]
    strengths: tuple[float, ...]
    quick: tuple[float, ...]
    unit: str

    def of(self, sensor: Sensor, *, quick: bool = False) -> tuple[float, ...]:
        """The strengths for a sensor: of lengths those below the usual one, and then it."""
        chosen = self.quick if quick else self.strengths
        if self.name != "length":
            return chosen
        return (*(one for one in chosen if one < sensor.duration), sensor.duration)


STUDIES = {
    study.name: study
    for study in (
        Study("length", length, (0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 2.0), (0.3,), "seconds"),
        Study("speed", speed, (0.25, 0.5, 0.71, 1.0, 1.41, 2.0, 4.0), (0.5, 1.0, 2.0), "× the usual speed"),
        Study("noise", noise, (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0), (0.0, 0.5), "share of the range"),
        Study("dead", dead, (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5), (0.0, 0.2), "share of the channels"),
        Study("drift", drift, (0.0, 0.01, 0.02, 0.05, 0.1, 0.2), (0.0, 0.05), "share of the range, and of the gain"),
    )
}
"""The studies on folds as published; `robustness` adds "session", which perturbs nothing."""


def _drawn(
    stream: Stream, kind: str, strength: float, seed: int, change: Callable[[Image, np.random.Generator], Image]
) -> Stream:
    if not (math.isfinite(strength) and strength >= 0):
        raise InputError(f"expected a finite strength of {kind}, 0 or more; came {strength}")
    if seed < 0:
        raise InputError(f"expected a seed of 0 or more; came {seed}")
    if strength == 0:
        return stream
    # With 2 in front, where copies that are learned from have 1: never the same draw.
    rng = np.random.default_rng([2, seed, _KINDS[kind], int.from_bytes(stream.key, "little")])
    return changed(stream, lambda image: change(image, rng))
