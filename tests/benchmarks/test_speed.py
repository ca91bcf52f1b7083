"""Each call is timed in a process of its own, by the public names alone, and every case of the table is there.

The table is filled by workers of this process: that they are processes, and end like killed ones, has a test alone. The
default learner needs no torch: an empty module stands for the one that a worker imports.
"""

import json
import time
from dataclasses import replace

import pytest
from commands import refused, run

import scroll_tactile
from examples.benchmarks import checkouts as sides_of
from examples.benchmarks import many_materials, speed
from examples.benchmarks.checkouts import HERE, NAME_BYTES, Worker, checkouts, disk_bytes, write_touches
from examples.benchmarks.health import Measured
from examples.benchmarks.speed import run_speed
from examples.benchmarks.speed_bench import Sizes
from examples.benchmarks.speed_touches import SKIN
from examples.benchmarks.timing import Timing
from examples.benchmarks.worker import NAME_BYTES as READ_BYTES
from examples.benchmarks.worker import _Calls, _resident
from scroll_tactile import Kernels
from scroll_tactile.errors import InputError

FEW = {"touches": 20, "asked": 1, "pairs": 2, "starts": 1, "materials": 6, "before_materials": 0, "each": 2}
TINY = Sizes(**FEW, opening=(20,), before_opening=0)  # an older checkout beside the everyday memory alone


def test_a_timing_is_the_median_and_the_99th_percentile_of_its_calls():
    timing = Timing.of([0.001] * 98 + [0.5, 1.0])
    assert timing.median == 1.0
    assert 500 < timing.p99 < 1000
    assert timing.mean == pytest.approx(15.98)
    assert timing.record("of_") == {"of_median_milliseconds": 1.0, "of_p99_milliseconds": timing.p99}


@pytest.fixture(scope="module")
def without_torch(tmp_path_factory):
    """This checkout, with a torch that is imported at once."""
    folder = tmp_path_factory.mktemp("checkout")
    for package in ("scroll_tactile", "store"):
        (folder / package).symlink_to(HERE.parents[1] / package)
    (folder / "torch.py").write_text("class Tensor: pass\n")
    return folder


class Beside(Worker):
    """A worker's calls in this process."""

    def __init__(self, checkout, touches):
        self.calls, self.started = _Calls(touches, scroll_tactile), {"torch": 0.1} | _resident()

    def __exit__(self, *_):
        self.calls.learner._ledger.store.close()  # no checkpoint is written, as in a process that was killed

    def call(self, name, **take):
        if name == "memory":
            return _resident()
        call, begun = self.calls.make(name, take), time.perf_counter()
        said = call()
        return {"wall": time.perf_counter() - begun, "said": said}


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Every case, tiny, with this checkout beside itself."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(speed, "checkouts", lambda before: {"now": before, "before": before})
        for module in (speed, many_materials, sides_of):
            patch.setattr(module, "Worker", Beside)
        patch.setitem(Kernels.__init__.__kwdefaults__, "dimension", 64)
        patch.setattr(speed, "REPLAYED", 6)
        patch.setattr(speed, "REFRESHES", 2)
        return run_speed(sizes=TINY, before=tmp_path_factory.mktemp("checkout"))


def test_every_case_is_measured_on_both_sides(measured):
    found = {(record["memory"].split(" (")[0], record["case"]): record for record in measured["records"]}
    everyday = "20 touches of 20 materials, BioTac"
    for case, calls in (
        ("observe, durable", 20),
        ("import torch", 1),
        ("first predict after opening", 1),
        ("predict again", 20),
        ("predict right after an observe", 2),
        ("a reader's refresh after one observation", 2),
        ("open, 6 observations after the last close", 1),
    ):
        record = found[everyday, case]
        assert (record["calls"], record["before_calls"]) == (calls, calls)
        assert 0 < record["median"] <= (record["p99"] or record["largest"]) <= record["largest"]
        assert record["times"] == record["before_median"] / record["median"]
        assert record["of_forward"] == record["median"] / measured["resnet_forward"]["median_milliseconds"]
    assert found[everyday, "predict again"]["wrong"] < 0.5
    assert (
        found[everyday, "disk after closing"]["median"]
        > 20 * found[everyday, "journal, a touch with its readings"]["median"] / 1e3
    )
    assert (
        found[everyday, "memory beyond torch, after them"]["median"]
        <= found[everyday, "the most it held until then"]["median"]
    )
    many = "6 materials × 2 touches"
    assert found[many, "predict, scene of 3"]["calls"] == found[many, "… a memory of these 3 alone"]["calls"] == 6
    assert found[many, "predict, scene of 3"]["of_alone"] > 0
    assert found["20 touches of 20 materials", "open after a close"]["median"] > 0


