"""Embeddings side by side."""

import numpy as np
import pytest

from scroll_tactile import Joined, Kernels, Maps, TactileLearner, Vision, sensors
from scroll_tactile.datasets.simulator import Scene
from scroll_tactile.errors import InputError

KERNELS = Kernels(dimension=64)
VISION = Vision(None, seed=0, stages=(1, 2))


class Loud:
    """Features beyond 1, within a bound of its own, one for each column, summed."""

    name, dimension, bound, fingerprint = "loud", 2, 8.0, "00" * 16

    def embed(self, image):
        return np.array([8.0 * float(image.mean()), -8.0])


def image(channels=19, columns=100):
    return np.random.default_rng([channels, columns]).uniform(-1, 1, (channels, columns)).astype(np.float32)


def judged(embedding):
    return embedding.capabilities.partial_windows, embedding.capabilities.judged_scales


def test_it_is_its_parts_side_by_side():
    joined = Joined(KERNELS, VISION)
    assert (joined.name, joined.dimension, joined.bound) == ("kernels+vision", 64 + 192, 1.0)
    assert joined.parts == (KERNELS, VISION)
    features = joined.embed(image())
    assert features[:64].tobytes() == KERNELS.embed(image()).tobytes()
    assert features[64:].tobytes() == VISION.embed(image()).tobytes()
    windows = {30: [0, 7], 75: [0, 20]}
    embedded = joined.embed_windows(image(), windows)
    for width in windows:
        assert embedded[width][:, :64].tobytes() == KERNELS.embed_windows(image(), windows)[width].tobytes()
        assert embedded[width][:, 64:].tobytes() == VISION.embed_windows(image(), windows)[width].tobytes()


def test_each_part_is_divided_by_its_bound():
    features = Joined(KERNELS, Loud()).embed(image())
    assert features[-1] == -1.0
    assert features[-2] == pytest.approx(float(image().mean()))


def test_the_most_demanding_part_decides_on_windows():
    assert judged(VISION) == (False, "widest")
    both = Joined(KERNELS, VISION)
    assert judged(both) == (False, "widest")
    plain = Joined(Loud(), Loud())
    assert judged(plain) == (True, "all")


def test_the_fingerprint_depends_on_the_parts_and_their_order():
    pairs = [(KERNELS, VISION), (VISION, KERNELS), (KERNELS, KERNELS), (Kernels(seed=2, dimension=64), VISION)]
    assert len({Joined(*pair).fingerprint for pair in pairs}) == 4
    assert Joined(KERNELS, VISION).fingerprint == Joined(Kernels(dimension=64), VISION).fingerprint


def test_a_learner_learns_with_it():
    scene = Scene(sensor=sensors.ROBOSKIN)
    learner = TactileLearner(sensor=scene.sensor, embedding=Joined(KERNELS, VISION))
    for at in range(3):
        for name in scene.materials[:3]:
            learner.observe(name, scene.touch(name, at))
    assert all(learner.predict(scene.touch(name, 9)).material == name for name in scene.materials[:3])


@pytest.mark.parametrize("parts", [(), (KERNELS,)])
def test_fewer_than_two_are_refused(parts):
    with pytest.raises(InputError, match="at least two"):
        Joined(*parts)


def test_what_is_no_embedding_is_refused():
    with pytest.raises(InputError, match="expected embeddings"):
        Joined(KERNELS, "vision")


def test_penalties_are_named_only_where_every_part_names_some():
    cosines = Maps(layout=(3,), cosines=64)
    both = Joined(cosines, Maps(layout=(3,), cosines=64, seed=2))
    assert both.capabilities.penalties == cosines.capabilities.penalties
    assert Joined(cosines, Kernels(dimension=64)).capabilities.penalties == ()
