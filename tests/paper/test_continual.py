"""Continual learning: formulas worked by hand, orders, requests, followed ridge heads, fleets, the default learner."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from paper_touches import PATCH, recorded
from torch import nn

from examples.paper.studies.continual_metrics import (
    accuracy_of,
    anytime_area,
    backward_transfer,
    curve,
    forgetting,
    forgetting_of,
    metrics_of,
    tally,
)
from examples.paper.studies.fleet_study import deal, federated
from examples.paper.studies.random_convolution import random_convolution
from examples.paper.studies.recursive_ridge import RecursiveRidge
from examples.paper.studies.robustness import SESSION, Robustness, Series, Simulated
from examples.paper.studies.schedules import SCHEDULES, arrange, part_ends, si_blurry
from examples.paper.studies.unlearning import Unlearning, relative_error, requests, ridge_from_scratch
from scroll_tactile.errors import InputError

NAMES = [f"m{number}" for number in range(8) for _ in range(3)]


class TestFormulas:
    def test_forgetting_and_transfer(self):
        moments = [{"a": 1.0}, {"a": 0.5, "b": 0.75}, {"a": 0.75, "b": 0.25, "c": 1.0}]
        assert forgetting(moments) == pytest.approx(((1 - 0.75) + (0.75 - 0.25)) / 2)
        moments = [{"a": 0.5}, {"a": 1.0, "b": 0.75}, {"a": 0.75, "b": 0.25, "c": 1.0}]
        assert backward_transfer(moments) == pytest.approx(((0.75 - 0.5) + (0.25 - 0.75)) / 2)
        for formula in (forgetting, backward_transfer):
            assert formula([{"a": 0.5}]) is None
            with pytest.raises(InputError, match="came none"):
                formula([])
            with pytest.raises(InputError, match="'a'"):
                formula([{"a": 0.5}, {"b": 0.5}])

    def test_anytime_area_weighs_each_accuracy_by_the_touches_since_the_last(self):
        assert anytime_area([(10, 1.0), (30, 0.5), (40, 0.0)]) == pytest.approx((10 * 1.0 + 20 * 0.5) / 40)
        assert anytime_area([(7, 0.25)]) == 0.25
        for wrong in ([], [(0, 1.0)], [(5, 1.0), (5, 1.0)], [(5, 1.0), (4, 1.0)]):
            with pytest.raises(InputError, match="ascending"):
                anytime_area(wrong)

    def test_counts_are_put_in_the_order_of_learning(self):
        points = {"10": {"a": [1, 2], "b": [2, 2]}, "9": {"a": [2, 2]}}
        assert (forgetting_of(points), curve(points)) == (0.5, [[1, 1.0], [2, 0.75]])
        assert accuracy_of(points["10"]) == 0.75
        assert tally(["a", "b", "a"], ["a", None, "b"]) == {"a": [1, 2], "b": [0, 1]}
        with pytest.raises(InputError, match="as many"):
            tally(["a"], [])

    def test_tasks_end_where_they_do_and_the_area_takes_all_points(self):
        points = {
            "2": {"a": [2, 2]},
            "4": {"a": [1, 2]},
            "6": {"a": [1, 2], "b": [0, 2]},
            "8": {"a": [2, 2], "b": [1, 2]},
        }
        assert metrics_of(points, [4, 8]) == {
            "last": 0.75,
            "average": (0.5 + 0.75) / 2,
            "anytime": (1.0 + 0.5 + 0.25 + 0.75) / 4,
            "forgetting": -0.5,  # the best at the end of an earlier task was ½; the point between is no task's end
            "backward_transfer": 0.5,
        }


class TestOrders:
    @pytest.mark.parametrize("schedule", SCHEDULES)
    def test_a_schedule_is_a_permutation_drawn_from_its_seed(self, schedule):
        order = arrange(schedule, NAMES, 0)
        assert sorted(order) == list(range(len(NAMES)))
        assert order == arrange(schedule, NAMES, 0) != arrange(schedule, NAMES, 1)

    def test_class_by_class_finishes_each_material(self):
        order = [NAMES[i] for i in arrange("class-by-class", NAMES, 3)]
        assert all(len(set(order[first : first + 3])) == 1 for first in range(0, len(NAMES), 3))
        assert part_ends("class-by-class", ["b", "b", "b", "a", "c", "c"]) == [3, 4, 6]
        assert part_ends("shuffled", ["b", "a", "b", "c", "a", "c", "b"]) == [2, 5, 7]

    def test_in_a_blurry_stream_every_touch_comes_once(self):
        for seed in range(20):
            order, ends = si_blurry(NAMES, seed)
            assert sorted(order) == list(range(len(NAMES)))
            assert ends == sorted(set(ends)) and ends[-1] == len(NAMES)
            assert (order, ends) == si_blurry(NAMES, seed)
        assert si_blurry(NAMES, 0) != si_blurry(NAMES, 1)
        for wrong, message in (({"disjoint": 1.5}, r"came 5, 1\.5 and 0\.1"), ({"tasks": 0}, "came 0, ")):
            with pytest.raises(InputError, match=message):
                si_blurry(NAMES, 0, **wrong)

    def test_disjoint_materials_keep_to_one_task_and_blurry_ones_travel(self):
        names = [f"m{number}" for number in range(20) for _ in range(40)]

        def spread(moved):
            order, ends = si_blurry(names, 3, disjoint=0.5, moved=moved)
            tasks = [sum(place >= end for end in ends) for place in range(len(order))]
            by_material = {}
            for place, i in enumerate(order):
                by_material.setdefault(names[i], set()).add(tasks[place])
            return sorted(map(len, by_material.values()))

        assert spread(0.0) == [1] * 20
        assert spread(0.1)[:10] == [1] * 10 and spread(0.1)[-1] > 1
        assert sum(count > 1 for count in spread(1.0)) == 10


def drawn(count, seed=0, dimension=5):
    random = np.random.default_rng(seed)
    return random.normal(0, 1, (count, dimension)), np.eye(3)[random.integers(0, 3, count)]


class TestUnlearning:
    @settings(max_examples=30, deadline=None)
    @given(st.integers(0, 2**32), st.integers(8, 60), st.integers(0, 120))
    def test_requests_add_what_is_away_and_delete_what_is_there(self, seed, touches, count):
        first, asked = requests(count, touches, seed)
        there = set(first)
        assert len(first) == round(touches / 2) and len(asked) == count
        for request in asked:
            assert 1 <= len(set(request.touches)) == len(request.touches) <= 4
            if request.adds:
                assert there.isdisjoint(request.touches)
                there.update(request.touches)
            else:
                assert there >= set(request.touches)
                there.difference_update(request.touches)
            assert there and there <= set(range(touches))
        assert (first, asked) == requests(count, touches, seed)
        with pytest.raises(InputError, match="came 7"):
            requests(3, 7, 0)

    def test_a_followed_head_is_the_dense_solution_of_what_is_there(self):
        rows, targets = drawn(30)
        ridge = RecursiveRidge(5, 0, 0.5)
        ridge.add(rows[:20, :], targets[:20, :2] * 0)  # two outputs at first, a third is met later
        ridge.remove(rows[:20], np.zeros((20, 2)))
        ridge.add(rows, targets)
        ridge.remove(rows[5:12], targets[5:12])
        kept = np.delete(np.arange(30), np.arange(5, 12))
        dense = np.linalg.solve(rows[kept].T @ rows[kept] + 0.5 * np.eye(5), rows[kept].T @ targets[kept])
        assert ridge.weights == pytest.approx(dense, rel=1e-9, abs=1e-12)
        assert ridge.inverse @ ridge.sums == pytest.approx(dense, rel=1e-9, abs=1e-12)

    def test_more_digits_are_nearer_the_truth_than_float64(self):
        # Integers, so that the truth is known: with Y = (XᵀX + λ) W for XᵀX = n I the head is W · n / (n + λ).
        rows = np.vstack([np.eye(3)] * 7)
        wanted = np.arange(9.0).reshape(3, 3)
        solved, refined = ridge_from_scratch(rows, rows @ wanted, 3.0)
        assert refined == pytest.approx(wanted * 0.7, rel=1e-15, abs=0)
        assert relative_error(solved, wanted * 0.7) < 1e-14
        narrow = rows[:2] * 1e4  # more unknowns than rows: (1e8 + λ) w = 1e8
        _, refined = ridge_from_scratch(narrow, np.eye(2) * 1e4, 1e-3)
        assert refined[0, 0] == pytest.approx(1e8 / (1e8 + 1e-3), rel=1e-15)
        assert refined[2] == pytest.approx([0.0, 0.0])
        assert relative_error(np.array([3.0, 4.0]), np.array([3.0, 0.0])) == pytest.approx(4 / 3)

    def test_a_trace_would_be_seen(self, monkeypatch):
        # A memory that keeps what it should retract: the comparison must find it.
        monkeypatch.setattr("scroll_tactile.learner.TactileLearner.retract", lambda self, receipt: None)
        recordings = recorded(PATCH, materials=3, each=8, folds=2)
        ((_, figures),) = Unlearning(recordings, checkpoints=(12,), features=64).run([0])
        assert not figures["after"][0]["ours"]["same_bytes"]
        assert figures["after"][0]["ours"]["error"] > 0


class TestFleet:
    def test_every_touch_is_dealt_once_and_a_small_alpha_parts_materials(self):
        names = [f"m{i}" for i in range(10) for _ in range(50)]

        def materials_a_robot(alpha):
            dealt = deal(names, 10, alpha, 0)
            assert sorted(i for own in dealt for i in own) == list(range(500))
            assert dealt == deal(names, 10, alpha, 0) != deal(names, 10, alpha, 1)
            return np.mean([len({names[i] for i in own}) for own in dealt])

        assert materials_a_robot(0.1) < materials_a_robot(1.0) < materials_a_robot(10.0)
        assert [len(own) for own in deal(names, 1, 0.1, 0)] == [500]
        with pytest.raises(InputError, match="came 0 and 1"):
            deal(names, 0, 1.0, 0)

    def test_equal_robots_average_to_one_and_touches_weigh(self):
        rows, places = torch.eye(4), torch.arange(4)

        def weights(parts):
            return next(federated(parts, lambda: nn.Linear(4, 4), rounds=2, epochs=1).parameters())

        # Of four touches each robot makes one full step, whatever the draw: the mean of equal steps is that step.
        assert torch.allclose(weights([(rows, places)]), weights([(rows, places)] * 3))
        half = (rows[:2], places[:2])
        assert not torch.allclose(weights([(rows, places), half]), weights([(rows, places), half, half]))

    def test_a_random_convolution_is_drawn_from_its_seed(self):
        image = np.random.default_rng(0).normal(0, 0.3, (6, 40)).clip(-1, 1).astype(np.float32)
        features = random_convolution(6, 0, dimension=16).embed(image)
        assert features.shape == (16,)
        assert (features == random_convolution(6, 0, dimension=16).embed(image)).all()
        assert (features != random_convolution(6, 1, dimension=16).embed(image)).any()


class TestRobustness:
    def test_the_session_is_successive_repetitions_where_their_order_is_known(self):
        sets = recorded(PATCH, materials=2, each=50, folds=5, ordered=True)
        _, session, *rotated = Robustness(sets).fits(4)
        assert [*session.tests] == [SESSION]
        last = {stream.key for _, stream in session.tests[SESSION]}
        assert last == {sets.streams[i].key for i in [*range(40, 50), *range(90, 100)]}
        assert last.isdisjoint(stream.key for _, stream in session.train)
        learned = [{material for material, _ in fit.train} for fit in rotated]
        assert learned == [{sets.materials[50]}, {sets.materials[0]}]
        assert all(SESSION not in fit.tests for fit in Robustness(recorded()).fits(0))

    def test_simulated_sensors_have_materials_that_are_never_touched(self):
        fits = Simulated(learned=2, tested=1).fits()
        assert [*fits] == ["events", "light"]
        for whole, without in fits.values():
            assert [len({material for material, _ in fit.train}) for fit in (whole, without)] == [20, 15]
            assert [len(test) for fit in (whole, without) for test in fit.tests.values()] == [20, 20]

    def test_a_file_that_is_no_series_is_named(self, tmp_path):
        (tmp_path / "text.npz").write_text("none")
        with pytest.raises(InputError, match=r"text\.npz; they cannot be read"):
            Series(tmp_path / "text.npz").fits()
