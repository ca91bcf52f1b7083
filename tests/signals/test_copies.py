"""Copies are a function of the touch, and a memory of touches with copies is as exact as one without."""

import numpy as np
import pytest
from touches import PAD, SMALL, contents, stream
from touches import SETTINGS as USUAL

from scroll_tactile import Augmented, TactileLearner, sensors
from scroll_tactile.errors import InputError, MismatchError
from scroll_tactile.signals.copies import hiss, silence, wander
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import validate

THREE = Augmented(copies=3, dead=0.3, offset=0.05, gain=0.2)
NOISY = Augmented(copies=2, noisy=3, noise=0.5)
SETTINGS = USUAL | {"augmentation": THREE}
FELT = [(name, (seed, readings)) for seed, readings in enumerate((60, 25, 90)) for name in "ab"]
RAMP = np.linspace(-1, 1, 60, dtype=np.float32).reshape(3, 20)


def both(augmentation, image, key):
    copies, noisy = augmentation.copies_of(image, key)
    return [*copies, *noisy]


def fed(felt, **settings):
    learner = TactileLearner(**SETTINGS | settings)
    for name, touch in felt:
        learner.observe(name, stream(touch))
    return learner


def filled(path, felt=FELT, **settings):
    learner = TactileLearner.open(path, **SETTINGS | settings)
    return learner, [learner.observe(name, stream(touch)) for name, touch in felt]


class TestCopies:
    def test_they_are_a_function_of_the_touch(self):
        one, other = (validate(stream((seed, 60)), PAD) for seed in (0, 1))
        image = tactile_image(one)
        first, again = (both(THREE, image, one.key) for _ in range(2))
        assert [copy.tobytes() for copy in first] == [copy.tobytes() for copy in again]
        assert len({copy.tobytes() for copy in first}) == 3
        assert first[0].tobytes() != both(THREE, image, other.key)[0].tobytes()

    def test_they_neither_touch_the_image_nor_a_global_generator(self):
        image, before = RAMP.copy(), np.random.get_state()[1].tobytes()  # noqa: NPY002
        THREE.copies_of(image, b"key")
        assert image.tobytes() == RAMP.tobytes()
        assert np.random.get_state()[1].tobytes() == before  # noqa: NPY002

    @pytest.mark.parametrize("columns", [1, 2, 5, 400])
    def test_they_are_sound_images_no_longer_than_the_touch(self, columns):
        image = np.linspace(-1, 1, 2 * columns, dtype=np.float32).reshape(2, columns)
        strong = Augmented(copies=4, speed=4, dead=0.9, offset=1, gain=1, noisy=2)
        for seed in range(20):
            for copy in both(strong, image, bytes([seed])):
                assert copy.dtype == np.float32
                assert copy.flags.c_contiguous
                assert len(copy) == 2
                assert 1 <= copy.shape[1] <= columns
                assert np.abs(copy).max() <= 1

    def test_without_any_strength_a_copy_is_the_touch(self):
        plain = Augmented(copies=2, speed=1, noisy=1, noise=0)
        assert [copy.tobytes() for copy in both(plain, RAMP, b"key")] == [RAMP.tobytes()] * 3

    def test_the_fastest_is_thinned_and_the_others_are_as_without(self):
        settings = {"copies": 3, "speed": 3.5, "dead": 0.5, "noisy": 2}
        thinned, plain = (both(Augmented(**settings, thinned=one), RAMP, b"key") for one in (True, False))
        assert [one.tobytes() for one in thinned[:2] + thinned[3:]] == [one.tobytes() for one in plain[:2] + plain[3:]]
        heard = (thinned[2] != -1).any(axis=1)
        assert thinned[2][heard].tobytes() == RAMP[heard, ::3].tobytes()
        assert both(Augmented(copies=1, thinned=True), RAMP[:, :3], b"key")[0].shape == (3, 3)  # of which no two can go

    def test_memories_from_before_there_were_thinned_copies_are_of_the_same_making(self):
        assert "thinned" not in Augmented().to_json()
        assert Augmented(**Augmented(thinned=True).to_json()).thinned

    def test_noise_fills_its_amplitude_and_the_range_ends_it(self):
        noise = hiss(np.zeros((4, 2000), np.float32), 0.25, np.random.default_rng(0))
        assert 0.49 < noise.max() <= 0.5
        assert -0.5 <= noise.min() < -0.49
        assert abs(noise.mean()) < 0.02
        assert hiss(np.full((1, 500), 1, np.float32), 1, np.random.default_rng(0)).max() == 1

    def test_broken_wires_read_the_low_end_and_the_others_what_they_did(self):
        image = np.zeros((10, 5), np.float32)
        silent = silence(image, 0.3, np.random.default_rng(0))
        assert sorted(set(map(tuple, silent.tolist()))) == [(-1.0,) * 5, (0.0,) * 5]
        assert (silent[:, 0] == -1).sum() == 3

    def test_drift_begins_with_nothing(self):
        wandered = wander(RAMP, 0.1, 0.3, np.random.default_rng(0))
        np.testing.assert_array_equal(wandered[:, 0], RAMP[:, 0])
        assert 0.05 < np.abs(wandered[:, -1] - RAMP[:, -1]).max() <= 2 * 0.1 + 2 * 0.3

    @pytest.mark.parametrize(
        "wrong",
        [
            {"copies": 0},
            {"copies": True},
            {"noisy": -1},
            {"speed": 0.5},
            {"dead": 1.0},
            {"noise": -1},
            {"gain": np.nan},
            {"thinned": True, "speed": 1.9},
            {"thinned": True, "copies": 0, "noisy": 1},
        ],
    )
    def test_strengths_that_cannot_be_are_refused(self, wrong):
        with pytest.raises(InputError, match=r"expected .*; came "):
            Augmented(**wrong)


