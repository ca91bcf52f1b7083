"""Kernels: one image, one vector of bytes, whatever happens around it."""

import random

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from images import image

from scroll_tactile import Kernels
from scroll_tactile.embeddings import convolution, kernels
from scroll_tactile.embeddings.protocol import embed_windows

SMALL = Kernels(dimension=64)
BOTH = [SMALL, Kernels()]  # the default as well: it uses several thresholds of a kernel, and larger banks


def forget_caches():
    for module in (convolution, kernels):
        for item in vars(module).values():
            if hasattr(item, "cache_clear"):
                item.cache_clear()


@settings(max_examples=10, deadline=None)
@given(channels=st.integers(1, 40), columns=st.integers(1, 200), data=st.data())
def test_any_windows_of_any_image_embed_as_they_do_alone(channels, columns, data):
    whole = image(channels, columns)
    widths = data.draw(st.lists(st.integers(1, columns), min_size=1, max_size=4, unique=True))
    windows = {w: data.draw(st.lists(st.integers(0, columns - w), min_size=1, max_size=3)) for w in widths}
    together = embed_windows(SMALL, whole, windows)
    for width, starts in windows.items():
        for row, start in zip(together[width], starts, strict=True):
            assert row.tobytes() == SMALL.embed(whole[:, start : start + width]).tobytes()


@pytest.mark.parametrize("columns", [9, 64, 4097])
def test_windows_wider_than_the_image_and_of_a_very_long_one(columns):
    whole = image(3, columns)
    windows = {5000: [0], 30: [0, columns - 30] if columns > 30 else [0]}
    for width, rows in SMALL.embed_windows(whole, windows).items():
        for row, start in zip(rows, windows[width], strict=True):
            assert row.tobytes() == SMALL.embed(whole[:, start : start + width], width).tobytes()


def test_images_that_are_not_contiguous():
    plain = image(19, 100)
    wide = np.zeros((38, 200), dtype=np.float32)
    wide[::2, ::2] = plain
    for same in (np.asfortranarray(plain), wide[::2, ::2], plain[:, ::-1].copy()[:, ::-1]):
        assert SMALL.embed(same).tobytes() == SMALL.embed(plain).tobytes()


@pytest.mark.parametrize("embedding", BOTH, ids=repr)
def test_features_lie_within_the_bound_and_on_the_grid(embedding):
    pictures = [np.full((19, 60), value, dtype=np.float32) for value in (-1, 0, 1)]
    pictures += [np.sign(image(19, 60)), np.tile(np.float32([-1, 1]), (5, 15)), image(1, 1), image(4, 700)]
    for picture in pictures:
        features = embedding.embed(picture)
        assert 0 <= features.min() <= features.max() <= 1 == embedding.bound
        scaled = features.astype(np.float64) * 2**20
        assert np.array_equal(scaled, np.rint(scaled))


def test_the_seed_decides_the_features_and_the_fingerprint_and_global_generators_are_left_alone():
    def states():
        name, keys, *rest = np.random.get_state()  # noqa: NPY002  # the global generator is what is meant
        return [random.getstate(), name, keys.tobytes(), rest, torch.random.get_rng_state().numpy().tobytes()]

    forget_caches()
    before = states()
    made = [Kernels(seed=seed, dimension=dimension) for seed in (0, 1) for dimension in (64, 65)]
    assert len({kernels.fingerprint for kernels in made}) == 4
    assert not np.array_equal(made[0].embed(image(3, 50)), made[2].embed(image(3, 50)))
    assert states() == before


@pytest.mark.parametrize("harm", ["missing", "cut", "changed", "empty", "a folder", "no room", "no home", "none"])
def test_thresholds_that_are_not_kept_or_damaged_are_made_again_to_the_same_features(tmp_path, monkeypatch, harm):
    own, picture = Kernels(seed=77, dimension=64), image(3, 50)
    monkeypatch.setenv("SCROLL_TACTILE_CACHE", str(tmp_path / "cache"))
    forget_caches()
    features = own.embed(picture).tobytes()
    files = sorted((tmp_path / "cache" / "banks").iterdir())
    whole = {file: file.read_bytes() for file in files}
    assert whole
    for file, data in whole.items():
        file.unlink()
        if harm == "a folder":
            file.mkdir()
        elif harm != "missing":
            half = len(data) // 2
            changed = data[:half] + bytes([data[half] ^ 1]) + data[half + 1 :]
            file.write_bytes({"cut": data[:-4], "changed": changed, "empty": b""}.get(harm, data))
    if harm == "no room":
        (tmp_path / "file").write_bytes(b"")
        monkeypatch.setenv("SCROLL_TACTILE_CACHE", str(tmp_path / "file"))
    elif harm == "no home":
        monkeypatch.delenv("SCROLL_TACTILE_CACHE")
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
        monkeypatch.setattr("pathlib.Path.expanduser", lambda path: (_ for _ in ()).throw(RuntimeError("no home")))
    made = []
    monkeypatch.setattr(convolution, "_thresholds", lambda *of, own=convolution._thresholds: made.append(1) or own(*of))
    forget_caches()
    assert own.embed(picture).tobytes() == features
    assert bool(made) == (harm != "none")
    if harm not in ("a folder", "no room", "no home"):
        assert {file: file.read_bytes() for file in files} == whole
        assert sorted((tmp_path / "cache" / "banks").iterdir()) == files  # and no draft
    forget_caches()


@pytest.mark.parametrize("settings", [{"seed": -1}, {"dimension": 63}])
def test_settings_that_make_no_embedding_are_refused(settings):
    with pytest.raises(ValueError, match="came"):
        Kernels(**settings)
