"""A model is fitted once, to touches held out: to their beginnings and to them at other paces."""

import numpy as np
import pytest
from live_touches import touched

from scroll_tactile import Kernels, Quantity, Sensor, TactileLearner
from scroll_tactile.clients.report.memory_facts import _without
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.fitting import Draft, rehearse
from scroll_tactile.prediction.judging import held_out_touches, judged
from scroll_tactile.readouts.calibration import calibrate_stage
from scroll_tactile.signals.levels import stream_of
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.statistics.moments import one_thread

SKIN = Sensor(name="skin", channels=6, rate=50.0, low=0.0, high=100.0, unit="N", duration=1.2, non_finite="missing")
SCENE = Scene(sensor=SKIN, seed=2)
NAMES = SCENE.materials[:4]
TOUCHES = [(name, SCENE.touch(name, i)) for i in range(8) for name in NAMES]
LATER = [(name, SCENE.touch(name, i)) for i in range(50, 56) for name in NAMES]


def learned(touches=TOUCHES, **settings):
    learner = TactileLearner(sensor=SKIN, embedding=Kernels(dimension=84), **settings)
    for name, touch in touches:
        learner.observe(name, touch)
    return learner


@pytest.fixture(scope="module")
def learner():
    made = learned()
    made.settle()
    return made


@pytest.fixture(scope="module")
def model(learner):
    return learner.model()


@pytest.fixture(scope="module")
def extractor(learner):
    return FeatureExtractor(learner.sensor, learner.embedding, learner.plan)


def faster(readings, times):
    places = np.linspace(0, len(readings) - 1, round(len(readings) / times))
    return np.stack([np.interp(places, range(len(readings)), channel) for channel in readings.T], axis=1)


def test_what_is_rehearsed_is_what_the_model_says_of_a_touch_that_it_lacks(learner, model, extractor):
    """Of each beginning of a touch that readouts and kept touches never observed."""
    rehearse(model)
    said, weighing, apart = model.held_out.trajectories, model.fitted, []
    rows, keys = model.matcher.kept.rows(), [key for _, key, _ in model.held_out.sample]
    assert len(said.targets) == len(rows) == len(TOUCHES)  # all are held out: they are few
    for touch in held_out_touches(model, 0.05)[::7]:
        stream = stream_of(model.matcher.kept.levels[rows[touch.key]], SKIN)
        other = _without(model, learner.memory, touch)
        with one_thread():
            for i, row in enumerate(weighing.early):
                encoded = extractor.encode(
                    stream.first(row.steps / SKIN.rate), model.longest, lambda at: model.scales_for(NAMES, at)
                )
                found = judged(other, extractor, sorted(NAMES), encoded)
                apart.append(np.abs(found.probability - said.chances[keys.index(touch.key), i]).max())
    assert len(apart) > 4
    assert np.median(apart) < 0.05  # a prediction looks for noise in the beginning alone


def test_nothing_is_fitted_when_it_is_asked_for(learner, monkeypatch):
    learner.settle()
    monkeypatch.setattr(Draft, "fit", lambda *_: pytest.fail("fitted again"))
    for _, touch in LATER[:3]:
        learner.predict(touch)
        learner.predict(touch.first(0.1), touch.first(0.3))
        learner.predict(faster(touch.readings, 1.7))
    with learner.live(contact="manual") as live:
        assert touched(live, LATER[0][1].readings).prediction.material in NAMES


@pytest.mark.parametrize("times", [2.0, 0.5])
def test_a_touch_at_another_pace_is_known_and_right(learner, times):
    said = [(learner.predict(faster(touch.readings, times)), name) for name, touch in LATER]
    assert np.mean([now.material == name for now, name in said]) >= 0.9
    assert np.mean([now.known is not False for now, _ in said]) >= 0.85  # eight of each were held out


def test_new_touches_are_scored_more_surely_than_held_out_ones_were(model):
    """Each material has eight touches, and one that is held out seven others."""
    row = model.fitted.complete
    found, readouts = model.held_out.at(row.stage, row.scales), [model.readouts[scale] for scale in row.scales]
    held_out = calibrate_stage(found, readouts, "lda", viewed=True).weights
    np.testing.assert_allclose(row.calibration.weights, (8 / 7) ** 0.75 * held_out)


def test_beginnings_are_right_sooner_than_later_and_no_surer_than_that(model):
    rehearse(model)
    said = model.held_out.trajectories
    right = (said.chances.argmax(axis=2) == said.targets[:, None]).mean(axis=0)
    assert right[-1] >= max(0.95, right[0])
    assert np.abs(said.chances.max(axis=2).mean(axis=0) - right).max() < 0.12


def waves(seed, readings):
    return 50 + 30 * np.sin(np.arange(readings)[:, None] * (0.1 + 0.03 * (seed % 7)) + np.arange(6) + seed)


