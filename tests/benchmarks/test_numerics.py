"""`benchmarks numerics`: its truths, its cases, what it measures and what it shows."""

import importlib.util
import json
import runpy
import sys
from pathlib import Path

import mpmath
import numpy as np
import pytest
from benchmarks.ridge_truth import truth
from commands import run
from typer.testing import CliRunner

from examples.benchmarks.numerics import comparison
from examples.benchmarks.numerics.comparison import claims, find_nist
from examples.benchmarks.numerics.learned import AGREED, answers_error, flips, measure_learned
from examples.benchmarks.numerics.long_runs import run_schedules, run_updates
from examples.benchmarks.numerics.memories import make_memories
from examples.benchmarks.numerics.peers import as_case, error_of, measure
from examples.benchmarks.numerics.recorded import nist_cases
from examples.benchmarks.numerics.regressions import Case, make_cases
from examples.benchmarks.numerics.truth import TrueReadout, exact_weights
from examples.benchmarks.solvers.methods import SOLVERS
from scroll_tactile.errors import DatasetError

RNG = np.random.default_rng(0)
ROWS, TARGETS = RNG.normal(size=(40, 6)), RNG.normal(size=(40, 2))


def agree(found, expected, within):
    with mpmath.workdps(80):
        for row, column in np.ndindex(found.shape):
            high = float(found[row, column])
            whole = mpmath.mpf(high) + mpmath.mpf(float(found[row, column] - high))
            assert abs(whole - expected[column][row]) <= within * abs(expected[column][row])


class TestTruth:
    @pytest.mark.parametrize("penalty", [0.0, 1e-3, 1e-30, 1e30])
    def test_exact_elimination_is_the_truth(self, penalty):
        rows = ROWS * np.logspace(0, -12, 6)
        agree(exact_weights(rows, TARGETS, penalty), truth(rows, TARGETS, penalty, 80), 1e-18)

    def test_repeated_rows_count_so_often(self):
        many = exact_weights(np.tile(ROWS, (7, 1)), np.tile(TARGETS, (7, 1)), 0.5)
        assert np.array_equal(many, exact_weights(ROWS, TARGETS, 0.5, repeats=7))

    def test_a_singular_system_has_none(self):
        assert exact_weights(np.rint(ROWS[:4] * 8), TARGETS[:4], 0.0) is None
        assert exact_weights(np.zeros((2, 3)), np.ones((2, 1)), 0.0) is None

    @pytest.mark.parametrize("scale", [1, 2.0**-30])
    def test_a_true_readout_answers_as_the_textbook_does(self, scale):
        """In fifty digits, of integers, and of doubles in another unit."""
        rng = np.random.default_rng(3)
        rows, evaluated = rng.integers(-(2**20), 2**20, size=(12, 4)), rng.integers(-(2**20), 2**20, size=(3, 4))
        places, penalty, gamma = np.arange(12) % 3, 3e9 * scale**2, 17.0
        answers = TrueReadout(rows * scale, places, penalty, gamma).answers(evaluated * scale)
        with mpmath.workdps(50):
            x, e = mpmath.matrix((rows * scale).tolist()), mpmath.matrix((evaluated * scale).tolist())
            mean = mpmath.ones(1, 12) * x / 12
            means = [sum((x[i, :] for i in range(y, 12, 3)), mpmath.zeros(1, 4)) / 4 for y in range(3)]
            within = mpmath.mpf(penalty) * mpmath.eye(4)
            beyond = within.copy()
            for i in range(12):
                within += (x[i, :] - means[i % 3]).T * (x[i, :] - means[i % 3])
                beyond += (x[i, :] - mean).T * (x[i, :] - mean)
            pull = [4 * (m - mean).T for m in means]
            for i in range(3):
                row = e[i, :]
                near = [gamma * ((row - m) * mpmath.lu_solve(within, (row - m).T))[0] for m in means]
                far = gamma * ((row - mean) * mpmath.lu_solve(beyond, (row - mean).T))[0]
                ridge = [1 / mpmath.mpf(3) + ((row - mean) * mpmath.lu_solve(beyond, p))[0] for p in pull]
                middle = sum(near) / 3
                assert answers.lda[i].tolist() == pytest.approx([float((middle - v) / 2) for v in near], rel=1e-14)
                assert answers.ridge[i].tolist() == pytest.approx([float(v) for v in ridge], rel=1e-14)
                assert answers.distances[i].tolist() == pytest.approx([float(v - far) for v in near], rel=1e-14)
                assert answers.novelty[i] == pytest.approx(float(min(near) - far), rel=1e-14)


