"""`benchmarks numerics`: its truths, its cases, what it measures and what it shows."""

import json
from fractions import Fraction
from pathlib import Path

import mpmath
import numpy as np
import pytest
from commands import refused, run

from examples.benchmarks.numerics import comparison
from examples.benchmarks.numerics.cases import FAMILIES, Case, make_cases
from examples.benchmarks.numerics.comparison import find_nist
from examples.benchmarks.numerics.long_runs import run_schedules, run_updates
from examples.benchmarks.numerics.measures import bars, error_of, measure
from examples.benchmarks.numerics.plots_numerics import NO_ANSWER, draw_numerics, points
from examples.benchmarks.numerics.recorded import digits, nist_cases
from examples.benchmarks.numerics.truth import TruthError, exact_weights, refined_weights
from examples.benchmarks.solvers.methods import SOLVERS
from scroll_tactile.errors import DatasetError, InputError

SIZE = 0.05  # of the report's cases
RNG = np.random.default_rng(0)
ROWS, TARGETS = RNG.normal(size=(40, 6)), RNG.normal(size=(40, 2))


def true(rows, targets, penalty):
    with mpmath.workdps(80):
        x, y = mpmath.matrix(rows.tolist()), mpmath.matrix(targets.tolist())
        system = x.T * x + mpmath.mpf(penalty) * mpmath.eye(x.cols)
        return [mpmath.lu_solve(system, x.T * y[:, c]) for c in range(y.cols)]


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
        agree(exact_weights(rows, TARGETS, penalty), true(rows, TARGETS, penalty), 1e-18)

    @pytest.mark.parametrize("penalty", [1e-12, 1e-3, 1e3])
    def test_refined_weights_are_the_truth(self, penalty):
        agree(refined_weights(ROWS, TARGETS, penalty), true(ROWS, TARGETS, penalty), 1e-18)

    def test_repeated_rows_count_so_often(self):
        many = exact_weights(np.tile(ROWS, (7, 1)), np.tile(TARGETS, (7, 1)), 0.5)
        assert np.array_equal(many, exact_weights(ROWS, TARGETS, 0.5, repeats=7))

    def test_of_a_singular_system_it_is_the_smallest(self):
        rows = np.rint(ROWS[:4] * 8)
        assert np.allclose(exact_weights(rows, TARGETS[:4], 0.0).astype(float), np.linalg.pinv(rows) @ TARGETS[:4])
        assert not exact_weights(np.zeros((2, 3)), np.ones((2, 1)), 0.0).any()

    def test_what_qr_cannot_verify_is_not_claimed(self):
        with pytest.raises(TruthError, match="ill conditioned"):
            refined_weights(ROWS * np.logspace(0, -14, 6), TARGETS, 1e-40)


class TestCases:
    def test_names_are_unique_and_families_all_there(self):
        cases = list(make_cases(0, 0.05))
        assert len({case.name for case in cases}) == len(cases)
        assert {case.family for case in cases} == set(FAMILIES)

    def test_a_seed_makes_the_same_cases_again_and_another_others(self):
        first, again, other = (list(make_cases(seed, 0.05)) for seed in (3, 3, 4))
        assert all(a.rows.tobytes() == b.rows.tobytes() for a, b in zip(first, again, strict=True))
        assert first[0].rows.tobytes() != other[0].rows.tobytes()


class TestMeasuring:
    def test_refusals_are_records_too(self):
        rows = np.c_[ROWS, np.zeros(40)]
        case = Case("c", "f", rows, TARGETS, 0.0)
        said = {method: measure(case, method, 0) for method in SOLVERS}
        assert said["covariance"]["diagnosis"] == "needs λ > 0"
        assert said["covariance"]["seconds_per_row"] is None
        for method in ("qr", "gram64", "gram32"):
            assert said[method]["relative_error"] is None
            assert "refused" in said[method]["diagnosis"]
        assert said["exact"]["relative_error"] < 1e-15
        assert "column 6 is zero" in said["exact"]["diagnosis"]

    def test_an_error_is_relative_and_counts_by_the_columns_sizes(self):
        truth = np.array([[1.0], [1e6]], dtype=np.longdouble)
        assert error_of(np.array([[1.0], [2e6]]), truth, np.array([1.0, 1e-6])) == pytest.approx(np.sqrt(0.5))
        assert error_of(np.full((2, 1), 1e308), np.full((2, 1), 1e-10, dtype=np.longdouble), np.ones(2)) is None
        assert error_of(np.zeros((2, 1)), np.zeros((2, 1), dtype=np.longdouble), np.ones(2)) == 0

    def test_a_bar_is_met_within_ten_times_or_by_name(self):
        def one(case, method, error, diagnosis="sound: x"):
            return {"case": case, "method": method, "relative_error": error, "diagnosis": diagnosis}

        records = [one("a", "qr", 1e-12), one("a", "exact", 9e-12), one("b", "qr", 1e-12), one("b", "exact", 2e-11)]
        records += [one("c", "qr", 1e-12), one("c", "exact", 1.0, "singular: …"), one("d", "qr", 1e-19)]
        records += [one("d", "exact", 1e-16), one("e", "qr", None), one("e", "exact", None)]
        judged = bars(records)
        assert {entry["case"]: entry["met"] for entry in judged} == {"a": True, "b": False, "c": True, "d": True}
        assert [entry["within_ten"] for entry in judged] == [True, False, False, True]

    def test_updates_are_measured_at_each_power_of_ten(self):
        found = list(run_updates(0, 8, {"exact": 10_000, "gram64": 1000}, lambda _: None))
        assert [(one["method"], one["rows"]) for one in found] == [("exact", 1000), ("exact", 10_000), ("gram64", 1000)]
        assert all(one["relative_error"] < 1e-11 for one in found)
        assert found[1]["relative_error"] < 2.0**-52
        assert found[1]["case"] == "1e4 one-row updates, d=8"

    def test_schedules_count_what_differs(self):
        found = {
            one["method"]: one["differing"] for one in run_schedules(0, ("exact", "gram64"), 10, 8, lambda _: None)
        }
        assert found["exact"] == 0
        assert found["gram64"] > 5


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
    assert one["relative_error"] <= 2.0**-52


