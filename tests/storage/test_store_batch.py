"""Group commit: rows that become durable together, or none of them."""

import errno
import os
from contextlib import contextmanager

import numpy as np
import pytest
from scroll_tactile_store import ReadOnlyError, RecordError, Store, StoreError, StoreFullError
from store_builds import fails


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
    assert (labels(opened), opened.last) == (["before"], 1)
    assert add(opened, "after") == [2]
    with opened.batch():
        assert add(opened, "again") == [3]
        with pytest.raises(RecordError):  # which is not part of it, and it goes on
            opened.append("a", "\0", b"")
        assert add(opened, "and again") == [4]
    assert labels(opened) == ["before", "after", "again", "and again"]


@contextmanager
def full_disk():
    """While it lasts nothing more can be written; the system calls of the log fail."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("write", "pwrite", "fdatasync"):
            patch.setattr(os, name, fails(errno.ENOSPC))
        yield


def test_after_a_failed_append_none_is_there_whether_or_not_the_caller_goes_on(opened):
    noise = np.random.default_rng(0).integers(0, 2**60, 2**20)  # too much to wait for the end of the batch
    with pytest.raises(StoreError, match="nothing of this batch was kept"), opened.batch():
        add(opened, "one")
        with full_disk(), pytest.raises(StoreFullError):
            opened.append("a", "large", b"", arrays={"x": noise})
        with pytest.raises(StoreError, match="nothing more can be appended"):
            add(opened, "two")
        assert (labels(opened), opened.last) == (["before"], 1)
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


def test_what_a_batch_does_not_allow_is_refused_at_once_and_waits_for_nothing(opened):
    for number, (name, call) in enumerate(IMPOSSIBLE.items(), 2):
        opened.commit_later(ONE, last_sequence=1)  # which a batch and its calls do not wait for
        with opened.batch():
            add(opened, name)
            with pytest.raises(StoreError, match=r"not possible in a batch .*: end it first"):
                call(opened)
        assert opened.last == number
    assert labels(opened) == ["before", *IMPOSSIBLE]
    opened.flush()
    assert opened.commit(ONE, last_sequence=3) > 1
    with Store.open(opened.path, mode="read") as reader, pytest.raises(ReadOnlyError), reader.batch():
        pass
