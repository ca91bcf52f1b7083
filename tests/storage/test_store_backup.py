"""A copy of a store that is in use: complete, verified and durable when it appears."""

import shutil

import pytest
from forging import log_of
from scroll_tactile_store import DamageError, NotAStoreError, Store, StoreError, repair_store
from scroll_tactile_store.layout import read_current
from store_builds import LAST, add, agrees, as_after_a_crash, commit, contents, damage, flip_row, folders, newest, spoil


def kept(folder):
    """What is in a folder but for what a writer leaves, its lock."""
    return {name: data for name, data in contents(folder).items() if not name.endswith(("lock", "holder.json"))}


@pytest.mark.parametrize("mode", ["read", "write"])
def test_a_copy_is_the_store_and_goes_on_by_itself(either, which, tmp_path, mode):
    before = kept(either)
    with Store.open(either, mode=mode) as opened:
        opened.backup(tmp_path / "new" / "copy")
        opened.backup(str(tmp_path / "another"))
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["copy"]
    copied = sorted(path.name for path in (tmp_path / "new" / "copy").iterdir())
    assert copied == ["CURRENT", "checkpoints", log_of(either).name]
    assert folders(tmp_path / "another") == folders(either)
    assert agrees(tmp_path / "new" / "copy", compacted=6 if which else 0, latest=15)
    assert kept(either) == before
    with Store.open(tmp_path / "another") as copy:
        assert add(copy, 99).sequence == LAST + 1
        commit(copy.commit, LAST + 1)
    assert damage(tmp_path / "another") == []


def test_of_a_store_that_is_written_all_is_copied_but_room_and_a_batch_that_is_not_over(opened, tmp_path):
    opened.backup(tmp_path / "empty")
    with Store.open(tmp_path / "empty", mode="read") as copy:
        assert (copy.last, list(copy.heads()), copy.latest()) == (0, [], None)
    for number in (1, 2, 3):
        add(opened, number)
    with opened.batch():
        add(opened, 4)
        opened.backup(tmp_path / "copy")
    crashed = as_after_a_crash(opened, tmp_path / "crashed")
    assert log_of(crashed).stat().st_size >= 2**20  # the room ahead
    with Store.open(crashed, mode="read") as reader:
        reader.backup(tmp_path / "second")
    for name, last in (("copy", 3), ("second", 4)):
        assert damage(tmp_path / name) == []
        assert log_of(tmp_path / name).stat().st_size < 2**14
        with Store.open(tmp_path / name, mode="read") as copy:
            assert [row.label for row in copy.records()] == [f"row {n}" for n in range(1, last + 1)]
        assert read_current(tmp_path / name / "CURRENT").last == last  # a copy says where its log ends


def test_what_is_there_is_not_written_over(plain, tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    (tmp_path / "door").symlink_to(plain)
    before = kept(tmp_path)
    inside = [plain / "copy", plain / "checkpoints" / "9", tmp_path / "door" / "copy", plain / ".." / "s" / "c"]
    with Store.open(plain, mode="read") as opened:
        for name in ("folder", "file", "link", "s"):
            with pytest.raises(NotAStoreError, match="is there already"):
                opened.backup(tmp_path / name)
        for path in inside:
            with pytest.raises(NotAStoreError, match="inside"):
                opened.backup(path)
    assert kept(tmp_path) == before
    assert list((tmp_path / "folder").iterdir()) == []


def test_a_damaged_store_is_not_copied(plain, tmp_path):
    def is_not_copied(match, error=DamageError):
        with Store.open(plain, mode="read") as opened, pytest.raises(error, match=match) as caught:
            opened.backup(tmp_path / "copy")
        assert "s/" in str(caught.value)

    flip_row(plain, 8, arrays=True)
    is_not_copied("row 8 has arrays that fail")
    repair_store(plain)
    spoil(newest(plain))
    is_not_copied("array 'rows' of checkpoint 1")
    (newest(plain) / "zarr.json").unlink()
    is_not_copied("checkpoint in")
    shutil.rmtree(newest(plain))
    is_not_copied("checkpoints/00000001", StoreError)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s"]
