"""Copies are a function of the touch, and a memory of touches with copies is as exact as one without."""

import numpy as np
import pytest
from touches import PAD, SMALL, Windowed, contents, stream
from touches import SETTINGS as USUAL

from scroll_tactile import Augmented, TactileLearner, sensors
from scroll_tactile.errors import InputError, MismatchError
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import validate

THREE = Augmented(copies=3, speed=2.5)
SETTINGS = USUAL | {"augmentation": THREE}
FELT = [(name, (seed, readings)) for seed, readings in enumerate((60, 25, 90)) for name in "ab"]
DRAWN = "441293ea24a12173b6adcaa56d6579656aa26c75ca2d4b154be9f128d58cfb37"  # what version 0.3 has of FELT with THREE
RAMP = np.linspace(-1, 1, 60, dtype=np.float32).reshape(3, 20)


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
        first, again = (THREE.copies_of(image, one.key) for _ in range(2))
        assert [copy.tobytes() for copy in first] == [copy.tobytes() for copy in again]
        assert len({copy.tobytes() for copy in first}) == 3
        assert first[0].tobytes() != THREE.copies_of(image, other.key)[0].tobytes()

    def test_they_neither_touch_the_image_nor_a_global_generator(self):
        image, before = RAMP.copy(), np.random.get_state()[1].tobytes()  # noqa: NPY002
        THREE.copies_of(image, b"key")
        assert image.tobytes() == RAMP.tobytes()
        assert np.random.get_state()[1].tobytes() == before  # noqa: NPY002

    @pytest.mark.parametrize("columns", [1, 2, 5, 400])
    def test_they_are_sound_images_no_longer_than_the_touch(self, columns):
        image = np.linspace(-1, 1, 2 * columns, dtype=np.float32).reshape(2, columns)
        strong = Augmented(copies=4, speed=4)
        for seed in range(20):
            for copy in strong.copies_of(image, bytes([seed])):
                assert copy.dtype == np.float32
                assert copy.flags.c_contiguous
                assert len(copy) == 2
                assert 1 <= copy.shape[1] <= columns
                assert np.abs(copy).max() <= 1

    def test_without_any_strength_a_copy_is_the_touch(self):
        plain = Augmented(copies=2, speed=1)
        assert [copy.tobytes() for copy in plain.copies_of(RAMP, b"key")] == [RAMP.tobytes()] * 2

    @pytest.mark.parametrize(
        "wrong",
        [
            {"copies": 0},
            {"copies": True},
            {"speed": 0.5},
            {"speed": np.nan},
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

    def test_they_are_those_that_earlier_versions_drew(self):
        assert fed(FELT, embedding=Windowed(seed=0, dimension=64)).digest() == DRAWN

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
            filled(tmp_path / "other", FELT[:1])[0].close()
            with pytest.raises(MismatchError, match="augmentations differ"):  # nor are memories of two merged
                again.merge(tmp_path / "other")

    def test_cameras_and_other_things_are_refused(self):
        with pytest.raises(InputError, match="whole frames"):
            TactileLearner(sensor=sensors.GELSIGHT, augmentation=THREE)
        with pytest.raises(InputError, match="came int 3"):
            TactileLearner(sensor=PAD, augmentation=3)
