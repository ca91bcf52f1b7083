"""What the judges of tests/faults found in the store, each as small as it can be."""

import os
import sys
from pathlib import Path

import pytest
from forging import spoil_row

from store import Store, check_store


@pytest.fixture
def path(tmp_path):
    """A store of three rows."""
    with Store.open(tmp_path / "s", identity={"a": 1}) as store:
        for i in range(3):
            store.append("kind", "label", bytes([i]), attributes={"i": i})
    return tmp_path / "s"


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_a_check_leaves_no_file_open(path):
    for damage in (False, True):
        if damage:
            spoil_row(path, 2, head=True)
        check_store(path)
        opened = [os.path.realpath(file) for file in Path("/proc/self/fd").iterdir()]
        assert not [name for name in opened if name.startswith(str(path))]
