"""The embedding: one image, one vector of bytes, whatever happens around it."""

import random
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scroll_tactile import Kernels
from scroll_tactile.embeddings import banks, kernels
from scroll_tactile.embeddings.protocol import embed_windows

SMALL = Kernels(dimension=64)
BOTH = [SMALL, Kernels()]  # the default as well: it uses several thresholds of a kernel, and larger banks


def image(channels, columns, seed=0):
    rng = np.random.default_rng([channels, columns, seed])
    walk = np.cumsum(rng.normal(size=(channels, columns)), axis=1)
    return np.clip(rng.uniform(-1, 1, (channels, 1)) + 0.05 * walk, -1, 1).astype(np.float32)


def forget_caches():
    for module in (banks, kernels):
        for item in vars(module).values():
            if hasattr(item, "cache_clear"):
                item.cache_clear()


@settings(max_examples=40, deadline=None)
@given(
    channels=st.integers(1, 40),
    columns=st.integers(1, 200),
    data=st.data(),
)
def test_any_windows_of_any_image_embed_as_they_do_alone(channels, columns, data):
    whole = image(channels, columns)
    widths = data.draw(st.lists(st.integers(1, columns), min_size=1, max_size=4, unique=True))
    asked = {w: data.draw(st.lists(st.integers(0, columns - w), min_size=1, max_size=3)) for w in widths}
    together = embed_windows(SMALL, whole, asked)
    for width, starts in asked.items():
        for row, start in zip(together[width], starts, strict=True):
            assert row.tobytes() == SMALL.embed(whole[:, start : start + width]).tobytes()


@pytest.mark.parametrize("columns", [1, 9, 12, 20, 64, 65, 99])
def test_a_window_wider_than_the_image_is_read_as_far_as_the_image_goes(columns):
    whole = image(19, columns)
    asked = {100: [0], **({30: [0, columns - 30]} if columns >= 30 else {30: [0]})}
    together = SMALL.embed_windows(whole, asked)
    for width, starts in asked.items():
        for row, start in zip(together[width], starts, strict=True):
            alone = SMALL.embed(whole[:, start : start + width], width)
            assert row.tobytes() == alone.tobytes()
            assert row.min() >= 0
            assert row.max() <= 1


