"""What no change may move: a memory is refused to an embedding whose features or fingerprint changed by a bit.

These are literals of 0.11.0, when kernels began to compete, so that without any data, too, a change of the default
embedding is noticed.
"""

import hashlib

import pytest

from examples.paper.transfer.maps import Maps
from scroll_tactile import Frames, Joined, Kernels, sensors
from scroll_tactile.embeddings.convolution import bank
from scroll_tactile.embeddings.protocol import embed_windows, window_plan
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.statistics.grid import to_codes

SCENE = Scene(sensor=sensors.BIOTAC)

FINGERPRINTS = [
    (Kernels(), "c38f4e9de80d967cb0b725d2619c58a67bb23e412e312c0f193dc008731b11be"),
    (Kernels(dimension=64), "d30c650cd0c542225b5ac9cebd617b4ca07150bb50c4639183f3d38b92d0ac64"),
    (Frames(), "4acbe6a3662862972b53271ce2e817fb6ca8eb8ea17ccd9fc51bdcef2be7de8f"),
    (Frames(rest=None), "c0681443478dd89f9aadb7c5fdb199e1138ca2339eecb2ec232290fc04e0b952"),
    (
        Joined(Kernels(dimension=64), Kernels(seed=2, dimension=128)),
        "05c617ee9b5e082048ad097c6df38be60b7ff18b3434fa947505823108d072c8",
    ),
    (Maps(layout=(19,), parts=3), "7370942d5c2d7ff09600c15f971087e8312dd2d02976fa12df2f3171e987ede6"),
]
CODES = "888cebaadb4cfb976bf95cf4dedfd4f4ae15a78a0161860a85e2c6e936ba80d6"
COMPETING = "3cfbf64416f716b8756b0820808e48e02d8f0201b1a47978a4bbfc0ab11a21cd"
# Of the first kernel of the shortest dilation, for three channels.
THRESHOLDS = [
    *(363.5, 420.5, -63.5, 843.5, -46.5, -726.5, 1458.5, -1574.5, 1133.5, 1.5, -6267.5, 129.5),
    *(-171.5, 3948.5, 115.5, -99.5, 194.5, -575.5, -2343.5, 1655.5, -77.5, 736.5, 340.5, -112.5),
]


@pytest.mark.parametrize(("embedding", "fingerprint"), FINGERPRINTS, ids=lambda given: repr(given)[:40])
def test_the_fingerprints_of_memories_that_exist(embedding, fingerprint):
    assert embedding.fingerprint == fingerprint


def test_the_default_kernels_thresholds():
    thresholds = bank(1, 3, 1).thresholds
    assert thresholds[:, 0].tolist() == THRESHOLDS
    assert thresholds.shape == (24, 378)


def test_the_default_features_of_a_simulated_touch():
    image = tactile_image(SCENE.touch("denim", 0))
    assert image.shape == (19, 400)
    embedding, digest = Kernels(), hashlib.sha256()
    windows = window_plan(sensors.BIOTAC, embedding).extent(image.shape[1])
    assert {width: len(starts) for width, starts in windows.items()} == {30: 19, 300: 3}
    for _, rows in sorted(embed_windows(embedding, image, windows).items()):
        digest.update(to_codes(rows, embedding.bound).astype("<i8").tobytes())
    assert digest.hexdigest() == CODES


def test_the_default_competing_features_of_a_simulated_touch():
    embedding = Kernels()
    _, competing = embedding.embed_competing(tactile_image(SCENE.touch("denim", 0)), {}, 400)
    assert hashlib.sha256(to_codes(competing, embedding.bound).astype("<i8").tobytes()).hexdigest() == COMPETING
