"""Many workers, one memory: the bytes of one process that observed each touch once, whatever happened meanwhile."""

import json
import multiprocessing
import os
import random
import shutil
import signal
import time
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing.connection import wait

import numpy as np
import pytest
from commands import run as command
from scroll_tactile_store import LockedError, StoreFullError
from touches import PAD, SETTINGS, SmallSample, fed, require_same, stream

import scroll_tactile.memory.state
from examples.benchmarks.fleet import DyingExecutor
from scroll_tactile import Kernels, TactileLearner
from scroll_tactile.clients.learning import fleet
from scroll_tactile.clients.learning.fleet import Processes, learn
from scroll_tactile.clients.learning.learning import learn_sources
from scroll_tactile.clients.learning.sources import SourceOptions, find_sources
from scroll_tactile.errors import InputError, RangeWarning, ScrollTactileError
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
# Of the first touches twelve come once more, half of them under another name.
TWICE = [*TOUCHES, *((name, touch) for name, touch in TOUCHES[:6]), *(("z", touch) for _, touch in TOUCHES[3:9])]


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


def run(destination, sources, executor=None, **settings):
    how = {"executor": executor or DyingExecutor(), "workers": 2}
    return learn(sources, destination, BY_FOLDER, **SETTINGS | how | settings)


def require_learned(destination, touches=TOUCHES, **settings):
    """The memory is that of one process, to the byte, now and when its checkpoint is lost; each touch says its file."""
    with TactileLearner.open(destination) as learner:
        require_same(learner, set(touches), **settings)
        assert sum(learner.materials.values()) == len(set(touches))
    return learner


def seen(learner):
    rows = [row for row in learner.observations() if row.state != "retracted"]
    return [(row.material, row.key, row.source) for row in rows]


def by_one_process(path, sources):
    """What `learn_sources` makes of sources: rows in order, digest, what was skipped and what was refused."""
    with TactileLearner.open(path, **SETTINGS) as learner:
        done = learn_sources(learner, find_sources(list(map(str, sources)))[0], BY_FOLDER)
        refused = [(each.source, each.why) for each in done.refused]
        return seen(learner), learner.digest(), done.skipped, refused


@pytest.fixture
def sources(tmp_path):
    return touch_files(tmp_path / "in", TOUCHES)


@pytest.fixture
def full(monkeypatch):
    """A disk that is full when so many shares were merged; None: never more."""
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
def learned(monkeypatch):
    """The sources of all shares that a worker began."""
    begun = []

    def learning(learner, sources, *words, **named):
        begun.extend(sources)
        return learn_sources(learner, sources, *words, **named)

    monkeypatch.setattr(fleet, "learn_sources", learning)
    return begun


class Then(DyingExecutor):
    """Does something with each share when its worker is done, and its number."""

    def __init__(self, then):
        super().__init__()
        self.then, self.done = then, 0

    def submit(self, what, share):
        future = super().submit(what, share)
        self.done += 1
        self.then(share, self.done)
        return future