class TestAugmentedObservation:
    def test_a_touch_counts_once_and_its_copies_are_learned_from(self):
        augmented, plain = fed(FELT), fed(FELT, augmentation=None)
        assert augmented.materials == plain.materials == {"a": 3, "b": 3}
        assert augmented.digest() != plain.digest()
        own = [touch.rows.tobytes() for *_, touch in plain.memory.sample]
        assert [touch.rows.tobytes() for *_, touch in augmented.memory.sample] == own

    def test_closed_killed_and_opened_again(self, tmp_path):
        learner, _ = filled(tmp_path / "m")
        with TactileLearner.open(tmp_path / "m", embedding=SMALL, mode="read") as beside:  # replays the journal
            assert beside.augmentation == THREE
            assert contents(beside) == contents(fed(FELT))
        learner.close()
        with TactileLearner.open(tmp_path / "m", embedding=SMALL) as again:
            again.observe("c", stream((3, 60)))
            assert contents(again) == contents(fed([*FELT, ("c", (3, 60))]))

    def test_copies_make_no_touch_longer(self):
        learner = fed([("a", (seed, 16)) for seed in range(4)], augmentation=Augmented(copies=3, speed=4))
        assert learner.memory.statistics.longest == 16
        shortest, longest = learner.plan.windows
        assert learner.memory.statistics.names(shortest) == ["a"]
        assert learner.memory.statistics.names(longest) == []


class TestIdentity:
    def test_another_augmentation_is_refused_by_both_names(self, tmp_path):
        filled(tmp_path / "m")[0].close()
        with pytest.raises(MismatchError, match=r"copies=3.*opened with Augmented\(copies=2"):
            TactileLearner.open(tmp_path / "m", **SETTINGS | {"augmentation": Augmented(copies=2)})

    def test_a_memory_without_one_stays_without(self, tmp_path):
        filled(tmp_path / "m", augmentation=None)[0].close()
        with pytest.raises(MismatchError, match=r"no augmentation; it was opened with Augmented\(copies=3"):
            TactileLearner.open(tmp_path / "m", **SETTINGS)
        with TactileLearner.open(tmp_path / "m", embedding=SMALL) as again:
            assert again.augmentation is None
            assert "augmentation" not in again._ledger.store.identity  # as the versions before it wrote

    def test_memories_of_two_are_not_merged(self, tmp_path):
        one, other = filled(tmp_path / "a")[0], filled(tmp_path / "b", augmentation=None)[0]
        with one, other, pytest.raises(MismatchError, match="augmentations differ"):
            one.merge(other, shared="once")

    def test_cameras_and_other_things_are_refused(self):
        with pytest.raises(InputError, match="whole frames"):
            TactileLearner(sensor=sensors.GELSIGHT, augmentation=THREE)
        with pytest.raises(InputError, match="came 3"):
            TactileLearner(sensor=PAD, augmentation=3)
