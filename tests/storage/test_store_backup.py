"""A copy of a store that is in use: complete, verified and durable when it appears."""

import shutil

import pytest
from forging import log_of
from scroll_tactile_store import DamageError, NotAStoreError, Store, StoreError, repair_store
from scroll_tactile_store.layout import read_current
from store_builds import add, as_after_a_crash, commit, contents, damage, flip_row, folders, newest, same_arrays, spoil


def kept(folder):
    """What is in a folder but for what a writer leaves, its lock."""
    return {name: data for name, data in contents(folder).items() if not name.endswith(("lock", "holder.json"))}


def same_store(found, expected):
    assert damage(found) == []
    with Store.open(found, mode="read") as ours, Store.open(expected, mode="read") as theirs:
        assert (ours.identity, ours.last, ours.compacted, ours.newest) == (
            theirs.identity,
            theirs.last,
            theirs.compacted,
            theirs.newest,
        )
        assert list(ours.heads()) == list(theirs.heads())
        for mine, other in zip(ours.records(ours.compacted), theirs.records(theirs.compacted), strict=True):
            assert same_arrays(mine.arrays, other.arrays)
        for mine, other in ((ours.latest(), theirs.latest()), (ours.compaction(), theirs.compaction())):
            assert (mine is None) == (other is None)
            assert mine is None or same_arrays(mine.arrays, other.arrays)
    return True


@pytest.mark.parametrize("mode", ["read", "write"])
def test_a_copy_is_the_store_and_goes_on_by_itself(either, tmp_path, mode):
    before = kept(either)
    with Store.open(either, mode=mode) as opened:
        opened.backup(tmp_path / "new" / "copy")
        opened.backup(str(tmp_path / "another"))
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["copy"]
    assert sorted(path.name for path in (tmp_path / "new" / "copy").iterdir()) == [
        "CURRENT",
        "checkpoints",
        log_of(either).name,
    ]
    assert same_store(tmp_path / "new" / "copy", either)
    assert kept(either) == before
    assert folders(tmp_path / "another") == folders(either)
    with Store.open(tmp_path / "another") as copy:
        assert add(copy, 99).sequence == 21
        commit(copy.commit, 21)
    assert damage(tmp_path / "another") == []


def test_a_store_without_rows_or_with_a_log_is_copied_too(opened, tmp_path):
    opened.backup(tmp_path / "empty")
    assert same_store(tmp_path / "empty", opened.path)
    add(opened, 1)
    crashed = as_after_a_crash(opened, tmp_path / "crashed")
    assert log_of(crashed).stat().st_size >= 2**20  # the room ahead
    with Store.open(crashed, mode="read") as reader:
        reader.backup(tmp_path / "copy")
    assert same_store(tmp_path / "copy", opened.path)
    assert log_of(tmp_path / "copy").stat().st_size < 2**13


def test_a_batch_that_is_not_over_is_not_in_it(opened, tmp_path):
    for number in (1, 2, 3):
        add(opened, number)
    with opened.batch():
        add(opened, 4)
        opened.backup(tmp_path / "copy")
    with Store.open(tmp_path / "copy", mode="read") as copy:
        assert copy.last == 3
    assert read_current(tmp_path / "copy" / "CURRENT").last == 3  # a copy says where its log ends


def test_what_is_there_is_not_written_over(plain, tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    (tmp_path / "door").symlink_to(plain)
    before = kept(tmp_path)
    with Store.open(plain, mode="read") as opened:
        for name in ("folder", "file", "link", "s"):
            with pytest.raises(NotAStoreError, match="is there already"):
                opened.backup(tmp_path / name)
        for inside in (
            plain / "copy",
            plain / "checkpoints" / "9",
            tmp_path / "door" / "copy",
            plain / ".." / "s" / "c",
        ):
            with pytest.raises(NotAStoreError, match="inside"):
                opened.backup(inside)
    assert kept(tmp_path) == before
    assert list((tmp_path / "folder").iterdir()) == []


def test_a_damaged_store_is_not_copied(plain, tmp_path):
    def is_refused(match):
        with Store.open(plain, mode="read") as opened, pytest.raises(DamageError, match=match) as caught:
            opened.backup(tmp_path / "copy")
        assert str(caught.value.path).startswith(str(plain))
        assert "s/" in str(caught.value)

    flip_row(plain, 8, arrays=True)
    is_refused("row 8 has arrays that fail")
    repair_store(plain)
    spoil(newest(plain))
    is_refused("array 'rows' of checkpoint 1")
    (newest(plain) / "zarr.json").unlink()
    is_refused("checkpoint in")
    shutil.rmtree(newest(plain))
    with Store.open(plain, mode="read") as opened, pytest.raises(StoreError, match="checkpoints/00000001"):
        opened.backup(tmp_path / "copy")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s"]
