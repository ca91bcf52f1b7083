"""Estimates by sampled touches: which heads answer at which length, what they cover, and what they say is missing."""

import dataclasses

import numpy as np
import pytest

from scroll_tactile import Kernels, Scene, Sensor
from scroll_tactile.embeddings.protocol import window_plan
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.quantities import Quantity
from scroll_tactile.readouts.estimation import Estimator
from scroll_tactile.signals.windows import SHAPE
from scroll_tactile.statistics.annotations import Annotation
from scroll_tactile.statistics.sample import SampledTouch

PAD = Sensor(name="pad", channels=8, rate=50.0, low=0.0, high=1.0, unit="N", duration=2.0)
EMBEDDING = Kernels(dimension=128)
PLAN = window_plan(PAD, EMBEDDING)
EXTRACTOR = FeatureExtractor(PAD, EMBEDDING, PLAN)
SCENE = Scene(sensor=PAD)
FORCE = Quantity(name="force", unit="N", low=0.0, high=4.0, resolution=0.001)
NAMES = ["felt", "denim", "cork", "silk"]


def felt(name, repetition, seconds=2.0):
    force = float(np.random.default_rng([repetition, NAMES.index(name)]).uniform(0.5, 2.0))
    return SCENE.touch(name, repetition, seconds, force=force), force


def valued(name, repetition, seconds=2.0, quantity=FORCE, value=None):
    """A sampled touch that carries its force, or another value."""
    touch, force = felt(name, repetition, seconds)
    steps, codes = EXTRACTOR.learned(touch)
    sampled = SampledTouch.of(PLAN.scored_stages(steps), codes)
    return with_value((name, touch.key, sampled), quantity, force if value is None else value)


def with_value(sampled, quantity, value):
    name, key, touch = sampled
    annotation = Annotation(((quantity.name, quantity.integer(value)),))
    return name, key, dataclasses.replace(touch, annotation=annotation)


LEARNED = [valued(name, repetition) for name in NAMES[:3] for repetition in range(20)]


def estimator_of(touches=LEARNED, quantities=None, least=100):
    return Estimator.of(PLAN, touches, quantities or {"force": FORCE}, least)


@pytest.fixture(scope="module")
def estimator():
    return estimator_of()


def asked(estimator, touch, risk=0.1, known=True, wanted=("force",)):
    image = EXTRACTOR.image(touch)
    steps = image.shape[1]
    means = EXTRACTOR.means(image[:, : estimator.length(steps)], estimator.scales_for(steps))
    return estimator.estimate(wanted, means, steps, risk, known=known)


def covered(estimator, names, seconds, known):
    """The share of new touches whose force lies in its interval, and the mean width."""
    found = []
    for name in names:
        for repetition in range(100, 140):
            touch, force = felt(name, repetition)
            estimate = asked(estimator, touch.first(seconds), known=known)["force"]
            found.append((estimate.low <= force <= estimate.high, estimate.width))
    return np.mean(found, axis=0)


def test_intervals_cover_at_every_length(estimator):
    covers, widths = zip(*(covered(estimator, NAMES[:3], seconds, True) for seconds in (0.3, 1.0, 2.0)), strict=True)
    assert min(covers) >= 0.84 and widths[-1] < 1.0


def test_a_new_material_has_the_wider_interval_that_it_needs(estimator):
    as_known, as_new = (covered(estimator, NAMES[3:], 2.0, known) for known in (True, False))
    assert as_new[1] > 1.5 * as_known[1] and as_new[0] > as_known[0]


def test_a_complete_touch_is_read_by_views_and_a_part_of_it_by_windows_as_they_were_then(estimator):
    assert SHAPE in estimator.scales_for(100) and SHAPE not in estimator.scales_for(99)
    assert estimator.stage(15) == 0 and estimator.stage(100) == estimator.last
    assert estimator.length(99) == PLAN.milestones()[1] and estimator.length(100) == 100
    touch = felt("cork", 3)[0]
    assert asked(estimator, touch.first(0.3))["force"].value != asked(estimator, touch)["force"].value


def test_a_touch_that_was_shorter_calibrates_no_other_length():
    shorter = [valued("felt", 50 + i, 0.5) for i in range(3)]
    more = estimator_of([*LEARNED, *shorter])
    for stage in range(more.last + 1):
        assert more.heads(stage)["force"].known.weights.tobytes() == (
            estimator_of().heads(stage)["force"].known.weights.tobytes()
        )


def test_risks_too_small_for_the_touches_give_the_range(estimator):
    estimate = asked(estimator, felt("felt", 3)[0], risk=0.01)["force"]
    assert estimate.interval == (0.0, 4.0) and "takes 99 touches" in estimate.missing
    assert 0.5 < estimate.value < 2.5 and (estimate.touches, estimate.materials) == (60, 3)
    assert asked(estimator, felt("felt", 3)[0], risk=0.1)["force"].missing == ""


def test_touches_without_a_value_have_no_part_and_cost_nothing():
    heat = Quantity(name="hot", unit="K", low=200.0, high=400.0, resolution=0.1)
    mixed = [valued(name, 200 + i, quantity=heat, value=300.0 + i % 7) for i, (name, *_) in enumerate(LEARNED[::4])]
    both = estimator_of([*LEARNED, *mixed], {"force": FORCE, "hot": heat})
    alone = estimator_of(mixed, {"hot": heat})
    touch = felt("cork", 7)[0]
    assert asked(both, touch, wanted=["hot"]) == asked(alone, touch, wanted=["hot"])
    assert asked(both, touch, wanted=["hot"])["hot"].touches == len(mixed)


def test_a_property_of_the_material_in_disguise_is_given_away_by_its_interval():
    stiff = [with_value(sampled, FORCE, 1.0 + NAMES.index(sampled[0])) for sampled in LEARNED]
    touch = felt("cork", 7)[0]
    known, new = (asked(estimator_of(stiff), touch, known=known)["force"] for known in (True, False))
    assert new.width > 2 * known.width


def test_heads_last_as_long_as_their_touches(estimator):
    estimator.heads(0)
    same = Estimator.of(PLAN, [*LEARNED], {"force": FORCE}, 99, estimator)
    assert same.heads(0) is estimator.heads(0) and same.least == 99
    assert Estimator.of(PLAN, [*LEARNED], {"force": FORCE}, 100, estimator).heads(0) is estimator.heads(0)
    fewer = Estimator.of(PLAN, LEARNED[1:], {"force": FORCE}, 100, estimator)
    assert fewer.heads(0)["force"].known.weights.tobytes() != estimator.heads(0)["force"].known.weights.tobytes()


def test_of_a_touch_shorter_than_those_that_carry_a_value_it_is_said_that_these_are_longer():
    """The least length is that of all touches, of which few may carry a value: it was an untyped error."""
    estimator = estimator_of(least=15)
    estimate = asked(estimator, felt("felt", 3)[0].first(0.3))["force"]
    assert (estimate.value, estimate.interval) == (None, None) and "longer than this one" in estimate.missing
    assert asked(estimator, felt("felt", 3)[0])["force"].missing == ""
