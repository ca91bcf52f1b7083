"""A correction: what makes the readings of a changed skin those that the skin which learned would have given."""

from __future__ import annotations

import binascii
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream

__all__ = ["GREATEST_GAIN", "Correction", "corrected", "corrected_stream"]

GREATEST_GAIN = 16.0  # and its inverse the least: a channel that changed by more says nothing that is known from before

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Correction:
    """The changed skin reads low + gain · (x − low) + offset where the one that learned would have read x.

    gains: float32 (n,). offsets: float32 (n,), in the sensor's unit. lost: bool (n,), the m channels that are left out:
    their values are missing, and a guess by the others stands in their place. guess: float32 (m, n − m + 1); as shares
    of the range, a lost channel is guessed as guess[:, :-1] · (the others) + guess[:, -1], within the range.
    """

    gains: Floats
    offsets: Floats
    lost: npt.NDArray[np.bool_]
    guess: Floats

    @classmethod
    def none(cls, channels: int) -> Self:
        """That of a skin that did not change."""
        ones, zeros = np.ones(channels, np.float32), np.zeros(channels, np.float32)
        return cls(ones, zeros, np.zeros(channels, np.bool_), np.zeros((0, channels + 1), np.float32))

    def applied(self, stream: Stream) -> Stream:
        """A stream as the skin that learned would have read it; one that was corrected before stays as it is."""
        if stream.raw is not None:
            return stream
        low, high = (np.asarray(limit, np.float64) for limit in stream.sensor.limits)
        span = high - low
        shares = corrected((stream.readings - low) / span, self.gains, self.offsets / span)
        shares[:, self.lost] = self._guessed(shares[:, ~self.lost])
        readings = (low + shares * span).astype(np.float32)
        np.clip(readings, *stream.sensor.limits, out=readings)  # rounding may pass an end
        mask = stream.mask
        if self.lost.any():
            mask = np.zeros(readings.shape, np.bool_) if mask is None else mask.copy()
            mask[:, self.lost] = True
            mask.setflags(write=False)
        readings += np.float32(0)  # −0 becomes 0: equal readings must have equal keys
        readings.setflags(write=False)
        return replace(stream, readings=readings, mask=mask, raw=stream)

    def _guessed(self, others: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The lost channels, (T, m), by the others, (T, n − m). Added in one order: equal on every machine."""
        weights = self.guess.astype(np.float64)
        found = np.tile(weights[:, -1], (len(others), 1))
        for share, weight in zip(others.T, weights.T[:-1], strict=True):
            found += share[:, None] * weight
        return np.clip(found, 0.0, 1.0)

    def to_text(self) -> str:
        """As an attribute of a journal row."""
        gains, offsets, guess = (part.astype("<f4").tobytes() for part in (self.gains, self.offsets, self.guess))
        parts = gains + offsets + self.lost.astype(np.uint8).tobytes() + guess
        return binascii.b2a_base64(parts, newline=False).decode()

    @classmethod
    def from_text(cls, text: Any, sensor: Sensor) -> Self:
        """The correction that `to_text` wrote. Raises InputError for what is none of this sensor."""
        n = sensor.channels
        try:
            raw = binascii.a2b_base64(text, strict_mode=True) if isinstance(text, str) else b""
        except ValueError:
            raw = b""
        lost = np.frombuffer(raw[8 * n : 9 * n], np.uint8)
        m = int(np.count_nonzero(lost))
        if sensor.camera or len(raw) != 9 * n + 4 * m * (n - m + 1):
            raise InputError(f"expected a gain and an offset for each of {n} channels; came {text!r:.60}")
        gains, offsets = (part.astype(np.float32) for part in np.frombuffer(raw[: 8 * n], "<f4").reshape(2, n))
        guess = np.frombuffer(raw[9 * n :], "<f4").astype(np.float32).reshape(m, n - m + 1)
        return cls(gains, offsets, lost.astype(np.bool_), guess)


def corrected(
    shares: npt.NDArray[np.float64], gains: npt.NDArray[np.floating], offsets: npt.NDArray[np.floating]
) -> npt.NDArray[np.float64]:
    """Readings as shares of the range, (T, n), by gains (n,) and offsets (n,), a share, of the skin that gave them.

    A reading at an end of the range stays there: how far beyond it would have gone is not known. Of a skin that reads
    nothing most of the time a zero that is clipped is no constant above zero.
    """
    found = np.clip((shares - offsets) / gains, 0.0, 1.0)
    return np.where((shares <= 0.0) | (shares >= 1.0), shares, found)


def corrected_stream(stream: Stream, correction: Correction | None) -> Stream:
    """A stream as the skin that learned would have read it; as it is where nothing is to be corrected."""
    return stream if correction is None else correction.applied(stream)
