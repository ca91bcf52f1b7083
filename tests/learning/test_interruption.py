"""An observation that is cut off halfway, by ctrl-C say, is there as a whole or not at all."""

import itertools
import linecache
import sys

import pytest
from touches import PAD, SMALL, SmallSample, stream

from scroll_tactile import Kernels, TactileLearner, sensors
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.statistics.moments import SecondMoment

SCENE = Scene(sensor=sensors.ROBOSKIN, seed=2)
TOUCHES = [(name, SCENE.touch(name, i)) for i in range(3) for name in SCENE.materials[:2]]


def small(path):
    return TactileLearner.open(path, sensor=sensors.ROBOSKIN, embedding=Kernels(dimension=64))


def expected(touches):
    learner = TactileLearner(sensor=sensors.ROBOSKIN, embedding=Kernels(dimension=64))
    for touch in touches:
        learner.observe(*touch)
    return learner.digest()


@pytest.fixture
def cut_off(monkeypatch):
    """Interrupts the second sum of the next observation: one scale is added, the other is not."""
    calls = []
    whole = SecondMoment.add

    def add(self, codes):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        whole(self, codes)

    def start():
        calls.clear()
        monkeypatch.setattr(SecondMoment, "add", add)

    return start


def test_going_on_after_it_loses_nothing(tmp_path, cut_off):
    with small(tmp_path) as learner:
        for touch in TOUCHES[:4]:
            learner.observe(*touch)
        cut_off()
        with pytest.raises(KeyboardInterrupt):
            learner.observe(*TOUCHES[4])
        learner.observe(*TOUCHES[5])
        assert learner.digest() == expected(TOUCHES)
    with small(tmp_path) as again:
        assert again.digest() == expected(TOUCHES)


def interrupted(call, at):
    """Whether a KeyboardInterrupt in the `at`-th line of scroll_tactile that `call` runs through cut it short.

    Not where a block ends: Python looks for signals at calls and jumps, and not between a block and its exit.
    """
    lines = itertools.count()

    def line(frame, event, _):
        ends = linecache.getline(frame.f_code.co_filename, frame.f_lineno).lstrip().startswith("with ")
        if event == "line" and not ends and next(lines) == at:
            raise KeyboardInterrupt
        return line

    def called(frame, event, _):
        return line if "/scroll_tactile/" in frame.f_code.co_filename else None

    before = sys.gettrace()
    sys.settrace(called)
    try:
        call()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(before)
    return False


def state(learner):
    """All that a memory without a path holds, to the byte."""
    memory, kept = learner.memory, learner.memory.kept
    pool = [(name, key, touch.rows.tobytes()) for name, key, touch in memory.sample]
    kept_levels = [(touch.material, touch.key, touch.levels.tobytes()) for touch in kept.touches()]
    return (
        learner.digest(),
        learner.materials,
        learner.exemplars,
        pool,
        kept_levels,
        learner.descriptions,
        memory.sequence,
    )


def without_a_path(touches):
    learner = TactileLearner(sensor=PAD, embedding=SMALL, exemplars=2, kept_touches=4)
    for touch in touches:
        learner.observe(*touch)
    return learner


@pytest.fixture
def soon_full(monkeypatch):
    """Also of a memory that is read again after an interrupt."""
    monkeypatch.setattr("scroll_tactile.memory.state.TouchSample", SmallSample)


@pytest.mark.usefixtures("soon_full")
class TestWithoutAPath:
    """An interrupt at any line leaves it before or after the change, and what comes then is as if it never was."""

    @pytest.mark.parametrize("count", [0, 8, 26])  # nothing, a new material, and blocks of rows that are full
    def test_observing(self, monkeypatch, count):
        monkeypatch.setattr("scroll_tactile.statistics.moments.BLOCK", 64)
        names = [*"abcdefgh", "i"]
        touches = [(names[min(i, 8)], stream((i, 30))) for i in range(28)]
        before, after = (state(without_a_path(touches[: count + more])) for more in (0, 1))
        whole = without_a_path([*touches[:count], touches[count], touches[27]])
        end, answer = state(whole), (whole.settle(), whole.predict(stream((99, 30))))[1]
        at, cut = 0, True
        while cut:
            learner = without_a_path(touches[:count])
            if count > 8:
                learner.predict(stream((98, 30)))
            cut = interrupted(lambda made=learner: made.observe(*touches[count]), at)
            found = state(learner)
            assert found in (before, after), at
            if found == before:
                learner.observe(*touches[count])
            learner.observe(*touches[27])
            assert state(learner) == end, at
            followed = dict(learner.predict(stream((99, 30))).ranking)
            assert followed == pytest.approx(dict(answer.ranking), abs=0.2), at
            learner.settle()
            assert learner.predict(stream((99, 30))) == answer, at
            at += 1 + at // 2
        assert at > 60

    def test_describing(self):
        at, cut = 0, True
        while cut:
            learner = without_a_path([("a", stream((0, 30)))])
            learner.describe("a", {"wool": 1.0})
            *before, _ = state(learner)  # each description is a row
            cut = interrupted(lambda made=learner: made.describe("a", {"silk": 1.0}), at)
            assert learner.descriptions in ({"a": {"wool": 1.0}}, {"a": {"silk": 1.0}})
            learner.describe("a", {"wool": 1.0})
            assert list(state(learner)[:-1]) == before
            at += 1
        assert at > 10

    def test_summing_what_waits(self):
        """Whoever only reads sums up the rows that wait: cut short there, nothing is counted twice."""
        touches = [(name, stream((i, 30))) for i, name in enumerate("abcabcabc")]
        digest = without_a_path(touches).digest()
        at, cut = 0, True
        while cut:
            learner = without_a_path(touches)
            cut = interrupted(learner.digest, at)
            assert learner.digest() == digest, at
            at += 1 + at // 6
        assert at > 50


def test_closing_after_it_saves_no_half(tmp_path, cut_off):
    learner = small(tmp_path)
    for touch in TOUCHES[:4]:
        learner.observe(*touch)
    cut_off()
    with pytest.raises(KeyboardInterrupt), learner:
        learner.observe(*TOUCHES[4])
    with small(tmp_path) as again:
        assert again.digest() == expected(TOUCHES[:5])  # its journal row was durable
