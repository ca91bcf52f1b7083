"""Where rows are is known from the index's files, or from the log where they are wrong or lost, and always the same."""

import random
import shutil
import struct

import numpy as np
import pytest
import scroll_tactile_store.open_log
import scroll_tactile_store.rows
from scroll_tactile_store import Store, check_store
from scroll_tactile_store.derived import HEADER as DERIVED
from scroll_tactile_store.derived import MARK, read_derived, write_derived
from scroll_tactile_store.encoding import encode_payload
from scroll_tactile_store.records import payload_digest
from scroll_tactile_store.rows import HEADER


@pytest.fixture(scope="module", autouse=True)
def small():
    with pytest.MonkeyPatch.context() as patch:
        for module in (scroll_tactile_store.rows, scroll_tactile_store.open_log):
            patch.setattr(module, "EVERY", 8)
        yield


@pytest.fixture(scope="module")
def whole(small, tmp_path_factory):
    """A store, not to be changed, and its keys."""
    path = tmp_path_factory.mktemp("whole") / "s"
    return path, made(path)


@pytest.fixture
def keys(whole, tmp_path):
    """The keys of the copy of it in tmp_path / "s"."""
    shutil.copytree(whole[0], tmp_path / "s")
    return dict(whole[1])


def made(path, rows=100, seed=0):
    """A store with rows of a few keys, checkpoints and several files of the index; its keys by sequence."""
    draw, keys = random.Random(seed), {}
    with Store.open(path, identity={"of": "rows"}) as kept:
        for _ in range(rows):
            key = bytes([draw.randrange(12)]) * draw.choice((0, 3, 8, 32))
            head = kept.append("observe", "a", key, arrays={"x": np.arange(3)})
            keys[head.sequence] = key
            if draw.random() < 0.2:
                kept.commit({"sum": np.arange(4)}, last_sequence=head.sequence)
        kept.commit({"sum": np.arange(4)}, last_sequence=kept.last)
    return keys


def files(path):
    return sorted((path / "derived").iterdir())


def require_all(path, keys):
    """Every key finds its rows, and every row is what was written."""
    with Store.open(path, mode="read") as kept:
        for key in set(keys.values()):
            assert [head.sequence for head in kept.with_key(key)] == [n for n, own in keys.items() if own == key]
        assert list(kept.with_key(b"never")) == []
        assert [(head.sequence, head.key) for head in kept.heads()] == list(keys.items())
        assert kept.record(1).key == keys[1]


def test_it_is_the_log_that_counts_whatever_the_files_say(tmp_path, keys):
    assert len(files(tmp_path / "s")) > 1
    require_all(tmp_path / "s", keys)
    for file in files(tmp_path / "s"):
        whole = file.read_bytes()
        for place in (0, 20, HEADER.size + 3, -1):
            harmed = bytearray(whole)
            harmed[place] ^= 1
            file.write_bytes(harmed)
            require_all(tmp_path / "s", keys)
        file.write_bytes(whole[:-40])
        require_all(tmp_path / "s", keys)
        file.write_bytes(whole)
    shutil.rmtree(tmp_path / "s" / "derived")
    require_all(tmp_path / "s", keys)


@pytest.mark.parametrize("column", [0, 1, 2])
def test_a_forged_file_is_dropped_where_it_is_found_out(tmp_path, keys, column):
    file = files(tmp_path / "s")[0]
    data = bytearray(file.read_bytes()[:-16])
    count = HEADER.unpack_from(data)[-1]
    at = HEADER.size + 8 * count * column + 8 * (count // 2)
    struct.pack_into("<Q", data, at, struct.unpack_from("<Q", data, at)[0] + 1)
    file.write_bytes(bytes(data) + payload_digest(bytes(data)))
    with Store.open(tmp_path / "s", mode="read") as kept:
        assert [(head.sequence, head.key) for head in kept.heads()] == list(keys.items())


@pytest.mark.parametrize("field", [5, 6, 7])
def test_a_forged_end_is_found_out_and_the_log_read_again(tmp_path, keys, field):
    file = files(tmp_path / "s")[-1]
    data = file.read_bytes()[:-16]
    head = list(HEADER.unpack_from(data))
    head[field] = bytes(16) if field == 7 else head[field] - 1
    data = HEADER.pack(*head) + data[HEADER.size :]
    file.write_bytes(data + payload_digest(data))
    require_all(tmp_path / "s", keys)


def test_a_new_log_has_files_of_its_own(tmp_path, keys):
    with Store.open(tmp_path / "s") as kept:
        kept.compact({"sum": np.arange(4)}, last_sequence=60)
        for _ in range(20):
            head = kept.append("observe", "b", b"new")
            keys[head.sequence] = b"new"
        kept.commit({"sum": np.arange(4)}, last_sequence=kept.last)
    with Store.open(tmp_path / "s", mode="read") as kept:
        assert [head.sequence for head in kept.with_key(b"new")] == list(range(101, 121))
        assert [head.sequence for head in kept.heads()] == list(keys)
    assert len(files(tmp_path / "s")) == 1


def test_there_are_few_files_however_many_rows(tmp_path):
    keys = made(tmp_path / "s", rows=150)
    assert len(files(tmp_path / "s")) <= 8
    require_all(tmp_path / "s", keys)


@pytest.mark.parametrize("mode", ["read", "write"])
def test_files_of_another_time_are_not_believed(tmp_path, keys, mode):
    """A copy was put back over the folder, file by file, and then went another way."""
    path, copy = tmp_path / "s", tmp_path / "copy"
    with Store.open(path) as kept:
        kept.backup(copy)
        for _ in range(9):
            kept.append("then", "a", b"new")
        kept.commit({}, last_sequence=kept.last)
    shutil.copytree(copy, path, dirs_exist_ok=True)
    with Store.open(path) as kept:
        for number in range(6):  # too few for a file of their own
            kept.append("otherwise", "a", b"new", arrays={"x": np.arange(number + 500)})
        kept.commit({}, last_sequence=kept.last)
    assert [problem for problem in check_store(path) if problem.kind != "leftover"] == []
    with Store.open(path, mode=mode) as kept:
        assert [head.kind for head in kept.with_key(b"new")] == ["otherwise"] * 6
        assert len(list(kept.heads())) == len(list(kept.records())) == len(keys) + 6


FOLLOWS = "ab" * 32


@pytest.mark.parametrize("sizes", [None, (2**63, 0), (0, 2**40), (3, 3), (2, 2**31)])
def test_a_forged_file_stands_for_no_more_than_it_has(tmp_path, sizes):
    write_derived(tmp_path, "watch", FOLLOWS, '{"a":1}', {"x": np.arange(5)})
    about, arrays = read_derived(tmp_path, "watch", FOLLOWS)
    assert about == {"a": 1} and arrays["x"].tolist() == [0, 1, 2, 3, 4]
    parts = [b"[", encode_payload({})]
    data = b"".join([DERIVED.pack(MARK, bytes.fromhex(FOLLOWS), *(sizes or map(len, parts))), *parts])
    (tmp_path / "derived" / "watch").write_bytes(data + payload_digest(data))
    assert read_derived(tmp_path, "watch", FOLLOWS) is None
