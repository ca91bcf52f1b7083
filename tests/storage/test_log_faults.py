"""The log where things fail: killed writers, full disks, short writes, errors of the disk, threads."""

import errno
import os

import pytest
from logs import BATCHES, KIND, append, build, read, rest
from scroll_tactile_store import StoreError, StoreFullError
from scroll_tactile_store.log import LogReader
from scroll_tactile_store.log_writer import AHEAD, LogWriter


class Failing:
    """A writer's file of which one call in a while fails."""

    def __init__(self, monkeypatch, log):
        self.left = {}
        self.code = errno.EIO
        write, sync, cut = log._file.write, os.fdatasync, os.ftruncate
        monkeypatch.setattr(log._file, "write", self.failing("write", write, part=True))
        monkeypatch.setattr(os, "fdatasync", self.failing("fdatasync", sync))
        monkeypatch.setattr(os, "ftruncate", self.failing("ftruncate", cut))

    def failing(self, name, call, *, part=False):
        def called(*given):
            if self.left.get(name, 0):
                self.left[name] -= 1
                if part:
                    call(given[0], given[1][: len(given[1]) // 2])
                raise OSError(self.code, os.strerror(self.code))
            return call(*given)

        return called


@pytest.mark.parametrize("name", ["write", "fdatasync"])
@pytest.mark.parametrize(("code", "error"), [(errno.EIO, StoreError), (errno.ENOSPC, StoreFullError)])
def test_a_failed_append_leaves_the_log_as_it_was(tmp_path, monkeypatch, name, code, error):
    path = build(tmp_path / "log")
    with LogWriter(path) as log, LogReader(path) as beside:
        failing = Failing(monkeypatch, log)
        failing.code = code
        beside.refresh()
        for round_ in range(3):
            failing.left = {name: 2 if name == "write" else 1}  # without room it tries once more, without zeros
            with pytest.raises(error):
                log.append(KIND, b"never" * 200)
            failing.left = {}
            kept = [*BATCHES, *([b"%d" % i] for i in range(round_))]
            assert read(path) == kept
            log.append(KIND, b"%d" % round_)
            assert path.stat().st_size == AHEAD  # the room ahead is made again
            assert read(path) == [*kept, [b"%d" % round_]]


def test_a_reader_learns_that_what_it_read_was_taken_back(tmp_path, monkeypatch):
    path = build(tmp_path / "log")
    with LogWriter(path) as log, LogReader(path) as beside:
        failing = Failing(monkeypatch, log)
        failing.left = {"fdatasync": 1, "ftruncate": 1}
        with pytest.raises(StoreError):
            log.append(KIND, b"not durable")
        assert rest(beside) == [*BATCHES, [b"not durable"]]
        log.append(KIND, b"in its place")
        with pytest.raises(StoreError, match="took a batch back"):
            rest(beside)
        with LogReader(path) as anew:
            assert rest(anew) == [*BATCHES, [b"in its place"]]


def test_short_writes_are_gone_on_with(tmp_path, monkeypatch):
    path, write = build(tmp_path / "log"), os.write
    with LogWriter(path) as log:
        monkeypatch.setattr(os, "write", lambda file, data: write(file, bytes(data)[:300]))
        append(log, [b"a" * 2000, b"b"])
        monkeypatch.undo()
    assert read(path) == [*BATCHES, [b"a" * 2000, b"b"]]


def test_what_is_left_of_a_nearly_full_disk_is_for_others(small_disk):
    path = build(small_disk / "log", [])
    with LogWriter(path) as log:
        log.append(KIND, b"x" * 100)
        assert path.stat().st_size < 1000
        (small_disk / "other").write_bytes(bytes(500_000))
