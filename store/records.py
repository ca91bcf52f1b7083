"""What the store keeps: records, heads and generations, and the checksummed rows that hold them in the journal.

SQLite gives the text of a row as bytes: damaged text need not be UTF-8, and the checksums are over bytes.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np

from store.content import read_content
from store.exceptions import DamageError, RecordError

__all__ = [
    "GENERATION_COLUMNS",
    "HEAD_COLUMNS",
    "JSON",
    "LARGEST_JSON",
    "LARGEST_NUMBER",
    "Generation",
    "GenerationRow",
    "Head",
    "Record",
    "Spans",
    "check_key",
    "check_text",
    "check_time",
    "checksum",
    "from_json",
    "lost_heads",
    "payload_digest",
    "read_head",
    "read_meta",
    "to_json",
    "uncovered",
    "united",
]

JSON: TypeAlias = "bool | int | float | str | Sequence[JSON] | Mapping[str, JSON] | None"

# Texts that are read as JSON. A value of three characters takes up to 90 bytes of memory: these at most 200 MB.
LARGEST_JSON, MOST_VALUES = 64 * 2**20, 2**21
LARGEST_NUMBER = 2**63 - 1  # of SQLite's integers

LONGEST_KEY = 64  # bytes: the longest digest in common use (sha512, blake2b)

HEAD_COLUMNS = "sequence, kind, label, key, time, attributes, size, digest, checksum"
GENERATION_COLUMNS = "number, upto, base, time, attributes, content, checksum"

# Ranges of sequences, first and last included, ascending and apart.
Spans = list[tuple[int, int]]


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
    return _check_pairs(what, text)


def _check_pairs(what: str, text: str) -> str:
    # UTF-8 has no form for half of a surrogate pair, and two halves in JSON would come back as one character.
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
        text = json.dumps(_plain(what, value), sort_keys=True, separators=(",", ":"), allow_nan=False)
        _require_bounded(text)
    except (RecursionError, ValueError) as error:
        if isinstance(error, RecordError):
            raise
        raise RecordError(f"{what} cannot be written as JSON: {error}") from error
    return text


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
    if isinstance(value, Mapping):
        if strange := [name for name in value if not isinstance(name, str)]:
            raise RecordError(f"{where} has the key {strange[0]!r}; JSON keys are strings")
        return {_check_pairs(where, name): _plain(f"{where}[{name!r}]", part) for name, part in value.items()}
    if isinstance(value, str):
        return _check_pairs(where, value)
    if isinstance(value, list | tuple):
        return [_plain(f"{where}[{index}]", part) for index, part in enumerate(value)]
    if value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise RecordError(f"{where} is {value!r}, which JSON cannot hold; use None or a string")
        return float(value)
    raise RecordError(f"{where} is a {type(value).__name__}, not JSON: convert it, or keep it as an array")


def checksum(table: str, *fields: int | float | bytes) -> bytes:
    """Return the 16-byte BLAKE2b over a row's fields, each with its length before it.

    An int counts as 8 bytes little-endian and a float as its IEEE 754 double, little-endian; the name
    of the table goes first, so that no row passes for one of another table.
    """
    digest = hashlib.blake2b(digest_size=16)
    for field in (table.encode("ascii"), *fields):
        if isinstance(field, int):
            part = struct.pack("<q", field)
        elif isinstance(field, float):
            part = struct.pack("<d", field)
        else:
            part = field
        digest.update(struct.pack("<Q", len(part)))
        digest.update(part)
    return digest.digest()


def payload_digest(payload: bytes) -> bytes:
    """Return the 16-byte BLAKE2b over the bytes of a payload."""
    return hashlib.blake2b(payload, digest_size=16).digest()


def _verifies(table: str, fields: Sequence[Any], stored: object) -> bool:
    try:
        return checksum(table, *fields) == stored
    except (TypeError, ValueError, AttributeError, struct.error):
        return False  # a flipped bit can also change a value's type


def read_head(row: tuple[Any, ...]) -> tuple[Head, bytes] | None:
    """Return what a row of table record holds, and the digest of its payload.

    None where its checksum fails, or where its values are none that `Store.append` takes: anybody can make a
    checksum.
    """
    *fields, stored = row
    if not _verifies("record", fields, stored):
        return None
    sequence, kind, label, key, time, attributes, size, digest = fields
    if not (_is_number(sequence) and _is_number(size) and _is_time(time)):
        return None
    try:
        head = Head(sequence, _text(kind), _text(label), check_key(key), time, from_json(attributes.decode()), size)
    except (AttributeError, ValueError):
        return None
    return head, digest


def _is_number(value: object) -> bool:
    return type(value) is int and 0 <= value <= LARGEST_NUMBER


def _is_time(value: object) -> bool:
    return type(value) is float and math.isfinite(value)


def _text(value: bytes) -> str:
    return check_text("text", value.decode())


def read_meta(rows: Iterable[tuple[Any, ...]]) -> dict[str, str]:
    """Return what table meta holds, by key, without the rows that fail their checksums or are no text."""
    meta = {}
    for key, value, stored in rows:
        if isinstance(key, bytes) and isinstance(value, bytes) and _verifies("meta", (key, value), stored):
            with suppress(UnicodeDecodeError):
                meta[key.decode()] = value.decode()
    return meta


def lost_heads(meta: dict[str, str]) -> Spans:
    """Return the rows up to the base that an earlier repair had to leave out."""
    try:
        spans = from_json(meta["repaired"])["heads"]
    except (KeyError, ValueError):
        return []
    if not isinstance(spans, list) or not all(isinstance(span, list) and len(span) == 2 for span in spans):
        return []
    bounds = [bound for span in spans for bound in span]
    # Ascending, and never the same one: spans that are apart.
    if not all(map(_is_number, bounds)) or any(end < first for first, end in spans) or bounds != sorted(bounds):
        return []
    return [(first, last) for first, last in spans]


def uncovered(first: int, last: int, spans: Spans) -> Iterator[tuple[int, int]]:
    """Yield the parts of `first` to `last` that are in none of the spans."""
    for begin, end in spans:
        if begin > last:
            break
        if first < begin:
            yield first, begin - 1
        first = max(first, end + 1)
    if first <= last:
        yield first, last


def united(spans: Iterable[tuple[int, int]]) -> Spans:
    """Return the sequences of all the spans as spans that are ascending and apart."""
    joined: Spans = []
    for first, last in sorted(spans):
        if joined and first <= joined[-1][1] + 1:
            joined[-1] = (joined[-1][0], max(last, joined[-1][1]))
        else:
            joined.append((first, last))
    return joined


@dataclass(frozen=True)
class GenerationRow:
    """What the journal knows of a generation; `content` is what `write_generation` returned, as JSON.

    `base` is 1 where the rows up to `upto` have given up their arrays for it, else 0.
    """

    number: int
    upto: int
    base: int
    time: float
    attributes: bytes
    content: bytes
    checksum: bytes

    @classmethod
    def of(
        cls, number: int, upto: int, base: int, time: float, attributes: str, content: dict[str, Any]
    ) -> GenerationRow:
        """Return the row with its checksum."""
        texts = attributes.encode(), json.dumps(content, separators=(",", ":")).encode()
        return cls(number, upto, base, time, *texts, checksum("generation", number, upto, base, time, *texts))

    @property
    def sound(self) -> bool:
        """Whether it is as it was written, and has numbers where `of` has them."""
        fields = (self.number, self.upto, self.base, self.time, self.attributes, self.content)
        numbers = all(map(_is_number, (self.number, self.upto, self.base))) and _is_time(self.time)
        texts = isinstance(self.attributes, bytes) and isinstance(self.content, bytes)
        return numbers and texts and _verifies("generation", fields, self.checksum)

    def verified(self, journal: Path) -> tuple[dict[str, JSON], dict[str, Any]]:
        """Return the attributes and the content; raise DamageError if they are not as written, or never were."""
        if not self.sound:
            raise DamageError(f"the row of generation {self.number} in {journal} fails its checksum", path=journal)
        try:
            content: dict[str, Any] = dict(from_json(self.content.decode()))
            read_content(content)
            return from_json(self.attributes.decode()), content
        except ValueError as error:
            raise DamageError(
                f"the row of generation {self.number} in {journal} was never written so: {error}", path=journal
            ) from error

    def values(self) -> tuple[int, int, int, float, str, str, bytes]:
        """Return the values of GENERATION_COLUMNS, to be written."""
        texts = self.attributes.decode(), self.content.decode()
        return self.number, self.upto, self.base, self.time, *texts, self.checksum
