"""Which arrays the store keeps, their digests, and the bytes of a record's payload (FORMAT.md describes them)."""

from __future__ import annotations

import hashlib
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import prod

import numpy as np

from scroll_tactile_store.compression import compress, decompress
from scroll_tactile_store.exceptions import RecordError, VersionError

__all__ = [
    "array_digest",
    "check_arrays",
    "decode_payload",
    "encode_payload",
    "flat_bytes",
    "item_size",
    "kept_dtype",
    "require_name",
    "require_shape",
    "require_values",
]

MAGIC = b"ARPL"
PAYLOAD_VERSION = 1
HEADER = struct.Struct("<4sBH")
LENGTHS = struct.Struct("<BQQ")
RAW, ZSTD = 0, 1

SMALL = 128  # bytes, of which compressing saves next to nothing

# Of a small payload that stands for gigabytes nobody is to make room for these. `encode_payload` keeps to it.
SPARE, RATIO = 64 * 2**20, 16

# A row this large stalls every append behind it.
LARGEST_PAYLOAD = 256 * 2**20

KEPT_TYPES = frozenset(["|b1", "|i1", "|u1", "<i2", "<i4", "<i8", "<u2", "<u4", "<u8", "<f2", "<f4", "<f8"])
TEXT_TYPE = re.compile(r"<U[1-9][0-9]{0,8}")
LAST_CODE_POINT = 0x10FFFF
MOST_AXES = 64  # NumPy's own limit
LARGEST_SIZE = 2**63 - 1

# The names are folders in a checkpoint: portable to every file system, never zarr's reserved "__…".
NAME = re.compile(r"(?!__)[A-Za-z0-9_](?:[A-Za-z0-9_.-]{0,98}[A-Za-z0-9_-])?")


def check_arrays(arrays: Mapping[str, np.ndarray] | None) -> dict[str, np.ndarray]:
    """Return the arrays as plain, C-contiguous ndarrays of the same dtype and shape; None counts as empty.

    An array that is already contiguous is not copied. Kept are bool, signed and unsigned integers,
    float16, float32, float64 and fixed-width unicode, all little-endian, in any shape. Raises
    RecordError for any other array and for a name that could not be a folder's on every system.
    """
    checked: dict[str, np.ndarray] = {}
    folded: dict[str, str] = {}
    for name, array in (arrays or {}).items():
        try:
            require_name(name)
        except ValueError as error:
            raise RecordError(str(error)) from error
        if other := folded.get(name.casefold()):
            raise RecordError(f"the names {other!r} and {name!r} would be one folder on a Mac or on Windows")
        folded[name.casefold()] = name
        _check_array(name, array)
        # Not ascontiguousarray, which turns a 0-d array into a 1-d one.
        checked[name] = np.asarray(array, order="C")
        try:
            require_values(checked[name])
        except ValueError as error:
            raise RecordError(f"array {name!r} cannot be kept: {error}") from error
    return checked


def require_name(name: object) -> str:
    """Return what can name an array; raise ValueError for anything else."""
    if not isinstance(name, str) or not NAME.fullmatch(name) or name.casefold() == "zarr.json":
        raise ValueError(
            f"{name!r} cannot name an array: use 1 to 100 ASCII letters, digits, '_', '-' and '.', not "
            "starting with '__', '-' or '.' nor ending with '.'"
        )
    return name


def kept_dtype(text: object) -> np.dtype:
    """Return the dtype that NumPy's string `text` stands for; raise ValueError where it is none that is kept."""
    if not isinstance(text, str) or not (text in KEPT_TYPES or TEXT_TYPE.fullmatch(text)):
        raise ValueError(f"{text!r} is no dtype that is kept")
    try:
        return np.dtype(text)
    except TypeError as error:
        raise ValueError(f"{text!r} is no dtype: {error}") from error


