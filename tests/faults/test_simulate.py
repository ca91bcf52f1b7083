"""Some seeds of the simulation, and some bugs that it must find; tests/faults/simulate.py has thousands."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SIMULATE = Path(__file__).with_name("simulate.py")

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or not any(map(shutil.which, ("cc", "gcc", "clang"))),
    reason="needs Linux and a C compiler, for what is done to files",
)


def simulated(*options):
    command = [sys.executable, SIMULATE, *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    return done.returncode, done.stdout + done.stderr


def test_the_whole_system_keeps_what_it_acknowledged():
    code, told = simulated("--seeds", "20")
    assert code == 0, told


@pytest.mark.parametrize(
    "plant", ["the log is not synced", "a retraction is lost in a merge", "a reader does not notice another log"]
)
def test_a_bug_is_found(plant):
    code, told = simulated("--seeds", "100", "--whole", "--plant", plant)
    assert code == 0, told
    assert "found in" in told
