"""Damage to the last rows of a log that replaced another: the batch without frames behind them proves it."""

from pathlib import Path

import numpy as np
import pytest

from store import DamageError, Store, check_store, repair_store

ARRAYS = {"values": np.arange(16.0)}


@pytest.fixture
def compacted(tmp_path) -> Path:
    """A store of three rows, the first of them compacted, whose last row has another bit."""
    folder = tmp_path / "store"
    with Store.open(folder, identity={"for": "a test"}) as store:
        for i in range(3):
            store.append("row", f"{i}", b"key", arrays=ARRAYS)
        store.compact(ARRAYS, last_sequence=1)
        offsets, sizes = store._journal._open.rows.offsets, store._journal._open.rows.sizes
        place = offsets[-1] + 88 + sizes[-1] - 1
    log = folder / "log-00000002"
    data = bytearray(log.read_bytes())
    data[place] ^= 1
    log.write_bytes(data)
    return folder


@pytest.mark.parametrize("after", [1, 2])
def test_a_damaged_last_row_is_not_taken_for_the_end(compacted, after):
    with Store.open(compacted, mode="read") as store, pytest.raises(DamageError, match=r"repair|row 3 is missing"):
        list(store.records(after=after))


def test_rows_before_it_are_read(compacted):
    with Store.open(compacted, mode="read") as store:
        assert store.record(2).label == "1"
        found = store.heads()
        assert [next(found).label, next(found).label] == ["0", "1"]
        with pytest.raises(DamageError, match="log-00000002"):
            next(found)
        assert [head.label for head in store.heads(kind="row")] == ["0", "1"]


def test_what_a_repair_leaves_is_read_to_its_end(compacted):
    assert any("log" in str(problem.what) for problem in check_store(compacted))
    assert repair_store(compacted).kept == 2
    with Store.open(compacted, mode="read") as store:
        assert [record.label for record in store.records(after=1)] == ["1"]


@pytest.mark.parametrize("place", [20, 80])
def test_rows_of_a_batch_whose_end_alone_is_damaged_are_kept(tmp_path, place):
    """What CURRENT has of the place behind it tells what the last frame was."""
    folder = tmp_path / "store"
    with Store.open(folder, identity={"for": "a test"}) as store:
        with store.batch():
            for i in range(3):
                store.append("row", f"{i}", b"key", arrays=ARRAYS)
        store.commit(ARRAYS, last_sequence=3)
    log = folder / "log-00000001"
    data = bytearray(log.read_bytes())
    data[len(data) - 88 + place] ^= 1
    log.write_bytes(data)
    with pytest.raises(DamageError, match=r"repair|row 3 is missing"):
        Store.open(folder)
    assert {problem.kind for problem in check_store(folder)} == {"spare"}
    repair = repair_store(folder)
    assert (repair.kept, repair.lost) == (3, [])
    with Store.open(folder) as store:
        assert store.compacted == 0
        assert [record.label for record in store.records()] == ["0", "1", "2"]
