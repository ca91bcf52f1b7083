"""What the store keeps: records, their heads, and checkpoints; and what of their fields can be kept."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import numpy as np

from scroll_tactile_store.exceptions import RecordError

JSON: TypeAlias = "bool | int | float | str | Sequence[JSON] | Mapping[str, JSON] | None"
Arrays: TypeAlias = Mapping[str, np.ndarray]
Attributes: TypeAlias = Mapping[str, JSON] | None

# Texts that are read as JSON. A value of three characters takes up to 90 bytes of memory: these at most 200 MB.
LARGEST_JSON, MOST_VALUES = 64 * 2**20, 2**21
LARGEST_NUMBER = 2**63 - 1

SIMPLE = frozenset({int, bool, type(None)})  # what comes back from JSON as it is

LONGEST_KEY = 64  # bytes: the longest digest in common use (sha512, blake2b)


@dataclass(frozen=True)
class Head:
    """One durable row of the journal without its arrays, which compaction may have given up.

    `sequence` counts 1, 2, 3 … without gaps. `key` is a content hash of at most 64 bytes and `time`
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


def check_text(what: str, text: str) -> str:
    """Return `text` when it can be kept as UTF-8; raise RecordError otherwise."""
    if not isinstance(text, str):
        raise RecordError(f"{what} must be a str, not {type(text).__name__}")
    if "\0" in text:
        raise RecordError(f"{what} {text!r} contains a NUL character, at which many readers would cut it off")
    return _check_pairs(what, text)


def _check_pairs(what: str, text: str) -> str:
    # UTF-8 has no form for half of a surrogate pair, and two halves in JSON would come back as one character.
    if text.isascii():
        return str(text)
    try:
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        raise RecordError(f"{what} {text!r} holds half of a surrogate pair at position {error.start}") from error
    return str(text)


def check_key(key: bytes) -> bytes:
    """Return the content hash `key` when it is bytes, at most 64 of them; raise RecordError otherwise."""
    if not isinstance(key, bytes):
        raise RecordError(f"the key must be bytes, not {type(key).__name__}")
    if len(key) > LONGEST_KEY:
        raise RecordError(f"the key has {len(key)} bytes; the longest that is kept has {LONGEST_KEY}")
    return key


def check_time(time: float) -> float:
    """Return `time`, Unix seconds, as a float; raise RecordError when it is not a finite number."""
    if isinstance(time, bool) or not isinstance(time, int | float) or not math.isfinite(time):
        raise RecordError(f"the time must be a finite number of seconds since 1970, not {time!r}")
    return float(time)


def to_json(what: str, value: Attributes) -> str:
    """Return `value` as compact JSON with sorted keys, in ASCII; None counts as empty. Raises as `plain_json`."""
    return plain_json(what, value)[1]


def plain_json(what: str, value: Attributes) -> tuple[dict[str, JSON], str]:
    """Return `value` as it comes back from JSON, and that: compact, in ASCII, with sorted keys. None counts as empty.

    Raises RecordError, naming the place, for what would not come back equal: NaN and infinities, keys
    that are not strings, NumPy scalars and other objects. A tuple comes back as a list.
    """
    if not isinstance(value, Mapping | None):
        raise RecordError(f"{what} must be a mapping, not {type(value).__name__}")
    try:
        plain = cast("dict[str, JSON]", _plain(what, value or {}))
        text = json.dumps(plain, sort_keys=True, separators=(",", ":"), allow_nan=False)
        _require_bounded(text)
    except (RecursionError, ValueError) as error:
        if isinstance(error, RecordError):
            raise
        raise RecordError(f"{what} cannot be written as JSON: {error}") from error
    return plain, text


def from_json(text: str) -> dict[str, JSON]:
    """Return what `to_json` wrote; raise ValueError for anything else, or JSON that is too deep or long."""
    _require_bounded(text)
    try:
        value = JSON_READER.decode(text)
    except RecursionError as error:
        raise ValueError("JSON that is nested too deep") from error
    if not isinstance(value, dict):
        raise ValueError("not a JSON object")
    return cast("dict[str, JSON]", value)


def _require_bounded(text: str) -> None:
    if len(text) > LARGEST_JSON:
        raise ValueError(f"JSON of {len(text)} characters; at most {LARGEST_JSON} are read")
    if len(text) > MOST_VALUES and sum(map(text.count, "[{,:")) > MOST_VALUES:
        raise ValueError(f"JSON of more than {MOST_VALUES} values")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"JSON with the number {text}")
    return number


JSON_READER = json.JSONDecoder(parse_float=_finite, parse_constant=_finite)


def _plain(where: str, value: JSON) -> JSON:
    if type(value) in SIMPLE:
        return value
    if isinstance(value, str):
        return _check_pairs(where, value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise RecordError(f"{where} is {value!r}, which JSON cannot hold; use None or a string")
        return float(value)
    if isinstance(value, list | tuple):
        # Most of what is appended is lists of numbers.
        parts = enumerate(value)
        return [part if type(part) in SIMPLE else _plain(f"{where}[{index}]", part) for index, part in parts]
    if isinstance(value, Mapping):
        if strange := [name for name in value if not isinstance(name, str)]:
            raise RecordError(f"{where} has the key {strange[0]!r}; JSON keys are strings")
        return {_check_pairs(where, name): _plain(f"{where}[{name!r}]", part) for name, part in value.items()}
    if isinstance(value, int):
        return int(value)
    raise RecordError(f"{where} is a {type(value).__name__}, not JSON: convert it, or keep it as an array")


def json_digest(known: Mapping[str, Any]) -> str:
    """Return the sha256 of a JSON object, in hexadecimal: of its compact text in ASCII, keys sorted at every depth."""
    return hashlib.sha256(json.dumps(known, sort_keys=True, separators=(",", ":")).encode("ascii")).hexdigest()


def payload_digest(*parts: bytes | memoryview) -> bytes:
    """Return the 16-byte BLAKE2b over the bytes of a payload, which may come in parts."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        digest.update(part)
    return digest.digest()
