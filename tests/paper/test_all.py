"""`python -m examples.paper all`: every result by its noted command, whatever ended the run before."""

import json
from pathlib import Path

import pytest
from commands import refused, run
from paper_touches import recorded

from examples.paper.runs import everything
from examples.paper.runs.everything import Part, _left, read_parts
from examples.paper.runs.options import QUICK_EPOCHS, SETS
from examples.paper.studies.table1 import Table1
from examples.tables import main

TABLE1 = "python -m examples.paper table1 --data DATA --sets roboskin-20 --epochs 100 --seed 0 --run RUN"


def test_all_results_have_commands_and_those_that_take_least_come_first():
    parts = read_parts()
    assert {part.name for part in parts} == {file.stem for file in everything.RESULTS.glob("*.json")}
    known = [part.seconds for part in parts if part.seconds is not None]
    assert known == sorted(known) and all(part.commands for part in parts)


def test_time_left_goes_with_the_machine():
    parts = [Part("a", [], 100.0), Part("b", [], 600.0), Part("c", [], None)]
    assert _left(parts, {}) == ", about 12 min to go, and c, whose time is not noted"
    assert _left(parts, {"a": 300.0, "c": 1.0}) == ", about 30 min to go"


@pytest.fixture
def noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three results: of one command, of two of which the second adds a fold, and of one that needs weights."""
    folder = tmp_path / "noted"
    folder.mkdir()
    commands = {
        "first": f"{TABLE1} --systems svm-spikes --folds 0",
        "second": f"{TABLE1} --systems svm --folds 0 && {TABLE1} --systems svm --folds 0,1",
        "third": f"{TABLE1} --systems vision-lda --weights w.pth --folds 0",
    }
    for i, (name, command) in enumerate(commands.items()):
        (folder / f"{name}.json").write_text(json.dumps({"command": command, "seconds": 200 * (i + 1)}))
    monkeypatch.setattr(everything, "RESULTS", folder)
    monkeypatch.setitem(SETS, "roboskin-20", lambda data, seed: recorded())
    return folder


@pytest.mark.usefixtures("noted")
class TestAll:
    def test_a_killed_run_goes_on_where_it_was(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
        words = ("all", "--data", tmp_path, "--run", tmp_path / "run")
        measure, asked = Table1._measure, []

        def killed(self: Table1, cell: object, progress: object) -> object:
            asked.append(cell.key)
            if len(asked) == 3:
                raise KeyboardInterrupt
            return measure(self, cell, progress)

        monkeypatch.setattr(Table1, "_measure", killed)
        begun = run(*words)
        assert begun.exit_code == 130, begun.output
        assert "left out: third" in begun.output and "2 results, about 10 min to go" in begun.output
        assert sorted(file.name for file in (tmp_path / "run" / "results").glob("*.json")) == [
            "first.json",
            "second.json",
        ]
        result = run(*words)
        assert result.exit_code == 0, result.output
        cells = ["fold 0, svm-spikes", "fold 0, svm", "fold 1, svm", "fold 1, svm"]  # each once, but the killed one
        assert asked == [f"RoboSkin-20, {cell}" for cell in cells]
        kept = json.loads((tmp_path / "run" / "results" / "second.json").read_text())
        assert kept["rows"][0]["sets"]["RoboSkin-20"]["folds"] == 2
        assert run(*words).exit_code == 0 and len(asked) == 4

    def test_a_quick_one_is_one_fold_and_a_failed_part_is_named_at_the_end(self, tmp_path: Path, capsys):
        run_folder = tmp_path / "run"
        words = ("all", "--data", tmp_path, "--run", run_folder, "--quick")
        result = run(*words, "--weights", Path(__file__))
        assert result.exit_code == 1 and "not made: third" in result.stderr.splitlines()[-1]
        kept = json.loads((run_folder / "results" / "second.json").read_text())
        assert kept["quick"] and kept["epochs"] == QUICK_EPOCHS
        assert "other weights" in refused(*words)
        assert "first, second, third; came fourth" in refused(*words[:-2], tmp_path / "b", "--only", "fourth")

    def test_tables_are_made_of_what_it_made(self, tmp_path: Path, capsys, noted: Path):
        (noted / "first.json").rename(noted / "table1.json")
        run_folder = tmp_path / "run"
        result = run("all", "--data", tmp_path, "--run", run_folder, "--only", "table1")
        assert result.exit_code == 0, result.output
        capsys.readouterr()
        main(["table1", "--results", str(run_folder), "--format", "csv"])
        assert "SVM on spikes,,,,63.3,75.0" in capsys.readouterr().out
