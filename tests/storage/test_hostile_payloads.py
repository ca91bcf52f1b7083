"""A payload or a frame from elsewhere, however forged, is damage: no crash, no byte of ours, no memory taken."""

import contextlib
import struct

import numpy as np
import pytest
from forging import Packed, pack, put_row, unpack
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numcodecs import blosc, zstd
from scroll_tactile_store import DamageError, Store, check_store, encoding
from scroll_tactile_store.encoding import decode_payload, encode_payload
from store_builds import taking_at_most

from scroll_tactile.recordings.zarrfile import _decompress_blosc


def payload(*arrays, text=None):
    """The bytes of a payload; arrays: (name, dtype, shape, buffer, bytes that it is said to have, or as many)."""
    return pack([Packed(*array) for array in arrays], text)


def test_what_was_never_written_so_is_not_said_to_fail_a_checksum_that_is_right(plain):
    number = put_row(plain, payload=b"no payload at all")
    with Store.open(plain, mode="read") as opened, pytest.raises(DamageError) as caught:
        list(opened.records())
    (problem,) = (problem.what for problem in check_store(plain) if problem.kind == "lost")
    assert f"row {number} is not as it was written (the payload does not say what its arrays are" in str(caught.value)
    assert f"row {number} has arrays that were never written so" in problem
    assert "checksum" not in str(caught.value) + problem


def test_so_little_that_stands_for_so_much_is_kept_as_it_is_and_read_back(opened, monkeypatch):
    monkeypatch.setattr(encoding, "SPARE", 2**20)
    zeros = np.zeros(5 * 2**20, np.uint8)
    head = opened.append("a", "zeros", b"", arrays={"zeros": zeros})
    assert head.size > zeros.nbytes
    assert opened.record(head.sequence).arrays["zeros"].tobytes() == zeros.tobytes()


FOUR = b"abcd"
# Arrays that together are larger than any, and a small payload of one large array.
LARGE = ("|u1", [2**28], zstd.compress(bytes(2**28), 1))
FORGED = {
    "nothing": b"",
    "bytes behind the last buffer": payload(("x", "|u1", [4], FOUR)) + b"x",
    "an end in what is said": payload(("x", "|u1", [4], FOUR))[:9],
    "no JSON": payload(text="{"),
    "a list": payload(text="[]"),
    "an array in words": payload(text='{"x":"y"}'),
    "a terabyte": payload(("x", "<f8", [2**37], b"", 2**40)),
    "sizes whose product overflows": payload(("x", "<f8", [2**32, 2**32], b"")),
    "more axes than arrays have": payload(("x", "|u1", [1] * 65, b"a")),
    "a length of 4.0": payload(("x", "|u1", [4.0], FOUR)),
    "a name that leads out": payload(("../x", "|u1", [4], FOUR)),
    "another size": payload(("x", "|u1", [5], FOUR)),
    "fewer bytes than none": payload(("x", "|u1", [4], FOUR, -4), ("y", "|u1", [8], FOUR, 8)),
    "no frame of zstd": payload(("x", "|u1", [5], FOUR)),
    "two frames of zstd": payload(("x", "|u1", [6], 2 * zstd.compress(b"abc"))),
    **{dtype: payload(("x", dtype, [1], bytes(8))) for dtype in ("|O8", "<U2", "|b1", ">i8", "<M8[s]", "i4,i4")},
    **{f"{count} large arrays": payload(*((f"x{i}", *LARGE) for i in range(count))) for count in (1, 60)},
}


@pytest.mark.parametrize("content", FORGED.values(), ids=FORGED)
def test_a_payload_that_was_never_written_is_damage_at_its_row_and_takes_no_memory(plain, content):
    number = put_row(plain, payload=content)
    with Store.open(plain, mode="read") as opened:
        found = opened.records()
        with taking_at_most(2**20 + 4 * len(content)), pytest.raises(DamageError) as refused:
            for _ in found:
                pass
    assert refused.value.sequence == number
    (problem,) = check_store(plain)
    assert problem.kind == "lost"
    assert f"row {number}" in problem.what


# Frames: of our own, and of Blosc, in which recordings are.


