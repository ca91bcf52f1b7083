"""`scroll-tactile memory …`, as its user sees it."""

import csv
import io
import json
import os
import re
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from commands import refused, run
from forging import log_of
from scroll_tactile_store import Store, StoreError
from touches import PAD, SETTINGS, fed, require_same, stream

from scroll_tactile import ModuleEmbedding, Quantity, TactileLearner
from scroll_tactile.clients.cli.terminal import opened_for_upkeep
from scroll_tactile.clients.learning.plain_export import export_plain
from scroll_tactile.errors import InputError, MismatchError
from scroll_tactile.prediction.predictor import reembed_memory

OBSERVED = [(name, (seed, 60)) for seed in range(4) for name in ("a", "b/ü", "c")]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("upkeep") / "m"
    with TactileLearner.open(folder, **SETTINGS) as learner:
        for name, touch in OBSERVED:
            learner.observe(name, stream(touch))
    return folder


@pytest.fixture
def path(whole, tmp_path):
    return Path(shutil.copytree(whole, tmp_path / "m"))


def words(result):
    assert result.exit_code == 0, result.output
    return " ".join(result.output.split())


def damage(path):
    """Change a character of a material's name in the log; its file."""
    log = log_of(path)
    data = bytearray(log.read_bytes())
    at = data.rindex("b/ü".encode())
    data[at] ^= 1
    log.write_bytes(data)
    return log


class TestCheckAndRepair:
    def test_a_sound_memory(self, path):
        assert "sound: every checksum holds" in words(run("memory", "check", path))
        assert "nothing was damaged; rows 1 to 12 verify" in words(run("memory", "repair", path))

    def test_damage_is_named_and_mended(self, path):
        log = damage(path)
        result = run("memory", "check", path)
        assert result.exit_code == 1
        assert "row" in result.output
        assert "2 damaged" in result.output  # a frame, and so a row
        assert f"scroll-tactile memory repair {path}" in " ".join(result.output.split())
        found = json.loads(run("memory", "check", path, "--json").output)
        assert not found["sound"]
        assert found["problems"][0]["path"] == str(log)
        repaired = words(run("memory", "repair", path))
        assert "lost:" in repaired
        assert "damaged journal was put aside" in repaired
        assert json.loads(run("memory", "check", path, "--json").output)["sound"] is True
        with TactileLearner.open(path, **SETTINGS) as learner:
            # The checkpoint holds what the row had; readings, and so exemplars, are in rows alone.
            require_same(learner, OBSERVED, exemplars=False)

    @pytest.mark.parametrize(
        "command", ["check", "repair", "backup", "compact", "export", "retract", "forget", "merge"]
    )
    def test_what_is_no_memory_is_refused(self, tmp_path, command):
        more = {"compact": ["--yes"], "export": [tmp_path / "out"], "backup": [tmp_path / "copy"], "retract": [1]}
        more |= {"forget": ["a"], "merge": [tmp_path]}
        opens = command in ("compact", "export", "retract", "forget", "merge")  # the others look at what may be damaged
        expected = "there is no memory in" if opens else "holds no store"
        assert expected in refused("memory", command, tmp_path / "none", *more.get(command, []))
        assert not (tmp_path / "none").exists()


class TestRetracting:
    def test_a_packed_memory_is_merged_and_its_source_is_forgotten(self, path, tmp_path):
        packed = run("memory", "pack", path, tmp_path / "p", "--source", "robot 7")
        assert packed.exit_code == 0 and "12 observations" in packed.output
        with TactileLearner.open(tmp_path / "other", **SETTINGS) as learner:
            learner.observe("d", stream((9, 60)))
            before = learner.digest()
        merged = run("memory", "merge", tmp_path / "other", tmp_path / "p")
        assert merged.exit_code == 0 and "12 observations came in" in merged.output
        assert "no observation" in refused("memory", "forget", tmp_path / "other", "--source", "robot")
        forgotten = run("memory", "forget", tmp_path / "other", "--source", "robot 7")
        assert forgotten.exit_code == 0 and "12 observations retracted" in forgotten.output
        with TactileLearner.open(tmp_path / "other") as learner:
            assert learner.digest() == before
        assert "a material, or a source" in refused("memory", "forget", tmp_path / "other")

    def test_a_memory_is_packed_without_its_rows_or_any_readings(self, path, tmp_path):
        sizes = []
        for words in ([], ["--no-rows"], ["--no-readings"]):
            assert run("memory", "pack", path, tmp_path / "p", *words).exit_code == 0
            sizes.append((tmp_path / "p").stat().st_size)
        assert sizes[2] < sizes[1]

    def test_retract_and_forget(self, path):
        assert "row 2 was retracted; 11 observations left" in words(run("memory", "retract", path, 2))
        assert "b/ü: 3 observations retracted; 2 materials left" in words(run("memory", "forget", path, "b/ü"))
        assert "was retracted already" in refused("memory", "retract", path, 2)
        assert "'b/ü' was never observed" in refused("memory", "forget", path, "b/ü")
        with TactileLearner.open(path, **SETTINGS) as learner:
            require_same(learner, [one for one in OBSERVED if one[0] != "b/ü"])

    def test_merge(self, path, tmp_path):
        with TactileLearner.open(tmp_path / "other", **SETTINGS) as other:
            for name, touch in [("a", (0, 60)), ("d", (1, 60))]:
                other.observe(name, stream(touch))
        result = words(run("memory", "merge", path, tmp_path / "other"))
        assert "1 observation came in, 1 stream observed by both; 13 are there now" in result
        with TactileLearner.open(path, **SETTINGS) as learner:
            require_same(learner, [*OBSERVED, ("d", (1, 60))])
            assert f"digest: {learner.digest()}" in result

    def test_compact_asks_first(self, path):
        result = run("memory", "compact", path, "--keep", "2")
        assert result.exit_code == 1
        assert "Of 12 observations only the newest 2 can be retracted or forgotten afterwards" in result.output
        with TactileLearner.open(path, **SETTINGS) as learner:
            learner.retract(1)
        assert "rows up to 10 are compacted; on disk" in words(run("memory", "compact", path, "--keep", "2", "--yes"))
        assert "were compacted" in refused("memory", "retract", path, 4)


