"""A row whose frame or head is damaged has no kind any more: nobody may go on as if no touch had been there."""

import pytest
from forging import log_of
from scroll_tactile_store import DamageError, check_store
from scroll_tactile_store.framing import FRAME_BYTES
from scroll_tactile_store.log import Log, refuse
from scroll_tactile_store.rows import ROW
from touches import OBSERVED, SETTINGS, filled, require_same

from scroll_tactile import TactileLearner

DAMAGED = 5  # a row, of the second touch of "b"


def harm(path, place):
    """Flip a bit in the frame of a row, or in its head."""
    with Log(log_of(path)) as log:
        frames = [frame for batch in log.scan(refuse) for frame in batch if frame.kind == ROW]
    data = bytearray(log_of(path).read_bytes())
    data[frames[DAMAGED - 1].offset + place] ^= 1
    log_of(path).write_bytes(data)


PLACES = pytest.mark.parametrize("place", [29, FRAME_BYTES + 50], ids=["frame", "head"])


@PLACES
def test_samples_are_not_chosen_again_without_a_damaged_row(path, place):
    learner, receipts = filled(path)
    learner.close()
    harm(path, place)
    with TactileLearner.open(path, **SETTINGS) as learner:
        for change in (
            lambda: learner.retract(receipts[0]),
            lambda: learner.forget(OBSERVED[0][0]),
            lambda: learner.forget(OBSERVED[DAMAGED - 1][0]),  # which is not said to be compacted
            lambda: learner.relabel(receipts[0], "other"),
        ):
            with pytest.raises(DamageError, match="row 5 ") as caught:
                change()
            assert caught.value.sequence == DAMAGED
            require_same(learner, OBSERVED, exemplars=False)
    with TactileLearner.open(path, **SETTINGS) as again:
        assert again.memory.sequence == len(OBSERVED)
        require_same(again, OBSERVED, exemplars=False)


@PLACES
def test_a_retraction_that_is_replayed_needs_the_row(path, place):
    learner, receipts = filled(path)
    learner.close()
    learner = TactileLearner.open(path, **SETTINGS)
    learner.retract(receipts[0])
    learner._ledger.store.close()  # as if the power failed: the retraction is to be replayed
    harm(path, place)
    before = log_of(path).read_bytes()
    for mode in ("write", "read"):
        with pytest.raises(DamageError, match="row 5 "):
            TactileLearner.open(path, mode=mode, **SETTINGS)
    assert log_of(path).read_bytes() == before
    assert check_store(path)
