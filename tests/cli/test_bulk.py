"""Commands over many files, and over the observations of a memory, as they are typed."""

import csv
import io
import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from commands import refused, run

from scroll_tactile import Kernels, TactileLearner, sensors
from scroll_tactile.simulation.scene import Scene

SCENE = Scene(sensors.ROBOSKIN)
NAMES = ("silk", "wool")


def touch(folder: Path, name: str, i: int) -> Path:
    (folder / name).mkdir(parents=True, exist_ok=True)
    np.save(folder / name / f"{i}.npy", SCENE.touch(name, i).readings)
    return folder / name / f"{i}.npy"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("touches")
    for name in NAMES:
        for i in range(3):
            touch(folder, name, i)
    return folder


@pytest.fixture
def memory(tmp_path: Path) -> Path:
    TactileLearner.open(tmp_path / "m", sensor=sensors.ROBOSKIN, embedding=Kernels(dimension=64)).close()
    return tmp_path / "m"


@pytest.fixture(scope="module")
def of_six(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("learned") / "m"
    TactileLearner.open(folder, sensor=sensors.ROBOSKIN, embedding=Kernels(dimension=64)).close()
    assert run("learn", folder, data, "--label-by", "folder").exit_code == 0
    return folder


@pytest.fixture
def learned(of_six: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(of_six, tmp_path / "learned"))


class TestLearn:
    def test_a_new_memory_from_folders(self, tmp_path: Path, data: Path) -> None:
        result = run("learn", tmp_path / "new", data, "--sensor", "roboskin", "--label-by", "folder")
        assert result.exit_code == 0, result.output
        assert "learned: 6 touches of 2 materials from 6 files; the memory has 6 now" in result.stdout
        found = json.loads(run("learn", tmp_path / "new", data, "--label-by", "folder", "--json").stdout)
        expected = {
            "files": 6,
            "touches": 0,
            "learned": {},
            "skipped": 6,
            "refused": [],
            "observations": 6,
            "deaths": 0,
            "facts": [],
        }
        assert found == {**expected, "seconds": found["seconds"], "digest": result.stdout.split()[-1]}
        assert "skipped: 6 touches" in run("learn", tmp_path / "new", data, "--label-by", "folder").stdout

    def test_some_refused_is_exit_code_1_and_the_rest_is_learned(
        self, memory: Path, data: Path, tmp_path: Path
    ) -> None:
        (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY broken")
        words = (memory, data / "silk", tmp_path / "bad.npy", tmp_path / "none.npy", "--label", "silk")
        result = run("learn", *words)
        assert result.exit_code == 1
        assert "learned: 3 touches of 1 material from 4 files" in result.stdout
        lines = [line for line in result.stderr.splitlines() if line.startswith("refused:")]
        assert len(lines) == 2 and "bad.npy" in lines[1] and "it is not there" in lines[0]
        found = json.loads(run("learn", *words, "--json").stdout)
        assert [Path(each["source"]).name for each in found["refused"]] == ["none.npy", "bad.npy"]

    def test_what_a_recording_has_is_listed_once(self, memory: Path, tmp_path: Path) -> None:
        for name in ("a", "b"):
            with h5py.File(tmp_path / f"{name}.h5", "w") as file:
                for key in ("tip", "pad"):
                    file[f"data/demo_0/obs/{key}"] = SCENE.touch("silk", 0).readings
        errors = run("learn", memory, tmp_path / "a.h5", tmp_path / "b.h5", "--label", "silk").stderr
        assert errors.count("refused:") == 2 and errors.count("expected a field to read") == 2
        assert errors.count("tip  [60]") == 1
        words = (memory, tmp_path / "a.h5", "--field", "pad", "--label", "silk")
        assert run("learn", *words).exit_code == 0
        listed = json.loads(run("memory", "list", memory, "--json").stdout)
        assert listed["source"] == f"{tmp_path}/a.h5 pad"

    def test_what_is_refused_makes_no_memory(self, tmp_path: Path, data: Path) -> None:
        new = tmp_path / "new"
        assert "--sensor" in refused("learn", new, data, "--label", "silk")
        for words in ((data, "--sensor", "biotac", "--label", "a"), (data, "--sensor", "roboskin")):
            result = run("learn", new, *words)
            assert result.exit_code == 1 and "learned: 0 touches from 6 files" in result.stdout
            assert result.stderr.count("refused:") == 6
        assert not new.exists()

    def test_a_cut_that_is_none_and_a_memory_that_is_being_written_are_refused(self, memory: Path, data: Path) -> None:
        assert run("learn", memory, data, "--cut", "thin").exit_code == 2
        with TactileLearner.open(memory):
            assert "is being written by this process" in refused("learn", memory, data, "--label", "a")

    def test_labels_in_a_table(self, memory: Path, data: Path, tmp_path: Path) -> None:
        rows = SCENE.touch("silk", 0).readings
        table = np.hstack([np.arange(len(rows))[:, None] / 50, rows])
        np.savetxt(
            tmp_path / "t.csv", table, delimiter=",", header=",".join(["time", *map(str, range(60))]), comments=""
        )
        (tmp_path / "labels.csv").write_text("file,begin,end,material\nt.csv,0,0.5,silk\nt.csv,0.5,1,wool\n")
        result = run("learn", memory, tmp_path / "t.csv", "--labels", tmp_path / "labels.csv")
        assert result.exit_code == 0, result.output
        assert "2 touches of 2 materials from 1 file;" in result.stdout
        listed = [json.loads(line) for line in run("memory", "list", memory, "--json").stdout.splitlines()]
        assert [row["source"].partition("t.csv")[2] for row in listed] == ["[0:25]", "[25:50]"]
        for text, said in (
            ("file,begin,end,material\nother.csv,0,1,silk\n", "none of the recordings"),
            ("file,begin,end,material\nt.csv,0,1,\n", "expected a file and a material"),
            ("file,begin,end\n", "no column 'material'"),
            ("file,begin,end,material\n", "there are none"),
        ):
            (tmp_path / "wrong.csv").write_text(text)
            assert said in refused("learn", memory, tmp_path / "t.csv", "--labels", tmp_path / "wrong.csv")
        assert "cannot be read" in refused("learn", memory, tmp_path / "t.csv", "--labels", tmp_path / "no.csv")


class TestPredict:
    def test_many_have_a_line_each(self, learned: Path, data: Path, tmp_path: Path) -> None:
        result = run("predict", learned, data / "silk", data / "wool" / "1.npy", tmp_path / "none.npy")
        assert result.exit_code == 1
        assert [line.split(": ")[0] for line in result.stdout.splitlines()] == [
            *(str(data / "silk" / f"{i}.npy") for i in range(3)),
            str(data / "wool" / "1.npy"),
        ]
        assert "refused:" in result.stderr and "none.npy" in result.stderr
        answers = [json.loads(line) for line in run("predict", learned, data, "--json").stdout.splitlines()]
        assert [answer["material"] for answer in answers] == ["silk"] * 3 + ["wool"] * 3
        alone = json.loads(run("predict", learned, data / "silk" / "0.npy", "--json").stdout)
        assert answers[0] == {"source": str(data / "silk" / "0.npy")} | alone
        rows = list(csv.DictReader(io.StringIO(run("predict", learned, data, "--csv").stdout)))
        assert [(row["answer"], float(row["probability"])) for row in rows] == [
            (answer["material"], answer["probability"]) for answer in answers
        ]

    def test_a_table_with_numbers_for_a_header_is_read_as_pandas_meant_it(self, learned: Path, tmp_path: Path) -> None:
        readings = SCENE.touch("wool", 7).readings
        np.save(tmp_path / "t.npy", readings)
        header = ",".join(map(str, range(60)))
        np.savetxt(tmp_path / "t.csv", readings, delimiter=",", header=header, comments="", fmt="%.9g")
        told = [json.loads(run("predict", learned, tmp_path / name, "--json").stdout) for name in ("t.csv", "t.npy")]
        assert told[0] == told[1]
        assert run("observe", learned, "wool", tmp_path / "t.csv").exit_code == 0
        found = json.loads(run("learn", learned, tmp_path / "t.npy", "--label", "wool", "--json").stdout)
        assert (found["touches"], found["skipped"]) == (0, 1)


class TestEvaluate:
    def test_it_shows_what_it_got_wrong(self, learned: Path, data: Path, tmp_path: Path) -> None:
        touch(tmp_path / "more", "wool", 5)
        (tmp_path / "more" / "wool").rename(tmp_path / "more" / "silk")
        touch(tmp_path / "more", "denim", 0)
        words = ("evaluate", learned, data, tmp_path / "more", "--label-by", "folder", "--with-learned")
        found = json.loads(run(*words, "--json").stdout)
        assert (found["touches"], found["never_learned"], found["accuracy"]) == (7, 1, 6 / 7)
        assert found["confusions"] == [["silk", "wool", 1]]
        (wrong,) = (row for row in found["wrong"] if row["material"] == "silk")
        assert (Path(wrong["source"]).name, wrong["answer"]) == ("5.npy", "wool")
        text = run(*words).stdout
        for said in ("accuracy: 85.7 %", "calibration error:", "called unknown:", "never learned: 1", "5.npy, silk:"):
            assert said in text, text
        rows = list(csv.DictReader(io.StringIO(run(*words, "--csv").stdout)))
        assert len(rows) == 8
        assert [row["right"] for row in rows if row["material"] == "silk"] == ["True"] * 3 + ["False"]

    def test_what_it_has_learned_is_left_out(self, learned: Path, data: Path, tmp_path: Path) -> None:
        touch(tmp_path / "more", "wool", 5)
        words = ("evaluate", learned, data, tmp_path / "more", "--label-by", "folder")
        found = json.loads(run(*words, "--json").stdout)
        assert (found["touches"], found["learned_before"], found["accuracy"]) == (1, 6, 1.0)
        every = json.loads(run(*words, "--with-learned", "--json").stdout)
        assert (every["touches"], every["learned_before"]) == (7, 6)
        assert "touches that it has learned: 6, left out" in run(*words).stdout
        assert "touches that it has learned: 6, answered all the same" in run(*words, "--with-learned").stdout

    def test_what_is_refused_is_exit_code_1(self, learned: Path, data: Path, tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        result = run("evaluate", learned, data / "silk", tmp_path / "empty", "--label", "silk")
        assert result.exit_code == 1
        assert "touches that it has learned: 3, left out; --with-learned answers them, too" in result.stdout
        assert "accuracy" not in result.stdout and "there is none in this folder" in result.stderr
        assert "nothing names it" in run("evaluate", learned, data / "silk").stderr


class TestList:
    def test_relabelling_is_listed(self, learned: Path) -> None:
        assert "as wool it is observation 8" in run("memory", "relabel", learned, "1", "wool").stdout
        lines = run("memory", "list", learned).stdout.splitlines()
        assert len(lines) == 7
        assert "silk  retracted" in lines[0] and lines[0].endswith("silk/0.npy")
        assert "  wool  " in lines[-1] and lines[-1].endswith("silk/0.npy")
        assert json.loads(run("inspect", learned, "--json").stdout)["materials"] == {"silk": 2, "wool": 4}
        assert "was retracted already" in refused("memory", "relabel", learned, "1", "wool")
        assert "is called 'wool' already" in refused("memory", "relabel", learned, "8", "wool")
        assert "1 to 200" in refused("memory", "relabel", learned, "8", "")
        assert run("memory", "compact", learned, "--yes").exit_code == 0
        assert "were compacted" in refused("memory", "relabel", learned, "8", "silk")
        states = [json.loads(line)["state"] for line in run("memory", "list", learned, "--json").stdout.splitlines()]
        assert states == ["retracted", *["compacted"] * 6]

    def test_observe_keeps_the_name_of_its_file(self, memory: Path, data: Path) -> None:
        run("observe", memory, "silk", data / "silk" / "0.npy")
        row = json.loads(run("memory", "list", memory, "--json").stdout)
        assert (row["sequence"], row["material"], row["state"]) == (1, "silk", "kept")
        assert row["source"] == str(data / "silk" / "0.npy")

    def test_the_same_touch_is_told_and_learned_once(self, memory: Path, data: Path) -> None:
        words = ("observe", memory, "silk", data / "silk" / "0.npy")
        run(*words)
        again = run(*words)
        assert again.exit_code == 0 and "observed 1 time" in again.stdout
        assert "this touch was learned already, as observation 1" in again.stdout
        other = run("observe", memory, "wool", words[-1])
        assert "are learned as 'silk', too: relabel or retract one of them" in other.stderr
        assert "observed 1 time" in other.stdout


@pytest.mark.parametrize("command", ["learn", "evaluate", "fleet"])
def test_help_shows_what_stands_in_square_brackets(command):
    said = " ".join(run(command, "--help").output.replace("│", " ").split())
    assert said.count("'slip [label]'") == 2  # of --labels and --annotate
