"""What a fleet meets in those who run its jobs, and in what is left behind: typed, named, and recovered from."""

import json
import multiprocessing.forkserver
import os
import pickle
import signal
import threading
from concurrent.futures import Executor, Future
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from scroll_tactile.memory.partial import Partial, write_partial
from scroll_tactile.pipelines.partials import Contained, Made, Making
from test_fleet import BY_FOLDER, TOUCHES, expected, require_learned, run, touch_files
from touches import SETTINGS

from examples.benchmarks.fleet import DyingExecutor
from scroll_tactile import TactileLearner
from scroll_tactile.errors import InputError, ScrollTactileError
from scroll_tactile.pipelines import engines, fleet, partials, runfile
from scroll_tactile.pipelines.fleet import learn
from store import DamageError, LockedError, StoreFullError


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


class TestPatience:
    @pytest.mark.parametrize("after", [0, 3])
    def test_an_executor_that_never_answers_is_named_and_the_same_call_goes_on(
        self, tmp_path, sources, monkeypatch, after
    ):
        monkeypatch.setattr(fleet, "GRACE", 0.2)
        monkeypatch.setattr(steps, "MOST_SOURCES", 1)
        with pytest.raises(ScrollTactileError, match="Silent has answered no job for 1 s"):
            run(tmp_path / "m", [tmp_path / "in"], client=Silent(after), patience=0.2)
        assert run(tmp_path / "m", [tmp_path / "in"]).observations == 12
        require_learned(tmp_path / "m")

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

        done = run(tmp_path / "m", [tmp_path / "in"], client=Forgetful(), patience=0.5)
        assert done.deaths == 1 and done.digest == expected().digest() and not done.refused

    def test_a_worker_that_is_stopped_is_ended_and_its_job_done_by_another(self, tmp_path, sources, monkeypatch):
        monkeypatch.setattr(fleet, "GRACE", 0.5)
        stopped = []
        submit = engines.Processes.submit

        def stopping(self, what, job):
            future = submit(self, what, job)
            if not stopped:
                (process,) = self._busy[future]._processes.values()
                stopped.append(process.pid)
                os.kill(process.pid, signal.SIGSTOP)
            return future

        monkeypatch.setattr(engines.Processes, "submit", stopping)
        done = learn(tmp_path / "m", sources[:6], BY_FOLDER, workers=1, patience=4, **SETTINGS)
        assert done.deaths and done.observations == 6
        with pytest.raises(ProcessLookupError):
            for _ in range(100):
                os.kill(stopped[0], 0)
                threading.Event().wait(0.1)


class TestGarbage:
    @pytest.mark.parametrize(
        "made",
        [
            None,
            "done",
            {},
            Made("/etc/passwd", processor=1.0),
            Made("", processor=1.0),
            Made("x", refused="all"),
            Made(None, refused=[1]),
        ],
    )
    def test_what_is_no_answer_is_asked_for_again_and_named_in_the_end(self, tmp_path, sources, monkeypatch, made):
        monkeypatch.setattr(steps, "TRIES", 3)

        class Garbage(DyingExecutor):
            def submit(self, what, job):
                future = Future()
                future.set_result(made)
                return future

        with pytest.raises(InputError, match=r"nothing was learned.*12 sources were refused.*MismatchError: expected"):
            run(tmp_path / "m", [tmp_path / "in"], client=Garbage())

    def test_a_partial_of_other_sources_is_not_taken_for_the_jobs(self, tmp_path, sources, monkeypatch):
        monkeypatch.setattr(steps, "MOST_SOURCES", 6)

        class Mistaken(DyingExecutor):
            """Writes the partial of one job where the other's belongs, once."""

            done = 0

            def submit(self, what, job):
                future = super().submit(what, job)
                if what is partials.learn_partial:
                    self.done += 1
                    if self.done == 2:
                        first = next(Path(job.folder).glob("learned-*.part"))
                        job.target.write_bytes(first.read_bytes())
                return future

        done = run(tmp_path / "m", [tmp_path / "in"], client=Mistaken())
        assert done.observations == 12 and done.digest == expected().digest()


