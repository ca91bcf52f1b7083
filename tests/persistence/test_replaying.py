"""However a memory came to be, it holds the same bytes: observed, replayed, merged, compacted, followed by a reader."""

import json
import shutil

import pytest
from commands import run
from forging import spoil_row
from scroll_tactile_store import DamageError, Store
from touches import OBSERVED, PAD, SMALL, OwnKernels, fed, filled, held, stream, without

from examples.paper.transfer.maps import Maps
from scroll_tactile import Joined, TactileLearner
from scroll_tactile.persistence import ledger

MADE = {
    "kernels": {"embedding": SMALL},
    "a user's own": {"embedding": OwnKernels(seed=0, dimension=64)},
    "maps, no exemplars": {"embedding": Maps(layout=(2,)), "exemplars": 0},
    "joined": {"embedding": Joined(SMALL, Maps(layout=(2,)))},
}


@pytest.fixture(params=MADE)
def made(request):
    return {"sensor": PAD, "exemplars": 4} | MADE[request.param]


def observe(learner, touches):
    return [learner.observe(name, stream(touch)) for name, touch in touches]


HELD = {}


def fresh(made, touches):
    """What a memory holds that observed these touches; made once of each."""
    key = repr((sorted((name, id(value)) for name, value in made.items()), touches))
    if key not in HELD:
        HELD[key] = held(fed(touches, **made)), made  # which no other object is then taken for
    return HELD[key][0]


def test_replayed_retracted_merged_and_compacted_it_is_what_observing_gives(made, tmp_path):
    with TactileLearner.open(tmp_path / "m", **made) as learner:
        receipts = observe(learner, OBSERVED[:8])
        learner.retract(receipts[2])
    shutil.rmtree(tmp_path / "m" / "checkpoints")
    with TactileLearner.open(tmp_path / "m", **made) as learner:
        learner.retract(receipts[5])
        with TactileLearner.open(tmp_path / "other", **made) as other:
            observe(other, OBSERVED[6:])
        learner.merge(tmp_path / "other")
        assert held(learner) == fresh(made, without(2, 5))
        learner.compact(keep=5)
        assert held(learner) == fresh(made, without(2, 5))
        learner.retract(learner.observations()[-1].sequence)
        assert held(learner) == fresh(made, without(2, 5, 11))
    with TactileLearner.open(tmp_path / "m", **made) as learner:
        assert held(learner) == fresh(made, without(2, 5, 11))
        learner.compact()
        assert held(learner) == fresh(made, without(2, 5, 11))


@pytest.mark.parametrize("made", ["kernels", "maps, no exemplars"], indirect=True)
def test_a_reader_follows_every_change(made, tmp_path, monkeypatch):
    with TactileLearner.open(tmp_path / "m", **made) as writer:
        receipts = observe(writer, OBSERVED[:4])
        with TactileLearner.open(tmp_path / "m", mode="read", **made) as reader:
            monkeypatch.setattr(reader._ledger, "_empty", None)  # row by row, and not from the beginning
            for at, (name, touch) in enumerate(OBSERVED[4:], start=4):
                writer.observe(name, stream(touch))
                assert reader.refresh()
                assert not reader.refresh()
                if at % 4 == 3:
                    assert held(reader) == fresh(made, OBSERVED[: at + 1])
            writer.describe("a", {"wool": 1.0})
            writer.retract(receipts[1])
            assert reader.refresh()
            assert held(reader)[:-1] == fresh(made, without(1))[:-1]
            assert reader.descriptions == {"a": {"wool": 1.0}}
            writer.forget("a")
            version = reader._ledger.version
            reader.refresh()
            assert reader._ledger.changed_since(version) == {"a"}
            assert held(reader) == fresh(made, [pair for pair in without(1) if pair[0] != "a"])


def test_a_reader_stays_as_it_was_where_a_row_is_damaged(tmp_path):
    made = {"sensor": PAD, "embedding": SMALL, "exemplars": 4}
    with TactileLearner.open(tmp_path / "m", **made) as writer:
        observe(writer, OBSERVED[:4])
        with TactileLearner.open(tmp_path / "m", mode="read", **made) as reader:
            observe(writer, OBSERVED[4:])
            spoil_row(tmp_path / "m", 8)
            for _ in range(2):
                with pytest.raises(DamageError):
                    reader.refresh()
                assert held(reader) == fresh(made, OBSERVED[:4])


def test_a_reader_takes_an_f_star_where_it_is_another_one(tmp_path):
    made = {"sensor": PAD, "embedding": SMALL, "exemplars": 4}
    with TactileLearner.open(tmp_path / "m", **made) as writer:
        receipts = observe(writer, OBSERVED[:6])
        with TactileLearner.open(tmp_path / "m", mode="read", **made) as reader:
            writer.fine_tune(epochs=1)
            assert reader.refresh()
            assert reader.tuned_digest() == writer.tuned_digest() is not None
            tuned = reader.memory.tuned
            observe(writer, [("a", (9, 60))])
            writer._ledger._write_checkpoint()
            assert reader.refresh()
            assert reader.memory.tuned is tuned
            writer.fine_tune(epochs=1)
            writer.retract(receipts[0])  # behind the checkpoint that has it
            assert reader.refresh()
            assert reader.tuned_digest() is writer.tuned_digest() is None


@pytest.mark.parametrize("made", ["kernels", "maps, no exemplars"], indirect=True)
def test_a_memory_that_was_killed_is_inspected_without_its_embedding(made, tmp_path):
    learner = TactileLearner.open(tmp_path / "m", **made)
    observe(learner, OBSERVED)
    learner._ledger.store.close()  # as if the power failed: the rows are in no checkpoint
    assert json.loads(run("inspect", tmp_path / "m", "--json").stdout)["digest"] == learner.digest()


@pytest.mark.parametrize("made", ["kernels", "maps, no exemplars"], indirect=True)
def test_a_checkpoint_is_written_each_so_many_rows(made, tmp_path, monkeypatch):
    monkeypatch.setattr(ledger, "CHECKPOINT_EVERY", 5)
    killed = TactileLearner.open(tmp_path / "m", **made)
    observe(killed, OBSERVED)
    killed._ledger.store.close()
    with TactileLearner.open(tmp_path / "m", **made) as learner:
        assert learner.memory.saved == 10
        assert held(learner) == fresh(made, OBSERVED)
    with Store.open(tmp_path / "m", mode="read") as store:
        assert not any(name.startswith("exemplars-held") for name in store.latest().arrays)


def test_a_checkpoint_that_takes_the_place_of_one_has_its_weighing(tmp_path):
    learner, _ = filled(tmp_path / "m")
    with learner:
        learner.settle()
    for compacting in (False, True, False):
        with TactileLearner.open(tmp_path / "m") as learner:
            weighings = dict(learner.memory.weighings)
            assert weighings
            if compacting:
                learner.compact()
    with TactileLearner.open(tmp_path / "m", mode="read") as learner:
        assert learner.memory.weighings == weighings
