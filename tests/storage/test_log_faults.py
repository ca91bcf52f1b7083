"""The log where things fail: killed writers, full disks, short writes, errors of the disk, threads."""

import errno
import os
import random
import resource
import signal
import subprocess
import sys
import threading

import pytest
from logs import BATCHES, KIND, append, build, names, read, rest

from store import StoreClosedError, StoreError, StoreFullError
from store.log import LogReader
from store.log_writer import AHEAD, LogWriter, create_log

ENDLESS = """
import os, sys, time
from pathlib import Path
from logs import KIND
from store.log_writer import LogWriter
with LogWriter(Path(sys.argv[1])) as log:
    batch = int(sys.argv[2])
    while True:
        for index in range(batch % 4 + 1):
            log.stage(KIND, b"%d %d " % (batch, index) * (batch * 37 % 400))
        log.commit()
        os.write(1, b"%d\\n" % batch)
        batch += 1
        time.sleep(0.0005)
"""


def expected(batch):
    return [b"%d %d " % (batch, index) * (batch * 37 % 400) for index in range(batch % 4 + 1)]


def test_what_was_acknowledged_survives_every_kill(tmp_path):
    path, rng, done = build(tmp_path / "log", []), random.Random(0), 0
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with LogReader(path) as beside:
        seen = []
        for _ in range(3):
            command = [sys.executable, "-c", ENDLESS, path, str(done)]
            with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE) as writer:
                last = done - 1
                for _ in range(rng.randint(1, 40)):
                    last = int(writer.stdout.readline())
                seen += rest(beside)
                writer.send_signal(signal.SIGKILL)
                last = max([last, *map(int, writer.stdout.read().split())])
            seen += rest(beside)
            found = read(path)
            assert len(found) in (last + 1, last + 2)
            assert found == [expected(batch) for batch in range(len(found))] == seen
            done = len(found)


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
            assert read(path) == [*kept, [b"%d" % round_]]


def test_where_it_cannot_take_a_batch_back_it_appends_nothing(tmp_path, monkeypatch, caplog):
    path = build(tmp_path / "log")
    with LogWriter(path) as log:
        failing = Failing(monkeypatch, log)
        failing.left = {"fdatasync": 1, "ftruncate": 2}
        for _ in range(2):
            with pytest.raises(StoreError, match="Input/output error"):
                log.append(KIND, b"never")
        assert "could not be taken back yet" in caplog.text
        log.append(KIND, b"again")
        monkeypatch.undo()
    assert read(path) == [*BATCHES, [b"again"]]


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


def test_a_fork_cannot_write_and_cuts_nothing_off(tmp_path):
    path = build(tmp_path / "log", [])
    with LogWriter(path) as log:
        command_in, command_out = os.pipe()
        if (child := os.fork()) == 0:
            os.read(command_in, 1)  # the parent has gone on
            try:
                log.append(KIND, b"of the child")
            except StoreClosedError:
                log.close()
                os._exit(0)
            os._exit(1)
        log.append(KIND, b"of the parent")
        os.write(command_out, b".")
        assert os.waitpid(child, 0)[1] == 0
        log.append(KIND, b"later")
    assert read(path) == [[b"of the parent"], [b"later"]]


def test_short_writes_are_gone_on_with(tmp_path, monkeypatch):
    path, write = build(tmp_path / "log"), os.write
    with LogWriter(path) as log:
        monkeypatch.setattr(os, "write", lambda file, data: write(file, bytes(data)[:300]))
        append(log, [b"a" * 2000, b"b"])
        monkeypatch.undo()
    assert read(path) == [*BATCHES, [b"a" * 2000, b"b"]]


def test_a_disk_that_fills_keeps_what_was_acknowledged_and_goes_on_when_there_is_room(small_disk):
    path, count = build(small_disk / "log", []), 0
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(200_000))
    with LogWriter(path) as log:
        for size in (30_000, 3_000, 300):
            with pytest.raises(StoreFullError, match="free some space"):
                while True:
                    log.append(KIND, bytes([count % 256]) * size)
                    count += 1
            assert len(read(path)) == count > 20
        ballast.unlink()
        log.append(KIND, b"room")
    found = read(path)
    assert found[-1] == [b"room"] and len(found) == count + 1
    with pytest.raises(StoreFullError):
        create_log(path, b"", [(KIND, os.urandom(2000)) for _ in range(500)])
    assert read(path) == found and names(small_disk) == ["log"]


def test_what_is_left_of_a_nearly_full_disk_is_for_others(small_disk):
    path = build(small_disk / "log", [])
    with LogWriter(path) as log:
        log.append(KIND, b"x" * 100)
        assert path.stat().st_size < 1000
        (small_disk / "other").write_bytes(bytes(500_000))


def test_every_size_at_which_a_file_may_end(tmp_path):
    """The system refuses the bytes behind a limit, after it has taken those before it."""
    path = build(tmp_path / "log")
    begin, (soft, hard) = path.stat().st_size, resource.getrlimit(resource.RLIMIT_FSIZE)
    data = path.read_bytes()
    batch = [b"a" * 40, b"b" * 60]
    needed = 3 * 88 + 100
    try:
        for room in range(0, needed + 1, 3):
            path.write_bytes(data)
            with LogWriter(path) as log:
                resource.setrlimit(resource.RLIMIT_FSIZE, (begin + room, hard))
                if room < needed:
                    with pytest.raises(StoreError, match="File too large"):
                        append(log, batch)
                    assert path.stat().st_size == begin
                    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
                append(log, batch)
                resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
                assert read(path) == [*BATCHES, batch]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_readers_beside_a_writer_see_whole_batches_and_no_damage(tmp_path):
    path, failures, done = build(tmp_path / "log", []), [], threading.Event()

    def follow():
        try:
            with LogReader(path) as log:
                found = []
                while not done.is_set():
                    found += rest(log)
                found += rest(log)
                assert found == [expected(batch) for batch in range(300)]
        except BaseException as error:
            failures.append(error)

    readers = [threading.Thread(target=follow) for _ in range(3)]
    for reader in readers:
        reader.start()
    with LogWriter(path) as log:
        for batch in range(300):
            append(log, expected(batch))
    done.set()
    for reader in readers:
        reader.join()
    assert failures == []


def test_threads_append_frames_that_do_not_mix(tmp_path):
    path = build(tmp_path / "log", [])
    with LogWriter(path) as log:

        def feed(name):
            for index in range(40):
                log.append(KIND, b"%d %d" % (name, index))

        threads = [threading.Thread(target=feed, args=(name,)) for name in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    found = [each for batch in read(path) for each in batch]
    for name in range(4):
        assert [each for each in found if each.startswith(b"%d " % name)] == [b"%d %d" % (name, i) for i in range(40)]


def test_what_was_acknowledged_is_there_to_the_byte(tmp_path):
    path, rng = build(tmp_path / "log", []), random.Random(1)
    sent = [rng.randbytes(rng.choice((0, 1, 511, 512, 4300, AHEAD - 176, AHEAD + 1))) for _ in range(40)]
    with LogWriter(path) as log:
        frames = [log.append(KIND, each) for each in sent]
        assert [log.read(frame.offset, frame.size)[1] for frame in frames] == sent
    assert [each for batch in read(path) for each in batch] == sent