def test_digits():
    certified = np.array([1.0, 100.0])
    assert digits(np.array([[1.0], [100.0]]), certified) == 15
    assert digits(np.array([[1.0], [100.1]]), certified) == pytest.approx(3)
    assert digits(np.array([[np.nan], [1.0]]), certified) == 0
    assert digits(np.array([[-7.0], [1.0]]), certified) == 0


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


def test_powers_are_rounded_once(nist):
    case = next(one for one in nist_cases(nist) if one.name == "Filip")
    first = json.loads(nist.read_text())["Filip"]["x"][0]
    assert case.rows[0, 10] == float(Fraction(first) ** 10)


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("numerics")
    with pytest.MonkeyPatch.context() as smaller:
        smaller.setattr(comparison, "QUICK", SIZE)
        smaller.setattr(comparison, "QUICK_UPDATES", {8: dict.fromkeys(SOLVERS, 1000)})
        result = run("bench", "numerics", "--quick", "--json", folder / "n.json", "--plot", folder / "n.png")
    assert result.exit_code == 0, result.output
    return folder, result.output


def test_the_command_measures_every_case_with_every_method(quick):
    folder, said = quick
    result = json.loads((folder / "n.json").read_text())
    wanted = {"case", "family", "method", "relative_error", "flipped", "seconds_per_row", "diagnosis"}
    assert all(wanted <= one.keys() for one in result["records"])
    assert {"command", "date", "versions", "machine", "seed"} <= result.keys()
    for case in make_cases(0, SIZE):
        assert {one["method"] for one in result["records"] if one["case"] == case.name} == set(SOLVERS)
    assert all(bar["met"] for bar in result["bars"])
    exact = [one for one in result["records"] if one["method"] == "exact" and one["relative_error"] is not None]
    assert max(one["relative_error"] for one in exact) < 1e-15
    assert all(one["differing"] == 0 for one in result["records"] if "differing" in one and one["method"] == "exact")
    assert "Hilbert" in said
    assert "not measured: biotac" in said
    assert (folder / "n.png").read_bytes().startswith(b"\x89PNG")


def test_what_cannot_be_written_is_refused_before_anything_is_measured(tmp_path):
    assert "folder" in refused("bench", "numerics", "--quick", "--json", tmp_path / "none" / "n.json")
    assert "folder" in refused("bench", "numerics", "--quick", "--plot", tmp_path / "none" / "n.png")


def test_a_library_that_is_not_there_is_named_with_what_installs_it(monkeypatch):
    monkeypatch.setattr("examples.benchmarks.__main__.find_spec", lambda name: None)
    assert 'pip install "scroll-tactile[bench]"' in refused("bench", "numerics", "--quick")


def test_real_features(real_data):
    from examples.benchmarks.numerics.recorded import real_case

    case = real_case("roboskin", real_data, 0, 64, 60)
    one = measure(case, "exact", 0)
    assert one["relative_error"] < 2.0**-52
    assert one["flipped"] == 0
    # A memory's codes: the grid of 20 bits changes nothing.
    assert measure(case, "exact20", 0)["relative_error"] == one["relative_error"]


def test_points_of_the_picture(tmp_path):
    def one(method, family, error, seconds):
        return {"method": method, "family": family, "relative_error": error, "seconds_per_row": seconds}

    records = [one("qr", "a", 1e-9, 1e-6), one("qr", "a", 1e-8, 3e-6), one("qr", "b", None, 1e-6)]
    records += [one("exact", "a", 0.0, 2e-6), one("covariance", "a", None, None)]
    found = points(records)
    assert found == [("qr", "a", 2e-6, 1e-8), ("qr", "b", 1e-6, NO_ANSWER), ("exact", "a", 2e-6, 1e-17)]
    with pytest.raises(InputError, match="cannot be written"):
        draw_numerics(tmp_path / "p.odd", records, title="t")
