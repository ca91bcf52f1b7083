"""Estimates by a learner: the same bits whatever the order, what is refused, and how they settle in a live session."""

import dataclasses
import pickle

import numpy as np
import pytest

from scroll_tactile import Kernels, Quantity, Scene, Sensor, TactileLearner
from scroll_tactile.clients.learning.learning import Answered, Evaluation
from scroll_tactile.clients.learning.metrics import interval_figures
from scroll_tactile.clients.learning.sources import SourceTouch
from scroll_tactile.errors import AnnotationError, InputError

PAD = Sensor(name="pad", channels=6, rate=50.0, low=0.0, high=1.0, unit="N", duration=1.0)
SETTINGS = {"sensor": PAD, "embedding": Kernels(dimension=64), "exemplars": 0}
FORCE = Quantity(name="force", unit="N", low=0.0, high=4.0, resolution=0.001)
SCENE = Scene(sensor=PAD)
OBSERVED = [(name, repetition) for repetition in range(8) for name in ("felt", "cork", "silk")]


def felt(name, repetition):
    force = round(float(np.random.default_rng([repetition, len(name)]).uniform(0.5, 2.0)), 3)
    return SCENE.touch(name, repetition, force=force), force


def observe(learner, observed=OBSERVED):
    receipts = []
    for name, repetition in observed:
        touch, force = felt(name, repetition)
        receipts.append(learner.observe(name, touch, values={"force": force}))
    return receipts


def fed(path=None, observed=OBSERVED, **more):
    made = SETTINGS | more
    learner = TactileLearner(**made) if path is None else TactileLearner.open(path, **made)
    learner.declare(FORCE)
    return learner, observe(learner, observed)


@pytest.fixture(scope="module")
def learner():
    made = fed()[0]
    made.settle()
    return made


def told(learner, touches=3):
    """What is estimated of some touches, by settled learners, at two lengths and both calibrations; to the bit."""
    learner.settle()
    asked = [felt(name, 90 + i)[0] for i, name in enumerate(("felt", "oak", "silk")[:touches])]
    return [
        pickle.dumps(dataclasses.astuple(learner.estimate(part, risk=0.2, known=known)["force"]))
        for touch in asked
        for part in (touch, touch.first(0.4))
        for known in (None, True, False)
    ]


def test_order_merge_retraction_and_restart_give_the_same_bits(tmp_path):
    few = {"kept_touches": 6}  # each state is fitted
    expected = told(fed(**few)[0])
    shuffled = [OBSERVED[i] for i in np.random.default_rng(0).permutation(len(OBSERVED))]
    assert told(fed(observed=shuffled, **few)[0]) == expected
    ours, _ = fed(tmp_path / "ours", OBSERVED[:9], **few)
    fed(tmp_path / "theirs", OBSERVED[9:], **few)[0].close()
    ours.merge(tmp_path / "theirs")
    assert told(ours) == expected
    [more] = observe(ours, [("oak", 3)])
    assert told(ours) != expected
    ours.retract(more)
    assert told(ours) == expected
    ours.close()
    with TactileLearner.open(tmp_path / "ours", **SETTINGS, **few) as again:
        assert told(again) == expected
        again.compact()
        assert told(again) == expected
    assert told(TactileLearner.open(tmp_path / "ours", mode="read", **SETTINGS, **few)) == expected


def test_an_estimate_says_its_value_its_interval_and_what_it_rests_on(learner):
    touch, force = felt("cork", 50)
    estimate = learner.estimate(touch)["force"]
    assert abs(estimate.value - force) < 0.4 and estimate.low < estimate.value < estimate.high
    assert (estimate.unit, estimate.touches, estimate.materials, estimate.seconds) == ("N", 24, 3, 1.0)
    assert estimate.known is (learner.predict(touch).known is True) and estimate.missing == ""
    assert learner.estimate(touch, known=False)["force"].width != learner.estimate(touch, known=True)["force"].width
    assert not learner.estimate(touch.readings[:, ::-1].copy())["force"].inside


def test_risks_are_nested(learner):
    touch, _ = felt("silk", 51)
    widths = [learner.estimate(touch, risk=risk, known=True)["force"].width for risk in (0.5, 0.3, 0.1, 0.05)]
    assert widths == sorted(widths) and widths[-1] <= 4.0


