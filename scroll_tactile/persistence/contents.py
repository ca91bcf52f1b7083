"""Which touches a memory has, by the hash of their readings: equal readings are one touch.

A touch that the memory has under the same name is never learned twice. One that it has under another name is refused in
learning from files, by one process or a fleet; `observe` and `merge` accept it.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence
from itertools import takewhile

from scroll_tactile_store import Head, Store

from scroll_tactile.memory.gate import sound_rows
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import MEMBER, OBSERVE, annotation_of
from scroll_tactile.signals.ranges import CURE
from scroll_tactile.statistics.annotations import Annotation

__all__ = ["ListedContents", "Rows", "StoredContents", "refusal"]

logger = logging.getLogger(__name__)


def refusal(names: Sequence[str], material: str, clipped: bool = False) -> str | None:
    """Why a touch that is there under these names cannot be learned as a material; None where it can.

    clipped: whether all its values lay outside the sensor's range, so that clipping may have made it equal another.
    """
    if not names or material in names:
        return None
    if clipped:
        return (
            f"all its values lie outside the sensor's range, and the memory has what clipping leaves of them already, "
            f"as {names[0]!r} and not as {material!r}: {CURE}"
        )
    return f"the memory has this touch already, as {names[0]!r} and not as {material!r}: relabel one of them"


Rows = dict[str, tuple[int, Annotation]]
"""Material → the row that has a content under this name, and its annotation; the oldest first."""


class ListedContents:
    """The touches of a memory without a store, by their keys."""

    def __init__(self, rows: Iterable[tuple[str, bytes, int, Annotation]] = ()) -> None:
        self._rows: dict[bytes, Rows] = {}
        for material, key, sequence, annotation in rows:
            self._rows.setdefault(key, {}).setdefault(material, (sequence, annotation))

    def copy(self) -> ListedContents:
        """A copy that changes independently."""
        other = ListedContents()
        other._rows = {key: dict(rows) for key, rows in self._rows.items()}
        return other

    def add(self, material: str, key: bytes, sequence: int, annotation: Annotation) -> None:
        """Add a touch that is not there under this name."""
        self._rows.setdefault(key, {})[material] = sequence, annotation

    def remove(self, material: str, key: bytes) -> None:
        """Take a touch out; nothing where it is not there."""
        self._rows.get(key, {}).pop(material, None)

    def rows(self, key: bytes) -> Rows:
        """The rows of a content; none where it is not there."""
        return self._rows.get(key, {})


class StoredContents:
    """The touches of a memory that is kept in a store, looked for there."""

    def __init__(self, store: Store, memory: Memory) -> None:
        self._store, self._memory = store, memory

    def _active(self, heads: Iterable[Head]) -> Iterator[Head]:
        heads = takewhile(lambda head: head.sequence <= self._memory.sequence, heads)
        return (head for head in heads if head.kind in (OBSERVE, MEMBER) and not self._memory.is_gone(head.sequence))

    def copy(self) -> ListedContents:
        """A copy in memory that changes independently, without damaged rows."""
        heads = self._active(sound_rows(self._store.heads, logger.warning))
        return ListedContents((head.label, head.key, head.sequence, annotation_of(head.attributes)) for head in heads)

    def rows(self, key: bytes) -> Rows:
        """As `ListedContents.rows`."""
        found: Rows = {}
        for head in self._active(self._store.with_key(key)):
            found.setdefault(head.label, (head.sequence, annotation_of(head.attributes)))
        return found
