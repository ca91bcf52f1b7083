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


def test_the_whole_system_keeps_what_it_acknowledged_and_bugs_are_found():
    done = subprocess.run(
        [sys.executable, SIMULATE, "--quick"], capture_output=True, text=True, check=False, timeout=300
    )
    told = done.stdout + done.stderr
    assert done.returncode == 0, told
    assert "12 seeds, 0 failed" in told
    assert "3 plants, 0 not found" in told
