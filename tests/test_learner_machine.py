"""Random histories of a learner against a list of touches that cannot go wrong."""

import itertools
import shutil
import tempfile
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.errors import MismatchError, ObservationError, StreamError, UnknownMaterialError
from scroll_tactile.statistics.sample import TouchSample
from scroll_tactile.statistics.statistics import Statistics

SMALL = Kernels(seed=0, dimension=64)
PAD = Sensor(name="pad", channels=2, rate=50.0, low=0.0, high=1.0, unit="N", duration=1.0)
SETTINGS = {"sensor": PAD, "embedding": SMALL, "exemplars": 4}

materials = st.sampled_from(["a", "b", "c", "ü"])
descriptions = st.sampled_from([None, {"x": True}, {"x": 1.0}, {"x": 0.25, "y": 0.75}, {"x": False, "y": None}])
touches = st.tuples(st.integers(0, 5), st.sampled_from([5, 9, 15, 16, 25, 40, 90]))
histories = st.lists(st.tuples(materials, touches), max_size=6)


class SmallSample(TouchSample):
    """A pool that is soon full, so that what was left out of it has to come back."""

    def __init__(self, capacity=5):
        super().__init__(capacity)


def stream(touch):
    seed, readings = touch
    return np.random.default_rng([seed, readings]).uniform(-0.1, 1.1, size=(readings, 2))


def fed(felt, described=(), **settings):
    learner = TactileLearner(**SETTINGS | settings)
    for material, one in dict(described).items():
        learner.describe(material, one)
    for material, touch in felt:
        learner.observe(material, stream(touch))
    return learner


def require_same(learner, felt, described=()):
    """All that is kept of what was observed is, to the byte, what a memory keeps that observed it in another order."""
    whole = fed(sorted(felt), described, readout=learner.settings.readout)
    assert learner.digest() == whole.digest()
    assert learner.exemplars == whole.exemplars
    ours, theirs = (
        [(material, key, touch.sums.tobytes(), touch.pairs.tobytes()) for material, key, touch in one.memory.sample]
        for one in (learner, whole)
    )
    assert ours == theirs
    for touch in ((7, 25), (8, 6), (9, 60)):
        assert learner.predict(stream(touch)) == whole.predict(stream(touch))
    assert repr(learner.descriptions) == repr(whole.descriptions)
    if described:
        assert repr(learner.compose(stream((7, 25)))) == repr(whole.compose(stream((7, 25))))


@dataclass(frozen=True)
class Felt:
    """An observation of the model; fixed: it can no longer be retracted."""

    sequence: int
    material: str
    touch: tuple
    fixed: bool = False

    @property
    def pair(self):
        return self.material, self.touch


