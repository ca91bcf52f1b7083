"""A record as the payload of a frame, and back (LOG.md describes it)."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from store.records import LARGEST_NUMBER, Head, check_key, check_text, from_json

__all__ = ["ROW", "Row", "decode_row", "encode_row"]

ROW = 2  # the kind of a frame that holds a record

# sequence, time, bytes of the arrays' payload, whether that follows; lengths of key, kind, label and attributes.
FIELDS = struct.Struct("<QdQBBIII")


@dataclass(frozen=True)
class Row:
    """A record's head, and the payload of its arrays; None where compaction gave that up."""

    head: Head
    payload: bytes | None


def encode_row(
    sequence: int, kind: str, label: str, key: bytes, time: float, attributes: str, payload: bytes | None, size: int
) -> bytes:
    """Return the bytes of checked values: `attributes` as JSON, and of arrays that were given up their `size` alone."""
    texts = (key, kind.encode(), label.encode(), attributes.encode())
    kept = payload is not None
    return b"".join((FIELDS.pack(sequence, time, size, kept, *map(len, texts)), *texts, payload or b""))


def decode_row(data: bytes) -> Row:
    """Return the record; raise ValueError for what `encode_row` never made. Anybody can make a checksum."""
    if len(data) < FIELDS.size:
        raise ValueError(f"a row has at least {FIELDS.size} bytes, not {len(data)}")
    sequence, time, size, kept, *lengths = FIELDS.unpack_from(data)
    texts, start = [], FIELDS.size
    for length in lengths:
        texts.append(data[start : start + length])
        start += length
    if start + (size if kept else 0) != len(data) or kept > 1:
        raise ValueError(f"a row of {len(data)} bytes says that it has {start} and {size}")
    if not 1 <= sequence <= LARGEST_NUMBER or size > LARGEST_NUMBER or not math.isfinite(time):
        raise ValueError(f"a row has the sequence {sequence}, {size} bytes and the time {time}")
    key, kind, label, attributes = texts
    head = Head(
        sequence,
        check_text("the kind", kind.decode()),
        check_text("the label", label.decode()),
        check_key(key),
        time,
        from_json(attributes.decode()),
        size,
    )
    return Row(head, data[start:] if kept else None)
