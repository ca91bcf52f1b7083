"""Group commit: rows that become durable together, or none of them."""

import errno
import os
from contextlib import contextmanager

import numpy as np
import pytest
from scroll_tactile_store import ReadOnlyError, RecordError, Store, StoreError, StoreFullError


@pytest.fixture
def opened(opened):
    opened.append("a", "before", b"")
    return opened


def labels(opened):
    return [row.label for row in opened.records()]


def add(opened, *names):
    return [opened.append("a", name, b"", arrays={"x": np.arange(5)}).sequence for name in names]


class Mine(BaseException):
    pass


@pytest.mark.parametrize("raised", [OSError(5, "mine"), KeyError("mine"), KeyboardInterrupt(), Mine()], ids=repr)
def test_after_an_exception_none_is_there_and_it_comes_out_as_it_is(opened, raised):
    with pytest.raises(type(raised)) as caught, opened.batch():
        add(opened, "one", "two")
        raise raised
    assert caught.value is raised
    assert labels(opened) == ["before"]
    assert opened.last == 1
    assert add(opened, "after") == [2]
    with opened.batch():
        assert add(opened, "again") == [3]
    assert labels(opened) == ["before", "after", "again"]


def test_a_refused_record_is_not_part_of_a_batch_that_goes_on(opened):
    with opened.batch():
        add(opened, "one")
        with pytest.raises(RecordError):
            opened.append("a", "\ud800", b"")
        assert add(opened, "two") == [3]
    assert labels(opened) == ["before", "one", "two"]


@contextmanager
def full_disk():
    """While it lasts nothing more can be written; the system calls of the log fail."""

    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.MonkeyPatch.context() as patch:
        for name in ("write", "fdatasync"):
            patch.setattr(os, name, fail)
        yield


def test_after_a_failed_append_none_is_there_whether_or_not_the_caller_goes_on(opened):
    noise = np.random.default_rng(0).integers(0, 2**60, 2**20)  # too much to wait for the end of the batch
    with pytest.raises(StoreError, match="nothing of this batch was kept"), opened.batch():
        add(opened, "one")
        with full_disk(), pytest.raises(StoreFullError):
            opened.append("a", "large", b"", arrays={"x": noise})
        with pytest.raises(StoreError, match="nothing more can be appended"):
            add(opened, "two")
        assert labels(opened) == ["before"]
        assert opened.last == 1
    with full_disk(), pytest.raises(StoreFullError), opened.batch():
        add(opened, "one")
        opened.append("a", "large", b"", arrays={"x": noise})
    assert labels(opened) == ["before"]
    assert add(opened, "after") == [2]


ONE = {"x": np.arange(3)}
IMPOSSIBLE = {
    "commit": lambda opened: opened.commit(ONE, last_sequence=1),
    "commit_later": lambda opened: opened.commit_later(ONE, last_sequence=1),
    "compact": lambda opened: opened.compact(ONE, last_sequence=1),
    "flush": lambda opened: opened.flush(),
    "close": lambda opened: opened.close(),
    "batch": lambda opened: opened.batch().__enter__(),
}


@pytest.mark.parametrize("call", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_what_a_batch_does_not_allow_is_refused_at_once_and_does_no_harm(opened, call):
    with opened.batch():
        add(opened, "one")
        with pytest.raises(StoreError, match=r"not possible in a batch .*: end it first"):
            call(opened)
        add(opened, "two")
    assert labels(opened) == ["before", "one", "two"]
    assert opened.latest() is None
    assert opened.commit(ONE, last_sequence=3) == 1


def test_a_batch_and_a_background_commit_do_not_wait_for_each_other_for_ever(opened):
    for _ in range(5):
        opened.commit_later(ONE, last_sequence=1)
        with opened.batch():
            add(opened, "one")
            with pytest.raises(StoreError, match="end it first"):
                opened.flush()
    opened.flush()
    assert opened.last == 6


def test_a_reader_has_no_batches(opened):
    with Store.open(opened.path, mode="read") as reader, pytest.raises(ReadOnlyError), reader.batch():
        pass
