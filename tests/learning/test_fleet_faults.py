"""What a fleet meets in those who run its jobs, and in what is left behind: typed, named, and recovered from."""

import json
import multiprocessing.forkserver
import os
import signal
import threading
from concurrent.futures import Executor, Future
from contextlib import suppress

import pytest
from scroll_tactile_store import LockedError
from test_fleet import BY_FOLDER, TOUCHES, expected, jobs_here, require_learned, run, touch_files
from touches import SETTINGS

from examples.benchmarks.fleet import DyingExecutor
from scroll_tactile.clients.learning import fleet, runfile, steps
from scroll_tactile.clients.learning.fleet import learn
from scroll_tactile.errors import InputError, ScrollTactileError

__all__ = ["jobs_here"]  # a fixture


@pytest.fixture
def sources(tmp_path):
    return touch_files(tmp_path / "in", TOUCHES)


class Silent(Executor):
    """Never answers, after so many jobs that it did."""

    _max_workers = 2

    def __init__(self, after=0):
        self.after = after

    def submit(self, what, /, *words, **named):
        self.after -= 1
        return DyingExecutor().submit(what, *words) if self.after >= 0 else Future()


class Then(DyingExecutor):
    """Does something with each job when it is done, and its number."""

    def __init__(self, then):
        super().__init__()
        self.then, self.done = then, 0

    def submit(self, what, job):
        future = super().submit(what, job)
        self.done += 1
        self.then(job, self.done)
        return future


class TestPatience:
    @pytest.mark.usefixtures("jobs_here")
    @pytest.mark.parametrize("after", [0, 3])
    def test_an_executor_that_never_answers_is_named_and_the_same_call_goes_on(
        self, tmp_path, sources, monkeypatch, after
    ):
        monkeypatch.setattr(fleet, "GRACE", 0.2)
        monkeypatch.setattr(steps, "MOST_SOURCES", 1)
        with pytest.raises(ScrollTactileError, match="Silent has answered no job for 2 s"):
            run(tmp_path / "m", [tmp_path / "in"], client=Silent(after), patience=1)
        done = run(tmp_path / "m", [tmp_path / "in"])
        assert (done.observations, done.held, done.repeated) == (12 - after, 12, 0)  # what was learned before came in
        require_learned(tmp_path / "m")

    @pytest.mark.usefixtures("jobs_here")
    def test_a_job_that_is_never_answered_is_handed_over_again(self, tmp_path, sources, monkeypatch):
        monkeypatch.setattr(fleet, "GRACE", 0.2)
        monkeypatch.setattr(steps, "MOST_SOURCES", 2)

        class Forgetful(DyingExecutor):
            forgotten = 0

            def submit(self, what, job):
                if str(sources[0]) in getattr(job, "sources", ()) and self.forgotten < 1:
                    self.forgotten += 1
                    return Future()
                future = Future()
                threading.Timer(0.1, lambda: future.set_result(what(job))).start()
                return future

        done = run(tmp_path / "m", [tmp_path / "in"], client=Forgetful(), patience=3)
        assert done.deaths == 1 and done.digest == expected().digest() and not done.refused

    def test_a_worker_that_is_stopped_is_ended_and_its_job_done_by_another(self, tmp_path, sources, monkeypatch):
        # On a busy machine the worker that comes after it may be late, too: it is tried as often as that takes.
        for module, name, value in ((fleet, "QUEUED", 0), (fleet, "GRACE", 8.0), (steps, "MOST_TRIES", 1000)):
            monkeypatch.setattr(module, name, value)
        stopped = []
        submit = fleet.Processes.submit

        def stopping(self, what, job):
            future = submit(self, what, job)
            if not stopped:
                (process,) = self._busy[future]._processes.values()
                stopped.append(process.pid)
                os.kill(process.pid, signal.SIGSTOP)
            return future

        monkeypatch.setattr(fleet.Processes, "submit", stopping)
        done = learn(tmp_path / "m", sources[:4], BY_FOLDER, workers=1, patience=60, **SETTINGS)
        assert done.deaths and done.observations == 4
        with pytest.raises(ProcessLookupError):
            for _ in range(100):
                os.kill(stopped[0], 0)
                threading.Event().wait(0.1)


class TestGarbage:
    @pytest.mark.parametrize("made", [None, "done"])
    def test_what_is_no_answer_is_asked_for_again_and_named_in_the_end(self, tmp_path, sources, monkeypatch, made):
        monkeypatch.setattr(steps, "MOST_TRIES", 2)

        class Garbage(DyingExecutor):
            def submit(self, what, job):
                future = Future()
                future.set_result(made)
                return future

        with pytest.raises(InputError, match=r"nothing was learned.*2 sources were refused.*MismatchError: expected"):
            run(tmp_path / "m", sources[:2], client=Garbage())

    def test_one_that_is_never_there_is_named_in_the_end(self, tmp_path, sources, monkeypatch):
        monkeypatch.setattr(steps, "MOST_TRIES", 2)

        elsewhere = Then(lambda job, number: job.target.unlink())
        with pytest.raises(InputError, match=r"2 sources were refused.*while they learned it, again and again"):
            run(tmp_path / "m", sources[:2], client=elsewhere)


