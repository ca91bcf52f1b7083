"""Where rows are is known from the checkpoint's index, or from the log where that is missing or another's."""

import random
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scroll_tactile_store import RecordError, Store, check_store, repair_store
from scroll_tactile_store.archive import write_archive
from scroll_tactile_store.checkpoint_files import INDEX
from scroll_tactile_store.layout import read_current, write_current
from scroll_tactile_store.rows import Rows

SUM = {"sum": np.arange(4)}


def made(path, rows=100, seed=0):
    """A store with rows of a few keys and checkpoints; its keys by sequence."""
    draw, keys = random.Random(seed), {}
    with Store.open(path, identity={"of": "rows"}) as kept:
        for _ in range(rows):
            key = bytes([draw.randrange(12)]) * draw.choice((0, 3, 8, 32))
            head = kept.append("observe", "a", key, arrays={"x": np.arange(3)})
            keys[head.sequence] = key
            if draw.random() < 0.2:
                kept.commit(SUM, last_sequence=head.sequence)
        kept.commit(SUM, last_sequence=90)
        for sequence in (rows + 1, rows + 2):
            keys[sequence] = kept.append("observe", "b", b"new").key
    return keys


@pytest.fixture
def path(tmp_path):
    return tmp_path / "s"


@pytest.fixture
def keys(path):
    return made(path)


def require_all(path, keys):
    """Every key finds its rows, and every row is what was written."""
    with Store.open(path, mode="read") as kept:
        for key in set(keys.values()):
            assert [head.sequence for head in kept.with_key(key)] == [n for n, own in keys.items() if own == key]
        assert list(kept.with_key(b"never")) == []
        assert [(head.sequence, head.key) for head in kept.heads()] == list(keys.items())
        newest = kept.latest()
        assert newest is None or list(newest.arrays) == ["sum"]


def scans(path, keys, monkeypatch):
    """Whether the log is read for where rows are, which are all found."""
    catch_up, begun = Rows.catch_up, []
    with monkeypatch.context() as patch:
        patch.setattr(Rows, "catch_up", lambda rows, *of: [begun.append(len(rows)), catch_up(rows, *of)][1])
        require_all(path, keys)
    return 0 in begun


def index_of(path):
    return next((path / "checkpoints").glob(f"*/{INDEX}*"))


def test_a_row_is_looked_up_without_the_log_being_read_also_in_a_copy_and_a_packed_store(
    tmp_path, path, keys, monkeypatch
):
    with Store.open(path) as kept:
        kept.backup(tmp_path / "copy")
    write_archive(path, tmp_path / "packed")
    for each in (path, tmp_path / "copy", tmp_path / "packed"):
        assert not scans(each, keys, monkeypatch)


def test_the_index_of_a_compacted_log_is_of_that_log(path, keys):
    with Store.open(path) as kept:
        kept.compact(SUM, last_sequence=60, newest=(SUM, {}))
    require_all(path, keys)
    with Store.open(path) as kept:
        keys[103] = kept.append("observe", "b", b"new").key
        kept.compact(SUM, last_sequence=70)
    require_all(path, keys)


@pytest.mark.parametrize("lost", ["flipped", "missing", "no checkpoint"])
def test_without_its_index_a_log_is_read(path, keys, monkeypatch, lost):
    if lost == "no checkpoint":
        write_current(path, replace(read_current(path / "CURRENT"), newest=None))
    elif lost == "flipped":
        file = next(each for each in index_of(path).rglob("*") if each.is_file() and each.name != "zarr.json")
        file.write_bytes(bytes([file.read_bytes()[0] ^ 1]) + file.read_bytes()[1:])
        assert [problem.kind for problem in check_store(path)] == ["spare"]
        repair_store(shutil.copytree(path, path.with_name("again")))
        with Store.open(path.with_name("again"), mode="read") as again:
            assert again.latest().last_sequence == read_current(path / "CURRENT").newest.last_sequence
        assert {problem.kind for problem in check_store(again.path)} == {"leftover"}
    else:
        shutil.rmtree(index_of(path))
    assert lost == "no checkpoint" or scans(path, keys, monkeypatch)
    require_all(path, keys)


@pytest.mark.parametrize("mode", ["read", "write"])
def test_a_repaired_log_is_not_read_by_the_index_of_the_one_before(path, keys, mode):
    log = path / "log-00000001"
    data = bytearray(log.read_bytes())
    place = read_current(path / "CURRENT").newest.place.offset
    data[place // 2] ^= 1
    log.write_bytes(data)
    assert repair_store(path).kept == 102
    with Store.open(path, mode=mode) as kept:
        for sequence in (1, 88, 101):
            (head,) = (head for head in kept.with_key(keys[sequence]) if head.sequence == sequence)
            assert head.key == keys[sequence]
        assert len(list(kept.heads())) in (101, 102)


def test_a_name_of_the_stores_own_is_refused(path, keys):
    with Store.open(path) as kept, pytest.raises(RecordError, match="no array may be called 'log-x'"):
        kept.commit({"log-x": np.arange(2)}, last_sequence=kept.last)


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
    assert [problem for problem in check_store(path) if problem.kind != "leftover"] == []
    with Store.open(path, mode=mode) as kept:
        assert [head.kind for head in kept.with_key(b"now")] == ["otherwise"] * 6
        assert len(list(kept.heads())) == len(list(kept.records())) == len(keys) + 6
