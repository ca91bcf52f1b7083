"""Who may open what: one writer, any readers that change nothing, and nothing that is not a store of ours.

What a folder from somebody else may not do stands in tests/test_strangers.py.
"""

import errno
import fcntl
import json
import os
import stat
from functools import partial

import numpy as np
import pytest
import scroll_tactile_store.layout
import scroll_tactile_store.store
from scroll_tactile_store import (
    LockedError,
    NotAStoreError,
    ReadOnlyError,
    Store,
    StoreClosedError,
    StoreError,
    check_store,
    repair_store,
)
from store_builds import LAST, add, as_after_a_crash, build, contents, fails, sequences


def test_a_new_store_keeps_its_identity_and_a_later_one_does_not_replace_it(tmp_path):
    path = tmp_path / "deep" / "er"
    with pytest.raises(ValueError, match="append"):
        Store.open(path, identity={}, mode="append")
    for mode in ("read", "write"):
        with pytest.raises(NotAStoreError):
            Store.open(path, mode=mode)
    assert list(tmp_path.iterdir()) == []
    with Store.open(path, identity={"for": ["this", 1]}) as made:
        assert (made.identity, made.last, made.latest(), list(made.records())) == ({"for": ["this", 1]}, 0, None, [])
    with Store.open(path, identity={"for": "that"}) as again:
        assert again.identity == {"for": ["this", 1]}
    with Store.open(str(path), mode="read") as reader:
        assert reader.identity == {"for": ["this", 1]}
        assert (reader.path, reader.mode) == (path, "read")


# Locks.


def test_a_second_writer_is_told_who_holds_it_also_by_a_link_and_no_dead_ones_note_is_an_obstacle(tmp_path):
    build(tmp_path / "s")
    (tmp_path / "link").symlink_to(tmp_path / "s")
    note = tmp_path / "s" / "holder.json"
    note.write_text('{"pid": 1, "host": "gone", "since": "2001-01-01"}')
    with Store.open(tmp_path / "link") as writer:
        assert json.loads(note.read_text())["pid"] == os.getpid()
        assert add(writer, LAST + 1).sequence == LAST + 1
        with pytest.raises(LockedError, match=rf"process {os.getpid()} on .* since 20.*mode=\"read\""):
            Store.open(tmp_path / "s")
        evil = json.dumps({"pid": 1, "host": "\x1b[31mevil", "since": "\x07\nx"})
        for text, told in (
            ("", "no note"),
            ("[]", "no note"),
            ("{}", "no note"),
            ("not json", "no note"),
            (evil, "evil"),
        ):
            note.write_text(text)
            with pytest.raises(LockedError, match=told) as caught:
                Store.open(tmp_path / "s")
            assert str(caught.value).isprintable()  # a terminal obeys nothing in it
    assert not note.exists()
    assert check_store(tmp_path / "link") == []


@pytest.mark.parametrize("code", [errno.ENOSYS, errno.ENOLCK])
def test_where_there_are_no_locks_that_is_said_and_no_other_kind_is_taken(tmp_path, monkeypatch, code):
    Store.open(tmp_path / "s", identity={}).close()
    before = contents(tmp_path / "s")
    monkeypatch.setattr(fcntl, "flock", fails(code))
    for path in (tmp_path / "s", tmp_path / "new"):
        with pytest.raises(StoreError, match="without which two writers could spoil") as caught:
            Store.open(path, identity={})
        assert not isinstance(caught.value, LockedError)
        assert str(path) in str(caught.value)
    assert read_all(tmp_path / "s") == []
    assert contents(tmp_path / "s") == before


# Readers.


def everything(folder):
    """All that can be told of a folder: names, bytes, sizes, times, and what each is."""
    told = {}
    for path in [folder, *sorted(folder.rglob("*"))]:
        entry = path.lstat()
        data = path.read_bytes() if stat.S_ISREG(entry.st_mode) else None
        told[str(path.relative_to(folder))] = (entry.st_mode, entry.st_size, entry.st_mtime_ns, entry.st_ino, data)
    return told


def read_all(path):
    with Store.open(path, mode="read") as reader:
        reader.latest()
        return [row.label for row in reader.records(reader.compacted)]


def backed_up(path, target):
    with Store.open(path, mode="read") as reader:
        reader.backup(target)
    return read_all(target)


