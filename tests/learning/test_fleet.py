"""Many workers, one memory: the bytes of one process that observed each touch once, whatever happened meanwhile."""

import os
import random
import shutil
import signal
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext, suppress

import numpy as np
import pytest
from scroll_tactile_store import StoreFullError
from touches import PAD, SETTINGS, fed, require_same, stream

from examples.benchmarks.fleet import DyingExecutor
from scroll_tactile import Kernels, TactileLearner
from scroll_tactile.clients.learning import fleet, steps
from scroll_tactile.clients.learning.fleet import learn
from scroll_tactile.clients.learning.learning import learn_sources
from scroll_tactile.clients.learning.sources import SourceOptions
from scroll_tactile.errors import InputError
from scroll_tactile.persistence.ledger import Ledger

BY_FOLDER = SourceOptions(by="folder")


def touch_files(folder, touches):
    """Recordings of one touch each, by the folder that names it; their paths."""
    paths = []
    for number, (name, touch) in enumerate(touches):
        path = folder / name / f"{number}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, stream(touch).astype(np.float32))
        paths.append(path)
    return paths


TOUCHES = [("abc"[i % 3], (i, 40 + 5 * (i // 3))) for i in range(12)]  # a content each


def memory_of(path, touches, pack=None, **how):
    """A memory in a folder that observed these touches as recordings hold them; pack: where it is packed as well."""
    with TactileLearner.open(path, **SETTINGS) as learner:
        for name, touch in touches:
            learner.observe(name, stream(touch).astype(np.float32))
        if pack is not None:
            learner.pack(pack, **how)
    return path


def expected(touches=TOUCHES, **settings):
    """What one learner holds that observed each touch once."""
    return fed(sorted(set(touches)), **settings)


def run(destination, sources, options=BY_FOLDER, client=None, **settings):
    return learn(destination, sources, options, client=client or DyingExecutor(), **SETTINGS | settings)


def require_learned(destination, touches=TOUCHES, **settings):
    """The memory is that of one process, to the byte, now and when its checkpoint is lost; each touch says its file."""
    with TactileLearner.open(destination) as learner:
        require_same(learner, set(touches), **settings)
        assert sum(learner.materials.values()) == len(set(touches))
    return learner


class TestSameBytes:
    def test_it_is_the_memory_of_one_process_with_the_source_of_every_touch(self, tmp_path):
        paths = touch_files(tmp_path / "in", TOUCHES)
        done = run(tmp_path / "m", [tmp_path / "in"])
        assert (done.sources, done.observations, done.repeated, done.refused) == (12, 12, 0, [])
        require_learned(tmp_path / "m")
        with TactileLearner.open(tmp_path / "m") as learner:
            assert {row.source for row in learner.observations()} == set(map(str, paths))
            assert {row.state for row in learner.observations()} == {"kept"}
            assert done.digest == learner.digest() and done.held == 12

    @pytest.mark.parametrize("seed", range(6))
    def test_random_workers_ends_and_duplicates_change_no_byte(self, tmp_path, seed, monkeypatch):
        draw = random.Random(seed)
        touches = [draw.choice(TOUCHES) for _ in range(draw.randrange(1, 20))]
        touch_files(tmp_path / "in", touches)
        monkeypatch.setattr(steps, "MOST_SOURCES", draw.randrange(1, 6))
        monkeypatch.setattr(steps, "MOST_TRIES", 50)
        ends = DyingExecutor(draw.choice([0.0, 0.3, 0.6]), seed)
        done = run(tmp_path / "m", [tmp_path / "in"], client=ends)
        assert done.observations == len(set(touches)) and not done.refused
        assert done.digest == expected(touches).digest()
        with TactileLearner.open(tmp_path / "m") as learner:
            assert learner.exemplars == expected(touches).exemplars

    def test_an_embedding_that_is_not_exact_keeps_its_codes_and_a_memory_without_readings_none(self, tmp_path):
        touch_files(tmp_path / "in", TOUCHES + TOUCHES[:3])
        for name, settings in {"codes": {"exemplars": 0, "kept_touches": 0}, "kept": {"exemplars": 0}}.items():
            done = run(tmp_path / name, [tmp_path / "in"], **settings)
            assert done.observations == 12
            require_learned(tmp_path / name, **settings)

    def test_memories_are_sources_too_in_folders_and_packed_with_rows_or_without(self, tmp_path):
        touch_files(tmp_path / "in", TOUCHES[:4])
        for name, part, rows in (
            ("folder", TOUCHES[2:6], True),
            ("rows", TOUCHES[5:9], True),
            ("sums", TOUCHES[9:], False),
        ):
            memory_of(tmp_path / f"{name}.memory", part, tmp_path / name, rows=rows)
        sources = [tmp_path / "in", tmp_path / "folder.memory", tmp_path / "rows", tmp_path / "sums"]
        done = run(tmp_path / "m", sources)
        assert done.refused == [] and done.repeated == 3
        require_learned(tmp_path / "m")
        with TactileLearner.open(tmp_path / "m") as learner:
            said = [row.source for row in learner.observations()]
            assert str(tmp_path / "folder.memory") in said

    def test_memories_without_rows_come_in_whole_and_one_that_shares_a_touch_is_refused(self, tmp_path):
        for name, part in {"x": TOUCHES[:4], "y": TOUCHES[4:9], "z": TOUCHES[8:], "w": TOUCHES[9:]}.items():
            memory_of(tmp_path / f"{name}.memory", part, tmp_path / name, rows=False)
        done = run(tmp_path / "m", [tmp_path / name for name in "xyzw"])
        assert [each.source for each in done.refused] == [str(tmp_path / "z")]
        assert "cannot be left out" in done.refused[0].why
        require_learned(tmp_path / "m")


@pytest.fixture
def full(monkeypatch):
    """A disk that is full when so many steps were merged, until it is asked for 0."""
    merge, merged = Ledger.merge, []

    def after(count):
        def merging(self, other, *words, **named):
            if len(merged) >= count:
                raise StoreFullError("full")
            merged.append(other)
            return merge(self, other, *words, **named)

        monkeypatch.setattr(Ledger, "merge", merge if count is None else merging)

    return after


@pytest.fixture
def jobs_here(monkeypatch):
    """Jobs that an executor runs in this process do not end it where they take longer than a run has patience."""
    monkeypatch.setattr(steps, "_within", lambda patience: nullcontext())


@pytest.fixture
def learned(monkeypatch):
    """The sources of all jobs that were begun."""
    begun = []

    def learning(learner, sources, *words, **named):
        begun.extend(sources)
        return learn_sources(learner, sources, *words, **named)

    monkeypatch.setattr(steps, "learn_sources", learning)
    return begun


class TestGoingOn:
    def test_a_run_that_was_killed_goes_on_where_it_was(self, tmp_path, monkeypatch, learned):
        touch_files(tmp_path / "in", TOUCHES)
        monkeypatch.setattr(steps, "MOST_SOURCES", 1)

        class Killed(DyingExecutor):
            def __init__(self):
                super().__init__()
                self._max_workers, self.jobs = 1, 0

            def submit(self, what, *words):
                self.jobs += 1
                if self.jobs > 6:  # four are handed over before the first is merged
                    raise KeyboardInterrupt
                return super().submit(what, *words)

        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "m", [tmp_path / "in"], client=Killed())
        before = len(learned)
        with TactileLearner.open(tmp_path / "m") as learner:  # what was merged is durable
            assert 0 < len(learner.observations()) <= before
        done = run(tmp_path / "m", [tmp_path / "in"])
        assert 0 < before < 12 == len(learned) == len(set(learned))
        assert done.sources == 12 and done.repeated == 0
        require_learned(tmp_path / "m")
        assert [path.name for path in (tmp_path / "m.fleet").iterdir()] == ["run.json"]

    @pytest.mark.parametrize("place", [100, -9000, -9, None])
    def test_a_packed_memory_that_was_damaged_meanwhile_is_learned_again(self, tmp_path, full, learned, place):
        touch_files(tmp_path / "in", TOUCHES)
        full(0)
        with pytest.raises(StoreFullError):
            run(tmp_path / "m", [tmp_path / "in"])
        full(None)
        path = min((tmp_path / "m.fleet").glob("learned-*.part"))
        whole = bytearray(path.read_bytes())
        if place is not None:
            whole[place] ^= 1
        path.write_bytes(bytes(whole if place is not None else whole[:-30]))
        learned.clear()
        done = run(tmp_path / "m", [tmp_path / "in"])
        assert done.observations == 12 and done.deaths == 0 and 0 < len(learned) < 12
        require_learned(tmp_path / "m")

    @pytest.mark.parametrize("merged", range(4))
    def test_a_full_disk_at_any_merge_costs_nothing(self, tmp_path, full, merged):
        touch_files(tmp_path / "in", TOUCHES + [("z", touch) for _, touch in TOUCHES[:2]])
        full(merged)
        with pytest.raises(StoreFullError):
            run(tmp_path / "m", [tmp_path / "in"])
        full(None)
        done = run(tmp_path / "m", [tmp_path / "in"])
        assert done.held == 12 and len(done.refused) == 2
        require_learned(tmp_path / "m")

    def test_what_could_not_be_read_is_said_by_the_run_that_goes_on(self, tmp_path, full):
        paths = touch_files(tmp_path / "in", TOUCHES[:4])
        paths[0].write_bytes(b"")
        full(0)
        with pytest.raises(StoreFullError):
            run(tmp_path / "m", [tmp_path / "in"], client=DyingExecutor(seed=1))
        full(None)
        done = run(tmp_path / "m", [tmp_path / "in"], client=DyingExecutor(seed=1))
        assert [each.source for each in done.refused] == [str(paths[0])] and done.observations == 3

    def test_a_memory_that_was_removed_is_learned_anew(self, tmp_path):
        touch_files(tmp_path / "in", TOUCHES)
        run(tmp_path / "m", [tmp_path / "in"])
        shutil.rmtree(tmp_path / "m")
        assert run(tmp_path / "m", [tmp_path / "in"]).observations == 12
        require_learned(tmp_path / "m")

    @pytest.mark.parametrize("workers", [1, 2])
    def test_a_run_that_was_cut_short_replays_little(self, tmp_path, monkeypatch, workers):
        monkeypatch.setattr(fleet, "SAVED_EVERY", 4)
        monkeypatch.setattr(steps, "MOST_SOURCES", 2)
        paths = touch_files(tmp_path / "in", TOUCHES)

        def cut(what, done, of):
            if done >= 8:
                raise KeyboardInterrupt

        client = None if workers == 1 else DyingExecutor()
        with pytest.raises(KeyboardInterrupt):
            learn(tmp_path / "m", paths, BY_FOLDER, workers=workers, client=client, progress=cut, **SETTINGS)
        with TactileLearner.open(tmp_path / "m", mode="read") as learner:
            assert learner.memory.saved >= 4 and 6 <= learner.memory.sequence < 12
        assert run(tmp_path / "m", paths).held == 12
        require_learned(tmp_path / "m")

    def test_more_sources_go_into_the_memory_of_an_earlier_run_and_nothing_twice(self, tmp_path):
        touch_files(tmp_path / "one", TOUCHES[:7])
        touch_files(tmp_path / "two", TOUCHES[5:])
        run(tmp_path / "m", [tmp_path / "one"])
        done = run(tmp_path / "m", [tmp_path / "one", tmp_path / "two", tmp_path / "two"])
        assert (done.observations, done.repeated, done.sources) == (5, 2, 14)
        require_learned(tmp_path / "m")

    def test_a_destination_that_was_made_from_others_is_refused_unless_it_is_added_to(self, tmp_path):
        touch_files(tmp_path / "in", TOUCHES[3:])
        memory_of(tmp_path / "m", TOUCHES[:5])
        with pytest.raises(InputError, match="not by a run of this kind"):
            run(tmp_path / "m", [tmp_path / "in"])
        done = run(tmp_path / "m", [tmp_path / "in"], add=True)
        assert (done.observations, done.repeated) == (7, 2)
        require_learned(tmp_path / "m")


class TestForgetting:
    def test_a_robots_day_is_taken_back_as_if_it_had_never_been(self, tmp_path):
        touch_files(tmp_path / "robot 1", TOUCHES[:6])
        touch_files(tmp_path / "robot 10", TOUCHES[6:])
        run(tmp_path / "m", [tmp_path / "robot 1", tmp_path / "robot 10"])
        with TactileLearner.open(tmp_path / "m") as learner:
            with pytest.raises(KeyError, match="comes from"):
                learner.forget(source=str(tmp_path / "robot"))
            assert learner.forget(source=str(tmp_path / "robot 1")) == 6
        require_learned(tmp_path / "m", TOUCHES[6:])

    def test_what_was_compacted_cannot_be_forgotten_and_neither_or_both_is_no_question(self, tmp_path):
        with TactileLearner.open(tmp_path / "r", **SETTINGS) as robot:
            robot.observe("a", stream((0, 60)), source="s3://day/1.npy")
            robot.pack(tmp_path / "p", rows=False)
        with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
            learner.merge(tmp_path / "p")
            with pytest.raises(KeyError, match="were compacted"):
                learner.forget(source="s3://day")
            for words in ({}, {"material": "a", "source": "x"}):
                with pytest.raises(InputError, match="a material, or a source"):
                    learner.forget(**words)
            assert learner.digest() == fed([("a", (0, 60))]).digest()


class TestWhatCannotBeLearned:
    def test_half_of_the_sources_are_unreadable_and_learned_once_they_can_be_read(self, tmp_path):
        paths = touch_files(tmp_path / "in", TOUCHES)
        for path in paths[::2]:
            path.write_bytes(path.read_bytes()[:90])
        done = run(tmp_path / "m", [tmp_path / "in", tmp_path / "gone"])
        assert {each.source for each in done.refused} == {*map(str, paths[::2]), str(tmp_path / "gone")}
        assert done.observations == 6
        require_learned(tmp_path / "m", TOUCHES[1::2])
        touch_files(tmp_path / "in", TOUCHES)
        assert run(tmp_path / "m", [tmp_path / "in"]).observations == 6
        require_learned(tmp_path / "m")

    def test_nothing_at_all_makes_no_memory(self, tmp_path):
        (tmp_path / "in").mkdir()
        with pytest.raises(InputError, match="nothing was learned, and no memory made: 1 sources were refused"):
            run(tmp_path / "m", [tmp_path / "in"])
        assert not (tmp_path / "m").exists()

    @pytest.mark.parametrize("workers", [1, 2])
    def test_nor_does_a_memory_that_is_refused(self, tmp_path, workers):
        other = PAD.model_copy(update={"name": "other pad"})
        with TactileLearner.open(tmp_path / "other", **SETTINGS | {"sensor": other}) as learner:
            learner.observe("a", stream((9, 60)))
        client = None if workers == 1 else DyingExecutor()
        with pytest.raises(InputError, match="no memory made: 1 sources were refused"):
            learn(tmp_path / "m", [tmp_path / "other"], BY_FOLDER, workers=workers, client=client, **SETTINGS)
        assert not (tmp_path / "m").exists()

    def test_a_source_that_ends_every_worker_is_named_and_the_others_are_learned(self, tmp_path, monkeypatch):
        paths = touch_files(tmp_path / "in", TOUCHES)

        class Poisoned(DyingExecutor):
            def submit(self, what, job):
                if str(paths[4]) in getattr(job, "sources", ()):
                    future = Future()
                    future.set_exception(BrokenProcessPool("died"))
                    return future
                return super().submit(what, job)

        done = run(tmp_path / "m", [tmp_path / "in"], client=Poisoned())
        assert [each.source for each in done.refused] == [str(paths[4])]
        assert "workers ended while they learned it" in done.refused[0].why
        require_learned(tmp_path / "m", TOUCHES[:4] + TOUCHES[5:])

    def test_memories_of_another_sensor_or_embedding_are_refused_by_name(self, tmp_path):
        touch_files(tmp_path / "in", TOUCHES)
        other = PAD.model_copy(update={"name": "other pad", "rate": 60.0})
        for name, settings in {"s": {"sensor": other}, "e": {"embedding": Kernels(seed=1, dimension=64)}}.items():
            with TactileLearner.open(tmp_path / name, **SETTINGS | settings) as learner:
                learner.observe("a", stream((9, 60)))
                learner.pack(tmp_path / f"{name}.part")
        wrong = [tmp_path / name for name in ("s", "e", "s.part", "e.part")]
        done = run(tmp_path / "m", [tmp_path / "in", *wrong])
        assert {each.source for each in done.refused} == set(map(str, wrong))
        assert all("other pad" in each.why or "embedding" in each.why for each in done.refused)
        require_learned(tmp_path / "m")

    def test_descriptions_that_differ_are_refused_or_chosen_by_the_rule_of_merge(self, tmp_path):
        for name, share in (("x", 1.0), ("y", 0.5)):
            with TactileLearner.open(tmp_path / name, **SETTINGS) as learner:
                learner.observe("a", stream((ord(name), 60)))
                learner.describe("a", {"cotton": share, "wool": 1 - share})
        done = run(tmp_path / "m", [tmp_path / "x", tmp_path / "y"])
        assert [each.source for each in done.refused] == [str(tmp_path / "y")]
        assert "Choose with descriptions='ours' or 'theirs'" in done.refused[0].why
        assert run(tmp_path / "m", [tmp_path / "x", tmp_path / "y"], descriptions="theirs").observations == 1
        with TactileLearner.open(tmp_path / "m") as learner:
            assert learner.descriptions["a"]["cotton"] == 0.5

    @pytest.mark.parametrize("wrong", [0, -1, True, 1.5, "2"])
    def test_workers_that_are_no_number(self, tmp_path, wrong):
        with pytest.raises(InputError, match="workers as a whole number"):
            learn(tmp_path / "m", [tmp_path], sensor=PAD, workers=wrong)


class TestProcesses:
    def test_workers_that_are_killed_again_and_again_change_nothing(self, tmp_path, monkeypatch):
        touch_files(tmp_path / "in", TOUCHES)
        monkeypatch.setattr(steps, "MOST_TRIES", 50)
        killed = []

        def kill(what, done, of):
            if len(killed) < 3:
                workers = [process for pool in running[0]._all for process in pool._processes.values()]
                if workers:
                    killed.append(workers[0].pid)
                    with suppress(ProcessLookupError):  # it has ended meanwhile
                        os.kill(workers[0].pid, signal.SIGKILL)

        running = []
        made = fleet.Processes.__init__
        monkeypatch.setattr(fleet.Processes, "__init__", lambda self, n: running.append(self) or made(self, n))
        done = learn(tmp_path / "m", [tmp_path / "in"], BY_FOLDER, workers=2, progress=kill, **SETTINGS)
        assert len(killed) == 3 and done.observations == 12
        require_learned(tmp_path / "m")

    def test_a_job_that_takes_too_long_is_given_up(self, tmp_path, monkeypatch):
        monkeypatch.setattr(steps, "MOST_TRIES", 1)
        touch_files(tmp_path / "in", TOUCHES[:2])
        os.mkfifo(tmp_path / "in" / "a" / "stuck.csv")  # nobody ever writes it
        done = learn(tmp_path / "m", [tmp_path / "in"], BY_FOLDER, workers=1, patience=12.0, **SETTINGS)
        assert [each.source for each in done.refused] == [str(tmp_path / "in" / "a" / "stuck.csv")]
        assert done.observations == 2
