"""The model: scenes, and materials that no sampled touch is of."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from touches import PAD, SMALL, SmallSample, Windowed

from scroll_tactile import TactileLearner
from scroll_tactile.errors import UnknownMaterialError
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import validate
from scroll_tactile.signals.windows import COMPETING

NAMES = [f"material {i:02d}" for i in range(12)]
WINDOWED = Windowed(dimension=64)
LONG = PAD.model_copy(update={"duration": 4.0})


def stream(place, seed, readings=60):
    """A noisy wave whose level is the material's."""
    rng = np.random.default_rng([place, seed])
    wave = np.sin(np.arange(readings)[:, None] * 0.4 + rng.uniform(0, 6, 2))
    return 0.2 + 0.05 * place + 0.2 * wave + rng.normal(0, 0.05, (readings, 2))


def learner_of(touches=3, sensor=PAD, embedding=SMALL, **settings):
    learner = TactileLearner(sensor=sensor, embedding=embedding, **settings)
    for i in range(touches):
        for place, name in enumerate(NAMES):
            learner.observe(name, stream(place, i))
    return learner


@cache
def shared(readout, embedding=SMALL, kept_touches=None):
    """A learner that no test changes."""
    return learner_of(readout=readout, embedding=embedding, kept_touches=kept_touches)


@cache
def model_of(readout, embedding=SMALL, kept_touches=None):
    return shared(readout, embedding, kept_touches).model()


scenes = st.sets(st.sampled_from(NAMES), min_size=1)


def require_same_odds(part, whole, scene, odd):
    """But for the share that is left for touches unlike all others, `odd` in all: evenly over who can be there."""
    shares = {name: share - odd / len(whole.ranking) for name, share in whole.ranking if name in scene}
    expected = {name: (1 - odd) * share / sum(shares.values()) + odd / len(scene) for name, share in shares.items()}
    assert dict(part.ranking) == pytest.approx(expected, rel=1e-6, abs=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(["lda", "ridge"]), scenes, st.integers(50, 90))
def test_the_probabilities_of_a_scene_are_those_of_its_materials_alone(readout, scene, seed):
    whole = shared(readout, WINDOWED).predict(stream(seed % 12, seed))
    part = shared(readout, WINDOWED).predict(stream(seed % 12, seed), scene=sorted(scene, reverse=True))
    require_same_odds(part, whole, scene, model_of(readout, WINDOWED).fitted.complete.readout_outliers)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(["lda", "ridge"]), scenes, st.integers(50, 90))
def test_how_strange_a_view_looks_depends_on_what_can_be_there(readout, scene, seed):
    """So the odds within a scene are those of all only where it holds the best of every scale."""
    learner, probe = shared(readout, kept_touches=0), stream(seed % 12, seed)
    model, image = model_of(readout, kept_touches=0), tactile_image(validate(probe, PAD))
    means = FeatureExtractor(PAD, SMALL, learner.plan).means(image, learner.plan.scales)
    for scale in learner.plan.scales:
        scores = model.readouts[scale].scores(means[scale], np.arange(len(NAMES)), readout)
        scene = scene | {NAMES[int(scores.argmax())]}
    odd = model.fitted.complete.readout_outliers
    require_same_odds(learner.predict(probe, scene=sorted(scene)), learner.predict(probe), scene, odd)


def test_a_scene_of_ten_thousand_names():
    learner, probe = shared("lda"), stream(3, 60)
    assert learner.predict(probe, scene=NAMES * 1000) == learner.predict(probe)
    with pytest.raises(UnknownMaterialError, match="never observed") as raised:
        learner.predict(probe, scene=[*NAMES, *(f"nobody's {i}" for i in range(10_000))])
    assert len(str(raised.value)) < 2000
    assert learner.predict(probe, scene=[NAMES[3]]).ranking == ((NAMES[3], 1.0),)


def test_a_scale_at_which_no_sampled_touch_was_read(monkeypatch):
    monkeypatch.setattr("scroll_tactile.memory.state.TouchSample", SmallSample)
    learner = learner_of(sensor=LONG)
    seeds = iter(range(1000))
    learner.observe("long", stream(9, next(seeds), 200))
    while "long" in {material for material, *_ in learner.memory.sample}:
        learner.observe("long", stream(9, next(seeds), 200))
        learner.observe(NAMES[0], stream(0, 1000 + next(seeds)))
    learner.describe("long", {"wet": True})
    learner.describe(NAMES[0], {"wet": False})
    for readings in (10, 60, 200):
        prediction = learner.predict(stream(9, 5000, readings))
        assert {name for name, _ in prediction.ranking} == {*NAMES, "long"}
        assert np.isfinite(prediction.novelty)
        assert sum(share for _, share in prediction.ranking) == pytest.approx(1)
        learner.compose(stream(9, 5000, readings))


def test_a_material_that_was_observed_briefly_among_others_that_came_since(monkeypatch):
    """What follows a fit may reach scales and stages that no touch had reached before it."""
    learner = TactileLearner(sensor=LONG, embedding=SMALL)
    for i in range(6):
        for place in range(3):
            learner.observe(NAMES[place], stream(place, i, 20))
    learner.predict(stream(0, 50, 20))
    learner.observe(NAMES[0], stream(0, 60, 200))
    learner.observe("new", stream(7, 61, 12))
    for readings in (10, 20, 60, 200):
        prediction = learner.predict(stream(7, 70, readings))
        assert {name for name, _ in prediction.ranking} == {*NAMES[:3], "new"}
        assert np.isfinite(prediction.novelty)


def test_competing_kernels_weigh_in_probabilities_and_not_in_novelty_or_distance():
    model, touch = model_of("lda"), stream(3, 99)
    moment = model.fitted.complete
    scales = moment.scales
    assert COMPETING in scales
    assert moment.calibration.weights[scales.index(COMPETING)] > 0
    windows = sum(bool(scale.width) for scale in scales)  # they measure how near sampled touches lie, too
    assert len(moment.calibration.scale_novelty) == len(scales) - 1 + windows
    image = tactile_image(validate(touch, PAD))
    means = FeatureExtractor(PAD, SMALL, model.plan).means(image, scales)
    moved = means | {COMPETING: means[COMPETING][::-1]}
    before, after = (model.judge(NAMES, one, image.shape[1], "complete") for one in (means, moved))
    assert (before.novelty, before.distance) == (after.novelty, after.distance)
    assert before.probability.tolist() != after.probability.tolist()
