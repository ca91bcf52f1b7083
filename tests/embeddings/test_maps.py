"""Maps: where a touch is observed, and in what order."""

import numpy as np
import pytest

from examples.paper.transfer.maps import Maps
from scroll_tactile.errors import InputError


def pressed(places, columns=60, layout=(6, 7)):
    """A press that comes on at once at some places of a grid."""
    image = np.full((*layout, columns), -1.0, dtype=np.float32)
    for (row, column), force in places.items():
        image[row, column, 10:] = 2 * force - 1
    return image.reshape(-1, columns)


def test_parts_are_means_in_their_order():
    image = np.arange(20, dtype=np.float32).reshape(2, 10) / 20
    features = Maps(layout=(2,), parts=5).embed(image).reshape(5, 2)
    np.testing.assert_allclose(features, image.reshape(2, 5, 2).mean(axis=2).T, atol=1e-7)
    assert not Maps(layout=(6, 7), parts=2).embed(pressed({})).any()
    short = Maps(layout=(2,), parts=5).embed(image[:, :2])  # fewer readings than parts: some are observed twice
    assert set(short.tolist()) <= set(image[:, :2].ravel().tolist())


@pytest.mark.parametrize("view", ["corner", "centre"])
def test_a_shape_is_the_same_a_taxel_further_on(view):
    shape = {(1, 1): 0.9, (1, 3): 0.5, (2, 2): 0.7}
    further = {(row + 1, column + 2): force for (row, column), force in shape.items()}
    maps = Maps(layout=(6, 7), parts=2, views=[view])
    here, there = maps.embed(pressed(shape)), maps.embed(pressed(further))
    np.testing.assert_allclose(here, there, atol=1e-3)
    lies = Maps(layout=(6, 7), parts=2, views=["as-felt"])
    assert np.abs(lies.embed(pressed(shape)) - lies.embed(pressed(further))).max() > 0.3


def test_cosines_are_seeded_and_near_for_near_touches():
    image, near = pressed({(2, 2): 0.9}), pressed({(2, 2): 0.85})
    far = pressed({(5, 6): 0.9, (0, 0): 0.9})
    maps = Maps(layout=(6, 7), cosines=512, seed=3)
    assert np.array_equal(maps.embed(image), Maps(layout=(6, 7), cosines=512, seed=3).embed(image))
    other = Maps(layout=(6, 7), cosines=512, seed=4)
    assert maps.fingerprint != other.fingerprint
    assert not np.array_equal(maps.embed(image), other.embed(image))
    alike, unlike = (np.square(maps.embed(image) - maps.embed(one)).mean() for one in (near, far))
    assert alike < unlike / 10


@pytest.mark.parametrize(
    "settings",
    [
        {"layout": ()},
        {"layout": (2, 3, 4)},
        {"layout": (0, 3)},
        {"layout": (4,), "parts": 0},
        {"layout": (4,), "cosines": -1},
        {"layout": (4,), "reach": 0.0},
        {"layout": (4, 4), "views": []},
        {"layout": (4, 4), "views": ["edge"]},
        {"layout": (4, 4), "cosines": 2},
    ],
)
def test_settings_that_cannot_be_are_refused(settings):
    with pytest.raises(InputError):
        Maps(**settings)
    with pytest.raises(InputError, match=r"shape \(42, T\); came \(41, 9\)"):
        Maps(layout=(6, 7)).embed(np.zeros((41, 9), np.float32))


def test_cosines_fall_off_with_the_sum_of_differences():
    maps = Maps(layout=(3,), parts=1, cosines=4000, reach=0.5)
    near, far = (np.array([[x], [0.2], [-0.4]], np.float32) for x in (0.1, 0.6))
    product = 2 * (maps.embed(near) * maps.embed(far)).mean()
    assert product == pytest.approx(np.exp(-1), abs=0.03)
