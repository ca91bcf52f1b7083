"""What a touch says of each channel of the sensor, as small whole numbers."""

from __future__ import annotations

import binascii
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream

__all__ = ["KINDS", "MOST_CHANNELS", "UNIT", "channel_numbers", "from_text", "has_numbers", "to_text"]

UNIT = 2.0**-10  # of a natural logarithm: 0.1 %
FLOOR = 2.0**-10  # of the range: below it a level or a spread is none; a quarter of it for the noise
KINDS = 3  # numbers of a channel: level, spread, noise
MOST_CHANNELS = 256  # beyond, a touch is not measured: the scatter of its numbers grows with the channels' square

Numbers = npt.NDArray[np.int16]


def has_numbers(sensor: Sensor) -> bool:
    """Whether touches of a sensor are measured by channel: of a camera, and of more than 256 channels, none are."""
    return not sensor.camera and sensor.channels <= MOST_CHANNELS


def channel_numbers(stream: Stream) -> Numbers | None:
    """Level, spread and noise of each channel of a touch, then the level of all: (3 n + 1,), in `UNIT` of a logarithm.

    With x the readings as shares of the range: log of mean x over its mean over channels; log of the standard
    deviation over time; log of the mean |second difference|, which is noise and no movement; log of the mean over all.
    A channel's gain moves the first three alike, an offset the first, noise the third.

    None for a sensor without (see `has_numbers`), and for fewer than three readings.
    """
    sensor = stream.sensor
    if not has_numbers(sensor) or len(stream) < 3:
        return None
    low, high = (np.asarray(limit, np.float64) for limit in sensor.limits)
    shares = (stream.readings.astype(np.float64) - low) / (high - low)
    level = shares.mean(axis=0)
    noise = np.abs(np.diff(shares, 2, axis=0)).mean(axis=0)
    total = np.log(level.mean() + FLOOR)
    parts = [np.log(level + FLOOR) - total, np.log(shares.std(axis=0) + FLOOR), np.log(noise + FLOOR / 4), [total]]
    return np.rint(np.concatenate(parts) / UNIT).astype(np.int16)


def to_text(numbers: Numbers) -> str:
    """The numbers as an attribute of a journal row."""
    return binascii.b2a_base64(numbers.astype("<i2").tobytes(), newline=False).decode()


def from_text(text: Any, channels: int) -> Numbers | None:
    """The numbers that `to_text` wrote; None where there are none of so many channels."""
    try:
        raw = binascii.a2b_base64(text, strict_mode=True) if isinstance(text, str) else b""
    except ValueError:
        return None
    return np.frombuffer(raw, "<i2").astype(np.int16) if len(raw) == 2 * (KINDS * channels + 1) else None
