"""Codes: the grid on which features become integers."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scroll_tactile.statistics.grid import BITS, to_codes


@given(st.lists(st.floats(-1, 1), min_size=1), st.sampled_from([1.0, 2.0, 0.5, 3.0, 100.0]))
def test_a_code_is_the_nearest_integer_on_the_grid(shares, bound):
    features = np.array(shares) * bound
    codes = to_codes(features, bound)
    assert codes.dtype == np.int32
    for code, feature in zip(codes.tolist(), features.tolist(), strict=True):
        exact = Fraction(feature) / Fraction(bound) * 2**BITS
        assert abs(code - exact) <= Fraction(1, 2) + Fraction(1, 10**9)
        assert abs(code) <= 2**BITS


def test_multiples_of_the_grid_are_kept_exactly_and_halves_go_to_even():
    assert to_codes(np.arange(-8, 9) / 8, 1.0).tolist() == [at * 2**17 for at in range(-8, 9)]
    assert to_codes(np.array([0.5, 1.5, 2.5, -0.5]) * 2.0**-BITS, 1.0).tolist() == [0, 2, 2, 0]


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
def test_any_kind_of_float_and_any_shape(kind):
    assert to_codes(np.full((2, 3), 0.25, dtype=kind), 1.0).tolist() == [[2**18] * 3] * 2
    assert to_codes(np.zeros((0, 5), dtype=kind), 1.0).shape == (0, 5)


def test_features_are_left_as_they_were():
    features = np.array([0.3, 0.7])
    features.setflags(write=False)
    to_codes(features, 1.0)
    assert features.tolist() == [0.3, 0.7]
