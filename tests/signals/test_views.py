"""Views of a whole touch: the same bits whatever the order, the offset, the machine."""

import itertools
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scroll_tactile.signals.image import shape_image, stretched

few = settings(max_examples=40, deadline=None)
UNIT = 2**20  # steps of half the range: what the values below are whole numbers of
values = st.integers(-UNIT, UNIT)


@st.composite
def images(draw, channels=3, columns=40, value=values):
    """Whole numbers of steps, shape (C, T)."""
    shape = draw(st.integers(1, channels)), draw(st.integers(1, columns))
    return np.array(draw(st.lists(value, min_size=shape[0] * shape[1], max_size=shape[0] * shape[1]))).reshape(shape)


def image_of(steps):
    return (steps / UNIT).astype(np.float32)


def companded(steps):
    """What is smaller than the knee grows in proportion, and from each doubling of 1 + |x| / knee to the next by one;
    2 is at 1."""

    def grown(size):
        power = 0
        while size >= 2 ** (power + 1):
            power += 1
        return power + size / 2**power - 1

    size = 1 + abs(Fraction(steps, UNIT)) * 128
    share = grown(size) / grown(Fraction(257))
    return np.float32(float(share if steps >= 0 else -share))


@few
@given(images())
def test_the_shape_is_changes_and_deviations_from_the_mean_companded(steps):
    found = shape_image(image_of(steps))
    assert found.dtype == np.float32
    rows = [row.tolist() for row in steps]
    changes = [[0, *(after - before for before, after in itertools.pairwise(row))] for row in rows]
    means = [Fraction(sum(row), len(row)) + Fraction(1, 2) for row in rows]
    deviations = [[value - mean.__floor__() for value in row] for row, mean in zip(rows, means, strict=True)]
    expected = np.array([[companded(value) for value in row] for row in changes + deviations])
    np.testing.assert_allclose(found, expected, rtol=3e-7, atol=0)


@few
@given(images(value=st.integers(-UNIT // 2, UNIT // 2)), st.integers(-UNIT // 2, UNIT // 2))
def test_an_offset_changes_no_bit(steps, offset):
    assert shape_image(image_of(steps)).tobytes() == shape_image(image_of(steps + offset)).tobytes()


@few
@given(images(columns=60), st.randoms(use_true_random=False))
def test_no_order_changes_a_bit(steps, random):
    """Of channels, of columns for the deviations, or of the array in memory: sums are of integers."""
    image, channels = image_of(steps), len(steps)
    whole = shape_image(image)
    by_channel = [shape_image(image[[i]]) for i in range(channels)]
    for i, alone in enumerate(by_channel):
        assert alone.tobytes() == whole[[i, channels + i]].tobytes()
    order = list(range(image.shape[1]))
    random.shuffle(order)
    assert shape_image(image[:, order])[channels:].tobytes() == whole[channels:, order].tobytes()
    assert shape_image(np.asfortranarray(image)).tobytes() == whole.tobytes()
    back = shape_image(-image[:, ::-1])  # changes and deviations of the mirror image, but where the mean is a half
    np.testing.assert_allclose(back[channels:], -whole[channels:, ::-1], atol=3e-5)


@pytest.mark.parametrize("columns", [2, 1023, 1024])
def test_large_values_are_summed_exactly(columns):
    """The sum of a thousand of them does not fit a float32."""
    steps = np.full((1, columns), UNIT)
    steps[0, 0] -= columns * 3
    deviations = shape_image(image_of(steps))[1]
    assert deviations[1:].tolist() == [companded(3)] * (columns - 1)
    assert deviations[0] == companded(3 - columns * 3)


def test_it_lies_between_minus_one_and_one_and_reaches_both():
    for level, columns in ((-1.0, 1), (0.3, 2), (1.0, 400)):  # of a constant touch there is nothing
        assert not shape_image(np.full((3, columns), level, np.float32)).any()
    found = shape_image(np.array([[-1, 1, -1]], np.float32))
    assert (found[0].tolist(), np.abs(found).max()) == ([0, 1, -1], 1)


class TestStretched:
    @pytest.mark.parametrize("columns", [1, 2, 9, 400, 1024])
    @pytest.mark.parametrize("of", [1, 2, 3, 100, 1023, 5000])
    def test_it_is_linear_interpolation_between_the_first_column_and_the_last(self, of, columns):
        image = np.random.default_rng(of).uniform(-1, 1, (3, of)).astype(np.float32)
        found = stretched(image, columns)
        assert (found.shape, found.dtype) == ((3, columns), np.float32)
        places = np.linspace(0, of - 1, columns)
        expected = [np.interp(places, np.arange(of), row) for row in image]
        np.testing.assert_allclose(found, expected, atol=1e-6)
        assert found[:, 0].tobytes() == image[:, 0].tobytes()
        if columns > 1:
            assert found[:, -1].tobytes() == image[:, -1].tobytes()
        assert np.abs(found).max() <= np.abs(image).max()
