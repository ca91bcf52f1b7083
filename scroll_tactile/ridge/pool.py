"""The pool: a bounded sample of touches on which the readouts of the other folds are tried.

Which touches are in it depends only on what was felt, never on the order: each material's touches are ranked by
content hash, and the pool holds the smallest by (rank, hash), so that materials share it evenly.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["CAPACITY", "Pool", "Touch"]

CAPACITY = 256  # touches: a false-alarm rate of 5 % then rests on thirteen of them


@dataclass(frozen=True)
class Touch:
    """Sums of the codes of a touch's windows, for each stage it reached and each scale that fits there.

    sums: int32 of shape (pairs, d) (64 windows of codes below 2²¹ fit); a pair is a stage with a scale, by place.
    pairs: (stage, scale, windows in the sum) of each, int64 of shape (pairs, 3).
    """

    sums: npt.NDArray[np.int32]
    pairs: npt.NDArray[np.int64]

    @classmethod
    def of(cls, stages: Sequence[Mapping[int, Sequence[int]]], codes: Mapping[int, npt.NDArray[np.int32]]) -> Touch:
        """The touch of these codes; stages: for each, width → places of the windows that are scored there."""
        chosen = [
            (stage, scale, width, places)
            for stage, scored in enumerate(stages)
            for scale, (width, places) in enumerate(sorted(scored.items()))
        ]
        sums = [codes[width][places].sum(axis=0, dtype=np.int32) for *_, width, places in chosen]
        pairs = [(stage, scale, len(places)) for stage, scale, _, places in chosen]
        return cls(np.stack(sums), np.array(pairs))

    def means(self, stage: int) -> list[npt.NDArray[np.float64]] | None:
        """Mean codes of the windows of each scale at a stage, each of shape (d,); None where it was not reached."""
        rows = np.flatnonzero(self.pairs[:, 0] == stage)
        return [self.sums[row] / self.pairs[row, 2] for row in rows] if len(rows) else None


class Pool:
    """At most `capacity` touches of all materials, a function of the set of touches felt."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self.capacity = capacity
        self._keys: dict[str, list[bytes]] = {}
        self._touches: dict[tuple[str, bytes], Touch] = {}

    def __len__(self) -> int:
        return len(self._touches)

    def __iter__(self) -> Iterator[tuple[str, bytes, Touch]]:
        """(material, key, touch), by material and key."""
        for material in sorted(self._keys):
            for key in self._keys[material]:
                yield material, key, self._touches[material, key]

    def wants(self, material: str, key: bytes) -> bool:
        """Whether a touch would be kept; one that is there already is not wanted again."""
        keys = self._keys.get(material, [])
        rank = bisect_left(keys, key)
        if rank < len(keys) and keys[rank] == key:
            return False
        return len(self) < self.capacity or (rank, key, material) < self._last()

    def add(self, material: str, key: bytes, touch: Touch) -> None:
        """Add a touch where it belongs in, and drop the one that falls out."""
        if not self.wants(material, key):
            return
        insort(self._keys.setdefault(material, []), key)
        self._touches[material, key] = touch
        if len(self) > self.capacity:
            _, dropped, of = self._last()
            self._keys[of].pop()
            del self._touches[of, dropped]

    def _last(self) -> tuple[int, bytes, str]:
        return max((len(keys) - 1, keys[-1], material) for material, keys in self._keys.items() if keys)

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
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]], materials: Sequence[str]) -> Pool:
        """The pool that `to_arrays` described."""
        pool = cls()
        edges = np.cumsum(arrays["pool-sizes"])[:-1]
        sums, pairs = np.split(arrays["pool-sums"], edges), np.split(arrays["pool-pairs"], edges)
        for at, material in enumerate(materials):
            pool.add(material, arrays["pool-keys"][at].tobytes(), Touch(sums[at], pairs[at]))
        return pool
