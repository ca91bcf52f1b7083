"""Touches whose features are there already, to be observed without embedding anything."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile import Kernels, Sensor, TactileLearner, sensors
from scroll_tactile.results import Receipt
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import Stream
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.statistics.grid import to_codes

BIOTAC: dict[str, Any] = {"sensor": sensors.BIOTAC, "embedding": Kernels()}
TINY_PAD = Sensor(name="pad", channels=2, rate=50.0, low=0.0, high=1.0, unit="N", duration=0.3)
TINY: dict[str, Any] = {"sensor": TINY_PAD, "embedding": Kernels(seed=0, dimension=64)}

Codes = dict[int, npt.NDArray[np.int32]]


@dataclass
class Felt:
    """What `Ledger.observe` takes."""

    material: str
    stream: Stream
    columns: int
    codes: Codes


def touches(settings: dict[str, Any], materials: int, of_each: int) -> list[Felt]:
    """Simulated touches, embedded."""
    learner, scene = TactileLearner(**settings, exemplars=0), Scene(sensor=settings["sensor"])
    found = []
    for i in range(of_each):
        for name in range(materials):
            felt = scene.touch(
                scene.materials[name % len(scene.materials)], i + of_each * (name // len(scene.materials))
            )
            image = tactile_image(felt)
            bound = learner.embedding.bound
            codes = {
                width: to_codes(rows, bound) for width, rows in learner._predictor.extractor.features(image).items()
            }
            found.append(Felt(f"material {name}", felt, image.shape[1], codes))
    return found


def endless(felt: list[Felt], seed: int = 0) -> Iterator[Felt]:
    """The same again and again, each time as another stream: one reading differs, and so the key."""
    rng = np.random.default_rng(seed)
    while True:
        for one in felt:
            readings = one.stream.readings.copy()
            readings.reshape(-1)[0] = rng.uniform(one.stream.sensor.low, one.stream.sensor.high)
            stream = Stream(one.stream.sensor, readings)
            assert stream.key  # computed here, once
            yield Felt(one.material, stream, one.columns, one.codes)


def observe(learner: TactileLearner, one: Felt) -> Receipt:
    """All that `TactileLearner.observe` does behind the embedding."""
    return learner._ledger.observe(one.material, one.stream, one.columns, one.codes)