def test_a_job_has_no_more_bytes_than_it_may(tmp_path, sources, monkeypatch):
    monkeypatch.setattr(steps, "JOBS_A_WORKER", 1)
    monkeypatch.setattr(steps, "MOST_STEP_BYTES", 2 * max(path.stat().st_size for path in sources))
    jobs = []
    client = Then(lambda job, number: jobs.append(len(job.sources)))
    client._max_workers = 1
    assert run(tmp_path / "m", sources, client=client).observations == 12
    assert jobs == [2] * 6


class TestSpoilt:
    @pytest.mark.parametrize("place", [-9, 3000])
    def test_one_that_is_spoilt_while_the_run_goes_on_is_learned_again(self, tmp_path, sources, monkeypatch, place):
        monkeypatch.setattr(steps, "MOST_SOURCES", 3)

        def spoil(job, number):
            if number == 3:
                whole = bytearray(job.target.read_bytes())
                whole[place] ^= 1
                job.target.write_bytes(bytes(whole))

        done = run(tmp_path / "m", [tmp_path / "in"], client=Then(spoil))
        assert done.observations == 12 and not done.refused and done.sources == 12
        require_learned(tmp_path / "m")


class TestNotes:
    @pytest.mark.parametrize(
        ("text", "match"),
        [
            ("[" * 100_000, "cannot be read"),
            ('{"format": 1, "plan": 5, "notes": {}}', "cannot be read"),
            ("[1, 2]", "cannot be read"),
            (None, "what a run learned in .*; it cannot be read: .* begin with add=True"),
        ],
    )
    def test_notes_that_are_none(self, tmp_path, sources, text, match):
        run(tmp_path / "m", sources[:2])
        notes = tmp_path / "m.fleet" / "run.json"
        kept = json.loads(notes.read_text())
        made = {"sources": [str(sources[3])], "made": {"refused": []}}
        wrong = [("learned", 5), ("made", 5), ("made", [5]), ("made", [{}]), ("made", [made])]
        for name, value in wrong if text is None else wrong[:1]:
            said = kept | {"notes": kept["notes"] | {name: value}}
            notes.write_text(json.dumps(said) if text is None else text)
            with pytest.raises(InputError, match=match) as raised:
                run(tmp_path / "m", sources)
            assert "ove" in str(raised.value) and "away" in str(raised.value)
        (tmp_path / "m.fleet").rename(tmp_path / "away")
        assert run(tmp_path / "m", sources, add=True).observations == 10

    def test_what_a_worker_left_that_was_killed_is_removed_and_nothing_else(self, tmp_path, sources):
        run(tmp_path / "m", sources[:2])
        left = tmp_path / "m.fleet" / "learned-0.part.x.partial"
        (left / "memory").mkdir(parents=True)
        (tmp_path / "m.fleet" / "mine.txt").write_text("any")
        seen = []
        run(tmp_path / "m", sources, client=Then(lambda job, number: seen.append(left.exists())))
        assert seen and not any(seen)
        assert sorted(path.name for path in (tmp_path / "m.fleet").iterdir()) == ["mine.txt", "run.json"]

    def test_notes_are_few_where_noting_takes_long(self, tmp_path, sources, monkeypatch):
        monkeypatch.setattr(steps, "MOST_SOURCES", 1)
        monkeypatch.setattr(steps, "NOTING", 10**9)
        written = []
        write = runfile.RunFile._write
        monkeypatch.setattr(runfile.RunFile, "_write", lambda *words: written.append(1) or write(*words))
        run(tmp_path / "m", sources)
        assert len(written) == 3  # as it began, at the first step and at the end
        assert len(json.loads((tmp_path / "m.fleet" / "run.json").read_text())["notes"]["learned"]) == 12

    def test_two_runs_for_one_destination(self, tmp_path, sources):
        class Second(DyingExecutor):
            def submit(self, what, job):
                with pytest.raises(LockedError, match=r"another run is at work for .*: wait until it has ended"):
                    run(tmp_path / "m", sources[:2])
                return super().submit(what, job)

        assert run(tmp_path / "m", sources, client=Second()).observations == 12
        assert run(tmp_path / "m", sources).observations == 0


@pytest.mark.parametrize("error", [None, KeyError()])
def test_processes_are_waited_for_unless_an_error_ends_the_block_whatever_the_caller_handles(error):
    waits = []

    class Pool:
        def shutdown(self, *, wait, cancel_futures):
            waits.append(wait)

    try:
        raise ValueError("the caller's own")
    except ValueError:
        with suppress(KeyError), fleet.Processes(1) as processes:
            processes._all.add(Pool())
            if error is not None:
                raise error from None
    assert waits == [error is None]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork server")
def test_a_fork_server_that_is_killed_is_begun_again(tmp_path, sources, monkeypatch):
    monkeypatch.setattr(steps, "MOST_SOURCES", 3)
    killed = []
    submit = fleet.Processes.submit

    def killing(self, what, job):
        server = multiprocessing.forkserver._forkserver._forkserver_pid
        if server is not None and len(killed) < 2 and server not in killed:
            killed.append(server)
            with suppress(ProcessLookupError):
                os.kill(server, signal.SIGKILL)
        return submit(self, what, job)

    monkeypatch.setattr(fleet.Processes, "submit", killing)
    done = learn(tmp_path / "m", [tmp_path / "in"], BY_FOLDER, workers=2, **SETTINGS)
    assert killed and done.observations == 12 and done.digest == expected().digest()
