"""Fixtures that several test modules share."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from quick_checkpoints import read_zarr, write_zarr
from real_sets import CACHE

from scroll_tactile.matching import likelihood

# The tests sync files tens of thousands of times: where there is room in memory, they do not wait for a disk.
IN_MEMORY = Path("/dev/shm")
if os.access(IN_MEMORY, os.W_OK) and shutil.disk_usage(IN_MEMORY).free > 2**32:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(IN_MEMORY))  # of `tmp_path`
    tempfile.tempdir = str(IN_MEMORY)

UNPACK = Path(__file__).parents[2] / "shared" / "data" / "unpack.py"


def pytest_configure(config: pytest.Config) -> None:
    """Workers are as many as cores: each computes on one, but where a test says how many."""
    if config.getoption("numprocesses", None):
        os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where a test's memory lies."""
    return tmp_path / "m"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of BioTac-20 and RoboSkin-20 as published; skips where the data is not at hand."""
    if not UNPACK.exists():
        pytest.skip(f"no real data: {UNPACK} does not exist, and the project ships none")
    subprocess.run([sys.executable, UNPACK, CACHE, "biotac_slide_20_50"], check=True, timeout=300)
    return CACHE / "biotac_slide_20_50"


@pytest.fixture(scope="session", autouse=True)
def shared_tables() -> Iterator[None]:
    """A table is a function of its noise, spread and weights: what one memory made, another of the same touches reads.

    Half of the time of a first prediction goes into tables, and most tests have memories of the same few touches.
    """
    made = likelihood._table

    @lru_cache(maxsize=512)
    def table(spread: bytes, weights: bytes, noise: likelihood.Noise) -> likelihood.Table:
        return made(np.frombuffer(spread), np.frombuffer(weights), noise)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(likelihood, "_table", lambda *of: table(of[0].tobytes(), of[1].tobytes(), of[2]))
        yield


BY_ZARR = ("test_store_commit", "test_store_roundtrip", "test_checkpoint_arrays")
"""What is about the writing and the reading themselves."""


@pytest.fixture(scope="module", autouse=True)
def quick_checkpoints(request: pytest.FixtureRequest) -> Iterator[None]:
    """Checkpoints are written without zarr, to the same bytes, and read, but in the tests of just that."""
    with pytest.MonkeyPatch.context() as patch:
        if request.path.stem not in BY_ZARR:
            patch.setattr("scroll_tactile_store.checkpoint_files._write_zarr", write_zarr)
            patch.setattr("scroll_tactile_store.checkpoint_files._read_zarr", read_zarr)
        yield