WRITER = """
import sys
from touches import SETTINGS, stream
from scroll_tactile import TactileLearner

with TactileLearner.open(sys.argv[1], **SETTINGS) as learner:
    for seed in range(4, 400):
        learner.observe("d", stream((seed, 60)))
        print(learner.digest(), flush=True)
"""


class TestBackup:
    def test_a_copy_under_a_writer_is_a_state_that_it_acknowledged(self, path, tmp_path):
        home = Path(__file__).resolve().parents[1]
        writer = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path)],
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(home), str(home.parent)])},
        )
        try:
            digests = [writer.stdout.readline().strip() for _ in range(3)]
            said = words(run("memory", "backup", path, tmp_path / "copy"))
            assert writer.poll() is None
            with TactileLearner.open(tmp_path / "copy", **SETTINGS) as learner:
                found, last = learner.digest(), learner._ledger.store.last
            assert found in digests or f"{found}\n" in writer.stdout
        finally:
            writer.terminate()
            writer.stdout.close()
            writer.wait()
        assert f"with rows 1 to {last}; every checksum holds" in said

    def test_what_is_there_stays(self, path, tmp_path):
        (tmp_path / "copy").mkdir()
        assert "is there already" in refused("memory", "backup", path, tmp_path / "copy")
        assert "inside" in refused("memory", "backup", path, path / "copy")


