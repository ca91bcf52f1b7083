"""Checkpoints: written whole, made durable before they count, in the background when asked."""

import logging
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import scroll_tactile_store.store
from quick_checkpoints import READ_BY_ZARR, WRITTEN_BY_ZARR, read_zarr, write_zarr
from scroll_tactile_store import DamageError, Store, StoreError, check_store
from store_builds import contents, fails, folders

ONE = {"x": np.arange(10)}


class Gate:
    """Holds writers of checkpoints at the door and counts them."""

    def __init__(self, monkeypatch):
        self.open, self.reached, self.last_sequences = threading.Event(), threading.Event(), []
        self.write = scroll_tactile_store.store.write_checkpoint
        monkeypatch.setattr(scroll_tactile_store.store, "write_checkpoint", self)

    def __call__(self, *given):
        self.last_sequences += [each.last_sequence for each in given if hasattr(each, "last_sequence")]
        self.reached.set()
        assert self.open.wait(10)
        return self.write(*given)


def test_appends_go_on_the_newest_waiting_commit_wins_and_others_wait(opened, monkeypatch):
    gate = Gate(monkeypatch)
    opened.append("a", "b", b"")
    opened.commit_later(ONE, last_sequence=0)
    assert gate.reached.wait(10)
    for last_sequence in (1, 2, 3):
        opened.append("a", "b", b"")
        opened.commit_later(ONE, last_sequence=last_sequence)
    assert (opened.last, opened.latest()) == (4, None)
    assert [thread.name for thread in threading.enumerate()].count("store commit s_0") == 1
    threading.Timer(0.05, gate.open.set).start()
    assert opened.commit(ONE, last_sequence=4) == 3
    assert gate.last_sequences == [0, 3, 4]
    opened.commit_later(ONE, last_sequence=4, attributes={"a": [1]})
    opened.close()  # which finishes what was handed over
    with Store.open(opened.path) as again:
        assert (again.latest().number, again.latest().attributes) == (4, {"a": [1]})
    assert "store commit" not in " ".join(thread.name for thread in threading.enumerate())


def test_a_program_that_forgets_to_close_ends_and_loses_no_row(tmp_path):
    """zarr writes nothing any more while the interpreter shuts down; the journal holds the row all the same."""
    code = """
import atexit, sys, numpy, scroll_tactile_store as store
opened = store.Store.open(sys.argv[1], identity={})
atexit.register(lambda: opened.commit_later({"x": numpy.arange(3)}, last_sequence=1))
opened.append("a", "b", b"")
opened.commit_later({"x": numpy.arange(2)}, last_sequence=1)
"""
    root = Path(scroll_tactile_store.__file__).parents[1]
    command = [sys.executable, "-c", code, tmp_path / "s"]
    ended = subprocess.run(command, cwd=root, check=True, timeout=60, capture_output=True)
    assert ended.stderr == b""
    with Store.open(tmp_path / "s") as again:
        assert again.last == 1
        assert again.commit(ONE, last_sequence=1)
    assert check_store(tmp_path / "s") == []


@pytest.mark.parametrize("surface", ["flush", "commit", "commit_later", "close"])
def test_a_failure_in_the_background_surfaces_once_and_is_logged(opened, monkeypatch, caplog, surface):
    with monkeypatch.context() as broken:
        broken.setattr(scroll_tactile_store.files, "sync_tree", fails())
        opened.commit_later(ONE, last_sequence=0)
        opened._wait()
    with pytest.raises(StoreError, match="Input/output error"):
        getattr(opened, surface)(**({"arrays": ONE, "last_sequence": 0} if "commit" in surface else {}))
    assert [record.levelno for record in caplog.records] == [logging.ERROR]
    if surface != "close":
        opened.flush()
        assert folders(opened.path) == []
        assert opened.commit(ONE, last_sequence=0) == 1


def test_an_error_of_the_caller_is_not_hidden_by_one_of_the_background(tmp_path, monkeypatch):
    monkeypatch.setattr(scroll_tactile_store.store, "write_checkpoint", fails())
    with pytest.raises(KeyError), Store.open(tmp_path, identity={}) as opened:
        opened.commit_later(ONE, last_sequence=0)
        raise KeyError


def test_a_loss_of_memory_is_not_taken_for_damage(opened, monkeypatch):
    opened.commit(ONE, last_sequence=0)

    def starve(*_):
        raise MemoryError

    monkeypatch.setattr("scroll_tactile_store.checkpoint_files._read_zarr", starve)
    with pytest.raises(StoreError) as caught:
        opened.latest()
    assert not isinstance(caught.value, DamageError)


# Most tests have checkpoints written and read in zarr's place (see tests/conftest.py): to the same bytes.

RNG = np.random.default_rng(0)
ARRAYS = {
    "floats": RNG.standard_normal((30, 4)),
    "short-floats": RNG.standard_normal((3, 2, 5)).astype(np.float32),
    "integers": RNG.integers(-(2**60), 2**60, (7, 3)),
    "small-integers": RNG.integers(0, 99, (40,)).astype(np.int16),
    "bytes": RNG.integers(0, 255, (2, 9)).astype(np.uint8),
    "none": np.zeros((0, 3)),
    "one": np.array(2.5),
}


@pytest.mark.parametrize("level", [None, 3, 6])
def test_every_file_has_the_bytes_that_zarr_gives_it(tmp_path, level):
    arrays = ARRAYS | ({"chunks": RNG.integers(0, 9, 10**6)} if level == 3 else {})  # which zarr writes
    for name, write in (("zarr", WRITTEN_BY_ZARR), ("quick", write_zarr)):
        group = write(tmp_path / name, arrays, level)
        group.update_attributes({"number": 1, "files": {"ü": [1, 2.5, None, True]}, "identity": {}})
    assert contents(tmp_path / "quick") == contents(tmp_path / "zarr")
    for name, array in arrays.items():
        for read in (read_zarr, READ_BY_ZARR):
            found = read(contents(tmp_path / "zarr" / name))
            assert (found.dtype, found.shape, found.tobytes()) == (array.dtype, array.shape, array.tobytes())


def test_the_store_writes_through_zarr_here(opened, monkeypatch):
    monkeypatch.setattr("zarr.create_group", None)
    with pytest.raises(TypeError):
        opened.commit(ONE, last_sequence=0)