@pytest.mark.parametrize("columns", [4096, 4097, 9000])
def test_windows_of_a_very_long_image(columns):
    whole = image(3, columns)
    asked = {30: [0, columns - 30], 5: [7], 200: [columns // 2]}
    for width, rows in SMALL.embed_windows(whole, asked).items():
        for row, start in zip(rows, asked[width], strict=True):
            assert row.tobytes() == SMALL.embed(whole[:, start : start + width]).tobytes()


def test_what_was_embedded_before_or_beside_changes_no_bit():
    images = [image(channels, columns) for channels, columns in [(19, 400), (60, 75), (1, 1), (19, 30)]]
    forget_caches()
    first = [SMALL.embed(picture).tobytes() for picture in images]
    forget_caches()
    for other in (Kernels(seed=3, dimension=64), Kernels(dimension=100)):
        for picture in images:
            other.embed(picture)
    assert [SMALL.embed(picture).tobytes() for picture in reversed(images)] == first[::-1]
    assert [Kernels(dimension=64).embed(picture).tobytes() for picture in images] == first


@pytest.fixture
def restored():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)
    torch.set_float32_matmul_precision("highest")
    torch.set_default_dtype(torch.float32)
    torch.set_default_device(None)
    forget_caches()


@pytest.mark.parametrize("cold", [False, True], ids=["warm", "cold"])
@pytest.mark.parametrize(
    "setting",
    [
        lambda: torch.set_num_threads(1),
        lambda: torch.set_num_threads(2),
        lambda: torch.set_float32_matmul_precision("medium"),
        lambda: torch.set_float32_matmul_precision("high"),
        lambda: torch.set_default_dtype(torch.float64),
        lambda: torch.set_default_device("meta"),
    ],
    ids=["one thread", "two threads", "medium precision", "high precision", "float64", "another device"],
)
@pytest.mark.usefixtures("restored")
def test_the_settings_of_the_callers_program_change_no_bit(setting, cold):
    cases = [(embedding, image(19, 400)) for embedding in BOTH] + [(SMALL, image(19, 30))]
    expected = [embedding.embed(picture).tobytes() for embedding, picture in cases]
    setting()
    if cold:
        forget_caches()
    assert [embedding.embed(picture).tobytes() for embedding, picture in cases] == expected


@pytest.mark.parametrize("cold", [False, True], ids=["warm", "cold"])
def test_automatic_mixed_precision_around_the_call_changes_no_bit(cold):
    cases = [image(19, 400), image(60, 15)]
    expected = [SMALL.embed(picture).tobytes() for picture in cases]
    if cold:
        forget_caches()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert [SMALL.embed(picture).tobytes() for picture in cases] == expected


def test_read_only_and_non_contiguous_images():
    plain = image(19, 100)
    expected = SMALL.embed(plain).tobytes()
    fixed = plain.copy()
    fixed.setflags(write=False)
    wide = np.zeros((38, 200), dtype=np.float32)
    wide[::2, ::2] = plain
    for same in (fixed, np.asfortranarray(plain), wide[::2, ::2], plain[:, ::-1].copy()[:, ::-1]):
        before = same.copy()
        assert SMALL.embed(same).tobytes() == expected
        assert np.array_equal(before, same)
    asked = {30: [0, 70], 100: [0], 4: [3]}
    expected_windows = SMALL.embed_windows(plain, asked)
    for width, rows in SMALL.embed_windows(fixed, asked).items():
        assert rows.tobytes() == expected_windows[width].tobytes()


@pytest.mark.parametrize("embedding", BOTH, ids=repr)
@pytest.mark.parametrize(
    "picture",
    [np.full((19, 60), value, dtype=np.float32) for value in (-1, 0, 1)]
    + [np.sign(image(19, 60)), np.tile(np.float32([-1, 1]), (5, 15)), image(1, 1), image(4, 700)],
    ids=["low", "middle", "high", "extremes", "alternating", "one value", "long"],
)
def test_features_lie_within_the_bound_and_on_the_grid(embedding, picture):
    features = embedding.embed(picture)
    assert features.shape == (embedding.dimension,)
    assert features.min() >= 0
    assert features.max() <= 1 == embedding.bound
    scaled = features.astype(np.float64) * 2**20
    assert np.array_equal(scaled, np.rint(scaled))


@pytest.mark.parametrize("dimension", [64, 65, 127, 333, 1008, 2016])
def test_any_dimension(dimension):
    for columns in (1, 15, 40, 400):
        assert Kernels(dimension=dimension).embed(image(3, columns)).shape == (dimension,)


def test_the_seed_decides_the_features_and_the_fingerprint():
    prints = {Kernels(seed=seed, dimension=dimension).fingerprint for seed in (0, 1) for dimension in (64, 65)}
    assert len(prints) == 4
    assert Kernels(seed=0, dimension=64).fingerprint in prints
    assert not np.array_equal(
        Kernels(seed=1, dimension=64).embed(image(3, 50)), Kernels(seed=0, dimension=64).embed(image(3, 50))
    )


CHILD = """
import hashlib
import numpy as np
from scroll_tactile import Kernels
kernels = Kernels(dimension=64)
image = np.linspace(-1, 1, 19 * 400, dtype=np.float32).reshape(19, 400)
print(kernels.embed(image).tobytes().hex()[:200], kernels.fingerprint, Kernels().fingerprint)
"""


def test_a_fresh_process_gives_the_same_features_and_fingerprint():
    said = subprocess.run([sys.executable, "-c", CHILD], capture_output=True, text=True, check=True, timeout=60).stdout
    picture = np.linspace(-1, 1, 19 * 400, dtype=np.float32).reshape(19, 400)
    assert said.split() == [SMALL.embed(picture).tobytes().hex()[:200], SMALL.fingerprint, Kernels().fingerprint]


def test_global_random_generators_are_left_alone():
    forget_caches()

    def states():
        name, keys, *rest = np.random.get_state()  # noqa: NPY002  # the global generator is what is meant
        return [random.getstate(), name, keys.tobytes(), rest, torch.random.get_rng_state().numpy().tobytes()]

    before = states()
    Kernels(seed=5, dimension=64).embed(image(7, 90))
    _ = Kernels(seed=5, dimension=64).fingerprint
    assert states() == before


@pytest.mark.parametrize("settings", [{"seed": -1}, {"dimension": 63}])
def test_settings_that_make_no_embedding_are_refused(settings):
    with pytest.raises(ValueError, match="came"):
        Kernels(**settings)
