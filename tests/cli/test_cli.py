"""The commands, as they are typed."""

import json
import re
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from commands import refused, run
from scroll_tactile_store import StoreError

from scroll_tactile import Kernels, TactileLearner, __version__, native, sensors
from scroll_tactile.errors import InputError
from scroll_tactile.simulation.scene import Scene

SCENE = Scene(sensors.ROBOSKIN)
SMALL = ["--materials", "5", "--touches", "3", "--held-out", "2", "--features", "64"]


def digest_of(output: str) -> str:
    found = re.search(r"digest: ([0-9a-f]{64})", output)
    assert found, output
    return found[1]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One .npy of each of two materials, and a .csv of a third touch."""
    folder = tmp_path_factory.mktemp("streams")
    for name in ("silk", "wool"):
        np.save(folder / f"{name}.npy", SCENE.touch(name, 0).readings)
        np.save(folder / f"{name}-again.npy", SCENE.touch(name, 1).readings)
    np.savetxt(folder / "silk.csv", SCENE.touch("silk", 2).readings, delimiter=",")
    return folder


@pytest.fixture(scope="module")
def memory(files: Path) -> Path:
    folder = files / "memory"
    TactileLearner.open(folder, sensor=sensors.ROBOSKIN, embedding=Kernels(dimension=64)).close()
    for file in ("silk", "silk-again", "wool", "wool-again"):
        result = run("observe", folder, file.removesuffix("-again"), files / f"{file}.npy")
        assert result.exit_code == 0, result.output
    assert "observed 2 times" in result.output
    return folder


class TestMemory:
    def test_predict_says_what_it_feels_like(self, memory: Path, files: Path) -> None:
        result = run("predict", memory, files / "silk.csv")
        assert result.exit_code == 0, result.output
        assert "silk" in result.output.splitlines()[0]
        answer = json.loads(run("predict", memory, files / "silk.csv", "--json").stdout)
        assert answer["material"] == "silk"
        assert [name for name, _ in answer["ranking"]] == ["silk", "wool"]
        only = json.loads(run("predict", memory, files / "silk.csv", "--scene", "wool", "--json").stdout)
        assert (only["material"], only["probability"]) == ("wool", 1.0)

    def test_inspect_shows_what_it_holds(self, memory: Path) -> None:
        found = json.loads(run("inspect", memory, "--json").stdout)
        assert found["materials"] == {"silk": 2, "wool": 2}
        assert found["sensor"]["name"] == "roboskin"
        assert found["bytes"] > 0
        assert found["kept"] == 4
        text = run("inspect", memory).stdout
        assert digest_of(text) == found["digest"]
        assert "4 of 2 materials" in text
        assert "kept touches: 4" in text

    def test_what_it_is_made_of_is_described_and_composed(self, memory: Path, files: Path) -> None:
        assert "nothing was described yet" in run("compose", memory, files / "silk.csv").output
        described = run("describe", memory, "silk", "silk=1.0")
        assert described.exit_code == 0, described.output
        assert "silk: made of silk; observed 2 times" in described.stdout
        run("describe", memory, "wool", "wool=0.75", "dye=0.25")
        run("describe", memory, "tweed", "wool=1", "soft=unknown")
        answer = json.loads(run("compose", memory, files / "silk.csv", "--json").stdout)
        found = {one["constituent"]: one for one in answer["constituents"]}
        assert answer["material"] == "silk" and list(found) == ["dye", "silk", "soft", "wool"]
        assert found["silk"]["presence"] > 0.5 > found["wool"]["presence"]
        assert found["soft"]["presence"] is None and found["soft"]["unlearned"]
        text = run("compose", memory, files / "silk.csv").stdout
        assert "constituent" in text and "a material never observed" in text
        typed = run("describe", memory, "silkk", "silk=1")
        assert typed.exit_code == 1 and "'silk' is nearly called so" in " ".join(typed.output.split())
        assert run("describe", memory, "silkk", "silk=1", "--new").exit_code == 0
        assert run("describe", memory, "silkk").exit_code == 0
        assert "each constituent once" in run("describe", memory, "silk", "silk=0.5", "silk=0.5").output
        for wrong, said in (("wool", "came 'wool'"), ("wool=much", "NAME=SHARE"), ("wool=0.7", "sum to one")):
            refused = run("describe", memory, "silk", wrong)
            assert refused.exit_code != 0 and said in refused.output
        assert "its description is removed; observed 2 times" in run("describe", memory, "silk").stdout

    def test_an_empty_memory_answers_unknown(self, tmp_path: Path, files: Path) -> None:
        TactileLearner.open(tmp_path / "m", sensor=sensors.ROBOSKIN).close()
        assert "never felt anything" in run("predict", tmp_path / "m", files / "silk.csv").stdout
        answer = json.loads(run("predict", tmp_path / "m", files / "silk.csv", "--json").stdout)
        assert (answer["material"], answer["known"], answer["novelty"]) == (None, False, None)
        assert (
            run("predict", tmp_path / "m", files / "silk.csv", "--csv")
            .stdout.splitlines()[1]
            .endswith(",0.0,False,,1.5")
        )
        assert run("memory", "list", tmp_path / "m").stdout == ""

    def test_a_sensor_of_ones_own(self, tmp_path: Path) -> None:
        mine = {"name": "mine", "channels": 3, "rate": 50, "low": 0, "high": 1, "unit": "V", "duration": 1}
        (tmp_path / "mine.json").write_text(json.dumps(mine))
        np.save(tmp_path / "t.npy", np.random.default_rng(0).random((50, 3)))
        result = run("observe", tmp_path / "m", "tin [can]", tmp_path / "t.npy", "--sensor", tmp_path / "mine.json")
        assert result.exit_code == 0, result.output
        assert "tin [can]: 1 s" in result.stdout

    def test_errors_are_one_line(self, memory: Path, files: Path, tmp_path: Path) -> None:
        silk = files / "silk.npy"
        assert "scroll-tactile observe" in refused("describe", tmp_path / "new", "silk", "silk=1")
        assert not (tmp_path / "new").exists()
        assert "one of biotac" in refused("observe", tmp_path / "new", "silk", silk, "--sensor", "skin")
        assert "biotac" in refused("observe", memory, "silk", silk, "--sensor", "biotac")
        assert "1 to 200 characters" in refused("observe", memory, "", silk)
        assert "'oak'" in refused("predict", memory, silk, "--scene", "oak,silk")
        assert "at least one material" in refused("predict", memory, silk, "--scene", ",")
        assert "not there" in refused("predict", memory, files / "none.npy")
        assert "file" in refused("inspect", silk)
        (tmp_path / "bad.csv").write_text("1,2\n1,two\n")
        assert "row 2, column 2" in refused("predict", memory, tmp_path / "bad.csv")
        np.save(tmp_path / "wide.npy", np.zeros((75, 61)))
        assert "60 channels" in refused("predict", memory, tmp_path / "wide.npy")


LONGER = [*SMALL, "--materials", "10", "--held-out", "1"]  # a demo long enough to be stopped in


class TestDemo:
    def test_it_shows_all_it_promises(self) -> None:
        result = run("demo", *SMALL, "--sensor", "contactile")
        assert result.exit_code == 0, result.output
        for words in (
            "Simulated",
            "nothing here is a result",
            "unknown is called unknown: ",
            "forgets nothing: ",
            "answers from 0.3 s on: ",
            "survives the power plug: ",
            "the very bits of a memory that nothing interrupted",
            "digest: ",
        ):
            assert words in result.stdout

    def test_errors_are_one_line(self, tmp_path: Path) -> None:
        for said, *words in (
            ("camera", "--sensor", "gelsight"), ("one of", "--sensor", "nose"), ("seed", "--seed", "-1"),
        ):  # fmt: skip
            assert said in refused("demo", "--memory", tmp_path / "m", *words)
            assert not (tmp_path / "m").exists()
        (tmp_path / "file").write_text("")
        assert "Not a directory" in refused("demo", "--memory", tmp_path / "file")

    def test_the_plug_is_pulled_and_it_goes_on(self, tmp_path: Path) -> None:
        kept = tmp_path / "kept"
        words = [sys.executable, "-m", "scroll_tactile.clients.cli", "demo", "--memory", str(kept), *LONGER]
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
        try:
            until = time.monotonic() + 60
            while not _finished(kept) and process.poll() is None and time.monotonic() < until:
                time.sleep(0.02)
        finally:
            process.kill()
            process.wait()
        assert len(_finished(kept)) < 10, "it was not stopped in time"
        resumed = run("demo", "--memory", kept, *LONGER)
        assert resumed.exit_code == 0, resumed.output
        observed = re.search(r"observed now: (\d+)", resumed.stdout)
        assert observed
        assert int(observed[1]) < 30
        assert digest_of(resumed.stdout) == digest_of(run("demo", *LONGER).stdout)
        assert digest_of(resumed.stdout) == digest_of(run("inspect", kept / "memory").stdout)


def _finished(kept: Path) -> list[str]:
    """The materials that the demonstration learned some touches of."""
    with suppress(StoreError, InputError), TactileLearner.open(kept / "memory", mode="read") as learner:
        return list(learner.materials)
    return []


def test_the_version_is_shown() -> None:
    assert run("--version").stdout == f"scroll-tactile {__version__}, kernels {native.described()}\n"
