"""Group commit: rows that become durable together, or none of them."""

import errno
import os
from contextlib import contextmanager
from functools import partial

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
            opened.append("a", 5, b"")
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


def test_what_a_batch_does_not_allow_is_refused_at_once_and_waits_for_nothing(opened):
    calls = [partial(call, ONE, last_sequence=1) for call in (opened.commit, opened.commit_later, opened.compact)]
    calls += [opened.flush, opened.close, lambda: opened.batch().__enter__()]
    for number, call in enumerate(calls, 2):
        opened.commit_later(ONE, last_sequence=1)  # which a batch and its calls do not wait for
        with opened.batch():
            add(opened, f"{number}")
            with pytest.raises(StoreError, match=r"not possible in a batch .*: end it first"):
                call()
    assert labels(opened) == ["before", "2", "3", "4", "5", "6", "7"]
    opened.flush()
    assert opened.commit(ONE, last_sequence=3) > 1
    with Store.open(opened.path, mode="read") as reader, pytest.raises(ReadOnlyError), reader.batch():
        pass
