"""What was observed is retracted, brought together, made small and made durable in bulk: exactly."""

import pytest
from forging import spoil_row
from scroll_tactile_store import DamageError, ReadOnlyError, Store, StoreError, repair_store
from touches import OBSERVED, PAD, SETTINGS, OwnKernels, fed, filled, require_same, spoil, stream, without

from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.errors import FineTuneError, InputError, MismatchError, ObservationError, UnknownMaterialError
from scroll_tactile.signals.stream import validate


class TestRetract:
    def test_what_is_not_there_or_was_retracted_is_refused(self, path):
        learner, receipts = filled(path)
        with learner:
            for wrong in (0, -1, 99, True, 1.5, None):
                with pytest.raises(ObservationError, match="there is no observation"):
                    learner.retract(wrong)
            learner.retract(receipts[2])
            with pytest.raises(ObservationError, match=r"observation 3 .* was retracted already"):
                learner.retract(receipts[2])
            with pytest.raises(ObservationError, match=r"row 13 .* is no observation, .* but of kind 'retract'"):
                learner.retract(13)
            learner.describe("d", {"wool": 1.0})
            for name in ("d", "e"):
                with pytest.raises(UnknownMaterialError, match=f"'{name}' was never observed"):
                    learner.forget(name)
            require_same(learner, without(2), {"d": {"wool": 1.0}})

    def test_a_receipt_of_another_memory_is_refused(self, path, tmp_path):
        learner, _ = filled(path)
        other, receipts = filled(tmp_path / "other", OBSERVED[::-1])
        with learner, other:
            with pytest.raises(ObservationError, match=r"receipt is of another memory: .* of 'c'.* it is of 'a'"):
                learner.retract(receipts[0])
            require_same(learner, OBSERVED)

    def test_a_reader_cannot(self, path):
        learner, receipts = filled(path)
        learner.close()
        with TactileLearner.open(path, mode="read", **SETTINGS) as reader:
            changes = (lambda: reader.observe("a", stream((9, 60))), lambda: reader.retract(receipts[0]))
            for call in (*changes, lambda: reader.forget("a"), reader.compact):
                with pytest.raises(ReadOnlyError):
                    call()
            require_same(reader, OBSERVED)


class TestTuned:
    def test_retracted_while_it_is_being_made(self, path):
        learner, receipts = filled(path)
        with learner:
            taken = []

            def progress(what, done, of):
                if not taken:
                    taken.append(learner.retract(receipts[0]))

            with pytest.raises(FineTuneError, match="was retracted meanwhile"):
                learner.fine_tune(epochs=1, progress=progress)
            assert learner.tuned_digest() is None


class TestBatch:
    def test_all_are_there_at_its_end_and_none_before(self, path):
        with TactileLearner.open(path, **SETTINGS) as learner:
            reader = TactileLearner.open(path, mode="read", **SETTINGS)
            with learner.batch():
                receipts = [learner.observe(name, stream(touch)) for name, touch in OBSERVED]
                learner.retract(receipts[5])
                learner.describe("a", {"wool": 1.0})
                require_same(learner, without(5), {"a": {"wool": 1.0}})
                assert not any(receipt.durable for receipt in receipts)
                assert not reader.refresh()
            assert reader.refresh()
            require_same(reader, without(5), {"a": {"wool": 1.0}})
            before = reader.compose(stream((7, 25)))
            learner.describe("a", {"silk": 1.0})
            assert reader.refresh()
            assert reader.compose(stream((7, 25))) != before
            with pytest.raises(ReadOnlyError):
                reader.describe("a", None)
            reader.close()
        with TactileLearner.open(path, **SETTINGS) as again:
            require_same(again, without(5), {"a": {"silk": 1.0}}, answers=True)

    def test_within_it_nothing_that_needs_a_checkpoint(self, path):
        learner, _ = filled(path)
        with learner:
            with learner.batch():
                for call in (learner.compact, learner.fine_tune, learner.close):
                    with pytest.raises(InputError, match="end it first"):
                        call()
                with pytest.raises(InputError, match="end the batch"):
                    learner.merge(fed([("a", (8, 60))]))
                with learner.batch():  # a batch in a batch is the same batch
                    learner.observe("a", stream((9, 60)))
            require_same(learner, [*OBSERVED, ("a", (9, 60))])


