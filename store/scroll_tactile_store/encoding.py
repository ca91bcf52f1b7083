"""Which arrays the store keeps, and the bytes of those of a record (FORMAT.md describes them)."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Mapping
from math import prod

import numpy as np

from scroll_tactile_store.exceptions import RecordError
from scroll_tactile_store.records import from_json

__all__ = [
    "NAME",
    "check_arrays",
    "declared_size",
    "decode_payload",
    "encode_payload",
    "kept_dtype",
    "require_shape",
]

# Every append waits for it: the levels of a BioTac touch's readings, 7.6 KB, become 3.4 KB in 0.06 ms.
LEVEL = 1
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

# Of a small payload that stands for gigabytes nobody is to make room for these. `encode_payload` keeps to it.
SPARE, RATIO = 64 * 2**20, 16

# A row this large stalls every append behind it.
LARGEST_PAYLOAD = 256 * 2**20

KEPT_TYPES = frozenset(["|i1", "|u1", "<i2", "<i4", "<i8", "<u2", "<u4", "<u8", "<f2", "<f4", "<f8"])
MOST_AXES = 64  # NumPy's own limit
LARGEST_SIZE = 2**63 - 1

# The names are folders in a checkpoint: portable to every file system, never zarr's reserved "__…".
NAME = r"(?!__|(?i:zarr\.json)(?![A-Za-z0-9_.-]))[A-Za-z0-9_](?:[A-Za-z0-9_.-]{0,98}[A-Za-z0-9_-])?"
KEPT_NAME = re.compile(NAME)

LENGTH = struct.Struct("<I")  # of what a payload says of its arrays


def check_arrays(arrays: Mapping[str, np.ndarray] | None) -> dict[str, np.ndarray]:
    """Return the arrays as plain, C-contiguous ndarrays of the same dtype and shape; None counts as empty.

    An array that is already contiguous is not copied. Kept are signed and unsigned integers, float16, float32 and
    float64, all little-endian, in any shape. Raises RecordError for any other array and for a name that could not be
    a folder's on every system.
    """
    names: dict[str, str] = {}
    for name, array in (arrays or {}).items():
        if not isinstance(name, str) or not KEPT_NAME.fullmatch(name):
            raise RecordError(
                f"{name!r} cannot name an array: use 1 to 100 ASCII letters, digits, '_', '-' and '.', not "
                "starting with '__', '-' or '.' nor ending with '.', and not 'zarr.json'"
            )
        if (other := names.setdefault(name.casefold(), name)) != name:
            raise RecordError(f"the names {other!r} and {name!r} would be one folder on a Mac or on Windows")
        if not isinstance(array, np.ndarray):
            raise RecordError(f"array {name!r} is a {type(array).__name__}, not a numpy.ndarray")
        if isinstance(array, np.ma.MaskedArray):
            raise RecordError(f"array {name!r} is masked; keep its data and its mask as two arrays")
        if array.dtype.str not in KEPT_TYPES:
            raise RecordError(
                f"array {name!r} has dtype {array.dtype} and shape {array.shape}; kept are integers and float16 to "
                "float64, little-endian: convert it first"
            )
    # Not ascontiguousarray, which turns a 0-d array into a 1-d one.
    return {name: np.asarray(array, order="C") for name, array in (arrays or {}).items()}


def kept_dtype(text: object) -> np.dtype:
    """Return the dtype that NumPy's string `text` stands for; raise ValueError where it is none that is kept."""
    if not isinstance(text, str) or text not in KEPT_TYPES:
        raise ValueError(f"{str(text)[:80]!r} is no dtype that is kept")
    return np.dtype(text)


def require_shape(lengths: object, dtype: np.dtype) -> tuple[int, ...]:
    """Return the shape of an array that could be in memory; raise ValueError where `lengths` is none."""
    if not isinstance(lengths, list) or len(lengths) > MOST_AXES:
        raise ValueError(f"{str(lengths)[:80]} is not the shape of an array with at most {MOST_AXES} axes")
    if not all(type(length) is int and length >= 0 for length in lengths):
        raise ValueError(f"{str(lengths)[:80]} is not a shape: a length is an int of 0 or more")
    if prod(max(length, 1) for length in lengths) * dtype.itemsize > LARGEST_SIZE:
        raise ValueError(f"an array of shape {str(lengths)[:80]} and dtype {dtype} is too large for any memory")
    return tuple(lengths)


