"""Compressed bytes: zstd frames, as they are written and read.

Nothing that is read here can leave its buffers: the length in a frame is compared with the destination, which the
caller has made, before a decoder that checks bounds itself gets to see it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["compress", "decompress", "decompress_zstd", "unshuffle_bits"]

Bytes = npt.NDArray[np.uint8]

# Every append waits for it: the levels of a BioTac touch's readings, 7.6 KB, become 2.9 KB in 0.03 ms, where the disk
# itself takes 0.2 to 0.3 ms.
LEVEL = 1

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

AT_ONCE = 2**20  # bytes whose bits are put back: of large arrays there is no third copy

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
    unshuffle_bits(shuffled, target, item)


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


def unshuffle_bits(shuffled: Bytes, target: Bytes, item: int) -> None:
    """Fill `target` with what bitshuffle made these bytes of: the lowest bits of all items first, and so on."""
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