class TestMerge:
    @pytest.mark.parametrize(
        ("settings", "said"),
        [
            ({"embedding": Kernels(seed=3, dimension=64)}, "their embeddings differ.* fingerprint"),
            ({"embedding": Kernels(seed=0, dimension=128)}, "their embeddings differ.*dimension 128 there, 64 here"),
            (
                {"sensor": Sensor(name="pad", channels=2, rate=50.0, low=0.0, high=2.0, unit="N", duration=1.0)},
                r"their sensors differ: high 2\.0 there, 1\.0 here",
            ),
        ],
    )
    def test_memories_of_another_making_are_refused(self, path, tmp_path, settings, said):
        ours, _ = filled(path)
        theirs, _ = filled(tmp_path / "other", OBSERVED[:3], **settings)
        with ours, theirs:
            with pytest.raises(MismatchError, match=said) as caught:
                ours.merge(theirs)
            assert str(path) in str(caught.value)
            assert str(tmp_path / "other") in str(caught.value)
            require_same(ours, OBSERVED)

    def test_without_readings_its_exemplars_cannot_be_had(self, path, tmp_path):
        own = OwnKernels(seed=0, dimension=64)
        ours, _ = filled(path, embedding=own)
        theirs, _ = filled(tmp_path / "other", [("d", (9, 60))], embedding=own, exemplars=0)
        with ours, theirs:
            with pytest.raises(MismatchError, match="kept no readings"):
                ours.merge(theirs)
            theirs.merge(ours)  # the other way round nothing is missing
            assert theirs.digest() == fed([*OBSERVED, ("d", (9, 60))], embedding=own).digest()
            theirs.compact()
            with pytest.raises(MismatchError, match="was compacted and keeps exemplars"):
                ours.merge(theirs)
            require_same(ours, OBSERVED, embedding=own)

    def test_itself_and_nothing_are_refused(self, path, tmp_path):
        ours, _ = filled(path)
        with ours:
            with pytest.raises(MismatchError, match="into itself"):
                ours.merge(path)
            with pytest.raises(StoreError, match="holds no store"):
                ours.merge(tmp_path / "none")
            require_same(ours, OBSERVED)

    def test_cut_off_in_the_middle_it_never_began(self, path, tmp_path):
        ours, _ = filled(path, OBSERVED[:4])
        theirs, _ = filled(tmp_path / "other", OBSERVED[4:])

        def stop(what, done, of):
            if done == 3:
                raise KeyboardInterrupt

        with ours, theirs:
            with pytest.raises(KeyboardInterrupt):
                ours.merge(theirs, progress=stop)
            require_same(ours, OBSERVED[:4])
            theirs.compact(keep=3)
            steps = []
            ours.merge(theirs, progress=lambda *step: steps.append(step))
            assert steps[-1] == ("merging", 9, 9)  # what it was compacted to, and a row for each stream
            require_same(ours, OBSERVED)


def test_a_compaction_checkpoint_is_gone_on_from_where_all_else_is_lost(path, caplog):
    learner, receipts = filled(path)
    learner.retract(receipts[1])  # before the compaction checkpoints
    learner.retract(receipts[10])  # behind them
    learner.compact(keep=8)
    learner.compact(keep=4)  # which still knows what the one before it left out
    learner.retract(receipts[11])
    later = learner.observe("a", stream((9, 60)))
    expected = [*without(1, 10, 11), ("a", (9, 60))]
    require_same(learner, expected)
    learner._ledger.store.close()  # as if the power failed
    with Store.open(path) as store:
        newest, compaction = store.state().newest, store.compaction().number
    assert newest != compaction
    spoil(path, newest)
    with TactileLearner.open(path, **SETTINGS) as learner:
        assert learner.memory.checkpoint == compaction
        require_same(learner, expected)
        learner.retract(later)
        require_same(learner, expected[:-1])
    with TactileLearner.open(path, **SETTINGS) as learner:
        require_same(learner, expected[:-1])
    assert "still counts" not in caplog.text


