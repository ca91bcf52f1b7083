"""The rows of the journal as SQLite gives them, with text as bytes, and whether they are as they were written."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from store.errors import DamageError
from store.records import JSON, Head, from_json
from store.schema import checksum

__all__ = [
    "GENERATION_COLUMNS",
    "HEAD_COLUMNS",
    "GenerationRow",
    "Spans",
    "lost_heads",
    "read_head",
    "read_meta",
    "uncovered",
]

HEAD_COLUMNS = "sequence, kind, label, key, time, attributes, size, digest, checksum"
GENERATION_COLUMNS = "number, upto, base, time, attributes, content, checksum"

# Ranges of sequences, first and last included, ascending and apart.
Spans = list[tuple[int, int]]


def read_head(row: tuple[Any, ...]) -> tuple[Head, bytes] | None:
    """Return what a row of table record holds, and the digest of its payload; None where its checksum fails."""
    *fields, stored = row
    try:
        if checksum("record", *fields) == stored:
            sequence, kind, label, key, time, attributes, size, digest = fields
            return Head(
                sequence, kind.decode(), label.decode(), key, time, from_json(attributes.decode()), size
            ), digest
    except (TypeError, ValueError, AttributeError):
        # A flipped bit can also change a value's type.
        pass
    return None


def read_meta(rows: Iterable[tuple[Any, ...]]) -> dict[str, str]:
    """Return what table meta holds, by key, without the rows that fail their checksums."""
    meta = {}
    for key, value, stored in rows:
        try:
            if checksum("meta", key, value) == stored:
                meta[key.decode()] = value.decode()
        except (TypeError, ValueError, AttributeError):
            pass
    return meta


def lost_heads(meta: dict[str, str]) -> Spans:
    """Return the rows that an earlier repair had to leave out though a base still stands for them."""
    try:
        return [(int(first), int(last)) for first, last in json.loads(meta["repaired"])["heads"]]
    except (KeyError, TypeError, ValueError):
        return []


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
        """Whether it is as it was written."""
        try:
            fields = (self.number, self.upto, self.base, self.time, self.attributes, self.content)
            return checksum("generation", *fields) == self.checksum
        except (TypeError, ValueError, AttributeError):
            # A flipped bit can also change a value's type.
            return False

    def verified(self, journal: Path) -> tuple[dict[str, JSON], dict[str, Any]]:
        """Return the attributes and the content; raise DamageError if they are not as written."""
        if not self.sound:
            raise DamageError(f"the row of generation {self.number} in {journal} fails its checksum", path=journal)
        return from_json(self.attributes.decode()), dict(from_json(self.content.decode()))

    def values(self) -> tuple[int, int, int, float, str, str, bytes]:
        """Return the values of GENERATION_COLUMNS, to be written."""
        texts = self.attributes.decode(), self.content.decode()
        return self.number, self.upto, self.base, self.time, *texts, self.checksum
