"""Memories of more than a thousand materials."""

import numpy as np
from touches import PAD

from scroll_tactile import Kernels, TactileLearner


def touch(material, seed, readings=20):
    """A noisy wave whose level, slope and frequency are the material's."""
    random, own = np.random.default_rng([material, seed]), np.random.default_rng(material)
    time = np.arange(readings)[:, None] / readings
    wave = own.uniform(0.2, 0.6, 2) + own.uniform(-0.2, 0.2, 2) * time
    return wave + own.uniform(0, 0.2, 2) * np.sin(own.uniform(3, 60, 2) * time) + random.normal(0, 0.002, (readings, 2))


def test_of_materials_of_one_short_touch_each_the_nearest_answers():
    learner, scene = TactileLearner(sensor=PAD, embedding=Kernels(dimension=64)), ["m0003", "m0400", "m1029"]
    for first, last in ((0, 1030), (1030, 5000)):
        for material in range(first, last):
            learner.observe(f"m{material:04d}", touch(material, 0))
        for material in (0, 5, 517, last - 1):
            prediction = learner.predict(touch(material, 0))
            assert prediction.material == f"m{material:04d}"
            assert len(prediction.ranking) == last
        for material in (3, 400, 1029):
            whole, part = (dict(learner.predict(touch(material, 7), scene=names).ranking) for names in (None, scene))
            assert max(part, key=part.get) == f"m{material:04d}"
            assert sorted(part, key=part.get) == sorted(scene, key=whole.get)
