"""Fixtures that several test modules share."""

import subprocess
import sys
from pathlib import Path

import pytest
from real_sets import CACHE

UNPACK = Path(__file__).parents[2] / "shared" / "data" / "unpack.py"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of BioTac-20 and RoboSkin-20 as published; skips where the data is not at hand."""
    if not UNPACK.exists():
        pytest.skip(f"no real data: {UNPACK} does not exist, and the project ships none")
    subprocess.run([sys.executable, UNPACK, CACHE, "biotac_slide_20_50"], check=True, timeout=300)
    return CACHE / "biotac_slide_20_50"
