"""Perturbations change a stream as they say, by a seed and its content alone."""

import numpy as np
import pytest
from paper_touches import PAD

from examples.paper.studies.baselines import _copies
from examples.paper.studies.perturbations import changed, dead, drift, gaussian, length, noise, speed
from scroll_tactile import sensors
from scroll_tactile.errors import InputError, StreamTooShortError
from scroll_tactile.signals.augmentation import Augmentation, flip, resize
from scroll_tactile.signals.stream import fewest_readings, validate

DRAWN = (noise, gaussian, dead, drift)


def touch(seed=0, readings=100):
    return validate(np.random.default_rng(seed).uniform(1, 3, size=(readings, 10)), PAD)


@pytest.mark.parametrize("perturb", DRAWN)
def test_what_is_drawn_depends_on_the_seed_and_the_content_alone(perturb):
    first, second = touch(0), touch(1)
    before = second.readings.tobytes()
    alone = perturb(second, 0.3, 7)
    perturb(first, 0.3, 7)
    assert perturb(second, 0.3, 7) == alone
    assert perturb(second, 0.3, 8) != alone != perturb(first, 0.3, 7)
    assert perturb(second, 0.0, 7) is second
    changed = perturb(second, 1.0, 0)
    assert (changed.sensor, len(changed), changed.clipped) == (PAD, 100, 0)
    assert changed.readings.min() >= -2 and changed.readings.max() <= 6
    assert second.readings.tobytes() == before
    for strength in (-0.1, np.nan, np.inf):
        with pytest.raises(InputError):
            perturb(second, strength, 0)


def test_noise_is_as_wide_as_it_says_and_gaussian_noise_has_its_energy():
    stream = validate(np.full((2000, 10), 2.0), PAD)
    added, tailed = (perturb(stream, 0.25, 0).readings - 2 for perturb in (noise, gaussian))
    assert 1.98 < np.abs(added).max() <= 2.001  # a quarter of the range of 8
    assert abs(added.std() - 2 / 3**0.5) < 0.02 and abs(added.std() - tailed.std()) < 0.03
    assert np.abs(tailed).max() > 3.9  # has tails, of a range of 8 about the middle
    for perturb in (noise, gaussian):
        loud = perturb(stream, 1.0, 0).readings
        assert (loud.min(), loud.max()) == (-2, 6)


def test_dead_channels_read_the_low_end_and_the_others_as_before():
    stream = touch()
    changed = dead(stream, 0.3, 0).readings
    gone = (changed == -2).all(axis=0)
    assert gone.sum() == 3
    np.testing.assert_allclose(changed[:, ~gone], stream.readings[:, ~gone], atol=1e-5)
    assert (dead(stream, 1.0, 0).readings == -2).all()
    with pytest.raises(InputError, match=r"0 to 1; came 1\.5"):
        dead(stream, 1.5, 0)


def test_drift_grows_from_nothing():
    stream = touch()
    off = np.abs(drift(stream, 0.1, 0).readings - stream.readings)
    np.testing.assert_allclose(off[0], 0, atol=1e-5)
    assert off[-20:].mean() > 3 * off[:20].mean()
    assert off.max() <= 0.1 * 8 + 0.1 * 5 + 1e-5  # of the range, and of what lies above the low end


@pytest.mark.parametrize(("factor", "readings"), [(0.25, 400), (0.5, 200), (2, 50), (4, 25), (100, 2)])
def test_faster_is_shorter_between_the_same_ends(factor, readings):
    ramp = validate(np.linspace(0, 4, 100)[:, None].repeat(10, axis=1), PAD)
    changed = speed(ramp, factor)
    np.testing.assert_allclose(changed.readings[:, 0], np.linspace(0, 4, readings), atol=1e-5)


def test_speed_one_and_the_whole_length_are_the_touch_itself():
    stream = touch()
    assert speed(stream, 1.0) is stream
    assert length(stream, 2.0) is stream
    assert length(stream, 0.3) == stream.first(0.3)


def test_what_cannot_be_is_refused():
    for factor in (0, -1, np.nan):
        with pytest.raises(InputError, match="above 0"):
            speed(touch(), factor)
    with pytest.raises(StreamTooShortError):
        length(touch(), 0.01)
    frame = validate(np.zeros((1, *sensors.GELSIGHT.shape)), sensors.GELSIGHT)
    with pytest.raises(InputError, match="whole frames"):
        noise(frame, 0.5, 0)


def test_what_is_changed_is_the_image_of_a_stream():
    stream = touch()
    assert changed(stream, flip).readings[0].tolist() == pytest.approx(stream.readings[-1].tolist())
    assert len(changed(stream, lambda image: resize(image, 0.5))) == len(stream) // 2
    camera = PAD.model_copy(update={"name": "cam", "channels": 192, "layout": (8, 8, 3), "camera": True})
    with pytest.raises(InputError, match="camera 'cam' takes whole frames"):
        changed(validate(np.zeros((5, 8, 8, 3)), camera), flip)


def test_copies_for_baselines_differ_and_are_never_too_short_to_be_streams():
    streams = [("felt", touch(i)) for i in range(3)]
    made, again = (_copies(streams, Augmentation(), 5) for _ in range(2))
    assert made == again and len({len(stream) for _, stream in made}) > 1
    short = Augmentation(0, (0.02, 0.02), keep=0.1)
    assert {len(stream) for _, stream in _copies(streams, short, 0)} == {fewest_readings(PAD)}
