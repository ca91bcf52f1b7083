"""The continual pipeline and its command, on simulated touches; a tiny part of the real ones where they are at hand."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from commands import refused, run
from paper_touches import recorded, untimed

from examples.paper.commands.continual_command import parse_sizes
from examples.paper.readers.labelled import Recordings
from examples.paper.studies.continual import accuracy_of, curve, forgetting, forgetting_of, summary, tally
from examples.paper.studies.continual_study import Continual
from examples.paper.studies.schedules import part_ends
from scroll_tactile import Kernels, sensors
from scroll_tactile.errors import InputError

SMALL: dict[str, Any] = {"sizes": (0, 8, "all"), "epochs": 1}


@pytest.fixture(scope="module")
def recordings() -> Recordings:
    """Four materials under a simulated RoboSkin, eight touches each, in two folds."""
    return recorded(sensors.ROBOSKIN, materials=4, each=8, folds=2, name="simulated")


@pytest.fixture(scope="module")
def whole(recordings: Recordings) -> list[dict[str, Any]]:
    return list(Continual(recordings, Kernels(dimension=64), **SMALL).run([0, 1]))


class TestForgetting:
    def test_by_hand(self) -> None:
        moments = [{"a": 1.0}, {"a": 0.5, "b": 0.75}, {"a": 0.75, "b": 0.25, "c": 1.0}]
        assert forgetting(moments) == pytest.approx(((1 - 0.75) + (0.75 - 0.25)) / 2)

    def test_one_moment_has_none(self) -> None:
        assert forgetting([{"a": 0.5}]) is None
        with pytest.raises(InputError, match="came none"):
            forgetting([])
        with pytest.raises(InputError, match="'a'"):
            forgetting([{"a": 0.5}, {"b": 0.5}])

    def test_counts_are_put_in_the_order_of_learning(self) -> None:
        points = {"10": {"a": [1, 2], "b": [2, 2]}, "9": {"a": [2, 2]}}
        assert forgetting_of(points) == 0.5
        assert curve(points) == [[1, 1.0], [2, 0.75]]
        assert accuracy_of(points["10"]) == 0.75

    def test_tally(self) -> None:
        assert tally(["a", "b", "a"], ["a", None, "b"]) == {"a": [1, 2], "b": [0, 1]}
        with pytest.raises(InputError, match="as many"):
            tally(["a"], [])


def test_parts_end_with_a_material_or_are_equally_long() -> None:
    assert part_ends("class-by-class", ["b", "b", "b", "a", "c", "c"]) == [3, 4, 6]
    assert part_ends("shuffled", ["b", "a", "b", "c", "a", "c", "b"]) == [2, 5, 7]


class TestContinual:
    def test_a_fold_has_all_figures(self, whole: list[dict[str, Any]]) -> None:
        fold = whole[1]
        assert (fold["fold"], fold["learned"], fold["tested"]) == (1, 16, 16)
        assert fold["equals_offline"]
        assert [met for met, _ in fold["f"]["curve"]] == [1, 2, 3, 4]
        assert fold["f"]["curve"][-1][1] == fold["f"]["accuracy"] > 0.7
        assert 0 <= fold["f"]["forgetting"] <= 1
        assert fold["ridge"] > 0.7
        assert list(fold["tuned"]) == ["0", "8", "all"]
        assert json.loads(json.dumps(fold)) == fold

    def test_without_exemplars_f_answers(self, whole: list[dict[str, Any]]) -> None:
        none = whole[0]["tuned"]["0"]
        assert (none["kept"], none["exemplars"], none["accuracy"]) == (False, 0, whole[0]["f"]["accuracy"])

    def test_a_buffer_is_of_its_size_and_of_no_order(self, whole: list[dict[str, Any]]) -> None:
        for fold in whole:
            small, large = fold["tuned"]["8"], fold["tuned"]["all"]
            assert (small["exemplars"], large["exemplars"]) == (8, 16)
            assert small["buffer_of_another_order"] and large["buffer_of_another_order"]
            assert small["buffer_digest"] != large["buffer_digest"]
            assert small["bytes_per_exemplar"] == 75 * 60 * 4
            for part in (small, large):
                assert part["accuracy"] >= 0.5
                assert isinstance(part["reason"], str)
                assert part["kept"] or part["accuracy"] == fold["f"]["accuracy"]

    def test_peers_are_there_for_each_size_and_beat_chance(self, whole: list[dict[str, Any]]) -> None:
        peers = whole[0]["peers"]
        assert [(peer["peer"], peer["size"]) for peer in peers] == [
            ("nearest mean", None),
            ("streaming LDA", None),
            ("RanPAC", None),
            ("naive fine-tuning", None),
            ("GDumb", "8"),
            ("experience replay", "8"),
            ("GDumb", "all"),
            ("experience replay", "all"),
        ]
        for peer in peers:
            assert [met for met, _ in peer["curve"]] == [1, 2, 3, 4]
            if peer["peer"] != "naive fine-tuning":
                assert peer["accuracy"] > 0.4, peer

    def test_an_interrupted_run_goes_on_to_the_same_figures(
        self, recordings: Recordings, whole: list[dict[str, Any]], tmp_path: Path
    ) -> None:
        task = Continual(recordings, Kernels(dimension=64), **SMALL, folder=tmp_path / "kept")
        reported: list[str] = []
        for stop in ("f: learning", "fine-tuning", "RanPAC"):

            def interrupt(what: str, done: int, of: int, stop: str = stop) -> None:
                reported.append(what)
                if stop in what and (stop != "f: learning" or done == 10):
                    raise KeyboardInterrupt

            with pytest.raises(KeyboardInterrupt):
                list(task.run([0, 1], interrupt))
        resumed = list(task.run([0, 1], lambda what, done, of: reported.append(what)))
        assert untimed(resumed) == untimed(whole)
        assert reported.count("offline: learning") == 2 * 16  # once in each fold
        reported.clear()
        assert untimed(list(task.run([0, 1], lambda what, done, of: reported.append(what)))) == untimed(whole)
        assert reported == []
        with pytest.raises(InputError, match="seed 0 there, 1 here"):
            list(Continual(recordings, Kernels(dimension=64), seed=1, **SMALL, folder=tmp_path / "kept").run([0]))

    def test_the_order_changes_neither_f_nor_its_buffer_nor_f_star(
        self, recordings: Recordings, whole: list[dict[str, Any]]
    ) -> None:
        task = Continual(recordings, Kernels(dimension=64), "shuffled", sizes=(8,), epochs=1, peers=False, curve=2)
        (fold,) = task.run([0])
        assert fold["digest"] == whole[0]["digest"]
        for name in ("buffer_digest", "tuned_digest", "accuracy"):
            assert fold["tuned"]["8"][name] == whole[0]["tuned"]["8"][name]
        assert fold["peers"] == []

    def test_f_star_can_be_measured_on_the_way(self, recordings: Recordings, whole: list[dict[str, Any]]) -> None:
        task = Continual(recordings, Kernels(dimension=64), sizes=(8,), epochs=1, peers=False, tuned_curve=True)
        (fold,) = task.run([0])
        tuned = fold["tuned"]["8"]
        assert [met for met, _ in tuned["curve"]] == [1, 2, 3, 4]
        assert tuned["forgetting"] is not None
        # What was tuned on the way leaves no trace in the last one.
        assert tuned["tuned_digest"] == whole[0]["tuned"]["8"]["tuned_digest"]

    def test_what_cannot_be_is_refused(self, recordings: Recordings) -> None:
        embedding = Kernels(dimension=64)
        with pytest.raises(InputError, match="each of the 4 materials at least; came 3"):
            Continual(recordings, embedding, sizes=(0, 3))
        with pytest.raises(InputError, match="came -1"):
            Continual(recordings, embedding, sizes=(-1,))
        with pytest.raises(InputError, match="size"):
            Continual(recordings, embedding, sizes=())
        with pytest.raises(InputError, match="curve"):
            Continual(recordings, embedding, curve=-1)
        with pytest.raises(InputError, match="folds out of"):
            list(Continual(recordings, embedding).run([2]))

    def test_a_summary_has_a_row_for_each_method_and_size(self, whole: list[dict[str, Any]]) -> None:
        rows = summary(whole)
        assert [(row["method"], row["size"]) for row in rows[:5]] == [
            ("f", None),
            ("f*", "0"),
            ("f*", "8"),
            ("f*", "all"),
            ("ridge", None),
        ]
        mean = (whole[0]["f"]["accuracy"] + whole[1]["f"]["accuracy"]) / 2
        assert rows[0]["accuracy"]["mean"] == pytest.approx(mean)
        assert (rows[2]["forgetting"], rows[2]["exemplars"]["mean"]) == (None, 8)
        assert summary([]) == []


class TestCommand:
    @pytest.fixture
    def simulated(self, recordings: Recordings, monkeypatch: pytest.MonkeyPatch) -> list[object]:
        module = sys.modules[
            "examples.paper.commands.continual_command"
        ]  # by its dotted name the command itself is found
        monkeypatch.setattr(module, "read", lambda dataset, data, seed: recordings)
        return ["continual", "roboskin-20", "--data", "simulated", "--features", 64, "--sizes", "0,8", "--epochs", 1]

    def test_it_measures_writes_and_draws(self, simulated: list[object], tmp_path: Path) -> None:
        files = ["--json", tmp_path / "r.json", "--plot", tmp_path / "p.png", "--run", tmp_path / "kept"]
        result = run(*simulated, *files)
        assert result.exit_code == 0, result.output
        for words in ("streaming LDA", "f*", "ridge", "f equals offline training: yes", "another order: yes"):
            assert words in result.stdout
        found = json.loads((tmp_path / "r.json").read_text())
        assert found["command"].startswith(
            "python -m examples.paper continual roboskin-20 --data DATA --embedding kernels"
        )
        assert {"versions", "date", "machine", "seed", "sensor", "means"} <= set(found)
        assert found["embedding"]["dimension"] == 64
        assert len(found["folds"]) == 2
        pytest.importorskip("matplotlib")
        assert (tmp_path / "p.png").read_bytes()[:4] == b"\x89PNG"
        again = run(*simulated, "--run", tmp_path / "kept", "--no-peers", "--json", tmp_path / "again.json")
        assert again.exit_code == 0, again.output
        assert "streaming LDA" not in again.stdout
        kept = json.loads((tmp_path / "again.json").read_text())["folds"]
        assert [fold["tuned"] for fold in kept] == [fold["tuned"] for fold in found["folds"]]

    def test_errors_are_one_line(self, simulated: list[object], tmp_path: Path) -> None:
        assert "each of the 4 materials" in refused(*simulated, "--sizes", "0,3")
        assert "came '20,many'" in refused(*simulated, "--sizes", "20,many")
        assert "needs --weights" in refused(*simulated, "--embedding", "vision")
        assert "has no weights" in refused(*simulated, "--weights", "resnet18")
        assert "or as module:factory; came 'sound'" in refused(*simulated, "--embedding", "sound")
        assert "has no Missing" in refused(*simulated, "--embedding", "examples.own_system:Missing")
        assert "none.pth" in refused(*simulated, "--embedding", "vision", "--weights", tmp_path / "none.pth")
        assert "folder that exists" in refused(*simulated, "--json", tmp_path / "none" / "r.json")
        assert "--folds" in refused(*simulated, "--folds", "first")
        assert run(*simulated, "--schedule", "backwards").exit_code == 2

    def test_an_embedding_of_ones_own(self, simulated: list[object], tmp_path: Path) -> None:
        own = ("--embedding", "examples.own_system:Strengths", "--json", tmp_path / "own.json")
        result = run(*simulated, "--sizes", 0, "--curve", 0, "--no-peers", *own)
        assert result.exit_code == 0, result.output
        assert json.loads((tmp_path / "own.json").read_text())["embedding"]["dimension"] == 32

    def test_sizes(self) -> None:
        assert parse_sizes("0, 20,all,20") == (0, 20, "all")
        for text in ("", "-1", "1.5", "20,", "ALL", "²"):
            with pytest.raises(InputError, match="--sizes"):
                parse_sizes(text)

    def test_a_few_real_touches(self, real_data: Path, tmp_path: Path) -> None:
        options = ["--data", real_data, "--folds", "0", "--materials", 2, "--features", 64, "--sizes", 0, "--curve", 0]
        result = run("continual", "roboskin-20", *options, "--json", tmp_path / "r.json")
        assert result.exit_code == 0, result.output
        (fold,) = json.loads((tmp_path / "r.json").read_text())["folds"]
        assert (fold["learned"], fold["tested"], fold["equals_offline"]) == (80, 20, True)

    def test_a_quick_one_is_a_fold_of_every_fifth_touch(self, real_data: Path, tmp_path: Path) -> None:
        options = ["--data", real_data, "--quick", "--materials", 2, "--features", 64, "--sizes", 0, "--curve", 0]
        result = run("continual", "roboskin-20", *options, "--json", tmp_path / "r.json")
        assert result.exit_code == 0, result.output
        found = json.loads((tmp_path / "r.json").read_text())
        (fold,) = found["folds"]
        assert (fold["learned"], fold["tested"]) == (16, 4)
        assert "quick:" in result.output and "--quick" in found["command"]
