"""Compressed bytes: the zstd frames that are written, and how these and earlier releases' Blosc frames are read.

Nothing that is read here can leave its buffers: every length in a frame is compared with the bytes that are there and
with the destination, which the caller has made, before a decoder that checks bounds itself gets to see a part of it.
c-blosc believes the lengths that a frame states; it never sees one.
"""

from __future__ import annotations

import struct

import numpy as np
import numpy.typing as npt

__all__ = ["compress", "decompress", "decompress_blosc", "decompress_zstd"]

Bytes = npt.NDArray[np.uint8]

# Every append waits for it: the levels of a BioTac touch's readings, 7.6 KB, become 2.9 KB in 0.03 ms, where the disk
# itself takes 0.2 to 0.3 ms.
LEVEL = 1

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

AT_ONCE = 2**20  # bytes whose bits are put back: of large arrays there is no third copy

BLOSC_HEADER = struct.Struct("<BBBBIII")
BLOSC_VERSION = 2
SHUFFLED, COPIED, BIT_SHUFFLED, UNSPLIT = 1, 2, 4, 16
LZ4, ZSTD = 1, 4  # of the five compressors of Blosc those that a release of this store has used
# c-blosc makes no smaller ones where it may choose: many small ones, each of which costs time, come from elsewhere.
SMALLEST_BLOCK, SMALLEST_STREAM = 4096, 128

# Steps that swap ever larger squares of bits across the diagonal of an 8 × 8 square (H. S. Warren, Hacker's Delight,
# 7-3): how far the bits of the mask move.
SWAPS = [
    (np.uint64(7), np.uint64(0x00AA00AA00AA00AA)),
    (np.uint64(14), np.uint64(0x0000CCCC0000CCCC)),
    (np.uint64(28), np.uint64(0x00000000F0F0F0F0)),
]


def compress(raw: Bytes, item: int) -> bytes:
    """Return bytes, items of `item` bytes, as one zstd frame that says its size, of their bits sorted by weight."""
    # Imported late: reading and opening a store without arrays does not need it, and it costs 60 ms.
    from numcodecs import zstd

    frame: bytes = zstd.compress(_shuffle_bits(raw, item), LEVEL)
    return frame


def decompress(frame: bytes, target: Bytes, item: int) -> None:
    """Fill `target` with what `compress` was given; raise ValueError for any other frame."""
    shuffled = np.empty_like(target)
    decompress_zstd(frame, shuffled)
    _unshuffle_bits(shuffled, target, item)


def decompress_zstd(frame: bytes, target: Bytes) -> None:
    """Fill `target` from a zstd frame; raise ValueError for one that is damaged or says another size."""
    from numcodecs import zstd

    size = _declared_size(frame)
    if size != target.size:
        raise ValueError(f"a zstd frame of {size} bytes stands for {target.size}")
    try:
        zstd.decompress(frame, target)
    except RuntimeError as error:
        raise ValueError(str(error)) from error


def _declared_size(frame: bytes) -> int:
    """Return the size in the header of a zstd frame (RFC 8878, 3.1.1.1); raise ValueError where there is none."""
    if len(frame) < 6 or frame[:4] != ZSTD_MAGIC:
        raise ValueError("not a zstd frame")
    descriptor = frame[4]
    one_segment = bool(descriptor & 0x20)
    width = (1 if one_segment else 0, 2, 4, 8)[descriptor >> 6]
    start = 5 + (0 if one_segment else 1) + (0, 1, 2, 4)[descriptor & 3]
    field = frame[start : start + width]
    if not width or len(field) < width:
        raise ValueError("a zstd frame that does not say its size")
    return int.from_bytes(field, "little") + (256 if width == 2 else 0)


def decompress_blosc(frame: bytes, target: Bytes) -> None:
    """Fill `target` from a Blosc 1 frame of zstd or LZ4; raise ValueError for one whose lengths are not what is there.

    The layout is that of c-blosc's README_HEADER: 16 bytes of header, where each block starts, and in each block one
    stream, or one for each byte of an item, every one behind its length.
    """
    if len(frame) < BLOSC_HEADER.size:
        raise ValueError("a Blosc frame without its header")
    version, _, flags, item, size, block, stored = BLOSC_HEADER.unpack_from(frame)
    if version != BLOSC_VERSION or item == 0 or size != target.size or stored != len(frame):
        raise ValueError(
            f"a Blosc frame (version {version}) of {stored} bytes for {size}, items of {item}, stands in {len(frame)} "
            f"bytes for {target.size}"
        )
    if flags & COPIED:
        _copy(frame[BLOSC_HEADER.size :], target)
    elif size:
        if not min(size, SMALLEST_BLOCK) <= block <= size:
            raise ValueError(f"a Blosc frame of {size} bytes has blocks of {block}")
        _fill_blocks(frame, target, item, block, flags)


