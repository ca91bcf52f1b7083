"""Annotated data sets of others: read by lerobot itself, made to harm, and as the command line takes them."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import live_touches
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commands import refused, run
from faults.recording_attacks import ATTACKS, RAN, SECRET
from live_touches import slide
from robot_sets import FIELD, robot_set, whole
from touches import PAD, SMALL

from scroll_tactile import Sensor, TactileLearner, annotate
from scroll_tactile.errors import InputError, RecordingError

SHARED = Path(__file__).parents[3] / "shared" / "data" / "recordings" / "lerobot_v3_tactile"
LEROBOT = "SCROLL_TACTILE_LEROBOT"  # a Python that has lerobot, which pins another torch than ours
TIP = Sensor(name="tip", channels=19, rate=100.0, low=-5.0, high=5.0, unit="1", duration=0.3)


@pytest.fixture(scope="module")
def tip():
    made, random = TactileLearner(sensor=TIP, embedding=SMALL), np.random.default_rng(0)
    for i in range(6):
        made.observe("ab"[i % 2], random.standard_normal((30, 19)) * (1 + i % 2))
    return made


@pytest.fixture(scope="module")
def episodes():
    random = np.random.default_rng(7)
    return [(f"slide {m}", slide(m, 50, random).astype(np.float32)) for m in "ab"]


@pytest.mark.parametrize("form", ["made here", "of others"])
def test_lerobot_itself_reads_the_answers(tip, episodes, tmp_path, form):
    python = os.environ.get(LEROBOT)
    if not python:
        pytest.skip(
            f"{LEROBOT} names no Python that has lerobot: it pins torch below 2.12 and cannot be installed here"
        )
    if form == "of others" and not SHARED.exists():
        pytest.skip(f"no recordings of others: {SHARED} does not exist, and the project ships none")
    if form == "of others":
        learner, folder, column = tip, SHARED, "observation.tactile.tip"
    else:
        learner, folder, column = live_touches.learner(), robot_set(tmp_path / "set", episodes), FIELD
        info = json.loads((folder / "meta/info.json").read_text())
        del info["features"]["observation.image"]  # its file is no video
        (folder / "meta/info.json").write_text(json.dumps(info))
    output = annotate(learner, folder, output=tmp_path / "out", field=column).output
    reads = Path(__file__).with_name("lerobot_reads.py")
    alone = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "cache"), "PATH": os.environ["PATH"]}
    how = {"capture_output": True, "text": True, "timeout": 300}
    said = subprocess.run([python, reads, output, column], check=False, env=alone, **how)
    assert said.returncode == 0, said.stderr[-3000:]
    found, table = json.loads(said.stdout), whole(output)
    assert found["kinds"]["observation.touch.material"] == "torch.int64"
    for name, values in found["values"].items():
        np.testing.assert_array_equal(np.float32(values), np.float32(table[name].to_pylist()))
    assert found["readings"] == table[column].to_pylist()
    events = [[row["content"] for row in rows or []] for rows in table["language_events"].to_pylist()]
    assert found["events"] == events and sum(map(len, events)) >= 2
    assert found.get("emitted", [None] * len(events)) == [rows[0] if rows else None for rows in events]
    stats = json.loads((output / "meta/stats.json").read_text())
    assert found["stats"] == {name: stats[name] for name in found["stats"]}


def test_a_set_of_others_is_equal_but_for_the_new_columns(tip, tmp_path):
    if not SHARED.exists():
        pytest.skip(f"no recordings of others: {SHARED} does not exist, and the project ships none")
    done = annotate(tip, SHARED, output=tmp_path / "out", field="observation.tactile.tip")
    old, new = whole(SHARED), whole(done.output)
    assert new.select(old.schema.names).equals(old, check_metadata=True)  # also what datasets notes of its types
    stats = json.loads((done.output / "meta/stats.json").read_text())
    assert list(stats["observation.touch.known"])[-5:] == ["q01", "q10", "q50", "q90", "q99"]
    values = new["observation.touch.probability"].to_numpy()
    medians = [np.quantile(part.astype(np.float64), 0.5) for part in np.split(values, 3)]
    np.testing.assert_allclose(stats["observation.touch.probability"]["q50"], [np.mean(medians)])


@pytest.mark.parametrize("name", [name for name in ATTACKS if name.startswith("R7 lerobot")])
def test_a_set_that_was_made_to_harm_is_refused(tip, tmp_path, name):
    for place in ("in", "elsewhere"):
        (tmp_path / place).mkdir()
    secret = tmp_path / "elsewhere" / "secret"
    secret.write_bytes(bytes([SECRET]) * 4096)
    path, options = ATTACKS[name](tmp_path / "in", secret)
    before = pa.default_memory_pool().max_memory()
    with pytest.raises(InputError):
        annotate(tip, path, output=tmp_path / "out", field=options["field"])
    assert not (tmp_path / "elsewhere" / RAN).exists()
    assert not (tmp_path / "out").exists() and not (tmp_path / "out.annotating").exists()
    assert pa.default_memory_pool().max_memory() < max(before, 1 << 30)


def beside(folder, column, kind=None):
    """Write a column beside the others, without a note of what type it had."""
    path = folder / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    pq.write_table(table.append_column("beside", column), path, store_schema=False)
    return folder


LONG = "x" * (1 << 20)


@pytest.mark.parametrize("name", ["texts", "lists", "structures", "wide"])
def test_texts_beside_the_readings_are_counted_before_they_are_made(episodes, tmp_path, name):
    few, many = episodes[0][1], np.tile(episodes[0][1], (400, 1))
    folder = robot_set(tmp_path / "set", [("one", few if name == "wide" else many)])
    count = len(few if name == "wide" else many)
    columns = {
        "texts": lambda: pa.DictionaryArray.from_arrays(pa.array(np.zeros(count, np.int32)), pa.array([LONG])),
        "lists": lambda: pa.array([[LONG] if i < 4 else [] for i in range(count)]),
        "structures": lambda: pa.array([{"a": {"b": "c"}}] * count),
        "wide": lambda: pa.array([bytes(200)] * count, pa.binary(200)),
    }
    beside(folder, columns[name]())
    if name in ("texts", "wide"):
        with pytest.raises(RecordingError, match="claims to hold" if name == "texts" else "values of 200 bytes each"):
            annotate(live_touches.learner(), folder, field="pad")
        assert pa.total_allocated_bytes() < 1 << 28
        return
    old = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    assert whole(annotate(live_touches.learner(), folder, field="pad").output).select(old.schema.names).equals(old)


def test_links_out_of_a_set_are_not_followed(episodes, tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("nobody's")
    for place, change in {
        "README.md": lambda path: (path.unlink(), path.symlink_to(secret)),
        "videos/observation.image/chunk-000/file-000.mp4": lambda path: (path.unlink(), os.mkfifo(path)),
        "videos": lambda path: (shutil.rmtree(path), path.symlink_to(tmp_path)),
    }.items():
        folder = robot_set(tmp_path / f"set {len(place)}", episodes)
        change(folder / place)
        with pytest.raises(RecordingError, match=r"leads out|is a FIFO|is a link to a folder"):
            annotate(live_touches.learner(), folder, field="pad")


@pytest.fixture(scope="module")
def memory(tmp_path_factory):
    folder, random = tmp_path_factory.mktemp("memory") / "memory", np.random.default_rng(1)
    with TactileLearner.open(folder, sensor=PAD, embedding=SMALL) as learner:
        for i in range(18):
            learner.observe("abc"[i % 3], slide("abc"[i % 3], 50, random))
    return folder


class TestCommand:
    def test_it_writes_what_the_function_does(self, memory, episodes, tmp_path):
        folder = robot_set(tmp_path / "set", episodes)
        result = run("annotate", folder, "--memory", memory, "--field", "pad")
        assert result.exit_code == 0, result.output
        assert "annotated: 2 episodes, 2 touches; of 100 frames" in result.output
        assert f"written: {folder}-annotated" in result.output
        with TactileLearner.open(memory, mode="read") as learner:
            ours = annotate(learner, folder, output=tmp_path / "ours", field="pad")
        assert whole(ours.output).equals(whole(tmp_path / "set-annotated"))
        result = run(
            "annotate", folder, "--memory", memory, "--field", "pad", "--in-place", "--as", "numbers", "--json"
        )
        found = json.loads(result.stdout)
        assert (found["output"], found["kept"]) == (str(folder), str(folder / "meta.before"))
        assert "language_events" not in whole(folder).schema.names

    def test_it_says_what_to_do(self, memory, episodes, tmp_path):
        folder = robot_set(tmp_path / "set", episodes)
        how = ("annotate", folder, "--memory")
        assert "there is no memory in" in refused(*how, tmp_path / "none", "--field", "pad")
        assert "expected a field to read" in refused(*how, memory)
        assert "2 channels" in refused(*how, memory, "--field", "pad", "--columns", "0")
        assert "expected forms" in refused(*how, memory, "--field", "pad", "--as", "words")
        assert "'zinc'" in refused(*how, memory, "--field", "pad", "--scene", "a, zinc")
        assert run(*how, memory, "--field", "pad", "--in-place").exit_code == 0
        again = refused(*how, memory, "--field", "pad", "--in-place")
        assert "--replace answers anew" in again and "--as without numbers" in again
        assert "take another --output" in refused(*how, memory, "--field", "pad", "--output", tmp_path)
