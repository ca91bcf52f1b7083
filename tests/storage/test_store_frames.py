"""Frames are never read or written beyond their bytes."""

import contextlib
import struct

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numcodecs import blosc
from scroll_tactile_store.compression import compress, decompress, decompress_zstd

from scroll_tactile.recordings.zarrfile import _decompress_blosc

ITEMS = st.sampled_from([1, 2, 4, 8])


def content(seed, size, distinct):
    """Bytes that compress well, badly or not at all."""
    return np.random.default_rng(seed).integers(0, distinct, size).astype(np.uint8)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 99), size=st.integers(1, 50_000), distinct=st.sampled_from([1, 3, 256]), item=ITEMS)
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
    "a header that ends early": b"\x02\x01\x20",
    "a block far behind the end": HEADER.pack(2, 1, 0x20, 1, 65536, 65536, 2**31 - 1) + struct.pack("<i", 2**30),
    "a block behind the end": HEADER.pack(2, 1, 0x20, 1, 65536, 65536, 20) + struct.pack("<i", 2**30),
    "copied bytes that are not there": HEADER.pack(2, 1, 2, 1, 65536, 65536, 65552),
    "copied bytes that are not there, nor claimed": HEADER.pack(2, 1, 2, 1, 65536, 65536, 16),
    "another size": blosc.compress(np.zeros(65537, np.uint8), b"zstd", 1),
    "blocks of no bytes": HEADER.pack(2, 1, 0x80, 1, 65536, 0, 20) + bytes(4),
    "blocks larger than all": HEADER.pack(2, 1, 0x80, 1, 65536, 2**31, 20) + bytes(4),
    "more blocks than bytes": HEADER.pack(2, 1, 0x80, 1, 65536, 1, 20) + bytes(4),
    "streams of a byte": HEADER.pack(2, 1, 0x80, 255, 65536, 65280, 24) + struct.pack("<ii", 20, 0),
    "a block in the header": HEADER.pack(2, 1, 0x80, 1, 65536, 65536, 24) + struct.pack("<ii", 0, 0),
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
