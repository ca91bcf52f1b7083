"""Tactile images made up for the tests of embeddings."""

import numpy as np


def image(channels: int, columns: int, seed: int = 0) -> np.ndarray:
    """A random walk of each channel about a level of its own."""
    rng = np.random.default_rng([channels, columns, seed])
    walk = np.cumsum(rng.normal(size=(channels, columns)), axis=1)
    return np.clip(rng.uniform(-1, 1, (channels, 1)) + 0.05 * walk, -1, 1).astype(np.float32)
