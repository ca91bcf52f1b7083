"""Continual metrics against examples worked by hand; fleets; and the study and its command on simulated touches."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import refused, run
from paper_touches import PATCH, recorded, untimed
from torch import nn

from examples.paper.readers.labelled import Recordings
from examples.paper.studies.continual_metrics import anytime_area, backward_transfer, metrics
from examples.paper.studies.fleet_study import deal, federated
from examples.paper.studies.metrics_study import METHODS, STREAMS, ContinualMetrics, summary
from examples.paper.studies.random_convolution import random_convolution
from scroll_tactile.errors import InputError

SMALL: dict[str, Any] = {"every": 6, "capacity": 8, "features": 64, "robots": (3,), "alphas": (0.1,)}


@pytest.fixture(scope="module")
def recordings() -> Recordings:
    return recorded(PATCH, materials=4, each=8, folds=2, name="simulated")


@pytest.fixture(scope="module")
def found(recordings: Recordings) -> list[Any]:
    return list(ContinualMetrics(recordings, **SMALL).run([0]))


class TestFormulas:
    def test_anytime_area_weighs_each_accuracy_by_the_touches_since_the_last(self) -> None:
        assert anytime_area([(10, 1.0), (30, 0.5), (40, 0.0)]) == pytest.approx((10 * 1.0 + 20 * 0.5) / 40)
        assert anytime_area([(7, 0.25)]) == 0.25
        for curve in ([], [(0, 1.0)], [(5, 1.0), (5, 1.0)], [(5, 1.0), (4, 1.0)]):
            with pytest.raises(InputError, match="ascending"):
                anytime_area(curve)

    def test_backward_transfer_is_the_final_accuracy_less_the_first(self) -> None:
        moments = [{"a": 0.5}, {"a": 1.0, "b": 0.75}, {"a": 0.75, "b": 0.25, "c": 1.0}]
        assert backward_transfer(moments) == pytest.approx(((0.75 - 0.5) + (0.25 - 0.75)) / 2)
        assert backward_transfer([{"a": 0.5}]) is None
        with pytest.raises(InputError, match="'a'"):
            backward_transfer([{"a": 1.0}, {"b": 1.0}])

    def test_tasks_end_where_they_do_and_the_area_takes_all_points(self) -> None:
        points = {
            "2": {"a": [2, 2]},
            "4": {"a": [1, 2]},
            "6": {"a": [1, 2], "b": [0, 2]},
            "8": {"a": [2, 2], "b": [1, 2]},
        }
        assert metrics(points, [4, 8]) == {
            "last": 0.75,
            "average": (0.5 + 0.75) / 2,
            "anytime": (1.0 + 0.5 + 0.25 + 0.75) / 4,
            "forgetting": -0.5,  # the best at the end of an earlier task was ½; the point between is no task's end
            "backward_transfer": 0.5,
        }


class TestFleet:
    def test_every_touch_is_dealt_once_and_a_small_alpha_parts_materials(self) -> None:
        names = [f"m{i}" for i in range(10) for _ in range(50)]

        def materials_a_robot(alpha: float) -> float:
            dealt = deal(names, 10, alpha, 0)
            assert sorted(i for own in dealt for i in own) == list(range(500))
            assert dealt == deal(names, 10, alpha, 0) != deal(names, 10, alpha, 1)
            return float(np.mean([len({names[i] for i in own}) for own in dealt]))

        assert materials_a_robot(0.1) < materials_a_robot(1.0) < materials_a_robot(10.0)
        assert [len(own) for own in deal(names, 1, 0.1, 0)] == [500]
        with pytest.raises(InputError, match="came 0 and 1"):
            deal(names, 0, 1.0, 0)

    def test_equal_robots_average_to_one_and_touches_weigh(self) -> None:
        rows, places = torch.eye(4), torch.arange(4)

        def weights(parts: list[tuple[torch.Tensor, torch.Tensor]]) -> torch.Tensor:
            return next(federated(parts, lambda: nn.Linear(4, 4), rounds=2, epochs=1).parameters())

        # Of four touches each robot makes one full step, whatever the draw: the mean of equal steps is that step.
        assert torch.allclose(weights([(rows, places)]), weights([(rows, places)] * 3))
        half = (rows[:2], places[:2])
        assert not torch.allclose(weights([(rows, places), half]), weights([(rows, places), half, half]))


class TestStudy:
    def test_every_method_and_fleet_is_measured(self, recordings: Recordings, found: list[Any]) -> None:
        by_system = {cell.system: figures for cell, figures in found}
        assert list(by_system) == [f"{stream}, {method}" for stream in STREAMS for method in METHODS] + [
            "fleet of 1, alpha 1",
            "fleet of 3, alpha 0.1",
        ]
        assert json.loads(json.dumps(by_system)) == by_system
        by_class = by_system["class by class, f"]
        assert by_class["ends"] == [4, 8, 12, 16]
        assert [touches for touches, _ in by_class["curve"]] == [4, 6, 8, 12, 16]
        assert by_class["last"] == by_class["curve"][-1][1] > 0.7
        assert by_system["class by class, nearest neighbour"]["last"] > 0.7
        assert by_system["class by class, ACIL"]["last"] > 0.7
        for name, figures in by_system.items():
            if "fleet" not in name:
                assert len(figures["peak_bytes"]) == len(figures["learning_seconds"]) == len(figures["ends"])
                assert min(figures["peak_bytes"]) > 0
        # What keeps every touch grows with each; 64 features of 8 bytes are 512.
        peaks = by_system["class by class, nearest neighbour"]["peak_bytes"]
        assert peaks[-1] - peaks[0] >= 12 * 512

    def test_a_fleet_has_the_bytes_and_the_answers_of_one_robot(self, found: list[Any]) -> None:
        fleets = [figures for cell, figures in found if "fleet" in cell.system]
        assert all(fleet["same_bytes"] and fleet["same_answers"] for fleet in fleets)
        assert fleets[0]["digest"] == fleets[1]["digest"]
        assert fleets[0]["accuracy"] == fleets[1]["accuracy"] > 0.7
        assert set(fleets[1]["averaged"]) == {"linear", "MLP"}

    def test_a_run_that_was_cut_goes_on_to_the_same_figures(
        self, recordings: Recordings, found: list[Any], tmp_path: Path
    ) -> None:
        task = ContinualMetrics(recordings, **SMALL, folder=tmp_path / "kept")
        first = task.run([0])
        done = [next(first) for _ in range(3)]
        first.close()
        assert done == list(ContinualMetrics(recordings, **SMALL, folder=tmp_path / "kept").run([0]))[:3]
        again = list(ContinualMetrics(recordings, **SMALL, folder=tmp_path / "kept").run([0]))

        def comparable(cells: list[Any]) -> Any:
            return [(cell, untimed({k: v for k, v in figures.items() if k != "peak_bytes"})) for cell, figures in cells]

        assert comparable(again) == comparable(found)
        with pytest.raises(InputError, match="seed 0 there, 1 here"):
            list(ContinualMetrics(recordings, seed=1, **SMALL, folder=tmp_path / "kept").run([0]))

    def test_a_summary_has_means_over_folds(self, found: list[Any]) -> None:
        means = summary([*found, *found])
        row = means["Si-Blurry, streaming LDA"]
        figures = {cell.system: figures for cell, figures in found}["Si-Blurry, streaming LDA"]
        assert row["last"] == {"mean": pytest.approx(figures["last"]), "sd": 0.0, "folds": 2}
        assert row["megabytes"]["mean"] == pytest.approx(max(figures["peak_bytes"]) / 1e6)
        assert means["fleet of 3, alpha 0.1"]["same_bytes"]["mean"] == 1.0

    def test_what_cannot_be_is_refused(self, recordings: Recordings) -> None:
        with pytest.raises(InputError, match="came 0"):
            ContinualMetrics(recordings, every=0)
        with pytest.raises(InputError, match=r"came \[10, 0\]"):
            ContinualMetrics(recordings, robots=(10, 0))
        with pytest.raises(InputError, match="folds out of"):
            list(ContinualMetrics(recordings).run([7]))


def test_a_random_convolution_is_drawn_from_its_seed() -> None:
    image = np.random.default_rng(0).normal(0, 0.3, (6, 40)).clip(-1, 1).astype(np.float32)
    features = random_convolution(6, 0, dimension=16).embed(image)
    assert features.shape == (16,)
    assert (features == random_convolution(6, 0, dimension=16).embed(image)).all()
    assert (features != random_convolution(6, 1, dimension=16).embed(image)).any()


def test_the_command_writes_what_it_shows(
    recordings: Recordings, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    module = sys.modules["examples.paper.commands.metrics_command"]
    monkeypatch.setattr(module, "read", lambda dataset, data, seed: recordings)
    monkeypatch.setattr(module, "QUICK_FLEETS", {"robots": (2,), "alphas": (0.1,)})
    words = ["metrics", "roboskin-20", "--data", "simulated", "--features", 64, "--materials", 4, "--buffer", 8]
    result = run(*words, "--quick", "--json", tmp_path / "r.json")
    assert result.exit_code == 0, result.output
    assert "Si-Blurry" in result.stdout and "the same" in result.stdout
    found = json.loads((tmp_path / "r.json").read_text())
    assert found["command"].startswith("python -m examples.paper metrics roboskin-20 --data DATA")
    assert {"versions", "date", "machine", "seed", "sensor", "methods", "means", "cells"} <= set(found)
    assert "came 'first'" in refused(*words, "--folds", "first")
    assert "came '10,0'" in refused(*words, "--robots", "10,0")
