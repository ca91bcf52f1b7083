"""The end of a log: what `CURRENT`, a checkpoint or a batch proves of it, and what a power cut may have torn."""

import os

import numpy as np
import pytest
from forging import log_of
from logs import ends as ends_of
from scroll_tactile_store import DamageError, Store, check_store, repair_store
from scroll_tactile_store.framing import FRAME_BYTES
from scroll_tactile_store.layout import CURRENT_FILE, log_path, read_current, write_current
from store_builds import as_after_a_crash, damage, flip, flip_row


def made(path, rows=4):
    with Store.open(path, identity={"for": "this"}) as store:
        for index in range(rows):
            store.append("add", f"label {index}", bytes([index]))
    return log_path(path, 1)


def ends(log):
    """Where the header and each batch end."""
    begin, _, commits = ends_of(log)
    return [begin, *commits]


def require_named(path, rows, kept):
    """Whoever opens it is told, and a repair keeps what is before the loss."""
    for mode in ("read", "write"):
        with pytest.raises(DamageError, match=f"had row {rows}: .*repair the store"):
            Store.open(path, mode=mode)
    assert [problem.kind for problem in check_store(path)] == ["lost"]
    assert repair_store(path).kept == kept
    assert damage(path) == []
    with Store.open(path) as store:
        assert [head.sequence for head in store.heads()] == list(range(1, kept + 1))
        assert store.append("add", "after", b"").sequence == kept + 1


@pytest.mark.parametrize(("kept", "flipped"), [(0, False), (2, False), (3, False), (3, True)])
def test_a_closed_log_that_is_cut_off_or_flipped_at_its_end_is_damaged(tmp_path, kept, flipped):
    log = made(tmp_path / "s")
    if flipped:
        flip(log, -100)
    else:
        os.truncate(log, ends(log)[kept])
    require_named(tmp_path / "s", 4, kept)


def test_a_log_that_had_a_row_and_has_none_is_damaged_though_nobody_closed_it(tmp_path):
    with Store.open(tmp_path / "s", identity={}) as store:
        store.append("add", "", b"")
        path = as_after_a_crash(store, tmp_path / "crashed")
    os.truncate(log_path(path, 1), ends(log_path(path, 1))[0])
    require_named(path, 1, 0)


@pytest.mark.parametrize("by", [1, FRAME_BYTES, FRAME_BYTES + 1])
def test_a_crashed_log_that_ends_before_a_checkpoints_place_is_named(tmp_path, by):
    with Store.open(tmp_path / "s", identity={}) as store:
        for label in "ab":
            store.append("add", label, b"")
        store.commit({}, last_sequence=2)
        store.append("add", "behind it", b"")
        path = as_after_a_crash(store, tmp_path / "crashed")
    os.truncate(log_path(path, 1), read_current(path / CURRENT_FILE).newest.place.offset - by)
    for mode in ("read", "write"):
        with pytest.raises(DamageError, match="repair the store"):
            Store.open(path, mode=mode)
    # Without the commit frame alone the row is whole, and the place tells of what is behind it.
    assert {problem.kind for problem in damage(path)} == ({"spare"} if by <= FRAME_BYTES else {"lost", "spare"})
    assert repair_store(path).kept == 2
    assert damage(path) == []


def test_a_store_that_cannot_say_so_is_closed_with_a_warning_and_one_that_is_another_is_left_alone(tmp_path, caplog):
    made(tmp_path / "other", 1)
    other = (tmp_path / "other" / CURRENT_FILE).read_bytes()
    with Store.open(tmp_path / "s", identity={}) as store:
        for _ in range(2):
            store.append("add", "", b"")
        (tmp_path / "s" / CURRENT_FILE).write_bytes(other)
    assert (tmp_path / "s" / CURRENT_FILE).read_bytes() == other
    with Store.open(tmp_path / "t", identity={}) as store:
        for _ in range(2):
            store.append("add", "", b"")
        (tmp_path / "t" / CURRENT_FILE).unlink()
    assert "CURRENT" in caplog.text


def test_a_store_that_says_nothing_of_it_is_read_as_before(tmp_path):
    log = made(tmp_path / "s")
    current = read_current(tmp_path / "s" / CURRENT_FILE)
    write_current(tmp_path / "s", type(current)(current.log, current.log_identity))
    os.truncate(log, ends(log)[2])
    with Store.open(tmp_path / "s") as store:
        assert store.last == 2


BATCH = {
    # what is harmed of a last batch of three rows; what of it is kept: `CURRENT` has the place behind it
    "the end's batch": (lambda path: flip(log_of(path), -88 + 20), [1, 2, 3]),
    "the end's checksum": (lambda path: flip(log_of(path), -88 + 80), [1, 2, 3]),
    "a row": (lambda path: flip_row(path, 2), [1, 3]),
}


@pytest.mark.parametrize(("harm", "kept"), BATCH.values(), ids=BATCH)
def test_a_repair_keeps_the_sound_rows_of_a_last_batch_that_a_checkpoint_proves(tmp_path, harm, kept):
    path = tmp_path / "s"
    with Store.open(path, identity={}) as store:
        with store.batch():
            for i in range(3):
                store.append("row", f"{i}", b"key", arrays={"x": np.arange(16.0)})
        store.commit({}, last_sequence=3)
    harm(path)
    if kept == [1, 2, 3]:
        with pytest.raises(DamageError, match=r"repair|row 3 is missing"):
            Store.open(path)
        assert {problem.kind for problem in check_store(path)} == {"spare"}
    repair = repair_store(path)
    assert (repair.kept, repair.lost == []) == (3, kept == [1, 2, 3])
    with Store.open(path) as store:
        assert [head.sequence for head in store.heads()] == kept
        assert store.compacted == (0 if kept == [1, 2, 3] else 3)
