"""Blosc frames, as Zarr stores of version 2 have them, read without c-blosc, which believes the lengths in them.

Nothing that is read here can leave its buffers: every length in a frame is compared with the bytes that are there and
with the destination, which the caller has made, before a decoder that checks bounds itself gets to see a part of it.
"""

from __future__ import annotations

import struct

import numpy as np
import numpy.typing as npt
from scroll_tactile_store.compression import decompress_zstd, unshuffle_bits

__all__ = ["decompress_blosc"]

Bytes = npt.NDArray[np.uint8]

BLOSC_HEADER = struct.Struct("<BBBBIII")
BLOSC_VERSION = 2
SHUFFLED, COPIED, BIT_SHUFFLED, UNSPLIT = 1, 2, 4, 16
LZ4, ZSTD = 1, 4  # of the five compressors of Blosc those that are read
# c-blosc makes no smaller ones where it may choose: many small ones, each of which costs time, come from elsewhere.
SMALLEST_BLOCK, SMALLEST_STREAM = 4096, 128


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
                unshuffle_bits(shuffled[: part.size], part, item)
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
            raise ValueError(f"a Blosc frame with compressor {compressor}, which is not read")


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
