"""Compaction: a checkpoint stands for rows that have given up their arrays, in a log that takes the other's place.

`tests/faults/each_call.py` has every call of it fail.
"""

import errno
from pathlib import Path

import pytest
import scroll_tactile_store.backup
import scroll_tactile_store.log
import scroll_tactile_store.store
from forging import log_of
from scroll_tactile_store import CompactedError, DamageError, Store
from scroll_tactile_store.layout import read_current
from store_builds import LAST, add, commit, damage, flip, flip_row, folders, holds, spoil, state


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


def test_the_space_is_given_back_to_the_disk(opened):
    before = log_of(opened.path).stat().st_size
    commit(opened.compact, LAST)
    opened.close()
    # A row without its arrays takes some 200 bytes; there is one log and one checkpoint.
    assert log_of(opened.path).stat().st_size < LAST * 300 < before
    assert folders(opened.path) == ["00000003"]
    assert sorted(entry.name for entry in opened.path.iterdir()) == ["CURRENT", "checkpoints", "lock", "log-00000002"]


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


@pytest.mark.parametrize("name", ["create_log", "write_checkpoint"])
def test_what_was_written_is_read_back_before_it_counts(opened, monkeypatch, name):
    real = getattr(scroll_tactile_store.store, name)

    def forgetful(path, written, *rest):
        done = real(path, written, *rest)
        if name == "create_log":
            flip(path, 500)
        else:
            spoil(path / "checkpoints" / f"{written.number:08d}")
        return done

    with monkeypatch.context() as broken, pytest.raises(DamageError):
        broken.setattr(scroll_tactile_store.store, name, forgetful)
        compact(opened, 5)
    assert holds(opened, latest=LAST)
    compact(opened, 5)
    assert holds(opened, compacted=5, latest=LAST)


def test_what_cannot_be_removed_is_no_failure(opened, monkeypatch, caplog):
    def stuck(*_):
        raise OSError(errno.EIO, "the disk says no")

    with monkeypatch.context() as broken:
        broken.setattr(scroll_tactile_store.store, "remove_unnamed", stuck)
        compact(opened, 5)
    assert "what was replaced could not be removed" in caplog.text
    assert holds(opened, compacted=5, latest=LAST)
    assert len(folders(opened.path)) == 3
    commit(opened.commit, LAST)
    assert len(folders(opened.path)) == 2


def test_a_reader_in_the_middle_gets_the_rest_or_is_told(opened):
    with Store.open(opened.path, mode="read") as reader:
        early, late, heads = reader.records(), reader.records(), reader.heads()
        assert [next(early).sequence for _ in range(3)] == [1, 2, 3]
        for expected in range(1, 8):
            assert next(late).sequence == expected
        compact(opened, 5)
        # What it has open it gives until it asks.
        assert next(early).sequence == 4
        assert (reader.compacted, reader.state().compacted) == (0, 5)
        with pytest.raises(CompactedError, match="row 5"):
            next(early)
        assert [row.sequence for row in late] == list(range(8, LAST + 1))
        assert [head.sequence for head in heads] == list(range(1, LAST + 1))
        assert holds(reader, compacted=5, latest=LAST)


def test_a_reader_stays_open_over_compactions(opened):
    with Store.open(opened.path, mode="read") as reader, Store.open(opened.path, mode="read") as lazy:
        files = open_files()
        last = LAST
        for last_sequence in range(1, 5):
            assert add(opened, last := last + 1).sequence == last
            compact(opened, last_sequence)
            reader.state()
            assert holds(reader, kept=last, compacted=last_sequence, latest=last)
        lazy.state()
        assert holds(lazy, kept=last, compacted=4, latest=last)
        assert log_of(opened.path).name == "log-00000005"
        assert open_files() == files
    assert damage(opened.path) == []


# What the judges of tests/faults found.


@pytest.mark.parametrize(
    "module", [scroll_tactile_store.store, scroll_tactile_store.backup], ids=["a reader", "a backup"]
)
def test_whoever_comes_while_a_log_takes_the_place_of_another_takes_the_new_one(plain, monkeypatch, module):
    path = plain
    before = [read_current(path / "CURRENT")]
    with Store.open(path) as writer:
        commit(writer.compact, 16)
    with Store.open(path, mode="read") as reader:
        monkeypatch.setattr(module, "read_current", lambda *given: before.pop() if before else read_current(*given))
        if module is scroll_tactile_store.backup:
            reader.backup(path.parent / "copy")
            path = path.parent / "copy"
        with Store.open(path, mode="read") as again:
            assert (again.last, again.compacted, before) == (LAST, 16, [])


def test_a_compaction_that_is_committed_stands_though_its_log_cannot_be_opened_at_once(plain, monkeypatch, caplog):
    path = plain
    synced = scroll_tactile_store.log.sync_open

    def failing(descriptor, **how):
        if read_current(path / "CURRENT").log == 2:
            monkeypatch.setattr(scroll_tactile_store.log, "sync_open", synced)
            raise OSError(errno.EIO, "the disk")
        synced(descriptor, **how)

    with Store.open(path) as writer:
        monkeypatch.setattr(scroll_tactile_store.log, "sync_open", failing)
        commit(writer.compact, 16)
        assert "could not be removed" in caplog.text
        assert (writer.compacted, add(writer, LAST + 1).sequence) == (16, LAST + 1)
    assert (damage(path), log_of(path).name) == ([], "log-00000002")
