"""A record as the payload of a frame, and back (FORMAT.md describes it)."""

from __future__ import annotations

import math
import struct
from typing import Any, NamedTuple

from scroll_tactile_store.records import LARGEST_NUMBER, Head, check_key, check_text, from_json, payload_digest, to_json

__all__ = [
    "HEAD_BYTES",
    "ROW",
    "JournalRow",
    "decode_head",
    "decode_row",
    "encode_row",
    "head_size",
    "head_without_arrays",
    "key_prefix",
    "prefix_in",
    "row_sequence",
    "verified_size",
]

ROW = 2  # the kind of a frame that holds a record

# sequence, time, bytes of the arrays' payload, whether that follows; lengths of key, kind, label and attributes.
FIELDS = struct.Struct("<QdQBBIII")
DIGEST_BYTES = 16
HEAD_BYTES = FIELDS.size + DIGEST_BYTES


class JournalRow(NamedTuple):
    """A record's head, and the payload of its arrays; None where compaction gave that up."""

    head: Head
    payload: bytes | None


def encode_row(
    sequence: int, kind: str, label: str, key: bytes, time: float, attributes: str, payload: bytes | None, size: int
) -> bytes:
    """Return the bytes of checked values: `attributes` as JSON, and of arrays that were given up their `size` alone."""
    texts = (key, kind.encode(), label.encode(), attributes.encode())
    kept = payload is not None
    fields = FIELDS.pack(sequence, time, size, kept, *map(len, texts))
    return b"".join((fields, payload_digest(b"".join((fields, *texts))), *texts, payload or b""))


def head_without_arrays(head: Head) -> bytes:
    """Return the bytes of a row that has given up its arrays."""
    text = to_json("attributes", head.attributes)
    return encode_row(head.sequence, head.kind, head.label, head.key, head.time, text, None, head.size)


def _fields(data: bytes) -> tuple[Any, ...]:
    if len(data) < HEAD_BYTES:
        raise ValueError(f"a row has at least {HEAD_BYTES} bytes, not {len(data)}")
    return FIELDS.unpack_from(data)


def row_sequence(data: bytes) -> int:
    """Return the sequence of a row, of which these are the first HEAD_BYTES or more; raise ValueError for none."""
    sequence: int = _fields(data)[0]
    if not 1 <= sequence <= LARGEST_NUMBER:
        raise ValueError(f"a row has the sequence {sequence}")
    return sequence


def key_prefix(key: bytes) -> int:
    """Return the first eight bytes of a key as a number, by which a row is looked for; equal keys have equal ones."""
    return int.from_bytes(key[:8], "little")


def prefix_in(data: bytes) -> int:
    """Return the `key_prefix` of a row of which these are the first HEAD_BYTES + 8, or all."""
    return key_prefix(data[HEAD_BYTES : HEAD_BYTES + min(8, FIELDS.unpack_from(data)[4])])


def head_size(data: bytes, whole: int) -> int:
    """Return the bytes of a row without its arrays, of which `data` has the first; raise ValueError for no row.

    whole: the bytes of the row.
    """
    _, _, size, kept, *lengths = _fields(data)
    end: int = HEAD_BYTES + sum(lengths)
    if end + (size if kept else 0) != whole or kept > 1:
        raise ValueError(f"a row of {whole} bytes says that it has {end} and {size}")
    return end


def verified_size(data: bytes, whole: int) -> int:
    """Return as `head_size`, of a head that is all there; raise ValueError where its own digest fails, too."""
    end = head_size(data, whole)
    if payload_digest(data[: FIELDS.size] + data[HEAD_BYTES:end]) != data[FIELDS.size : HEAD_BYTES]:
        raise ValueError("a row's head is not as it was written")
    return end


def decode_head(data: bytes, whole: int) -> Head:
    """Return the head of a row of `whole` bytes, of which `data` has the head, verified by its own digest.

    Raises ValueError for what `encode_row` never made. Anybody can make a digest.
    """
    texts = data[HEAD_BYTES : verified_size(data, whole)]
    sequence, time, size, _, *lengths = FIELDS.unpack_from(data)
    if not 1 <= sequence <= LARGEST_NUMBER or size > LARGEST_NUMBER or not math.isfinite(time):
        raise ValueError(f"a row has the sequence {sequence}, {size} bytes and the time {time}")
    parts, start = [], 0
    for length in lengths:
        parts.append(texts[start : start + length])
        start += length
    key, kind, label, attributes = parts
    return Head(
        sequence,
        check_text("the kind", kind.decode()),
        check_text("the label", label.decode()),
        check_key(key),
        time,
        from_json(attributes.decode()),
        size,
    )


def decode_row(data: bytes) -> JournalRow:
    """Return the record; raise ValueError for what `encode_row` never made. Anybody can make a checksum."""
    head, kept = decode_head(data, len(data)), FIELDS.unpack_from(data)[3]
    return JournalRow(head, data[head_size(data, len(data)) :] if kept else None)