class TestSameBytes:
    def test_it_is_the_memory_of_one_process_with_the_source_of_every_touch(self, tmp_path, sources):
        done = run(tmp_path / "m", [tmp_path / "in"])
        assert (done.sources, done.observations, done.repeated, done.refused) == (12, 12, 0, [])
        assert done.learned == {"a": 4, "b": 4, "c": 4}
        require_learned(tmp_path / "m")
        with TactileLearner.open(tmp_path / "m") as learner:
            assert {row.source for row in learner.observations()} == set(map(str, sources))
            assert {row.state for row in learner.observations()} == {"kept"}
            assert done.digest == learner.digest() and done.held == 12
        assert not (tmp_path / "m.fleet").exists()

    @pytest.mark.parametrize("seed", range(6))
    def test_random_workers_deaths_duplicates_and_names_change_no_byte(self, tmp_path, seed, monkeypatch):
        monkeypatch.setattr(scroll_tactile.memory.state, "TouchSample", SmallSample)
        draw = random.Random(seed)
        paths = touch_files(tmp_path / "in", draw.sample(TWICE, draw.randrange(1, len(TWICE) + 1)))
        draw.shuffle(paths)
        monkeypatch.setattr(fleet, "MOST_SOURCES", draw.randrange(1, 6))
        executor = DyingExecutor(draw.choice([0.0, 0.3, 0.6]), seed)
        by = {"workers": 1} if seed == 5 else {"executor": executor, "workers": 1}
        done = learn(paths, tmp_path / "m", BY_FOLDER, **by, **SETTINGS)
        rows, digest, skipped, refused = by_one_process(tmp_path / "one", paths)
        assert done.digest == digest and done.repeated == skipped
        assert [(each.source, each.why) for each in done.refused] == refused
        with TactileLearner.open(tmp_path / "m") as learner, TactileLearner.open(tmp_path / "one") as one:
            assert seen(learner) == rows
            held = [(name, key, t.rows.tobytes()) for name, key, t in learner.memory.sample]
            assert held == [(name, key, t.rows.tobytes()) for name, key, t in one.memory.sample]
            assert learner.exemplars == one.exemplars

    def test_processes_learn_the_same_bytes_also_where_one_is_killed(self, tmp_path):
        paths = touch_files(tmp_path / "in", TWICE)
        killed = []

        def kill(what, done, of):
            if done and not killed and (workers := multiprocessing.active_children()):
                killed.append(workers[0].pid)
                with suppress(ProcessLookupError):  # it has ended meanwhile
                    os.kill(workers[0].pid, signal.SIGKILL)

        done = learn(paths, tmp_path / "m", BY_FOLDER, workers=2, progress=kill, **SETTINGS)
        rows, digest, skipped, _ = by_one_process(tmp_path / "one", paths)
        assert killed and (done.digest, done.repeated, len(done.refused)) == (digest, skipped, 6)
        with TactileLearner.open(tmp_path / "m") as learner:
            assert seen(learner) == rows

    def test_an_embedding_that_is_not_exact_keeps_its_codes_and_a_memory_without_readings_none(self, tmp_path):
        touch_files(tmp_path / "in", TOUCHES + TOUCHES[:3])
        for name, settings in {"codes": {"exemplars": 0, "kept_touches": 0}, "kept": {"exemplars": 0}}.items():
            done = run(tmp_path / name, [tmp_path / "in"], **settings)
            assert done.observations == 12
            require_learned(tmp_path / name, **settings)

    @pytest.mark.parametrize("executor", [None, DyingExecutor()])
    def test_memories_are_sources_too_in_folders_and_packed_with_rows_or_without(self, tmp_path, executor):
        touch_files(tmp_path / "in", TOUCHES[:4])
        for name, part, rows in (
            ("folder", TOUCHES[2:6], True),
            ("rows", TOUCHES[5:9], True),
            ("sums", TOUCHES[9:], False),
        ):
            memory_of(tmp_path / f"{name}.memory", part, tmp_path / name, rows=rows)
        sources = [tmp_path / "in", tmp_path / "folder.memory", tmp_path / "rows", tmp_path / "sums"]
        done = learn(sources, tmp_path / "m", BY_FOLDER, workers=1, executor=executor, **SETTINGS)
        assert done.refused == [] and done.repeated == 3
        require_learned(tmp_path / "m")
        with TactileLearner.open(tmp_path / "m") as learner:
            said = [row.source for row in learner.observations()]
            assert str(tmp_path / "folder.memory") in said


class TestNames:
    def test_a_memory_that_has_it_under_another_name_comes_first(self, tmp_path, sources):
        before = [("x", TOUCHES[4][1]), TOUCHES[5]]
        memory_of(tmp_path / "m", before)
        for came in (10, 0):  # and says so again
            done = run(tmp_path / "m", [tmp_path / "in"])
            (refused,) = done.refused
            assert refused.source == str(sources[4]) and "as 'x' and not as 'b'" in refused.why
            assert (done.observations, done.repeated) == (came, 11 - came)
        with TactileLearner.open(tmp_path / "m") as learner:
            require_same(learner, [pair for pair in TOUCHES if pair != TOUCHES[4]] + before[:1])
            (row,) = (row for row in learner.observations() if row.material == "x")
            learner.relabel(row.sequence, "b")
        assert run(tmp_path / "m", [tmp_path / "in"]).refused == []

    def test_memories_are_refused_touch_by_touch_where_they_have_rows_and_whole_where_not(self, tmp_path):
        touch_files(tmp_path / "in", TOUCHES[:4])
        for name, rows in (("rows", True), ("sums", False)):
            with TactileLearner.open(tmp_path / f"{name}.memory", **SETTINGS) as learner:
                learner.observe("z", stream(TOUCHES[3][1]).astype(np.float32), source="robot 7")
                learner.observe("z", stream((90 + rows, 60)).astype(np.float32))
                learner.pack(tmp_path / name, rows=rows)
        for _ in range(2):  # and says so again
            done = run(tmp_path / "m", [tmp_path / "in", tmp_path / "rows", tmp_path / "sums"])
            assert [each.source for each in done.refused] == ["robot 7", str(tmp_path / "sums")]
        assert all("as 'a' and not as 'z'" in each.why for each in done.refused)
        assert "cannot be left out" in done.refused[1].why
        with TactileLearner.open(tmp_path / "m") as learner:
            assert learner.materials == {"a": 2, "b": 1, "c": 1, "z": 1}


