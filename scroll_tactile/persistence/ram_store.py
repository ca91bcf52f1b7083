"""The journal of a memory without a folder: its rows in RAM, with the methods of `Store` by which memories are kept."""

from __future__ import annotations

import time as clock
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from scroll_tactile_store import Checkpoint, CompactedError, Head, Record, Store

from scroll_tactile.memory.identity import Identity
from scroll_tactile.memory.touch_rows import Arrays
from scroll_tactile.recipe import Recipe

__all__ = ["AnyStore", "RamStore"]


class RamStore:
    """Rows and checkpoints in RAM; they go with the process. Methods do and raise what those of `Store` do.

    recipe: of the memory. A row keeps the arrays that it came with until `compact`.
    """

    mode: ClassVar[Literal["write", "read"]] = "write"

    def __init__(self, recipe: Recipe) -> None:
        self.path = Path("a memory without a path")  # as messages name it
        self._recipe = recipe
        self._rows: dict[int, Record] = {}
        self._with_key: dict[bytes, list[int]] = {}
        self._newest: Checkpoint | None = None
        self._compaction: Checkpoint | None = None
        self.last = 0

    @classmethod
    def compacted_to(cls, recipe: Recipe, heads: Iterable[Head], last: int, kept: tuple[Arrays, Any]) -> Self:
        """The rows up to one without their arrays. kept: what stands for them, as `Memory.to_arrays` gives it."""
        made = cls(recipe)
        for head in heads:
            made._take(Record(**vars(head) | {"arrays": {}}))
        made.last = last
        made.compact(kept[0], last_sequence=last, attributes=kept[1])
        return made

    def copy(self) -> Self:
        """One that changes independently; what lies in the rows is shared."""
        made = copy(self)
        made._rows, made._with_key = dict(self._rows), {key: list(own) for key, own in self._with_key.items()}
        return made

    @cached_property
    def identity(self) -> Mapping[str, Any]:
        """What the memory was made with, which may compute a fingerprint: only merging and packing ask for it."""
        return Identity.of(self._recipe).to_json()

    @property
    def newest(self) -> int | None:
        """The number of the newest checkpoint."""
        return None if self._newest is None else self._newest.number

    @property
    def compacted(self) -> int:
        """The last row that gave up its arrays."""
        return 0 if self._compaction is None else self._compaction.last_sequence

    def append(
        self,
        kind: str,
        label: str,
        key: bytes,
        *,
        attributes: Mapping[str, Any] | None = None,
        arrays: Arrays | None = None,
        time: float | None = None,
    ) -> Head:
        """Add a row."""
        moment = clock.time() if time is None else time
        row = Record(self.last + 1, kind, label, key, moment, attributes or {}, 0, arrays=arrays or {})
        self._take(row)
        return row

    def _take(self, row: Record) -> None:
        self._rows[row.sequence] = row
        self._with_key.setdefault(row.key, []).append(row.sequence)
        self.last = row.sequence

    @contextmanager
    def batch(self) -> Iterator[None]:
        """After an exception in the block none of its rows is kept."""
        before = self.last
        try:
            yield
        except BaseException:
            rows = {sequence: row for sequence, row in self._rows.items() if sequence <= before}
            keys = {key: [own for own in rows if own <= before] for key, rows in self._with_key.items()}
            self.__dict__.update(_rows=rows, _with_key=keys, last=before)  # at once
            raise

    def heads(self, after: int = 0, *, kind: str | None = None) -> Iterator[Head]:
        """The rows behind one, of a kind."""
        for sequence in range(after + 1, self.last + 1):
            row = self._rows.get(sequence)
            if row is not None and kind in (None, row.kind):
                yield row

    def with_key(self, key: bytes) -> Iterator[Head]:
        """The rows with a key."""
        rows = (self._rows[sequence] for sequence in self._with_key.get(key, ()))
        return (row for row in rows if row.key == key)  # another where appending one was cut short

    def record(self, sequence: int) -> Record:
        """A row with its arrays."""
        if sequence <= self.compacted:
            raise CompactedError(f"row {sequence} of {self.path} was compacted, and its arrays given up")
        row = self._rows[sequence]
        return replace(row, arrays={name: array.copy() for name, array in row.arrays.items()})

    def records(self, after: int = 0) -> Iterator[Record]:
        """The rows behind one with their arrays."""
        return (self.record(sequence) for sequence in range(after + 1, self.last + 1))

    def latest(self) -> Checkpoint | None:
        """The newest checkpoint, all of it."""
        return _copied(self._newest)

    def compaction(self) -> Checkpoint | None:
        """The checkpoint that stands for compacted rows."""
        return _copied(self._compaction)

    def commit(self, arrays: Arrays, *, last_sequence: int, attributes: Mapping[str, Any] | None = None) -> int:
        """Keep a checkpoint in place of the one before."""
        self._newest = Checkpoint((self.newest or 0) + 1, last_sequence, attributes or {}, arrays)
        return self._newest.number

    def commit_later(self, arrays: Arrays, *, last_sequence: int, attributes: Mapping[str, Any] | None = None) -> None:
        """Keep nothing: the rows are there, and nobody opens them again."""

    def flush(self) -> None:
        """Nothing waits."""

    def compact(
        self,
        arrays: Arrays,
        *,
        last_sequence: int,
        attributes: Mapping[str, Any] | None = None,
        newest: tuple[Arrays, Any] | None = None,
    ) -> None:
        """Have a checkpoint stand for the rows up to one, which give up their arrays."""
        number = (self.newest or 0) + 1
        kept = Checkpoint(number, last_sequence, attributes or {}, arrays)
        last = kept if newest is None else Checkpoint(number + 1, self.last, newest[1], newest[0])
        rows = {n: replace(row, arrays={}) if n <= last_sequence else row for n, row in self._rows.items()}
        self.__dict__.update(_rows=rows, _compaction=kept, _newest=last)  # at once: ctrl-C leaves all of it or nothing

    def size(self) -> dict[str, int]:
        """The bytes of its arrays."""
        checkpoints = {id(each): each for each in (self._newest, self._compaction) if each is not None}
        return {"journal": _bytes(self._rows.values()), "checkpoints": _bytes(checkpoints.values())}

    def close(self) -> None:
        """Nothing is to be released."""


def _copied(checkpoint: Checkpoint | None) -> Checkpoint | None:
    """A checkpoint with arrays that are the caller's own."""
    if checkpoint is None:
        return None
    return replace(checkpoint, arrays={name: array.copy() for name, array in checkpoint.arrays.items()})


def _bytes(kept: Iterable[Record | Checkpoint]) -> int:
    return sum(array.nbytes for one in kept for array in one.arrays.values())


AnyStore = Store | RamStore
"""Where the rows of a memory lie."""