@pytest.mark.parametrize("memory", [*make_memories(1, 0.1)], ids=lambda memory: memory.name)
def test_what_the_learner_runs_is_right_on_hard_memories(memory):
    """To 1e-9 of the scores; touches left out to 1e-8; ρ to its last bits."""
    fresh, grid = measure_learned(memory)
    assert max(fresh[name] for name in ("answers_error", "ridge_error", "novelty_error")) < AGREED / 30
    assert fresh["flipped"] == 0
    assert fresh["share_error"] < 1e-14
    assert fresh["left_out_error"] is None or fresh["left_out_error"] < 1e-8
    assert memory.below or (grid["answers_error"] < 1e-2 and grid["flipped"] == 0)


class TestMeasuring:
    def test_cases_have_names_of_their_own_and_a_seed_makes_them_again(self):
        first, again, other = ([*make_memories(seed, 0.1), *make_cases(seed)] for seed in (3, 3, 4))
        assert len({case.name for case in first}) == len(first)
        kept = [
            case.rows if isinstance(case, Case) else case.features for cases in (first, again, other) for case in cases
        ]
        assert [part.tobytes() for part in kept[: len(first)]] == [
            part.tobytes() for part in kept[len(first) : -len(first)]
        ]
        assert kept[0].tobytes() != kept[-len(first)].tobytes()

    def test_refusals_are_records_too(self):
        case = Case("c", np.c_[ROWS, np.zeros(40)], TARGETS, 0.0)
        said = {method: measure(case, method, 0) for method in SOLVERS}
        assert said["recursion"]["diagnosis"] == "needs λ > 0"
        assert said["recursion"]["seconds_per_row"] is None
        for method in ("square root", "plain sums", "exact"):
            assert "refused" in said[method]["diagnosis"]
        assert "other weights fit as well" in said["pseudo-inverse"]["diagnosis"]
        assert all(record["weights_error"] is None for record in said.values())

    def test_an_error_is_relative_and_counts_by_the_columns_sizes(self):
        truth = np.array([[1.0], [1e6]], dtype=np.longdouble)
        assert error_of(np.array([[1.0], [2e6]]), truth, np.array([1.0, 1e-6])) == pytest.approx(np.sqrt(0.5))
        assert error_of(np.full((2, 1), 1e308), np.full((2, 1), 1e-10, dtype=np.longdouble), np.ones(2)) is None
        assert error_of(np.zeros((2, 1)), np.zeros((2, 1), dtype=np.longdouble), np.ones(2)) == 0

    def test_an_error_of_answers_is_that_of_the_worst_row_whatever_all_materials_share(self):
        true = np.array([[1.0, -1.0], [100.0, -100.0]])
        assert answers_error(true + 7.0, true) == 0
        assert answers_error(true + np.array([[0.1, -0.1], [0, 0]]), true) == pytest.approx(0.1)
        assert flips(np.array([[0.0, 1.0], [1.0, 0.0]]), true) == 1

    def test_the_claim_names_its_worst_case_and_fails_beyond_it(self):
        fine = {"case": "a", "family": "within the bound", "method": "learner", "flipped": 0}
        fine |= dict.fromkeys(("answers_error", "ridge_error", "novelty_error", "left_out_error", "share_error"), 1e-12)
        grids = [
            fine | {"method": "grid", "family": family, "weights_error": 0.1}
            for family in ("within the bound", "below the grid")
        ]
        assert claims([fine, *grids])["agreed"]
        found = claims([fine, fine | {"case": "b", "ridge_error": 2e-9}, *grids])
        assert not found["agreed"]
        assert found["ridge_error"] == {"error": 2e-9, "case": "b"}

    def test_updates_are_measured_at_each_power_of_ten(self):
        exact, plain = run_updates(0, 8, 1000, ["exact", "plain sums"], lambda _: None)
        assert [(one["method"], one["rows"]) for one in (exact, plain)] == [("exact", 1000), ("plain sums", 1000)]
        assert exact["weights_error"] < 2.0**-52 and plain["weights_error"] < 1e-11
        assert exact["case"] == "1e3 observations, 8 features"

    def test_schedules_count_what_differs(self):
        methods = ("learner", "exact", "plain sums")
        found = {one["method"]: one["differing"] for one in run_schedules(0, methods, 10, 8, lambda _: None)}
        assert (found["learner"], found["exact"]) == (0, 0)
        assert found["plain sums"] > 5


