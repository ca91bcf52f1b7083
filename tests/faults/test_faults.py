"""A few of each fault of tests/faults, in seconds; the commands there do thousands."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

FAULTS = Path(__file__).parent
COUNTS = {
    "kill": "kills",
    "each_call": "calls",
    "power_cut": "disks",
    "bit_flips": "flips",
    "disk": "operations",
    "processes": "readers",
    "latency": "disk",
    "space": "large",
    "hostile": "cases",
    "threads": "calls",
}

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or not any(map(shutil.which, ("cc", "gcc", "clang"))),
    reason="needs Linux and a C compiler, for what is done to files",
)


def quick(name, folder, *more):
    """Run a command; its exit code and its record."""
    record = folder / "record.json"
    command = [sys.executable, FAULTS / f"{name}.py", "--quick", "--json", record, *more]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert record.exists(), done.stdout + done.stderr
    return done.returncode, json.loads(record.read_text())


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    return quick("all", tmp_path_factory.mktemp("faults"))[1]


@pytest.mark.parametrize("name", COUNTS)
def test_a_few_of_each_fault_do_no_harm(name, records):
    record = records[name]
    assert record["failures"] == []
    assert record[COUNTS[name]]
    if record.get("skipped"):
        pytest.skip("; ".join(record["skipped"]))


def test_hostile_recordings_do_no_harm(tmp_path):
    code, record = quick("hostile", tmp_path, "--recordings")
    assert record["failures"] == []
    assert record["cases"]
    assert code == 0


def test_a_power_cut_would_be_noticed_where_the_log_was_not_synced(tmp_path):
    code, record = quick("power_cut", tmp_path, "--without", "log")
    assert code == 1
    assert len(record["failures"]) > 5


def test_what_the_gate_keeps_out_would_be_noticed_without_it(tmp_path):
    code, record = quick("hostile", tmp_path, "--without", "gate", "--cases", "20")
    assert code == 1
    assert len(record["failures"]) > 10
