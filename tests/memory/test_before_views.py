"""Memories made before whole touches were viewed: they are as those of now, as far as the readings are there."""

import numpy as np
import pytest
from touches import OBSERVED, SETTINGS, Windowed, contents, fed, filled, require_same, stream, without

from scroll_tactile import Kernels, TactileLearner
from scroll_tactile.memory.rows import pack_readings, row_codes
from scroll_tactile.memory.state import Memory
from scroll_tactile.signals.windows import Scale, WindowPlan

WINDOWED = Windowed(seed=0, dimension=64)
NAMES = ("a", "b", "c")


@pytest.fixture
def before(tmp_path, monkeypatch):
    """Makes a memory as version 0.3 did, whose kernels read windows alone, and compacts it but for the last rows."""

    def made(name="m", observed=OBSERVED, keep=None):
        with monkeypatch.context() as patch:
            patch.setattr(Kernels, "capabilities", Windowed.capabilities)
            learner, _ = filled(tmp_path / name, observed)
            with learner:
                if keep is not None:
                    learner.compact(keep=keep)
                assert learner.plan.views == ()
        return tmp_path / name

    return made


def answers(learner):
    learner.settle()
    return [learner.predict(stream(touch)) for touch in ((7, 25), (9, 60), (9, 300))]


@pytest.mark.parametrize("mode", ["write", "read"])
def test_it_is_embedded_again_and_then_as_one_that_observed_its_touches_now(before, mode):
    with TactileLearner.open(before(), mode=mode) as learner:
        require_same(learner, OBSERVED)


def test_that_happens_once(before, monkeypatch):
    path, embedded = before(), []
    codes = Memory.codes
    monkeypatch.setattr(Memory, "codes", lambda self, record: embedded.append(record) or codes(self, record))
    with TactileLearner.open(path) as learner:
        assert len(embedded) >= len(OBSERVED)
        digest = learner.digest()
    embedded.clear()
    with TactileLearner.open(path) as learner:
        assert learner.digest() == digest
    assert not embedded


def test_it_can_be_retracted_from_compacted_and_merged(before, tmp_path):
    with TactileLearner.open(before()) as learner:
        learner.retract(2)
        require_same(learner, without(1))
        learner.compact()
        require_same(learner, without(1))
    ours, _ = filled(tmp_path / "ours", OBSERVED[:1])
    with ours:
        ours.merge(before("other", OBSERVED[1:]), shared="once")
        require_same(ours, OBSERVED)


def test_what_was_compacted_is_judged_by_windows_alone(before):
    with TactileLearner.open(before(keep=0)) as learner:
        assert learner.model().views == []
        windowed = fed(OBSERVED, embedding=WINDOWED)
        assert answers(learner) == answers(windowed)
        for i, name in enumerate(NAMES):
            assert learner.model().views == []
            learner.observe(name, stream((20 + i, 60)))
            windowed.observe(name, stream((20 + i, 60)))
            learner.settle()
        assert learner.model().views != []  # of every material there is one to see
        assert answers(learner) != answers(windowed)


def test_a_compacted_one_comes_into_one_with_views(before, tmp_path):
    ours, _ = filled(tmp_path / "ours", OBSERVED)
    with ours:
        ours.merge(before(observed=[("old", (30 + i, 60)) for i in range(4)], keep=0), shared="once")
        assert ours.model().views == []
        found = contents(ours)
        assert {material for material, _ in ours.predict(stream((9, 60))).ranking} == {*NAMES, "old"}
    with TactileLearner.open(tmp_path / "ours", **SETTINGS) as again:
        assert contents(again) == found
        again.forget("c")
        again.merge(before("other", OBSERVED[2:3]), shared="once")
        assert again.materials == {"a": 4, "b": 4, "c": 1, "old": 4}
        again.forget("a")
        again.observe("old", stream((40, 60)))
        assert again.model().views != []


@pytest.mark.parametrize("kept", [True, False])
def test_rows_of_windows_are_embedded_again_where_they_hold_readings(kept):
    """Those of the first versions hold the codes of all windows, and readings for exemplars."""
    plan, calls = WindowPlan((15, 37), whole=50), []
    arrays = {"codes-15": np.zeros((len(plan.extent(20)[15]), 64), np.int32)}
    again = {scale: np.ones((1, 64), np.int32) for scale in (Scale("window", 15), *plan.views)}
    found = row_codes(
        arrays | (pack_readings(np.ones((20, 2), np.float32)) if kept else {}),
        20,
        plan,
        lambda readings: calls.append(readings.shape) or again,
    )
    assert calls == ([(20, 2)] if kept else [])
    assert (found is again) == kept
    assert set(found) == (set(again) if kept else {Scale("window", 15)})


@pytest.mark.parametrize("keep", [None, 0, 5])
def test_a_fine_tune_leaves_it_as_it_was(before, keep):
    with TactileLearner.open(before(keep=keep)) as learner:
        digest, found = learner.digest(), answers(learner)
        assert learner.fine_tune(epochs=1).digest == learner.tuned_digest()
        assert (learner.digest(), answers(learner)) == (digest, found)
