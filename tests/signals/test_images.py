import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scroll_tactile.sensors import BIOTAC, GELSIGHT, Sensor
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import validate


def camera(height, width):
    return Sensor(
        name="eye", channels=height * width * 3, rate=30, low=0, high=255, unit="counts", duration=1,
        layout=(height, width, 3), camera=True,
    )  # fmt: skip


def test_an_image_is_channels_by_time_in_float32():
    readings = np.random.default_rng(0).uniform(0, 255, (40, 19))
    image = tactile_image(validate(readings, BIOTAC))
    assert image.shape == (19, 40)
    assert image.dtype == np.float32
    assert image.flags.c_contiguous
    assert np.allclose(image, readings.T / 127.5 - 1, atol=1e-6)


@given(
    low=st.floats(-(2.0**100), 2.0**100, width=32),
    span=st.floats(1e-30, 1e30),
    seed=st.integers(0, 1000),
)
@settings(max_examples=40, deadline=None)
def test_the_range_maps_onto_minus_one_to_one(low, span, seed):
    high = float(np.float32(low + span))
    if not low < high:
        return
    sensor = Sensor(name="s", channels=2, rate=10, low=low, high=high, unit="N", duration=1)
    share = np.sort(np.random.default_rng(seed).uniform(0, 1, 5))
    values = np.concatenate([[low], low + share * (high - low), [high]])
    image = tactile_image(validate(np.stack([values, values], axis=1), sensor))
    assert image[0, 0] == -1
    assert abs(image[0, -1] - 1) < 1e-6
    assert image.min() >= -1
    assert image.max() <= 1
    assert (np.diff(image[0]) >= 0).all()


def test_a_frame_is_averaged_down_and_scanned_column_by_column():
    frames = np.random.default_rng(1).integers(0, 256, (2, 480, 640, 3), dtype=np.uint8)
    image = tactile_image(validate(frames, GELSIGHT))
    assert image.shape == (360, 320)
    assert image.flags.c_contiguous
    small = frames.astype(float).reshape(2, 120, 4, 160, 4, 3).mean(axis=(2, 4)) / 127.5 - 1
    for frame, row, column, colour in [(0, 0, 0, 0), (1, 119, 159, 2), (1, 7, 30, 1)]:
        assert image[row * 3 + colour, frame * 160 + column] == pytest.approx(
            small[frame, row, column, colour], abs=1e-6
        )


def test_with_a_resting_image_what_is_shown_is_the_difference_from_it():
    frames = np.random.default_rng(5).integers(0, 256, (2, 5, 7, 3)).astype(np.float32)
    rest = np.random.default_rng(6).integers(0, 256, (5, 7, 3)).astype(np.float32)
    image = tactile_image(validate(frames, camera(5, 7)), rest)
    gap = np.clip((frames - rest) / 127.5, -1, 1)
    assert image.dtype == np.float32
    assert np.allclose(image, gap.transpose(1, 3, 0, 2).reshape(15, 14), atol=1e-6)
    assert not tactile_image(validate(rest[None], camera(5, 7)), rest).any()


def shares(length, size):
    """(size, length): the share that each pixel has in each of `size` equal areas."""
    edges = np.arange(size + 1)[:, None] * length / size
    pixels = np.arange(length)
    inside = np.minimum(edges[1:], pixels + 1) - np.maximum(edges[:-1], pixels)
    return np.maximum(inside, 0) * size / length


@pytest.mark.parametrize(("height", "width"), [(5, 7), (121, 161), (239, 160), (120, 333)])
def test_areas_that_divide_pixels_share_them(height, width):
    frame = np.random.default_rng(3).uniform(0, 255, (height, width, 3))
    image = tactile_image(validate(frame[None], camera(height, width)))
    rows, columns = min(height, 120), min(width, 160)
    truth = np.einsum("rh,hwk,cw->rck", shares(height, rows), frame, shares(width, columns), optimize=True)
    assert np.allclose(image, truth.transpose(0, 2, 1).reshape(rows * 3, columns) / 127.5 - 1, atol=1e-6)