class History(RuleBasedStateMachine):
    """The model: what was observed and not retracted, in a list."""

    def __init__(self):
        super().__init__()
        self.home = Path(tempfile.mkdtemp())
        self.names = (str(number) for number in itertools.count())
        self.felt: list[Felt] = []
        self.described: dict[str, dict] = {}
        self.last = 0
        self.pools = mock.patch("scroll_tactile.memory.state.TouchSample", SmallSample)
        self.pools.start()

    def open(self, path, readout="lda", mode="write"):
        return TactileLearner.open(path, readout=readout, mode=mode, **SETTINGS)

    @initialize()
    def create(self):
        self.path = self.home / next(self.names)
        self.learner = self.open(self.path)
        self.reader = self.open(self.path, mode="read")

    def note(self, receipt, material, touch):
        self.last += 1
        assert receipt.sequence == self.last
        self.felt.append(Felt(self.last, material, touch))

    @rule(material=materials, touch=touches)
    def observe(self, material, touch):
        receipt = self.learner.observe(material, stream(touch))
        assert receipt.durable
        self.note(receipt, material, touch)

    @rule(felt=histories, fails=st.booleans())
    def observe_together(self, felt, fails):
        receipts = []
        try:
            with self.learner.batch():
                receipts += [self.learner.observe(name, stream(touch)) for name, touch in felt]
                if fails:
                    self.learner.observe("a", [])
        except StreamError:
            assert fails
        assert not any(receipt.durable for receipt in receipts)
        for receipt, one in zip(receipts, felt, strict=True):
            self.note(receipt, *one)

    @rule(data=st.data())
    @precondition(lambda self: any(not one.fixed for one in self.felt))
    def retract(self, data):
        one = data.draw(st.sampled_from([one for one in self.felt if not one.fixed]))
        self.learner.retract(one.sequence)
        self.felt.remove(one)
        self.last += 1
        with pytest.raises(ObservationError, match="already"):
            self.learner.retract(one.sequence)

    def say(self, material, one):
        self.last += repr(self.described.get(material)) != repr(one)
        self.described.pop(material, None)
        self.described |= {} if one is None else {material: one}

    @rule(material=materials, one=descriptions)
    def describe(self, material, one):
        before = self.learner.digest()
        self.learner.describe(material, one)
        assert self.learner.digest() == before
        self.say(material, one)
        assert self.learner.memory.sequence == self.last

    @rule(material=materials)
    def forget(self, material):
        before = [one for one in self.felt if one.material == material]
        if not before or any(one.fixed for one in before):
            with pytest.raises(ObservationError if before else UnknownMaterialError):
                self.learner.forget(material)
            return
        assert self.learner.forget(material) == len(before)
        self.felt = [one for one in self.felt if one.material != material]
        self.described.pop(material, None)
        self.last += 1

    @rule(keep=st.integers(0, 4))
    def compact(self, keep):
        self.learner.compact(keep=keep)
        loose = [one for one in self.felt if not one.fixed]
        upto = self.last if keep == 0 else loose[-keep].sequence - 1 if len(loose) > keep else 0
        self.felt = [replace(one, fixed=one.fixed or one.sequence <= upto) for one in self.felt]
        for one in self.felt:
            if one.fixed:
                with pytest.raises(ObservationError):
                    self.learner.retract(one.sequence)

    @rule(
        felt=histories,
        taken=st.sets(st.integers(0, 5)),
        keep=st.none() | st.integers(0, 3),
        once=st.booleans(),
        said=st.dictionaries(materials, descriptions, max_size=2),
        late=st.booleans(),
        choice=st.sampled_from(["same", "ours", "theirs"]),
    )
    def merge(self, felt, taken, keep, once, said, late, choice):
        """Another memory, which takes some back, describes some and may be compacted, comes in."""
        with self.open(self.home / next(self.names)) as other:

            def describe():
                for name, one in said.items():
                    other.describe(name, one)

            if not late:
                describe()
            receipts = [other.observe(name, stream(touch)) for name, touch in felt]
            for at in sorted(taken):
                if at < len(felt):
                    other.retract(receipts[at])
            left = [one for at, one in enumerate(felt) if at not in taken]
            if keep is not None:
                other.compact(keep=keep)
            fixed = len(left) if keep == 0 else 0 if keep is None else max(0, len(left) - keep)
            based = other._ledger.memory.base > 0
            if late:
                describe()
            ours = {one.pair for one in self.felt}
            shared = [at for at, one in enumerate(left) if one in ours]
            if once and any(at < fixed for at in shared):
                with pytest.raises(ObservationError, match="cannot be counted once"):
                    self.learner.merge(other, shared="once")
                return
            new = {name: one for name, one in said.items() if one and repr(self.described.get(name)) != repr(one)}
            if choice == "same" and set(new) & set(self.described):
                with pytest.raises(MismatchError, match="described differently"):
                    self.learner.merge(other, shared="once" if once else "twice")
                choice = "theirs"
            merged = self.learner.merge(other, shared="once" if once else "twice", descriptions=choice)
        new = {name: one for name, one in new.items() if choice == "theirs" or name not in self.described}
        assert merged.described == len(new)
        for name, one in new.items():
            self.say(name, one)
        coming = [at for at in range(len(left)) if not (once and at in shared)]
        assert (merged.observations, merged.shared) == (len(coming), len(shared))
        self.last += based
        for at in coming:
            self.last += 1
            self.felt.append(Felt(self.last, *left[at], fixed=at < fixed))

    @rule(touch=touches, scene=st.none() | st.lists(materials, min_size=1))
    def predict(self, touch, scene):
        felt = {one.material for one in self.felt}
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
        self.learner = self.open(self.path, readout)
        require_same(self.learner, [one.pair for one in self.felt], self.described)

    @rule(readout=st.sampled_from(["lda", "ridge"]))
    def abandon(self, readout):
        """Leave the memory as it lies on the disk, as a kill would, and go on from there."""
        before, self.path = self.path, self.home / next(self.names)
        shutil.copytree(before, self.path, ignore=shutil.ignore_patterns("*-shm", "lock"))
        self.learner.close()
        self.reader.close()
        self.learner = self.open(self.path, readout)
        self.reader = self.open(self.path, mode="read")

    @rule()
    def refresh(self):
        self.reader.refresh()
        require_same(self.reader, [one.pair for one in self.felt], self.described)
        assert not self.reader.refresh()

    @rule(data=st.data())
    def split_and_add(self, data):
        """The statistics of two memories that share the touches are, together, those of the one that observed all."""
        sides = [data.draw(st.booleans()) for _ in self.felt]
        parts = [fed(one.pair for one, side in zip(self.felt, sides, strict=True) if side == part) for part in (0, 1)]
        ours, theirs = (part.memory.statistics for part in parts)
        whole = self.learner.memory.statistics
        assert ours + theirs == whole
        assert whole - ours == theirs
        assert whole - whole == Statistics(SMALL.dimension, whole.scales)

    @invariant()
    @precondition(lambda self: hasattr(self, "learner"))
    def agrees(self):
        assert self.learner.materials == dict(sorted(Counter(one.material for one in self.felt).items()))

    def teardown(self):
        if hasattr(self, "learner"):
            for _ in range(2):
                require_same(self.learner, [one.pair for one in self.felt], self.described)
                self.learner.close()
                self.learner = self.open(self.path, self.learner.settings.readout)
            self.learner.close()
            self.reader.close()
        self.pools.stop()
        shutil.rmtree(self.home)


History.TestCase.settings = settings(
    max_examples=25, stateful_step_count=15, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
TestHistory = History.TestCase
