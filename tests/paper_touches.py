"""Touches made up for the tests of the studies, and figures without their times."""

from typing import Any

import numpy as np

from examples.paper.readers.labelled import Recordings
from scroll_tactile.sensors import Sensor
from scroll_tactile.simulation.scene import Scene

PAD = Sensor(name="pad", channels=10, rate=50.0, low=-2.0, high=6.0, unit="N", duration=2.0)
PATCH = Sensor(name="patch", channels=6, rate=50.0, low=0.0, high=255.0, unit="counts", duration=1.0)


def recorded(
    sensor: Sensor = PATCH,
    materials: int = 3,
    each: int = 12,
    folds: int = 3,
    *,
    name: str = "RoboSkin-20",
    seed: int = 0,
    ordered: bool = False,
) -> Recordings:
    """So many materials of a simulated scene, so many touches of each, dealt into folds in turn."""
    scene = Scene(sensor, seed=seed)
    names = [material for material in scene.materials[:materials] for _ in range(each)]
    number = np.tile(np.arange(each), materials)
    streams = [scene.touch(material, i) for material, i in zip(names, number.tolist(), strict=True)]
    return Recordings(name, sensor, streams, names, number, number % folds, ordered)


def untimed(figures: Any) -> Any:
    """Figures as JSON has them, without the times."""
    if isinstance(figures, dict):
        return {key: untimed(value) for key, value in figures.items() if not key.endswith("seconds")}
    return [untimed(value) for value in figures] if isinstance(figures, (list, tuple)) else figures
