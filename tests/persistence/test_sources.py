"""Where a touch comes from is kept beside it, and changes nothing of what was learned; a wrong name is put right."""

import pytest
from touches import OBSERVED, SETTINGS, filled, require_same, stream, without

from scroll_tactile import TactileLearner
from scroll_tactile.errors import InputError, MaterialError, ObservationError


def sources(learner):
    return [(row.sequence, row.material, row.state, row.source) for row in learner.observations()]


class TestSource:
    def test_it_is_kept_through_opening_merging_compacting_and_reembedding(self, path, tmp_path):
        with TactileLearner.open(path, **SETTINGS) as learner:
            learner.observe("a", stream((0, 60)), source="félt [1].npy[0:60] /rh/tactile")
            learner.observe("b", stream((1, 60)))
        with TactileLearner.open(path) as learner:
            expected = [(1, "a", "kept", "félt [1].npy[0:60] /rh/tactile"), (2, "b", "kept", None)]
            assert sources(learner) == expected
            learner.reembed()
            assert sources(learner) == expected
            with TactileLearner.open(tmp_path / "other", **SETTINGS) as other:
                other.merge(learner)
                assert sources(other) == expected
            learner.compact()
            with TactileLearner.open(tmp_path / "third", **SETTINGS) as third:
                third.merge(learner)
                kept = [(material, state, source) for _, material, state, source in sources(third)]
                assert kept == [("a", "compacted", expected[0][3]), ("b", "compacted", None)]

    @pytest.mark.parametrize("wrong", ["", "x" * 1001, "a\x1b[2J", "\ud800", 7, b"a", ["a"]])
    def test_what_is_none_is_refused_and_nothing_kept(self, path, wrong):
        with TactileLearner.open(path, **SETTINGS) as learner:
            with pytest.raises(InputError, match="source"):
                learner.observe("a", stream((0, 60)), source=wrong)
            assert learner.observations() == []


class TestRelabel:
    def test_it_keeps_the_source_and_follows_what_was_learned(self, path):
        with TactileLearner.open(path, **SETTINGS) as learner:
            for i, (material, touch) in enumerate(OBSERVED):
                learner.observe(material, stream(touch), source=f"{i}.npy")
            learner.predict(stream((7, 25)))
            learner.relabel(2, "d")
            assert sources(learner)[1] == (2, "b", "retracted", "1.npy")
            assert sources(learner)[-1] == (14, "d", "kept", "1.npy")
            assert dict(learner.predict(stream((7, 25))).ranking).keys() == {"a", "b", "c", "d"}
            require_same(learner, [*without(1), ("d", OBSERVED[1][1])])

    def test_what_cannot_be_relabelled_is_refused_and_nothing_changed(self, path):
        learner, _ = filled(path)
        with learner:
            for sequence, name, error, match in (
                (1, "a", InputError, "is called 'a' already"),
                (1, "", MaterialError, "1 to 200"),
                (99, "b", ObservationError, "there is no observation"),
            ):
                with pytest.raises(error, match=match):
                    learner.relabel(sequence, name)
            with learner.batch(), pytest.raises(InputError, match="a batch of its own"):
                learner.relabel(1, "b")
            require_same(learner, OBSERVED)
            learner.compact()
            with pytest.raises(ObservationError, match="were compacted, and their features given up"):
                learner.relabel(1, "b")
