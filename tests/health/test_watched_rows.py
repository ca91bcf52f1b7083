"""Health after a retraction, over restarts and beside writers: what a fresh reading of the journal would say."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scroll_tactile_store import StoreError, StoreFullError
from scroll_tactile_store.log import Log

from scroll_tactile import Health, Kernels, Scene, Sensor, TactileLearner
from scroll_tactile.health.watch import EVERY, Watch, WatchedRow, WatchedRows, WatchRules

PAD = Sensor(name="pad", channels=4, rate=50.0, low=0.0, high=1000.0, unit="counts", duration=1.0)
SCENE = Scene(sensor=PAD, seed=3)
NAMES = SCENE.materials[:3]
RULES = WatchRules(0.01)


def empty() -> WatchedRows:
    return WatchedRows(RULES, 2)


def row(sequence: int, seed: int, shift: int) -> WatchedRow:
    """A touch of one of two materials or the sensor at rest, or a row that does not count."""
    random = np.random.default_rng([sequence, seed])
    numbers = random.normal(0, 40, 7).astype(np.int16)
    numbers[[2, 4]] += shift  # spread and noise of the first channel
    material = ("a", "a", "b", "", None)[int(random.integers(5))]
    return WatchedRow(sequence) if material is None else WatchedRow(sequence, material, 30, numbers)


def taken(rows: list[WatchedRow], into: WatchedRows) -> WatchedRows:
    for each in rows:
        if each.sequence > into.last:
            into.take(each)
    return into


def state(watched: WatchedRows) -> tuple[Any, ...]:
    watch = watched.watch
    arrays = watch.scatter.inverse, watch.bets.shares, watch.bets.log, watch.least, watch.since
    recent = [each.row for kept in (watch.touched, watch.rested) for each in kept]
    parts = watch.grew, watch.evidence, watch.taken, watch.alarmed, watch.change, recent
    return *parts, *(part.tobytes() for part in arrays)


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 9),
    st.lists(st.tuples(st.integers(1, 70), st.floats(0, 1), st.sampled_from([0, 0, 300])), min_size=1, max_size=6),
)
def test_rows_taken_back_leave_the_state_of_a_fresh_reading(seed: int, steps: list[tuple[int, float, int]]) -> None:
    rows, watched, sequence = list[WatchedRow](), empty(), 0
    for more, place, shift in steps:
        rows += [row(sequence + i, seed, shift) for i in range(1, more + 1)]
        sequence += more
        taken(rows, watched)
        gone = 1 + round(place * (sequence - 1))
        rows = [each if each.sequence != gone else WatchedRow(gone) for each in rows]
        watched.take_back(gone)
        assert state(taken(rows, watched)) == state(taken(rows, empty()))


def test_few_copies_are_kept_and_few_rows_read_again() -> None:
    rows = [row(sequence, 0, 0) for sequence in range(1, 3001)]
    watched = taken(rows, empty())
    assert watched.watch.alarmed is None
    assert len(watched._earlier) <= 14
    for gone in (3000, 2990, 2700, 2000):
        watched.take_back(gone)
        assert 2 * (3000 - watched.last) <= 4 * (3000 - gone) + 5 * EVERY
        taken(rows, watched)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A memory of 150 touches, rest readings among them."""
    path = tmp_path_factory.mktemp("watched") / "memory"
    with TactileLearner.open(path, sensor=PAD, embedding=Kernels(dimension=64)) as learner, learner.batch():
        for i in range(50):
            for name in NAMES:
                learner.observe(name, SCENE.touch(name, i), source=f"robot-{i % 2}/day.npy")
    return path


@pytest.fixture
def memory(made: Path, tmp_path: Path) -> Path:
    with TactileLearner.open(made, mode="read") as learner:
        learner.backup(tmp_path / "memory")
    return tmp_path / "memory"


