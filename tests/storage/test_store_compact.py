"""Compaction: a checkpoint stands for rows that have given up their arrays, in a log that takes the other's place."""

import errno
import shutil
from pathlib import Path

import numpy as np
import pytest
import scroll_tactile_store.checkpoints
import scroll_tactile_store.files
from forging import log_of
from scroll_tactile_store import CompactedError, DamageError, Store
from store_builds import damage, flip, flip_row, folders

LAST = 12


def noise(number):
    return np.random.default_rng(number).integers(0, 2**60, 400)


def add(opened, number):
    return opened.append("a", f"row {number}", bytes([number]), arrays={"x": noise(number)}).sequence


def sums(last_sequence):
    return {"sum": np.array(last_sequence * (last_sequence + 1) // 2), "bulk": np.full(500, last_sequence, np.float64)}


def compact(opened, last_sequence, **options):
    opened.compact(sums(last_sequence), last_sequence=last_sequence, newest=(sums(opened.last), {}), **options)


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """Twelve rows, and a checkpoint up to the last; not to be changed."""
    with Store.open(tmp_path_factory.mktemp("made") / "s", identity={"for": "compaction"}) as fresh:
        for number in range(1, LAST + 1):
            add(fresh, number)
        fresh.commit(sums(LAST), last_sequence=LAST)
    return fresh.path


@pytest.fixture
def opened(made, tmp_path):
    with Store.open(shutil.copytree(made, tmp_path / "s")) as copy:
        yield copy


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


def spoil(folder):
    chunk = folder / "bulk" / "c" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-1])


def agrees(opened, compacted, last=LAST):
    assert (opened.last, opened.compacted) == (last, compacted)
    assert [head.label for head in opened.heads()] == [f"row {number}" for number in range(1, last + 1)]
    found = [(row.sequence, row.arrays["x"].tobytes()) for row in opened.records(compacted)]
    assert found == [(number, noise(number).tobytes()) for number in range(compacted + 1, last + 1)]
    for after in range(compacted):
        with pytest.raises(CompactedError, match=f"records 1 to {compacted}"):
            opened.records(after)
    found = opened.compaction()
    if compacted:
        assert (found.last_sequence, found.arrays["sum"]) == (compacted, sums(compacted)["sum"])
    else:
        assert found is None
    return True


def test_the_space_is_given_back_to_the_disk(opened):
    before = log_of(opened.path).stat().st_size
    opened.compact(sums(LAST), last_sequence=LAST)
    opened.close()
    # A row without its arrays takes some 200 bytes; there is one log and one checkpoint.
    assert log_of(opened.path).stat().st_size < LAST * 300 < before
    assert folders(opened.path) == ["00000002"]
    assert sorted(entry.name for entry in opened.path.iterdir()) == ["CURRENT", "checkpoints", "lock", "log-00000002"]


@pytest.mark.parametrize("last_sequence", [5, LAST])
def test_a_flipped_bit_in_a_log_that_nothing_was_appended_to_is_damage(opened, last_sequence):
    """All its rows are one batch, which must not look as one that a power cut left."""
    opened.compact(sums(last_sequence), last_sequence=last_sequence)
    opened.close()
    flip_row(opened.path, LAST - 1)
    assert damage(opened.path)
    with Store.open(opened.path, mode="read") as reader, pytest.raises(DamageError, match=f"row {LAST - 1} is missing"):
        list(reader.heads(LAST - 2))


@pytest.mark.parametrize(("row", "arrays"), [(7, True), (3, False)])
def test_a_damaged_row_keeps_all_from_being_given_up(opened, row, arrays):
    """Behind the compaction checkpoint, or a head, which opening does not read."""
    opened.close()
    flip_row(opened.path, row, arrays=arrays)
    before = log_of(opened.path).read_bytes()
    with Store.open(opened.path) as again:
        with pytest.raises(DamageError, match=r"row 7 is not as it was written|repair the store"):
            compact(again, 5)
        assert (again.compacted, folders(again.path)) == (0, ["00000001"])
        assert log_of(again.path).read_bytes() == before
        if arrays:  # where the compaction checkpoint stands for it, its arrays are given up anyway
            compact(again, 7)
            assert agrees(again, 7)


@pytest.mark.parametrize("name", ["create_log", "write_checkpoint"])
def test_what_was_written_is_read_back_before_it_counts(opened, monkeypatch, name):
    real = getattr(scroll_tactile_store.checkpoints, name)

    def forgetful(path, number, *rest):
        done = real(path, number, *rest)
        if name == "create_log":
            flip(path, 500)
        else:
            spoil(path / "checkpoints" / f"{number:08d}")
        return done

    with monkeypatch.context() as broken, pytest.raises(DamageError):
        broken.setattr(scroll_tactile_store.checkpoints, name, forgetful)
        compact(opened, 5)
    assert agrees(opened, 0)
    compact(opened, 5)
    assert agrees(opened, 5)


def test_what_cannot_be_removed_is_no_failure(opened, monkeypatch, caplog):
    def stuck(*_):
        raise OSError(errno.EIO, "the disk says no")

    with monkeypatch.context() as broken:
        broken.setattr(scroll_tactile_store.checkpoints, "remove_unnamed", stuck)
        compact(opened, 5)
    assert "what was replaced could not be removed" in caplog.text
    assert agrees(opened, 5)
    assert len(folders(opened.path)) == 3
    opened.commit(sums(LAST), last_sequence=LAST)
    assert len(folders(opened.path)) == 2


def test_a_reader_in_the_middle_gets_the_rest_or_is_told(opened):
    with Store.open(opened.path, mode="read") as reader:
        early, late, heads = reader.records(), reader.records(), reader.heads()
        assert [next(early).sequence for _ in range(3)] == [1, 2, 3]
        for expected in range(1, 8):
            assert next(late).sequence == expected
        compact(opened, 5)
        # What it has open it may still give.
        assert next(early).sequence == 4
        assert reader.compacted == 5
        with pytest.raises(CompactedError, match="row 5"):
            next(early)
        assert [row.sequence for row in late] == list(range(8, LAST + 1))
        assert [head.sequence for head in heads] == list(range(1, LAST + 1))
        assert agrees(reader, 5)


def test_a_reader_stays_open_over_compactions(opened):
    with Store.open(opened.path, mode="read") as reader, Store.open(opened.path, mode="read") as lazy:
        files = open_files()
        last = LAST
        for last_sequence in range(1, 5):
            assert add(opened, last := last + 1) == last
            compact(opened, last_sequence)
            assert agrees(reader, last_sequence, last)
            assert reader.latest().last_sequence == last
        assert agrees(lazy, 4, last)
        assert log_of(opened.path).name == "log-00000005"
        assert open_files() == files
    assert damage(opened.path) == []
