"""A few of each fault of tests/faults, in seconds; the commands there do thousands."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

FAULTS = Path(__file__).parent / "faults"

needs_kill = pytest.mark.skipif(not hasattr(signal, "SIGKILL") or not hasattr(os, "fork"), reason="needs fork, kill -9")
needs_shim = pytest.mark.skipif(
    sys.platform != "linux" or not any(map(shutil.which, ("cc", "gcc", "clang"))),
    reason="needs Linux and a C compiler, for what SQLite does to files",
)


def quick(name, folder, *more):
    """Run a command; its exit code and its record."""
    record = folder / "record.json"
    command = [sys.executable, FAULTS / f"{name}.py", "--quick", "--json", record, *more]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert record.exists(), done.stdout + done.stderr
    return done.returncode, json.loads(record.read_text())


@pytest.mark.parametrize(
    ("name", "count"),
    [
        pytest.param("kill", "kills", marks=needs_kill),
        pytest.param("each_call", "calls", marks=[needs_kill, needs_shim]),
        pytest.param("power_cut", "disks", marks=needs_shim),
        ("bit_flips", "flips"),
        pytest.param("disk", "operations", marks=needs_shim),
        pytest.param("processes", "readers", marks=needs_kill),
        ("latency", "disk"),
        ("space", "large"),
    ],
)
def test_a_few_of_each_fault_do_no_harm(name, count, tmp_path):
    code, record = quick(name, tmp_path)
    assert record["failures"] == []
    assert code == 0
    assert record[count]
    if record.get("skipped"):
        pytest.skip("; ".join(record["skipped"]))


@needs_shim
def test_a_power_cut_would_be_noticed_where_the_log_was_not_synced(tmp_path):
    code, record = quick("power_cut", tmp_path, "--without", "log")
    assert code == 1
    assert len(record["failures"]) > 5
