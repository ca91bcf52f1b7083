"""What an embedding declares, what one that declares nothing is taken for, and embeddings side by side."""

import dataclasses

import numpy as np
import pytest
from images import image

from scroll_tactile import Capabilities, Frames, Joined, Kernels, TactileLearner, Vision, sensors
from scroll_tactile.embeddings.protocol import capabilities_of, embed_windows, parts_of, window_plan
from scroll_tactile.errors import EmbeddingError, InputError
from scroll_tactile.signals.windows import COMPETING, SHAPE, WHOLE, whole_steps
from scroll_tactile.testing import check_embedding


class Plain:
    """The least that an embedding can be."""

    name, dimension, bound, fingerprint = "plain", 3, 1.0, "0123456789abcdef"

    def embed(self, image):
        return np.array([image.mean(), image.min(), image.max()])


class Declaring(Plain):
    """One that counts how its windows are read."""

    def __init__(self, capabilities):
        self.capabilities = capabilities
        self.calls = 0

    def embed_windows(self, image, windows):
        self.calls += 1
        return {
            width: np.stack([self.embed(image[:, i : i + width]) for i in starts]) for width, starts in windows.items()
        }


def test_name_dimension_bound_fingerprint_and_embed_are_enough():
    assert capabilities_of(Plain()) == Capabilities()
    assert len(parts_of(plain := Plain())) == 1 and parts_of(plain)[0] is plain
    check_embedding(Plain(), columns=(9, 30))
    learner = TactileLearner(embedding=Plain(), sensor=sensors.BIOTAC)
    learner.observe("felt", np.full((400, 19), 3.0))
    assert learner.materials == {"felt": 1}


def test_capabilities_are_a_frozen_object_of_their_own_type():
    with pytest.raises(AttributeError):
        Capabilities().partial_windows = False
    wrong = Declaring({"partial_windows": False})
    with pytest.raises(EmbeddingError, match=r"capabilities of Declaring as .*Capabilities.*came \{'partial"):
        window_plan(sensors.BIOTAC, wrong)


@pytest.mark.parametrize("own", [True, False])
def test_windows_are_read_by_the_embedding_itself_only_where_it_declares_so(own):
    embedding = Declaring(Capabilities(embeds_windows=own))
    image = np.linspace(-1, 1, 90, dtype=np.float32).reshape(3, 30)
    assert (
        embed_windows(embedding, image, {9: [0, 4]})[9].tobytes()
        == embedding.embed_windows(image, {9: [0, 4]})[9].tobytes()
    )
    assert embedding.calls == 1 + own


def test_the_plan_of_windows_follows_what_is_declared():
    plan = window_plan(sensors.BIOTAC, Declaring(Capabilities(False, "widest", shrinkage=3.0)))
    assert (plan.partial, plan.judged, plan.shrinkage) == (False, "widest", 3.0)
    plain, views = window_plan(sensors.BIOTAC, Plain()), window_plan(sensors.BIOTAC, Kernels())
    assert plain == dataclasses.replace(views, whole=0, competes=False)
    assert (plain.views, views.views) == ((), (WHOLE, SHAPE, COMPETING))
    two = dataclasses.replace(Kernels.capabilities, competes=False)
    assert window_plan(sensors.BIOTAC, Declaring(two)).views == (WHOLE, SHAPE)
    joined = Joined(Kernels(dimension=64), Kernels(seed=2, dimension=64))
    assert window_plan(sensors.BIOTAC, joined) == views
    assert window_plan(sensors.BIOTAC, Joined(Kernels(dimension=64), Plain())).views == ()
    assert window_plan(sensors.GELSIGHT, Frames()).views == ()  # of cameras none
    assert whole_steps(sensors.GELSIGHT) == 0


KERNELS = Kernels(dimension=64)
VISION = Vision(None, seed=0, stages=(1, 2))


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
