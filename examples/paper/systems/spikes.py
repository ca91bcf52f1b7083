"""Threshold (delta) encoding: a stream as spikes, each a change by one threshold, in two polarities.

With a channel's reading x_t in units of the image, half the sensor's range, and a threshold θ:

    n_t = trunc((x_t − x̂_{t−1}) / θ),   x̂_t = x̂_{t−1} + θ n_t,   x̂_{−1} = x_rest

n_t > 0 are so many spikes of the channel's ON line, n_t < 0 of its OFF line. So x̂ follows the reading, never further
off than θ, and what does not change costs no spikes (delta modulation, as in event cameras: Lichtsteiner et al. 2008,
IEEE J. Solid-State Circuits 43). Several spikes may fall within one reading: at the rates of tactile sensors a slip is
more than a threshold a reading, and a line that could fire once only would lag behind.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError

__all__ = ["REST", "encode"]

Image = npt.NDArray[np.float32]

REST = -1.0
"""The least value of an image: where every channel begins, so that the first spikes show how it was pressed."""


def encode(image: Image, threshold: float, rest: float = REST) -> Image:
    """Spike counts, float32 of shape (2 C, T), of a tactile image (C, T): the C ON lines, then the C OFF lines.

    threshold: θ > 0, in units of the image. rest: x_rest, where each channel is before the first reading.
    Raises InputError for another threshold, or an image that is not (C, T).
    """
    if not (math.isfinite(threshold) and threshold > 0):
        raise InputError(f"expected a finite threshold above 0; came {threshold}")
    if image.ndim != 2:
        raise InputError(f"expected a tactile image of shape (C, T); came {image.shape}")
    steps = (image.astype(np.float64) - rest) / threshold
    # x̂ is kept as a whole number of thresholds, so that its rounding does not add up.
    level = np.zeros(len(image))
    fired = np.empty_like(steps)
    for i in range(steps.shape[1]):
        fired[:, i] = np.trunc(steps[:, i] - level)
        level += fired[:, i]
    return np.concatenate([np.maximum(fired, 0), np.maximum(-fired, 0)]).astype(np.float32)
