"""Compaction: a checkpoint stands for rows that have given up their arrays, in a log that takes the other's place.

`tests/faults/each_call.py` has every call of it fail; test_store_threads.py has it happen beside every reader.
"""

import os
from pathlib import Path

import pytest
import scroll_tactile_store.log
import scroll_tactile_store.store
from forging import get_current, log_of
from scroll_tactile_store import CompactedError, DamageError, Store, StoreError
from store_builds import LAST, add, commit, damage, fails, flip, flip_row, folders, holds, sequences, spoil, state


def compact(opened, last_sequence):
    commit(opened.compact, last_sequence, newest=(state(opened.last), {"n": opened.last}))


@pytest.fixture
def opened(plain):
    """Twenty rows, and a checkpoint up to the last."""
    with Store.open(plain) as copy:
        commit(copy.commit, LAST)
        yield copy


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.parametrize("together", [4096, 7])
def test_the_space_is_given_back_to_the_disk(opened, monkeypatch, together):
    monkeypatch.setattr(scroll_tactile_store.log, "TOGETHER", together)  # rows of a batch
    before = log_of(opened.path).stat().st_size
    commit(opened.compact, LAST)
    opened.close()
    # A row without its arrays takes some 200 bytes; there is one log and one checkpoint.
    assert log_of(opened.path).stat().st_size < LAST * 300 < before
    assert folders(opened.path) == ["00000003"]
    assert sorted(entry.name for entry in opened.path.iterdir()) == ["CURRENT", "checkpoints", "lock", "log-00000002"]
    with Store.open(opened.path, mode="read") as reader:
        assert holds(reader, compacted=LAST, latest=LAST)


@pytest.mark.parametrize("last_sequence", [5, LAST])
def test_a_flipped_bit_in_a_log_that_nothing_was_appended_to_is_damage(opened, last_sequence):
    """All its rows are one batch, which must not look as one that a power cut left."""
    commit(opened.compact, last_sequence)
    opened.close()
    flip_row(opened.path, LAST - 1)
    assert damage(opened.path)
    with pytest.raises(DamageError, match="repair"), Store.open(opened.path, mode="read") as reader:
        list(reader.heads(LAST - 2))


@pytest.mark.parametrize(("row", "arrays"), [(7, True), (3, False)])
def test_a_damaged_row_keeps_all_from_being_given_up(opened, row, arrays):
    """Behind the compaction checkpoint, or a head, which opening does not read."""
    opened.close()
    flip_row(opened.path, row, arrays=arrays)
    before = log_of(opened.path).read_bytes()
    with Store.open(opened.path) as again:
        with pytest.raises(DamageError, match=f"row {row} is not as it was written"):
            compact(again, 5)
        assert (again.compacted, folders(again.path)) == (0, ["00000002"])
        assert log_of(again.path).read_bytes() == before
        if arrays:  # where the compaction checkpoint stands for it, its arrays are given up anyway
            compact(again, 7)
            assert holds(again, compacted=7, latest=LAST)


@pytest.mark.parametrize("harm", ["a bit of the log", "the end of the log", "a bit of a checkpoint"])
def test_what_was_written_is_read_back_before_it_counts(opened, monkeypatch, harm):
    name = "create_log" if "log" in harm else "write_checkpoint"
    real = getattr(scroll_tactile_store.store, name)

    def forgetful(path, *rest):
        done = real(path, *rest)
        if harm == "a bit of the log":
            flip(path, 500)
        elif harm == "the end of the log":
            os.truncate(path, path.stat().st_size - 20)
        else:
            spoil(path / "checkpoints" / folders(path)[-1])
        return done

    with monkeypatch.context() as broken, pytest.raises(DamageError):
        broken.setattr(scroll_tactile_store.store, name, forgetful)
        compact(opened, 5)
    assert holds(opened, latest=LAST)
    compact(opened, 5)
    assert holds(opened, compacted=5, latest=LAST)


def test_what_cannot_be_removed_is_no_failure(opened, monkeypatch, caplog):
    with monkeypatch.context() as broken:
        broken.setattr(scroll_tactile_store.store, "remove_unnamed", fails())
        compact(opened, 5)
    assert "what was replaced could not be removed" in caplog.text
    assert holds(opened, compacted=5, latest=LAST)
    assert len(folders(opened.path)) == 3
    commit(opened.commit, LAST)
    assert len(folders(opened.path)) == 2


def test_a_reader_goes_on_with_what_it_has_until_it_looks_over_any_number_of_compactions(opened):
    with Store.open(opened.path, mode="read") as reader, Store.open(opened.path, mode="read") as lazy:
        early, late, heads = reader.records(), reader.records(), reader.heads()
        assert [next(early).sequence for _ in range(3)] == [1, 2, 3]
        assert [next(late).sequence for _ in range(7)] == [1, 2, 3, 4, 5, 6, 7]
        compact(opened, 5)
        assert next(early).sequence == 4
        assert (reader.compaction(), reader.compacted, reader.state().compacted) == (None, 0, 5)
        with pytest.raises(CompactedError, match="row 5"):
            next(early)
        assert sequences(late) == list(range(8, LAST + 1))
        assert sequences(heads) == list(range(1, LAST + 1))
        assert holds(reader, compacted=5, latest=LAST)
        files, last = open_files(), LAST
        for last_sequence in range(6, 10):
            assert add(opened, last := last + 1).sequence == last
            compact(opened, last_sequence)
            with pytest.raises(CompactedError, match="read it anew"):
                reader.compaction()
            assert holds(reader, kept=last, compacted=last_sequence, latest=last)
        lazy.state()
        assert holds(lazy, kept=last, compacted=9, latest=last)
        assert open_files() == files
    assert damage(opened.path) == []


# What the judges of tests/faults found.


@pytest.mark.parametrize("failing", ["the log", "the folder"])
def test_a_compaction_that_is_committed_stands_whatever_fails_behind_its_commit(opened, monkeypatch, caplog, failing):
    """The new log cannot be opened at once; or the folder not synced, and the next append makes up for that."""
    synced, calls = os.fsync, []

    def fail_once(descriptor):
        found = os.path.realpath(f"/proc/self/fd/{descriptor}")
        if get_current(opened.path)["log"][0] == 2 and found == str(
            log_of(opened.path) if failing == "the log" else opened.path
        ):
            calls.append(found)
            if len(calls) == 1:
                fails()()
        synced(descriptor)

    monkeypatch.setattr(os, "fsync", fail_once)
    if failing == "the log":
        commit(opened.compact, 16)
        assert [record.levelname for record in caplog.records][:1] == ["WARNING"]
    else:
        with pytest.raises(StoreError, match="Input/output error"):
            commit(opened.compact, 16)
    assert (opened.compacted, add(opened, LAST + 1).sequence) == (16, LAST + 1)
    assert len(calls) > 1
    assert (log_of(opened.path).name, damage(opened.path)) == ("log-00000002", [])
