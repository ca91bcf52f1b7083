"""Shrinkage against its formula in fifty digits."""

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scroll_tactile.readouts.task import LARGEST, LEAST, shrinkage


def textbook(scatter, touches):
    """Chen, Wiesel, Eldar and Hero 2010, equation 23, kept within its bounds."""
    with mpmath.workdps(50):
        s = mpmath.matrix(scatter.tolist())
        width = s.rows
        trace = mpmath.fsum(s[i, i] for i in range(width))
        squares = mpmath.fsum(s[i, j] ** 2 for i in range(width) for j in range(width))
        spread = squares - trace**2 / width
        if not spread:
            return LARGEST
        part = 1 - mpmath.mpf(2) / width
        ratio = (part * squares + trace**2) / ((touches + part) * spread)
        return float(min(max(ratio, LEAST), LARGEST))


def scatter_of(rows, width, seed, size):
    """Of integers, so that no rounding is in it."""
    x = np.random.default_rng(seed).integers(-size, size, (rows, width), endpoint=True).astype(float)
    return x.T @ x


@given(st.integers(1, 12), st.integers(2, 9), st.integers(0, 99), st.sampled_from([3, 1000]), st.integers(1, 10**6))
def test_it_is_the_papers(rows, width, seed, size, touches):
    scatter = scatter_of(rows, width, seed, size)
    expected = textbook(scatter, touches)
    assert shrinkage(scatter, touches) == pytest.approx(expected, rel=1e-9)
    assert shrinkage(scatter * 2.0**40, touches) == shrinkage(scatter, touches)  # of any unit
    assert shrinkage(np.tril(scatter) + np.triu(np.full_like(scatter, np.nan), 1), touches) == shrinkage(
        scatter, touches
    )
    assert LEAST <= expected <= LARGEST


@pytest.mark.parametrize(
    ("scatter", "touches", "expected"),
    [
        (np.zeros((4, 4)), 1, LARGEST),  # no scatter
        (np.array([[9.0]]), 100, LARGEST),  # one feature: it is a multiple of the identity
        (np.eye(6) * 7, 100, LARGEST),
        (np.ones((5, 5)), 1, LARGEST),  # one touch
        (np.ones((5, 5)), 10**9, LEAST),  # equal features, observed for ever
        (np.diag([1.0, 2.0]), 9, textbook(np.diag([1.0, 2.0]), 9)),
    ],
)
def test_where_there_is_nothing_to_choose(scatter, touches, expected):
    assert shrinkage(scatter, touches) == pytest.approx(expected, rel=1e-12)


def test_more_touches_are_drawn_less_to_the_identity_and_a_million_stay_above_the_least():
    rng = np.random.default_rng(0)
    # Of 512 features of a spectrum that falls off, as that of an embedding does.
    spectrum = np.exp(-np.arange(512) / 40.0)
    x = rng.normal(size=(2000, 512)) * np.sqrt(spectrum)
    shares = [shrinkage(x.T @ x, touches) for touches in (1, 10, 100, 1000, 10**4)]
    assert shares == sorted(shares, reverse=True)
    assert LEAST < shares[-1] < shares[0] <= LARGEST
