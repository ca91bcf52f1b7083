"""A memory without a path has the journal of one with a path, in RAM: it does the same, and holds the same bytes."""

import pytest
from touches import OBSERVED, SETTINGS, SMALL, OwnKernels, fed, filled, held, stream, without

from examples.paper.transfer.maps import Maps
from scroll_tactile import TactileLearner
from scroll_tactile.errors import InputError, ObservationError

MADE = {
    "readings alone": {"embedding": SMALL},
    "readings alone, of a user's own": {"embedding": OwnKernels(seed=0, dimension=64)},
    "codes alone": {"embedding": Maps(layout=(2,)), "exemplars": 0, "kept_touches": 0},
    "both": {"embedding": Maps(layout=(2,))},
}


@pytest.mark.parametrize("made", MADE.values(), ids=MADE)
def test_what_changes_it_leaves_what_observing_gives(made, tmp_path):
    learner = fed(OBSERVED[:8], **made)
    learner.retract(3)
    assert held(learner) == held(fed([pair for pair in without(2) if pair in OBSERVED[:8]], **made))
    filled(tmp_path / "m", OBSERVED[6:], **made)[0].close()
    assert (merged := learner.merge(tmp_path / "m")).observations == 4 and merged.shared == 2
    assert held(learner) == held(fed(without(2), **made))
    learner.relabel(2, "a")
    assert learner.forget("c") == 3
    expected = [(name if touch != OBSERVED[1][1] else "a", touch) for name, touch in without(2) if name != "c"]
    assert held(learner) == held(fed(expected, **made))
    learner.compact(keep=2)
    with pytest.raises(ObservationError, match="were compacted"):
        learner.retract(1)
    last = [row for row in learner.observations() if row.state == "kept"][-1]
    learner.retract(last.sequence)
    expected.remove(
        (last.material, next(touch for _, touch in expected if learner.stream(stream(touch)).key == last.key))
    )
    assert held(learner) == held(fed(expected, **made))
    learner.compact()
    assert held(learner) == held(fed(expected, **made))


def test_it_is_packed_and_merged_as_one_with_a_path(tmp_path):
    learner = fed(OBSERVED[:6], {"a": {"wool": 1.0}})
    learner.retract(3)
    learner.pack(tmp_path / "p")
    for brought in (learner, tmp_path / "p"):
        with TactileLearner.open(tmp_path / f"m{brought is learner}", **SETTINGS) as other:
            assert other.merge(brought).observations == 5
            assert held(other) == held(learner)
    ours = fed(OBSERVED[4:])
    ours.merge(learner)
    learner.merge(ours)
    assert ours.digest() == learner.digest() == fed(without(1)).digest()
    assert learner.merge(learner).shared == 11


def test_a_merge_that_is_cut_short_never_began_and_rows_behind_a_checkpoint_alone_are_embedded_again(monkeypatch):
    monkeypatch.setattr("scroll_tactile.persistence.ledger.CHECKPOINT_EVERY", 3)
    learner, other, embedded = fed(OBSERVED[:4]), fed(OBSERVED[4:]), []
    with pytest.raises(KeyboardInterrupt):
        learner.merge(other, progress=lambda what, done, of: done < 3 or interrupt())
    empty, encode = learner._ledger._empty, learner._ledger._empty.encode
    monkeypatch.setattr(empty, "encode", lambda readings: embedded.append(len(readings)) or encode(readings))
    assert learner.memory.sequence == 4 and len(embedded) == 1
    assert held(learner) == held(fed(OBSERVED[:4])) and len(learner.observations()) == 4


def test_one_that_a_compacted_one_came_into_is_merged_as_any():
    learner, between, ours = fed(OBSERVED[:4]), fed(OBSERVED[4:8]), fed(OBSERVED[8:])
    learner.compact()
    between.merge(learner)
    assert ours.merge(between).observations == 8
    assert held(ours) == held(fed(OBSERVED))


def test_what_takes_a_folder_is_refused(tmp_path):
    for call in (lambda learner: learner.backup(tmp_path / "b"), lambda learner: learner.reembed()):
        with pytest.raises(InputError, match="without a path"):
            call(fed(OBSERVED[:1]))


def interrupt(*_):
    raise KeyboardInterrupt
