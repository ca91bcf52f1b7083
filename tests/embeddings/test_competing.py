"""Competing kernels: counts that a loop over kernels and steps of time gives, too."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from images import image
from touches import PAD

from scroll_tactile import Kernels, TactileLearner
from scroll_tactile.embeddings.convolution import (
    GROUP,
    HEAVY,
    LEVELS,
    MOST_CHANNELS,
    TAPS,
    WEIGHT,
    bank,
    competing_counts,
    competing_groups,
    to_levels,
)
from scroll_tactile.embeddings.joined import Joined
from scroll_tactile.embeddings.kernels import _dilations, groups_by_dilation
from scroll_tactile.errors import EmbeddingError

SMALL = Kernels(dimension=64)


def responses(channels, row, dilation, levels):
    """The responses of one kernel, by its definition: six taps of −1 and three of 2 on a sum of channels."""
    summed = channels[row].astype(np.int64) @ levels
    weights = np.full(TAPS, -1)
    weights[list(HEAVY[row % len(HEAVY)])] = 2
    steps = range(len(summed) - (TAPS - 1) * dilation)
    return np.array([weights @ summed[step : step + TAPS * dilation : dilation][:TAPS] for step in steps])


def proportions(embedding, whole, width):
    """What `embed_competing` has to give for an image (C, T): by kernels one by one."""
    levels, features = to_levels(whole).astype(np.int64), []
    dilations = _dilations(width)
    for dilation, number in zip(dilations, groups_by_dilation(embedding.dimension, len(dilations)), strict=True):
        if not number:
            continue
        own = bank(embedding.seed, len(whole), dilation)
        of, most, least = competing_groups(own, number), [], []
        for group in own.rows[of.members]:
            sizes = own.channels[group].sum(axis=1)
            weights = [round(WEIGHT / float(size) ** 0.5) for size in sizes]
            all_of_group = [
                weight * responses(own.channels, row, dilation, levels)
                for row, weight in zip(group.tolist(), weights, strict=True)
            ]
            for one in all_of_group:
                best, worst = np.max(all_of_group, axis=0), np.min(all_of_group, axis=0)
                most.append(np.mean((one == best) & (best > 0)))
                least.append(np.mean((one == worst) & (worst < 0)))
        features += most + least
    return np.arcsin(np.sqrt(features)) * (2 / np.pi)


@settings(max_examples=8, deadline=None)
@given(channels=st.integers(1, 70), width=st.integers(12, 90), short=st.floats(0.7, 1))
def test_features_are_counts_of_the_steps_at_which_a_kernel_responds_most(channels, width, short):
    whole = image(channels, max(12, int(short * width)))
    _, competing = SMALL.embed_competing(whole, {}, width)
    np.testing.assert_allclose(competing, proportions(SMALL, whole, width), atol=2.0**-20)


@settings(max_examples=8, deadline=None)
@given(channels=st.integers(1, 40), columns=st.integers(1, 200), wider=st.integers(0, 150), data=st.data())
def test_windows_beside_it_are_read_as_without_it(channels, columns, wider, data):
    whole, width = image(channels, columns), columns + wider
    widths = data.draw(st.lists(st.integers(1, columns), max_size=3, unique=True))
    windows = {w: data.draw(st.lists(st.integers(0, columns - w), min_size=1, max_size=3)) for w in widths}
    together, competing = SMALL.embed_competing(whole, windows, width)
    alone = SMALL.embed_windows(whole, windows)
    assert {w: rows.tobytes() for w, rows in together.items()} == {w: rows.tobytes() for w, rows in alone.items()}
    assert competing.tobytes() == SMALL.embed_competing(whole, {}, width)[1].tobytes()
    assert competing.shape == (64,) and competing.min() >= 0 and competing.max() <= 1


@pytest.mark.parametrize("dimension", [65, 1008, 2016])
def test_any_dimension_and_zeros_behind_the_last_group(dimension):
    assert [len(Kernels(dimension=dimension).embed(image(3, columns))) for columns in (1, 40)] == [dimension] * 2
    competing = Kernels(dimension=dimension).embed_competing(image(3, 100), {}, 100)[1]
    assert competing.shape == (dimension,)
    used = dimension // (2 * GROUP) * 2 * GROUP
    assert competing[:used].any()
    assert not competing[used:].any()


def test_kernels_that_share_a_place_both_have_it_and_nobody_has_a_flat_one():
    own = bank(1, 2, 1)
    of = competing_groups(own, 2)
    flat = np.zeros((len(own.channels), 10), np.float32)
    assert not competing_counts(flat, own, of).any()
    alike = 1 / of.weights[0, :2, None].astype(np.float32)
    flat[own.rows[of.members[0, :2]]] = alike  # two of the first group, alike once they are weighed
    assert competing_counts(flat, own, of)[0, 0].tolist() == [10, 10, 0, 0, 0, 0, 0, 0]


def test_weighed_responses_are_exact_in_float32():
    most = [size * round(WEIGHT / size**0.5) for size in range(1, MOST_CHANNELS + 1)]
    assert max(most) * 12 * LEVELS < 2**24


def test_every_kernel_of_a_bank_competes_before_any_does_again():
    own = bank(1, 5, 8)
    of = competing_groups(own, 2 * len(own) // GROUP)
    once = of.members.ravel()[: len(own)]
    assert sorted(once.tolist()) == list(range(len(own)))


def test_joined_embeddings_compete_each_by_itself():
    parts = Kernels(dimension=64), Kernels(seed=2, dimension=80)
    whole, windows = image(3, 60), {20: [0, 30]}
    features, competing = Joined(*parts).embed_competing(whole, windows, 60)
    assert competing.tolist() == [*(v for part in parts for v in part.embed_competing(whole, {}, 60)[1].tolist())]
    assert features[20].tobytes() == Joined(*parts).embed_windows(whole, windows)[20].tobytes()


def test_competing_features_of_another_shape_are_refused():
    class Short(Kernels):
        capabilities = dataclasses.replace(Kernels.capabilities)

        def embed_competing(self, image, windows, width):
            features, competing = super().embed_competing(image, windows, width)
            return features, competing[1:]

    learner = TactileLearner(sensor=PAD, embedding=Short(dimension=64))
    with pytest.raises(
        EmbeddingError, match=r"'kernels' .* expected features of shape \(64,\) of all, by competing .*; came \(63,\)"
    ):
        learner.observe("felt", np.linspace([0.0, 1.0], [1.0, 0.0], 50))
