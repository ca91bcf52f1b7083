"""The journal of a memory without a folder: rows and checkpoints in RAM, with the methods of `Store` that it takes."""

from __future__ import annotations

import time as clock
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

from scroll_tactile_store import Checkpoint, CompactedError, Head, Record, Store

from scroll_tactile.memory.identity import Identity
from scroll_tactile.memory.touch_rows import Arrays
from scroll_tactile.recipe import Recipe

__all__ = ["AnyStore", "RamStore"]

Held = TypeVar("Held", Record, Checkpoint)
Told = Mapping[str, Any] | None  # attributes


class RamStore:
    """Rows and checkpoints in RAM; they go with the process. Methods do and raise what those of `Store` do.

    recipe: of the memory. heads: rows to begin with, which have no arrays any more. last: the last row that counts;
    rows behind it were taken back, and are overwritten: a shallow copy stays as it is.
    """

    mode: ClassVar[Literal["write", "read"]] = "write"

    def __init__(self, recipe: Recipe, heads: Iterable[Head] = ()) -> None:
        self.path = Path("a memory without a path")  # as messages name it
        self.last = 0
        self._recipe = recipe
        self._rows: dict[int, Record] = {}
        self._with_key: dict[bytes, list[int]] = {}
        self._checkpoints: tuple[Checkpoint | None, Checkpoint | None] = None, None  # the newest, that of a compaction
        for head in heads:
            self._take(Record(**vars(head) | {"arrays": {}}))

    @cached_property
    def identity(self) -> Mapping[str, Any]:
        """What the memory was made with, which may compute a fingerprint: only merging and packing ask for it."""
        return Identity.of(self._recipe).to_json()

    @property
    def compacted(self) -> int:
        """The last row that gave up its arrays."""
        return 0 if self._checkpoints[1] is None else self._checkpoints[1].last_sequence

    def append(
        self, kind: str, label: str, key: bytes, *, attributes: Told = None, arrays: Any = None, time: Any = None
    ) -> Head:
        """Add a row."""
        moment = clock.time() if time is None else time
        return self._take(Record(self.last + 1, kind, label, key, moment, attributes or {}, 0, arrays=arrays or {}))

    def _take(self, row: Record) -> Record:
        self._rows[row.sequence] = row
        self._with_key.setdefault(row.key, []).append(row.sequence)
        self.last = row.sequence
        return row

    @contextmanager
    def batch(self) -> Iterator[None]:
        """After an exception in the block none of its rows is kept."""
        before = self.last
        try:
            yield
        except BaseException:
            self.last = before
            raise

    def heads(self, after: int = 0, *, kind: str | None = None) -> Iterator[Head]:
        """The rows behind one, of a kind."""
        rows = map(self._rows.get, range(after + 1, self.last + 1))
        return (row for row in rows if row is not None and kind in (None, row.kind))

    def with_key(self, key: bytes) -> Iterator[Head]:
        """The rows with a key."""
        rows = (self._rows[sequence] for sequence in self._with_key.get(key, ()) if sequence <= self.last)
        return (row for row in rows if row.key == key)  # another in the place of one that was taken back

    def record(self, sequence: int) -> Record:
        """A row with its arrays."""
        if sequence <= self.compacted:
            raise CompactedError(f"row {sequence} of {self.path} was compacted, and its arrays given up")
        return _fresh(self._rows[sequence])

    def records(self, after: int = 0) -> Iterator[Record]:
        """The rows behind one with their arrays."""
        return map(self.record, range(after + 1, self.last + 1))

    def latest(self) -> Checkpoint | None:
        """The newest checkpoint, all of it."""
        return None if self._checkpoints[0] is None else _fresh(self._checkpoints[0])

    def compaction(self) -> Checkpoint | None:
        """The checkpoint that stands for compacted rows."""
        return None if self._checkpoints[1] is None else _fresh(self._checkpoints[1])

    def commit(self, arrays: Arrays, *, last_sequence: int, attributes: Told = None) -> int:
        """Keep a checkpoint in place of the one before: after a change that is cut short rows behind it are read."""
        self._checkpoints = Checkpoint(1, last_sequence, attributes or {}, arrays), self._checkpoints[1]
        return 1

    commit_later = commit

    def flush(self) -> None:
        """Nothing waits."""

    def compact(
        self, arrays: Arrays, *, last_sequence: int, attributes: Told = None, newest: tuple[Arrays, Any] | None = None
    ) -> None:
        """Have a checkpoint stand for the rows up to one, which give up their arrays."""
        kept = Checkpoint(1, last_sequence, attributes or {}, arrays)
        last = kept if newest is None else Checkpoint(1, self.last, newest[1], newest[0])
        self._checkpoints = last, kept  # at once; nobody reads the arrays of rows behind which it stands any more
        self._rows = {n: replace(row, arrays={}) if n <= last_sequence else row for n, row in self._rows.items()}
        self.last = max(self.last, last_sequence)

    def size(self) -> dict[str, int]:
        """The bytes of its arrays."""
        held: list[Any] = [*self._rows.values(), *filter(None, self._checkpoints)]
        return {"all": sum({id(array): array.nbytes for one in held for array in one.arrays.values()}.values())}

    def close(self) -> None:
        """Nothing is to be released."""


def _fresh(held: Held) -> Held:
    """A row or a checkpoint with arrays that are the caller's own."""
    return replace(held, arrays={name: array.copy() for name, array in held.arrays.items()})


AnyStore = Store | RamStore
"""Where the rows of a memory lie."""
