"""Metrics, passes, notes of runs, stream files, the demonstration and replays, on simulated touches."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from examples.paper.plots.drawing import confusion_counts
from examples.paper.runs.runfile import RunFile
from examples.paper.studies.replay import Replay, subset, summary
from scroll_tactile import Kernels, TactileLearner, sensors
from scroll_tactile.datasets import Recordings
from scroll_tactile.datasets.simulator import Scene
from scroll_tactile.errors import DatasetError, InputError
from scroll_tactile.pipelines.classification import missing
from scroll_tactile.pipelines.demo import Demo
from scroll_tactile.pipelines.memories import open_memory
from scroll_tactile.pipelines.metrics import accuracy, auroc, calibration_error, mean_and_spread
from scroll_tactile.recordings.arrays import read_sensor, read_stream


class TestMetrics:
    def test_accuracy_is_the_share_of_right_answers(self) -> None:
        assert accuracy(["a", "b", "c", "d"], ["a", "b", "c", None]) == 0.75

    def test_calibration_error_of_a_case_worked_by_hand(self) -> None:
        # Two bins: 0.25 and 0.5 fall into (0, ½], half right: |0.5 − 0.375|; 0.75 and 1 into (½, 1], both right.
        assert calibration_error([0.25, 0.5, 0.75, 1.0], [1, 0, 1, 1], bins=2) == pytest.approx(
            (2 * 0.125 + 2 * 0.125) / 4
        )

    def test_certain_and_right_is_calibrated_and_zero_has_a_bin(self) -> None:
        assert calibration_error([1.0, 1.0], [1, 1]) == 0.0
        assert calibration_error([0.0], [0]) == 0.0

    def test_auroc_counts_ties_half(self) -> None:
        assert auroc([3, 2], [1, 0]) == 1.0
        assert auroc([0], [1]) == 0.0
        assert auroc([1, 1], [1, 1]) == 0.5
        assert auroc([math.inf, 1], [1, 0]) == pytest.approx(3.5 / 4)

    @pytest.mark.parametrize("seed", range(5))
    def test_auroc_is_scikit_learns(self, seed: int) -> None:
        metrics = pytest.importorskip("sklearn.metrics")
        random = np.random.default_rng(seed)
        scores = random.integers(0, 20, 200) / 7  # many ties
        labels = random.random(200) < 0.3
        assert auroc(scores[labels], scores[~labels]) == pytest.approx(metrics.roc_auc_score(labels, scores))

    def test_mean_and_spread(self) -> None:
        assert mean_and_spread([1.0, 3.0]) == (2.0, pytest.approx(math.sqrt(2)))
        assert mean_and_spread([0.5]) == (0.5, 0.0)

    def test_nothing_to_measure_is_refused(self) -> None:
        for call in (lambda: accuracy([], []), lambda: auroc([], [1]), lambda: calibration_error([0.5], [])):
            with pytest.raises(InputError):
                call()
        with pytest.raises(InputError, match="probabilities"):
            calibration_error([1.5], [1])


TOUCHES = [(name, Scene(sensors.BIOTAC).touch(name, at)) for name in ("silk", "wool") for at in range(3)]


class TestMissing:
    def test_the_first_few_of_every_material_are_there(self) -> None:
        assert missing(TOUCHES, {"silk": 3, "wool": 1}) == TOUCHES[4:]
        assert missing(TOUCHES, {}) == TOUCHES

    def test_a_memory_of_something_else_is_refused(self) -> None:
        with pytest.raises(InputError, match="'oak': 1"):
            missing(TOUCHES, {"oak": 1})
        with pytest.raises(InputError, match="'silk': 4"):
            missing(TOUCHES, {"silk": 4})


class TestRunFile:
    def test_notes_come_back(self, tmp_path: Path) -> None:
        RunFile(tmp_path / "run" / "notes.json", {"seed": 0}).note("a", [1, 2])
        again = RunFile(tmp_path / "run" / "notes.json", {"seed": 0})
        assert again.resumed
        assert again.notes == {"a": [1, 2]}

    def test_another_run_is_refused_by_what_differs(self, tmp_path: Path) -> None:
        RunFile(tmp_path / "notes.json", {"seed": 0, "kind": "x"})
        with pytest.raises(InputError, match="seed 0 there, 1 here"):
            RunFile(tmp_path / "notes.json", {"seed": 1, "kind": "x"})

    def test_other_things_in_the_folder_are_left_alone(self, tmp_path: Path) -> None:
        (tmp_path / "thesis.txt").write_text("mine")
        with pytest.raises(InputError, match="empty folder"):
            RunFile(tmp_path / "notes.json", {})
        assert [file.name for file in tmp_path.iterdir()] == ["thesis.txt"]

    @pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": 9, "plan": {}, "notes": {}}', "\x00"])
    def test_damaged_notes_are_refused(self, tmp_path: Path, text: str) -> None:
        (tmp_path / "notes.json").write_text(text)
        with pytest.raises(InputError, match="notes"):
            RunFile(tmp_path / "notes.json", {})


class TestFiles:
    def test_a_table_with_and_without_a_header(self, tmp_path: Path) -> None:
        for name, text in (("plain", "1,2\n3,4\n"), ("head", "\ufeffa;b\n1;2\n\n3;4\n"), ("tabs", "x\ty\n1\t2\n3\t4")):
            (tmp_path / f"{name}.csv").write_text(text, encoding="utf-8")
            np.testing.assert_array_equal(read_stream(tmp_path / f"{name}.csv"), [[1, 2], [3, 4]])

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("a,b\n1,2\n3,x\n", r"row 3, column 2: expected a number; came 'x'"),
            ("1,\n", r"row 1, column 2: expected a number; came ''"),
            ("1,2\n\n3\n", r"row 3: expected 2 cells"),
            ("a,b\n", "there are none"),
            ("", "there are none"),
        ],
    )
    def test_a_bad_cell_is_named_by_row_and_column(self, tmp_path: Path, text: str, message: str) -> None:
        (tmp_path / "t.csv").write_text(text)
        with pytest.raises(InputError, match=message):
            read_stream(tmp_path / "t.csv")

    def test_files_that_are_no_streams(self, tmp_path: Path) -> None:
        (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY broken")
        (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00")
        (tmp_path / "t.txt").write_text("1")
        np.savez(tmp_path / "z.npz", a=np.zeros(3))
        (tmp_path / "z.npz").rename(tmp_path / "z.npy")
        np.save(tmp_path / "o.npy", np.array([{}], dtype=object), allow_pickle=True)
        for name in ("bad.npy", "b.csv", "t.txt", "z.npy", "o.npy", "none.npy", ""):
            with pytest.raises(InputError):
                read_stream(tmp_path / name)

    def test_a_sensor_by_name_or_file(self, tmp_path: Path) -> None:
        assert read_sensor("roboskin") == sensors.ROBOSKIN
        (tmp_path / "s.json").write_text(sensors.CONTACTILE.model_dump_json())
        assert read_sensor(str(tmp_path / "s.json")) == sensors.CONTACTILE
        (tmp_path / "s.json").write_text('{"name": "x", "channels": 0}')
        with pytest.raises(InputError, match="channels"):
            read_sensor(str(tmp_path / "s.json"))
        with pytest.raises(InputError, match="one of biotac"):
            read_sensor("biotacc")


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
        assert (resumed.observed, resumed.digest, resumed.steps) == (6, whole.digest, whole.steps)
        assert resumed.answers == whole.answers
        again = task.run()
        assert (again.observed, again.digest, again.answers) == (0, whole.digest, whole.answers)

    def test_forgetting_would_be_told(self) -> None:
        outcome = Demo(sensors.BIOTAC, **SMALL).run()
        assert len(outcome.novel) == 20
        first = outcome.steps[0]
        wrong = [outcome.answers.predictions[-1]] * 2  # what was said to the last material, to the first
        outcome.answers.predictions[:2] = wrong
        assert outcome.forgotten() == [(first.material, 1.0, 0.0)]
        assert outcome.answers.confusions() == [(first.material, outcome.answers.truth[-1], 2)]

    def test_another_seed_does_not_go_on(self, tmp_path: Path) -> None:
        small = SMALL | {"materials": 2, "touches": 1, "held_out": 1}
        Demo(sensors.BIOTAC, **small, folder=tmp_path / "kept").run()
        with pytest.raises(InputError, match="seed 0 there, 1 here"):
            Demo(sensors.BIOTAC, seed=1, **small, folder=tmp_path / "kept").run()


@pytest.fixture(scope="module")
def recordings() -> Recordings:
    """Five materials under a simulated RoboSkin, ten touches each, in two folds."""
    scene = Scene(sensors.ROBOSKIN)
    names = scene.materials[:5]
    return Recordings(
        name="simulated",
        sensor=scene.sensor,
        streams=[scene.touch(name, at) for name in names for at in range(10)],
        materials=[name for name in names for _ in range(10)],
        repetition=np.tile(np.arange(10), 5),
        fold=np.tile(np.arange(10) % 2, 5),
        ordered=False,
    )


class TestReplay:
    def test_a_fold_has_all_figures(self, recordings: Recordings) -> None:
        (fold,) = Replay(recordings, curve=4, novelty=True, features=128).run([1])
        assert (fold["fold"], fold["learned"], fold["tested"]) == (1, 25, 25)
        assert fold["equals_offline"]
        assert sum(fold["tested_of"].values()) == 25
        assert [met for met, _ in fold["curve"]] == [1, 2, 3, 4, 5]
        assert fold["curve"][-1][1] == fold["accuracy"] > 0.9
        assert 0 <= fold["calibration_error"] <= 1
        assert 0.5 < fold["novelty_auroc"] <= 1
        assert json.loads(json.dumps(fold)) is not None

    def test_an_interrupted_replay_goes_on(self, recordings: Recordings, tmp_path: Path) -> None:
        whole = list(Replay(recordings, "shuffled", readout="ridge", curve=10, features=128).run([0, 1]))
        task = Replay(recordings, "shuffled", readout="ridge", curve=10, features=128, folder=tmp_path / "kept")

        def stop(what: str, done: int, of: int) -> None:
            if what == "learning" and done == 15 and (tmp_path / "kept" / "fold-1").exists():
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            list(task.run([0, 1], stop))
        with open_memory(tmp_path / "kept" / "fold-1", mode="read") as learner:
            assert sum(learner.materials.values()) == 16
        resumed = list(task.run([0, 1]))
        for one, other in zip(whole, resumed, strict=True):
            # Figures that were read back have lists where tuples were.
            assert json.loads(json.dumps(one | {"seconds": 0})) == json.loads(json.dumps(other | {"seconds": 0}))

    def test_no_schedule_makes_a_difference(self, recordings: Recordings) -> None:
        digests = {
            next(Replay(recordings, schedule, features=64).run([0]))["digest"]
            for schedule in ("reversed", "interleaved")
        }
        assert len(digests) == 1

    def test_what_cannot_be_is_refused(self, recordings: Recordings) -> None:
        with pytest.raises(InputError, match="folds out of"):
            list(Replay(recordings).run([2]))
        with pytest.raises(DatasetError, match="blocked"):
            list(Replay(recordings, blocked=True).run([0]))
        with pytest.raises(InputError, match="curve"):
            Replay(recordings, curve=-1)
        with pytest.raises(InputError, match="materials"):
            subset(recordings, 6)

    def test_a_summary_leaves_out_what_was_not_measured(self) -> None:
        folds = [{"accuracy": 0.5, "first": None}, {"accuracy": 1.0, "first": 0.2}]
        names = ("half", "twice", "calibration_error", "false_alarms", "novelty_auroc")
        means = summary([fold | dict.fromkeys(names) for fold in folds])
        assert means == {"accuracy": {"mean": 0.75, "sd": pytest.approx(math.sqrt(0.125))}}


def test_confusion_counts() -> None:
    counts = confusion_counts(["a", "b"], [4, 4], [("a", "b", 3)])
    assert counts.tolist() == [[1, 3], [0, 4]]


def test_kernels_of_another_size_are_found_again(tmp_path: Path) -> None:
    with TactileLearner.open(tmp_path / "m", sensor=sensors.BIOTAC, embedding=Kernels(dimension=64)) as learner:
        learner.observe("silk", Scene(sensors.BIOTAC).touch("silk", 0))
        digest = learner.digest()
    with open_memory(tmp_path / "m") as learner:
        assert learner.digest() == digest