def _flat(array: np.ndarray) -> np.ndarray:
    """Return the bytes of a C-contiguous array as a uint8 vector that shares its memory."""
    return array.reshape(-1).view(np.uint8) if array.size else np.empty(0, np.uint8)


def encode_payload(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return checked arrays as the bytes of a journal row's payload.

    Raises RecordError when they hold more than 256 MiB together.
    """
    # Imported late: a store without arrays does not need it, and it costs 60 ms.
    from numcodecs import zstd

    size = sum(array.nbytes for array in arrays.values())
    if size > LARGEST_PAYLOAD:
        raise RecordError(
            f"the arrays of one record hold {size} bytes, more than {LARGEST_PAYLOAD}: keep them in a checkpoint"
        )
    raw = {name: _flat(array).tobytes() for name, array in arrays.items()}
    packed = {name: min(data, zstd.compress(data, LEVEL), key=len) for name, data in raw.items()}
    buffers = packed if size <= SPARE + RATIO * sum(map(len, packed.values())) else raw
    about = {name: [one.dtype.str, list(one.shape), len(buffers[name])] for name, one in arrays.items()}
    text = json.dumps(about, separators=(",", ":")).encode("ascii")
    return b"".join([LENGTH.pack(len(text)), text, *buffers.values()])


def decode_payload(payload: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of a payload, as fresh writable arrays; its checksum need not be right, nor from a friend.

    Room is made only for what the bytes can stand for. Raises ValueError for bytes that are no payload, or hold more
    than `encode_payload` takes.
    """
    start = LENGTH.size + int.from_bytes(payload[: LENGTH.size], "little")
    try:
        about = from_json(payload[LENGTH.size : start].decode("ascii"))
    except ValueError as error:
        raise ValueError(f"the payload does not say what its arrays are: {error}") from error
    described = {name: _described(name, told) for name, told in about.items()}
    size = sum(prod(shape) * dtype.itemsize for dtype, shape, _ in described.values())
    if size > (most := min(LARGEST_PAYLOAD, SPARE + RATIO * len(payload))):
        raise ValueError(f"the arrays of a payload of {len(payload)} bytes have {size} bytes, more than {most}")
    if (stored := sum(part for _, _, part in described.values())) != len(payload) - start:
        raise ValueError(f"the buffers of a payload have {len(payload) - start} bytes, not {stored}")
    arrays = {}
    for name, (dtype, shape, stored) in described.items():
        arrays[name] = np.empty(shape, dtype)
        _fill(_flat(arrays[name]), payload[start : start + stored])
        start += stored
    return arrays


def _described(name: str, told: object) -> tuple[np.dtype, tuple[int, ...], int]:
    """Return the dtype, the shape and the stored bytes that a payload says of an array."""
    if not KEPT_NAME.fullmatch(name) or not isinstance(told, list) or len(told) != 3:
        raise ValueError(f"a payload says {str(told)[:80]} of an array {name[:80]!r}")
    dtype, stored = kept_dtype(told[0]), told[2]
    if type(stored) is not int or stored < 0:
        raise ValueError(f"array {name!r} has {str(stored)[:80]} bytes")
    return dtype, require_shape(told[1], dtype), stored


def _fill(target: np.ndarray, buffer: bytes) -> None:
    """Fill bytes with a buffer: as it is where it has as many, or from a zstd frame. Raises ValueError."""
    if len(buffer) == target.size:
        target[:] = np.frombuffer(buffer, np.uint8)
        return
    from numcodecs import zstd

    if (size := declared_size(buffer)) != target.size:
        raise ValueError(f"a zstd frame of {size} bytes stands for {target.size}")
    try:
        zstd.decompress(buffer, target)
    except RuntimeError as error:
        raise ValueError(str(error)) from error


def declared_size(frame: bytes) -> int:
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
