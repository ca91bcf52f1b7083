"""Random histories of a learner against a list of touches that cannot go wrong."""

import shutil
import tempfile
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.ridge.statistics import Statistics

SMALL = Kernels(seed=0, dimension=64)
PAD = Sensor(name="pad", channels=2, rate=50.0, low=0.0, high=1.0, unit="N", duration=1.0)

materials = st.sampled_from(["a", "b", "c", "ü"])
touches = st.tuples(st.integers(0, 5), st.sampled_from([5, 9, 15, 16, 25, 40, 90]))


def stream(touch):
    seed, readings = touch
    return np.random.default_rng([seed, readings]).uniform(-0.1, 1.1, size=(readings, 2))


def fed(felt):
    learner = TactileLearner(sensor=PAD, embedding=SMALL)
    for material, touch in felt:
        learner.observe(material, stream(touch))
    return learner


class History(RuleBasedStateMachine):
    """The model: what was observed, in a list."""

    def __init__(self):
        super().__init__()
        self.home = Path(tempfile.mkdtemp())
        self.lives = 0
        self.felt = []

    def open(self, readout="lda"):
        return TactileLearner.open(self.home / str(self.lives), sensor=PAD, embedding=SMALL, readout=readout)

    @initialize()
    def create(self):
        self.learner = self.open()

    @rule(material=materials, touch=touches)
    def observe(self, material, touch):
        receipt = self.learner.observe(material, stream(touch))
        self.felt.append((material, touch))
        assert receipt.durable
        assert receipt.sequence == len(self.felt)

    @rule(touch=touches, scene=st.none() | st.lists(materials, min_size=1))
    def predict(self, touch, scene):
        felt = {material for material, _ in self.felt}
        scene = scene and [name for name in scene if name in felt]
        prediction = self.learner.predict(stream(touch), scene=scene or None)
        assert {name for name, _ in prediction.ranking} == set(scene or felt)
        shares = [share for _, share in prediction.ranking]
        assert not shares or abs(sum(shares) - 1) < 1e-9
        assert np.isfinite(shares).all()

    @rule()
    def refuse(self):
        for material, readings in (("a", np.full((50, 2), np.nan)), ("a", []), ("", np.zeros((50, 2)))):
            try:
                self.learner.observe(material, readings)
            except ValueError:
                continue
            raise AssertionError("not refused")

    @rule(readout=st.sampled_from(["lda", "ridge"]))
    def reopen(self, readout):
        self.learner.close()
        self.learner = self.open(readout)

    @rule(readout=st.sampled_from(["lda", "ridge"]))
    def abandon(self, readout):
        """Leave the memory as it lies on the disk, as a kill would, and go on from there."""
        before = self.home / str(self.lives)
        self.lives += 1
        shutil.copytree(before, self.home / str(self.lives), ignore=shutil.ignore_patterns("*-shm", "lock"))
        self.learner.close()
        self.learner = self.open(readout)

    @rule(data=st.data())
    def split_and_merge(self, data):
        """Two memories that share the touches make, together, the one that felt them all."""
        sides = [data.draw(st.booleans()) for _ in self.felt]
        parts = [fed([one for one, side in zip(self.felt, sides, strict=True) if side == part]) for part in (0, 1)]
        ours, theirs = (part._memory.statistics for part in parts)
        whole = self.learner._memory.statistics
        assert ours + theirs == whole
        assert whole - ours == theirs
        assert whole - whole == Statistics(SMALL.dimension, whole.scales)

    @invariant()
    @precondition(lambda self: hasattr(self, "learner"))
    def agrees(self):
        counts = {}
        for material, _ in sorted(self.felt):
            counts[material] = counts.get(material, 0) + 1
        assert self.learner.materials == counts

    def teardown(self):
        if hasattr(self, "learner"):
            whole = fed(sorted(self.felt))
            for _ in range(2):
                assert self.learner.digest() == whole.digest()
                whole.readout = self.learner.readout
                for touch in ((7, 25), (8, 6), (9, 60)):
                    assert self.learner.predict(stream(touch)) == whole.predict(stream(touch))
                self.learner.close()
                self.learner = self.open(self.learner.readout)
            self.learner.close()
        shutil.rmtree(self.home)


History.TestCase.settings = settings(
    max_examples=25, stateful_step_count=15, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
TestHistory = History.TestCase
