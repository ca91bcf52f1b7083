"""What a writer, other threads, a fork or ctrl-C do beside a call, at its worst moment."""

import gc
import multiprocessing
import os
import threading
from functools import partial

import numpy as np
import pytest
from scroll_tactile_store import LockedError, RecordError, Store, StoreClosedError, check_store
from scroll_tactile_store import log as store_log
from scroll_tactile_store.archive import write_archive
from scroll_tactile_store.files import tree_size
from scroll_tactile_store.rows import Rows
from store_builds import add, commit, damage, same_arrays, sequences, state, values


def look(path, copy):
    with Store.open(path, mode="read") as reader:
        last, after = reader.last, max(reader.compacted, reader.last - 3)
        assert sequences(reader.heads(last - 3)) == [last - 2, last - 1, last]
        found = [(row.sequence, row.arrays["x"].tobytes()) for row in reader.records(after)]
        assert found == [(n, values(n).tobytes()) for n in range(after + 1, last + 1)]
        newest = reader.latest()
        assert same_arrays(newest.arrays, state(newest.last_sequence))
    return last


def check(path, copy):
    assert damage(path) == []


def back_up(path, copy):
    with Store.open(path, mode="read") as reader:
        reader.backup(copy)
    return look(copy, None)


DOES = {
    "appends": lambda writer: [add(writer, writer.last + 1) for _ in range(2)],
    "commits": lambda writer: [commit(writer.commit, writer.last) for _ in range(2)],
    "compacts": lambda writer: [add(writer, writer.last + 1), commit(writer.compact, writer.last)],
}


@pytest.mark.parametrize("does", DOES)
@pytest.mark.parametrize(("use", "places"), [(look, range(24)), (check, range(0, 48, 5)), (back_up, range(0, 60, 5))])
def test_whoever_reads_finds_all_that_was_there_whatever_a_writer_does_meanwhile(
    tmp_path, monkeypatch, caplog, use, places, does
):
    """A writer does it once, before the first, second, third … file that is opened and part of one that is read."""
    with Store.open(tmp_path / "s", identity={}) as writer:
        [add(writer, number) for number in range(1, 4)]
        commit(writer.commit, 2)
        for place in places:
            calls, before = [], writer.last

            def call(*given, real, calls=calls, place=place, **named):
                calls.append(real)
                if len(calls) == place + 1:
                    DOES[does](writer)
                return real(*given, **named)

            with monkeypatch.context() as watched:
                for name in ("open", "read"):
                    watched.setattr(os, name, partial(call, real=getattr(os, name)))
                found = use(tmp_path / "s", tmp_path / f"copy {place}")
            assert found in (None, before, writer.last)
            commit(writer.commit, writer.last)  # or what is read grows faster than `place`
            assert place > 15 or place < len(calls)
    assert caplog.records == []


@pytest.fixture
def opened(tmp_path):
    with Store.open(tmp_path / "s", identity={}) as made:
        for i in range(10):
            made.append("add", "label", b"%d" % i, arrays={"x": np.arange(3.0)})
        yield made


def test_a_compaction_that_waited_for_a_later_one_is_refused(opened, monkeypatch):
    waiting, go, idle = threading.Event(), threading.Event(), Store._idle
    refused = []

    def wait(self):
        if threading.current_thread() is not threading.main_thread():
            waiting.set()
            go.wait(10)
        idle(self)

    def earlier():
        try:
            opened.compact({"sum": np.full(1, 5.0)}, last_sequence=5)
        except RecordError as error:
            refused.append(str(error))

    monkeypatch.setattr(Store, "_idle", wait)
    thread = threading.Thread(target=earlier)
    thread.start()
    waiting.wait(10)
    opened.compact({"sum": np.full(1, 10.0)}, last_sequence=10)
    go.set()
    thread.join()
    assert refused and "compacted up to 10 meanwhile" in refused[0]
    assert opened.compacted == 10
    assert check_store(opened.path) == []


def test_closing_waits_for_what_another_thread_commits(opened, monkeypatch):
    committing, go, write = threading.Event(), threading.Event(), Store._remove_unnamed

    def wait(self):
        if threading.current_thread() is not threading.main_thread():
            committing.set()
            go.wait(0.3)
        write(self)

    monkeypatch.setattr(Store, "_remove_unnamed", wait)
    thread = threading.Thread(target=lambda: opened.commit({"sum": np.ones(1)}, last_sequence=10))
    thread.start()
    committing.wait(10)
    opened.close()
    assert not thread.is_alive() or opened._committing.acquire(timeout=0)
    thread.join()
    with Store.open(opened.path) as again:
        assert [head.sequence for head in again.heads()] == [*range(1, 11)]


def test_a_fork_may_not_use_its_parents_store_and_takes_neither_its_lock_nor_what_was_unpacked(opened, tmp_path):
    write_archive(opened.path, tmp_path / "packed")
    assert tree_size(tmp_path / "packed") > 1000
    heads = opened.heads()
    next(heads)
    with Store.open(tmp_path / "packed", mode="read") as packed:
        folder = packed._folder

        def child(said):
            for use in (lambda: next(heads), lambda: opened.append("add", "label", b"x"), lambda: packed.last):
                with pytest.raises(StoreClosedError) as caught:
                    use()
                said.put(str(caught.value))
            opened.close()
            packed.__dict__.clear()
            gc.collect()

        said = multiprocessing.get_context("fork").SimpleQueue()
        process = multiprocessing.get_context("fork").Process(target=child, args=(said,))
        process.start()
        process.join(60)
        assert process.exitcode == 0 and all("fork" in said.get() for _ in range(3))
        said.close()
        with pytest.raises(LockedError):
            Store.open(opened.path)
        assert folder.exists() and packed.state().last == 10
    assert not folder.exists()
    assert opened.append("add", "label", b"x").sequence == 11
    assert check_store(opened.path) == []


def test_a_reader_that_is_interrupted_keeps_no_half_of_a_batch(opened, monkeypatch):
    with Store.open(opened.path, mode="read") as reader:
        with opened.batch():
            for i in range(4):
                opened.append("add", "label", b"later %d" % i)
        take, taken = Rows._take, []

        def interrupted(self, log, frame):
            taken.append(frame)
            if len(taken) == 3:
                raise KeyboardInterrupt
            return take(self, log, frame)

        monkeypatch.setattr(Rows, "_take", interrupted)
        with pytest.raises(KeyboardInterrupt):
            reader.state()
        assert reader.last == 10
        assert reader.state().last == 14
        assert [head.sequence for head in reader.heads()] == [*range(1, 15)]


def test_taking_back_that_is_interrupted_leaves_no_gap(opened, monkeypatch):
    sync, calls = store_log.sync_open, []

    def interrupted(*words, **named):
        calls.append(words)
        if len(calls) <= 2:
            raise KeyboardInterrupt
        return sync(*words, **named)

    monkeypatch.setattr(store_log, "sync_open", interrupted)
    with pytest.raises(KeyboardInterrupt):
        opened.append("add", "label", b"x")
    assert opened.append("add", "label", b"y").sequence == 11
    opened.close()
    assert check_store(opened.path) == []
