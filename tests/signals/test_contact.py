"""Which frames of a camera count."""

import numpy as np
import pytest
from scroll_tactile_store import Store

from scroll_tactile import Frames, Kernels, TactileLearner, sensors
from scroll_tactile.embeddings.protocol import require_rest
from scroll_tactile.errors import InputError, MismatchError, NoContactError, StreamError
from scroll_tactile.memory.identity import Identity
from scroll_tactile.recipe import Recipe
from scroll_tactile.signals.contact import MOST_FRAMES, image_of, in_contact, pressed
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import validate
from scroll_tactile.simulation.gel import SMALL, Gel

SHAPE = SMALL.shape
REST = np.full(SHAPE, 100, np.float32)


def stream(*levels):
    """A frame for each level: the gel at rest, and a tenth of it this much brighter."""
    frames = np.full((len(levels), *SHAPE), 100, np.float32)
    for frame, level in zip(frames, levels, strict=True):
        frame[:6] += level
    return validate(frames, SMALL)


def test_frames_that_differ_enough_from_the_first_are_in_contact():
    touch = stream(0, 3, -30, 0, 6)
    assert in_contact(touch, "first").tolist() == [False, False, True, False, True]
    assert in_contact(touch, None).all()
    assert in_contact(touch, REST + 6).tolist() == [True] * 5


def test_one_colour_is_enough_and_a_speck_of_dust_is_not():
    frames = np.full((3, *SHAPE), 100, np.uint8)
    frames[1, :6, :, 2] = 140
    frames[2, :5, :5] = 255
    assert in_contact(validate(frames, SMALL), "first").tolist() == [False, True, False]


def test_kept_are_the_rest_and_the_frames_in_contact():
    touch = stream(0, 0, 20, 1, 40)
    kept = pressed(touch, "first")
    assert kept.readings[:, 0, 0, 0].tolist() == [100, 120, 140]
    assert not kept.readings.flags.writeable
    assert pressed(touch, REST).readings[:, 0, 0, 0].tolist() == [120, 140]
    assert pressed(touch, None) is touch


def test_what_frames_in_contact_missed_is_still_known():
    frames = stream(0, 0, 20, 1, 40).readings.copy()
    frames[2, 3, 3, 0] = np.nan
    kept = pressed(validate(frames, SMALL.model_copy(update={"non_finite": "missing"})), "first")
    assert np.argwhere(kept.mask).tolist() == [[1, 3, 3, 0]]


@pytest.mark.parametrize("rest", ["first", REST, None], ids=["first", "given", "none"])
def test_what_is_kept_is_kept_again(rest):
    kept = pressed(stream(0, *[20, 0, 30] * 60), rest)
    assert pressed(kept, rest) == kept
    if rest is not None:
        assert len(kept) == MOST_FRAMES + (rest is not REST)
        assert len(pressed(stream(0, *[20] * (MOST_FRAMES + 1)), rest)) == len(kept)


def test_the_image_is_the_difference_from_the_rest():
    touch = pressed(stream(0, 20, 0, 40), "first")
    image = image_of(touch, "first")
    assert image.shape == (180, 160)
    assert image[:18, :80] == pytest.approx(20 / 127.5)
    assert image[:18, 80:] == pytest.approx(40 / 127.5)
    assert not image[18:].any()
    assert np.array_equal(image, image_of(pressed(stream(0, 20, 0, 40), REST), REST))
    assert np.array_equal(image_of(touch, None), tactile_image(touch))


@pytest.mark.parametrize("touch", [stream(0), stream(0, 0, 0), stream(50, 51, 50), Gel().touch("mesh", 0, force=0)])
def test_a_stream_without_contact_is_refused(touch):
    with pytest.raises(NoContactError, match=r"of \d none differs from the resting image, the first of them, by 2%"):
        pressed(touch, "first")
    assert issubclass(NoContactError, StreamError)
    with pytest.raises(NoContactError, match="the one given"):
        pressed(touch, touch.readings[0])


def test_the_resting_image_and_the_embedding_have_to_be_the_sensors():
    require_rest(Frames(rest=REST), SMALL)
    require_rest(Kernels(), SMALL)
    with pytest.raises(InputError, match=r"expected a resting image of sensor 'gelsight' of shape \(480, 640, 3\)"):
        require_rest(Frames(rest=REST), sensors.GELSIGHT)
    with pytest.raises(InputError, match="reads a camera's frames, and sensor 'biotac' has 19 channels"):
        require_rest(Frames(), sensors.BIOTAC)


def test_an_embedding_that_cannot_read_the_sensor_leaves_no_memory_behind(tmp_path):
    for sensor, embedding in ((sensors.BIOTAC, Frames()), (sensors.GELSIGHT, Frames(rest=REST))):
        with pytest.raises(InputError):
            TactileLearner.open(tmp_path / sensor.name, sensor=sensor, embedding=embedding)
        assert not (tmp_path / sensor.name).exists()


def test_a_cameras_memory_says_that_its_windows_are_frames_and_one_that_does_not_is_refused(tmp_path):
    identity = Identity.of(Recipe.of(SMALL, Kernels(dimension=64))).to_json()
    assert identity["grid"]["frames"] is True
    assert Identity.of(Recipe.of(sensors.BIOTAC, Kernels(dimension=64))).grid.frames is False
    identity["grid"]["frames"] = False
    Store.open(tmp_path / "other", identity=identity).close()
    with pytest.raises(MismatchError, match="was made with"):
        TactileLearner.open(tmp_path / "other", sensor=SMALL, embedding=Kernels(dimension=64))