def test_a_process_that_ended_without_a_close_left_what_it_acknowledged(without_torch, tmp_path):
    rng = speed.np.random.default_rng(0)
    made = [(f"m{i}", rng.uniform(-1, 1, (100, 8)).astype("float32")) for i in range(3)]
    touches = write_touches(tmp_path / "touches", SKIN, made, 100)
    for expected in (None, "m0"):
        with Worker(without_torch, touches) as worker:
            worker.call("open", path=str(tmp_path / "memory"))
            assert worker.call("predict", touch=0)["said"] == expected
            for i in range(3):
                worker.call("observe", touch=i)
            assert worker.memory() <= worker.memory("peak")
    assert disk_bytes(tmp_path / "memory") > disk_bytes(tmp_path / "memory", "log-*") > 3 * 100 * 8
    assert READ_BYTES == NAME_BYTES


def test_touches_of_another_seed_are_not_taken_for_ones_own(tmp_path):
    made = [("m0", speed.np.zeros((100, 8), "float32"))]
    for _ in range(2):
        write_touches(tmp_path / "touches", SKIN, made, 100, seed=0, each=1)
    for other in ({"seed": 1, "each": 1}, {"seed": 0, "each": 2}):
        with pytest.raises(InputError, match="give another folder"):
            write_touches(tmp_path / "touches", SKIN, made, 100, **other)


def test_what_was_measured_is_found_again_up_to_a_line_that_was_cut(tmp_path):
    (tmp_path / "cache").write_text('[["a", 1], {}]\n[["b", 2]')
    for _ in range(2):
        cached = Measured(tmp_path / "cache")
        assert cached.get(("a", 1), pytest.fail) == {}
        assert cached.get(("b", 2), lambda: {"found": 3}) == {"found": 3}
    assert (tmp_path / "cache").read_text() == '[["a", 1], {}]\n[["b", 2], {"found": 3}]\n'
    assert Measured(None).get(("a",), lambda: {"now": 1}) == {"now": 1}


def test_the_command_measures_prints_and_writes_it(tmp_path, monkeypatch, measured):
    asked = {}
    monkeypatch.setattr(speed, "run_speed", lambda **given: asked.update(given) or measured)
    result = run(
        "bench", "speed", "--materials", 200, "--opening", 20000, "--before", tmp_path, "--json", tmp_path / "r"
    )
    assert result.exit_code == 0, result.output
    assert asked["sizes"] == replace(Sizes(), materials=200, before_materials=200, opening=(10_000, 20_000))
    found = json.loads((tmp_path / "r").read_text())
    assert found["command"] == (
        "python -m examples.benchmarks speed --before BEFORE --touches 800 --pairs 200 --materials 200 "
        "--opening 20000 --seed 0"
    )
    assert str(tmp_path) not in (tmp_path / "r").read_text()
    assert {"load_average", "load_average_after", "versions", "date", "seed"} <= found.keys()
    assert "observe, durable" in result.output


def test_a_folder_that_is_no_checkout_is_refused(tmp_path):
    assert list(checkouts(None)) == ["now"]
    with pytest.raises(InputError, match="checkout"):
        checkouts(tmp_path)


def test_what_cannot_be_written_is_refused_before_anything_is_measured(tmp_path):
    assert "folder" in refused("bench", "speed", "--json", tmp_path / "none" / "n.json")
