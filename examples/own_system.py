"""A system and an embedding of your own, measured as the paper's are:

    python -m examples.paper table1 --data DATA --system examples.own_system:NearestMean \
        --embedding examples.own_system:Strengths --quick

On simulated touches: python -m examples.own_system
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from examples.paper.readers.labelled import Recordings
from examples.paper.studies.table1 import Table1, rows
from scroll_tactile import Scene, Stream, sensors


class Strengths:
    """How far each part of a touch lies from its mean: a frozen map from an image (C, T) to (32,) features."""

    name, dimension, bound, fingerprint = "strengths", 32, 1.0, "0001"  # a hash of all that features depend on

    def embed(self, image: np.ndarray) -> np.ndarray:
        """Features of shape (32,) of a tactile image of shape (C, T) in [-1, 1]."""
        far = np.abs(image - image.mean(axis=1, keepdims=True)) / 2
        return np.array([part.mean() for part in np.array_split(np.sort(far, axis=None), self.dimension)])


class NearestMean:
    """Names the material whose mean touch is nearest, by the mean of each channel."""

    name = "nearest mean"

    def fit(self, streams: Any, materials: Any, validation: Any, seed: int, progress: Any = 0, watch: Any = 0) -> None:
        """Learn N streams of N materials, and the validation, (material, stream), as there is nothing to choose."""
        read: dict[str, list[np.ndarray]] = {}
        for name, stream in (*zip(materials, streams, strict=True), *validation):
            read.setdefault(name, []).append(stream.readings.mean(axis=0))
        self.means = {name: np.mean(each, axis=0) for name, each in read.items()}

    def predict(self, streams: Sequence[Stream]) -> list[str]:
        """The material of each stream."""
        reads = [stream.readings.mean(axis=0) for stream in streams]
        return [min(self.means, key=lambda name: np.square(self.means[name] - read).sum()) for read in reads]


if __name__ == "__main__":
    scene, numbers = Scene(sensor=sensors.BIOTAC), np.tile(np.arange(8), 4)
    names = [material for material in scene.materials[:4] for _ in range(8)]
    touches = [scene.touch(name, i) for name, i in zip(names, numbers.tolist(), strict=True)]
    recordings = Recordings("simulated", sensors.BIOTAC, touches, names, numbers, numbers % 2, False)
    study = Table1([recordings], ("examples.own_system:NearestMean", "examples.own_system:Strengths-lda"))
    for row in rows(list(study.run({"simulated": [0, 1]}))):
        print(f"{row['system']}: right {row['sets']['simulated']['mean']:.0%}")