def test_a_memory_that_has_too_little_gives_no_number():
    learner = TactileLearner(**SETTINGS)
    learner.declare(FORCE)
    touch, _ = felt("felt", 0)
    assert learner.estimate(touch)["force"].value is None
    observe(learner, [("felt", repetition) for repetition in range(4)])
    estimate = learner.estimate(touch)["force"]
    assert estimate.value is None and "two materials" in estimate.missing
    learner.observe("cork", felt("cork", 0)[0])  # without a value
    assert "two materials" in learner.estimate(touch)["force"].missing
    observe(learner, [("cork", 1)])
    assert learner.estimate(touch)["force"].value is not None
    assert learner.predict(touch).known is None and learner.estimate(touch)["force"].inside


@pytest.mark.parametrize(
    ("asked", "error", "message"),
    [
        ({"of": ["speed"]}, AnnotationError, "out of \\['force'\\]"),
        ({"of": "force"}, AnnotationError, "sequence of names"),
        ({"risk": 0}, InputError, "risk as a share"),
        ({"risk": float("nan")}, InputError, "risk as a share"),
        ({"known": "yes"}, InputError, "known as True"),
    ],
)
def test_what_cannot_be_asked_is_refused(learner, asked, error, message):
    with pytest.raises(error, match=message):
        learner.estimate(felt("felt", 0)[0], **asked)


def test_without_a_quantity_there_is_nothing_to_estimate():
    with pytest.raises(AnnotationError, match="declare one"):
        TactileLearner(**SETTINGS).estimate(felt("felt", 0)[0])


def lived(learner, touch, width):
    """The states of a live session reading by reading, and the one at the touch's end."""
    with learner.live(risk=0.2, contact="manual", widths={"force": width}) as session:
        session.begin()
        return [session.push(reading) for reading in touch.readings], session.end()


def test_a_live_session_shows_estimates_as_they_settle(learner):
    touch, _ = felt("cork", 60)
    states, ended = lived(learner, touch, 0.01)
    shown = {state.estimates["force"].value for state in states if state.estimates}
    assert len(shown) > 1 and not states[0].estimates and not ended.settled
    assert ended.estimates == ended.touches[0].estimates == learner.estimate(touch, risk=0.2)
    states, ended = lived(learner, touch, 3.9)
    assert [state.settled for state in states].index(True) < 25 and ended.settled


def test_an_evaluation_says_how_intervals_hold_on_materials_learned_and_new(learner):
    def answered(name, repetition, value=None):
        touch, force = felt(name, repetition)
        values = {"force": force if value is None else value}
        return Answered(
            SourceTouch("somewhere", name, touch, values), learner.predict(touch), learner.estimate(touch, risk=0.2)
        )

    touches = [answered(name, 70 + i) for i in range(5) for name in ("felt", "cork", "oak")]
    measured = Evaluation(tuple(touches), (), frozenset(learner.materials)).measured["force"]
    assert measured["learned"]["touches"] == 10 and measured["new"]["touches"] == 5
    assert measured["learned"]["covered"] >= 0.5 and measured["learned"]["mean_error"] < 0.5
    assert measured["learned"]["risk"] == 0.2 and measured["learned"]["without"] == 0
    far = Evaluation((answered("felt", 70, 3.9), answered("felt", 71, 3.9)), (), frozenset(learner.materials))
    assert far.measured["force"]["learned"]["covered"] == 0 and far.measured["force"]["learned"]["r2"] is None
    assert Evaluation((), (), frozenset()).measured == {}


def test_figures_of_intervals():
    figures = interval_figures([1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0, 6.0], [0.0, 2.0, 3.5, 5.0], [2.0, 3.0, 4.0, 7.0])
    assert figures == {"covered": 0.5, "width": 1.375, "mean_error": 0.5, "r2": pytest.approx(0.2)}
    with pytest.raises(InputError):
        interval_figures([1.0], [1.0, 2.0], [0.0], [1.0])


@pytest.mark.parametrize(
    ("widths", "error"), [({"speed": 1.0}, AnnotationError), ({"force": 0.0}, InputError), ({"force": "x"}, InputError)]
)
def test_widths_that_cannot_be_are_refused(learner, widths, error):
    with pytest.raises(error):
        learner.live(contact="manual", widths=widths)
    with pytest.raises(InputError, match="none was declared"):
        TactileLearner(**SETTINGS).live(contact="manual", widths={"force": 1.0})
