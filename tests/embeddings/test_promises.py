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
SKIN = ((20,), (9, 30, 75))
EYE = ((3, 60), (1, 9, 40))


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
    "frames": (Frames(), ((3, 180), (1, 9, 80))),
    "frames by cosines": (Frames(cosines=64), EYE),
    "frames by a network": (Frames(NETWORK), EYE),
    "maps of channels": (Maps(layout=(20,), parts=3), SKIN),
    "maps of channels by cosines": (Maps(layout=(20,), parts=3, cosines=70), SKIN),
    "maps of a grid": (Maps(layout=(4, 5), parts=2), SKIN),
    "maps of a grid by cosines": (Maps(layout=(4, 5), parts=2, views=["corner"], cosines=64), SKIN),
    "vision": (Vision(NETWORK), SIZES),
    "vision, all stages": (Vision(None, seed=1, stages=(0, 1, 2, 3, 4)), ((19,), (9, 60))),
    "vision, bfloat16": (Vision(NETWORK, stages=(0, 4), precision="bfloat16"), ((19,), (9, 60))),
    "joined": (Joined(KERNELS, Vision(NETWORK, stages=(1, 2))), ((19,), (9, 60))),
    "joined with one's own": (Joined(Loud(), KERNELS), ((19,), (9, 60))),
    "a module": (ModuleEmbedding(pool(), name="pool", dimension=16), ((19,), (9, 60))),
    "one's own": (Loud(), SIZES),
}


@pytest.mark.parametrize("kind", SHIPPED)
def test_it_keeps_the_promises_of_an_embedding(kind):
    embedding, (channels, columns) = SHIPPED[kind]
    assert is_embedding(embedding)
    assert len(check_embedding(embedding, channels=channels, columns=columns)) == 10


@pytest.mark.parametrize("kind", SHIPPED)
def test_the_shortest_touches_are_read(kind):
    embedding, (channels, _) = SHIPPED[kind]
    check_embedding(embedding, channels=channels[-1:], columns=(2, 5, 8))
    rng = np.random.default_rng(2)
    for columns in range(2, 9):
        image = rng.uniform(-1, 1, (channels[-1], columns)).astype(np.float32)
        (row,) = embed_windows(embedding, image, {30: [0]})[30]
        assert row.shape == (embedding.dimension,)
        assert np.abs(row).max() <= embedding.bound


@pytest.mark.parametrize("kind", ["kernels", "vision", "maps of a grid", "frames"])
@pytest.mark.parametrize("shape", [(19,), (0, 5), (20, 0), (3, 4, 5)])
def test_what_is_no_image_is_refused(kind, shape):
    with pytest.raises(InputError, match=r"expected (a|the) tactile image"):
        SHIPPED[kind][0].embed(np.zeros(shape, np.float32))


@pytest.mark.parametrize("kind", ["kernels", "default kernels", "vision, all stages", "a module"])
@pytest.mark.parametrize("hostile", ["one thread", "two threads", "autocast", "gradients", "precision"])
def test_the_callers_program_changes_no_bit(kind, hostile):
    embedding = SHIPPED[kind][0]
    images = [
        np.random.default_rng(i).uniform(-1, 1, (19, columns)).astype(np.float32) for i, columns in ((0, 30), (1, 75))
    ]
    before = [embedding.embed(image).tobytes() for image in images]
    threads, precision = torch.get_num_threads(), torch.get_float32_matmul_precision()
    try:
        torch.set_num_threads(2 if hostile == "two threads" else 1)
        if hostile == "precision":
            torch.set_float32_matmul_precision("medium")
        with torch.set_grad_enabled(hostile == "gradients"), torch.autocast("cpu", enabled=hostile == "autocast"):
            assert [embedding.embed(image).tobytes() for image in images] == before
        assert torch.get_num_threads() == (2 if hostile == "two threads" else 1)
    finally:
        torch.set_num_threads(threads)
        torch.set_float32_matmul_precision(precision)