class Counted:
    """How many rows watches took; before each, what is to happen."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.count, self.then = 0, dict[int, Callable[[], object]]()
        take = Watch.take

        def counted(watch: Watch, *row: Any) -> None:
            self.count += 1
            self.then.get(self.count, lambda: None)()
            take(watch, *row)

        patch.setattr(Watch, "take", counted)

    def rows(self, what: Callable[[], Health]) -> tuple[Health, int]:
        self.count = 0
        return what(), self.count


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counted:
    return Counted(monkeypatch)


def fresh(path: Path, **which: Any) -> Health:
    with TactileLearner.open(path, mode="read") as learner:
        return learner.health(**which)


def test_an_undo_reads_few_rows_again(memory: Path, counted: Counted) -> None:
    with TactileLearner.open(memory) as learner:
        assert counted.rows(learner.health)[1] == 150
        assert counted.rows(learner.health)[1] == 0
        learner.retract(150)
        after, count = counted.rows(learner.health)
        assert count <= EVERY
        learner.relabel(139, NAMES[1])
        learner.forget(source="robot-1/day.npy")
        learner.sense(SCENE.touch(NAMES[0], 99))
        last, _ = counted.rows(learner.health)
        learner.compact()
        assert counted.rows(learner.health) == (last, 0)
    assert after.touches == 149 and last.touches == 76
    assert fresh(memory) == last


def test_the_memory_is_free_while_rows_are_read_and_may_change(memory: Path, counted: Counted) -> None:
    with TactileLearner.open(memory) as learner:

        def observes() -> None:
            learner.observe(NAMES[0], SCENE.touch(NAMES[0], 77))

        def beside() -> None:
            thread = threading.Thread(target=observes)
            thread.start()
            thread.join(30)
            assert not thread.is_alive()

        counted.then = {20: beside, 70: lambda: learner.retract(10), 80: learner.health}
        found, _ = counted.rows(learner.health)
        counted.then = {}
        assert found.touches == 150
    assert fresh(memory) == found


@pytest.mark.parametrize("asked", [True, False])
def test_rows_of_a_batch_that_was_lost_count_no_more_nor_after_a_restart(
    memory: Path, monkeypatch: pytest.MonkeyPatch, asked: bool
) -> None:
    def full(*_: Any) -> None:
        raise StoreFullError("no space left")

    with TactileLearner.open(memory) as learner:
        before = learner.health()
        with pytest.raises(StoreError, match="nothing of this batch"), learner.batch():
            for i in range(4):
                learner.sense(SCENE.touch(NAMES[0], 80 + i), NAMES[0])
            lost = learner.health()
            assert lost.touches == before.touches + 4
            monkeypatch.setattr(Log, "stage", full)
            with pytest.raises(StoreFullError):
                learner.sense(SCENE.touch(NAMES[0], 84), NAMES[0])
        monkeypatch.undo()
        if asked:
            assert learner.health() == before
        for i in range(4):  # these have the same places in the journal
            learner.sense(SCENE.touch(NAMES[1], 90 + i), NAMES[1])
        found = learner.health() if asked else None
    after = fresh(memory)
    assert after.grew[-1] != lost.grew[-1] and found in (None, after)


def test_rows_that_others_ask_about_are_not_read_again_and_nobody_takes_those_that_are_told_of(
    memory: Path, counted: Counted, monkeypatch: pytest.MonkeyPatch
) -> None:
    with TactileLearner.open(memory) as learner:
        for _ in range(3):  # diagnostics and a live session, by rules of their own
            learner.health()
            learner.health(after=20)
        assert counted.rows(learner.health)[1] == counted.rows(lambda: learner.health(after=20))[1] == 0
        told = WatchedRows.health

        def alone(watched: WatchedRows, *how: Any) -> Health:
            assert watched not in learner._ledger.watched.values()  # or another thread takes it further meanwhile
            return told(watched, *how)

        monkeypatch.setattr(WatchedRows, "health", alone)
        learner.health()


@pytest.mark.parametrize("first", ["", "a"])
def test_a_change_is_told_by_the_rows_that_show_it_however_many_of_the_other_kind_came_since(first: str) -> None:
    """Touches near the bound, then many rests, which carry it over the bound; and the other way round."""
    random, second = np.random.default_rng(0), "" if first else "a"
    watched = WatchedRows(RULES, 4)

    def take(material: str, shift: float = 0.0) -> None:
        assert watched.last < 2000
        numbers = np.append(random.normal(0, 20, 12), -1024)
        numbers[0] += shift
        watched.take(WatchedRow(watched.last + 1, material, 100, numbers.astype(np.int16)))

    for material in (first, second):
        for _ in range(150):
            take(material)
    while watched.watch.evidence < np.log(100) - 1.5:
        take(first, 300)
    for _ in range(140):
        take(second)
    assert watched.watch.alarmed is None
    while watched.watch.alarmed is None:
        take(second, 300)
    assert watched.watch.change is not None and 0 in watched.watch.change.channels


def test_an_opened_memory_reads_its_rows_once_and_says_the_same(memory: Path, counted: Counted) -> None:
    with TactileLearner.open(memory) as learner:
        learner.retract(149)
        found = learner.health()
    with TactileLearner.open(memory, mode="read") as learner:
        assert counted.rows(learner.health) == (found, 149)
        assert counted.rows(learner.health) == (found, 0)
        assert counted.rows(lambda: learner.health(source="robot-0"))[1] == 75  # other rules, other rows