def test_what_damage_keeps_from_being_retracted_is_named(path, caplog):
    learner, _ = filled(path)
    learner.close()
    learner = TactileLearner.open(path, **SETTINGS)
    learner.retract(1)
    learner._ledger.store.close()  # as if the power failed: the row is there, a checkpoint without it is not
    spoil_row(path, 5)
    repaired = repair_store(path)
    assert repaired.kept == 13
    assert "what rows behind 12 took back of them counts again" in repaired.lost[-1]
    with TactileLearner.open(path, **SETTINGS) as again:
        require_same(again, OBSERVED, exemplars=False)
        assert again.exemplars == {}  # the repair gave up the rows that held their readings
        assert "the readings of 12 candidates for exemplars were lost to damage" in caplog.text
        again.compact()
        assert again.exemplars == {}
    assert "observation 1 was retracted by row 13, but still counts" in caplog.text


def test_a_compaction_interrupted_when_it_was_done_already_is_known(path, monkeypatch):
    learner, receipts = filled(path)
    with learner:

        def interrupted(_):
            raise KeyboardInterrupt

        with monkeypatch.context() as broken:
            broken.setattr(Store, "_remove_unnamed", interrupted)
            with pytest.raises(KeyboardInterrupt):
                learner.compact(keep=2)
        require_same(learner, OBSERVED)
        with pytest.raises(ObservationError, match="rows 1 to 10 were compacted"):
            learner.retract(receipts[0])
        learner.retract(receipts[-1])
        require_same(learner, without(11))


def test_with_a_damaged_compaction_checkpoint_nothing_is_retracted(path):
    learner, receipts = filled(path)
    with learner:
        learner.compact(keep=6)
        compaction = learner._ledger.store.compaction().number
        spoil(path, compaction)
        for call in (lambda: learner.retract(receipts[-1]), lambda: learner.forget("a")):
            with pytest.raises((DamageError, ObservationError)):
                call()
        require_same(learner, OBSERVED, exemplars=False)
        with pytest.raises(DamageError):  # it has the readings of some
            learner.exemplars  # noqa: B018
        learner.observe("a", stream((9, 60)))
    with TactileLearner.open(path, **SETTINGS) as again:
        require_same(again, [*OBSERVED, ("a", (9, 60))], exemplars=False)


def test_a_compaction_checkpoint_damaged_since_keeps_nobody_from_opening(path, caplog):
    learner, receipts = filled(path)
    learner.compact(keep=6)
    learner.retract(receipts[-1])
    learner.retract(receipts[-4])
    compaction = learner._ledger.store.compaction().number
    learner._ledger.store.close()  # as if the power failed: the retractions are to be replayed
    spoil(path, compaction)
    with TactileLearner.open(path, **SETTINGS) as again:
        whole = fed(without(11, 8))
        assert again.digest() == whole.digest()
        assert again.materials == whole.materials
        for i in (11, 8):
            gone = OBSERVED[i][0], validate(stream(OBSERVED[i][1]), PAD).key
            assert gone not in {(material, key) for material, key, _ in again.memory.exemplars}
            assert gone not in {(name, key) for name, key, _ in again.memory.sample}
    assert "no other touch can take the place of a retracted one" in caplog.text
    assert repair_store(path).lost
    with TactileLearner.open(path, **SETTINGS) as again:
        assert again.digest() == whole.digest()


def test_a_reader_sees_no_new_rows_beside_an_older_f_star(path, monkeypatch):
    learner, _ = filled(path)
    learner.fine_tune(epochs=1)
    latest, looks = Store.latest, []

    def slow(store, **asked):
        found = latest(store, **asked)
        if store.mode == "read" and not looks:
            looks.append(1)  # while the reader reads, the writer goes on
            learner.observe("a", stream((8, 60)))
            learner.fine_tune(epochs=1)
            learner.observe("b", stream((9, 60)))
        return found

    monkeypatch.setattr(Store, "latest", slow)
    with learner, TactileLearner.open(path, mode="read", **SETTINGS) as reader:
        require_same(reader, OBSERVED)
        reader.refresh()
        require_same(reader, [*OBSERVED, ("a", (8, 60)), ("b", (9, 60))])
        assert reader.tuned_digest() == learner.tuned_digest()
