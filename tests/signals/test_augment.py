"""Each augmentation is a change in how the touch was made; together they are a function of image and generator."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from scroll_tactile.signals.augmentation import Augmentation, Change, crop, fit, flip, jitter, resize

few = settings(max_examples=40, deadline=None)
images = hnp.arrays(
    np.float32, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12), elements=st.floats(-1, 1, width=32)
)
changes = st.builds(
    Change,
    flip=st.booleans(),
    speed=st.floats(0.3, 3),
    keep=st.floats(0.1, 1),
    place=st.floats(0, 1),
    noise=st.floats(0, 2),
    drift=st.floats(0, 2),
    seed=st.integers(0, 2**63 - 1),
)
RAMP = np.linspace(-1, 1, 21, dtype=np.float32)[None].repeat(2, axis=0)


def sound(image):
    return image.dtype == np.float32 and image.flags.c_contiguous and bool((np.abs(image) <= 1).all())


@few
@given(images)
def test_flipped_twice_is_as_it_was_and_channels_stay(image):
    assert flip(flip(image)).tobytes() == image.tobytes()
    assert flip(image)[:, 0].tolist() == image[:, -1].tolist()
    assert sound(flip(image))


@few
@given(images, st.floats(0.05, 20))
def test_resized_has_its_ends_its_range_and_its_columns(image, factor):
    resized = resize(image, factor)
    assert resized.shape == (len(image), max(1, round(image.shape[1] * factor)))
    assert resized[:, 0].tolist() == image[:, 0].tolist()
    if resized.shape[1] > 1:
        np.testing.assert_allclose(resized[:, -1], image[:, -1], rtol=0, atol=1e-6)
    assert (resized.min(axis=1) >= image.min(axis=1) - 1e-6).all()
    assert (resized.max(axis=1) <= image.max(axis=1) + 1e-6).all()
    assert resize(image, 1).tolist() == image.tolist()
    line = resize(RAMP, factor)[0]
    np.testing.assert_allclose(line, np.linspace(-1, 1, len(line)) if len(line) > 1 else [-1], atol=1e-6)


def test_cropped_is_the_stretch_asked_for_and_fitted_goes_on_as_its_mirror_image():
    image = np.array([[0, 0.5, 1]], np.float32)
    assert crop(image, 1, 2).tolist() == [[0.5, 1]]
    assert fit(image, 2).tolist() == [[0, 0.5]]
    assert fit(image, 8).tolist() == [[0, 0.5, 1, 1, 0.5, 0, 0, 0.5]]
    assert fit(image[:, :1], 4).tolist() == [[0] * 4]


def test_jitter_adds_noise_and_a_slow_offset_and_stays_in_range():
    image, nothing = np.zeros((2, 9), np.float32), np.zeros((2, 9), np.float32)
    slow = jitter(image, nothing, np.array([[-0.5, 0.5], [0.25, 0.25]], np.float32))
    assert slow[0].tolist() == np.linspace(-0.5, 0.5, 9).tolist()
    assert slow[1].tolist() == [0.25] * 9
    assert jitter(image, nothing + 3, np.full((2, 1), -1, np.float32)).tolist() == [[1] * 9] * 2
    assert jitter(image, nothing, np.zeros((2, 3), np.float32)).tolist() == image.tolist()


@few
@given(images, changes, st.none() | st.integers(1, 30))
def test_a_change_gives_a_tactile_image_and_always_the_same(image, change, columns):
    before = image.tobytes()
    changed = change.apply(image, columns)
    assert sound(changed)
    assert len(changed) == len(image)
    assert columns is None or changed.shape[1] == columns
    assert change.apply(image, columns).tobytes() == changed.tobytes()
    assert image.tobytes() == before
    assert not np.shares_memory(changed, image)
    assert Change().apply(image).tolist() == image.tolist()
    assert Augmentation(0, (1, 1), 1, 0, 0).augment(image, np.random.default_rng(0)).tolist() == image.tolist()


def test_draws_spread_over_what_is_allowed():
    rng = np.random.default_rng(0)
    for change in [Augmentation(0.5, (0.5, 4), 0.6, 0.3, 0.2).draw(rng) for _ in range(100)]:
        assert 0.5 <= change.speed <= 4.000001
        assert (0.6 <= change.keep <= 1, 0 <= change.noise <= 0.3, 0 <= change.drift <= 0.2) == (True,) * 3
    drawn = [Augmentation().draw(rng) for _ in range(400)]
    assert 0.4 < np.mean([change.flip for change in drawn]) < 0.6
    assert 0.45 < np.mean([change.speed > 1 for change in drawn]) < 0.55
    assert min(change.keep for change in drawn) < 0.81
    assert len({change.seed for change in drawn}) == 400


def test_strengths_do_not_change_what_is_drawn_after():
    weak, strong = np.random.default_rng(3), np.random.default_rng(3)
    Augmentation(0, (1, 1), 1, 0, 0).augment(RAMP, weak)
    Augmentation(1, (0.1, 9), 0.1, 1, 1).augment(RAMP, strong)
    assert weak.random() == strong.random()


def test_by_default_touches_change_and_only_by_the_generator_given():
    state = np.random.get_state()[1].tobytes()  # noqa: NPY002 - it is the one that must not be drawn from
    rng = np.random.default_rng(0)
    first, second = (Augmentation().augment(RAMP, rng, steps=40) for _ in range(2))
    assert first.shape == second.shape == (2, 40)
    assert first.tobytes() != second.tobytes()
    assert Augmentation().augment(RAMP, np.random.default_rng(0), steps=40).tobytes() == first.tobytes()
    assert np.random.get_state()[1].tobytes() == state  # noqa: NPY002


@few
@given(hnp.arrays(np.float32, (3, 2, 9), elements=st.floats(-1, 1, width=32)), st.floats(0.2, 4), st.integers(1, 20))
def test_a_batch_is_changed_as_each_of_it(batch, factor, columns):
    noise = np.linspace(-0.2, 0.2, batch.size, dtype=np.float32).reshape(batch.shape)
    drift = noise[..., :4]
    both = (
        (flip(batch), [flip(one) for one in batch]),
        (resize(batch, factor), [resize(one, factor) for one in batch]),
        (crop(batch, 2, 5), [crop(one, 2, 5) for one in batch]),
        (fit(batch, columns), [fit(one, columns) for one in batch]),
        (jitter(batch, noise, drift), [jitter(*parts) for parts in zip(batch, noise, drift, strict=True)]),
    )
    for together, apart in both:
        assert together.tobytes() == np.stack(apart).tobytes()
    assert sound(Change(flip=True, speed=factor, keep=0.5, noise=0.1, drift=0.1).apply(batch, columns))
