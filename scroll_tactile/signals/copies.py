"""Augmented observation: a touch is learned together with copies at other speeds.

The touch's content hash seeds the generator that draws the copies, so what is learned of a touch is a function of the
touch: the same bits in any order and on any machine. Only the four operations that IEEE 754 rounds correctly are used,
and no power or logarithm, whose last bit differs between machines.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field, FiniteFloat

from scroll_tactile.errors import InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.settings import ValidatedFields
from scroll_tactile.signals.augmentation import Image, crop, resize

__all__ = ["Augmented", "require_augmentable"]

FEWEST = 2  # steps of a copy, however fast it is


class Augmented(ValidatedFields):
    """Which copies a touch is observed with.

    copies: how many, the same for every touch, so that each counts alike. speed: the most that a copy is slower, or
    faster, as a factor of 1 or more. The speeds are spread evenly over the copies, two of them faster for each that is
    slower: there is less of a fast touch to be known by. A copy is no longer than the touch: a slower one is cut off
    there, as slow touches are when they are evaluated. At most 1000 copies, and a factor of 100.

    Raises InputError for strengths that cannot be.
    """

    copies: Annotated[int, Field(ge=1, le=1000)] = 4
    speed: Annotated[FiniteFloat, Field(ge=1, le=100, strict=False)] = 2.0

    def copies_of(self, image: npt.NDArray[np.float32], key: bytes) -> list[Image]:
        """The copies of a touch, each float32 of shape (C, T') in [-1, 1], T' ≤ T; the same for the same key.

        image: the tactile image of the touch, shape (C, T). key: its content hash, see `Stream.key`.
        """
        rng = np.random.default_rng([1, int.from_bytes(key, "little")])
        copies = []
        for i in range(self.copies):
            copies.append(self._paced(image, (i + rng.random()) / self.copies))
            # Unused, of kinds of copies that are gone: without it the next would have another pace, and the figures
            # that are recorded for copies would be others.
            rng.random(3), rng.random((2, len(image), 1), dtype=np.float32), rng.permutation(len(image))
        return copies

    def _paced(self, image: Image, pace: float) -> Image:
        faster = pace > 1 / 3
        factor = 1 + ((3 * pace - 1) / 2 if faster else 3 * pace) * (self.speed - 1)
        steps = image.shape[1]
        copy = resize(image, max(1 / factor if faster else factor, FEWEST / steps))
        return crop(copy, 0, min(steps, copy.shape[1]))


def require_augmentable(sensor: Sensor, augmentation: Augmented | None) -> None:
    """Raise InputError for what is no augmentation, and for any with a camera, whose frames are no channels in time."""
    if augmentation is not None and not isinstance(augmentation, Augmented):
        raise InputError(f"expected an augmentation such as Augmented(copies=4); came {augmentation!r:.60}")
    if augmentation is not None and sensor.camera:
        raise InputError(
            f"the copies of an augmentation differ in speed, and camera {sensor.name!r} takes whole frames: leave the "
            "augmentation out"
        )
