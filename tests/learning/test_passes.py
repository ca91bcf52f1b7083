"""Metrics, passes and the demonstration, on simulated touches."""

import math
from pathlib import Path

import pytest

from scroll_tactile import Kernels, TactileLearner, sensors
from scroll_tactile.clients.learning.demo import Demo, pull_the_plug
from scroll_tactile.clients.learning.metrics import (
    accuracy,
    calibration_error,
    confusion_counts,
    mean_and_spread,
    observe_all,
)
from scroll_tactile.errors import InputError
from scroll_tactile.simulation.scene import Scene


class TestMetrics:
    def test_calibration_error_of_a_case_worked_by_hand(self) -> None:
        # Two bins, half right each: 0.25 and 0.5 in (0, ½], |0.5 − 0.375|; 0.75 and 1 in (½, 1], |0.5 − 0.875|.
        error = calibration_error([0.25, 0.5, 0.75, 1.0], [1, 0, 1, 0], bins=2)
        assert error == pytest.approx((2 * 0.125 + 2 * 0.375) / 4)

        assert calibration_error([1.0, 1.0], [1, 1]) == calibration_error([0.0], [0]) == 0.0

    def test_confusions_are_counted_beside_the_right_answers(self) -> None:
        counts = confusion_counts(["a", "b", "c"], [4, 3, 1], [("a", "b", 1), ("b", "c", 2)])
        assert counts.tolist() == [[3, 1, 0], [0, 1, 2], [0, 0, 1]]

    def test_mean_and_spread(self) -> None:
        assert mean_and_spread([1.0, 3.0]) == (2.0, pytest.approx(math.sqrt(2)))
        assert mean_and_spread([0.5]) == (0.5, 0.0)

    def test_nothing_to_measure_is_refused(self) -> None:
        for call in (lambda: accuracy([], []), lambda: calibration_error([0.5], [])):
            with pytest.raises(InputError):
                call()
        with pytest.raises(InputError, match="probabilities"):
            calibration_error([1.5], [1])


TOUCHES = [(name, Scene(sensors.BIOTAC).touch(name, i)) for name in ("silk", "wool") for i in range(3)]


def test_the_touches_that_a_memory_does_not_hold_are_observed_and_one_of_something_else_is_refused():
    learner, whole = (TactileLearner(sensor=sensors.BIOTAC, embedding=Kernels(dimension=64)) for _ in range(2))
    assert (observe_all(learner, TOUCHES[:4]), observe_all(learner, TOUCHES), observe_all(whole, TOUCHES)) == (4, 2, 6)
    assert learner.digest() == whole.digest()
    with pytest.raises(InputError, match="'wool': 3"):
        observe_all(learner, TOUCHES[:3])


SMALL = {"materials": 4, "touches": 3, "held_out": 2, "features": 64}


class TestDemo:
    def test_an_interrupted_demo_goes_on_to_the_same_memory(self, tmp_path: Path) -> None:
        whole = Demo(sensors.BIOTAC, **SMALL).run()
        assert whole.observed == 12
        seen = []

        def stop(step: object) -> None:
            seen.append(step)
            if len(seen) == 2:
                raise KeyboardInterrupt

        task = Demo(sensors.BIOTAC, **SMALL, folder=tmp_path / "kept")
        with pytest.raises(KeyboardInterrupt):
            task.run(stop)
        resumed = task.run()
        assert (resumed.observed, resumed.digest, resumed.half) == (6, whole.digest, whole.half)
        assert resumed.answers == whole.answers
        again = task.run()
        assert (again.observed, again.digest, again.answers, again.half) == (0, whole.digest, whole.answers, whole.half)

    def test_a_folder_of_another_demonstration_is_refused(self, tmp_path: Path) -> None:
        Demo(sensors.BIOTAC, **SMALL, folder=tmp_path).run()
        with pytest.raises(InputError, match="none of this demonstration"):
            Demo(sensors.BIOTAC, 1, **SMALL, folder=tmp_path).run()

    def test_what_is_new_is_shown(self) -> None:
        outcome = Demo(sensors.BIOTAC, materials=8, touches=5, held_out=2, features=64).run()
        assert (outcome.half.tested, outcome.first) == (8, 8)
        assert outcome.half.unknown >= 6 and outcome.half.right == 1.0 and outcome.still_right == 1.0
        outcome.answers.predictions[:2] = outcome.answers.predictions[-2:]  # what was said to the last, to the first
        assert outcome.still_right == 0.75  # forgetting would be seen

    def test_a_process_that_is_killed_loses_nothing_that_it_acknowledged(self) -> None:
        found = pull_the_plug(sensors.ROBOSKIN, 3)
        assert found.acknowledged == 5 <= found.found and found.same
