"""Who only reads a store leaves every byte as it is; and what is no store, or lies where no store can be written.

What a folder from somebody else may not do stands in tests/test_strangers.py.
"""

import errno
import fcntl
import json
import os
import stat

import pytest
from forging import put_row
from scroll_tactile_store import DamageError, LockedError, NotAStoreError, Store, StoreError, check_store, repair_store
from scroll_tactile_store.files import same_folder
from store_builds import LAST, add, as_after_a_crash, build, commit, contents

LOG = "log-00000001"


def everything(folder):
    """All that can be told of a folder: names, bytes, sizes, times, and what each is."""
    told = {}
    for path in [folder, *sorted(folder.rglob("*"))]:
        entry = path.lstat()
        data = path.read_bytes() if stat.S_ISREG(entry.st_mode) else None
        told[str(path.relative_to(folder))] = (entry.st_mode, entry.st_size, entry.st_mtime_ns, entry.st_ino, data)
    return told


def uses(path, target):
    """Every use of a store that must not change it, one after another."""
    return {
        "read": lambda: read_all(path),
        "check": lambda: check_store(path),
        "backup": lambda: backed_up(path, target),
    }


def read_all(path):
    with Store.open(path, mode="read") as reader:
        reader.latest()
        return [row.label for row in reader.records(reader.compacted)]


def backed_up(path, target):
    with Store.open(path, mode="read") as reader:
        reader.backup(target)
    return read_all(target)


# A read leaves everything as it is.


@pytest.fixture(params=["closed", "crashed", "closed beside a reader"])
def left(request, tmp_path):
    """A store in each state in which a writer can leave it."""
    path = build(tmp_path / "s")
    if request.param == "closed beside a reader":
        writer = Store.open(path)
        with Store.open(path, mode="read") as reader:
            add(writer, LAST + 1)
            assert reader.state().last == LAST + 1
            writer.close()
    elif request.param.startswith("crashed"):
        writer = Store.open(path)
        add(writer, LAST + 1)
        as_after_a_crash(writer, tmp_path / "c")
        writer.close()
        path = tmp_path / "c"
    return path


@pytest.mark.parametrize("use", ["read", "check", "backup"])
def test_a_read_a_check_and_a_backup_leave_the_folder_as_it_is(left, tmp_path, use):
    before = everything(left)
    first = uses(left, tmp_path / "copy")[use]()
    again = uses(left, tmp_path / "copy 2")[use]()
    assert everything(left) == before
    assert first == again
    if use != "check":
        assert len(first) >= LAST


# Locks and paths.


def test_a_store_is_reached_through_a_link(tmp_path):
    (tmp_path / "link").symlink_to(build(tmp_path / "s"))
    with Store.open(tmp_path / "link") as writer:
        assert add(writer, LAST + 1).sequence == LAST + 1
        with pytest.raises(LockedError):
            Store.open(tmp_path / "s")
    assert check_store(tmp_path / "link") == []


@pytest.mark.parametrize("code", [errno.ENOSYS, errno.ENOLCK])
def test_where_there_are_no_locks_that_is_said_and_no_other_kind_is_taken(tmp_path, monkeypatch, code):
    Store.open(tmp_path / "s", identity={}).close()
    before = contents(tmp_path / "s")

    def missing(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", missing)
    for path in (tmp_path / "s", tmp_path / "new"):
        with pytest.raises(StoreError, match="without which two writers could spoil it") as caught:
            Store.open(path, identity={})
        assert not isinstance(caught.value, LockedError)
        assert str(path) in str(caught.value)
    assert read_all(tmp_path / "s") == []
    assert contents(tmp_path / "s") == before


def test_a_note_of_a_holder_is_shown_without_what_a_terminal_would_obey(tmp_path):
    with Store.open(tmp_path, identity={}):
        note = {"pid": 1, "host": "\x1b[31mevil", "since": "\x07\nx"}
        (tmp_path / "holder.json").write_text(json.dumps(note))
        with pytest.raises(LockedError) as caught:
            Store.open(tmp_path)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("path", ["a\0b", "a\ud800b", None, 5, b"bytes"])
def test_what_is_no_path_is_no_store(path):
    for call in (lambda: Store.open(path, identity={}), lambda: check_store(path), lambda: repair_store(path)):
        with pytest.raises(NotAStoreError):
            call()


def test_one_folder_by_two_paths_is_the_same(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "link").symlink_to("s")
    assert same_folder(tmp_path / "s", tmp_path / "link")
    assert same_folder(tmp_path / "none", tmp_path / "s" / ".." / "none")
    assert not same_folder(tmp_path / "s", tmp_path)


def test_a_number_beyond_all_numbers_is_no_row(tmp_path):
    path = build(tmp_path / "s")
    (path / "checkpoints" / ("9" * 40)).mkdir()
    with Store.open(path) as writer:
        commit(writer.commit, LAST)
    assert (path / "checkpoints" / ("9" * 40)).is_dir()
    put_row(path, sequence=2**63)
    with pytest.raises(DamageError, match="no row"):
        Store.open(path)
