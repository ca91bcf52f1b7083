"""A memory of format 3 opens in every later version: as a test this reads the golden one, as a script it makes it.

`python tests/memory/test_golden.py` makes `tests/data/format-3.zip`, a memory that has all kinds of rows and
checkpoints, and `tests/data/format-3.json`, what is in it. A release from 1.0 on never makes it again. Of
`tests/data/format-1.zip`, which 0.15 made, and `format-2.zip`, of 0.18, the file is left that says so.
"""

import hashlib
import json
import re
import shutil
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scroll_tactile_store.layout
from commands import refused
from scroll_tactile_store import Store, VersionError, check_store, repair_store
from scroll_tactile_store.layout import read_current, write_current

from scroll_tactile import Kernels, Quantity, Sensor, TactileLearner
from scroll_tactile.memory.gate import check_memory
from scroll_tactile.memory.identity import Identity
from scroll_tactile.memory.state import Memory

GOLDEN = Path(__file__).parents[1] / "data" / "format-3.zip"
EXPECTED = GOLDEN.with_suffix(".json")
PAD = Sensor(name="pad", channels=2, rate=50.0, low=0.0, high=1.0, unit="N", duration=1.0)
FORCE = Quantity(name="force", unit="N", low=0, high=4, resolution=0.125)
NAMES = ("felt", "Samt ü/√", "cork")
STANDING = [0, 1, 2, 3, 4, 6, 7, 8, 9]  # seeds of the touches in it, of 60 readings each; "cork" has one of 40 beside
ASKED = [(100 + seed, readings) for seed in range(3) for readings in (9, 30, 60)]
# What the memory says, but for f* and probabilities: machines solve with other last bits.
EXACT = ("digest", "materials", "exemplars", "descriptions", "kept", "axes", "quantities", "noted")


def stream(seed, readings=60):
    """A random walk whose step is the seed's: materials of their own."""
    rng = np.random.default_rng([seed, readings])
    return 0.5 + 0.4 * np.sin(np.cumsum(rng.normal(0, 0.1 + seed % 3 / 3, (readings, 2)), axis=0))


