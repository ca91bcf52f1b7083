"""Short, noisy and half-broken touches are known by statistics of their own, as exact as the others."""

import numpy as np
import pytest
from touches import PAD, stream

from scroll_tactile import Augmented, Kernels, Robust, TactileLearner, sensors
from scroll_tactile.datasets.simulator import Scene
from scroll_tactile.embeddings.robust import is_noisy, noisy_statistics
from scroll_tactile.errors import InputError
from scroll_tactile.pipelines.robustness import dead, noise
from scroll_tactile.prediction.filling import Filling, sampled_readings
from scroll_tactile.signals.copies import hiss
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.windows import BEGINNING, CHANNELS, NOISE
from scroll_tactile.statistics.grid import to_codes
from scroll_tactile.statistics.statistics import Statistics

SMALL = Robust(Kernels(seed=0, dimension=64))
SETTINGS = {"sensor": PAD, "embedding": SMALL, "exemplars": 4, "augmentation": Augmented(copies=1, noisy=2)}
OBSERVED = [(name, (seed, readings)) for seed, readings in enumerate((60, 25)) for name in "ab"]
NAMES = ("felt", "denim", "cork", "oak")


def fed(observed, **settings):
    learner = TactileLearner(**SETTINGS | settings)
    for name, touch in observed:
        learner.observe(name, stream(touch))
    return learner


@pytest.fixture(scope="module")
def scene():
    return Scene(sensor=sensors.BIOTAC)


@pytest.fixture(scope="module")
def robust(scene):
    learner = TactileLearner(
        sensor=sensors.BIOTAC,
        embedding=Robust(Kernels(dimension=256)),
        augmentation=Augmented(copies=1, speed=1.1, noisy=6, noise=0.7),
        exemplars=0,
    )
    for name in NAMES:
        for at in range(8):
            learner.observe(name, scene.touch(name, at, seconds=2))
    return learner


def share(learner, scene, change):
    evaluated = [(name, change(scene.touch(name, at, seconds=2))) for name in NAMES for at in range(50, 55)]
    return np.mean([learner.predict(touch).material == name for name, touch in evaluated])


class TestEmbedding:
    def test_another_inner_one_or_seed_is_another(self):
        others = (Robust(Kernels(seed=1, dimension=64)), Robust(Kernels(seed=0, dimension=64), seed=2))
        assert len({SMALL.fingerprint, SMALL.inner.fingerprint, *(one.fingerprint for one in others)}) == 4

    @pytest.mark.parametrize("columns", [1, 2, 5, 400])
    @pytest.mark.parametrize("channels", [1, 19])
    def test_noisy_features_of_any_size_and_of_extremes(self, channels, columns):
        rng = np.random.default_rng([channels, columns])
        for image in (
            np.full((channels, columns), -1),
            np.ones((channels, columns)),
            rng.uniform(-1, 1, (channels, columns)),
        ):
            features = SMALL.embed_noisy([image.astype(np.float32)])
            assert features.shape == (2, 1, 64)
            assert np.abs(features).max() <= 1
            statistics = noisy_statistics(image.astype(np.float32), 4)
            assert statistics.shape == (28, channels)
            assert (statistics == np.rint(statistics)).all()
            assert np.abs(statistics).max() < 2**15

    def test_noisy_features_are_the_same_bits_in_any_company(self):
        images = [np.random.default_rng(at).uniform(-1, 1, (3, 40 + at)).astype(np.float32) for at in range(5)]
        alone = np.concatenate([SMALL.embed_noisy([image]) for image in images], axis=1)
        assert SMALL.embed_noisy(images).tobytes() == alone.tobytes()
        assert not np.array_equal(*SMALL.embed_noisy(images))  # the second set says other things

    def test_more_noise_says_the_same_of_the_touch_beneath(self):
        rest, pressed = np.full((6, 4000), -1, np.float32), np.full((2, 4000), -0.6, np.float32)
        touch = np.concatenate([rest, pressed])  # two channels at a fifth of the range
        rng = np.random.default_rng(0)
        little, much = (noisy_statistics(hiss(touch, amplitude, rng)) for amplitude in (0.25, 0.5))
        spread = noisy_statistics(hiss(touch, 0.5, rng)) - much
        kept = np.r_[0:4, 6]  # how often the edge is passed by margins below a fifth, and how often all is lost
        assert np.abs(little - much)[kept].max() <= 200 + 3 * np.abs(spread)[kept].max()
        assert (much[kept, 6:].min(axis=1) - much[kept, :6].max(axis=1) > 300).all()

    def test_noise_is_distinguished_from_touch(self, scene):
        for name in NAMES:
            touch = scene.touch(name, 0)
            assert not is_noisy(tactile_image(touch))
            assert is_noisy(tactile_image(noise(touch, 0.2)))
            assert is_noisy(tactile_image(noise(touch, 1.0)))
        assert not is_noisy(np.zeros((3, 1), np.float32))