def require_shape(lengths: object, dtype: np.dtype) -> tuple[int, ...]:
    """Return the shape of an array that could be in memory; raise ValueError where `lengths` is none."""
    if not isinstance(lengths, list | tuple) or len(lengths) > MOST_AXES:
        raise ValueError(f"{str(lengths)[:80]} is not the shape of an array with at most {MOST_AXES} axes")
    if not all(type(length) is int and length >= 0 for length in lengths):
        raise ValueError(f"{lengths} is not a shape: a length is an int of 0 or more")
    if prod(max(length, 1) for length in lengths) * max(dtype.itemsize, 1) > LARGEST_SIZE:
        raise ValueError(f"an array of shape {lengths} and dtype {dtype} is too large for any memory")
    return tuple(lengths)


def require_values(array: np.ndarray) -> None:
    """Raise ValueError for a bool that is neither 0 nor 1 or a character that is no code point of Unicode."""
    if array.size and array.dtype.kind == "b" and flat_bytes(array).max() > 1:
        raise ValueError("a bool is neither 0 nor 1")
    if array.nbytes and array.dtype.kind == "U" and flat_bytes(array).view("<u4").max() > LAST_CODE_POINT:
        raise ValueError("a character is no code point of Unicode")


def _check_array(name: str, array: np.ndarray) -> None:
    if not isinstance(array, np.ndarray):
        raise RecordError(f"array {name!r} is a {type(array).__name__}, not a numpy.ndarray")
    if isinstance(array, np.ma.MaskedArray):
        raise RecordError(f"array {name!r} is masked; keep its data and its mask as two arrays")
    kept = array.dtype.str
    if kept not in KEPT_TYPES and not kept.startswith("<U"):
        hint = "byte-swap it to little-endian" if kept.startswith(">") else "convert it"
        raise RecordError(
            f"array {name!r} has dtype {array.dtype} and shape {array.shape}; kept are bool, integers, "
            f"float16 to float64 and fixed-width unicode, little-endian: {hint} first"
        )


def flat_bytes(array: np.ndarray) -> np.ndarray:
    """Return the bytes of a C-contiguous array, in C order, as a uint8 vector that shares its memory."""
    if array.nbytes == 0:
        return np.empty(0, np.uint8)
    return array.reshape(-1).view(np.uint8)


def item_size(dtype: np.dtype) -> int:
    """Return by how many bytes the elements of an array alternate: four for text, a character."""
    return 4 if dtype.kind == "U" else dtype.itemsize


def array_digest(array: np.ndarray) -> str:
    """Return the sha256, in hexadecimal, over the dtype, the shape and the bytes of a C-contiguous array."""
    digest = hashlib.sha256(f"{array.dtype.str};{','.join(map(str, array.shape))};".encode("ascii"))
    digest.update(flat_bytes(array).data)
    return digest.hexdigest()


