"""Every embedding that ships keeps the promises of one, and refuses what is no image."""

import numpy as np
import pytest
import torch

from examples.paper.transfer.maps import Maps
from scroll_tactile import Frames, Joined, Kernels, ModuleEmbedding, Vision
from scroll_tactile.embeddings.protocol import embed_windows, is_embedding
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.errors import InputError
from scroll_tactile.testing import check_embedding

NETWORK = ResNet.random(0).state_dict()
KERNELS = Kernels(dimension=64)
SIZES = ((1, 19), (1, 9, 60))
SKIN = ((20,), (9, 60))
EYE = ((30,), (1, 40))
SEEN = ((9,), (9, 30))


class Loud:
    """Features beyond 1, within a bound of its own, and nothing but what the protocol asks for."""

    name, dimension, bound, fingerprint = "loud", 2, 8.0, "00" * 16

    def embed(self, image):
        assert image.flags.c_contiguous
        return np.array([8.0 * float(image.mean()), -8.0])


def pool():
    return torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d((4, 4)), torch.nn.Flatten())


SHIPPED = {
    "kernels": (KERNELS, SIZES),
    "default kernels": (Kernels(), ((19,), (30, 400))),
    "frames": (Frames(), ((3, 30), (1, 40))),
    "frames by cosines": (Frames(cosines=64), EYE),
    "frames by a network": (Frames(NETWORK), EYE),
    "maps of channels": (Maps(layout=(20,), parts=3), SKIN),
    "maps of channels by cosines": (Maps(layout=(20,), parts=3, cosines=70), SKIN),
    "maps of a grid": (Maps(layout=(4, 5), parts=2), SKIN),
    "maps of a grid by cosines": (Maps(layout=(4, 5), parts=2, views=["corner"], cosines=64), SKIN),
    "vision": (Vision(NETWORK), SEEN),
    "vision, all stages": (Vision(None, seed=1, stages=(0, 1, 2, 3, 4)), SEEN),
    "joined": (Joined(KERNELS, Vision(NETWORK, stages=(1, 2))), SEEN),
    "joined with one's own": (Joined(Loud(), KERNELS), ((19,), (9, 60))),
    "a module": (ModuleEmbedding(pool(), name="pool", dimension=16), ((19,), (9, 60))),
    "one's own": (Loud(), SIZES),
}


@pytest.mark.parametrize("kind", SHIPPED)
def test_it_keeps_the_promises_of_an_embedding(kind):
    embedding, (channels, columns) = SHIPPED[kind]
    assert is_embedding(embedding)
    assert len(check_embedding(embedding, channels=channels, columns=(2, *columns))) == 9
    image = np.random.default_rng(2).uniform(-1, 1, (channels[-1], 8)).astype(np.float32)
    for shortest in (2, 5, 8):
        (row,) = embed_windows(embedding, image[:, :shortest], {30: [0]})[30]
        assert row.shape == (embedding.dimension,)
        assert np.abs(row).max() <= embedding.bound


@pytest.mark.parametrize("kind", ["kernels", "vision", "maps of a grid", "frames"])
@pytest.mark.parametrize("shape", [(19,), (0, 5), (20, 0), (3, 4, 5)])
def test_what_is_no_image_is_refused(kind, shape):
    with pytest.raises(InputError, match=r"expected (a|the) tactile image"):
        SHIPPED[kind][0].embed(np.zeros(shape, np.float32))


@pytest.mark.parametrize("kind", ["vision, all stages", "a module"])
def test_the_callers_program_changes_no_bit(kind):
    embedding, image = SHIPPED[kind][0], np.random.default_rng(0).uniform(-1, 1, (19, 30)).astype(np.float32)
    before, threads = embedding.embed(image).tobytes(), torch.get_num_threads()
    precision = torch.get_float32_matmul_precision()
    try:
        for count, gradients, autocast in ((1, True, False), (2, False, True)):
            torch.set_num_threads(count)
            torch.set_float32_matmul_precision("medium")
            with torch.set_grad_enabled(gradients), torch.autocast("cpu", enabled=autocast):
                assert embedding.embed(image).tobytes() == before
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(threads)
        torch.set_float32_matmul_precision(precision)
