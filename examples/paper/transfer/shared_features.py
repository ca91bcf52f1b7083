"""Features that do not know the sensor: the same numbers of a touch, however many channels recorded it, and how
often."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from examples.paper.systems.inputs import Image, average_columns
from scroll_tactile import Kernels
from scroll_tactile.errors import InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import Stream

__all__ = ["Features", "SharedFeatures"]

FloatArray = npt.NDArray[np.float64]
Features = Callable[[Stream], FloatArray]
"""From a touch to its features, (d,)."""

_BANDS = 13
_LOWEST = 0.5  # Hz
_QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)
_PARTS = 10  # of a window, along time
_PRINCIPAL = 8  # variances of the channels' covariance
_LEAST = 1e-4  # of the image's unit, below which logarithms do not look
_CHANNELS = 10  # that a touch is resampled to


@dataclass(frozen=True)
class SharedFeatures:
    """What two sensors or more can be asked alike: the lowest rate, and windows as long as the shortest usual touch.

    sensors: with channels, no cameras. Raises InputError for a camera.

    >>> from scroll_tactile.simulation.scene import Scene
    >>> from scroll_tactile.sensors import BIOTAC, ROBOSKIN
    >>> shared = SharedFeatures((BIOTAC, ROBOSKIN))
    >>> [shared.spectra(Scene(sensor).touch("felt", 0)).shape for sensor in (BIOTAC, ROBOSKIN)]
    [(140,), (140,)]
    """

    sensors: tuple[Sensor, ...]

    def __post_init__(self) -> None:
        cameras = [skin.name for skin in self.sensors if skin.camera]
        if cameras or not self.sensors:
            raise InputError(f"expected sensors with channels; came {cameras or 'none'}")

    @property
    def rate(self) -> float:
        """Hz."""
        return min(skin.rate for skin in self.sensors)

    @property
    def columns(self) -> int:
        """Of a window, at the common rate."""
        return round(min(skin.duration for skin in self.sensors) * self.rate)

    def spectra(self, stream: Stream) -> FloatArray:
        """Plain statistics of a touch, (140,), the mean over its windows.

        Of each channel: log power in 13 bands up to half the common rate, log standard deviation, mean, log mean step;
        of these the mean, standard deviation and five quantiles over channels. Then the first eight variances of the
        channels' covariance, as shares, and the mean and the log step of all channels in ten parts of the window.
        """
        features: FloatArray = np.mean([self._of_window(window) for window in self._windows(stream)], axis=0)
        return features

    def resampled(self, kernels: Kernels) -> Features:
        """Kernels of a touch brought to ten channels, the least active first, and the common rate: (d,).

        Each is less its median, and all are scaled to a root mean square of a quarter.
        """

        def features(stream: Stream) -> FloatArray:
            embedded = [kernels.embed(_ten_channels(window)) for window in self._windows(stream)]
            mean: FloatArray = np.mean(embedded, axis=0, dtype=np.float64)
            return mean

        return features

    def _windows(self, stream: Stream) -> Sequence[Image]:
        """Windows (C, columns), overlapping by half or more; of a short touch one that is shorter."""
        every = max(1, round(stream.sensor.rate / self.rate))
        image = average_columns(tactile_image(stream), every)
        room = max(0, image.shape[1] - self.columns)
        count = 1 + -(-room // max(1, self.columns // 2))
        starts = np.linspace(0, room, count).round().astype(int)
        return [image[:, start : start + self.columns] for start in starts]

    def _of_window(self, window: Image) -> FloatArray:
        image = window.astype(np.float64)
        middle = image.mean(axis=1, keepdims=True)
        taper = np.hanning(image.shape[1])
        power = np.abs(np.fft.rfft((image - middle) * taper)) ** 2 / (np.square(taper).sum() * self.rate)
        frequency = np.fft.rfftfreq(image.shape[1], 1 / self.rate)
        edges = np.linspace(_LOWEST, self.rate / 2, _BANDS + 1)
        place = np.clip(np.searchsorted(edges, frequency, side="right") - 1, -1, _BANDS - 1)
        bands = [power[:, place == band].sum(axis=1) / max(1, (place == band).sum()) for band in range(_BANDS)]
        steps = np.abs(np.diff(image, axis=1))
        own = np.stack(
            [
                *np.log10(np.array(bands) + _LEAST**2),
                np.log10(image.std(axis=1) + _LEAST),
                middle[:, 0],
                np.log10(steps.mean(axis=1) * self.rate + _LEAST),
            ]
        )
        variances = np.linalg.eigvalsh(np.cov(image))[::-1][:_PRINCIPAL] if len(image) > 1 else np.zeros(0)
        shares = np.zeros(_PRINCIPAL)
        shares[: len(variances)] = np.maximum(variances, 0)
        shares = np.log10(shares / max(shares.sum(), _LEAST**2) + _LEAST)
        parts = np.array([part.mean() for part in np.array_split(image, _PARTS, axis=1)])
        moved = np.array([part.mean() if part.size else 0.0 for part in np.array_split(steps, _PARTS, axis=1)])
        over_channels = [own.mean(axis=1), own.std(axis=1), *np.quantile(own, _QUANTILES, axis=1)]
        return np.concatenate([*over_channels, shares, parts - parts.mean(), np.log10(moved + _LEAST)])


def _ten_channels(window: Image) -> Image:
    image = window - np.median(window, axis=1, keepdims=True)
    image = image[np.argsort(window.std(axis=1), kind="stable")]
    image /= 4 * max(float(np.sqrt(np.square(image).mean())), _LEAST)
    edges = np.linspace(0, len(image), _CHANNELS + 1)
    groups = [image[int(low) : max(int(low) + 1, int(np.ceil(high)))].mean(axis=0) for low, high in pairwise(edges)]
    resampled: Image = np.clip(np.stack(groups), -1, 1).astype(np.float32)
    return resampled
