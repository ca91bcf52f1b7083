"""Memories written by earlier releases are read: run as a test it reads them, run as a script it writes this one's.

`python tests/memory/test_golden.py` makes `tests/data/<version>/`: a store that has all kinds of rows and generations,
and `expected.json`, what was in it. A release adds its own and never touches those of others.
"""

import hashlib
import json
import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from scroll_tactile import Kernels, Sensor, TactileLearner, __version__
from scroll_tactile.errors import MismatchError
from scroll_tactile.memory.state import Memory
from store import Store, VersionError

DATA = Path(__file__).parents[1] / "data"
PAD = Sensor(name="pad", channels=2, rate=50.0, low=0.0, high=1.0, unit="N", duration=1.0)
# Of what earlier releases observed: it is viewed and kept as now, but for what was compacted. Before 0.3 its windows
# count as the stages that they make, but for the same.
EARLIER = {
    "0.1.0": "140956f954c31c819cbe4ce52734c4a7f3082e418d526dd673003160637dea2e",
    "0.2.0": "140956f954c31c819cbe4ce52734c4a7f3082e418d526dd673003160637dea2e",
    "0.3.0": "fd4382a21ead3d6d3a1a7e110ebc593960402bd1d8fe83188c99697183a73705",
}
NAMES = ("felt", "Samt ü/√", "cork")
COMPACTED = (0, 1, 2, 3, 6, 7, 8, 9, 11)  # seeds of the touches whose readings are gone, of 60 readings each
ASKED = [(100 + seed, readings) for seed in range(3) for readings in (9, 30, 60)]


def stream(seed, readings):
    """A random walk whose step is the seed's: materials of their own."""
    rng = np.random.default_rng([seed, readings])
    return 0.5 + 0.4 * np.sin(np.cumsum(rng.normal(0, 0.1 + seed % 3 / 3, (readings, 2)), axis=0))


def open_golden(path, mode="write"):
    return TactileLearner.open(path, sensor=PAD, embedding=Kernels(seed=0, dimension=64), exemplars=4, mode=mode)


def content(learner):
    """All that a memory says, in JSON's types."""
    learner.settle()
    answers = [learner.predict(stream(*asked)) for asked in ASKED]
    return {
        "materials": learner.materials,
        "digest": learner.digest(),
        "exemplars": {name: [key.hex() for key in keys] for name, keys in learner.exemplars.items()},
        "tuned": learner.tuned_digest(),
        "descriptions": learner.descriptions,
        "answers": [[answer.material, round(answer.probability, 6)] for answer in answers],
        "kept": kept(learner),
    }


def kept(learner):
    """The touches kept for recall, each as its material and key, and a digest of their levels."""
    touches = learner.memory.kept.touches()
    levels = hashlib.sha256(b"".join(touch.levels.tobytes() for touch in touches)).hexdigest()
    return [[touch.material, touch.key.hex()] for touch in touches], levels


def fresh(seeds):
    """A memory without a path that observes now what is in a golden store: touches of some seeds, and the last."""
    learner = TactileLearner(sensor=PAD, embedding=Kernels(seed=0, dimension=64), exemplars=4)
    for seed in seeds:
        learner.observe(NAMES[seed % 3], stream(seed, 60))
    learner.observe("cork", stream(20, 40))
    return learner


def arrays_of(learner, endings):
    """The arrays of the statistics whose names end so, to the byte."""
    arrays, _ = learner.memory.statistics.to_arrays()
    return {name: array.tobytes() for name, array in arrays.items() if name.endswith(tuple(endings))}


def require(learner, expected):
    found = json.loads(json.dumps(content(learner)))
    exact = [name for name in expected if name not in ("answers", "earlier", "current")]
    assert {name: found[name] for name in exact} == {name: expected[name] for name in exact}
    if expected["current"]:  # the readouts of earlier ones were others
        for (name, probability), (material, share) in zip(found["answers"], expected["answers"], strict=True):
            assert name == material
            assert probability == pytest.approx(share, abs=1e-4)  # machines solve with other last bits


def write(folder):
    """Make the store: felt, retracted, merged, compacted, fine-tuned, and left as a killed process leaves it."""
    shutil.rmtree(folder, ignore_errors=True)
    with open_golden(folder / "other") as other:
        for seed in range(6):
            other.observe(NAMES[seed % 3], stream(seed, 60))
        other.compact(keep=2)
    learner = open_golden(folder / "memory")
    with learner.batch():
        receipts = [learner.observe(NAMES[seed % 3], stream(seed, 60)) for seed in range(6, 18)]
    learner.retract(receipts[4])
    learner.describe("felt", {"wool": 0.75, "viscose": 0.25})
    learner.describe("cork", {"soft": False, "natural": True})
    learner.observe("short", stream(1, 8))
    learner.forget("short")
    learner.compact(keep=6)
    learner.merge(folder / "other", shared="once")
    learner.fine_tune(epochs=1)
    learner.observe("cork", stream(20, 40))
    learner.describe("cork", {"soft": False, "natural": None})
    learner.retract(learner.observe("felt", stream(21, 60)))
    shutil.rmtree(folder / "other")
    shutil.copytree(folder / "memory", folder / "store", ignore=shutil.ignore_patterns("*-shm", "lock", "holder.json"))
    (folder / "expected.json").write_text(json.dumps(content(learner), indent=1) + "\n", encoding="utf-8")
    learner.close()
    shutil.rmtree(folder / "memory")