class TestExport:
    def test_all_of_it_is_read_without_this_library(self, path, tmp_path):
        run("memory", "retract", path, 3)
        run("memory", "compact", path, "--keep", "4", "--yes")
        run("memory", "retract", path, 12)
        assert "written" in words(run("memory", "export", path, tmp_path / "out"))
        out, left = tmp_path / "out", [one for at, one in enumerate(OBSERVED) if at not in (2, 11)]
        whole = fed(left)
        about = json.loads((out / "memory.json").read_text())
        assert (about["digest"], about["materials"]) == (whole.digest(), whole.materials)
        with (out / "observations.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert [row["material"] for row in rows] == [name for name, _ in OBSERVED]
        states = ["compacted"] * 8 + ["kept"] * 3 + ["retracted"]
        states[2] = "retracted"
        assert [row["state"] for row in rows] == states
        with np.load(out / "statistics.npz") as arrays:
            assert arrays["materials"].tolist() == ["a", "b/ü", "c"]
            for scale in whole.memory.statistics.scales:
                found = [whole._predictor.extractor.codes(whole_image(touch)) for _, touch in left]
                codes = np.concatenate([rows[scale] for rows in found if scale in rows]).astype(np.int64)
                assert np.array_equal(arrays[f"second-{scale}"], codes.T @ codes)
                assert np.array_equal(arrays[f"sums-{scale}"].sum(axis=0), codes.sum(axis=0))
                assert arrays[f"counts-{scale}"].sum() == len(codes)
                self.require_scores(arrays, about["touches"], whole.model().readouts[scale], codes[5])
        with (out / "exemplars.csv").open(newline="") as file:
            index = list(csv.DictReader(file))
        found = {}
        for row in index:
            found.setdefault(row["material"], []).append(bytes.fromhex(row["key"]))
            readings = np.load(out / row["file"], allow_pickle=False)
            assert readings.shape == (60, 2)
        assert found == whole.exemplars

    def require_scores(self, arrays, touches, readout, row):
        """The scores of a row follow from the exported arrays, as `export_plain` says."""
        known = arrays[f"counts-{readout.scale}"] > 0
        counts, sums, second = (
            arrays[f"{what}-{readout.scale}"].astype(float) for what in ("counts", "sums", "second")
        )
        means, d = sums[known] / counts[known, None], len(second)
        scatter = second - means.T * counts[known] @ means
        trace, squares = np.trace(scatter), np.square(scatter).sum()
        share = ((1 - 2 / d) * squares + trace**2) / ((touches + 1 - 2 / d) * (squares - trace**2 / d))
        share = min(max(share, 0.0001), 0.99)
        solved = np.linalg.solve(scatter + share / (1 - share) * trace / d * np.eye(d), means.T)
        scores = counts.sum() / (1 - share) * (row @ solved - (means.T * solved).sum(axis=0) / 2)
        expected = readout.scores(row.astype(float), range(len(readout.names)), "lda")
        assert np.allclose(np.diff(scores), np.diff(expected), rtol=1e-4)

    def test_no_cell_is_computed_by_a_spreadsheet_and_every_name_comes_back(self, tmp_path):
        names = ["=cmd|'/c calc'!A1", "@SUM(A1)", "+1+1", "-2", "'=1", "＝1"]
        names += ["a;=1", "a;'=1;;-2", 'b,"=1', "'u'", "ü - c"]
        with TactileLearner.open(tmp_path / "m", **SETTINGS | {"exemplars": len(names)}) as learner:
            learner.declare(Quantity(name="=q", unit="N", low=0.0, high=1.0, resolution=0.1))
            for i, name in enumerate(names):
                learner.observe(name, stream((i, 60)), source=name, values={"=q": 0.5}, labels={name: name})
                learner.describe(name, {name: 1.0})
            export_plain(learner, tmp_path / "out")
        for table, column in (("observations", "source"), ("exemplars", "material"), ("descriptions", "constituent")):
            text = (tmp_path / "out" / f"{table}.csv").read_text(encoding="utf-8")
            for separator in ",;\t":  # a spreadsheet takes that of its country
                rows = csv.reader(io.StringIO(text), delimiter=separator)
                assert [cell for row in rows for cell in row if cell.startswith(tuple("=+-@＝\t\r"))] == []
            for read in ("material", column):
                found = [row[read] for row in csv.DictReader(io.StringIO(text))]
                assert {re.sub(r"(^|;)'(?='*[=+@＝-])", r"\1", cell) for cell in found} == set(names)

    def test_a_path_that_no_system_takes_is_an_error_with_a_type(self, path, tmp_path):
        long = tmp_path / ("m" * 300)
        assert "too long" in refused("memory", "export", path, long)
        assert "too long" in refused("memory", "export", long, tmp_path / "out")
        assert "too long" in refused("memory", "merge", path, long)
        for call in (TactileLearner.open, partial(TactileLearner.open, **SETTINGS), reembed_memory):
            with pytest.raises((InputError, StoreError)):
                call(long)

    def test_nothing_is_written_over(self, path, tmp_path):
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "mine").write_text("x")
        assert "holds something already" in refused("memory", "export", path, tmp_path / "out")
        assert [one.name for one in (tmp_path / "out").iterdir()] == ["mine"]
        with pytest.raises(InputError, match="cannot be written"):
            export_plain(fed(OBSERVED), tmp_path / "out" / "mine")


class TestAnyEmbedding:
    def test_a_memory_of_a_module_is_looked_after_without_it(self, tmp_path):
        import torch

        module = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d((1, 8)), torch.nn.Flatten(), torch.nn.Tanh())
        embedding = ModuleEmbedding(module, name="means", dimension=8, channels=[2])
        with TactileLearner.open(tmp_path / "m", sensor=PAD, embedding=embedding) as learner:
            for name, touch in OBSERVED:
                learner.observe(name, stream(touch))
            learner.forget("c")
            digest = learner.digest()
        with TactileLearner.open(tmp_path / "n", sensor=PAD, embedding=embedding) as learner:
            for name, touch in OBSERVED:
                learner.observe(name, stream(touch))
        assert "c: 4 observations" in words(run("memory", "forget", tmp_path / "n", "c"))
        assert words(run("memory", "compact", tmp_path / "n", "--yes"))
        with TactileLearner.open(tmp_path / "n", sensor=PAD, embedding=embedding) as learner:
            assert learner.digest() == digest
        with opened_for_upkeep(tmp_path / "n") as learner, pytest.raises(MismatchError, match="does not ship"):
            learner.observe("a", stream((0, 60)))

    def test_another_programs_store_is_refused(self, tmp_path):
        Store.open(tmp_path / "s", identity={"for": "other things"}).close()
        assert "holds no memory of touch" in refused("memory", "forget", tmp_path / "s", "a")


def whole_image(touch):
    from scroll_tactile.signals.image import tactile_image
    from scroll_tactile.signals.stream import validate

    return tactile_image(validate(stream(touch), PAD))
