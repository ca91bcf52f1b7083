"""Augmented observation: a touch is learned together with copies at other speeds, in noise, or with dead channels.

The touch's content hash seeds the generator that draws the copies, so what is learned of a touch is a function of the
touch: the same bits in any order and on any machine. Only the four operations that IEEE 754 rounds correctly are used,
and no power or logarithm, whose last bit differs between machines.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import Field, FiniteFloat

from scroll_tactile.errors import InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.settings import FrozenModel
from scroll_tactile.signals.augmentation import Image, crop, resize

__all__ = ["Augmented", "hiss", "require_augmentable", "silence", "wander"]

FEWEST = 2  # columns of a copy, however fast it is


def hiss(image: Image, amplitude: float, rng: np.random.Generator) -> Image:
    """The touch observed by a noisy sensor: uniform noise in ± `amplitude`, a share of the range; clipped to the range.

    image: float32 of shape (C, T) in [-1, 1], twice the share. Every value has noise of its own.
    """
    noise = rng.random(image.shape, dtype=np.float32) * np.float32(2) - np.float32(1)
    noisy: Image = np.clip(image + noise * np.float32(2 * amplitude), np.float32(-1), np.float32(1))
    return noisy


def silence(image: Image, share: float, rng: np.random.Generator) -> Image:
    """The touch observed with dead channels: a `share` of the channels, rounded, reads the low end of the range
    throughout.

    image: float32 of shape (C, T) in [-1, 1]. Which channels are dead is drawn.
    """
    copy = image.copy()
    copy[rng.permutation(len(image))[: round(share * len(image))]] = -1
    return copy


def wander(image: Image, offset: float, gain: float, rng: np.random.Generator) -> Image:
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


_Count = Annotated[int, Field(ge=0)]
_Strength = Annotated[FiniteFloat, Field(ge=0, strict=False)]


class Augmented(FrozenModel):
    """Which copies a touch is observed with.

    copies: how many that differ in all but noise, the same for every touch, so that each counts alike. speed: the most
    that a copy is slower, or faster, as a factor of 1 or more. dead: the largest share of channels that read the low
    end of the range. offset, gain: the most that a channel's zero (as a share of the range) and its gain drift by
    until the end of the touch. noisy: how many copies more that differ in noise alone. noise: its largest amplitude,
    uniform and as a share of the range; the least is a tenth of that.

    thinned: whether the fastest copy has every n-th reading, n the whole part of `speed`, 2 or more. Readings of the
    other copies lie between two of the touch's, and are smoothed by that as no sensor smooths.

    The speeds are spread evenly over the copies, two of them faster for each that is slower: there is less of a fast
    touch to be known by. A copy is no longer than the touch: a slower one is cut off there, as slow touches are when
    they are evaluated.

    Raises InputError for strengths that cannot be.
    """

    copies: _Count = 4
    speed: Annotated[FiniteFloat, Field(ge=1, strict=False)] = 2.0
    dead: Annotated[FiniteFloat, Field(ge=0, lt=1, strict=False)] = 0.0
    offset: _Strength = 0.0
    gain: _Strength = 0.0
    noisy: _Count = 0
    noise: _Strength = 1.0
    thinned: bool = False

    def model_post_init(self, context: Any) -> None:
        """Raise InputError for settings that would copy nothing, or thin nothing."""
        if not self.copies + self.noisy:
            raise InputError(f"expected 1 copy or more in all; came {self!r}")
        if self.thinned and (self.speed < 2 or not self.copies):
            raise InputError(f"expected, to be thinned, a copy and a speed of 2 or more; came {self!r}")

    def to_json(self) -> dict[str, Any]:
        """Its fields in JSON's types, as a memory keeps them.

        `thinned` only where it is true: older memories do not have it.
        """
        return {name: value for name, value in self.model_dump(mode="json").items() if name != "thinned" or value}

    def copies_of(self, image: npt.NDArray[np.float32], key: bytes) -> tuple[list[Image], list[Image]]:
        """The copies of a touch and its noisy copies, each float32 of shape (C, T') in [-1, 1], T' ≤ T.

        The same for the same key. image: the tactile image of the touch, shape (C, T). key: its content hash, see
        `Stream.key`.
        """
        rng = np.random.default_rng([1, int.from_bytes(key, "little")])
        copies = [self._copy(image, i, rng) for i in range(self.copies)]
        amplitudes = self.noise * (0.1 + 0.9 * rng.random(self.noisy))
        return copies, [hiss(image, float(amplitude), rng) for amplitude in amplitudes]

    def _copy(self, image: Image, i: int, rng: np.random.Generator) -> Image:
        pace = (i + rng.random()) / self.copies
        dead, offset, gain = rng.random(3)
        copy = self._paced(image, pace) if i + 1 < self.copies or not self.thinned else self._thinned(image)
        copy = wander(copy, offset * self.offset, gain * self.gain, rng)
        return silence(copy, dead * self.dead, rng)

    def _paced(self, image: Image, pace: float) -> Image:
        faster = pace > 1 / 3
        factor = 1 + ((3 * pace - 1) / 2 if faster else 3 * pace) * (self.speed - 1)
        columns = image.shape[1]
        copy = resize(image, max(1 / factor if faster else factor, FEWEST / columns))
        return crop(copy, 0, min(columns, copy.shape[1]))

    def _thinned(self, image: Image) -> Image:
        step = min(math.floor(self.speed), max(1, image.shape[1] // FEWEST))
        return np.ascontiguousarray(image[:, ::step])


def require_augmentable(sensor: Sensor, augmentation: Augmented | None) -> None:
    """Raise InputError for what is no augmentation, and for any with a camera, whose frames are no channels in time."""
    if augmentation is not None and not isinstance(augmentation, Augmented):
        raise InputError(f"expected an augmentation such as Augmented(copies=4); came {augmentation!r:.60}")
    if augmentation is not None and sensor.camera:
        raise InputError(
            f"the copies of an augmentation differ in speed, noise and dead channels, and camera {sensor.name!r} takes "
            "whole frames: leave the augmentation out"
        )