def content(seed, size, distinct):
    """Bytes that compress well, badly or not at all."""
    return np.random.default_rng(seed).integers(0, distinct, size).astype(np.uint8)


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 99),
    size=st.integers(1, 50_000),
    distinct=st.sampled_from([1, 3, 256]),
    item=st.sampled_from([1, 2, 4, 8]),
)
@example(seed=0, size=7, distinct=3, item=8)
def test_a_frame_gives_back_what_it_was_made_of(seed, size, distinct, item):
    raw = content(seed, size * item, distinct).view(f"u{item}")
    assert decode_payload(encode_payload({"x": raw}))["x"].tobytes() == raw.tobytes()


FRAMES = {
    "zstd": lambda raw: blosc.compress(raw.view("<u4"), b"zstd", 1, blosc.BITSHUFFLE),
    "lz4": lambda raw: blosc.compress(raw.view("<u2"), b"lz4", 1, blosc.SHUFFLE),
    "own": lambda raw: unpack(encode_payload({"x": raw}))[0].buffer,
}
READ = {"zstd": _decompress_blosc, "lz4": _decompress_blosc, "own": lambda frame, target: encoding._fill(target, frame)}


@pytest.mark.parametrize("kind", FRAMES)
@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_harmed_frame_writes_outside_its_destination(kind, seed):
    rng = np.random.default_rng(seed)
    frame = bytearray(FRAMES[kind](content(seed, 40_000, 17)))
    early = min(len(frame), 96)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(early if rng.random() < 0.7 else len(frame)))
        if rng.random() < 0.3:
            frame[at : at + 4] = struct.pack("<I", int(rng.choice([0, 1, 2**31 - 1, 2**31, 2**32 - 1, len(frame)])))
        else:
            frame[at] = int(rng.integers(256))
    if rng.random() < 0.2:
        del frame[int(rng.integers(len(frame))) :]
    around = np.full(40_000 + 2 * 4096, 0xA5, np.uint8)
    with contextlib.suppress(ValueError, RuntimeError):
        READ[kind](bytes(frame), around[4096:-4096])
    assert (around[:4096] == 0xA5).all()
    assert (around[-4096:] == 0xA5).all()


HEADER = struct.Struct("<BBBBIII")
HOSTILE = {
    "empty": b"",
    "a block far behind the end": HEADER.pack(2, 1, 0x20, 1, 65536, 65536, 2**31 - 1) + struct.pack("<i", 2**30),
    "copied bytes that are not there": HEADER.pack(2, 1, 2, 1, 65536, 65536, 65552),
    "another size": blosc.compress(np.zeros(65537, np.uint8), b"zstd", 1),
    "blocks of no bytes": HEADER.pack(2, 1, 0x80, 1, 65536, 0, 20) + bytes(4),
    "blocks larger than all": HEADER.pack(2, 1, 0x80, 1, 65536, 2**31, 20) + bytes(4),
    "more blocks than bytes": HEADER.pack(2, 1, 0x80, 1, 65536, 1, 20) + bytes(4),
    "a stream of a negative length": HEADER.pack(2, 1, 0x80, 1, 65536, 65536, 24) + struct.pack("<ii", 20, -5),
    "a stream behind the end": HEADER.pack(2, 1, 0x80, 1, 65536, 65536, 24) + struct.pack("<ii", 20, 9),
    "a compressor that was never used": HEADER.pack(2, 1, 0x60, 1, 65536, 65536, 25) + struct.pack("<iib", 20, 1, 0),
    "items of no bytes": HEADER.pack(2, 1, 0x80, 0, 65536, 65536, 24) + struct.pack("<ii", 20, 0),
}


@pytest.mark.parametrize("frame", HOSTILE.values(), ids=HOSTILE)
def test_a_frame_whose_lengths_are_not_what_is_there_is_refused(frame):
    with pytest.raises((ValueError, RuntimeError)):
        _decompress_blosc(frame, np.empty(65536, np.uint8))


@pytest.mark.parametrize(
    "frame",
    [b"", b"\x28\xb5\x2f\xfd", b"\x28\xb5\x2f\xfd\x00\x00", zstd.compress(bytes(99)), bytes(99)],
    ids=["empty", "cut off", "without a size", "another size", "none"],
)
def test_a_zstd_frame_that_says_another_size_or_none_is_refused(frame):
    with pytest.raises(ValueError, match="zstd"):
        decode_payload(payload(("x", "|u1", [100], frame)))
