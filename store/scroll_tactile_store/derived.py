"""What follows from a checkpoint, in files of the folder `derived`, and counts where it is of that checkpoint.

A file is a mark and version, the checkpoint's sha256, the lengths of the three parts that come next, a JSON object,
another that describes the mapped arrays, the other arrays as a row has them, compressed where that halves them; then
the mapped arrays as they are in memory, each from a multiple of 64 bytes on, and a digest of all before. The digest has
no key: a file from elsewhere can hold anything, and whoever reads it has to check what he needs.

A writer puts a new file in the place of one that is mapped, so that its readers keep the old bytes. Whoever cuts such
a file short in place ends the processes that read it; one that writes into it misleads them.
"""

from __future__ import annotations

import logging
import mmap
import struct
from collections.abc import Collection, Iterator, Mapping
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from scroll_tactile_store.encoding import (
    LARGEST_PAYLOAD,
    decode_payload,
    encode_payload,
    flat_bytes,
    kept_dtype,
    require_name,
    require_shape,
)
from scroll_tactile_store.exceptions import DamageError, VersionError
from scroll_tactile_store.files import is_real_folder, new_file, regular_file, remove_tree
from scroll_tactile_store.layout import DERIVED, NEW
from scroll_tactile_store.records import JSON, LARGEST_JSON, from_json, payload_digest, to_json

__all__ = ["read_derived", "remove_derived", "without_digest", "write_derived", "write_digested"]

logger = logging.getLogger(__name__)

MARK = b"\x89ARDER\x02\n"
HEADER = struct.Struct("<8s32sQQQ")
DIGEST_BYTES = 16
ROWS = "rows-"  # files of the index, which are of the log: see `scroll_tactile_store.rows`
LARGEST_FILE = 2**33  # bytes
ALIGNED = 64  # bytes: a mapped array begins at a multiple
PART = 2**20  # bytes that are read at once
NUMBERS = "iuf"  # kinds of dtypes of which any bytes are values


def write_derived(
    folder: Path,
    name: str,
    follows: str,
    attributes: str,
    arrays: Mapping[str, np.ndarray],
    mapped: Collection[str] = (),
) -> None:
    """Write a file of a store's folder, in the place of the one before; a power cut may leave neither.

    follows: the sha256 of the checkpoint, in hexadecimal. attributes: JSON. mapped: the names of arrays that readers
    map rather than read. Raises OSError, RecordError.
    """
    large = {own: arrays[own] for own in sorted(arrays.keys() & mapped) if _is_mapped(arrays[own])}
    payload = encode_payload({own: array for own, array in arrays.items() if own not in large}, sparingly=True)
    described = to_json("mapped", {own: [array.dtype.str, *array.shape] for own, array in large.items()})
    texts = [attributes.encode("ascii"), described.encode("ascii"), payload]
    parts: list[bytes | memoryview] = [HEADER.pack(MARK, bytes.fromhex(follows), *map(len, texts)), *texts]
    end = sum(map(len, parts))
    for array in large.values():  # in the order that JSON has them
        parts += [bytes(-end % ALIGNED), flat_bytes(array).data]
        end += -end % ALIGNED + array.nbytes
    write_digested(folder / DERIVED / name, *parts)


def _is_mapped(array: np.ndarray) -> bool:
    return bool(array.size) and array.dtype.kind in NUMBERS


def write_digested(path: Path, *parts: bytes | memoryview) -> None:
    """Put a file with a digest behind its parts in the place of the one before, not durably. Raises OSError."""
    path.parent.mkdir(exist_ok=True)
    draft = path.with_name(path.name + NEW)
    with new_file(draft) as file:
        for part in (*parts, payload_digest(*parts)):
            file.write(part)
    draft.replace(path)


def without_digest(data: bytes) -> bytes:
    """Return the bytes before the digest; raise ValueError where that differs."""
    if payload_digest(data[:-DIGEST_BYTES]) != data[-DIGEST_BYTES:]:
        raise ValueError("its digest differs")
    return data[:-DIGEST_BYTES]


def remove_derived(folder: Path) -> None:
    """Remove the files of a checkpoint that no longer counts: they may say what was retracted and compacted since."""
    if is_real_folder(folder / DERIVED):
        for entry in (folder / DERIVED).iterdir():
            if not entry.name.startswith(ROWS):
                remove_tree(entry)


def read_derived(folder: Path, name: str, follows: str) -> tuple[Mapping[str, JSON], Mapping[str, np.ndarray]] | None:
    """Return attributes and arrays of a file; None where it is missing, damaged or of another checkpoint.

    The mapped arrays, too, are the caller's to change: pages that he writes to are copied.
    """
    path = folder / DERIVED / name
    try:
        with regular_file(path, LARGEST_FILE, within=folder) as (file, size):
            mark, of, *sizes = HEADER.unpack(file.read(HEADER.size))
            if mark != MARK or of.hex() != follows:
                raise ValueError("it is of another checkpoint")
            if max(sizes[:2]) > LARGEST_JSON or sizes[2] > 2 * LARGEST_PAYLOAD or sum(sizes) > size:
                raise ValueError(f"its parts of {sizes} bytes are too large")
            texts = [file.read(length) for length in sizes]
            described = from_json(texts[1].decode("ascii"))
            places, end = _placed(described, HEADER.size + sum(sizes))
            if end + DIGEST_BYTES != size:
                raise ValueError(f"it has {size} bytes; its arrays end at {end}")
            file.seek(0)
            if payload_digest(*_parts(file, end)) != file.read(DIGEST_BYTES):
                raise ValueError("its digest differs")
            arrays = decode_payload(texts[2])
            memory = mmap.mmap(file.fileno(), end, access=mmap.ACCESS_COPY) if places else b""
        return from_json(texts[0].decode("ascii")), {**arrays, **_mapped(memory, places)}
    except FileNotFoundError:
        return None
    except (DamageError, VersionError, OSError, ValueError, MemoryError, struct.error) as error:
        logger.info("%s is not used: %s", path, error)
        return None


Places = Mapping[str, tuple[np.dtype, tuple[int, ...], int]]
"""Of each mapped array its dtype, shape and first byte."""


def _placed(described: Mapping[str, Any], begin: int) -> tuple[Places, int]:
    """The mapped arrays behind a place, as they are described, and where the last one ends."""
    places = {}
    for name, about in described.items():
        if not isinstance(about, list) or not about or (dtype := kept_dtype(about[0])).kind not in NUMBERS:
            raise ValueError(f"{require_name(name)} is described by {about!r:.80}")
        shape = require_shape(about[1:], dtype)
        begin += -begin % ALIGNED
        places[require_name(name)] = dtype, shape, begin
        begin += prod(shape) * dtype.itemsize
    return places, begin


def _mapped(memory: bytes | mmap.mmap, places: Places) -> dict[str, np.ndarray]:
    return {
        name: np.frombuffer(memory, dtype, prod(shape), begin).reshape(shape)
        for name, (dtype, shape, begin) in places.items()
    }


def _parts(file: BinaryIO, size: int) -> Iterator[bytes]:
    """The first bytes of a file, a part at a time: what is read so is not held, as what is mapped would be."""
    for first in range(0, size, PART):
        yield file.read(min(PART, size - first))