@pytest.mark.parametrize("left", ["closed", "killed", "closed beside a reader"])
def test_reading_checking_and_backing_up_leave_the_folder_as_it_is(tmp_path, left):
    path = build(tmp_path / "s")
    if left != "closed":
        with Store.open(path) as writer, Store.open(path, mode="read") as reader:
            add(writer, LAST + 1)
            assert reader.state().last == LAST + 1
            killed = as_after_a_crash(writer, tmp_path / "c")
            writer.close()
        path = killed if left == "killed" else path
    before = everything(path)
    expected = [f"row {number}" for number in range(1, LAST + 1 + (left != "closed"))]
    for name in "12":
        assert (read_all(path), check_store(path), backed_up(path, tmp_path / name)) == (expected, [], expected)
    assert everything(path) == before


def test_a_reader_stays_with_what_it_asked_for_and_reads_current_once_for_all_that_is_new(tmp_path, monkeypatch):
    read, calls = scroll_tactile_store.store.read_current, []
    with Store.open(tmp_path, identity={}) as writer, Store.open(tmp_path, mode="read") as reader:
        for number in range(3):
            writer.append("a", f"{number}", b"k")
        writer.commit({}, last_sequence=2)
        assert reader.state(look=False) == (0, None, 0)
        assert (list(reader.heads()), reader.latest()) == ([], None)
        monkeypatch.setattr(
            scroll_tactile_store.store, "read_current", lambda path: [calls.append(path), read(path)][1]
        )
        assert reader.state() == writer.state() == (3, 1, 0)
        assert [row.label for row in reader.records()] == ["0", "1", "2"]
        assert (reader.last, reader.compacted, reader.latest().last_sequence) == (3, 0, 2)
        assert sequences(reader.with_key(b"k")) == [1, 2, 3]
        assert calls == [tmp_path / "CURRENT"]
        for call in (reader.commit, reader.commit_later, reader.compact):
            with pytest.raises(ReadOnlyError):
                call({}, last_sequence=0)
        with pytest.raises(ReadOnlyError):
            reader.append("a", "b", b"")


def test_a_reader_whose_folder_becomes_another_stores_reads_that_one(tmp_path):
    for name, rows in (("one", 1), ("other", 3)):
        with Store.open(tmp_path / name, identity={"for": name}) as made:
            for _ in range(rows):
                made.append("a", name, b"")
    with Store.open(tmp_path / "one", mode="read") as reader:
        (tmp_path / "one").rename(tmp_path / "gone")
        (tmp_path / "other").rename(tmp_path / "one")
        assert [head.label for head in reader.heads()] == ["one"]
        assert reader.state() == (3, None, 0)
        assert [head.label for head in reader.heads()] == ["other"] * 3


def test_a_store_that_another_process_is_just_making_is_no_foreign_folder(tmp_path, monkeypatch):
    Store.open(tmp_path / "s", identity={}).close()
    real, looks = scroll_tactile_store.layout.read_current, []

    def not_yet(folder):
        looks.append(folder)
        if len(looks) == 1:
            raise FileNotFoundError
        return real(folder)

    monkeypatch.setattr(scroll_tactile_store.layout, "read_current", not_yet)
    with Store.open(tmp_path / "s", mode="read") as opened:
        assert opened.last == 0


def test_closing_is_final_and_may_be_repeated(tmp_path):
    opened = Store.open(tmp_path, identity={})
    opened.append("a", "b", b"", arrays={"x": np.arange(3)})
    rows = opened.records()
    opened.close()
    opened.close()
    calls = [partial(call, {}, last_sequence=0) for call in (opened.commit, opened.commit_later, opened.compact)]
    calls += [partial(opened.append, "a", "b", b""), partial(next, rows), opened.records, opened.latest, opened.state]
    for call in (*calls, opened.flush, opened.size, opened.__enter__):
        with pytest.raises(StoreClosedError):
            call()


# Paths.


@pytest.mark.parametrize("path", ["a\0b", "a\ud800b", None, 5, b"bytes"])
def test_what_is_no_path_is_no_store(path):
    for call in (lambda: Store.open(path, identity={}), lambda: check_store(path), lambda: repair_store(path)):
        with pytest.raises(NotAStoreError):
            call()


def test_where_there_is_no_store_none_is_read_checked_or_repaired_and_nothing_written(tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.txt").write_text("mine")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "empty").mkdir()
    before = contents(tmp_path)
    for name in ("file", "folder", "loop", "empty", "nothing"):
        for call in (check_store, repair_store, read_all):
            with pytest.raises(NotAStoreError, match=name):
                call(tmp_path / name)
    with pytest.raises(NotAStoreError, match="thesis"):
        Store.open(tmp_path / "folder", identity={})
    assert contents(tmp_path) == before