class TestGoingOn:
    def test_a_run_that_was_killed_goes_on_and_learns_nothing_that_is_complete_again(self, tmp_path, sources, learned):
        class Killed(DyingExecutor):
            def submit(self, what, share):
                if len(learned) >= 6:
                    raise KeyboardInterrupt
                return super().submit(what, share)

        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "m", [tmp_path / "in"], Killed(), workers=3)
        assert len(learned) == 6
        left = tmp_path / "m.fleet" / "share-0.x.partial"  # of a worker that died
        (left / "whole").mkdir(parents=True)
        (tmp_path / "m.fleet" / "mine.txt").write_text("any")
        (tmp_path / "m.fleet" / "share-known.json").unlink()
        (tmp_path / "m.fleet" / "share-known.json").symlink_to("mine.txt")  # a link is not followed
        done = run(tmp_path / "m", [tmp_path / "in"], workers=3)
        assert len(learned) == len(set(learned)) == 12 == done.sources and done.repeated == 0
        require_learned(tmp_path / "m")
        assert [path.read_text() for path in (tmp_path / "m.fleet").iterdir()] == ["any"]

    @pytest.mark.parametrize("merged", range(4))
    def test_a_full_disk_at_any_merge_costs_nothing(self, tmp_path, full, learned, merged):
        paths = touch_files(tmp_path / "in", TOUCHES + [("z", touch) for _, touch in TOUCHES[:2]])
        paths[-1].write_bytes(b"")
        full(merged)
        with pytest.raises(StoreFullError):
            run(tmp_path / "m", [tmp_path / "in"])
        full(None)
        assert (tmp_path / "m").exists() == (merged > 0) and len(learned) == 14
        done = run(tmp_path / "m", [tmp_path / "in"])
        assert done.held == 12 and [each.source for each in done.refused] == list(map(str, paths[:-3:-1]))[::-1]
        assert len(learned) == 14  # what could not be read is said by the run that goes on, which reads nothing again
        require_learned(tmp_path / "m")

    @pytest.mark.parametrize("place", [100, -9, None])
    def test_a_folder_that_was_damaged_meanwhile_is_learned_again(self, tmp_path, sources, full, learned, place):
        full(0)
        with pytest.raises(StoreFullError):
            run(tmp_path / "m", [tmp_path / "in"])
        full(None)
        path = min((tmp_path / "m.fleet").glob("share-*/memory/log-*"))
        whole = bytearray(path.read_bytes())
        if place is not None:
            whole[place] ^= 1
        path.write_bytes(bytes(whole if place is not None else whole[:-30]))
        learned.clear()
        done = run(tmp_path / "m", [tmp_path / "in"])
        assert done.observations == 12 and not done.refused and 0 < len(learned) < 12
        require_learned(tmp_path / "m")

    def test_one_that_is_spoilt_again_and_again_is_named(self, tmp_path, sources):
        def spoil(share, number):
            if str(sources[4]) in share.sources:
                log = next(share.memory.glob("log-*"))
                log.write_bytes(log.read_bytes()[:-30] + bytes(30))

        done = run(tmp_path / "m", [tmp_path / "in"], Then(spoil))
        (refused,) = done.refused
        assert refused.source == str(sources[4]) and "ended twice before it was learned" in refused.why
        require_learned(tmp_path / "m", TOUCHES[:4] + TOUCHES[5:])

    def test_a_memory_that_was_removed_is_learned_anew(self, tmp_path, sources, full, learned):
        for _ in range(2):
            assert run(tmp_path / "m", [tmp_path / "in"]).observations == 12
            shutil.rmtree(tmp_path / "m")
        memory_of(tmp_path / "m", TOUCHES[:3])
        full(1)
        with pytest.raises(StoreFullError):  # shares are complete that left out what the memory had
            run(tmp_path / "m", [tmp_path / "in"])
        full(None)
        shutil.rmtree(tmp_path / "m")
        assert run(tmp_path / "m", [tmp_path / "in"]).observations == 12
        require_learned(tmp_path / "m")

    def test_sources_in_another_order_after_a_cut_are_learned_as_one_process_does(self, tmp_path, full):
        paths = touch_files(tmp_path / "in", TWICE)
        full(0)
        for some in (paths[3:14:2], paths[::-1]):
            with pytest.raises(StoreFullError):
                run(tmp_path / "m", some)
        full(None)
        done = run(tmp_path / "m", paths)
        rows, digest, skipped, refused = by_one_process(tmp_path / "one", paths)
        assert (done.digest, done.repeated, len(done.refused)) == (digest, skipped, len(refused))
        with TactileLearner.open(tmp_path / "m") as learner:
            assert seen(learner) == rows

    def test_more_sources_go_into_the_same_memory_and_nothing_twice(self, tmp_path):
        touch_files(tmp_path / "one", TOUCHES[:7])
        touch_files(tmp_path / "two", TOUCHES[5:])
        run(tmp_path / "m", [tmp_path / "one"])
        done = run(tmp_path / "m", [tmp_path / "one", tmp_path / "two", tmp_path / "two"])
        assert (done.observations, done.repeated, done.sources) == (5, 9, 14)
        require_learned(tmp_path / "m")

    def test_two_runs_for_one_memory(self, tmp_path, sources):
        def second(share, number):
            with pytest.raises(LockedError):
                run(tmp_path / "m", sources[:2])

        assert run(tmp_path / "m", sources, Then(second)).observations == 12

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
    def test_half_of_the_sources_are_unreadable_and_learned_once_they_can_be_read(self, tmp_path, sources):
        for path in sources[::2]:
            path.write_bytes(path.read_bytes()[:90])
        done = run(tmp_path / "m", [tmp_path / "in", tmp_path / "gone"])
        assert {each.source for each in done.refused} == {*map(str, sources[::2]), str(tmp_path / "gone")}
        assert done.observations == 6
        require_learned(tmp_path / "m", TOUCHES[1::2])
        touch_files(tmp_path / "in", TOUCHES)
        assert run(tmp_path / "m", [tmp_path / "in"]).observations == 6
        require_learned(tmp_path / "m")

    @pytest.mark.parametrize("workers", [1, 2])
    def test_nothing_at_all_makes_no_memory(self, tmp_path, workers):
        (tmp_path / "in").mkdir()
        with TactileLearner.open(
            tmp_path / "other", **SETTINGS | {"sensor": PAD.model_copy(update={"name": "x"})}
        ) as o:
            o.observe("a", stream((9, 60)))
        executor = None if workers == 1 else DyingExecutor()
        sources = [tmp_path / "in", tmp_path / "other"]
        done = learn(sources, tmp_path / "m", BY_FOLDER, workers=workers, executor=executor, **SETTINGS)
        assert [each.source for each in done.refused] == list(map(str, sources))
        assert (done.observations, done.held, done.digest) == (0, 0, "")
        assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "other"]

    @pytest.mark.parametrize("alone", [False, True])
    def test_a_source_that_ends_every_worker_is_named_and_the_others_are_learned(self, tmp_path, sources, alone):
        class Poisoned(DyingExecutor):
            def submit(self, what, share):
                if str(sources[4]) not in share.sources:
                    return super().submit(what, share)
                future = Future()
                future.set_exception(BrokenProcessPool("died"))
                return future

        done = run(tmp_path / "m", [tmp_path / "in"], Poisoned(), workers=12 if alone else 1)
        assert [each.source for each in done.refused] == [str(sources[4])] and done.deaths == 2
        assert "its worker ended twice" in done.refused[0].why and "died" in done.refused[0].why
        require_learned(tmp_path / "m", TOUCHES[:4] + TOUCHES[5:])

    @pytest.mark.parametrize("answer", [None, "done"])
    def test_an_answer_without_a_folder_is_none(self, tmp_path, sources, answer):
        class Elsewhere(Executor):
            def submit(self, what, share):
                future = Future()
                future.set_result(answer)
                return future

        done = run(tmp_path / "m", sources[:2], Elsewhere())
        assert len(done.refused) == 2 and all("is not there, or not complete" in each.why for each in done.refused)

    def test_an_executor_that_takes_no_work_any_more_is_named_and_the_same_call_goes_on(self, tmp_path, sources):
        class Broken(DyingExecutor):
            def submit(self, what, share):
                if str(sources[-1]) in share.sources:
                    raise BrokenProcessPool("a process died")
                return super().submit(what, share)

        with pytest.raises(ScrollTactileError, match="Broken takes no work any more: a process died"):
            run(tmp_path / "m", [tmp_path / "in"], Broken())
        assert run(tmp_path / "m", [tmp_path / "in"]).observations == 12
        require_learned(tmp_path / "m")

    def test_memories_of_another_sensor_or_embedding_are_refused_by_name(self, tmp_path, sources):
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

    def test_memories_without_rows_come_in_whole_and_one_that_shares_a_touch_is_refused(self, tmp_path):
        for name, part in {"x": TOUCHES[:4], "y": TOUCHES[4:9], "z": TOUCHES[8:], "w": TOUCHES[9:]}.items():
            memory_of(tmp_path / f"{name}.memory", part, tmp_path / name, rows=False)
        done = run(tmp_path / "m", [tmp_path / name for name in "xyzw"])
        assert [each.source for each in done.refused] == [str(tmp_path / "z")]
        assert "cannot be left out" in done.refused[0].why
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

    @pytest.mark.parametrize(
        ("given", "match"),
        [
            *(({"workers": wrong}, "workers as a whole number") for wrong in (0, -1, True, 1.5, "2")),
            ({"executor": "tcp://127.0.0.1:1"}, "expected an Executor, such as client.get_executor.*; came str"),
            ({"sources": "in"}, "expected a list of sources, then the folder of the memory; came 'in'"),
            ({"sensor": None}, "a new memory takes a sensor"),
        ],
    )
    def test_what_does_not_fit_together(self, tmp_path, given, match):
        with pytest.raises(InputError, match=match):
            learn(**{"sources": [tmp_path], "memory": tmp_path / "m", "sensor": PAD} | given)
        assert not (tmp_path / "m").exists()


