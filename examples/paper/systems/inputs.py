"""What the systems read of a stream: an image of fixed layout, of any length."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.signals.augmentation import fit
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import Stream

__all__ = ["average_columns", "one_width", "picture", "usual_columns"]

Image = npt.NDArray[np.float32]


def picture(stream: Stream) -> Image:
    """A stream as an image in [-1, 1], float32: the tactile image (C, T); of a camera the mean frame, (3, H, W).

    A network reads a camera's frame in its own colours and proportions, where `tactile_image` scans it along time.
    """
    if not stream.sensor.camera:
        return tactile_image(stream)
    low, high = np.asarray(stream.sensor.low), np.asarray(stream.sensor.high)
    frame = stream.readings.mean(axis=0, dtype=np.float64).transpose(2, 0, 1)
    return np.ascontiguousarray(np.clip((frame - low) / ((high - low) / 2) - 1, -1, 1), dtype=np.float32)


def average_columns(image: Image, every: int) -> Image:
    """The means of every few successive columns, of an image (…, T): (…, ⌊T / every⌋), at least one column.

    Columns left over at the end are dropped. Raises InputError for `every` below 1.
    """
    if every < 1:
        raise InputError(f"expected to average every 1 or more columns; came {every}")
    if every == 1:
        return image
    count = max(1, image.shape[-1] // every)
    kept = image[..., : count * every]
    means: Image = kept.reshape(*image.shape[:-1], count, -1).mean(axis=-1, dtype=np.float32)
    return means


def usual_columns(images: Sequence[Image]) -> int:
    """The median width of images: what a system that needs one width brings all to."""
    return int(np.median([image.shape[-1] for image in images]))


def one_width(image: Image, columns: int) -> Image:
    """An image (C, T) or (3, H, W) of so many columns: cut, or continued as its mirror image (see `augment.fit`)."""
    if image.shape[-1] == columns:
        return image
    # `fit` reads (C, T): the axes before the last are one to it.
    return fit(image.reshape(-1, image.shape[-1]), columns).reshape(*image.shape[:-1], columns)
