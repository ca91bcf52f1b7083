"""One content of one material is one touch, whatever way it comes in, and whoever brings it is told."""

import copy
import pickle

import pytest
from scroll_tactile_store import StoreError, StoreFullError
from scroll_tactile_store.log import Log
from touches import SETTINGS, fed, filled, held, stream

from scroll_tactile import TactileLearner
from scroll_tactile.clients.learning.metrics import observe_all
from scroll_tactile.errors import AnnotationError, ObservationError
from scroll_tactile.quantities import Quantity

OBSERVED = [("abc"[i % 3], (i, 60)) for i in range(12)]  # a content each


@pytest.fixture(params=["path", "memory"])
def learner(request, tmp_path):
    """With a path, and without."""
    if request.param == "memory":
        yield fed(OBSERVED)
    else:
        made, _ = filled(tmp_path / "m", OBSERVED)
        with made:
            yield made


class TestOneContent:
    def test_the_same_again_is_the_receipt_that_is_there(self, learner):
        before = held(learner)
        for i, (name, touch) in enumerate(OBSERVED):
            receipt = learner.observe(name, stream(touch).tolist())
            assert (receipt.sequence, receipt.repeated) == (i + 1, True)
        assert held(learner) == before and sum(learner.materials.values()) == len(OBSERVED)
        assert not learner.observe("a", stream((77, 60))).repeated

    def test_another_name_is_learned_and_told(self, learner):
        assert learner.names_of(stream((0, 60))) == ["a"] and learner.names_of(stream((70, 60))) == []
        assert not learner.observe("b", stream((0, 60))).repeated
        assert learner.names_of(stream((0, 60))) == ["a", "b"]
        assert learner.observe("b", stream((0, 60))).repeated and learner.observe("a", stream((0, 60))).repeated

    @pytest.mark.parametrize("copied", [copy.deepcopy, lambda learner: pickle.loads(pickle.dumps(learner))])
    def test_a_snapshot_has_what_is_there_compacted(self, learner, copied):
        before = held(learner)
        other = copied(copied(learner))
        assert held(other) == before and other.observe(*given(OBSERVED[0])).repeated
        assert {row.state for row in other.observations()} == {"compacted"}
        later = other.observe("a", stream((77, 60)))
        with pytest.raises(ObservationError, match="rows 1 to 12 were compacted"):
            other.retract(1)
        other.retract(later)
        assert held(other) == before == held(learner)


class TestChanges:
    """What is there is what was observed and not retracted, whatever was done in between."""

    def test_a_batch_that_is_lost_has_nothing_there(self, tmp_path, monkeypatch):
        learner, _ = filled(tmp_path / "m", OBSERVED[:4])

        def full(*_):
            raise StoreFullError("no space left")

        with learner:
            with pytest.raises(StoreError, match="nothing of this batch"), learner.batch():
                first = learner.observe(*given(OBSERVED[5]))
                assert learner.observe(*given(OBSERVED[5])).repeated and not first.durable
                monkeypatch.setattr(Log, "stage", full)
                with pytest.raises(StoreFullError):
                    learner.observe(*given(OBSERVED[6]))
            monkeypatch.undo()
            assert not learner.observe(*given(OBSERVED[5])).repeated


class TestRelabel:
    """A touch that gets the name of one with its very readings is that one."""

    @pytest.mark.parametrize("merged", [False, True])
    def test_the_row_that_is_there_stays(self, tmp_path, merged):
        (learner, receipts), twin = filled(tmp_path / "m", OBSERVED[1:]), ("b", OBSERVED[0][1])
        with learner:
            if merged:
                filled(tmp_path / "o", [OBSERVED[0]])[0].close()
                learner.merge(tmp_path / "o")
            else:
                learner.observe(*given(OBSERVED[0]))
            there, last = learner.observations()[-1].sequence, learner._ledger.store.last
            other = learner.observe(*given(twin))
            assert learner.relabel(other, "a") == there and learner._ledger.store.last == last + 2
            assert held(learner) == held(fed(OBSERVED))
            assert learner.names_of(stream(twin[1])) == ["a"]
            learner.retract(there)
            assert held(learner) == held(fed(OBSERVED[1:]))
            assert learner.relabel(receipts[0], "c") == learner._ledger.store.last  # and without one it is a new row

    def test_with_other_values_or_labels_it_is_refused_and_nothing_changed(self, tmp_path):
        learner, _ = filled(tmp_path / "m", [])
        with learner:
            learner.declare(FORCE)
            learner.observe("a", stream((0, 60)), values={"force": 1})
            bare = learner.observe("b", stream((0, 60)))
            other = learner.observe("c", stream((0, 60)), values={"force": 2})
            before = held(learner), learner._ledger.store.last
            with pytest.raises(AnnotationError, match=r"observation 2 has this touch of 'a' .*'force': 1.* Retract it"):
                learner.relabel(other, "a")
            assert (held(learner), learner._ledger.store.last) == before
            assert learner.relabel(bare, "a") == 2 and learner.materials == {"a": 1, "c": 1}


FORCE = Quantity(name="force", unit="N", low=0, high=4, resolution=0.5)


def test_a_touch_that_a_pass_or_a_merge_brings_twice_is_one(tmp_path):
    with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner, filled(tmp_path / "o", OBSERVED[:1])[0] as other:
        touches = [(OBSERVED[0][0], learner.stream(stream(OBSERVED[0][1])))] * 2
        assert [observe_all(learner, touches) for _ in range(2)] == [2, 1]  # it looks once more, at one
        other.pack(tmp_path / "packed")
        for brought in (other, tmp_path / "packed"):
            merged = learner.merge(brought)
            assert (merged.observations, merged.shared) == (0, 1)
        assert held(learner) == held(fed(OBSERVED[:1]))


@pytest.mark.parametrize(("at", "cut"), [("_changed", OBSERVED), ("store.append", OBSERVED[:-1])])
def test_one_that_is_cut_short_is_whole_or_not_there(learner, monkeypatch, at, cut):
    learner.retract(12)

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(f"{__name__}.HERE", learner._ledger, raising=False)
        patched.setattr(f"{__name__}.HERE.{at}", interrupt)
        with pytest.raises(KeyboardInterrupt):
            learner.observe(*given(OBSERVED[-1]))
    assert held(learner) == held(fed(cut))
    assert learner.observe(*given(OBSERVED[-1])).repeated == (cut is OBSERVED)


def given(pair):
    name, touch = pair
    return name, stream(touch)
