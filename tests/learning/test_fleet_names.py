"""A fleet says what one process says: of touches under two names, and of readings that do not fit their range."""

import itertools
import json
import random

import numpy as np
import pytest
from commands import run as command
from scroll_tactile_store import StoreFullError
from test_fleet import BY_FOLDER, TOUCHES, full, memory_of, run, touch_files
from touches import PAD, SETTINGS, SmallSample, require_same, stream

import scroll_tactile.memory.state
from examples.benchmarks.fleet import DyingExecutor
from scroll_tactile import TactileLearner
from scroll_tactile.clients.learning import learning, steps
from scroll_tactile.clients.learning.fleet import learn
from scroll_tactile.clients.learning.sources import find_sources
from scroll_tactile.errors import RangeWarning

__all__ = ["full"]  # a fixture

# Of the first touches twelve come once more, half of them under another name.
TWICE = [*TOUCHES, *((name, touch) for name, touch in TOUCHES[:6]), *(("z", touch) for _, touch in TOUCHES[3:9])]


class Shuffled(DyingExecutor):
    """Answers in another order than it was asked."""

    def __init__(self, seed):
        super().__init__(0.3, seed)
        self._max_workers = 4


def seen(learner):
    rows = [row for row in learner.observations() if row.state != "retracted"]
    return [(row.material, row.key, row.source) for row in rows]


def by_one_process(path, sources):
    """What `learn` makes of sources: rows in order, digest, what was skipped and what was refused."""
    with TactileLearner.open(path, **SETTINGS) as learner:
        done = learning.learn_sources(learner, find_sources(list(map(str, sources)))[0], BY_FOLDER)
        refused = [(each.source, each.why) for each in done.refused]
        return seen(learner), learner.digest(), done.skipped, refused


@pytest.mark.parametrize("seed", range(4))
def test_it_is_what_one_process_learns_and_refuses_whatever_the_workers(tmp_path, seed, monkeypatch):
    monkeypatch.setattr(scroll_tactile.memory.state, "TouchSample", SmallSample)
    draw = random.Random(seed)
    touches = draw.sample(TWICE, len(TWICE))
    paths = touch_files(tmp_path / "in", touches)
    draw.shuffle(paths)
    monkeypatch.setattr(steps, "MOST_SOURCES", draw.randrange(1, 5))
    monkeypatch.setattr(steps, "MOST_TRIES", 50)
    if seed < 3:
        done = run(tmp_path / "m", paths, client=Shuffled(seed))
    else:
        done = learn(tmp_path / "m", paths, BY_FOLDER, workers=1, **SETTINGS)
    rows, digest, skipped, refused = by_one_process(tmp_path / "one", paths)
    assert done.digest == digest and done.repeated == skipped
    assert [(each.source, each.why) for each in done.refused] == refused and len(refused) > 2
    with TactileLearner.open(tmp_path / "m") as learner, TactileLearner.open(tmp_path / "one") as one:
        assert seen(learner) == rows
        held = [(name, key, t.rows.tobytes()) for name, key, t in learner.memory.sample]
        assert held == [(name, key, t.rows.tobytes()) for name, key, t in one.memory.sample]
        assert learner.exemplars == one.exemplars


def test_the_first_source_counts_also_where_its_worker_is_last(tmp_path, monkeypatch):
    a, b = touch_files(tmp_path / "in", [("a", (0, 60)), ("b", (0, 60))])
    monkeypatch.setattr(steps, "MOST_SOURCES", 1)
    for number, sources in enumerate(itertools.permutations([a, b])):
        for late in (a, b):

            class Late(DyingExecutor):
                """Gives up one source the first times: it comes last."""

                tries = 0

                def submit(self, what, job, late=late):
                    if str(late) in getattr(job, "sources", ()) and self.tries < 3:
                        self.tries += 1
                        job = None
                    return super().submit(what, job)

            done = run(tmp_path / f"m {number} {late.name}", sources, client=Late())
            (refused,) = done.refused
            first, second = (path.parent.name for path in sources)
            assert refused.source == str(sources[1])
            assert f"has this touch already, as {first!r} and not as {second!r}" in refused.why
            assert (done.observations, done.repeated) == (1, 0)


def test_a_destination_that_has_it_under_another_name_comes_first(tmp_path, monkeypatch):
    monkeypatch.setattr(steps, "JOBS_A_WORKER", 1)  # several sources a job
    before = [("x", TOUCHES[4][1]), TOUCHES[5]]
    paths = touch_files(tmp_path / "in", TOUCHES)
    memory_of(tmp_path / "m", before)
    for _ in range(2):  # and says so again
        done = run(tmp_path / "m", [tmp_path / "in"], add=True)
        (refused,) = done.refused
        assert refused.source == str(paths[4]) and "as 'x' and not as 'b'" in refused.why
    assert done.observations == 0
    with TactileLearner.open(tmp_path / "m") as learner:
        require_same(learner, [pair for pair in TOUCHES if pair != TOUCHES[4]] + before[:1])
        (row,) = (row for row in learner.observations() if row.material == "x")
        learner.relabel(row.sequence, "b")
    assert run(tmp_path / "m", [tmp_path / "in"]).refused == []


