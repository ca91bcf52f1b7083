"""What the store keeps: records, their heads, and checkpoints; and what of their fields can be kept."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from scroll_tactile_store.exceptions import RecordError

JSON: TypeAlias = "bool | int | float | str | Sequence[JSON] | Mapping[str, JSON] | None"
Arrays: TypeAlias = Mapping[str, np.ndarray]
Attributes: TypeAlias = Mapping[str, JSON] | None

# Texts that are read as JSON. A value of three characters takes up to 90 bytes of memory: these at most 200 MB.
LARGEST_JSON, MOST_VALUES = 64 * 2**20, 2**21
LARGEST_NUMBER = 2**63 - 1


@dataclass(frozen=True)
class Head:
    """One durable row of the journal without its arrays, which compaction may have given up.

    `sequence` counts 1, 2, 3 … without gaps. `key` is a content hash of at most 255 bytes and `time`
    is in Unix seconds. `size` is that of the payload in bytes.
    """

    sequence: int
    kind: str
    label: str
    key: bytes
    time: float
    attributes: Mapping[str, JSON]
    size: int


# Without eq: comparing arrays element by element has no single truth value.
@dataclass(frozen=True, eq=False)
class Record(Head):
    """One durable row of the journal, with its arrays: fresh copies, the caller's to change."""

    arrays: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Committed arrays: it contains the journal's rows up to and including sequence `last_sequence`."""

    number: int
    last_sequence: int
    attributes: Mapping[str, JSON]
    arrays: Mapping[str, np.ndarray]


def to_json(what: str, value: Attributes) -> str:
    """Return `value` as compact JSON with sorted keys, in ASCII; None counts as empty. A tuple comes back as a list.

    Raises RecordError for what JSON cannot hold: NaN and infinities, NumPy scalars and other objects, and too much.
    """
    try:
        text = json.dumps(dict(value or {}), sort_keys=True, separators=(",", ":"), allow_nan=False)
        _require_bounded(text)
    except (RecursionError, TypeError, ValueError) as error:
        raise RecordError(f"{what} cannot be written as JSON: {error}") from error
    return text


def from_json(text: str) -> dict[str, JSON]:
    """Return what `to_json` wrote; raise ValueError for anything else, or JSON that is too deep or long."""
    _require_bounded(text)
    try:
        value = json.loads(text)
    except RecursionError as error:
        raise ValueError("JSON that is nested too deep") from error
    if not isinstance(value, dict):
        raise ValueError("not a JSON object")
    return value


def _require_bounded(text: str) -> None:
    if len(text) > LARGEST_JSON:
        raise ValueError(f"JSON of {len(text)} characters; at most {LARGEST_JSON} are read")
    if len(text) > MOST_VALUES and sum(map(text.count, "[{,:")) > MOST_VALUES:
        raise ValueError(f"JSON of more than {MOST_VALUES} values")


def json_digest(known: Mapping[str, Any]) -> str:
    """Return the sha256 of a JSON object, in hexadecimal: of its compact text in ASCII, keys sorted at every depth."""
    return hashlib.sha256(json.dumps(known, sort_keys=True, separators=(",", ":")).encode("ascii")).hexdigest()


def payload_digest(*parts: bytes | memoryview) -> bytes:
    """Return the 16-byte BLAKE2b over the bytes of a payload, which may come in parts."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        digest.update(part)
    return digest.digest()
