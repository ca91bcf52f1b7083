"""Samples: bounded choices among the streams observed, which depend on the set of them and never on the order.

Each material's streams are ranked by content hash, and a sample holds the first by (rank, hash), so that materials
share it evenly. The readouts of the other folds are evaluated on a `TouchSample`; the candidates for exemplars are
another.
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

__all__ = ["CAPACITY", "Sample", "TouchSample", "WindowSums"]

CAPACITY = 256  # touches: a false-alarm rate of 5 % then rests on thirteen of them

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
        """The sums of these codes; stages: for each, scale → places of the windows that are scored there."""
        scored = [
            (stage, i, scale, places)
            for stage, windows in enumerate(stages)
            for i, (scale, places) in enumerate(sorted(windows.items()))
        ]
        sums = [codes[scale][places].sum(axis=0, dtype=np.int32) for *_, scale, places in scored]
        pairs = [(stage, i, len(places)) for stage, i, _, places in scored]
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
    """At most `capacity` items of all materials: a function of the set observed.

    It holds the first items in the order (rank of the key within its material, key, material). An item more pushes the
    others back or leaves them where they are, so what was dropped never belongs in again.

    Raises InputError for a capacity below 1.
    """

    def __init__(self, capacity: int) -> None:
        if capacity < 1:
            raise InputError(f"expected a capacity of 1 or more items; came {capacity}")
        self.capacity = capacity
        self._keys: dict[str, list[bytes]] = {}
        self._items: dict[tuple[str, bytes], T] = {}

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[tuple[str, bytes, T]]:
        """(material, key, item), by material and key."""
        for material in sorted(self._keys):
            for key in self._keys[material]:
                yield material, key, self._items[material, key]

    def holds(self, material: str, key: bytes) -> bool:
        """Whether it holds this stream; if not, the stream can be retracted without a change here."""
        return (material, key) in self._items

    def wants(self, material: str, key: bytes) -> bool:
        """Whether `add` would keep this stream; one that is held already changes nothing."""
        if self.holds(material, key):
            return False
        rank = bisect_left(self._keys.get(material, []), key)
        return len(self) < self.capacity or (rank, key, material) < self._last()

    def add(self, material: str, key: bytes, item: T) -> None:
        """Add an item where it belongs in, and drop what falls out."""
        if not self.wants(material, key):
            return
        insort(self._keys.setdefault(material, []), key)
        self._items[material, key] = item
        if len(self) > self.capacity:
            _, _, last = self._last()
            del self._items[last, self._keys[last].pop()]

    def update(self, items: Iterable[tuple[str, bytes, T]]) -> None:
        """Add several items (material, key, item), such as another sample."""
        for material, key, item in items:
            self.add(material, key, item)

    def refill(self, streams: Iterable[tuple[str, bytes, int]], make: Callable[[str, bytes, int], T]) -> None:
        """Add all streams (material, key, sequence); `make(material, key, sequence)` makes only those that stay."""
        places: Sample[int | None] = Sample(self.capacity)
        places.update((material, key, None) for material, key, _ in self)
        places.update(streams)
        self.update(
            (material, key, make(material, key, sequence)) for material, key, sequence in places if sequence is not None
        )

    def _last(self) -> tuple[int, bytes, str]:
        return max((len(keys) - 1, keys[-1], material) for material, keys in self._keys.items() if keys)


class TouchSample(Sample[WindowSums]):
    """At most `capacity` touches of all materials: a function of the set of touches observed."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        super().__init__(capacity)

    def to_arrays(self) -> tuple[dict[str, npt.NDArray[Any]], list[str]]:
        """What a store keeps: arrays by name, and the material of each touch."""
        touches = [touch for *_, touch in self]
        return {
            "pool-keys": np.array([list(key) for _, key, _ in self] or [[]], np.uint8)[: len(self)],
            "pool-sizes": np.array([len(touch.pairs) for touch in touches], dtype=np.int64),
            "pool-pairs": np.concatenate([np.zeros((0, 3), np.int64), *(touch.pairs for touch in touches)]),
            "pool-sums": np.concatenate([t.sums for t in touches]) if touches else np.zeros((0, 0), np.int32),
        }, [material for material, *_ in self]

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]], materials: Sequence[str]) -> TouchSample:
        """The sample that `to_arrays` described."""
        sample = cls()
        edges = np.cumsum(arrays["pool-sizes"])[:-1]
        sums, pairs = np.split(arrays["pool-sums"], edges), np.split(arrays["pool-pairs"], edges)
        for i, material in enumerate(materials):
            sample.add(material, arrays["pool-keys"][i].tobytes(), WindowSums(sums[i], pairs[i]))
        return sample