def renamed(path):
    """Write the partial in a file again, with another name for a touch, and right checksums."""
    settings = {name: SETTINGS[name] for name in ("sensor", "embedding", "exemplars")}
    making = Making(**settings, augmentation=None, recall=None, options=BY_FOLDER)
    draft = path.with_suffix(".draft")
    with Partial(path) as packed, write_partial(draft) as written:
        packed.read_with(making.memory().plan)
        sums = packed.sums()
        for head in packed.named:
            other = {"a": "b", "b": "c", "c": "a"}[head.label] if head.sequence == 1 else head.label
            written.touch(replace(head, label=other), packed.record(head.sequence).arrays)
        written.finish(packed.identity, making.memory().of_sums(sums.arrays, sums.attributes), None, packed.note)
    draft.replace(path)


class TestSpoilt:
    def test_a_partial_with_other_names_and_right_checksums_is_learned_again(self, tmp_path, sources, monkeypatch):
        monkeypatch.setattr(steps, "MOST_SOURCES", 4)
        merge = TactileLearner.merge
        monkeypatch.setattr(TactileLearner, "merge", lambda *_, **__: (_ for _ in ()).throw(StoreFullError("full")))
        with pytest.raises(StoreFullError):
            run(tmp_path / "m", [tmp_path / "in"])
        monkeypatch.setattr(TactileLearner, "merge", merge)
        path = min((tmp_path / "m.fleet").glob("learned-*.part"))
        renamed(path)
        learned = []
        learn_again = partials._learn
        monkeypatch.setattr(partials, "_learn", lambda job: learned.extend(job.sources) or learn_again(job))
        done = run(tmp_path / "m", [tmp_path / "in"])
        assert 0 < len(learned) < 12 and done.deaths == 0 and not done.refused
        require_learned(tmp_path / "m")

    @pytest.mark.parametrize("place", [None, -9, 100])
    def test_one_that_is_spoilt_while_the_run_goes_on_is_learned_again(self, tmp_path, sources, monkeypatch, place):
        monkeypatch.setattr(steps, "MOST_SOURCES", 3)

        class Spoiling(DyingExecutor):
            spoilt = 0

            def submit(self, what, job):
                future = super().submit(what, job)
                if what is partials.learn_partial:
                    self.spoilt += 1
                    if self.spoilt == 3:
                        if place is None:
                            renamed(job.target)
                        else:
                            whole = bytearray(job.target.read_bytes())
                            whole[place] ^= 1
                            job.target.write_bytes(bytes(whole))
                return future

        client = Spoiling()
        if place == 100:  # in a row, which is read last
            with pytest.raises(DamageError, match="call again: its sources are learned again"):
                run(tmp_path / "m", [tmp_path / "in"], client=client, fan=2)
        done = run(tmp_path / "m", [tmp_path / "in"], client=client, fan=2)
        assert done.observations == 12 and not done.refused and done.sources == 12
        require_learned(tmp_path / "m")

    def test_errors_of_workers_reach_who_waits_for_them(self):
        error = pickle.loads(pickle.dumps(DamageError("spoilt", path=Path("x"), sequence=3)))
        assert (str(error), error.path, error.sequence) == ("spoilt", Path("x"), 3)


