"""Which arrays the store keeps, and the bytes of those of a record (FORMAT.md describes them)."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Mapping
from math import prod
from typing import Any

import numpy as np

from scroll_tactile_store.exceptions import RecordError
from scroll_tactile_store.records import from_json

# Every append waits for it: the levels of a BioTac touch's readings, 7.6 KB, become 3.4 KB in 0.06 ms.
LEVEL = 1
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

# Of a small payload that stands for gigabytes nobody is to make room for these. `encode_payload` keeps to it.
SPARE, RATIO = 64 * 2**20, 16

# A row this large stalls every append behind it.
LARGEST_PAYLOAD = 256 * 2**20

KEPT_TYPES = frozenset(["|i1", "|u1", "<i2", "<i4", "<i8", "<u2", "<u4", "<u8", "<f2", "<f4", "<f8"])

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
    for name, array in (arrays or {}).items():
        if not isinstance(name, str) or not KEPT_NAME.fullmatch(name):
            raise RecordError(
                f"{name!r} cannot name an array: use 1 to 100 ASCII letters, digits, '_', '-' and '.', not "
                "starting with '__', '-' or '.' nor ending with '.', and not 'zarr.json'"
            )
        if not isinstance(array, np.ndarray) or array.dtype.str not in KEPT_TYPES:
            what = f"{getattr(array, 'dtype', type(array).__name__)} and shape {np.shape(array)}"
            kept = "integers and float16 to float64, little-endian: convert it first"
            raise RecordError(f"array {name!r} is of {what}; kept are numpy.ndarrays of {kept}")
    # Not ascontiguousarray, which turns a 0-d array into a 1-d one.
    return {name: np.asarray(array, order="C") for name, array in (arrays or {}).items()}


def array_bytes(shape: object, dtype: np.dtype) -> int:
    """Return the bytes of an array of this shape; raise ValueError where that is none."""
    if not isinstance(shape, list) or not all(type(length) is int and length >= 0 for length in shape):
        raise ValueError(f"{str(shape)[:80]} is no shape")
    return prod(shape) * dtype.itemsize


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
    arrays, room = dict[str, np.ndarray](), min(LARGEST_PAYLOAD, SPARE + RATIO * len(payload))
    try:
        about: dict[str, Any] = dict(from_json(payload[LENGTH.size : start].decode("ascii")))
        for name, (dtype, shape, stored) in about.items():
            if not KEPT_NAME.fullmatch(name) or dtype not in KEPT_TYPES:
                raise ValueError(f"an array {name[:80]!r} has elements of {str(dtype)[:80]}")
            room -= array_bytes(shape, np.dtype(dtype))
            if room < 0:
                raise ValueError(f"the arrays of a payload of {len(payload)} bytes are more than it can stand for")
            arrays[name] = np.empty(shape, dtype)
            _fill(_flat(arrays[name]), payload[start : start + stored])
            start += stored
    except TypeError as error:
        raise ValueError(f"a payload does not say what its arrays are: {error}") from error
    if start != len(payload):
        raise ValueError(f"the buffers of a payload end at byte {start} of {len(payload)}")
    return arrays


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
