"""An observation that is cut off halfway, by ctrl-C say, is there as a whole or not at all."""

import pytest

from scroll_tactile import Kernels, TactileLearner, sensors
from scroll_tactile.datasets.simulator import Scene
from scroll_tactile.errors import ScrollTactileError
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


def test_without_a_path_it_is_refused_rather_than_wrong(cut_off):
    learner = TactileLearner(sensor=sensors.ROBOSKIN, embedding=Kernels(dimension=64))
    learner.observe(*TOUCHES[0])
    cut_off()
    with pytest.raises(KeyboardInterrupt):
        learner.observe(*TOUCHES[1])
    with pytest.raises(ScrollTactileError, match="interrupted"):
        learner.digest()


def test_closing_after_it_saves_no_half(tmp_path, cut_off):
    learner = small(tmp_path)
    for touch in TOUCHES[:4]:
        learner.observe(*touch)
    cut_off()
    with pytest.raises(KeyboardInterrupt), learner:
        learner.observe(*TOUCHES[4])
    with small(tmp_path) as again:
        assert again.digest() == expected(TOUCHES[:5])  # its journal row was durable
