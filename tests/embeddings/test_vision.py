"""The vision embedding: bytes that repeat, windows, normalisation, and its differentiable twin."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from images import image

from scroll_tactile import Vision
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.embeddings.steady import steady
from scroll_tactile.embeddings.vision import pool_windows
from scroll_tactile.errors import InputError

RANDOM = Vision(None, seed=0)


def test_features_are_the_definition():
    """Each stage averaged over rows and columns and scaled to length 1, by NumPy, from the unfolded network."""
    vision, picture = Vision(None, seed=3, stages=(1, 3, 4)), image(19, 60)
    mean, deviation = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    planes = ((np.stack([picture] * 3) + 1) / 2 - mean[:, None, None]) / deviation[:, None, None]
    with torch.no_grad():
        maps = vision.network().net(torch.from_numpy(planes[None].astype(np.float32)))
    parts = [maps[stage][0].double().numpy().mean(axis=(1, 2)) for stage in (1, 3, 4)]
    expected = np.concatenate([part / np.linalg.norm(part) for part in parts])
    assert vision.embed(picture).dtype == np.float32
    assert np.abs(vision.embed(picture) - expected).max() < 1e-6


def test_dimension_is_the_sum_of_the_stages_widths():
    assert RANDOM.dimension == 64 + 128 + 256
    assert Vision(None, seed=0, stages=(4,)).dimension == 512
    with pytest.raises(InputError, match="needs a seed"):
        Vision({}, seed=0)


def test_a_narrow_window_sees_nothing_of_what_comes_later():
    early, late = image(19, 200), image(19, 200)
    late[:, 30:] = 1.0
    windows = {30: [0], 150: [0]}
    one, other = RANDOM.embed_windows(early, windows), RANDOM.embed_windows(late, windows)
    assert one[30].tobytes() == other[30].tobytes()
    assert one[150].tobytes() != other[150].tobytes()


def test_windows_wider_than_the_image_and_of_a_very_long_one():
    row = RANDOM.embed_windows(image(2, 5000), {300: [4000]})[300][0]
    assert row.tobytes() == RANDOM.embed(image(2, 5000)[:, 4000:4300]).tobytes()
    picture = image(19, 60)
    for width in (60, 61, 300):
        assert RANDOM.embed_windows(picture, {width: [0]})[width][0].tobytes() == RANDOM.embed(picture).tobytes()
    short = image(19, 9)
    assert RANDOM.embed_windows(short, {30: [0]})[30][0].tobytes() == RANDOM.embed(short).tobytes()


@settings(max_examples=50, deadline=None)
@given(columns=st.integers(1, 500), shrink=st.integers(1, 32), data=st.data())
def test_a_window_covers_the_columns_of_a_map_that_it_should(columns, shrink, data):
    across = -(-columns // shrink)
    start = data.draw(st.integers(0, columns - 1))
    width = data.draw(st.integers(1, columns))
    place = torch.arange(across, dtype=torch.float64)
    # Planes that say which columns were averaged: their mean place, against ones that keep its length in sight.
    stage = torch.stack([place, torch.ones_like(place)])[None, :, None, :]
    first = int(np.floor(start / columns * across + 1e-12))
    after = max(first + 1, int(np.ceil(min(start + width, columns) / columns * across - 1e-12)))
    assert 0 <= first < after <= across
    pooled = pool_windows([stage], columns, [(start, width)])[0, 0].numpy()
    expected = np.array([np.arange(first, after).mean(), 1.0])
    assert np.allclose(pooled, expected / np.linalg.norm(expected))


def test_the_fingerprint_is_of_all_that_features_depend_on():
    state = ResNet.random(0).state_dict()
    assert RANDOM.fingerprint == Vision(state).fingerprint
    touched = {name: tensor.clone() for name, tensor in state.items()}
    touched["layer4.1.bn2.bias"][0] += 1e-6  # not even used by the default stages
    others = [Vision(touched), Vision(None, seed=0, stages=(1, 2))]
    assert len({one.fingerprint for one in [RANDOM, *others]}) == 3
    assert len(RANDOM.fingerprint) == 64
    int(RANDOM.fingerprint, 16)


def test_the_network_gives_what_the_embedding_gives():
    vision = Vision(None, seed=3, stages=(0, 2, 4))
    pictures = [image(60, 75, seed) for seed in range(2)]
    windows = [(0, 56), (10, 56), (0, 75)]
    batch = torch.from_numpy(np.stack(pictures))
    features = vision.network()(batch, windows)
    assert features.shape == (2, 3, vision.dimension)
    for row, picture in zip(features, pictures, strict=True):
        alone = vision.embed_windows(picture, {56: [0, 10], 75: [0]})
        assert np.abs(row.detach().numpy() - np.concatenate([alone[56], alone[75]])).max() < 1e-4


def test_training_the_network_changes_neither_the_embedding_nor_its_statistics():
    vision, picture = Vision(None, seed=0, stages=(2,)), image(19, 60)
    before, tuned = vision.embed(picture).tobytes(), vision.network()
    mean = tuned.net.bn1.running_mean.clone()
    assert tuned.train().training is False
    optimizer = torch.optim.SGD(tuned.parameters(), lr=0.1)
    for _ in range(2):
        features = tuned(torch.from_numpy(picture)[None].repeat(4, 1, 1), [(0, 60), (0, 48)])
        features[..., 0].sum().backward()
        assert all(torch.isfinite(p.grad).all() for p in tuned.parameters() if p.grad is not None)
        optimizer.step()
    assert torch.equal(tuned.net.bn1.running_mean, mean)
    assert vision.embed(picture).tobytes() == before
    again = Vision(tuned.net.state_dict(), stages=(2,))
    assert (
        np.abs(again.embed(picture) - tuned(torch.from_numpy(picture)[None], [(0, 60)])[0, 0].detach().numpy()).max()
        < 1e-5
    )
    assert again.fingerprint != vision.fingerprint
    assert vision.network().net.conv1.weight.data_ptr() != vision.network().net.conv1.weight.data_ptr()


def test_a_part_without_any_response_stays_zero_and_its_gradients_finite():
    stage = torch.zeros(1, 4, 2, 6, requires_grad=True)
    pooled = pool_windows([stage, stage.detach() + 1], 12, [(0, 12)])
    assert pooled.tolist() == [[[0.0] * 4 + [0.5] * 4]]
    pooled.sum().backward()
    assert torch.isfinite(stage.grad).all()


@pytest.mark.parametrize(
    "wrong",
    [
        {"stages": ()},
        {"stages": (2, 1)},
        {"stages": (1, 1)},
        {"stages": (5,)},
        {"seed": None},
    ],
    ids=str,
)
def test_settings_that_do_not_fit_are_refused(wrong):
    with pytest.raises(InputError, match=r"expected|needs a seed"):
        Vision(None, **({"seed": 0} | wrong))


def test_the_universal_stem_says_what_is_too_small_for_it():
    vision = Vision(ResNet.random(0, "universal").state_dict())
    assert vision.embed(image(3, 3)).shape == vision.embed(image(3, 2)).shape == (448,)
    assert vision.fingerprint
    with pytest.raises(InputError, match="at least 3 channels"):
        vision.embed(image(2, 30))


def test_steady_gives_back_what_it_changed():
    threads, precision = torch.get_num_threads(), torch.get_float32_matmul_precision()
    try:
        torch.set_num_threads(2)
        torch.set_float32_matmul_precision("high")
        with pytest.raises(KeyError), steady():
            assert torch.get_num_threads() == 1
            assert torch.get_float32_matmul_precision() == "highest"
            raise KeyError
        assert (torch.get_num_threads(), torch.get_float32_matmul_precision()) == (2, "high")
    finally:
        torch.set_num_threads(threads)
        torch.set_float32_matmul_precision(precision)