def test_a_run_that_was_cut_short_and_goes_on_with_other_sources_takes_the_same(tmp_path, monkeypatch, full):
    paths = touch_files(tmp_path / "in", TWICE)
    monkeypatch.setattr(steps, "MOST_SOURCES", 3)
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


@pytest.mark.parametrize("seed", range(2))
def test_a_run_that_was_cut_short_goes_on_with_its_sources_in_another_order(tmp_path, seed, monkeypatch, full):
    # Each of the two jobs has both copies of a touch; the one that its partial has no row of may come first now.
    x, y, z = TOUCHES[:3]
    paths = touch_files(tmp_path / "in", [x, y, x, z, ("d", x[1]), TOUCHES[3], x, TOUCHES[3]])
    monkeypatch.setattr(steps, "MOST_SOURCES", 4)
    monkeypatch.setattr(steps, "JOBS_A_WORKER", 1)
    full(0)
    with pytest.raises(StoreFullError):
        run(tmp_path / "m", paths, workers=1)
    full(None)
    order = paths[::-1] if seed == 0 else random.Random(seed).sample(paths, len(paths))
    done = run(tmp_path / "m", order, workers=1)
    _, digest, skipped, refused = by_one_process(tmp_path / "one", order)
    assert (done.digest, done.held + done.repeated + len(done.refused), done.repeated) == (digest, 8, skipped)
    assert [(each.source, each.why) for each in done.refused] == refused


def test_memories_are_refused_touch_by_touch_where_they_have_rows_and_whole_where_not(tmp_path):
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
    assert "none of them can be left out" in done.refused[1].why
    with TactileLearner.open(tmp_path / "m") as learner:
        assert learner.materials == {"a": 2, "b": 1, "c": 1, "z": 1}


@pytest.fixture
def beyond(tmp_path):
    """A folder of six different touches, all of their values above the pad's range."""
    for number, name in enumerate("abcabc"):
        path = tmp_path / "in" / name / f"{number}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.random.default_rng(number).uniform(5, 9, (60, 2)).astype(np.float32))
    return tmp_path / "in"


def test_it_says_and_refuses_what_one_process_does(tmp_path, beyond):
    with (
        pytest.warns(RangeWarning) as first,
        TactileLearner.open(tmp_path / "one", **SETTINGS) as learner,
    ):
        one = learning.learn_sources(learner, find_sources([str(beyond)])[0], BY_FOLDER)
    with pytest.warns(RangeWarning, match="100 % of the values lie outside the range of sensor 'pad'") as met:
        done = run(tmp_path / "m", [beyond])
    assert [str(each.message) for each in met] == [str(each.message) for each in first] == [done.range_problem]
    assert met[0].filename == run.__code__.co_filename
    assert [(each.source, each.why) for each in done.refused] == [(each.source, each.why) for each in one.refused]
    assert (done.observations, done.repeated, len(done.refused)) == (1, 1, 4)
    for each in done.refused:
        assert "all its values lie outside the sensor's range" in each.why and "relabel" not in each.why
        assert "as 'a' and not as" in each.why and "low and high" in each.why


def test_it_is_of_the_first_source_whatever_the_workers_and_said_also_after_a_cut(tmp_path, beyond, monkeypatch, full):
    paths = touch_files(tmp_path / "sound", TOUCHES[:2])
    np.save(beyond / "b" / "4.npy", np.linspace(0.2, 9, 120).reshape(60, 2))
    sources = [*paths, beyond / "b" / "4.npy", beyond]
    monkeypatch.setattr(steps, "MOST_SOURCES", 2)
    full(0)
    with pytest.raises(StoreFullError):
        run(tmp_path / "m", sources)
    full(None)
    with pytest.warns(RangeWarning, match="91 % of the values"):
        run(tmp_path / "m", sources)


def test_the_command_line_says_it_as_one_line(tmp_path, beyond):
    (tmp_path / "pad.json").write_text(PAD.model_dump_json())
    words = [beyond, "--sensor", tmp_path / "pad.json", "--label-by", "folder", "--json"]
    told = [
        command(name, tmp_path / name, *words, *more) for name, more in (("learn", ()), ("fleet", ("--workers", 1)))
    ]
    for result in told:
        assert result.stderr.startswith("Warning: 100 % of the values lie") and len(result.stderr.splitlines()) == 1
    assert told[0].stderr == told[1].stderr
    refused = [json.loads(result.stdout)["refused"] for result in told]
    assert refused[0] == refused[1] and len(refused[0]) == 4
