"""What an embedding declares, and what one that declares nothing is taken for."""

import dataclasses

import numpy as np
import pytest

from scroll_tactile import Capabilities, Frames, Joined, Kernels, TactileLearner, sensors
from scroll_tactile.embeddings.protocol import capabilities_of, embed_windows, parts_of, require_rest, window_plan
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


def test_an_embedding_of_frames_is_refused_to_a_sensor_of_channels():
    with pytest.raises(InputError, match="reads a camera's frames, and sensor 'biotac'"):
        require_rest(Declaring(Capabilities(reads_frames=True)), sensors.BIOTAC)
    with pytest.raises(InputError, match="expected a resting image of sensor 'gelsight'"):
        require_rest(Frames(rest=np.zeros((4, 4, 3))), sensors.GELSIGHT)


def test_an_embedding_that_is_no_composite_is_its_own_part():
    plain = Plain()
    assert parts_of(plain) == (plain,)