def encode_payload(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return checked arrays as the bytes of a journal row's payload.

    Raises RecordError when they hold more than 256 MiB together.
    """
    size = sum(array.nbytes for array in arrays.values())
    if size > LARGEST_PAYLOAD:
        raise RecordError(
            f"the arrays of one record hold {size} bytes, more than {LARGEST_PAYLOAD}: keep them in a checkpoint"
        )
    if len(arrays) > 0xFFFF:
        raise RecordError(f"one record has {len(arrays)} arrays, more than 65535")
    payload = _packed(arrays, _compressed)
    return payload if size <= SPARE + RATIO * len(payload) else _packed(arrays, _plain)


def _packed(arrays: Mapping[str, np.ndarray], buffered: Callable[[np.ndarray], tuple[int, bytes]]) -> bytes:
    head, buffers = [HEADER.pack(MAGIC, PAYLOAD_VERSION, len(arrays))], []
    for name, array in arrays.items():
        codec, buffer = buffered(array)
        head += [_short(name), _short(array.dtype.str), struct.pack("<B", array.ndim)]
        head += [struct.pack(f"<{array.ndim}Q", *array.shape)]
        head += [LENGTHS.pack(codec, array.nbytes, len(buffer))]
        buffers.append(buffer)
    return b"".join(head + buffers)


def _short(text: str) -> bytes:
    return struct.pack("<B", len(text)) + text.encode("ascii")


def _compressed(array: np.ndarray) -> tuple[int, bytes]:
    raw = flat_bytes(array)
    if raw.size >= SMALL and len(frame := compress(raw, item_size(array.dtype))) < raw.size:
        return ZSTD, frame
    return _plain(array)


def _plain(array: np.ndarray) -> tuple[int, bytes]:
    return RAW, flat_bytes(array).tobytes()


@dataclass(frozen=True)
class _Described:
    """What a payload says of one of its arrays; `stored` are the bytes of its buffer."""

    name: str
    dtype: np.dtype
    shape: tuple[int, ...]
    codec: int
    size: int
    stored: int


def decode_payload(payload: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of a payload, as fresh writable arrays; its checksum need not be right, nor from a friend.

    Nothing is allocated before all that it says of its arrays is found to be so. Raises VersionError for a
    payload of a newer version and ValueError for bytes that are no payload, or hold more than `encode_payload`
    takes.
    """
    try:
        described, start = _descriptions(payload)
    except (struct.error, IndexError, UnicodeDecodeError) as error:
        raise ValueError(f"the payload ends in a description: {error}") from error
    size, stored = (sum(getattr(part, name) for part in described) for name in ("size", "stored"))
    if size > (most := min(LARGEST_PAYLOAD, SPARE + RATIO * len(payload))):
        raise ValueError(f"the arrays of a payload of {len(payload)} bytes have {size} bytes, more than {most}")
    if stored != len(payload) - start:
        raise ValueError(f"the buffers of a payload have {len(payload) - start} bytes, not {stored}")
    if len({part.name.casefold() for part in described}) < len(described):
        raise ValueError("two arrays of a payload have one name")
    arrays = {}
    for part in described:
        arrays[part.name] = _filled(part, payload[start : start + part.stored])
        start += part.stored
    return arrays


def _descriptions(payload: bytes) -> tuple[list[_Described], int]:
    """Return what the payload says of each array, and where the first buffer begins."""
    magic, version, count = HEADER.unpack_from(payload)
    if magic != MAGIC:
        raise ValueError("the payload does not start with its magic number")
    if version > PAYLOAD_VERSION:
        raise VersionError(
            f"a record's arrays are written in payload format {version}; this release reads up to "
            f"{PAYLOAD_VERSION}: upgrade it"
        )
    if version < 1:
        raise ValueError(f"there is no payload format {version}")
    start, described = HEADER.size, []
    for _ in range(count):
        texts = []
        for _ in ("name", "dtype"):
            end = start + 1 + payload[start]
            texts.append(payload[start + 1 : end].decode("ascii"))
            start = end
        name, dtype, axes = require_name(texts[0]), kept_dtype(texts[1]), payload[start]
        shape = require_shape(struct.unpack_from(f"<{axes}Q", payload, start + 1), dtype)
        codec, size, stored = LENGTHS.unpack_from(payload, start + 1 + 8 * axes)
        start += 1 + 8 * axes + LENGTHS.size
        if size != prod(shape) * dtype.itemsize:
            raise ValueError(f"array {name!r} of shape {shape} and dtype {dtype} is said to have {size} bytes")
        if codec not in (RAW, ZSTD) or (codec == RAW and stored != size):
            raise ValueError(f"array {name!r} has codec {codec} and {stored} bytes for {size}")
        described.append(_Described(name, dtype, shape, codec, size, stored))
    return described, start


def _filled(part: _Described, buffer: bytes) -> np.ndarray:
    array = np.empty(part.shape, part.dtype)
    target = flat_bytes(array)
    if part.codec == RAW:
        target[:] = np.frombuffer(buffer, np.uint8)
    else:
        decompress(buffer, target, item_size(part.dtype))
    require_values(array)
    return array