@pytest.fixture(params=sorted(path.name for path in DATA.iterdir() if (path / "expected.json").is_file()))
def golden(request, tmp_path):
    """A copy of a golden store, and what is in it."""
    shutil.copytree(DATA / request.param / "store", tmp_path / "m")
    expected = json.loads((DATA / request.param / "expected.json").read_text(encoding="utf-8"))
    expected["current"] = request.param == __version__
    if request.param in EARLIER:
        expected |= {"digest": EARLIER[request.param], "earlier": request.param}
    return tmp_path / "m", expected


def test_it_is_read(golden):
    path, expected = golden
    with open_golden(path, mode="read") as learner:
        require(learner, expected)


def test_it_opens_from_its_path_alone(golden):
    path, expected = golden
    with TactileLearner.open(path, mode="read") as learner:
        require(learner, expected)


def test_it_is_written_on(golden):
    path, expected = golden
    with open_golden(path) as learner:
        require(learner, expected)
        receipt = learner.observe("new", stream(30, 60))
        learner.retract(receipt)
        require(learner, expected)
        learner.compact()
    with open_golden(path) as learner:
        require(learner, expected)


def test_it_is_upgraded_to_what_its_touches_give_now_once(golden, monkeypatch):
    path, expected = golden
    earlier, embedded = expected.get("earlier"), []
    codes = Memory.codes
    monkeypatch.setattr(Memory, "codes", lambda self, record: embedded.append(record) or codes(self, record))
    there = [seed for seed in range(18) if seed != 10]
    now = fresh([seed for seed in there if not (earlier and seed in COMPACTED)])
    with open_golden(path) as learner:
        views = [f"-{view}" for view in learner.plan.views]
        assert arrays_of(learner, views) == arrays_of(now, views)
        if earlier in (None, "0.3.0"):
            widths = ["observations", "lengths", *(f"-{width}" for width in learner.plan.widths)]
            assert arrays_of(learner, widths) == arrays_of(fresh(there), widths)
        assert kept(learner) == kept(now)
        assert (learner.digest() == now.digest()) == (not earlier)
    assert embedded
    embedded.clear()
    with open_golden(path) as learner:
        assert kept(learner) == kept(now)
        assert learner.digest() == expected["digest"]
    assert not embedded


def test_every_kind_of_row_and_generation_is_in_it(golden):
    path, _ = golden
    assert (path / "journal.sqlite-wal").stat().st_size > 0
    with Store.open(path, mode="read") as store:
        assert {head.kind for head in store.heads()} == {"observe", "retract", "merge", "felt", "describe"}
        assert 0 < store.compacted < store.last
        assert store.latest().upto < store.last
        assert "tuned" in store.latest().attributes


def test_it_is_what_this_release_writes(tmp_path):
    """Where the format changes, a new version and a new golden store are due."""
    current = DATA / __version__
    write(tmp_path / "again")
    again, expected = (json.loads((one / "expected.json").read_text()) for one in (tmp_path / "again", current))
    for exact in ("digest", "materials", "exemplars", "descriptions", "kept"):  # an f* is not the same on every machine
        assert again[exact] == expected[exact]
    shutil.copytree(current / "store", tmp_path / "golden")  # a look with SQLite empties its log
    shapes = []
    for path in (tmp_path / "again" / "store", tmp_path / "golden"):
        with closing(sqlite3.connect(path / "journal.sqlite")) as connection:
            shapes.append(connection.execute("SELECT name, sql FROM sqlite_master ORDER BY name").fetchall())
        with Store.open(path) as store:
            shapes[-1] += sorted(store.latest().arrays)
    assert shapes[0] == shapes[1]


def test_a_newer_store_is_refused_with_what_to_do(golden):
    path, _ = golden
    with Store.open(path):
        pass  # so that its log is in the file
    with closing(sqlite3.connect(path / "journal.sqlite")) as connection:
        connection.execute("PRAGMA user_version = 99")
    before = (path / "journal.sqlite").read_bytes()
    with pytest.raises(VersionError, match="is written in format 99; this release reads up to format 1: upgrade it"):
        open_golden(path)
    assert (path / "journal.sqlite").read_bytes() == before


def test_a_row_of_an_unknown_kind_is_refused_with_what_to_do(golden):
    path, _ = golden
    with Store.open(path) as store:
        store.append("dream", "", b"")
    with pytest.raises(MismatchError, match=r"is of kind 'dream', .* Open the memory with the version that wrote it"):
        open_golden(path)


if __name__ == "__main__":
    write(DATA / __version__)
    print((DATA / __version__ / "expected.json").read_text())
    sys.exit()
