"""One content is one touch, whatever way it comes in; one that is to count again is held out with all its copies."""

import copy
import itertools
import pickle

import pytest
from forging import spoil_row
from scroll_tactile_store import StoreClosedError, StoreError, StoreFullError
from scroll_tactile_store.log_writer import LogWriter
from touches import fed, filled, held, stream

from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.persistence.contents import ListedContents
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.statistics.annotations import NO_ANNOTATION

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

    def test_a_snapshot_of_a_closed_memory_says_that_it_does_not_know_what_is_there(self, tmp_path):
        filled(tmp_path / "m", OBSERVED, exemplars=0)[0].close()
        learner = TactileLearner.open(tmp_path / "m")
        learner.close()
        for other in (pickle.loads(pickle.dumps(learner)), copy.deepcopy(copy.deepcopy(learner))):
            assert other.digest() == learner.digest()
            for call in ((other.names_of,), (other.observe, "a")):
                with pytest.raises(StoreClosedError, match="snapshot of a memory that was closed"):
                    call[0](*call[1:], stream((0, 60)))
            other.observe("a", stream((50, 60)), again=True)
            assert other.digest() == fed([*OBSERVED, ("a", (50, 60))]).digest()

    def test_a_repeated_receipt_equals_the_first(self, learner):
        readings = stream((90, 60))  # some are outside the range
        with learner.batch():
            first = learner.observe("a", readings)
        for same in (readings, readings.clip(0, 1)):
            again = learner.observe("a", same)
            assert again.repeated and again == first and hash(again) == hash(first)
        assert (first.clipped > 0, again.clipped) == (True, 0)
        assert learner.observe("a", readings, again=True) != first


class TestChanges:
    """What is there is what was observed and not retracted, whatever was done in between."""

    def test_what_was_taken_back_and_compacted_is_learned_again(self, tmp_path):
        learner, receipts = filled(tmp_path / "m", OBSERVED)
        learner.retract(receipts[8])
        with learner:
            assert learner.compact(keep=3).last_sequence == 9  # the row that was retracted is the last of them
            assert learner.names_of(stream(OBSERVED[8][1])) == []
            assert not learner.observe(*given(OBSERVED[8])).repeated

    def test_a_batch_that_is_lost_has_nothing_there(self, tmp_path, monkeypatch):
        learner, _ = filled(tmp_path / "m", OBSERVED[:4])

        def full(*_):
            raise StoreFullError("no space left")

        with learner:
            with pytest.raises(StoreError, match="nothing of this batch"), learner.batch():
                first = learner.observe(*given(OBSERVED[5]))
                assert learner.observe(*given(OBSERVED[5])).repeated and not first.durable
                monkeypatch.setattr(LogWriter, "stage", full)
                with pytest.raises(StoreFullError):
                    learner.observe(*given(OBSERVED[6]))
            monkeypatch.undo()
            assert not learner.observe(*given(OBSERVED[5])).repeated

    def test_damaged_rows_keep_nothing_from_being_learned(self, tmp_path):
        filled(tmp_path / "m", OBSERVED)[0].close()
        spoil_row(tmp_path / "m", 4, head=True)
        with TactileLearner.open(tmp_path / "m") as learner:
            assert not learner.observe("d", stream((70, 60))).repeated
            assert learner.observe(*given(OBSERVED[4])).repeated


class TestCopies:
    """Copies that were meant are held out together, and are a function of what was observed."""

    def test_one_in_memory_that_is_cut_short_leaves_no_trace(self, monkeypatch):
        learner = many(OBSERVED)
        before = _sample(learner)

        def cut(*_):
            raise KeyboardInterrupt

        monkeypatch.setattr(learner._ledger, "_changed", cut)
        with pytest.raises(KeyboardInterrupt):
            learner.observe(*given(OBSERVED[0]), again=True)
        with pytest.raises(KeyboardInterrupt):
            learner.observe("a", stream((90, 60)))
        monkeypatch.undo()
        assert _sample(learner) == before
        assert not learner.observe("a", stream((90, 60))).repeated


def test_three_times_everything_is_calibrated_as_once():
    pad = Sensor(name="pad", channels=6, rate=100.0, duration=1.0, low=0.0, high=1.0, unit="V")
    scene, answers = Scene(sensor=pad), []
    names = scene.materials[:4]
    for times in (1, 3):
        learner = TactileLearner(sensor=pad, embedding=Kernels(seed=0, dimension=128))
        for _, name, i in itertools.product(range(times), names, range(6)):
            learner.observe(name, scene.touch(name, i), again=True)
        answers.append(
            sum(learner.predict(scene.touch(name, 40 + i)).known is True for name in names for i in range(3))
        )
    assert min(answers) >= 11  # of twelve


def many(touches, **settings):
    """A memory without a path that observed these touches, each as often as it comes."""
    return fed(touches, again=True, **settings)


def test_a_row_that_is_not_there_is_no_error():
    held = ListedContents([("a", b"1", 1, NO_ANNOTATION)])
    held.remove("a", b"1", 2)
    held.remove("b", b"2", 1)
    assert held.names(b"1") == ["a"] and [*held.rows("a", b"1")] == [1] and not held.rows("a", b"3")


def given(pair):
    name, touch = pair
    return name, stream(touch)


def _sample(learner):
    return [(name, key, t.rows.tobytes(), t.pairs.tobytes(), t.copies) for name, key, t in learner.memory.sample]
