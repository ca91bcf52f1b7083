"""What the store hands out: a row of the journal, and a snapshot of arrays."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias, cast

import numpy as np

from store.errors import RecordError

__all__ = ["JSON", "Generation", "Head", "Record", "check_key", "check_text", "check_time", "from_json", "to_json"]

JSON: TypeAlias = "bool | int | float | str | Sequence[JSON] | Mapping[str, JSON] | None"

LONGEST_KEY = 64  # bytes: the longest digest in common use (sha512, blake2b)


@dataclass(frozen=True)
class Head:
    """One durable row of the journal without its arrays, which may have been compacted away.

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
class Record:
    """One durable row of the journal, as `Head`; the arrays are fresh copies, the caller's to change."""

    sequence: int
    kind: str
    label: str
    key: bytes
    time: float
    attributes: Mapping[str, JSON]
    arrays: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Generation:
    """A committed snapshot: it contains the journal's rows up to and including sequence `upto`."""

    number: int
    upto: int
    attributes: Mapping[str, JSON]
    arrays: Mapping[str, np.ndarray]


def check_text(what: str, text: str) -> str:
    """Return `text` when it can be kept as UTF-8 in SQLite; raise RecordError otherwise."""
    if not isinstance(text, str):
        raise RecordError(f"{what} must be a str, not {type(text).__name__}")
    if "\0" in text:
        raise RecordError(f"{what} {text!r} contains a NUL character, at which many readers would cut it off")
    try:
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        raise RecordError(
            f"{what} {text!r} has no UTF-8 form: position {error.start} holds half of a surrogate pair"
        ) from error
    return text


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
    return float(time) + 0.0  # SQLite gives -0.0 back as 0.0, and the checksum is over its sign, too


def to_json(what: str, value: Mapping[str, JSON] | None) -> str:
    """Return `value` as compact JSON with sorted keys, in ASCII; None counts as empty.

    Raises RecordError, naming the place, for what would not come back equal: NaN and infinities, keys
    that are not strings, NumPy scalars and other objects. A tuple comes back as a list.
    """
    if value is None:
        return "{}"
    if not isinstance(value, Mapping):
        raise RecordError(f"{what} must be a mapping, not {type(value).__name__}")
    try:
        return json.dumps(_plain(what, value), sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (RecursionError, ValueError) as error:
        if isinstance(error, RecordError):
            raise
        raise RecordError(f"{what} cannot be written as JSON: {error}") from error


def from_json(text: str) -> dict[str, JSON]:
    """Return what `to_json` wrote; raise ValueError when `text` is not a JSON object."""
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError("not a JSON object")
    return cast("dict[str, JSON]", value)


def _plain(where: str, value: JSON) -> JSON:
    if isinstance(value, Mapping):
        if strange := [name for name in value if not isinstance(name, str)]:
            raise RecordError(f"{where} has the key {strange[0]!r}; JSON keys are strings")
        return {_paired(where, name): _plain(f"{where}[{name!r}]", part) for name, part in value.items()}
    if isinstance(value, str):
        return _paired(where, value)
    if isinstance(value, list | tuple):
        return [_plain(f"{where}[{index}]", part) for index, part in enumerate(value)]
    if value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise RecordError(f"{where} is {value!r}, which JSON cannot hold; use None or a string")
        return float(value)
    raise RecordError(f"{where} is a {type(value).__name__}, not JSON: convert it, or keep it as an array")


def _paired(where: str, text: str) -> str:
    # Two halves of a surrogate pair beside each other would come back as one character.
    try:
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        raise RecordError(f"{where} holds half of a surrogate pair: {text!r}") from error
    return str(text)
