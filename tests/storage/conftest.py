"""Fixtures of the store's tests."""

import shutil
import subprocess

import pytest
from scroll_tactile_store import Store
from store_builds import build


@pytest.fixture(scope="session")
def stores(tmp_path_factory):
    """The stores of `build`, by whether they are compacted; not to be changed."""
    home = tmp_path_factory.mktemp("stores")
    return {compacted: build(home / str(compacted), compacted=compacted) for compacted in (False, True)}


@pytest.fixture(params=[False, True], ids=["plain", "compacted"])
def which(request):
    return request.param


@pytest.fixture
def either(stores, tmp_path, which):
    """A copy of one of `stores`: the test runs with each."""
    return shutil.copytree(stores[which], tmp_path / "s")


@pytest.fixture
def plain(stores, tmp_path):
    return shutil.copytree(stores[False], tmp_path / "s")


@pytest.fixture
def compacted(stores, tmp_path):
    return shutil.copytree(stores[True], tmp_path / "s")


@pytest.fixture
def opened(tmp_path):
    """An empty store, open to write."""
    with Store.open(tmp_path / "s", identity={}) as fresh:
        yield fresh


@pytest.fixture
def small_disk(tmp_path):
    """A file system of one megabyte, which only root may mount."""
    mount, command = tmp_path / "disk", shutil.which("mount")
    mount.mkdir()
    arguments = [command, "-t", "tmpfs", "-o", "size=1m", "tmpfs", mount]
    if command is None or subprocess.run(arguments, capture_output=True, check=False).returncode:
        pytest.skip("no small file system can be mounted here")
    yield mount
    subprocess.run(["umount", mount], check=True)
