"""Touches made up for the tests of the studies, and figures without their times."""

from typing import Any

import numpy as np

from examples.paper.readers.fabric_slide import CPM_FINGER, Slides
from examples.paper.readers.labelled import Recordings
from examples.paper.readers.letter_spike import DOTS, GRID, NUSKIN, dots_of
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream, validate
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


def press(letter: str, number: int) -> Stream:
    """A simulated press: dots of two taxels' distance, anywhere on the skin, each with a force of its own."""
    rng = np.random.default_rng([number, *letter.encode()])
    image = np.zeros((40, *GRID))
    row, column = rng.integers(0, 4), rng.integers(0, 4)
    for i, dot in enumerate(DOTS):
        if dots_of(letter)[dot]:
            image[8:, row + 2 * (i % 3), column + 3 * (i // 3)] = rng.uniform(500, 900)
    # A taxel that is not pressed sends nothing, and stays at rest.
    noise = rng.uniform(0, 30, image.shape) * (image > 0)
    return validate((image + noise).reshape(40, -1), NUSKIN)


def pressed(letters: str = "ABCDEFGHJKLMNOPQRTVXYZ") -> Recordings:
    """Five presses of each letter, each in a fold of its own."""
    names = [letter for letter in letters for _ in range(5)]
    number = np.tile(np.arange(5), len(letters))
    streams = [press(name, i) for name, i in zip(names, number.tolist(), strict=True)]
    return Recordings("letter-spike", NUSKIN, streams, names, number, number, ordered=True)


def slid() -> Slides:
    """Slides over three fabrics, at four forces and four speeds."""
    rng = np.random.default_rng(0)
    names, forces, speeds, streams = [], [], [], []
    for name in ("felt", "silk", "wool"):
        shape = 1 + 0.3 * rng.standard_normal((50, 16)).cumsum(axis=0) / 7
        for force in (120, 150, 210, 250):
            for speed in (-150, -10, 20, 120):
                count = 200 if abs(speed) > 50 else 400
                i = np.linspace(0, 49, count)
                values = np.stack([np.interp(i, np.arange(50), column) for column in shape.T], axis=1)
                streams.append(validate(np.clip(values, 0.2, 2) * force + rng.normal(0, 2, (count, 16)), CPM_FINGER))
                names, forces, speeds = [*names, name], [*forces, force], [*speeds, speed]
    number = np.arange(len(names)) % 16
    recordings = Recordings("FabricSlide", CPM_FINGER, streams, names, number, number % 5, ordered=False)
    return Slides(recordings, np.array(forces), np.array(speeds))


def untimed(figures: Any) -> Any:
    """Figures as JSON has them, without the times."""
    if isinstance(figures, dict):
        return {key: untimed(value) for key, value in figures.items() if not key.endswith("seconds")}
    return [untimed(value) for value in figures] if isinstance(figures, (list, tuple)) else figures
