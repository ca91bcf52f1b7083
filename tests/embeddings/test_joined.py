"""Embeddings side by side."""

import numpy as np
import pytest
from images import image

from scroll_tactile import Joined, Kernels, Vision
from scroll_tactile.errors import InputError

KERNELS = Kernels(dimension=64)
VISION = Vision(None, seed=0, stages=(1, 2))


class Loud:
    """Features beyond 1, within a bound of its own, one for each column, summed."""

    name, dimension, bound, fingerprint = "loud", 2, 8.0, "00" * 16

    def embed(self, image):
        return np.array([8.0 * float(image.mean()), -8.0])


def test_it_is_its_parts_side_by_side():
    joined = Joined(KERNELS, VISION)
    assert (joined.name, joined.dimension, joined.bound) == ("kernels+vision", 64 + 192, 1.0)
    assert joined.parts == (KERNELS, VISION)
    declared = joined.capabilities
    assert (declared.partial_windows, declared.judged_scales) == (False, "widest")  # the most demanding part's
    picture, windows = image(19, 100), {30: [0, 7], 75: [0, 20]}
    parts = [part.embed_windows(picture, windows) for part in (KERNELS, VISION)]
    for width, rows in joined.embed_windows(picture, windows).items():
        assert rows[:, :64].tobytes() == parts[0][width].tobytes()
        assert rows[:, 64:].tobytes() == parts[1][width].tobytes()


def test_each_part_is_divided_by_its_bound():
    features = Joined(KERNELS, Loud()).embed(image(19, 100))
    assert features[-1] == -1.0
    assert features[-2] == pytest.approx(float(image(19, 100).mean()))


def test_the_fingerprint_depends_on_the_parts_and_their_order():
    pairs = [(KERNELS, VISION), (VISION, KERNELS), (KERNELS, KERNELS), (Kernels(seed=2, dimension=64), VISION)]
    assert len({Joined(*pair).fingerprint for pair in pairs}) == 4
    assert Joined(KERNELS, VISION).fingerprint == Joined(Kernels(dimension=64), VISION).fingerprint


@pytest.mark.parametrize(
    ("parts", "message"),
    [((), "at least two"), ((KERNELS,), "at least two"), ((KERNELS, "vision"), "expected embeddings")],
)
def test_what_cannot_be_joined_is_refused(parts, message):
    with pytest.raises(InputError, match=message):
        Joined(*parts)
