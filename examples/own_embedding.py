"""An embedding of your own: the spectrum of each channel, certified, and learned from like any other.

A memory that it made is opened with it again: python examples/own_embedding.py
"""

import hashlib
import tempfile

import numpy as np

from scroll_tactile import Scene, TactileLearner, check_embedding, sensors
from scroll_tactile.errors import EmbeddingMismatchError


class Spectrum:
    """How strongly the channels move, in bands of frequency: a frozen map from an image (C, T) to (48,) features."""

    name = "spectrum"
    dimension = 48
    bound = 1.0

    @property
    def fingerprint(self) -> str:
        """Hex of a hash over all that the features depend on."""
        return hashlib.sha256(b"spectrum, 48 bands, hann window, version 1").hexdigest()

    def embed(self, image: np.ndarray) -> np.ndarray:
        """Features of shape (48,) of a tactile image of shape (C, T) in [-1, 1]."""
        signal = image.astype(np.float64) * np.hanning(image.shape[1])
        power = np.abs(np.fft.rfft(signal, n=512, axis=1)).mean(axis=0)
        bands = np.array([band.mean() for band in np.array_split(np.log1p(power), self.dimension)])
        return np.clip(bands / 8, 0, self.bound)


print("certified:", *check_embedding(Spectrum()), sep="\n  ")

scene = Scene(sensor=sensors.BIOTAC)
with tempfile.TemporaryDirectory() as folder:
    with TactileLearner.open(folder, sensor=sensors.BIOTAC, embedding=Spectrum()) as learner:
        for repetition in range(6):
            for material in scene.materials[:5]:
                learner.observe(material, scene.touch(material, repetition))
    try:
        TactileLearner.open(folder)
    except EmbeddingMismatchError as error:
        print("without it:", error)
    with TactileLearner.open(folder, embedding=Spectrum()) as learner:
        answers = [learner.predict(scene.touch(material, 50)).material for material in scene.materials[:5]]
    print(f"right: {sum(a == m for a, m in zip(answers, scene.materials, strict=False))} of 5")
