"""Who may open what: one writer, any readers, and nothing that is not a store of ours."""

import json
import multiprocessing
import os
from pathlib import Path

import numpy as np
import pytest
import scroll_tactile_store.layout
import scroll_tactile_store.store
from scroll_tactile_store import (
    CompactedError,
    LockedError,
    NotAStoreError,
    ReadOnlyError,
    RecordError,
    Store,
    StoreClosedError,
)


def test_a_new_store_keeps_its_identity_and_a_later_one_does_not_replace_it(tmp_path):
    path = tmp_path / "deep" / "er"
    with Store.open(path, identity={"for": ["this", 1]}) as made:
        assert (made.identity, made.last, made.latest(), list(made.records())) == ({"for": ["this", 1]}, 0, None, [])
    with Store.open(path, identity={"for": "that"}) as again:
        assert again.identity == {"for": ["this", 1]}
    with Store.open(str(path), mode="read") as reader:
        assert reader.identity == {"for": ["this", 1]}
        assert (reader.path, reader.mode) == (path, "read")


def test_a_second_writer_is_told_who_holds_it(tmp_path):
    told = rf"process {os.getpid()} on .* since 20.*mode=\"read\""
    with Store.open(tmp_path, identity={}), pytest.raises(LockedError, match=told):
        Store.open(tmp_path)


def test_a_dead_holders_note_is_no_obstacle(tmp_path):
    Store.open(tmp_path, identity={}).close()
    (tmp_path / "holder.json").write_text('{"pid": 1, "host": "gone", "since": "2001-01-01"}')
    with Store.open(tmp_path):
        assert json.loads((tmp_path / "holder.json").read_text())["pid"] == os.getpid()
    assert not (tmp_path / "holder.json").exists()


@pytest.mark.parametrize("note", ["", "[]", "{}", "not json"])
def test_a_spoilt_note_still_gives_a_clear_refusal(tmp_path, note):
    with Store.open(tmp_path, identity={}):
        (tmp_path / "holder.json").write_text(note)
        with pytest.raises(LockedError, match="left no note"):
            Store.open(tmp_path)


def test_a_reader_may_do_nothing_that_writes(tmp_path):
    Store.open(tmp_path, identity={}).close()
    with Store.open(tmp_path, mode="read") as reader:
        for call in (
            lambda: reader.append("a", "b", b""),
            lambda: reader.commit({}, last_sequence=0),
            lambda: reader.commit_later({}, last_sequence=0),
        ):
            with pytest.raises(ReadOnlyError):
                call()


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


def test_closing_is_final_and_may_be_repeated(tmp_path):
    opened = Store.open(tmp_path, identity={})
    opened.append("a", "b", b"")
    rows = opened.records()
    opened.close()
    opened.close()
    for call in (
        lambda: opened.append("a", "b", b""),
        lambda: opened.last,
        opened.records,
        lambda: next(rows),
        opened.latest,
        lambda: opened.commit({}, last_sequence=0),
        lambda: opened.commit_later({}, last_sequence=0),
        opened.flush,
        opened.size,
        opened.__enter__,
    ):
        with pytest.raises(StoreClosedError):
            call()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_fork_may_not_use_its_parents_store(tmp_path):
    with Store.open(tmp_path, identity={}) as opened:
        opened.append("a", "b", b"")
        context = multiprocessing.get_context("fork")
        answer = context.SimpleQueue()

        def child():
            try:
                opened.append("a", "c", b"")
            except StoreClosedError as error:
                answer.put(str(error))
            opened.close()

        process = context.Process(target=child)
        process.start()
        process.join()
        assert "fork" in answer.get()
        with pytest.raises(LockedError):  # the child's close did not free the parent's lock
            Store.open(tmp_path)
        assert opened.append("a", "d", b"").sequence == 2
        answer.close()
        process.close()


@pytest.mark.parametrize("mode", ["read", "write"])
def test_where_there_is_no_store_nothing_is_made_without_an_identity(tmp_path, mode):
    with pytest.raises(NotAStoreError):
        Store.open(tmp_path / "new", mode=mode)
    assert list(tmp_path.iterdir()) == []


def test_a_store_that_another_process_is_just_making_is_no_foreign_folder(tmp_path, monkeypatch):
    Store.open(tmp_path / "s", identity={}).close()
    real = Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda path: (each for each in real(path) if each.name != "CURRENT"))
    with Store.open(tmp_path / "s", mode="read") as opened:
        assert opened.last == 0


def test_a_mode_is_read_or_write(tmp_path):
    with pytest.raises(RecordError, match="append"):
        Store.open(tmp_path, identity={}, mode="append")


def test_a_reader_stays_with_what_it_asked_for_and_reads_current_once_for_all_that_is_new(tmp_path, monkeypatch):
    read, calls = scroll_tactile_store.store.read_current, []
    with Store.open(tmp_path, identity={}) as writer, Store.open(tmp_path, mode="read") as reader:
        for number in range(3):
            writer.append("a", f"{number}", b"k")
        writer.commit({}, last_sequence=2)
        assert (reader.last, reader.newest, list(reader.heads()), reader.latest()) == (0, None, [], None)
        monkeypatch.setattr(
            scroll_tactile_store.store, "read_current", lambda path: [calls.append(path), read(path)][1]
        )
        assert reader.state() == writer.state() == (3, 1, 0)
        assert [row.label for row in reader.records()] == ["0", "1", "2"]
        assert (reader.last, reader.compacted, reader.latest().last_sequence) == (3, 0, 2)
        assert [head.sequence for head in reader.with_key(b"k")] == [1, 2, 3]
        assert calls == [tmp_path / "CURRENT"]


def test_a_reader_reads_on_what_a_writer_has_replaced(tmp_path):
    with Store.open(tmp_path, identity={}) as writer:
        for number in range(4):
            writer.append("a", f"{number}", b"k", arrays={"x": np.arange(3)})
        writer.commit({}, last_sequence=2)
        with Store.open(tmp_path, mode="read") as reader:
            writer.compact({}, last_sequence=3)
            assert [row.sequence for row in reader.records()] == [1, 2, 3, 4]
            assert reader.compaction() is None
            writer.compact({}, last_sequence=4)
            reader.state()
            writer.compact({"new": np.arange(2)}, last_sequence=4)
            with pytest.raises(CompactedError, match="read it anew"):
                reader.compaction()
            assert list(reader.compaction().arrays) == ["new"]
