"""Kept touches: a bounded sample of what was observed to compare others with (see `matching.matcher`).

In a checkpoint these are `kept-keys` (n, 32), `kept-columns` (n), and `kept-levels`, each channel by channel; their
materials are the attribute `kept`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.likelihood import LevelArray, levels_of
from scroll_tactile.matching.match import KeptTouch
from scroll_tactile.sensors import Sensor
from scroll_tactile.statistics.sample import Sample

__all__ = ["Keeping", "KeptTouches", "usual_kept"]

MOST_TOUCHES = 1000
MOST_BYTES = 16_000_000  # of levels; with all that is made of them for comparing it is three times as much
LONGEST = 2.0  # times the usual length: what is kept of a touch


def usual_kept(sensor: Sensor) -> int:
    """The default number of kept touches: of a BioTac 1000, and none of a camera, whose touches are large."""
    return 0 if sensor.camera else max(1, min(MOST_TOUCHES, MOST_BYTES // (sensor.channels * sensor.readings)))


@dataclass(frozen=True)
class Keeping:
    """What is kept: the levels of at most `capacity` touches of a sensor."""

    sensor: Sensor
    capacity: int

    def levels(self, readings: npt.NDArray[np.floating]) -> LevelArray:
        """What is kept of readings (T, C) in the sensor's unit: levels (C, T'), T' at most twice the usual length."""
        return levels_of(readings[: self.most_columns], self.sensor)

    @property
    def most_columns(self) -> int:
        """T' at most."""
        return max(2, round(LONGEST * self.sensor.readings))


class KeptTouches(Sample[LevelArray]):
    """The kept touches: a function of the set of touches observed.

    made: how they are kept.
    """

    def __init__(self, made: Keeping) -> None:
        super().__init__(made.capacity)
        self.made = made

    def touches(self) -> list[KeptTouch]:
        """All of them, by material and key."""
        return [KeptTouch(material, key, levels) for material, key, levels in self]

    def take(self, material: str, key: bytes, readings: npt.NDArray[np.floating] | None) -> None:
        """Keep a touch where it belongs in, if its readings are there."""
        if readings is not None and self.wants(material, key):
            self.add(material, key, self.made.levels(readings))

    def to_arrays(self) -> tuple[dict[str, npt.NDArray[Any]], list[str]]:
        """What a store keeps: arrays by name, and the material of each touch."""
        kept = self.touches()
        levels = np.concatenate([np.zeros(0, np.uint8), *(touch.levels.ravel() for touch in kept)])
        return {
            "kept-keys": np.array([list(touch.key) for touch in kept] or [[]], np.uint8)[: len(kept)],
            "kept-columns": np.array([touch.levels.shape[1] for touch in kept], dtype=np.int64),
            "kept-levels": np.diff(levels, prepend=np.uint8(0)),
        }, [touch.material for touch in kept]

    def fill(self, arrays: Mapping[str, npt.NDArray[Any]], materials: Sequence[str]) -> None:
        """Take in what `to_arrays` described."""
        columns, channels = arrays["kept-columns"], self.made.sensor.channels
        parts = np.split(np.cumsum(arrays["kept-levels"], dtype=np.uint8), np.cumsum(columns * channels)[:-1])
        for i, material in enumerate(materials):
            self.add(material, arrays["kept-keys"][i].tobytes(), parts[i].reshape(channels, -1))
