"""Kept touches: a bounded sample of what was observed, as levels, to compare others with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.matching.likelihood import LevelArray, levels_of
from scroll_tactile.matching.match import KeptTouch
from scroll_tactile.memory.touch_rows import Arrays
from scroll_tactile.sensors import Sensor
from scroll_tactile.statistics.annotations import NO_ANNOTATION, Annotation
from scroll_tactile.statistics.sample import Sample

__all__ = ["KeptTouches"]

LONGEST_KEPT = 2.0  # times the usual length: what is kept of a touch


class KeptTouches(Sample[KeptTouch]):
    """Kept touches: a bounded sample of what was observed, as levels, to compare others with (see `matching.matcher`).

    A function of the set of touches observed: at most `capacity` of a sensor's. In a checkpoint these are `kept-keys`
    (n, 32), `kept-columns` (n), and `kept-levels`, each channel by channel; their materials are the attribute `kept`.
    """

    def __init__(self, sensor: Sensor, capacity: int) -> None:
        super().__init__(capacity)
        self.sensor = sensor

    @property
    def most_columns(self) -> int:
        """Of a touch that is kept: twice the usual length."""
        return max(2, round(LONGEST_KEPT * self.sensor.readings))

    def levels(self, readings: npt.NDArray[np.floating]) -> LevelArray:
        """What is kept of readings (T, C) in the sensor's unit: levels (C, T'), T' at most `most_columns`."""
        return levels_of(readings[: self.most_columns], self.sensor)

    def touches(self) -> list[KeptTouch]:
        """All of them, by material and key."""
        return [touch for *_, touch in self]

    def take(
        self,
        material: str,
        key: bytes,
        readings: npt.NDArray[np.floating] | None,
        annotation: Annotation = NO_ANNOTATION,
    ) -> None:
        """Keep a touch where it belongs in, if its readings are there."""
        if readings is not None and self.wants(material, key):
            self.add(material, key, KeptTouch(material, key, self.levels(readings), annotation))

    def to_arrays(self) -> tuple[dict[str, npt.NDArray[Any]], list[str]]:
        """What a store keeps: arrays by name, and the material of each touch."""
        kept = self.touches()
        levels = np.concatenate([np.zeros(0, np.uint8), *(touch.levels.ravel() for touch in kept)])
        return {
            "kept-keys": np.array([list(touch.key) for touch in kept] or [[]], np.uint8)[: len(kept)],
            "kept-columns": np.array([touch.levels.shape[1] for touch in kept], dtype=np.int64),
            "kept-levels": np.diff(levels, prepend=np.uint8(0)),
        }, [touch.material for touch in kept]

    def fill(self, arrays: Arrays, materials: Sequence[str], annotations: Sequence[Annotation] = ()) -> None:
        """Take in what `to_arrays` described; annotations: of each touch."""
        noted = annotations or [NO_ANNOTATION] * len(materials)
        columns, channels = arrays["kept-columns"], self.sensor.channels
        parts = np.split(np.cumsum(arrays["kept-levels"], dtype=np.uint8), np.cumsum(columns * channels)[:-1])
        for i, material in enumerate(materials):
            key, levels = arrays["kept-keys"][i].tobytes(), parts[i].reshape(channels, -1)
            self.add(material, key, KeptTouch(material, key, levels, noted[i]))
