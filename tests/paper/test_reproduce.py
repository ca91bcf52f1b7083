"""Studies of systems, their resumption, and `python -m examples.paper`, on a few simulated touches."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import refused, run
from paper_touches import PATCH, recorded, untimed

from examples.paper.commands.options import SETS
from examples.paper.readers import physiclear
from examples.paper.readers.labelled import Recordings
from examples.paper.runs.cells import Cell, pooled, split, thinned, time_left
from examples.paper.runs.study import SystemStudy
from examples.paper.studies.table1 import PAPER, Table1, blocked, rows
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.errors import DatasetError, InputError

FEW: dict[str, Any] = {"systems": ("svm-spikes", "conv-lstm", "svm"), "epochs": 2}


@pytest.fixture(scope="module")
def recordings() -> Recordings:
    return recorded()


class TestSplit:
    def test_every_touch_is_learned_or_held_or_tested(self, recordings: Recordings):
        parts = split(recordings, 1, seed=0)
        assert (len(parts.streams), len(parts.validation), len(parts.test)) == (21, 3, 12)
        assert {name for name, _ in parts.validation} == set(recordings.materials)
        keys = [item.key for item in parts.streams] + [item.key for _, item in [*parts.validation, *parts.test]]
        assert sorted(keys) == sorted(stream.key for stream in recordings.streams)
        assert len(set(parts.touch)) == 12

    def test_the_seed_draws_the_validation_only(self, recordings: Recordings):
        held = [{item.key for _, item in split(recordings, 0, seed).validation} for seed in (0, 0, 1)]
        assert held[0] == held[1] != held[2]

    def test_a_quick_one_learns_every_second(self, recordings: Recordings):
        parts = split(recordings, 0, seed=0, every=2)
        assert (len(parts.streams), len(parts.validation), len(parts.test)) == (9, 3, 12)

    def test_a_thinned_set_has_a_fifth_of_each_material_in_each_fold(self):
        few = thinned(recorded(each=18, ordered=True), 5)
        assert [*zip(few.materials[:6], few.fold[:6].tolist(), strict=True)] == [
            (few.materials[0], fold) for fold in (0, 1, 2, 0, 1, 2)
        ]
        assert few.repetition[:6].tolist() == [0, 1, 2, 15, 16, 17] and len(few) == 18
        frames = recorded(materials=2, each=12)
        video = np.tile(np.repeat(np.arange(6), 2), 2)
        few = thinned(replace(frames, repetition=video, fold=video % 2), 5)
        assert few.repetition[:4].tolist() == [0, 0, 1, 1]

    def test_frames_of_a_video_are_not_parted(self):
        sets = recorded()
        # Four frames to a recording, three recordings of each material, each its own fold.
        video = np.tile(np.repeat(np.arange(3), 4), 3)
        parts = split(Recordings(sets.name, PATCH, sets.streams, sets.materials, video, video, False), 2, seed=0)
        assert len(parts.test) == 12 and len(set(parts.touch)) == 3
        assert len(parts.validation) == 0  # two recordings are too few to hold one out
        more = np.tile(np.repeat(np.arange(6), 2), 3)
        parts = split(Recordings(sets.name, PATCH, sets.streams, sets.materials, more, more // 2, False), 2, seed=0)
        held = {item.key for _, item in parts.validation}
        pairs = [{sets.streams[i].key, sets.streams[i + 1].key} for i in range(0, 36, 2)]
        assert len(held) == 6 and all(pair <= held or not pair & held for pair in pairs)

    def test_materials_that_no_other_fold_trains_are_named(self, recordings: Recordings):
        fold = np.repeat([0, 1, 2], 12)
        alone = Recordings("odd", PATCH, recordings.streams, recordings.materials, recordings.repetition, fold, False)
        with pytest.raises(InputError, match=r"'bark'.*never trained on"):
            split(alone, 0, seed=0)
        with pytest.raises(InputError, match=r"out of \[0, 1, 2\]; came 7"):
            split(recordings, 7, seed=0)


def test_folds_of_unequal_size_count_by_touches():
    assert pooled([{"right": 1, "tested": 1}, {"right": 0, "tested": 3}])["mean"] == 0.25


def test_time_left_is_that_of_the_same_system_where_it_is_known():
    cells = [Cell("a", 0, "slow"), Cell("a", 1, "slow"), Cell("b", 0, "slow"), Cell("a", 0, "quick")]
    assert time_left({}, cells) == ""
    assert time_left({cells[0]: 30.0}, cells[1:2]) == ", about 30 s left"
    assert time_left({cells[0]: 240.0, cells[3]: 1.0}, cells) == ", about 8 min left"


@pytest.fixture(scope="module")
def whole(recordings: Recordings) -> list[Any]:
    return list(Table1([recordings], **FEW).run({"RoboSkin-20": [0, 1]}))


class TestTable1:
    def test_cells_have_their_figures(self, whole: list[Any]):
        assert [cell.system for cell, _ in whole] == [key for key in FEW["systems"] for _ in range(2)]
        for cell, found in whole:
            assert 0 <= found["right"] <= found["tested"] == 12
            assert ("epochs" in found) == (cell.system == "conv-lstm")
        epochs = whole[2][1]["epochs"]
        assert len(epochs) == 2 and {"accuracy", "loss", "validation_loss", "rate"} == epochs[0].keys()

    def test_rows_stand_beside_the_papers(self, whole: list[Any]):
        found = {row["key"]: row for row in rows(whole)}["svm-spikes"]["sets"]["RoboSkin-20"]
        assert found["paper"] == PAPER["svm-spikes"]["RoboSkin-20"] == 0.633
        assert found["difference"] == pytest.approx(found["mean"] - 0.633)
        assert found["folds"] == 2
        # A network's accuracy after each epoch, over the folds: the first epochs are the curves of efficiency.
        network = {row["key"]: row for row in rows(whole)}["conv-lstm"]["sets"]["RoboSkin-20"]
        first = [figures["epochs"][0]["accuracy"] for cell, figures in whole if cell.system == "conv-lstm"]
        assert [point[0] for point in network["points"]] == [1, 2] and "points" not in found
        assert network["points"][0][1:] == [pytest.approx(np.mean(first)), pytest.approx(np.std(first, ddof=1))]
        # Blocked folds, and the control of random weights, are not in the paper.
        ours = {"right": 3, "tested": 4, "seconds": 1.0}
        cells = [Cell("BioTac-20 blocked", 0, "svm"), Cell("BioTac-20", 0, "least-squares-random")]
        for row in rows([(cell, ours) for cell in cells]):
            for alone in row["sets"].values():
                assert (alone["mean"], alone["paper"], alone["difference"]) == (0.75, None, None)

    def test_a_killed_run_goes_on_to_the_same_figures(self, recordings: Recordings, whole: list[Any], tmp_path: Path):
        cell = "fold 0, conv-lstm"

        def killed(what: str, done: int, of: int) -> None:
            if cell in what and "starting" not in what:
                raise KeyboardInterrupt

        study = Table1([recordings], **FEW, folder=tmp_path / "run")
        with pytest.raises(KeyboardInterrupt):
            list(study.run({"RoboSkin-20": [0, 1]}, killed))
        begun = json.loads((tmp_path / "run" / "table1.json").read_text())["notes"]
        kept = [key for key in begun if "fold" in key]
        assert kept and not any(cell in key for key in kept)
        again = list(Table1([recordings], **FEW, folder=tmp_path / "run").run({"RoboSkin-20": [0, 1]}))
        assert untimed([figures for _, figures in again]) == untimed([figures for _, figures in whole])
        done = {key: begun[key]["seconds"] for key in kept}
        assert {cell.key: f["seconds"] for cell, f in again if cell.key in done} == done  # not done again

    def test_other_settings_and_other_data_are_refused(self, recordings: Recordings, tmp_path: Path):
        folder = tmp_path / "run"
        folds = {"RoboSkin-20": [0]}
        list(Table1([recordings], ("svm-spikes",), folder=folder).run(folds))
        with pytest.raises(InputError, match="epochs 100 there, 5 here"):
            list(Table1([recordings], ("svm-spikes",), epochs=5, folder=folder).run(folds))
        with pytest.raises(InputError, match="other recordings or folds of RoboSkin-20"):
            list(Table1([recorded(seed=1)], ("svm-spikes",), folder=folder).run(folds))

    @pytest.mark.parametrize(
        ("wrong", "message"),
        [
            ({"systems": ("cnn",)}, "came cnn"),
            ({"systems": ("vision-lda",)}, "need the weights"),
            ({"systems": ("svm",), "epochs": 0}, "epochs"),
            ({"systems": ("svm",), "seed": -1}, "seed"),
        ],
    )
    def test_studies_that_cannot_be_are_refused(self, recordings: Recordings, wrong: dict[str, Any], message: str):
        with pytest.raises(InputError, match=message):
            SystemStudy([recordings], **wrong)
        with pytest.raises(InputError, match="different names"):
            SystemStudy([recordings, recordings], ("svm",))


@pytest.fixture
def patched(monkeypatch: pytest.MonkeyPatch) -> None:
    sets: dict[str, Callable[[Path, int], Recordings]] = {
        "biotac-20": lambda data, seed: recorded(name="BioTac-20", ordered=True),
        "biotac-20-blocked": lambda data, seed: blocked(recorded(name="BioTac-20", ordered=True)),
        "roboskin-20": lambda data, seed: recorded(),
        "roboskin-20-unmixed": lambda data, seed: recorded(name="RoboSkin-20, unmixed"),
    }
    for name, reader in sets.items():
        monkeypatch.setitem(SETS, name, reader)
    monkeypatch.setattr(
        "examples.paper.commands.strengths_command.read", lambda dataset, data, seed: sets[dataset.value](data, seed)
    )


@pytest.mark.usefixtures("patched")
class TestCommand:
    def test_table1_quick(self, tmp_path: Path):
        file = tmp_path / "table1.json"
        words = ("table1", "--data", tmp_path, "--systems", "svm,kernels-lda,conv-lstm", "--quick")
        result = run(*words, "--json", file, "--run", tmp_path / "run")
        assert result.exit_code == 0, result.output
        assert "94.2 %" in result.output and "50.5 %" in result.output and "BioTac-20 blocked" not in result.output
        assert "quick:" in result.output and "15 epochs where the paper has 100" in result.output
        kept = json.loads(file.read_text())
        assert {"command", "seed", "versions", "machine", "seconds", "device", "threads"} <= kept.keys()
        assert "snntorch" in kept["versions"]
        assert kept["command"].startswith("python -m examples.paper table1") and "--quick" in kept["command"]
        assert len(kept["cells"]) == 6
        assert len(kept["cells"]["RoboSkin-20, fold 0, conv-lstm"]["epochs"]) == 15
        assert kept["systems"]["svm"] == {"name": "SVM", "library": "scikit-learn"}
        assert {system["library"] for system in kept["systems"].values()} <= kept["versions"].keys()
        first = {row["key"]: row for row in kept["rows"]}["svm"]["sets"]["BioTac-20"]
        assert first["difference"] == pytest.approx(first["mean"] - 0.942)
        assert "epochs 15 there, 4 here" in refused(*words, "--epochs", "4", "--run", tmp_path / "run")

    def test_the_order_of_time_is_a_set_of_table1(self, tmp_path: Path):
        words = ("--systems", "svm-spikes", "--sets", "roboskin-20-unmixed", "--folds", "0", "--json", tmp_path / "a")
        result = run("table1", "--data", tmp_path, *words)
        assert result.exit_code == 0, result.output
        row = json.loads((tmp_path / "a").read_text())["rows"][0]["sets"]["RoboSkin-20, unmixed"]
        assert row["paper"] is None  # which is of the file as it is published

    def test_ones_own_stand_in_the_table_and_in_the_noted_command(self, tmp_path: Path):
        own = ("--system", "examples.own_system:NearestMean", "--embedding", "examples.own_system:Strengths")
        words = (
            "table1",
            "--data",
            tmp_path,
            "--systems",
            "svm-spikes",
            *own,
            "--quick",
            "--json",
            tmp_path / "a.json",
        )
        result = run(*words)
        assert result.exit_code == 0, result.output
        kept = json.loads((tmp_path / "a.json").read_text())
        keys = ["svm-spikes", own[1], f"{own[3]}-lda"]
        assert [row["key"] for row in kept["rows"]] == keys
        assert f"--systems {','.join(keys)} " in kept["command"]
        noted = kept["command"].split()[3:]
        again = run(*[tmp_path if word == "DATA" else word for word in noted], "--json", tmp_path / "b.json")
        assert again.exit_code == 0, again.output
        assert untimed(json.loads((tmp_path / "b.json").read_text())["rows"]) == untimed(kept["rows"])
        assert "no Missing" in refused("table1", "--data", tmp_path, "--system", "examples.own_system:Missing")
        robust = run("strengths", "dead", "--data", tmp_path, "--quick", "--systems", own[1])
        assert robust.exit_code == 0, robust.output

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (("table1", "--sets", "biotac-50", "--systems", "svm"), "biotac-20-blocked"),
            (("table1", "--systems", "cnn"), "least-squares-random"),
            (("table1", "--systems", "svm", "--sets", "roboskin-20", "--folds", "9"), "out of [0, 1, 2]"),
            (("table1", "--sets", "gelsight", "--systems", "svm"), "github.com/clear-nus/octopi"),
            (("table1", "--systems", "svm", "--json", "none/x.json"), "folder that exists"),
            (("strengths", "speed", "--systems", "least-squares"), "ours, svm, svm-spikes, conv-lstm, snn, resnet"),
            (("strengths", "speed", "--systems", "resnet-pretrained"), "give --weights"),
            (("strengths", "speed", "--systems", "svm", "--sets", "roboskin-20", "--folds", "9"), "out of [0, 1, 2]"),
        ],
    )
    def test_what_cannot_be_is_one_red_line(self, tmp_path: Path, words: tuple[str, ...], message: str):
        assert message in refused(*words, "--data", tmp_path)

    def test_efficiency_draws(self, tmp_path: Path):
        pytest.importorskip("matplotlib")
        words = ("efficiency", "--data", tmp_path, "--systems", "conv-lstm,kernels-lda", "--folds", "0")
        plot, file = tmp_path / "curves.png", tmp_path / "curves.json"
        result = run(*words, "--epochs", 2, "--plot", plot, "--json", file)
        assert result.exit_code == 0, result.output
        assert plot.stat().st_size > 10_000
        found = json.loads(file.read_text())["curves"]
        assert [
            (curve["by"], [point[0] for point in curve["points"]]) for curve in found if "Robo" in curve["dataset"]
        ] == [
            ("epochs", [1, 2]),
            ("streams", [1, 2, 5]),  # of eight
        ]
        assert len(found) == 4 and all(0 <= mean <= 1 for curve in found for _, mean, _ in curve["points"])

    def test_activation_compares_and_draws_and_goes_on_where_it_was(self, tmp_path: Path):
        pytest.importorskip("matplotlib")
        safetensors = pytest.importorskip("safetensors.torch")
        weights, folder, plot = tmp_path / "w.safetensors", tmp_path / "run", tmp_path / "a.png"
        safetensors.save_file(ResNet.random(4).state_dict(), weights)
        words = ("activation", "--data", tmp_path, "--quick", "--epochs", 1, "--run", folder)
        assert "expected --weights" in refused(*words)
        files = [tmp_path / "one.json", tmp_path / "two.json"]
        for file, drawn in zip(files, (["--plot", plot], []), strict=True):
            result = run(*words, "--weights", weights, "--json", file, *drawn)
            assert result.exit_code == 0, result.output
        once, again = (json.loads(file.read_text()) for file in files)
        assert once["likeness"] == again["likeness"] and once["cells"] == again["cells"]
        pairs = {(pair["one"], pair["two"]): pair for pair in once["likeness"]}
        assert len(pairs) == 6
        tuned = ("fine-tuned on BioTac-20", "fine-tuned on RoboSkin-20")
        assert pairs["pre-trained", tuned[0]]["filters"] > 0.9 > pairs["pre-trained", "random weights"]["filters"]
        assert 0 < pairs[tuned]["moved"] <= 1 and pairs[tuned]["blocks"] > 0.5
        assert plot.read_bytes().startswith(b"\x89PNG")
        (folder / "activation BioTac-20.npz").unlink()
        assert "first layers cannot be read" in refused(*words, "--weights", weights)

    def test_noise_is_measured_of_the_papers_systems_and_ours(self, tmp_path: Path):
        pytest.importorskip("matplotlib")
        file = tmp_path / "noise.json"
        words = ("strengths", "noise", "--data", tmp_path, "--quick", "--epochs", 1, "--run", tmp_path / "run")
        result = run(*words, "--systems", "svm,conv-lstm", "--json", file, "--plot", tmp_path / "noise.png")
        assert result.exit_code == 0, result.output
        assert "73.0 %" in result.output and "80.0 %" in result.output
        kept = json.loads(file.read_text())
        assert kept["command"].startswith("python -m examples.paper strengths noise --data DATA --sets biotac-20,")
        means = {(item["dataset"], item["strength"], item["system"], item["augmented"]): item for item in kept["means"]}
        assert len(means) == 16
        assert means["RoboSkin-20", 0.0, "svm", False]["mean"] > 0.5  # of three materials
        assert kept["sets"]["RoboSkin-20"]["settings"]["conv-lstm"]["epochs"] == 1
        assert (tmp_path / "noise-biotac-20.png").is_file() and (tmp_path / "noise-roboskin-20.png").is_file()
        # Another system can join the run; the same with other settings cannot.
        assert run(*words, "--systems", "svm,svm-spikes").exit_code == 0
        again = refused(*words[:6], 2, *words[7:], "--systems", "conv-lstm")
        assert "other settings of conv-lstm" in again and "'epochs': 2" in again


class TestPhysiclear:
    def test_frames_are_streams_and_videos_are_not_parted(self, gelsight: Path):
        read = physiclear.load(gelsight)
        assert len(read) == 36 and set(read.materials) == {"apple", "pen", "rug"}
        assert read.streams[0].readings.shape == (1, 120, 160, 3)
        assert abs(float(read.streams[0].readings[0, 60, 6, 0]) - 100) < 20
        for name in ("apple", "pen", "rug"):
            videos: dict[int, set[int]] = {}
            for material, video, fold in zip(read.materials, read.repetition.tolist(), read.fold.tolist(), strict=True):
                if material == name:
                    videos.setdefault(video, set()).add(fold)
            assert videos.keys() == {0, 3, 5}
            assert all(len(folds) == 1 for folds in videos.values())
        assert physiclear.load(gelsight / "physiclear", seed=1).fold.tolist() != read.fold.tolist()

    def test_a_study_votes_by_video_and_runs_what_reads_frames(self, gelsight: Path):
        read = physiclear.load(gelsight)
        study = Table1([read], ("svm", "kernels-lda"), epochs=1)
        results = list(study.run({read.name: [read.fold[0]]}))
        assert [cell.system for cell, _ in results] == ["kernels-lda"]
        assert results[0][1]["recordings"] == results[0][1]["tested"] // 4
        assert rows(results)[0]["sets"][read.name]["vote"] == 1.0

    def test_what_is_missing_or_damaged_is_named(self, gelsight: Path):
        apple = gelsight / "physiclear" / "apple"
        (apple / "apple_3_2.jpg").rename(apple / "kept")
        with pytest.raises(DatasetError, match="it also holds kept"):
            physiclear.load(gelsight)
        kept = (apple / "kept").read_bytes()
        (apple / "kept").unlink()
        with pytest.raises(DatasetError, match=r"expected .*apple_3_2\.jpg; it is missing.*octopi"):
            physiclear.load(gelsight)
        pytest.importorskip("PIL.Image").new("RGB", (64, 48)).save(apple / "apple_3_2.jpg")
        with pytest.raises(DatasetError, match=r"320 × 240.*64 × 48"):
            physiclear.load(gelsight)
        (apple / "apple_3_2.jpg").write_bytes(kept[:200])
        with pytest.raises(DatasetError, match=r"apple_3_2\.jpg; it cannot be read"):
            physiclear.load(gelsight)
        for path in apple.glob("apple_[35]_*.jpg"):
            path.unlink()
        with pytest.raises(DatasetError, match="two videos or more"):
            physiclear.load(gelsight)
