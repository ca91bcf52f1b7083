"""A payload or a frame from elsewhere, however forged, is damage: no crash, no byte of ours, no memory taken."""

import contextlib
import struct

import numpy as np
import pytest
from forging import Packed, pack, put_row
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numcodecs import blosc, zstd
from scroll_tactile_store import DamageError, RecordError, Store, VersionError, check_store, encoding
from scroll_tactile_store.compression import compress, decompress, decompress_zstd
from store_builds import taking_at_most

from scroll_tactile.recordings.zarrfile import _decompress_blosc


def payload(arrays, version=1):
    """The bytes of a payload; arrays: (name, dtype, shape, codec, bytes of the array, buffer)."""
    return pack([Packed(*array) for array in arrays], version)


def test_what_was_never_written_so_is_not_said_to_fail_a_checksum_that_is_right(plain):
    number = put_row(plain, payload=b"no payload at all")
    with Store.open(plain, mode="read") as opened, pytest.raises(DamageError) as caught:
        list(opened.records())
    (problem,) = (problem.what for problem in check_store(plain) if problem.kind == "lost")
    assert f"row {number} is not as it was written (the payload does not start with" in str(caught.value)
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
LARGE = ("|u1", (2**28,), 1, 2**28, zstd.compress(bytes(2**28), 1))
FORGED = {
    "nothing": b"",
    "bytes behind the last buffer": payload([("x", "|u1", (4,), 0, 4, FOUR)]) + b"x",
    "fewer arrays than said": struct.pack("<4sBH", b"ARPL", 1, 3),
    "format 0": payload([], version=0),
    "a terabyte": payload([("x", "<f8", (2**37,), 0, 2**40, b"")]),
    "sizes whose product overflows": payload([("x", "<f8", (2**32, 2**32), 0, 0, b"")]),
    "more axes than arrays have": payload([("x", "|u1", (1,) * 65, 0, 1, b"a")]),
    "one name in two cases": payload([("x", "|u1", (4,), 0, 4, FOUR), ("X", "|u1", (4,), 0, 4, FOUR)]),
    "a name that leads out": payload([("../x", "|u1", (4,), 0, 4, FOUR)]),
    "text too long": payload([("x", "<U999999999", (2**40,), 0, 0, b"")]),
    "a character that is none": payload([("x", "<U1", (1,), 0, 4, struct.pack("<I", 0x110000))]),
    "a bool of 2": payload([("x", "|b1", (1,), 0, 1, b"\2")]),
    "another size": payload([("x", "|u1", (5,), 0, 4, FOUR)]),
    "an unknown codec": payload([("x", "|u1", (4,), 2, 4, FOUR)]),
    "no frame of zstd": payload([("x", "|u1", (4,), 1, 4, FOUR)]),
    "two frames of zstd": payload([("x", "|u1", (6,), 1, 6, 2 * zstd.compress(b"abc"))]),
    **{dtype: payload([("x", dtype, (1,), 0, 8, bytes(8))]) for dtype in ("|O8", ">i8", "<M8[s]", "i4,i4")},
    **{f"{count} large arrays": payload([(f"x{i}", *LARGE) for i in range(count)]) for count in (1, 60)},
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


def test_arrays_in_a_newer_format_are_told_from_damage(plain):
    put_row(plain, payload=payload([], version=2))
    with Store.open(plain, mode="read") as opened, pytest.raises(VersionError, match=r"format 2; .* upgrade"):
        list(opened.records())


@pytest.mark.parametrize(
    "array",
    [np.array([2], np.uint8).view(bool), np.array([0x110000], "<u4").view("<U1")],
    ids=["a bool of 2", "a character that is none"],
)
def test_what_would_be_damage_is_not_written(opened, array):
    with pytest.raises(RecordError, match="'x'"):
        opened.append("a", "b", b"", arrays={"x": array})


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
    raw = content(seed, size * item, distinct)
    target = np.empty(raw.size, np.uint8)
    decompress(compress(raw, item), target, item)
    assert target.tobytes() == raw.tobytes()


FRAMES = {
    "zstd": lambda raw: blosc.compress(raw.view("<u4"), b"zstd", 1, blosc.BITSHUFFLE),
    "lz4": lambda raw: blosc.compress(raw.view("<u2"), b"lz4", 1, blosc.SHUFFLE),
    "own": lambda raw: compress(raw, 4),
}
READ = {"zstd": _decompress_blosc, "lz4": _decompress_blosc, "own": lambda frame, target: decompress(frame, target, 4)}


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
    [b"", b"\x28\xb5\x2f\xfd", b"\x28\xb5\x2f\xfd\x00\x00", compress(np.zeros(99, np.uint8), 1), bytes(99)],
    ids=["empty", "cut off", "without a size", "another size", "none"],
)
def test_a_zstd_frame_that_says_another_size_or_none_is_refused(frame):
    with pytest.raises(ValueError, match="zstd"):
        decompress_zstd(frame, np.empty(100, np.uint8))
