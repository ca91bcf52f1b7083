"""What follows from a checkpoint, in files of the folder `derived`, and counts where it is of that checkpoint.

A file is a mark and version, the checkpoint's sha256, the bytes of a JSON object, this object, arrays as a row has
them, compressed where that halves them, and a digest of all before. The digest has no key: a file from elsewhere can
hold anything, and whoever reads it has to check what he needs.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from store.encoding import decode_payload, encode_payload
from store.exceptions import DamageError, VersionError
from store.files import is_real_folder, new_file, read_regular, remove_tree
from store.layout import DERIVED, NEW
from store.records import JSON, from_json, payload_digest

__all__ = ["read_derived", "remove_derived", "without_digest", "write_derived", "write_digested"]

logger = logging.getLogger(__name__)

MARK = b"\x89ARDER\x01\n"
HEADER = struct.Struct("<8s32sQ")
DIGEST_BYTES = 16
ROWS = "rows-"  # files of the index, which are of the log: see `store.rows`
LARGEST_FILE = 2**29  # bytes: a payload has at most half of it


def write_derived(folder: Path, name: str, follows: str, attributes: str, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a file of a store's folder, in the place of the one before; a power cut may leave neither.

    follows: the sha256 of the checkpoint, in hexadecimal. attributes: JSON. Raises OSError, RecordError.
    """
    about = attributes.encode("ascii")
    head = HEADER.pack(MARK, bytes.fromhex(follows), len(about))
    write_digested(folder / DERIVED / name, b"".join((head, about, encode_payload(arrays, sparingly=True))))


def write_digested(path: Path, data: bytes) -> None:
    """Put a file with a digest behind its bytes in the place of the one before, not durably. Raises OSError."""
    path.parent.mkdir(exist_ok=True)
    draft = path.with_name(path.name + NEW)
    with new_file(draft) as file:
        file.write(data)
        file.write(payload_digest(data))
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
        data = read_regular(path, LARGEST_FILE, within=folder)
        mark, of, size = HEADER.unpack_from(data)
        if mark != MARK or of.hex() != follows:
            raise ValueError("it is of another checkpoint")
        data = without_digest(data)
        begin = HEADER.size + size
        about = from_json(data[HEADER.size : begin].decode("ascii"))
        return about, decode_payload(data[begin:])
    except FileNotFoundError:
        return None
    except (DamageError, VersionError, OSError, ValueError, MemoryError, struct.error) as error:
        logger.info("%s is not used: %s", path, error)
        return None
