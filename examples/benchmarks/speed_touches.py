"""The touches that `speed` times: BioTac's or like them, and simulated ones of any number of materials."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from examples.paper.readers.biotac_slide import load
from examples.paper.readers.labelled import hold_out
from scroll_tactile import sensors
from scroll_tactile.sensors import Sensor
from scroll_tactile.simulation.scene import Scene

__all__ = ["SHORT", "SKIN", "Touch", "biotac_touches", "name_of", "skin_touch", "skin_touches"]

Touch = tuple[str, npt.NDArray[np.float32]]

SKIN = Sensor(name="skin", channels=8, rate=100.0, low=-1.0, high=1.0, unit="1", duration=1.0)
SHORT = SKIN.model_copy(update={"name": "short-skin", "duration": 0.1})


def biotac_touches(number: int, asked: int, data: Path | None, seed: int) -> tuple[Sequence[Touch], Sequence[Touch]]:
    """So many touches to learn, in a random order, and touches to predict, of BioTac or like it.

    asked: to predict, of each material, where they are simulated.
    """
    if data is None:
        scene = Scene(sensor=sensors.BIOTAC, seed=seed)
        repetitions = -(-number // len(scene.materials))
        train = [(name, scene.touch(name, i)) for i in range(repetitions) for name in scene.materials][:number]
        test = [(name, scene.touch(name, 1000 + i)) for i in range(asked) for name in scene.materials]
    else:
        recordings = load(data, "biotac", seed)
        train, test = hold_out(recordings, recordings.fold == 0)
    order = np.random.default_rng(seed).permutation(len(train))[:number]
    learned = [(train[i][0], np.array(train[i][1].readings)) for i in order]
    return learned, [(name, np.array(stream.readings)) for name, stream in test]


def name_of(place: int) -> str:
    """Of one of any number of materials."""
    return f"m{place:06d}"


def skin_touches(seed: int, materials: int, each: int) -> Iterator[Touch]:
    """Touches to learn, material after material in each round, and then those to predict, one each."""
    for repetition in range(each):
        for place in range(materials):
            yield name_of(place), skin_touch(seed, place, repetition)
    for i in range(min(200, materials)):
        yield name_of(37 * i % materials), skin_touch(seed, 37 * i % materials, 1000)


def skin_touch(seed: int, place: int, repetition: int) -> npt.NDArray[np.float32]:
    """A touch of one of any number of materials: twenty of each of the simulator's scenes."""
    scene = Scene(sensor=SKIN, seed=seed + place // 20)
    return np.array(scene.touch(scene.materials[place % 20], repetition).readings)