def noted(seed):
    """What is noted of a touch: of every second a value, of most a label."""
    return {
        "values": {} if seed % 2 else {"force": seed / 8},
        "labels": {"slip": ("north", "süd")[seed // 3 % 2]} if seed % 5 else {},
    }


def opened(path, mode="write"):
    return TactileLearner.open(path, sensor=PAD, embedding=Kernels(seed=0, dimension=64), exemplars=4, mode=mode)


def write(target):
    """Make the memory: felt, retracted, merged, compacted, fine-tuned, and left as a killed process leaves it."""
    with tempfile.TemporaryDirectory() as home:
        path, other_path = Path(home, "memory"), Path(home, "other")
        with opened(other_path) as other:
            other.declare(FORCE)
            for seed in range(4):
                other.observe(NAMES[seed % 3], stream(seed), **noted(seed))
            other.compact(keep=2)
        learner = opened(path)
        learner.declare(FORCE)
        with learner.batch():
            receipts = [
                learner.observe(NAMES[seed % 3], stream(seed), **noted(seed), source=f"{seed}.csv")
                for seed in range(4, 10)
            ]
        learner.retract(receipts[1])
        learner.describe("felt", {"wool": 0.75, "viscose": 0.25})
        learner.describe("cork", {"soft": False, "natural": True})
        learner.observe("short", stream(1, 8))
        learner.forget("short")
        learner.compact(keep=3)
        learner.merge(other_path)
        learner.fine_tune(epochs=1)
        learner.observe("cork", stream(20, 40), **noted(20))
        learner.describe("cork", {"soft": False, "natural": None})
        learner.retract(learner.observe("felt", stream(21)))
        with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in sorted(path.rglob("*")):
                if file.is_file() and file.name not in ("lock", "holder.json"):
                    archive.write(file, file.relative_to(path))
        said = json.dumps(content(learner), indent=1, ensure_ascii=False) + "\n"
        target.with_suffix(".json").write_text(said, encoding="utf-8")
        learner.close()


def content(learner, asked=ASKED):
    """All that a memory says, in JSON's types."""
    if asked:
        learner.settle()
    answers = [learner.predict(stream(*touch)) for touch in asked]
    return {
        "materials": learner.materials,
        "digest": learner.digest(),
        "exemplars": {name: [key.hex() for key in keys] for name, keys in learner.exemplars.items()},
        "tuned": learner.tuned_digest(),
        "descriptions": learner.descriptions,
        "answers": [[answer.material, round(answer.probability, 6)] for answer in answers],
        "kept": kept(learner),
        "axes": learner.axes,
        "quantities": [str(quantity) for quantity in learner.quantities.values()],
        "noted": [[row.values, row.labels] for row in learner.observations() if row.state != "retracted"],
    }


def kept(learner):
    """The kept touches, each as its material and key, and a digest of their levels."""
    touches = learner.memory.kept.touches()
    levels = hashlib.sha256(b"".join(touch.levels.tobytes() for touch in touches)).hexdigest()
    return [[[touch.material, touch.key.hex()] for touch in touches], levels]


def require(learner, asked=ASKED):
    """What the memory says is what was recorded."""
    found, expected = content(learner, asked), json.loads(EXPECTED.read_text(encoding="utf-8"))
    assert {name: found[name] for name in (*EXACT, "tuned")} == {name: expected[name] for name in (*EXACT, "tuned")}
    for (name, probability), (material, share) in zip(found["answers"], expected["answers"], strict=bool(asked)):
        assert name == material
        assert probability == pytest.approx(share, abs=1e-4)


@pytest.fixture
def golden(tmp_path):
    """A copy of the golden memory."""
    shutil.unpack_archive(GOLDEN, tmp_path / "m")
    return tmp_path / "m"


def test_it_is_small_and_holds_no_pickle():
    files = list(GOLDEN.parent.rglob("*"))
    assert len(files) <= 30 and sum(file.stat().st_size for file in files) < 500_000
    names = zipfile.ZipFile(GOLDEN).namelist()
    assert {name.split("/")[0].rstrip("0123456789") for name in names} == {"CURRENT", "log-", "checkpoints"}


def test_it_is_sound(golden):
    assert [problem for problem in check_store(golden) if problem.kind != "leftover"] == []
    assert check_memory(golden) == []


def test_every_kind_of_row_and_checkpoint_is_in_it(golden):
    with Store.open(golden, mode="read") as held:
        kinds = {"observe", "retract", "merge", "member", "describe", "declare"}
        assert {head.kind for head in held.heads()} == kinds
        assert 0 < held.compacted < held.latest().last_sequence < held.last
        assert {"sample", "kept", "exemplars", "descriptions", "tuned", "targets"} <= set(held.latest().attributes)
        assert len(held.compaction().arrays["exemplars-held-readings"])


@pytest.mark.parametrize("how", [opened, TactileLearner.open])
def test_it_says_what_was_recorded(golden, how):
    with how(golden, mode="read") as learner:
        require(learner, ASKED if how is opened else ())
        now = TactileLearner(sensor=PAD, embedding=Kernels(seed=0, dimension=64), exemplars=4)
        now.declare(FORCE)
        for seed in STANDING:
            now.observe(NAMES[seed % 3], stream(seed), **noted(seed))
        now.observe("cork", stream(20, 40), **noted(20))
        assert learner.digest() == now.digest()
        assert kept(learner) == kept(now)


def test_it_is_written_on(golden, monkeypatch):
    with opened(golden) as learner:
        require(learner, ())
        learner.retract(learner.observe("new", stream(30)))
        require(learner, ())
        learner.compact()
    embedded = []
    monkeypatch.setattr(Memory, "codes", lambda self, record: embedded.append(record))
    with opened(golden) as learner:
        require(learner, ())
    assert not embedded
    assert check_store(golden) == []


def test_it_is_what_this_version_writes(golden, tmp_path):
    """Where names or values on the disk change, an earlier version may not read them."""
    write(tmp_path / "again.zip")
    again, expected = (json.loads(file.read_text("utf-8")) for file in (tmp_path / "again.json", EXPECTED))
    assert {name: again[name] for name in EXACT} == {name: expected[name] for name in EXACT}
    shutil.unpack_archive(tmp_path / "again.zip", tmp_path / "again")
    written = []
    for path in (golden, tmp_path / "again"):
        with Store.open(path, mode="read") as held:
            rows = [(head.kind, head.label, head.key, sorted(head.attributes)) for head in held.heads()]
            arrays = [sorted(record.arrays) for record in held.records(held.compacted)]
            points = [
                (point.last_sequence, sorted(point.arrays), sorted(point.attributes))
                for point in (held.latest(), held.compaction())
            ]
            written.append((held.identity, rows, arrays, points))
            assert held.identity == Identity.read(held).to_json()
    assert written[0] == written[1]


def test_a_newer_format_is_refused_with_what_to_do(golden, monkeypatch):
    current = read_current(golden / "CURRENT")
    monkeypatch.setattr(scroll_tactile_store.layout, "FORMAT_VERSION", 4)
    write_current(golden, current)
    monkeypatch.undo()
    before = {file: file.read_bytes() for file in golden.rglob("*") if file.is_file()}
    for mode in ("write", "read"):
        with pytest.raises(VersionError, match="is written in format 4; this release reads format 3: upgrade it"):
            opened(golden, mode)
    assert {file: file.read_bytes() for file in golden.rglob("*") if file.is_file()} == before


@pytest.fixture(params=["0.18", "0.15", "0.7"])
def old(request, tmp_path):
    """What two releases left, and what is said of it."""
    path = tmp_path / "m"
    if request.param != "0.7":
        number, said = {"0.18": (2, r"0\.16 to 0\.18"), "0.15": (1, r"0\.15 or before")}[request.param]
        shutil.unpack_archive(GOLDEN.with_name(f"format-{number}.zip"), path)
        return path, rf"in format {number}, by scroll-tactile {said}; this one reads format 3: learn it again from the"
    (path / "generations" / "00000001").mkdir(parents=True)
    (path / "journal.sqlite").write_bytes(b"SQLite format 3\0" + bytes(4080))
    return path, "was made by a release 0.x, whose memories this one does not read: learn it again from the"


@pytest.mark.parametrize(
    "use",
    [
        TactileLearner.open,
        opened,
        lambda path: opened(path, "read"),
        lambda path: opened(path.parent / "ours").merge(path),
        check_store,
        check_memory,
        repair_store,
    ],
    ids=["open", "write", "read", "merge", "check", "check_memory", "repair"],
)
def test_a_memory_of_an_older_release_is_refused_by_name_and_left_as_it_is(old, use):
    path, said = old
    before = {file: file.is_file() and file.read_bytes() for file in path.rglob("*")}
    with pytest.raises(VersionError, match=said):
        use(path)
    np.save(path.with_name("t.npy"), stream(1))
    for words in (("memory", "backup", path, path.with_name("copy")), ("predict", path, path.with_name("t.npy"))):
        assert re.search(said, refused(*words))
    assert not path.with_name("copy").exists()
    assert {file: file.is_file() and file.read_bytes() for file in path.rglob("*")} == before


if __name__ == "__main__":
    GOLDEN.parent.mkdir(exist_ok=True)
    write(GOLDEN)
    print(EXPECTED.read_text(encoding="utf-8"))