@pytest.fixture(scope="module")
def nist() -> Path:
    """NIST's file; skips where it is not at hand."""
    path = find_nist(None)
    if path is None:
        pytest.skip("no nist_strd.json beside the checkout")
    return path


# Correct digits of the worst coefficient, by the doubles as they are (no grid). Filip's are what rounding its powers
# to doubles leaves: the solution for these doubles is exact.
DIGITS = {"Longley": 14, "Filip": 7.5, "Wampler1": 15, "Wampler2": 13, "Wampler3": 15, "Wampler4": 15}


@pytest.mark.parametrize("name", DIGITS)
def test_nists_certified_digits(nist, name):
    case = next(one for one in nist_cases(nist) if one.name == name)
    one = measure(case, "exact", 0)
    assert one["digits"] >= DIGITS[name]
    assert one["weights_error"] <= 2.0**-52


def test_a_file_in_nists_form_and_one_that_is_not(tmp_path):
    sets = {
        "note": "…",
        "Line": {"degree": 1, "x": ["0.1", "2", "3"], "y": ["1.1", "3", "4"], "certified": ["1", "1"]},
        "Through": {"degree": 1, "intercept": False, "x": ["1"], "y": ["2"], "certified": ["2"]},
        "Table": {"X": [["1.5"], ["2"]], "y": ["1", "2"], "certified": ["-2", "2"]},
    }
    (tmp_path / "nist_strd.json").write_text(json.dumps(sets))
    line, through, table = nist_cases(tmp_path / "nist_strd.json")
    assert line.rows.tolist() == [[1, 0.1], [1, 2], [1, 3]]
    assert through.rows.tolist() == [[1.0]]
    assert table.rows.tolist() == [[1, 1.5], [1, 2]]
    assert find_nist(tmp_path) == tmp_path / "nist_strd.json"
    assert [measure(case, "exact", 0)["digits"] for case in (through, table)] == [15, 15]
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(DatasetError, match=r"bad\.json"):
        list(nist_cases(tmp_path / "bad.json"))
    with pytest.raises(DatasetError, match="cannot be read"):
        list(nist_cases(tmp_path / "none.json"))


@pytest.mark.parametrize(("agreed", "flipped", "code"), [(True, 0, 0), (False, 0, 1), (True, 1, 1)])
def test_figures_that_cannot_be_right_end_the_command_with_1(monkeypatch, agreed, flipped, code):
    """CI runs `numerics --quick`."""
    measured = {"records": [], "not_measured": {}, "claims": {"agreed": agreed, "flipped": flipped, "limit": 1e-9}}
    monkeypatch.setattr(comparison, "run_numerics", lambda **_: measured)
    assert run("bench", "numerics", "--quick").exit_code == code


def test_a_library_that_is_not_there_is_named_with_what_installs_it(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "flint" else found(name))
    monkeypatch.delitem(sys.modules, "examples.benchmarks.__main__", raising=False)
    app = runpy.run_module("examples.benchmarks.__main__")["app"]
    result = CliRunner().invoke(app, ["numerics"])
    assert result.exit_code == 1 and "[bench]" in result.stderr


def test_real_features(real_data):
    from examples.benchmarks.numerics.recorded import real_memory

    memory = real_memory("roboskin", real_data, 0, 64, 60)
    fresh, grid = measure_learned(memory)
    assert fresh["answers_error"] < 1e-12
    assert grid["answers_error"] < 1e-4
    assert fresh["flipped"] == grid["flipped"] == 0
    assert measure(as_case(memory, fresh["penalty"]), "exact", 0)["weights_error"] < 2.0**-52
