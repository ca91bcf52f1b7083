"""Touches as another session would record them: shorter, faster, noisy, with dead channels or a drifting sensor.

Each perturbation makes a stream of a stream. What is drawn is drawn from a seed and the stream's content hash, so
that it does not depend on which other streams are tested, or in what order. With no strength a stream is returned as
it is. Only test streams are perturbed.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from scroll_tactile.errors import InputError
from scroll_tactile.signals.augmentation import Image, changed, resize
from scroll_tactile.signals.copies import hiss, silence, wander
from scroll_tactile.signals.stream import Stream, fewest_readings

__all__ = ["dead", "drift", "length", "noise", "speed"]

_KINDS = {"noise": 0, "dead": 1, "drift": 2}


def length(stream: Stream, seconds: float, seed: int = 0) -> Stream:
    """The first seconds of the touch, or all of a shorter one; nothing is drawn.

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
    """Dead channels: a share of them, rounded, reads the low end of the sensor's range from beginning to end.

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