class TestNotes:
    @pytest.mark.parametrize(
        ("text", "match"),
        [
            ("[" * 100_000, "cannot be read"),
            ('{"format": 1, "plan": 5, "notes": {}}', "its plan is a int"),
            ("[1, 2]", "cannot be read"),
            (None, "sources that a run learned"),
        ],
    )
    def test_notes_that_are_none(self, tmp_path, sources, text, match):
        run(tmp_path / "m", sources[:2])
        notes = tmp_path / "m.fleet" / "run.json"
        kept = json.loads(notes.read_text())
        for learned in (5, [5], {"a": 1}):
            kept["notes"]["learned"] = learned
            notes.write_text(json.dumps(kept) if text is None else text)
            with pytest.raises(InputError, match=match):
                run(tmp_path / "m", sources)

    @pytest.mark.parametrize("make", [os.mkdir, os.mkfifo])
    @pytest.mark.parametrize("name", ["learned-0.part", "run.json", "x.partial"])
    def test_what_is_no_file_is_named_before_anything_is_learned(self, tmp_path, sources, make, name):
        run(tmp_path / "m", sources[:2])
        place = tmp_path / "m.fleet" / name
        place.unlink(missing_ok=True)
        make(place)
        with pytest.raises(InputError, match="move it away"):
            run(tmp_path / "m", sources)

    def test_two_runs_for_one_destination(self, tmp_path, sources):
        class Second(DyingExecutor):
            def submit(self, what, job):
                with pytest.raises(LockedError, match=r"another run is at work for .*: wait until it has ended"):
                    run(tmp_path / "m", sources[:2])
                return super().submit(what, job)

        assert run(tmp_path / "m", sources, client=Second()).observations == 12
        assert run(tmp_path / "m", sources).observations == 0

    def test_one_that_began_as_another_removed_its_folder_is_alone_all_the_same(self, tmp_path, monkeypatch):
        folder, lock, removed = tmp_path / "m.fleet", runfile.flock, []

        def late(*words):
            if not removed:  # the other, which had it locked until now, is through
                folder.rmdir()
                removed.append(folder)
            return lock(*words)

        monkeypatch.setattr(runfile, "flock", late)
        with (
            runfile.alone_in(folder, tmp_path / "m"),
            pytest.raises(LockedError),
            runfile.alone_in(folder, tmp_path / "m"),
        ):
            pass
        assert removed and not folder.exists()


@pytest.mark.parametrize("error", [None, KeyError()])
def test_processes_are_waited_for_unless_an_error_ends_the_block_whatever_the_caller_handles(error):
    waits = []

    class Pool:
        def shutdown(self, *, wait, cancel_futures):
            waits.append(wait)

    try:
        raise ValueError("the caller's own")
    except ValueError:
        with suppress(KeyError), engines.Processes(1) as processes:
            processes._all.add(Pool())
            if error is not None:
                raise error from None
    assert waits == [error is None]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork server")
def test_a_fork_server_that_is_killed_is_begun_again(tmp_path, sources, monkeypatch):
    monkeypatch.setattr(steps, "MOST_SOURCES", 3)
    killed = []
    submit = engines.Processes.submit

    def killing(self, what, job):
        server = multiprocessing.forkserver._forkserver._forkserver_pid
        if server is not None and len(killed) < 2 and server not in killed:
            killed.append(server)
            with suppress(ProcessLookupError):
                os.kill(server, signal.SIGKILL)
        return submit(self, what, job)

    monkeypatch.setattr(engines.Processes, "submit", killing)
    done = learn(tmp_path / "m", [tmp_path / "in"], BY_FOLDER, workers=2, **SETTINGS)
    assert killed and done.observations == 12 and done.digest == expected().digest()


def test_what_a_partial_notes_of_itself_is_looked_at(tmp_path, sources):
    class Keeping(DyingExecutor):
        made = None

        def submit(self, what, job):
            future = super().submit(what, job)
            if what is partials.learn_partial and not self.made:
                type(self).made = job.making, job.target.read_bytes()
            return future

    run(tmp_path / "m", sources[:3], client=Keeping())
    making, content = Keeping.made
    path = tmp_path / "p.part"
    path.write_bytes(content)
    good = Contained.of(path, making, thorough=True)
    assert good.touches and good.sources
    empty = {"sources": [], "again": []}
    with Partial(path) as packed:
        noted = dict(packed.note)
    strange = [noted | {"clipped": 5}, noted | {"range_problem": 5}, noted | {"again": [["x", "x", "x", "00"]]}]
    strange.append(noted | {"again": [[good.sources[0], "x", "of no row", "00" * 32]]})
    for note in ({}, {"read": 5}, {"read": [[1, 2]]} | empty, {"read": []} | empty, *strange):
        with pytest.MonkeyPatch.context() as patch:
            read = Partial._read

            def other(self, note=note, read=read):
                read(self)
                self.note = note

            patch.setattr(Partial, "_read", other)
            with pytest.raises(ScrollTactileError, match="none of a fleet's run"):
                Contained.of(path, making)
