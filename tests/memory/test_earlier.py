"""A memory made with what only earlier versions have says what to do, shows what it holds, and is carried over.

Version 0.3 wrote `tests/data/gone`: "robust" with `Robust(Kernels(seed=0, dimension=64))` and Augmented(copies=1,
speed=2.0, thinned=True, noisy=2, noise=0.7), "copies" with the kernels alone and Augmented(copies=2, dead=0.3, noisy=1,
noise=0.5). Both observed six touches, of which the fourth was retracted, and a description, and were closed.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import refused, run

from scroll_tactile import Augmented, Kernels, Sensor, TactileLearner
from scroll_tactile.errors import EmbeddingMismatchError, MismatchError
from scroll_tactile.memory.earlier import is_gone, sample_of_windows, split_copies
from scroll_tactile.memory.identity import Identity
from scroll_tactile.memory.rows import row_codes, unpack_codes, unpack_windows
from scroll_tactile.signals.windows import Scale, WindowPlan
from scroll_tactile.statistics.sample import SampledTouch, TouchSample
from store import Store

GONE = Path(__file__).parents[1] / "data" / "gone"
PAD = Sensor(name="pad", channels=2, rate=50.0, low=0.0, high=1.0, unit="N", duration=0.4)
NAMES = ("felt", "cork", "silk")
SMALL = Kernels(seed=0, dimension=64)
EXPECTED = {"robust": (EmbeddingMismatchError, "has no longer"), "copies": (MismatchError, "dead=0.3.*noisy=1")}


def stream(seed, readings=24):
    rng = np.random.default_rng([seed, readings])
    return 0.5 + 0.4 * np.sin(np.cumsum(rng.normal(0, 0.1 + seed % 3 / 3, (readings, 2)), axis=0))


def fed(embedding):
    """What observes the same touches now."""
    learner = TactileLearner(sensor=PAD, embedding=embedding, exemplars=4)
    for seed in (0, 1, 2, 4, 5):
        learner.observe(NAMES[seed % 3], stream(seed))
    learner.describe("felt", {"wool": 0.75, "viscose": 0.25})
    return learner


@pytest.fixture(params=EXPECTED)
def memory(request, tmp_path):
    """Its folder, the error that it opens with, what that says, and the embedding that it is carried over to."""
    shutil.copytree(GONE / request.param, tmp_path / "m")
    return tmp_path / "m", *EXPECTED[request.param], SMALL if request.param == "copies" else Kernels()


def test_it_says_what_to_do(memory, tmp_path):
    path, error, said, _ = memory
    np.save(tmp_path / "t.npy", stream(9))
    for settings in ({}, {"mode": "read"}, {"sensor": PAD}, {"embedding": Kernels()}, {"augmentation": Augmented()}):
        with pytest.raises(error, match=f"{said}.*scroll-tactile memory reembed {path}"):
            TactileLearner.open(path, **settings)
    for words in (("predict", path, tmp_path / "t.npy"), ("observe", path, "new", tmp_path / "t.npy")):
        assert f"scroll-tactile memory reembed {path}" in refused(*words)


def test_it_is_carried_over_and_loses_nothing(memory):
    path, *_, embedding = memory
    with Store.open(path, mode="read") as store:
        before = [(head.sequence, head.kind, head.label, head.key, head.time) for head in store.heads()]
    assert "m.before" in run("memory", "reembed", path).stdout
    with Store.open(path, mode="read") as store:
        assert before == [(head.sequence, head.kind, head.label, head.key, head.time) for head in store.heads()]
    whole = fed(embedding)
    with TactileLearner.open(path) as learner:
        assert learner.augmentation is None
        assert learner.digest() == whole.digest()
        assert learner.exemplars == whole.exemplars
        assert learner.descriptions == whole.descriptions
        for seed in range(6, 9):
            assert learner.predict(stream(seed)) == whole.predict(stream(seed))
        learner.retract(1)
        learner.observe("new", stream(20))
        assert learner.materials == {"cork": 2, "new": 1, "silk": 2}


def test_to_the_default_embedding_and_to_any_other(memory):
    path, *_ = memory
    assert run("memory", "reembed", path, "--default").exit_code == 0
    with TactileLearner.open(path) as learner:
        assert learner.digest() == fed(Kernels()).digest()


def test_what_needs_nothing_embedded_works_without(memory, tmp_path):
    path, *_ = memory
    shown = json.loads(run("inspect", path, "--json").stdout)
    assert shown["materials"] == {"cork": 2, "felt": 1, "silk": 2}
    assert run("memory", "check", path).exit_code == 0
    assert run("memory", "backup", path, tmp_path / "copy").exit_code == 0
    assert json.loads(run("inspect", tmp_path / "copy", "--json").stdout)["digest"] == shown["digest"]
    assert f"scroll-tactile memory reembed {path}" in refused("memory", "export", path, tmp_path / "plain")
    run("memory", "reembed", path)
    assert run("memory", "export", path, tmp_path / "plain").exit_code == 0


def test_of_rows_in_no_generation_it_says_what_to_do(memory):
    path, *_ = memory
    shutil.rmtree(path / "generations")
    assert f"scroll-tactile memory reembed {path}" in refused("inspect", path)
    assert run("memory", "reembed", path).exit_code == 0
    with TactileLearner.open(path) as learner:
        assert sum(learner.materials.values()) == 5


def test_nothing_writes_it(memory, tmp_path):
    """Its statistics would lose what this version does not read, or its readings what carries it over."""
    path, *_ = memory
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    for words in (("compact", path, "--yes"), ("retract", path, 1), ("forget", path, "silk")):
        assert "scroll-tactile memory reembed" in refused("memory", *words)
    ours = TactileLearner.open(tmp_path / "ours", sensor=PAD, embedding=SMALL, exemplars=4)
    with ours, pytest.raises(MismatchError, match=r"embeddings differ|makes no longer"):
        ours.merge(path, shared="twice")
    assert {file: file.read_bytes() for file in before if file.exists()} == before


def test_a_compacted_one_says_who_opens_it(memory, monkeypatch):
    path, *_ = memory
    monkeypatch.setattr(Store, "compacted", 3)
    assert "rows 1 to 3 were compacted" in refused("memory", "reembed", path)


class TestIdentity:
    def test_copies_that_differ_in_speed_alone_are_those_of_now(self, tmp_path):
        kept = {"copies": 2, "speed": 2.0, "dead": 0.0, "offset": 0.0, "gain": 0.0, "noisy": 0, "noise": 1.0}
        identity = Identity.of(PAD, SMALL, 4).to_json() | {"augmentation": kept}
        Store.open(tmp_path / "m", identity=identity).close()
        with TactileLearner.open(tmp_path / "m", augmentation=Augmented(copies=2)) as learner:
            learner.observe("a", stream(1))
        assert Identity.from_json(identity).to_json() == Identity.of(PAD, SMALL, 4, Augmented(copies=2)).to_json()

    def test_none_of_this_is_written(self):
        assert "gone_copies" not in json.dumps(Identity.of(PAD, SMALL, 4, Augmented()).to_json())

    @pytest.mark.parametrize(("setting", "value"), [("dead", 0.1), ("gain", 0.1), ("noisy", 1), ("thinned", True)])
    def test_each_setting_that_is_gone_is_noticed_where_it_did_something(self, setting, value):
        assert split_copies({"copies": 2, "speed": 2.0, setting: value})[1][setting] == value

    def test_an_embedding_that_is_gone_is_noticed_within_another(self):
        robust = {"kind": "robust", "inner": SMALL.configuration(), "seed": 1}
        joined = {"kind": "joined", "parts": [SMALL.configuration(), {"kind": "joined", "parts": [robust, robust]}]}
        assert is_gone("kernels+robust kernels", joined)
        assert is_gone("robust kernels", None)
        assert not is_gone("robust kernels", SMALL.configuration())

    def test_an_embedding_of_ones_own_of_that_name_opens_its_memory(self, tmp_path):
        class Own(Kernels):
            name = "robust kernels"

        with TactileLearner.open(tmp_path / "m", sensor=PAD, embedding=Own(dimension=64)) as learner:
            learner.observe("a", stream(1))
        with TactileLearner.open(tmp_path / "m", embedding=Own(dimension=64)) as learner:
            assert learner.materials == {"a": 1}
        with pytest.raises(EmbeddingMismatchError):
            TactileLearner.open(tmp_path / "m")


def test_a_sample_is_read_without_the_rows_of_scales_that_are_gone():
    """As a memory of a user's own embedding holds it that once declared beginnings and noise."""
    plan, rng = WindowPlan((15, 37)), np.random.default_rng(0)
    now, then = TouchSample(), TouchSample()
    for i, columns in enumerate((12, 20, 30, 60)):
        pairs = [
            (stage, place) for stage, n in enumerate(plan.stages(columns)) for place in range(len(plan.judging(n)))
        ]
        rows = rng.integers(-9, 9, (len(pairs), 4)).astype(np.int32)
        now.add("m", bytes([i] * 32), SampledTouch(rows, np.array([(*pair, 3) for pair in pairs])))
        others = [(stage, 0, 3) for stage, place in pairs if place == 0] + [
            (len(plan.milestones()), k, 2) for k in (0, 1)
        ]
        mixed = np.array([*((stage, place + 1, 3) for stage, place in pairs), *others])
        order = np.lexsort((mixed[:, 1], mixed[:, 0]))
        every = np.concatenate([rows, np.full((len(others), 4), 99, np.int32)])
        then.add("m", bytes([i] * 32), SampledTouch(every[order], mixed[order]))
    found = sample_of_windows(then, [0, 1, 2, 3, 15, 37], plan)
    for (*_, touch), (*_, expected) in zip(found, now, strict=True):
        assert touch.rows.tobytes() == expected.rows.tobytes()
        assert touch.pairs.tolist() == expected.pairs.tolist()
    assert sample_of_windows(now, [15, 37], plan) is now


class TestRows:
    """Of rows that hold arrays of scales that are gone, those of windows are read."""

    plan = WindowPlan((15,))
    windows = np.arange(12, dtype=np.int32).reshape(3, 4)

    def test_stages(self):
        arrays = {f"stages-{number}": np.ones((2, 4), np.int32) for number in range(4)}
        arrays["stages-15"] = self.windows
        assert list(unpack_codes(arrays)) == [Scale("window", 15)]
        assert list(row_codes(arrays, 30, self.plan, None)) == [Scale("window", 15)]

    def test_codes_and_places_among_values(self):
        values, places = np.arange(12, dtype=np.int32), np.arange(12).reshape(3, 4).T.astype(np.uint8)
        for name in ("codes-1", "codes-15"):
            arrays = {name: self.windows, "values-0": values, "places-0": places}
            found = unpack_windows(arrays)
            assert list(found) == [Scale("window", 15)] * (name == "codes-15")
        arrays = {"values-15": values, "places-15": places, "values-3": values, "places-3": places}
        found = unpack_windows(arrays)
        assert list(found) == [Scale("window", 15)]
        np.testing.assert_array_equal(found[Scale("window", 15)], self.windows)
