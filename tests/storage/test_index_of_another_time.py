"""The files of the index are those of a later time: a copy was put back over the folder, file by file."""

import shutil

import numpy as np
import pytest

import store.open_log
import store.rows
from store import Store, check_store

ARRAYS = {"values": np.arange(16.0)}


@pytest.fixture
def restored(tmp_path, monkeypatch):
    """A store that was restored over what was there, and then took another way."""
    for module in (store.rows, store.open_log):
        monkeypatch.setattr(module, "EVERY", 4)
    folder, copy = tmp_path / "store", tmp_path / "copy"
    with Store.open(folder, identity={"for": "a test"}) as opened:
        append(opened, "first", 4)
        opened.commit(ARRAYS, last_sequence=4)
        opened.backup(copy)
        append(opened, "then", 4)
        opened.commit(ARRAYS, last_sequence=8)
    assert list((folder / "derived").iterdir())
    shutil.copytree(copy, folder, dirs_exist_ok=True)
    with Store.open(folder) as opened:
        append(opened, "otherwise", 3, more=500)  # too few for an index of its own
        opened.commit(ARRAYS, last_sequence=7)
    return folder


def append(opened, kind, count, more=0):
    for i in range(count):
        opened.append(kind, f"{i}", bytes([i]), arrays={"values": np.random.default_rng(i).random(20 + more)})


@pytest.mark.parametrize("mode", ["read", "write"])
def test_an_index_of_another_time_is_not_used(restored, mode):
    assert [problem for problem in check_store(restored) if problem.kind != "leftover"] == []
    with Store.open(restored, mode=mode) as opened:
        assert [head.kind for head in opened.with_key(b"\1")] == ["first", "otherwise"]
        assert [head.kind for head in opened.heads()] == ["first"] * 4 + ["otherwise"] * 3
        assert len(list(opened.records())) == 7
