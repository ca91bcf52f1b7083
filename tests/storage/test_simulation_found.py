"""What tests/faults/simulate.py found, each as the shortest case of it."""

import errno
import os

import pytest
from touches import filled

from store import DamageError, Store, repair_store
from store.framing import MARK


def test_packing_passes_over_what_a_failing_disk_does_not_let_go_of(tmp_path, monkeypatch):
    learner, _ = filled(tmp_path / "memory", [("a", (0, 60))])

    def refuse(*given, **named):
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as failing:
        failing.setattr(os, "rmdir", refuse)
        learner.pack(tmp_path / "packed")
    learner.close()
    with Store.open(tmp_path / "packed", mode="read") as packed:
        assert packed.last == 1


def test_a_repair_keeps_the_sound_rows_of_a_last_batch_that_a_checkpoint_proves(tmp_path):
    path = tmp_path / "store"
    with Store.open(path, identity={}) as store:
        with store.batch():
            for name in "abc":
                store.append("row", name, b"")
        store.commit({}, last_sequence=3)
    log = path / "log-00000001"
    data = bytearray(log.read_bytes())
    place = -1
    for _ in range(3):  # the header, the first row, the second
        place = data.index(MARK, place + 1)
    data[place + 100] ^= 1
    log.write_bytes(data)
    assert repair_store(path).kept == 3
    with Store.open(path) as store:
        assert [head.label for head in store.heads()] == ["a", "c"]


def test_a_bit_of_a_repaired_log_does_not_take_its_rows_away_unnoticed(tmp_path):
    path = tmp_path / "store"
    with Store.open(path, identity={}) as store:
        for name in "abc":
            store.append("row", name, b"")
    (path / "CURRENT").unlink()
    assert repair_store(path).lost == []
    log = path / "log-00000002"
    data = bytearray(log.read_bytes())
    data[data.index(MARK, 1) + 100] ^= 1  # of the first row
    log.write_bytes(data)
    with pytest.raises(DamageError, match="proves that it was durable"):
        Store.open(path)


def test_of_a_log_and_the_one_that_compaction_replaced_a_repair_takes_the_newer(tmp_path):
    path = tmp_path / "store"
    with Store.open(path, identity={}) as store:
        store.append("row", "a", b"")
        before = (path / "log-00000001").read_bytes()
        store.compact({}, last_sequence=1)
    (path / "log-00000001").write_bytes(before)  # a power cut brought it back
    (path / "CURRENT").unlink()
    repair_store(path)
    with Store.open(path) as store:
        assert store.compacted == 1
