"""A user certifies their own learner: what keeps every promise, and what breaks one, which is then named."""

import numpy as np
import pytest

from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.errors import LearnerError
from scroll_tactile.simulation.gel import SMALL as CAMERA
from scroll_tactile.testing import check_learner

PAD = Sensor(name="pad", channels=3, rate=50.0, low=(0.0, -1.0, 0.0), high=(1.0, 1.0, 9.0), unit="N", duration=1.0)
SMALL = Kernels(dimension=64)
WAYS = {
    "ridge, no exemplars": {"sensor": PAD, "embedding": SMALL, "readout": "ridge", "exemplars": 0},
    "no kept touches": {"sensor": PAD, "embedding": SMALL, "kept_touches": 0},
    "camera": {"sensor": CAMERA},
}


RNG = np.random.default_rng(0)
TOUCHES = [("ab"[i % 2], RNG.random((60, 3))) for i in range(6)]  # as few as it takes


@pytest.mark.parametrize("way", WAYS)
def test_a_learner_keeps_its_promises(way):
    touches = None if way == "camera" else TOUCHES  # the usual learner is that of the docstring
    held = check_learner(lambda path: TactileLearner.open(path, **WAYS[way]), touches=touches)
    assert len(held) == 14


class Forgetful(TactileLearner):
    def retract(self, receipt):
        """Do nothing."""


class Hasty(TactileLearner):
    def predict(self, stream, **asked):
        self.observe("seen", stream)
        return super().predict(stream, **asked)


class Ordered(TactileLearner):
    def observe(self, material, stream):
        return super().observe(material, np.asarray(stream) * (0.5 if self.materials else 1.0))


class Careless(TactileLearner):
    def observe(self, material, stream, **noted):
        return super().observe(material, np.nan_to_num(np.asarray(stream)), **noted)


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (Ordered, "order: expected the same digest"),
        (Forgetful, "retract: expected the same digest"),
        (Hasty, "predict: the memory or its answer changed"),
        (Careless, "expected NotFiniteError; the stream was observed"),
    ],
)
def test_one_that_breaks_a_promise_is_named(kind, said):
    with pytest.raises(LearnerError, match=said):
        check_learner(lambda path: kind.open(path, sensor=PAD, embedding=SMALL, kept_touches=0), touches=TOUCHES)


def test_too_few_touches_are_refused():
    with pytest.raises(LearnerError, match="three touches or more"):
        check_learner(lambda path: TactileLearner.open(path, sensor=PAD, embedding=SMALL), touches=TOUCHES[:3])
