"""Requests, heads and bytes: what comes and goes leaves no trace in ours, and rounding in what is followed."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run
from hypothesis import given, settings
from hypothesis import strategies as st
from paper_touches import PATCH, recorded, untimed

from examples.paper.readers.labelled import Recordings
from examples.paper.studies.recursive_ridge import RecursiveRidge
from examples.paper.studies.unlearning_study import (
    Unlearning,
    relative_error,
    requests,
    ridge_from_scratch,
    summary,
)
from scroll_tactile.errors import InputError


@pytest.fixture(scope="module")
def recordings() -> Recordings:
    return recorded(PATCH, materials=3, each=8, folds=2, name="simulated")


@pytest.fixture(scope="module")
def found(recordings: Recordings) -> list[Any]:
    return list(Unlearning(recordings, checkpoints=(1, 12), features=64).run([0, 1]))


def drawn(count: int, seed: int = 0, dimension: int = 5) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return random.normal(0, 1, (count, dimension)), np.eye(3)[random.integers(0, 3, count)]


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32), st.integers(8, 60), st.integers(0, 120))
def test_requests_add_what_is_away_and_delete_what_is_there(seed: int, touches: int, count: int) -> None:
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


def test_too_few_touches_are_refused() -> None:
    with pytest.raises(InputError, match="came 7"):
        requests(3, 7, 0)


class TestRecursiveRidge:
    def test_it_is_the_dense_solution_of_what_is_there(self) -> None:
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

    def test_more_digits_are_nearer_the_truth_than_float64(self) -> None:
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

    def test_relative_error(self) -> None:
        assert relative_error(np.array([3.0, 4.0]), np.array([3.0, 0.0])) == pytest.approx(4 / 3)


class TestUnlearning:
    def test_no_trace_is_left_in_ours(self, found: list[Any]) -> None:
        for _, figures in found:
            assert figures["same_answers"]
            assert [after["requests"] for after in figures["after"]] == [1, 12]
            for after in figures["after"]:
                assert after["ours"]["same_bytes"]
                assert after["ours"]["error"] == 0.0

    def test_what_is_followed_is_rounded(self, found: list[Any]) -> None:
        means = summary(found)
        assert means["same_bytes"] == {"1": True, "12": True}
        assert means["ours"] == {"1": 0.0, "12": 0.0}
        followed, anew = means["peer"]["0.001"]["weights"], means["peer"]["0.001"]["anew"]
        assert followed["12"] is None or followed["12"] > anew["12"] > 0

    def test_a_trace_would_be_seen(self, recordings: Recordings, monkeypatch: pytest.MonkeyPatch) -> None:
        # A memory that keeps what it should retract: the comparison must find it.
        monkeypatch.setattr("scroll_tactile.learner.TactileLearner.retract", lambda self, receipt: None)
        ((_, figures),) = Unlearning(recordings, checkpoints=(12,), features=64).run([0])
        assert not figures["after"][0]["ours"]["same_bytes"]
        assert figures["after"][0]["ours"]["error"] > 0

    def test_a_finished_fold_is_read_back(self, recordings: Recordings, found: list[Any], tmp_path: Path) -> None:
        task = Unlearning(recordings, checkpoints=(1, 12), features=64, folder=tmp_path / "kept")
        first = list(task.run([0]))
        reported: list[str] = []
        both = list(task.run([0, 1], lambda what, done, of: reported.append(what)))
        assert both[0] == first[0]
        assert not any("fold 0" in what for what in reported)
        assert [figures["after"] for _, figures in both] == [figures["after"] for _, figures in found]
        assert untimed(both[0][1]).keys() == both[0][1].keys() - {"seconds"}

    def test_the_command_writes_what_it_shows(
        self, recordings: Recordings, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        module = sys.modules["examples.paper.commands.unlearning_command"]
        monkeypatch.setattr(module, "read", lambda dataset, data, seed: recordings)
        monkeypatch.setattr(module, "QUICK_CHECKPOINTS", (1, 5))
        words = ["unlearning", "roboskin-20", "--data", "simulated", "--features", 64, "--materials", 3, "--quick"]
        result = run(*words, "--json", tmp_path / "r.json")
        assert result.exit_code == 0, result.output
        assert "the same in every bit" in result.stdout
        found = json.loads((tmp_path / "r.json").read_text())
        assert found["command"] == "python -m examples.paper unlearning roboskin-20 --data DATA --seed 0 --quick"
        assert found["means"]["same_bytes"] == {"1": True, "5": True}
        assert {"versions", "date", "machine", "seed", "sensor", "penalties", "cells"} <= set(found)
