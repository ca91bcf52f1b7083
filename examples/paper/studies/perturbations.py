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
from scroll_tactile.signals.augmentation import Image, resize
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import Stream, fewest_readings, validate

__all__ = ["changed", "dead", "drift", "gaussian", "length", "noise", "speed"]

_KINDS = {"noise": 0, "dead": 1, "drift": 2, "gaussian": 3}


def length(stream: Stream, seconds: float, seed: int = 0) -> Stream:
    """The first seconds of the touch, or all of a shorter one; nothing is drawn.

    Raises StreamTooShortError for less than two readings.
    """
    return stream.first(seconds)


def speed(stream: Stream, factor: float, seed: int = 0) -> Stream:
    """The finger moved `factor` times as fast: the readings resampled along time, T / factor of them.

    The sensor's rate stays, so a slow slide is a longer stream. Linear interpolation, without a filter before it: a
    sensor has none either. What a slide's speed changes beside its time scale (force, friction) is not modelled, and
    nothing is drawn. A stream is made no shorter than two readings.
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
    return _drawn(stream, "noise", amplitude, seed, lambda image, rng: _hiss(image, amplitude, rng))


def gaussian(stream: Stream, amplitude: float, seed: int = 0) -> Stream:
    """Gaussian noise of the energy of `noise`: its standard deviation is amplitude / √3 of the range; clipped to it."""
    return _drawn(stream, "gaussian", amplitude, seed, lambda image, rng: _blur(image, amplitude / math.sqrt(3), rng))


def dead(stream: Stream, share: float, seed: int = 0) -> Stream:
    """Dead channels: a share of them, rounded, reads the low end of the sensor's range from beginning to end.

    Which channels is drawn anew for each touch. Raises InputError for a share above 1.
    """
    if share > 1:
        raise InputError(f"expected a share of channels from 0 to 1; came {share}")
    return _drawn(stream, "dead", share, seed, lambda image, rng: _silence(image, share, rng))


def drift(stream: Stream, strength: float, seed: int = 0) -> Stream:
    """A sensor that warms up: each channel's zero and gain change along a straight line until the touch ends.

    strength: the zero by at most this share of the range, and the gain by at most this share of itself, at the end;
    drawn evenly between ± these for each channel. Clipped to the range.
    """
    return _drawn(stream, "drift", strength, seed, lambda image, rng: _wander(image, strength, strength, rng))


def changed(stream: Stream, change: Callable[[Image], Image]) -> Stream:
    """The stream whose tactile image, float32 (C, T) in [-1, 1], is what `change` makes of this one's.

    `changed(stream, flip)` is the slide the other way. Raises InputError for a camera's stream, and what `validate`
    raises for what came out.
    """
    sensor = stream.sensor
    if sensor.camera:
        raise InputError(f"changes are of channels along time, and camera {sensor.name!r} takes whole frames")
    image = change(tactile_image(stream)).T.astype(np.float64)
    low, high = np.asarray(sensor.low), np.asarray(sensor.high)
    return validate(low + (image + 1) / 2 * (high - low), sensor)


def _drawn(
    stream: Stream, kind: str, strength: float, seed: int, change: Callable[[Image, np.random.Generator], Image]
) -> Stream:
    if not (math.isfinite(strength) and strength >= 0):
        raise InputError(f"expected a finite strength of {kind}, 0 or more; came {strength}")
    if seed < 0:
        raise InputError(f"expected a seed of 0 or more; came {seed}")
    if strength == 0:
        return stream
    rng = np.random.default_rng([2, seed, _KINDS[kind], int.from_bytes(stream.key, "little")])
    return changed(stream, lambda image: change(image, rng))


def _hiss(image: Image, amplitude: float, rng: np.random.Generator) -> Image:
    """The touch observed by a noisy sensor: uniform noise in ± `amplitude`, a share of the range; clipped to the range.

    image: float32 of shape (C, T) in [-1, 1], twice the share. Every value has noise of its own.
    """
    noise = rng.random(image.shape, dtype=np.float32) * np.float32(2) - np.float32(1)
    noisy: Image = np.clip(image + noise * np.float32(2 * amplitude), np.float32(-1), np.float32(1))
    return noisy


def _blur(image: Image, deviation: float, rng: np.random.Generator) -> Image:
    """The touch observed by a noisy sensor: Gaussian noise of this standard deviation, a share of the range; clipped.

    image: float32 of shape (C, T) in [-1, 1], twice the share. Every value has noise of its own.
    """
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    noisy: Image = np.clip(image + noise * np.float32(2 * deviation), np.float32(-1), np.float32(1))
    return noisy


def _silence(image: Image, share: float, rng: np.random.Generator) -> Image:
    """The touch observed with dead channels: a `share` of the channels, rounded, reads the low end of the range
    throughout.

    image: float32 of shape (C, T) in [-1, 1]. Which channels are dead is drawn.
    """
    copy = image.copy()
    copy[rng.permutation(len(image))[: round(share * len(image))]] = -1
    return copy


def _wander(image: Image, offset: float, gain: float, rng: np.random.Generator) -> Image:
    """The touch observed by a sensor that warms up: each channel's gain and zero change along a straight line.

    image: float32 of shape (C, T) in [-1, 1]. From nothing at the beginning to, at the end, an offset of at most
    `offset` of the range and a gain of at most 1 ± `gain` about the low end of the range, drawn for each channel;
    clipped to the range.
    """
    along = np.linspace(0, 1, image.shape[1], dtype=np.float32)
    drawn = rng.random((2, len(image), 1), dtype=np.float32) * np.float32(2) - np.float32(1)
    change = (image + 1) * (drawn[0] * np.float32(gain)) + drawn[1] * np.float32(2 * offset)
    wandered: Image = np.clip(image + change * along, np.float32(-1), np.float32(1))
    return wandered
