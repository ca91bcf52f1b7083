"""Which arrays the store keeps, their digests, and the bytes of a record's payload (FORMAT.md describes them)."""

from __future__ import annotations

import hashlib
import re
import struct
from collections.abc import Mapping
from io import BytesIO

import numpy as np

from store.exceptions import RecordError, VersionError

__all__ = ["array_digest", "check_arrays", "decode_payload", "encode_payload", "flat_bytes"]

MAGIC = b"ARPL"
PAYLOAD_VERSION = 1
HEADER = struct.Struct("<4sBH")
LENGTHS = struct.Struct("<BQQ")
RAW, BLOSC = 0, 1

# Every append waits for it: the differences of a BioTac touch's readings, 15 KB as int16, become 3.2 KB in 0.023 ms
# (LZ4: 5.3 KB in 0.007 ms; zstd level 3: 3.1 KB in 0.037 ms), where the disk itself takes 0.2 to 0.3 ms.
COMPRESSOR, LEVEL = b"zstd", 1
SMALL = 128  # bytes, of which compressing saves next to nothing

# SQLite refuses blobs above 1e9 bytes, and a row this large stalls every append behind it.
LARGEST_PAYLOAD = 256 * 2**20

KEPT_TYPES = frozenset(["|b1", "|i1", "|u1", "<i2", "<i4", "<i8", "<u2", "<u4", "<u8", "<f2", "<f4", "<f8"])

# The names are folders in a generation: portable to every file system, never zarr's reserved "__…".
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
        _check_name(name)
        if other := folded.get(name.casefold()):
            raise RecordError(f"the names {other!r} and {name!r} would be one folder on a Mac or on Windows")
        folded[name.casefold()] = name
        _check_array(name, array)
        # Not ascontiguousarray, which turns a 0-d array into a 1-d one.
        checked[name] = np.asarray(array, order="C")
    return checked


def _check_name(name: str) -> None:
    if not isinstance(name, str) or not NAME.fullmatch(name) or name.casefold() == "zarr.json":
        raise RecordError(
            f"{name!r} cannot name an array: use 1 to 100 ASCII letters, digits, '_', '-' and '.', not "
            "starting with '__', '-' or '.' nor ending with '.'"
        )


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
            f"the arrays of one record hold {size} bytes, more than {LARGEST_PAYLOAD}: keep them in a generation"
        )
    if len(arrays) > 0xFFFF:
        raise RecordError(f"one record has {len(arrays)} arrays, more than 65535")
    head, buffers = [HEADER.pack(MAGIC, PAYLOAD_VERSION, len(arrays))], []
    for name, array in arrays.items():
        codec, buffer = _compressed(array)
        head += [_short(name), _short(array.dtype.str), struct.pack("<B", array.ndim)]
        head += [struct.pack(f"<{array.ndim}Q", *array.shape)]
        head += [LENGTHS.pack(codec, array.nbytes, len(buffer))]
        buffers.append(buffer)
    return b"".join(head + buffers)


def _short(text: str) -> bytes:
    return struct.pack("<B", len(text)) + text.encode("ascii")


def _compressed(array: np.ndarray) -> tuple[int, bytes]:
    raw = flat_bytes(array)
    if raw.size < SMALL:
        return RAW, raw.tobytes()
    # Imported late: reading and opening a store without arrays does not need it, and it costs 60 ms.
    from numcodecs import blosc

    # Blosc shuffles by the item's size, which it takes from the buffer; a character is four bytes.
    item = 4 if array.dtype.kind == "U" else array.dtype.itemsize
    packed: bytes = blosc.compress(raw.view(f"<u{item}"), COMPRESSOR, LEVEL, blosc.BITSHUFFLE)
    return (BLOSC, packed) if len(packed) < raw.size else (RAW, raw.tobytes())


def decode_payload(payload: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of a payload whose checksum was verified, as fresh writable arrays.

    Raises VersionError for a payload of a newer version and ValueError for bytes that are no payload.
    """
    try:
        return _decode(BytesIO(payload))
    except (struct.error, UnicodeDecodeError, RuntimeError, TypeError, OverflowError) as error:
        raise ValueError(f"not a payload of arrays: {error}") from error


def _decode(stream: BytesIO) -> dict[str, np.ndarray]:
    def unpack(layout: str) -> tuple[int, ...]:
        return struct.unpack(layout, stream.read(struct.calcsize(layout)))

    def text() -> str:
        return stream.read(*unpack("<B")).decode("ascii")

    if stream.read(4) != MAGIC:
        raise ValueError("the payload does not start with its magic number")
    version, count = unpack("<BH")
    if version > PAYLOAD_VERSION:
        raise VersionError(
            f"a record's arrays are written in payload format {version}; this release reads up to "
            f"{PAYLOAD_VERSION}: upgrade it"
        )
    described = []
    for _ in range(count):
        name, dtype = text(), text()
        (dimensions,) = unpack("<B")
        array = np.empty(unpack(f"<{dimensions}Q"), np.dtype(dtype))
        codec, size, stored = unpack("<BQQ")
        if array.nbytes != size:
            raise ValueError(f"array {name!r} of {array.nbytes} bytes is said to have {size}")
        described.append((name, array, codec, stored))
    for _, array, codec, stored in described:
        _fill(array, codec, stream.read(stored), stored)
    return {name: array for name, array, _, _ in described}


def _fill(array: np.ndarray, codec: int, buffer: bytes, size: int) -> None:
    target = flat_bytes(array)
    if len(buffer) != size:
        raise ValueError("the payload ends early")
    if codec == RAW:
        target[:] = np.frombuffer(buffer, np.uint8)
    elif codec == BLOSC:
        from numcodecs import blosc

        if struct.unpack_from("<I", buffer, 4)[0] != array.nbytes:
            raise ValueError("a compressed array has another length than its description")
        blosc.decompress(buffer, target)
    else:
        raise ValueError(f"unknown codec {codec}")
