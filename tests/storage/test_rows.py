"""Where rows are is known from the checkpoint's index, or from the log where that is missing or another's."""

import os
import random
import shutil

import numpy as np
import pytest
from forging import get_current, log_of, set_current
from scroll_tactile_store import Store, check_store, repair_store
from scroll_tactile_store.archive import write_archive
from scroll_tactile_store.checkpoint_files import INDEX
from store_builds import damage, flip, newest, sequences

SUM = {"sum": np.arange(4)}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "s"


@pytest.fixture
def keys(path):
    """A store with rows of a few keys, most of them with large arrays, and checkpoints; its keys by sequence."""
    draw, keys = random.Random(0), {}
    with Store.open(path, identity={"of": "rows"}) as kept:
        for _ in range(100):
            key = bytes([draw.randrange(12)]) * draw.choice((0, 3, 8, 32))
            noise = np.frombuffer(draw.randbytes(2000), np.uint8)
            head = kept.append("observe", "a", key, arrays={"x": noise})
            keys[head.sequence] = key
            if draw.random() < 0.1:
                kept.commit(SUM, last_sequence=head.sequence)
        kept.commit(SUM, last_sequence=90)
        for sequence in (101, 102):
            keys[sequence] = kept.append("observe", "b", b"new").key
    return keys


def looked_through(path, keys, monkeypatch):
    """Whether all of the log is read to find one key's rows; every key finds its own, and nothing else."""
    read, parts = os.read, []
    with monkeypatch.context() as patch:
        patch.setattr(os, "read", lambda file, size: parts.append(size) or read(file, size))
        with Store.open(path, mode="read") as kept:
            assert sequences(kept.with_key(b"new")) == [n for n in keys if n > 100]
    with Store.open(path, mode="read") as kept:
        for key in set(keys.values()):
            assert sequences(kept.with_key(key)) == [n for n, own in keys.items() if own == key]
        assert list(kept.with_key(b"never")) == []
        assert [(head.sequence, head.key) for head in kept.heads()] == list(keys.items())
        latest = kept.latest()
        assert latest is None or list(latest.arrays) == ["sum"]
    return len(parts) > len(keys)


def test_a_row_is_looked_up_without_the_log_being_read_also_in_a_copy_and_a_packed_store(
    tmp_path, path, keys, monkeypatch
):
    with Store.open(path) as kept:
        kept.backup(tmp_path / "copy")
    write_archive(path, tmp_path / "packed")
    for each in (path, tmp_path / "copy", tmp_path / "packed"):
        assert not looked_through(each, keys, monkeypatch)
    with Store.open(path) as kept:
        kept.compact(SUM, last_sequence=60, newest=(SUM, {}))
    assert not looked_through(path, keys, monkeypatch)
    with Store.open(path) as kept:
        keys[103] = kept.append("observe", "b", b"new").key
        kept.compact(SUM, last_sequence=70, newest=(SUM, {}))
    assert not looked_through(path, keys, monkeypatch)


@pytest.mark.parametrize("lost", ["flipped", "missing", "no checkpoint"])
def test_without_its_index_a_log_is_read(path, keys, monkeypatch, lost):
    index = next(newest(path).glob(f"{INDEX}*"))
    if lost == "no checkpoint":
        set_current(path, newest=None)
    elif lost == "missing":
        shutil.rmtree(index)
    else:
        flip(next(file for file in index.rglob("*") if file.is_file() and file.name != "zarr.json"))
        again = shutil.copytree(path, path.with_name("again"))
        assert damage(again) != []
        repair_store(again)
        with Store.open(again, mode="read") as opened:
            assert opened.latest().last_sequence == get_current(path)["newest"]["last_sequence"]
        assert {problem.kind for problem in check_store(again)} == {"leftover"}
    assert looked_through(path, keys, monkeypatch)


@pytest.mark.parametrize("mode", ["read", "write"])
def test_a_repaired_log_is_not_read_by_the_index_of_the_one_before(path, keys, mode):
    flip(log_of(path), log_of(path).stat().st_size // 2)
    assert repair_store(path).kept == 102
    with Store.open(path, mode=mode) as kept:
        for sequence in (1, 88, 101):
            (head,) = (head for head in kept.with_key(keys[sequence]) if head.sequence == sequence)
            assert head.key == keys[sequence]
        assert len(list(kept.heads())) in (101, 102)


@pytest.mark.parametrize("mode", ["read", "write"])
def test_a_copy_put_back_over_the_folder_that_went_another_way_is_read_as_it_is(tmp_path, path, keys, mode):
    copy = tmp_path / "copy"
    with Store.open(path) as kept:
        kept.backup(copy)
        for _ in range(9):
            kept.append("then", "a", b"now")
        kept.commit({}, last_sequence=kept.last)
    shutil.copytree(copy, path, dirs_exist_ok=True)
    with Store.open(path) as kept:
        for number in range(6):
            kept.append("otherwise", "a", b"now", arrays={"x": np.arange(number + 500)})
        kept.commit({}, last_sequence=kept.last)
    assert damage(path) == []
    with Store.open(path, mode=mode) as kept:
        assert [head.kind for head in kept.with_key(b"now")] == ["otherwise"] * 6
        assert len(list(kept.heads())) == len(list(kept.records())) == len(keys) + 6
