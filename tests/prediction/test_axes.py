"""An axis of labels answers as a memory does whose materials are the labels."""

import numpy as np
import pytest
from live_touches import slide
from touches import SETTINGS, SmallSample, stream

from scroll_tactile import TactileLearner
from scroll_tactile.errors import AnnotationError, InputError, UnknownMaterialError

FELT = [(name, (seed, 60)) for seed in range(6) for name in "abc"]
LABELS = [None if i % 5 == 4 else "nse"[(i // 2) % 3] for i in range(len(FELT))]
ASKED = [stream(touch) for touch in ((7, 25), (8, 60), (9, 300))]


def felt(learner, first=0, last=None):
    """Observe touches with their labels."""
    for (name, touch), label in list(zip(FELT, LABELS, strict=True))[first:last]:
        learner.observe(name, stream((touch[0] + ord(name), touch[1])), labels={"slip": label} if label else None)


def by_labels(count=None, **settings):
    """A memory whose materials are the labels of the first touches that have one."""
    learner = TactileLearner(**SETTINGS | settings)
    for (name, touch), label in list(zip(FELT, LABELS, strict=True))[:count]:
        if label:
            learner.observe(label, stream((touch[0] + ord(name), touch[1])))
    return learner


def answers(learner, **how):
    return [learner.predict(touch, **how) for touch in ASKED]


@pytest.fixture(scope="module")
def oracle():
    """What that memory answers."""
    return answers(by_labels())


def test_each_answer_is_the_one_of_a_memory_of_the_labels_from_touch_to_touch():
    ours, theirs = TactileLearner(**SETTINGS), by_labels(0)
    for i in range(10):
        felt(ours, i, i + 1)
        if LABELS[i]:
            theirs.observe(LABELS[i], stream((FELT[i][1][0] + ord(FELT[i][0]), 60)))
        asked = answers(ours, of="slip"), answers(theirs)
        assert [sorted(dict(own.ranking)) for own in asked[0]] == [sorted(dict(own.ranking)) for own in asked[1]]
        if i % 3 == 0:
            for learner in (ours, theirs):
                learner.settle()  # between two fits, calibrations may be of other moments
            assert answers(ours, of="slip") == answers(theirs)
    assert ours.predict(ASKED[1], of="slip", scene=["n", "e"]) == theirs.predict(ASKED[1], scene=["n", "e"])
    assert ours.predict(*ASKED, of="slip") == theirs.predict(*ASKED)
    said = ours.predict(ASKED[1], of="slip")
    assert said.candidates() == theirs.predict(ASKED[1]).candidates()
    assert {name for name, _ in ours.predict(ASKED[1]).ranking} == set("abc")  # materials are as they were


@pytest.mark.parametrize("how", ["settled", "reopened", "merged", "retracted", "compacted", "ridge"])
def test_whatever_was_done_it_is_settled_to_the_same_bits(tmp_path, oracle, how):
    settings = SETTINGS | ({"readout": "ridge"} if how == "ridge" else {})
    with TactileLearner.open(tmp_path / "m", **settings) as learner:
        felt(learner, 0, 9 if how == "merged" else None)
        answers(learner, of="slip")
        if how == "merged":
            with TactileLearner.open(tmp_path / "o", **SETTINGS) as other:
                felt(other, 9)
                learner.merge(other)
        if how == "retracted":
            receipts = [
                learner.observe(name, stream((40, 60)), labels=labels)
                for name, labels in (("a", {"slip": "n"}), ("b", None), ("c", {"slip": "west"}))
            ]
            answers(learner, of="slip")
            for receipt in receipts:
                learner.retract(receipt)
        if how == "compacted":
            learner.compact(keep=3)
        if how != "reopened":
            learner.settle()
            expected = answers(by_labels(readout="ridge")) if how == "ridge" else oracle
            assert answers(learner, of="slip") == expected
    if how == "reopened":
        with TactileLearner.open(tmp_path / "m", mode="read") as learner:
            assert answers(learner, of="slip") == oracle
    assert answers(learner, of="slip") == (expected if how == "ridge" else oracle)  # closed, it answers all the same


def test_a_touch_without_a_label_that_moves_the_samples_is_settled_too(monkeypatch):
    """No touch of the axis came or went: only which of them are sampled, or kept."""
    monkeypatch.setattr("scroll_tactile.memory.state.TouchSample", SmallSample)
    ours, theirs = (TactileLearner(**SETTINGS, kept_touches=6) for _ in range(2))
    felt(ours)
    ours.settle()
    answers(ours, of="slip")
    for name in "adef":
        ours.observe(name, stream((50, 60)))
    for name in "adef":
        theirs.observe(name, stream((50, 60)))
    felt(theirs)
    for learner in (ours, theirs):
        learner.settle()
    assert answers(ours, of="slip") == answers(theirs, of="slip")


def test_a_touch_with_one_label_and_then_another_counts_once_for_each():
    ours, theirs = TactileLearner(**SETTINGS), by_labels()
    felt(ours)
    for name, label in zip("ad", "ns", strict=True):
        ours.observe(name, stream((30, 60)), labels={"slip": label})
        theirs.observe(label, stream((30, 60)))
    for learner in (ours, theirs):
        learner.settle()
    assert answers(ours, of="slip") == answers(theirs)


def test_a_live_session_answers_by_an_axis():
    learner = TactileLearner(**SETTINGS)
    felt(learner)
    touch = slide("a", 60, np.random.default_rng(0))
    with learner.live(of="slip", contact="manual", risk=1e-12) as live:
        live.begin()
        live.push(touch)
        now = live.end()
    assert now.prediction == learner.predict(touch, of="slip")
    assert now.prediction.material in set("nse")


def test_an_axis_that_is_none_is_refused_with_those_that_there_are():
    learner = TactileLearner(**SETTINGS)
    with pytest.raises(AnnotationError, match=r"labels on, out of \[\]; came 'slip'"):
        learner.predict(ASKED[0], of="slip")
    felt(learner, 0, 6)
    for ask in (lambda: learner.predict(ASKED[0], of="slop"), lambda: learner.live(of="slop")):
        with pytest.raises(AnnotationError, match=r"labels on, out of \['slip'\]; came 'slop'"):
            ask()
    with pytest.raises(InputError, match="f\\* answers by materials, and not by labels on 'slip'"):
        learner.predict(ASKED[0], of="slip", tuned=True)
    with pytest.raises(UnknownMaterialError, match=r"names \['a'\], which were never observed"):
        learner.predict(ASKED[0], of="slip", scene=["a"])
