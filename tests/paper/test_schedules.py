"""No schedule makes a difference: not to a bit of the memory, nor of a prediction."""

import pytest

from examples.paper.studies.schedules import SCHEDULES, ScheduleName, arrange, si_blurry, try_schedules
from scroll_tactile import sensors
from scroll_tactile.errors import InputError
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.statistics.sample import TouchSample

NAMES = [f"m{number}" for number in range(8) for _ in range(3)]


def test_random_schedules_give_one_memory() -> None:
    scene = Scene(sensors.ROBOSKIN)
    names = scene.materials[:3]
    touches = [(name, scene.touch(name, i)) for name in names for i in range(3)]
    probes = [(name, scene.touch(name, 9, seconds=seconds)) for name in names for seconds in (0.2, None)]
    trials = try_schedules(sensors.ROBOSKIN, touches, probes, count=6, seed=1, features=64)
    assert len({trial.digest for trial in trials}) == 1
    assert all(trial.same_predictions for trial in trials)
    assert any(trial.split for trial in trials)
    assert any(trial.reopened for trial in trials)
    assert any(trial.batches > 2 for trial in trials)


def test_split_learners_share_a_sample_that_overflows(monkeypatch: pytest.MonkeyPatch) -> None:
    # More touches than the sample holds: which are in it must not depend on who observed them.
    class SmallSample(TouchSample):
        def __init__(self, capacity: int = 5) -> None:
            super().__init__(capacity)

    monkeypatch.setattr("scroll_tactile.memory.state.TouchSample", SmallSample)
    scene = Scene(sensors.ROBOSKIN)
    touches = [(name, scene.touch(name, i)) for name in scene.materials[:3] for i in range(4)]
    trials = try_schedules(sensors.ROBOSKIN, touches, touches[:3], count=3, features=64)
    assert trials[2].split
    assert len({trial.digest for trial in trials}) == 1
    assert all(trial.same_predictions for trial in trials)


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_schedule_is_a_permutation_drawn_from_its_seed(schedule: ScheduleName) -> None:
    order = arrange(schedule, NAMES, 0)
    assert sorted(order) == list(range(len(NAMES)))
    assert order == arrange(schedule, NAMES, 0)
    assert order != arrange(schedule, NAMES, 1)


def test_class_by_class_finishes_each_material() -> None:
    order = [NAMES[i] for i in arrange("class-by-class", NAMES, 3)]
    assert all(len(set(order[first : first + 3])) == 1 for first in range(0, len(NAMES), 3))
    assert arrange("reversed", NAMES, 3) == arrange("class-by-class", NAMES, 3)[::-1]


def test_batches_hold_four_materials_and_interleaved_all() -> None:
    batches = [NAMES[i] for i in arrange("batches", NAMES, 0)]
    assert [len(set(batches[:12])), len(set(batches[12:]))] == [4, 4]
    assert len(set(batches[:3])) > 1  # shuffled within a batch
    interleaved = [NAMES[i] for i in arrange("interleaved", NAMES, 0)]
    assert all(len(set(interleaved[first : first + 8])) == 8 for first in range(0, len(NAMES), 8))


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(InputError, match="schedule"):
        arrange("backwards", NAMES, 0)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="at least one"):
        try_schedules(sensors.BIOTAC, [], [])


class TestSiBlurry:
    def test_every_touch_comes_once_and_the_seed_draws_the_order(self) -> None:
        for seed in range(20):
            order, ends = si_blurry(NAMES, seed)
            assert sorted(order) == list(range(len(NAMES)))
            assert ends == sorted(set(ends)) and ends[-1] == len(NAMES)
            assert (order, ends) == si_blurry(NAMES, seed)
        assert si_blurry(NAMES, 0) != si_blurry(NAMES, 1)

    def test_disjoint_materials_keep_to_one_task_and_blurry_ones_travel(self) -> None:
        names = [f"m{number}" for number in range(20) for _ in range(40)]

        def spread(moved: float) -> list[int]:
            order, ends = si_blurry(names, 3, disjoint=0.5, moved=moved)
            tasks = [sum(place >= end for end in ends) for place in range(len(order))]
            by_material: dict[str, set[int]] = {}
            for place, i in enumerate(order):
                by_material.setdefault(names[i], set()).add(tasks[place])
            return sorted(map(len, by_material.values()))

        assert spread(0.0) == [1] * 20
        assert spread(0.1)[:10] == [1] * 10
        assert spread(0.1)[-1] > 1
        assert sum(count > 1 for count in spread(1.0)) == 10

    def test_what_cannot_be_is_refused(self) -> None:
        with pytest.raises(InputError, match=r"came 5, 1\.5 and 0\.1"):
            si_blurry(NAMES, 0, disjoint=1.5)
        with pytest.raises(InputError, match="came 0, "):
            si_blurry(NAMES, 0, tasks=0)
