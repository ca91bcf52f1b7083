"""What follows from a checkpoint, in files of the folder `derived`, and counts where it is of that checkpoint.

A file is a mark and version, the checkpoint's sha256, the lengths of the two parts that come next, a JSON object, and
arrays as a row has them; then a digest of all before. The digest has no key: a file
from elsewhere can hold anything, and whoever reads it has to check what he needs.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from scroll_tactile_store.encoding import LARGEST_PAYLOAD, decode_payload, encode_payload
from scroll_tactile_store.exceptions import DamageError, VersionError
from scroll_tactile_store.files import is_real_folder, new_file, regular_file, remove_tree
from scroll_tactile_store.layout import DERIVED, NEW
from scroll_tactile_store.records import JSON, LARGEST_JSON, from_json, payload_digest

__all__ = ["read_derived", "remove_derived", "without_digest", "write_derived", "write_digested"]

logger = logging.getLogger(__name__)

MARK = b"\x89ARDER\x03\n"
HEADER = struct.Struct("<8s32sQQ")
DIGEST_BYTES = 16
ROWS = "rows-"  # files of the index, which are of the log: see `scroll_tactile_store.rows`
LARGEST_FILE = 2**30  # bytes


def write_derived(folder: Path, name: str, follows: str, attributes: str, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a file of a store's folder, in the place of the one before; a power cut may leave neither.

    follows: the sha256 of the checkpoint, in hexadecimal. attributes: JSON. Raises OSError, RecordError.
    """
    parts = [attributes.encode("ascii"), encode_payload(arrays)]
    write_digested(folder / DERIVED / name, HEADER.pack(MARK, bytes.fromhex(follows), *map(len, parts)), *parts)


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
    """Return attributes and arrays of a file; None where it is missing, damaged or of another checkpoint."""
    path = folder / DERIVED / name
    try:
        with regular_file(path, LARGEST_FILE, within=folder) as (file, size):
            mark, of, *sizes = HEADER.unpack(file.read(HEADER.size))
            if mark != MARK or of.hex() != follows:
                raise ValueError("it is of another checkpoint")
            end = HEADER.size + sum(sizes)
            if sizes[0] > LARGEST_JSON or sizes[1] > 2 * LARGEST_PAYLOAD or end + DIGEST_BYTES != size:
                raise ValueError(f"its parts of {sizes} bytes are not in {size}")
            file.seek(0)
            parts = without_digest(file.read(size))[HEADER.size :]
        return from_json(parts[: sizes[0]].decode("ascii")), decode_payload(parts[sizes[0] :])
    except FileNotFoundError:
        return None
    except (DamageError, VersionError, OSError, ValueError, MemoryError, struct.error) as error:
        logger.info("%s is not used: %s", path, error)
        return None