def _copy(source: bytes, target: Bytes) -> None:
    if len(source) != target.size:
        raise ValueError(f"{len(source)} bytes stand for {target.size}")
    target[:] = np.frombuffer(source, np.uint8)


def _fill_blocks(frame: bytes, target: Bytes, item: int, block: int, flags: int) -> None:
    first = BLOSC_HEADER.size + 4 * -(-target.size // block)
    if first > len(frame):
        raise ValueError("a Blosc frame ends before its blocks start")
    starts = np.frombuffer(frame[BLOSC_HEADER.size : first], "<u4")
    shuffled = np.empty(block, np.uint8)
    for i, start in enumerate(starts.tolist()):
        if start < first:
            raise ValueError(f"block {i} of a Blosc frame starts in its header")
        part = target[i * block : (i + 1) * block]
        streams = 1 if flags & UNSPLIT or part.size < block else item
        if streams > 1 and (part.size % streams or part.size // streams < SMALLEST_STREAM):
            raise ValueError(f"a block of {part.size} bytes cannot be {streams} streams")
        if flags & BIT_SHUFFLED and part.size >= item:
            _fill_streams(frame, start, shuffled[: part.size], streams, flags >> 5)
            if part.size // item % 8:
                part[:] = shuffled[: part.size]  # c-blosc shuffles the bits of no other numbers of items
            else:
                _unshuffle_bits(shuffled[: part.size], part, item)
        elif flags & SHUFFLED and item > 1:
            _fill_streams(frame, start, shuffled[: part.size], streams, flags >> 5)
            _unshuffle_bytes(shuffled[: part.size], part, item)
        else:
            _fill_streams(frame, start, part, streams, flags >> 5)


def _fill_streams(frame: bytes, start: int, target: Bytes, streams: int, compressor: int) -> None:
    size = target.size // streams
    for first in range(0, target.size, size):
        begin = start + 4
        end = begin + int.from_bytes(frame[start:begin], "little")
        if begin > len(frame) or end > len(frame):
            raise ValueError("a stream of a Blosc frame ends behind it")
        part, stream, start = target[first : first + size], frame[begin:end], end
        if len(stream) == size:
            part[:] = np.frombuffer(stream, np.uint8)
        elif compressor == ZSTD:
            decompress_zstd(stream, part)
        elif compressor == LZ4:
            _decompress_lz4(stream, part)
        else:
            raise ValueError(f"a Blosc frame with compressor {compressor}, which no release has used")


def _decompress_lz4(stream: bytes, target: Bytes) -> None:
    from numcodecs import lz4

    try:
        lz4.decompress(target.size.to_bytes(4, "little") + stream, target)
    except RuntimeError as error:
        raise ValueError(str(error)) from error


def _unshuffle_bytes(shuffled: Bytes, target: Bytes, item: int) -> None:
    whole = target.size - target.size % item
    target[:whole].reshape(-1, item)[...] = shuffled[:whole].reshape(item, -1).T
    target[whole:] = shuffled[whole:]


def _shuffle_bits(raw: Bytes, item: int) -> Bytes:
    """Return first the lowest bit of the first byte of all items, then their second … (bitshuffle's order).

    Of a number of items that is no multiple of eight the last ones stay as they are, at the end.
    """
    whole = raw.size - raw.size % (8 * item)
    squares = np.ascontiguousarray(raw[:whole].reshape(-1, item).T).view("<u8")
    shuffled = np.empty_like(raw)
    planes = _transposed(squares).view(np.uint8).reshape(item, -1, 8)
    shuffled[:whole].reshape(item, 8, -1)[...] = planes.transpose(0, 2, 1)
    shuffled[whole:] = raw[whole:]
    return shuffled


def _unshuffle_bits(shuffled: Bytes, target: Bytes, item: int) -> None:
    whole = target.size - target.size % (8 * item)
    planes, items = shuffled[:whole].reshape(item, 8, -1), target[:whole].reshape(-1, item)
    step = max(1, AT_ONCE // (8 * item))
    for start in range(0, planes.shape[2], step):
        squares = np.ascontiguousarray(planes[:, :, start : start + step].transpose(0, 2, 1)).view("<u8")
        items[8 * start : 8 * (start + step)] = _transposed(squares).view(np.uint8).reshape(item, -1).T
    target[whole:] = shuffled[whole:]


def _transposed(squares: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Return 8 × 8 bits each, a byte a row, mirrored at the diagonal."""
    for distance, mask in SWAPS:
        swapped = (squares ^ (squares >> distance)) & mask
        squares = squares ^ swapped ^ (swapped << distance)
    return squares
