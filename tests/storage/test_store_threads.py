"""What other threads, a fork or ctrl-C do beside a call, at its worst moment."""

import os
import threading

import numpy as np
import pytest
from scroll_tactile_store import RecordError, Store, StoreClosedError, check_store
from scroll_tactile_store import log as store_log
from scroll_tactile_store.archive import write_archive
from scroll_tactile_store.files import tree_size
from scroll_tactile_store.rows import Rows


@pytest.fixture
def opened(tmp_path):
    with Store.open(tmp_path / "s", identity={}) as made:
        for i in range(10):
            made.append("add", "label", b"%d" % i, arrays={"x": np.arange(3.0)})
        yield made


def in_a_fork(do):
    """Whether it raises StoreClosedError in a forked child, which then ends as a script does."""
    if (pid := os.fork()) == 0:
        try:
            do()
            os._exit(0)
        except StoreClosedError:
            os._exit(7)
        finally:
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7


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


def test_what_was_opened_is_not_read_on_in_a_fork(opened):
    heads = opened.heads()
    next(heads)
    assert in_a_fork(lambda: next(heads))
    opened.append("add", "label", b"x")
    assert check_store(opened.path) == []


def test_a_fork_that_ends_leaves_its_parents_unpacked_store(opened, tmp_path):
    write_archive(opened.path, tmp_path / "packed")
    assert tree_size(tmp_path / "packed") > 1000
    with Store.open(tmp_path / "packed", mode="read") as packed:
        folder = packed._folder
        if (pid := os.fork()) == 0:
            try:
                packed.__dict__.clear()
                import gc

                gc.collect()
            finally:
                os._exit(0)
        os.waitpid(pid, 0)
        assert folder.exists()
        assert packed.state().last == 10
    assert not folder.exists()


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