FEW = {
    "one touch": [("a", 1, 60)],
    "one short touch": [("a", 1, 2)],
    "one material": [("a", seed, 60) for seed in range(20)],
    "two touches": [("a", 1, 60), ("b", 2, 60)],
    "two short ones": [("a", 1, 2), ("b", 2, 2)],
    "a short one and a long": [("a", 1, 2), ("b", 2, 60)],
    "one of each": [(name, seed, 60) for seed, name in enumerate("abcdef")],
    "one of another": [*(("a", seed, 60) for seed in range(20)), ("b", 3, 2)],
    "all alike": [(name, 1, 60) for name in "abc"],
    "any length": [(name, i, n) for i, n in enumerate((2, 3, 9, 60, 400, 4000, 2, 3, 4000)) for name in "abc"],
}


@pytest.mark.parametrize("kept_touches", [0, 1, None])
@pytest.mark.parametrize("kind", FEW)
def test_of_whatever_few_touches_everything_is_answered(kind, kept_touches):
    """From touch to touch, of any length, live and settled."""
    learner = TactileLearner(sensor=SKIN, embedding=Kernels(dimension=84), kept_touches=kept_touches)
    learner.declare(Quantity(name="force", unit="N", low=0.0, high=9.0, resolution=0.1))
    for i, (name, seed, readings) in enumerate(FEW[kind]):
        values = {"force": float(i % 9)} if i % 2 else None
        learner.observe(name, waves(seed, readings), values=values, labels={"slip": "ny"[i % 2]} if i == 1 else None)
        if i + 1 == len(FEW[kind]):
            learner.settle()
        elif i not in (1, 5):
            continue
        for asked in (2, 9, 30, 60, 61, 130, 400):
            said = [learner.predict(waves(40, asked)), learner.predict(waves(40, asked), waves(41, 60))]
            assert {shown for one in said for shown, _ in one.ranking} == set(learner.materials)
            assert np.allclose([sum(share for _, share in one.ranking) for one in said], 1.0)
            assert np.isfinite([one.novelty for one in said]).all()
            assert learner.estimate(waves(40, asked)).keys() == {"force"}  # R1
            if i:
                assert learner.predict(waves(40, asked), of="slip").probability == 1.0  # R2
        with learner.live(contact="manual", of="slip" if i else None) as live:
            assert touched(live, waves(40, 60)).prediction.probability > 0


def test_more_materials_than_the_sample_has_touches_each_of_one_short_touch():
    """R3."""
    learner = learned([(f"m{i}", waves(i, 20) + 15 * np.sin(i * np.arange(1, 7))) for i in range(1030)])
    said = learner.predict(waves(5, 20) + 15 * np.sin(5 * np.arange(1, 7)))
    assert (said.material, len(said.ranking)) == ("m5", 1030)


def test_a_material_comes_to_a_ridge_after_opening(path):
    """R4."""
    how = {"sensor": SKIN, "embedding": Kernels(dimension=84), "readout": "ridge", "kept_touches": 0, "exemplars": 0}
    with TactileLearner.open(path, **how) as learner:
        for name, touch in TOUCHES:
            learner.observe(name, touch)
        learner.predict(TOUCHES[0][1])
    with TactileLearner.open(path, readout="ridge") as learner:
        learner.observe("new", waves(3, 60))
        assert learner.predict(waves(3, 60)).material == "new"


@pytest.mark.parametrize("kept_touches", [0, None])
@pytest.mark.parametrize("readings", [2, 3, 5, 9])
def test_touches_too_short_for_any_moment_before_their_end(kept_touches, readings):
    short = learned([(name, touch.first(readings / SKIN.rate)) for name, touch in TOUCHES], kept_touches=kept_touches)
    for _, touch in LATER[:3]:
        for count in range(2, readings + 3):
            prediction = short.predict(touch.first(count / SKIN.rate))
            assert sum(share for _, share in prediction.ranking) == pytest.approx(1.0)


def test_touches_with_gaps_are_held_out_too():
    rng = np.random.default_rng(0)
    learner = TactileLearner(sensor=SKIN, embedding=Kernels(dimension=84))
    for name, touch in TOUCHES:
        readings = touch.readings.copy()
        readings[rng.random(readings.shape) < 0.1] = np.nan
        learner.observe(name, readings)
    assert learner.predict(TOUCHES[0][1].readings[:12]).material in NAMES


def test_what_was_fitted_to_single_touches_takes_in_second_ones_after_opening(tmp_path):
    """It had no scatter to shrink: its penalty is no share of one, and without any, K would be singular."""
    names, settings = SCENE.materials[:18], {"sensor": SKIN, "embedding": Kernels(dimension=84)}
    with TactileLearner.open(tmp_path, **settings) as writer:
        for name in names:
            writer.observe(name, SCENE.touch(name, 0))
        writer.settle()
    with TactileLearner.open(tmp_path) as writer:
        writer.observe(names[0], SCENE.touch(names[0], 1))
        assert writer.predict(SCENE.touch(names[0], 2)).material == names[0]


@pytest.mark.parametrize("seconds", [0.62, 0.8, 1.0])
def test_a_beginning_of_a_known_touch_is_known_wherever_it_ends(learner, seconds):
    """Between the last milestone and the end of a touch no sampled touch ever ended."""
    said = [learner.predict(touch.first(seconds)) for _, touch in LATER]
    assert np.mean([one.known is not False for one in said]) >= 0.85
    assert np.mean([one.material == name for one, (name, _) in zip(said, LATER, strict=True)]) >= 0.9
