"""The arrays of a row as bytes: what is written is read back, and what never was written so is damage at its row."""

import numpy as np
import pytest
from forging import pack, put_row
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numcodecs import zstd
from scroll_tactile_store import DamageError, RecordError, Store, check_store, encoding
from scroll_tactile_store import records as store_records
from scroll_tactile_store.encoding import decode_payload, encode_payload

FOUR = b"abcd"
FORGED = {
    "no payload": b"no payload at all",
    "nothing": b"",
    "no JSON": pack([], "{"),
    "an array in words": pack([], '{"x":"y"}'),
    "bytes behind the last buffer": pack([("x", "|u1", [4], FOUR, 4)]) + b"x",
    "sizes whose product overflows": pack([("x", "<f8", [2**32, 2**32], b"", 0)]),
    "another size": pack([("x", "|u1", [5], FOUR, 4)]),
    "fewer bytes than none": pack([("x", "|u1", [4], FOUR, -4), ("y", "|u1", [8], FOUR, 8)]),
    "no frame of zstd": pack([("x", "|u1", [5], FOUR, 4)]),
    "two frames of zstd": pack([("x", "|u1", [6], 2 * zstd.compress(b"abc"), 2 * len(zstd.compress(b"abc")))]),
    **{dtype: pack([("x", dtype, [1], bytes(8), 8)]) for dtype in ("|O8", "<U2", "|b1", ">i8", "<M8[s]", "i4,i4")},
}


@pytest.mark.parametrize("content", FORGED.values(), ids=FORGED)
def test_what_was_never_written_so_is_damage_at_its_row(plain, content):
    number = put_row(plain, payload=content)
    with Store.open(plain, mode="read") as opened, pytest.raises(DamageError, match=f"row {number}") as caught:
        list(opened.records())
    assert caught.value.sequence == number
    (problem,) = check_store(plain)
    assert (problem.kind, f"row {number}" in problem.what) == ("lost", True)


def test_more_attributes_than_are_read_are_not_written(opened, monkeypatch):
    monkeypatch.setattr(store_records, "MOST_VALUES", 2**10)
    monkeypatch.setattr(store_records, "LARGEST_JSON", 2**14)
    for many in ({"many": [0] * 2**10}, {"long": "x" * 2**14}):
        with pytest.raises(RecordError, match="attributes"):
            opened.append("a", "b", b"", attributes=many)
        with pytest.raises(RecordError, match="attributes"):
            opened.commit({}, last_sequence=0, attributes=many)


def test_so_little_that_stands_for_so_much_is_kept_as_it_is_and_read_back(opened, monkeypatch):
    monkeypatch.setattr(encoding, "SPARE", 2**20)
    zeros = np.zeros(5 * 2**20, np.uint8)
    head = opened.append("a", "zeros", b"", arrays={"zeros": zeros})
    assert head.size > zeros.nbytes
    assert opened.record(head.sequence).arrays["zeros"].tobytes() == zeros.tobytes()


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 99),
    size=st.integers(1, 50_000),
    distinct=st.sampled_from([1, 3, 256]),
    item=st.sampled_from([1, 2, 4, 8]),
)
@example(seed=0, size=7, distinct=3, item=8)
def test_a_frame_gives_back_what_it_was_made_of(seed, size, distinct, item):
    raw = np.random.default_rng(seed).integers(0, distinct, size * item).astype(np.uint8).view(f"u{item}")
    assert decode_payload(encode_payload({"x": raw}))["x"].tobytes() == raw.tobytes()
