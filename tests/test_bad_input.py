"""Touches that no model was made for: each is refused by a typed error, or answered with finite probabilities."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from scroll_tactile import Quantity, Sensor, TactileLearner
from scroll_tactile.errors import (
    AnnotationError,
    InputError,
    NotFiniteError,
    ReadingsTypeError,
    StreamError,
    StreamTooShortError,
)
from scroll_tactile.simulation.scene import Scene

LOW, HIGH = (0.0, -10.0, 0.0, 100.0, 0.0), (255.0, 10.0, 1.0, 900.0, 4095.0)
PLAIN = Sensor(name="pad", channels=5, rate=50.0, low=0.0, high=255.0, unit="counts", duration=1.5)
MIXED = PLAIN.model_copy(update={"name": "mixed", "low": LOW, "high": HIGH})
GAPPED = MIXED.model_copy(update={"name": "gapped", "non_finite": "missing"})
SINGLE = Sensor(name="single", channels=1, rate=50.0, low=0.0, high=255.0, unit="counts", duration=1.5)
SENSORS = [PLAIN, MIXED, GAPPED, SINGLE]
NAMES = ["bark", "felt", "oak", "silk"]


def readings_of(sensor, name="felt", repetition=9):
    return Scene(sensor).touch(name, repetition).readings.astype(np.float64)


@pytest.fixture(scope="module", params=SENSORS, ids=lambda sensor: sensor.name)
def learner(request):
    """A memory of some touches of each of four materials; the tests only ask it."""
    return learned(request.param)


def learned(sensor, of_each=3):
    made, scene = TactileLearner(sensor=sensor), Scene(sensor)
    for repetition in range(of_each):
        for name in NAMES:
            made.observe(name, scene.touch(name, repetition))
    return made


def limits(sensor):
    return np.broadcast_to(sensor.low, sensor.shape), np.broadcast_to(sensor.high, sensor.shape)


def dead(values, sensor, alive=0):
    return np.where(np.arange(sensor.channels) < alive, values, limits(sensor)[0])


def noise(values, sensor, amplitude=None):
    rng = np.random.default_rng(0)
    low, high = limits(sensor)
    if amplitude is None:
        return rng.uniform(low, high, values.shape)
    return values + rng.normal(0, amplitude, values.shape) * (high - low)


def stuck(values, sensor):
    return np.where(np.arange(sensor.channels) == 0, limits(sensor)[1], values)


def with_some(values, sensor, what):
    spoilt = values.copy()
    spoilt[[3, 4, 20], [0, -1, 0]] = what
    return spoilt


def narrow(values, sensor):
    low, high = limits(sensor)
    return low + 0.6 * (high - low) + 0.01 * (values - low)


def slower(values, sensor, times=100):
    places = np.linspace(0, len(values) - 1, times * len(values))
    return np.stack([np.interp(places, range(len(values)), channel) for channel in values.T], axis=1)


SOUND = {
    "a usual touch": lambda values, sensor: values,
    "all channels dead": dead,
    "all channels but one dead": lambda values, sensor: dead(values, sensor, alive=1),
    "constant": lambda values, sensor: values[:1].repeat(len(values), axis=0),
    "constant at the top": lambda values, sensor: limits(sensor)[1][None].repeat(len(values), axis=0),
    "two readings": lambda values, sensor: values[:2],
    "seven readings": lambda values, sensor: values[:7],
    "noise alone": noise,
    "noise as wide as the range": lambda values, sensor: noise(values, sensor, amplitude=1.0),
    "a channel stuck at the top": stuck,
    "a hundredth of the range": narrow,
    "a hundred times slower": slower,
    "a hundred times faster": lambda values, sensor: values[:: len(values) - 1],
    "two channels swapped": lambda values, sensor: values[:, [*range(sensor.channels)][::-1]],
    "far outside the range": lambda values, sensor: values * 1e300,
}
NOT_FINITE = {
    "NaN": lambda values, sensor: with_some(values, sensor, np.nan),
    "infinity": lambda values, sensor: with_some(values, sensor, [np.inf, -np.inf, np.inf]),
    "a channel of NaN": lambda values, sensor: np.where(
        np.arange(sensor.channels) == sensor.channels - 1, np.nan, values
    ),
    "a second of NaN": lambda values, sensor: np.where(np.arange(len(values))[:, None] < 50, np.nan, values),
    "but one value NaN": lambda values, sensor: np.where(
        np.arange(values.size).reshape(values.shape) == 9, values, np.nan
    ),
}


def check(prediction, names):
    ranked, shares = zip(*prediction.ranking, strict=True)
    assert sorted(ranked) == sorted(names)
    assert all(math.isfinite(share) and 0 <= share <= 1 for share in shares)
    assert sum(shares) == pytest.approx(1)
    assert (prediction.material, prediction.probability) == prediction.ranking[0]
    assert math.isfinite(prediction.novelty)
    assert prediction.known in (True, False, None)


@pytest.mark.parametrize("kind", SOUND)
def test_an_unusual_touch_is_answered(learner, kind):
    readings = SOUND[kind](readings_of(learner.sensor), learner.sensor)
    answer = learner.predict(readings)
    check(answer, NAMES)
    check(learner.predict(readings, scene=NAMES[1:3]), NAMES[1:3])
    assert learner.predict(readings) == answer


@pytest.mark.parametrize("kind", NOT_FINITE)
def test_what_is_not_finite_is_answered_or_refused_as_the_sensor_says(learner, kind):
    readings = NOT_FINITE[kind](readings_of(learner.sensor), learner.sensor)
    if learner.sensor.non_finite == "missing":
        check(learner.predict(readings), NAMES)
    else:
        with pytest.raises(NotFiniteError, match="expected finite readings"):
            learner.predict(readings)


def test_a_touch_of_nothing_finite_or_of_one_reading_is_refused(learner):
    values = readings_of(learner.sensor)
    before = learner.digest()
    for readings, error in ((np.full_like(values, np.nan), NotFiniteError), (values[:1], StreamTooShortError)):
        for call in (learner.predict, lambda touch: learner.observe("felt", touch)):
            with pytest.raises(error):
                call(readings)
    assert learner.digest() == before


@pytest.mark.filterwarnings("ignore::scroll_tactile.errors.FactWarning")  # some are far outside
def test_unusual_touches_are_learned_and_no_answer_suffers():
    made, kinds = learned(GAPPED, of_each=2), SOUND | NOT_FINITE
    for kind, spoil in kinds.items():
        for repetition in range(2):
            made.observe(kind, spoil(readings_of(GAPPED, repetition=repetition), GAPPED))
    for spoil in kinds.values():
        check(made.predict(spoil(readings_of(GAPPED), GAPPED)), [*NAMES, *kinds])


@pytest.mark.parametrize("kind", ["all channels dead", "two readings", "noise alone", "a channel of NaN"])
def test_a_memory_of_nothing_else_answers(kind):
    made, usual = TactileLearner(sensor=GAPPED, kept_touches=2), readings_of(GAPPED)
    for repetition in range(2):
        for name in NAMES[:2]:
            made.observe(name, (SOUND | NOT_FINITE)[kind](readings_of(GAPPED, name, repetition), GAPPED))
        check(made.predict(usual), NAMES[:2])
    check(made.predict((SOUND | NOT_FINITE)[kind](usual, GAPPED)), NAMES[:2])


def test_what_was_missing_is_kept_as_it_was_filled(tmp_path):
    readings = NOT_FINITE["NaN"](readings_of(GAPPED), GAPPED)
    with TactileLearner.open(tmp_path / "m", sensor=GAPPED) as made:
        for name in NAMES[:2]:
            made.observe(name, readings_of(GAPPED, name, 0))
        receipt = made.observe("felt", readings)
        before, answer = made.digest(), made.predict(readings)
    with TactileLearner.open(tmp_path / "m") as again:
        assert again.sensor == GAPPED
        assert (again.digest(), again.predict(readings)) == (before, answer)
        again.retract(receipt)
        check(again.predict(readings), NAMES[:2])


@given(st.data())
@settings(max_examples=20, deadline=None)
def test_anything_of_the_right_shape_is_answered_or_refused(learner, data):
    shape = (data.draw(st.integers(1, 40)), learner.sensor.channels)
    readings = data.draw(hnp.arrays(np.float64, shape, elements=st.floats(width=32)))
    finite = np.isfinite(readings)
    enough = finite.any() if learner.sensor.non_finite == "missing" else finite.all()
    if enough and len(readings) > 1:
        check(learner.predict(readings), NAMES)
    else:
        with pytest.raises((NotFiniteError, StreamTooShortError)):
            learner.predict(readings)


def test_a_touch_of_hours_is_refused_before_it_is_kept(tmp_path, monkeypatch):
    pad = Sensor(name="pad", channels=1, rate=100.0, low=0.0, high=1.0, unit="", duration=1.0)
    monkeypatch.setattr("scroll_tactile.memory.touch_rows.MOST_BYTES", 4 * 200)
    with TactileLearner.open(tmp_path / "m", sensor=pad) as learner:
        with pytest.raises(StreamError, match="at most 200 readings of sensor 'pad', 256 MiB; came 201"):
            learner.observe("felt", np.zeros((201, 1)))
        assert learner.observe("felt", np.zeros((200, 1))).sequence == 1


TOUCH = np.random.default_rng(0).uniform(0, 255, (60, 5))
HUGE = 10**400


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda one: one.observe("oak", TOUCH, values={"f": HUGE}),
            AnnotationError,
            "'f' as a number .* came 1",
        ),
        (
            lambda one: one.observe("oak", TOUCH, values={"f": -HUGE}),
            AnnotationError,
            "from 0 to 10 N; came -1000",
        ),
        (
            lambda one: one.compose(TOUCH, unfamiliar=HUGE),
            InputError,
            "unfamiliar as .* came int 1",
        ),
        (lambda one: one.estimate(TOUCH, risk=HUGE), InputError, "risk as a share .* came int 1000"),
        (lambda one: one.observe("oak", np.asarray(one.stream(TOUCH))), ReadingsTypeError, r"is Stream\(.*, a Stream"),
        (
            lambda one: one.observe("oak", np.asarray(iter(TOUCH))),
            ReadingsTypeError,
            "the only item is <",
        ),
        (lambda one: one.live().push(np.asarray(one.stream(TOUCH))), ReadingsTypeError, "the only item is Stream"),
    ],
)
def test_what_overflows_or_hides_in_an_array_is_refused_by_name(call, error, message):
    learner = TactileLearner(sensor=PLAIN)
    learner.declare(Quantity(name="f", unit="N", low=0.0, high=10.0, resolution=0.01))
    with pytest.raises(error, match=message):
        call(learner)
    assert learner.materials == {}


@pytest.mark.filterwarnings("ignore:the matrix subclass")
def test_a_matrix_is_an_array():
    learner = TactileLearner(sensor=PLAIN)
    with learner.live() as one, learner.live() as other:
        one.push(TOUCH)
        other.push(np.asmatrix(TOUCH))
        other.push(np.asmatrix(TOUCH)[0])
        assert (one.report.readings, other.report.readings) == (60, 61)
