"""Samples: bounded choices among what was felt, which depend on what was felt and never on the order.

Each material's streams are ranked by content hash, and a sample holds the first by (rank, hash), so that materials
share it evenly. The pool is the sample of touches on which the readouts of the other folds are tried; the candidates
for exemplars are another.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.signals.windows import Scale

__all__ = ["CAPACITY", "LARGEST_SHARE", "Sample", "TouchSample", "WindowSums"]

CAPACITY = 256  # touches: a false-alarm rate of 5 % then rests on thirteen of them
LARGEST_SHARE = 8  # an item of more than this part of the limit is never held: one would push out all others

T = TypeVar("T")


@dataclass(frozen=True)
class WindowSums:
    """Sums of the codes of a touch's windows, for each stage it reached and each scale that fits there.

    sums: int32 of shape (pairs, d) (64 windows of codes below 2²¹ fit); a pair is a stage with a scale, by place.
    pairs: (stage, scale, windows in the sum) of each, int64 of shape (pairs, 3).
    """

    sums: npt.NDArray[np.int32]
    pairs: npt.NDArray[np.int64]

    @classmethod
    def of(
        cls, stages: Sequence[Mapping[Scale, Sequence[int]]], codes: Mapping[Scale, npt.NDArray[np.int32]]
    ) -> WindowSums:
        """The touch of these codes; stages: for each, width → places of the windows that are scored there."""
        chosen = [
            (stage, scale, width, places)
            for stage, scored in enumerate(stages)
            for scale, (width, places) in enumerate(sorted(scored.items()))
        ]
        sums = [codes[width][places].sum(axis=0, dtype=np.int32) for *_, width, places in chosen]
        pairs = [(stage, scale, len(places)) for stage, scale, _, places in chosen]
        return cls(np.stack(sums), np.array(pairs))

    def windows(self, stage: int) -> list[int]:
        """How many windows of each scale are in the sums of a stage; none where it was not reached."""
        windows: list[int] = self.pairs[self.pairs[:, 0] == stage, 2].tolist()
        return windows

    def means(self, stage: int) -> list[npt.NDArray[np.float64]] | None:
        """Mean codes of the windows of each scale at a stage, each of shape (d,); None where it was not reached."""
        rows = np.flatnonzero(self.pairs[:, 0] == stage)
        return [self.sums[row] / self.pairs[row, 2] for row in rows] if len(rows) else None


class Sample(Generic[T]):
    """At most `capacity` items of all materials, of at most `limit` bytes together: a function of the set felt.

    It holds the longest beginning of the order (rank of the key within its material, key, material) that fits. Only
    where a limit is given do the items' sizes count.

    A stream that was dropped must never belong in again, or what was dropped would depend on the order. In numbers
    of items that is so: a stream more pushes the others back or leaves them. In bytes it is not: a short stream that
    takes the rank of a long one would make room behind it. So each item is counted as the largest of its material
    that was felt, held or not, and what is in front of an item only grows. Of each material two more things are kept
    for that: the size of the largest, and the smallest key that was dropped, for nothing behind that belongs in.
    """

    def __init__(self, capacity: int | None = None, limit: int | None = None) -> None:
        if (capacity is None and limit is None) or min(capacity or 1, limit or 1) < 1 or 0 in (capacity, limit):
            raise InputError(f"expected a capacity of 1 or more, in items or bytes; came {capacity} and {limit}")
        self.capacity = capacity
        self.limit = limit
        self._keys: dict[str, list[bytes]] = {}
        self._items: dict[tuple[str, bytes], T] = {}
        self._largest: dict[str, int] = {}
        self._dropped: dict[str, bytes] = {}

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[tuple[str, bytes, T]]:
        """(material, key, item), by material and key."""
        for material in sorted(self._keys):
            for key in self._keys[material]:
                yield material, key, self._items[material, key]

    def wants(self, material: str, key: bytes, size: int = 0) -> bool:
        """Whether adding an item of so many bytes changes anything; one that is there already does not.

        Without a limit that is whether it would be kept. With one it may also be that it was felt which counts.
        """
        if (material, key) in self._items:
            return False
        if self.limit is None:
            rank = bisect_left(self._keys.get(material, []), key)
            return len(self) < (self.capacity or 0) or (rank, key, material) < self._last()
        if size > self.limit // LARGEST_SHARE:
            return False
        return size > self._largest.get(material, -1) or self._before_dropped(material, key)

    def add(self, material: str, key: bytes, item: T, size: int = 0) -> None:
        """Add an item of so many bytes where it belongs in, and drop what falls out."""
        if self.wants(material, key, size):
            self._insert(material, key, item, size)
            self._cut()

    def depends_on(self, material: str, key: bytes) -> bool:
        """Whether taking a stream that was felt out again can change it: where it holds it, or has a limit."""
        return self.limit is not None or (material, key) in self._items

    def refill(self, felt: Iterable[tuple[str, bytes, int, int]], make: Callable[[str, bytes, int], T]) -> None:
        """Add all streams felt: (material, key, bytes, place); `make(material, key, place)` makes those that stay."""
        marks: Sample[int] = Sample(self.capacity, self.limit)
        marks.update(self.notes(), ((material, key, -1, 0) for material, key, _ in self))
        for material, key, size, place in felt:
            marks.add(material, key, place, size)
        chosen = ((material, key, make(material, key, at), 0) for material, key, at in marks if at >= 0)
        self.update(marks.notes(), chosen)

    def update(self, notes: Mapping[str, Sequence[Any]], items: Iterable[tuple[str, bytes, T, int]]) -> None:
        """Add all that another sample of the same capacity and limit stands for: its `notes` and (…, size) it holds."""
        for material, (largest, smallest) in notes.items():
            self._largest[material] = max(largest, self._largest.get(material, 0))
            if smallest is not None and self._before_dropped(material, bytes.fromhex(smallest)):
                while self._keys.get(material) and self._keys[material][-1] >= bytes.fromhex(smallest):
                    self._drop(material)
                self._dropped[material] = bytes.fromhex(smallest)
        for material, key, item, size in items:
            self._insert(material, key, item, size)
        self._cut()  # not before all are there: what was dropped from behind them has its place only then

    def notes(self) -> dict[str, list[Any]]:
        """Material → size of its largest item felt, and hex of the smallest key dropped; nothing without a limit."""
        if self.limit is None:
            return {}
        dropped = {name: key.hex() for name, key in self._dropped.items()}
        return {name: [size, dropped.get(name)] for name, size in sorted(self._largest.items())}

    def _insert(self, material: str, key: bytes, item: T, size: int) -> None:
        self._largest[material] = max(size, self._largest.get(material, 0))
        if (material, key) not in self._items and self._before_dropped(material, key):
            insort(self._keys.setdefault(material, []), key)
            self._items[material, key] = item

    def _cut(self) -> None:
        while self._items and self._over():
            self._drop(self._last()[2])

    def _before_dropped(self, material: str, key: bytes) -> bool:
        return material not in self._dropped or key < self._dropped[material]

    def _over(self) -> bool:
        if self.capacity is not None and len(self) > self.capacity:
            return True
        if self.limit is None:
            return False
        counted = sum(len(keys) * self._largest[material] for material, keys in self._keys.items())
        edge = ((len(self._keys.get(material, [])), key, material) for material, key in self._dropped.items())
        return counted > self.limit or self._last() > min(edge, default=self._last())

    def _drop(self, material: str) -> None:
        key = self._keys[material].pop()
        del self._items[material, key]
        if self.limit is not None:
            self._dropped[material] = key  # smaller than any dropped before: those behind never come in

    def _last(self) -> tuple[int, bytes, str]:
        return max((len(keys) - 1, keys[-1], material) for material, keys in self._keys.items() if keys)


class TouchSample(Sample[WindowSums]):
    """At most `capacity` touches of all materials, a function of the set of touches felt."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        super().__init__(capacity)

    def to_arrays(self) -> tuple[dict[str, npt.NDArray[Any]], list[str]]:
        """What a store keeps: arrays by name, and the material of each touch."""
        entries = list(self)
        return {
            "pool-keys": np.array([list(key) for _, key, _ in entries] or [[]], np.uint8)[: len(entries)],
            "pool-sizes": np.array([len(touch.pairs) for *_, touch in entries], dtype=np.int64),
            "pool-pairs": np.concatenate([t.pairs for *_, t in entries]) if entries else np.zeros((0, 3), np.int64),
            "pool-sums": np.concatenate([t.sums for *_, t in entries]) if entries else np.zeros((0, 0), np.int32),
        }, [material for material, *_ in entries]

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]], materials: Sequence[str]) -> TouchSample:
        """The pool that `to_arrays` described."""
        pool = cls()
        edges = np.cumsum(arrays["pool-sizes"])[:-1]
        sums, pairs = np.split(arrays["pool-sums"], edges), np.split(arrays["pool-pairs"], edges)
        for at, material in enumerate(materials):
            pool.add(material, arrays["pool-keys"][at].tobytes(), WindowSums(sums[at], pairs[at]))
        return pool