@pytest.fixture
def beyond(tmp_path):
    """A folder of six different touches, all of their values above the pad's range."""
    for number, name in enumerate("abcabc"):
        path = tmp_path / "in" / name / f"{number}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.random.default_rng(number).uniform(5, 9, (60, 2)).astype(np.float32))
    return tmp_path / "in"


class TestRange:
    def test_it_says_and_refuses_what_one_process_does(self, tmp_path, beyond):
        with pytest.warns(RangeWarning) as first:
            _, _, _, refused = by_one_process(tmp_path / "one", [beyond])
        with pytest.warns(RangeWarning, match="100 % of the values lie outside the range of sensor 'pad'") as met:
            done = run(tmp_path / "m", [beyond], workers=3)  # a share of each source
        assert [str(each.message) for each in met] == list(map(str, done.facts))
        assert [str(each.message) for each in first] == [each.sentence for each in done.facts]
        assert met[0].filename == run.__code__.co_filename
        assert [(each.source, each.why) for each in done.refused] == refused
        assert (done.observations, done.repeated, len(done.refused)) == (1, 1, 4)
        for each in done.refused:
            assert "all its values lie outside the sensor's range" in each.why and "relabel" not in each.why
            assert "as 'a' and not as" in each.why and "low and high" in each.why

    def test_it_is_of_the_first_source_and_said_also_after_a_cut(self, tmp_path, beyond, full):
        paths = touch_files(tmp_path / "sound", [("sound", touch) for _, touch in TOUCHES[:2]])
        np.save(beyond / "b" / "4.npy", np.linspace(0.2, 9, 120).reshape(60, 2))
        sources = [*paths, beyond / "b" / "4.npy", beyond]
        full(0)
        with pytest.raises(StoreFullError):
            run(tmp_path / "m", sources)
        full(None)
        with pytest.warns(RangeWarning, match="91 % of the values"):
            run(tmp_path / "m", sources)

    def test_the_command_line_says_it_as_one_line(self, tmp_path, beyond):
        (tmp_path / "pad.json").write_text(PAD.model_dump_json())
        words = [beyond, "--sensor", tmp_path / "pad.json", "--label-by", "folder", "--json"]
        told = [
            command(name, tmp_path / name, *words, *more) for name, more in (("learn", ()), ("fleet", ("--workers", 1)))
        ]
        for result in told:
            assert ": 100 % of the values lie" in result.stderr and len(result.stderr.splitlines()) == 1
            (fact,) = json.loads(result.stdout)["facts"]
            assert (fact["kind"], fact["size"], fact["source"]) == ("range", 1.0, str(beyond / "a" / "0.npy"))
        assert told[0].stderr == told[1].stderr
        refused = [json.loads(result.stdout)["refused"] for result in told]
        assert refused[0] == refused[1] and len(refused[0]) == 4


def test_an_error_waits_for_no_process_and_ends_it():
    with suppress(KeyError), Processes(1) as processes:
        processes.submit(time.sleep, 600)
        while not (found := multiprocessing.active_children()):
            time.sleep(0.01)
        raise KeyError
    assert wait([found[0].sentinel], 60)  # it ended; its exit code another thread may just be asking for
