"""Files of what follows from a checkpoint: some arrays are mapped, and a forged file stands for no more than it has."""

import json
import mmap

import numpy as np
import pytest
from scroll_tactile_store.derived import ALIGNED, HEADER, MARK, read_derived, write_derived
from scroll_tactile_store.encoding import encode_payload
from scroll_tactile_store.records import payload_digest

FOLLOWS = "ab" * 32
ARRAYS = {
    "large": np.arange(3000, dtype=np.float32).reshape(30, 100),
    "bytes": np.arange(-100, 100, dtype=np.int8),
    "none": np.empty((0, 4)),
    "text": np.array(["a", "bc"]),
    "small": np.arange(5),
}


def test_mapped_arrays_come_back_as_they_were_and_may_be_changed(tmp_path):
    write_derived(tmp_path, "model", FOLLOWS, '{"a":1}', ARRAYS, ["large", "bytes", "none", "text"])
    for _ in range(2):
        about, arrays = read_derived(tmp_path, "model", FOLLOWS)
        assert about == {"a": 1}
        assert {name: (one.dtype, one.shape, one.tobytes()) for name, one in arrays.items()} == {
            name: (one.dtype, one.shape, one.tobytes()) for name, one in ARRAYS.items()
        }
        assert arrays["large"].ctypes.data % ALIGNED == arrays["bytes"].ctypes.data % ALIGNED == 0
        arrays["large"][:] = 7  # the file stays as it is
    old = arrays["large"]
    write_derived(tmp_path, "model", FOLLOWS, "{}", {"large": np.zeros(10**5)}, ["large"])
    assert (old == 7).all() and old.shape == (30, 100)


@pytest.mark.parametrize(
    "described",
    [
        {"a": ["<f4", 2**40]},
        {"a": ["<f4", 2**62, 2**62]},
        {"a": ["<f4", -1]},
        {"a": ["<f4", 10.0]},
        {"a": ["<U3", 10]},
        {"a": ["|b1", 40]},
        {"a": ["|O", 5]},
        {"a": []},
        {"a": "<f4"},
        {"../a": ["<f4", 10]},
        {"a": ["<f4", 10], "b": ["<f4", 10]},
        {},
        [],
        None,
    ],
)
def test_what_describes_other_bytes_than_there_are_is_not_used(tmp_path, described):
    texts = [b"{}", json.dumps(described).encode(), encode_payload({})]
    head = b"".join([HEADER.pack(MARK, bytes.fromhex(FOLLOWS), *map(len, texts)), *texts])
    data = head + bytes(-len(head) % ALIGNED) + bytes(40)
    (tmp_path / "derived").mkdir()
    (tmp_path / "derived" / "model").write_bytes(data + payload_digest(data))
    assert read_derived(tmp_path, "model", FOLLOWS) is None


@pytest.mark.parametrize("sizes", [(2**63, 0, 0), (0, 2**40, 0), (0, 0, 2**40), (3, 3, 3), (0, 0, 0)])
def test_parts_of_false_lengths_are_not_read(tmp_path, sizes):
    data = HEADER.pack(MARK, bytes.fromhex(FOLLOWS), *sizes) + b"{}{}"
    (tmp_path / "derived").mkdir()
    (tmp_path / "derived" / "model").write_bytes(data + payload_digest(data))
    assert read_derived(tmp_path, "model", FOLLOWS) is None


def test_without_mapped_arrays_nothing_is_mapped(tmp_path, monkeypatch):
    monkeypatch.setattr(mmap, "mmap", None)
    write_derived(tmp_path, "model", FOLLOWS, "{}", {"small": np.arange(5)})
    assert read_derived(tmp_path, "model", FOLLOWS)[1]["small"].tolist() == [0, 1, 2, 3, 4]