class TestMemory:
    def test_what_each_observation_adds(self):
        learner = fed(OBSERVED[:2])
        statistics = learner.memory.statistics
        assert statistics.scales[:4] == (NOISE[0], BEGINNING, CHANNELS, NOISE[1])
        rows = [int(statistics.counts(scale, ["a", "b"]).sum()) for scale in (*NOISE, BEGINNING, CHANNELS)]
        # Two touches: 2 noisy copies; itself and a copy, at each of 3 stages; 32 readings.
        assert rows == [2 * 2, 2 * 2, 2 * 2 * 3, 2 * 32]
        assert learner.materials == {"a": 1, "b": 1}

    def test_it_follows_as_another_does(self):
        learner, fresh = fed(OBSERVED), fed([*OBSERVED, ("a", (8, 60))])
        learner.predict(stream((9, 60)))
        learner.observe("a", stream((8, 60)))
        assert learner.predict(stream((9, 60))).material == fresh.predict(stream((9, 60))).material
        assert learner._current.present(learner._ledger) is not learner.model()  # followed, and not fitted again

    def test_f_star_is_refused(self):
        with pytest.raises(InputError, match="windows alone"):
            fed(OBSERVED).fine_tune()


class TestAnswers:
    def test_clean_touches(self, robust, scene):
        assert share(robust, scene, lambda touch: touch) == 1

    def test_through_noise(self, robust, scene):
        plain = TactileLearner(sensor=sensors.BIOTAC, embedding=Kernels(dimension=256), exemplars=0)
        for name in NAMES:
            for at in range(8):
                plain.observe(name, scene.touch(name, at, seconds=2))
        noisy, before = (share(one, scene, lambda touch: noise(touch, 0.3)) for one in (robust, plain))
        assert noisy >= before + 0.2
        answer = robust.predict(noise(scene.touch("cork", 60), 0.3), scene=["cork", "oak"])
        assert sorted(name for name, _ in answer.ranking) == ["cork", "oak"]
        assert sum(chance for _, chance in answer.ranking) == pytest.approx(1)

    def test_a_noisy_touch_is_composed_of_what_it_feels_like(self, robust, scene):
        for name in NAMES:
            robust.describe(name, {f"{name}'s": 1.0})
        try:
            for name in NAMES:
                touch = noise(scene.touch(name, 50, seconds=2), 0.3)
                answer, made_of = robust.predict(touch), robust.compose(touch)
                assert made_of.prediction.ranking == answer.ranking
                chances = dict(answer.ranking)
                for other in NAMES:
                    assert made_of[f"{other}'s"].presence == pytest.approx(chances.get(other, 0))
        finally:
            for name in NAMES:
                robust.describe(name, None)

    def test_with_dead_channels(self, robust, scene):
        assert share(robust, scene, lambda touch: dead(touch, 0.2)) >= 0.9

    def test_without_noisy_copies_noise_is_judged_as_the_rest(self, scene):
        learner = TactileLearner(sensor=sensors.BIOTAC, embedding=SMALL, exemplars=0)
        for name in NAMES[:2]:
            learner.observe(name, scene.touch(name, 0))
        assert learner.predict(noise(scene.touch("felt", 1), 0.5)).material in NAMES
        assert learner.model().noisy is None


class TestFilling:
    def filling_of(self, readings):
        """By readings of shape (N, C) in [-1, 1]."""
        statistics = Statistics(8, (CHANNELS,))
        image = np.ascontiguousarray(readings.T, dtype=np.float32)
        for at in range(0, image.shape[1], 32):
            statistics.add("m", {CHANNELS: to_codes(sampled_readings(image[:, at : at + 32], 8), 2.0)})
        return Filling.of(statistics, len(image), 2.0)

    def test_mean_and_covariance_are_those_of_the_readings(self):
        readings = np.random.default_rng(0).uniform(-0.9, 0.9, (64, 3)) @ np.array(
            [[0.5, 0.4, 0], [0, 0.1, 0], [0, 0, 1]]
        )
        filling = self.filling_of(readings)
        np.testing.assert_allclose(filling.mean, readings.mean(axis=0), atol=1e-3)
        np.testing.assert_allclose(filling.covariance, np.cov(readings.T, bias=True), atol=1e-3)

    def test_a_silent_channel_is_what_the_others_say(self):
        half = np.random.default_rng(0).uniform(-0.9, 0.9, (96, 1))
        filling = self.filling_of(np.concatenate([half, half / 2, -half], axis=1))
        image = np.ascontiguousarray(np.concatenate([half, half / 2, -half], axis=1).T, dtype=np.float32)
        silent = image.copy()
        silent[1] = -1
        np.testing.assert_allclose(filling.fill(silent), image, atol=2e-3)
        assert silent[1, 0] == -1  # the image that came is left as it was
