"""Samples: bounded choices among the streams observed, which depend on the set of them and never on the order.

Each material's streams are ranked by content hash, and a sample holds the first by (rank, hash), so that materials
share it evenly. Readouts are calibrated on a `TouchSample`; the candidates for exemplars are another.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.annotations import NO_ANNOTATION, Annotation
from scroll_tactile.statistics.fields import Bytes, Ints, Must, Name, key_rows
from scroll_tactile.statistics.grid import BITS, mean_code
from scroll_tactile.statistics.moments import MOST_ROWS

__all__ = ["CAPACITY", "Sample", "SampleFields", "SampledTouch", "Stages", "TouchFields", "TouchSample", "stage_rows"]

CAPACITY = 256  # touches: a false-alarm rate of 5 % then rests on thirteen of them
MOST_STAGES = 2**10  # of a touch, and scales that judge at one
MOST_PAIRS = MOST_STAGES**2

T = TypeVar("T")
U = TypeVar("U")
Codes = dict[Scale, npt.NDArray[np.int32]]


Stages = Sequence[Mapping[Scale, Sequence[Sequence[int]]]]
"""For each stage that a touch reached: scale → places of the windows that are scored there, in groups of one row."""


def stage_rows(stages: Stages, windows: Codes) -> Codes:
    """What is learned of a touch: for each scale a row for each group of each stage that it judges at, (rows, d).

    windows: the codes of the touch's windows by scale; a scale without any adds none. A row is the mean of a group. Of
    a stage that is one group it is what will be judged of a touch that ends there.
    """
    rows: dict[Scale, list[npt.NDArray[np.int64]]] = {}
    for stage in stages:
        for scale, groups in ((scale, groups) for scale, groups in stage.items() if scale in windows):
            rows.setdefault(scale, []).extend(
                mean_code(windows[scale][places].sum(axis=0, dtype=np.int64), len(places)) for places in groups
            )
    return {scale: np.stack(rows[scale]).astype(np.int32) for scale in sorted(rows)}


@dataclass(frozen=True)
class SampledTouch:
    """The mean row that a touch added to the statistics at each stage that it reached, of each scale that judges there.

    rows: codes, int32 of shape (pairs, d). pairs: the stage of each, the place of its scale among those that judge at
    the stage, ascending, and the rows that the touch added at that scale in all, of which a stage has several where
    its windows are learned one by one: int64 of shape (pairs, 3). annotation: its values and labels.
    """

    rows: npt.NDArray[np.int32]
    pairs: npt.NDArray[np.int64]
    annotation: Annotation = NO_ANNOTATION

    @classmethod
    def of(cls, stages: Stages, codes: Codes, annotation: Annotation = NO_ANNOTATION) -> SampledTouch:
        """The sampled touch of some codes, stage after stage, as `stage_rows` gives them."""
        used: dict[Scale, int] = {}
        rows, pairs = [], []
        for stage, scales in enumerate(stages):
            for place, scale in enumerate(sorted(scales)):
                if scale not in codes:
                    continue
                row, count = used.get(scale, 0), len(scales[scale])
                used[scale] = row + count
                rows.append(mean_code(codes[scale][row : row + count].sum(axis=0, dtype=np.int64), count))
                pairs.append((stage, place, len(codes[scale])))
        return cls(np.stack(rows).astype(np.int32), np.array(pairs), annotation)


class Sample(Generic[T]):
    """At most `capacity` items of all materials: a function of the set observed.

    It holds the first items in the order (rank of the key within its material, key, material). An item more pushes the
    others back or leaves them where they are, so what was dropped never belongs in again.
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        self.capacity = capacity
        self._keys: dict[str, list[bytes]] = {}
        self._items: dict[tuple[str, bytes], T] = {}
        self._greatest: tuple[int, bytes, str] | None = None  # what `_last` found, until a key comes or goes

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[tuple[str, bytes, T]]:
        """(material, key, item), by material and key."""
        for material in sorted(self._keys):
            for key in self._keys[material]:
                yield material, key, self._items[material, key]

    def touches(self) -> list[T]:
        """The items alone, by material and key."""
        return [item for *_, item in self]

    def named(self) -> tuple[list[str], list[Annotation], Bytes]:
        """The fields of `TouchFields`."""
        noted = [getattr(item, "annotation", NO_ANNOTATION) for item in self.touches()]
        keys = key_rows([key for _, key, _ in self])
        return [material for material, *_ in self], noted if any(noted) else [], keys

    def holds(self, material: str, key: bytes) -> bool:
        """Whether it holds this stream; if not, the stream can be retracted without a change here."""
        return (material, key) in self._items

    def wants(self, material: str, key: bytes) -> bool:
        """Whether `add` would keep this stream; not of one that is held already."""
        if self.holds(material, key):
            return False
        rank = bisect_left(self._keys.get(material, []), key)
        return len(self) < self.capacity or (rank, key, material) < self._last()

    def add(self, material: str, key: bytes, item: T) -> None:
        """Add an item where it belongs in, and drop what falls out; of a stream that is held nothing changes."""
        if not self.wants(material, key):
            return
        insort(self._keys.setdefault(material, []), key)
        self._items[material, key] = item
        self._greatest = None
        if len(self) > self.capacity:
            _, _, last = self._last()
            del self._items[last, self._keys[last].pop()]
            self._greatest = None

    def update(self, items: Iterable[tuple[str, bytes, T]]) -> None:
        """Add several items (material, key, item), such as another sample."""
        for material, key, item in items:
            self.add(material, key, item)

    def refill(self, streams: Iterable[tuple[str, bytes, U]], make: Callable[[U], T]) -> None:
        """Add all streams (material, key, what one is made of); `make` makes only those that stay."""
        places: Sample[U | None] = Sample(self.capacity)
        places.update((material, key, None) for material, key, _ in self)
        places.update(streams)
        self.update((material, key, make(source)) for material, key, source in places if source is not None)

    def _last(self) -> tuple[int, bytes, str]:
        """(rank, key, material) of the item that falls out next: most touches are compared with it, and stay out."""
        if self._greatest is None:
            self._greatest = max((len(keys) - 1, keys[-1], material) for material, keys in self._keys.items() if keys)
        return self._greatest


@dataclass
class TouchFields:
    """What a store keeps of any sample of n touches, in the order of materials and keys.

    materials, annotations: of each touch; no annotations where no touch has any. keys: content hashes, (n, 32).
    """

    materials: Annotated[list[Name], Must("", "n")]
    annotations: list[Annotation]
    keys: Annotated[Bytes, Must("uint8", "n 32")]

    def named(self) -> list[tuple[str, bytes, Annotation]]:
        """The material, the key and the annotation of each touch."""
        noted = self.annotations or [NO_ANNOTATION] * len(self.materials)
        return list(zip(self.materials, map(bytes, self.keys), noted, strict=True))


@dataclass
class SampleFields(TouchFields):
    """What a store keeps of a `TouchSample`, whose touches have p rows in all.

    sizes: how many of the rows are each touch's own, (n,). pairs: see `SampledTouch`, (p, 3). rows: feature by feature,
    which takes less on the disk, (d, p).
    """

    sizes: Annotated[Ints, Must("int64", "n", 1, MOST_PAIRS)]
    pairs: Annotated[Ints, Must("int64", "p 3", 0, (MOST_STAGES, MOST_STAGES, MOST_ROWS))]
    rows: Annotated[npt.NDArray[np.int32], Must("int32", "d p", -(2**BITS), 2**BITS)]


class TouchSample(Sample[SampledTouch]):
    """At most `capacity` touches of all materials: a function of the set of touches observed."""

    def to_fields(self, dimension: int) -> SampleFields:
        """What a store keeps of it."""
        touches = self.touches()
        pairs = np.concatenate([np.zeros((0, 3), np.int64), *(touch.pairs for touch in touches)])
        rows = np.concatenate([np.zeros((0, dimension), np.int32), *(touch.rows for touch in touches)])
        sizes = np.array([len(touch.pairs) for touch in touches], dtype=np.int64)
        return SampleFields(*self.named(), sizes, pairs, np.ascontiguousarray(rows.T))

    @classmethod
    def of(cls, kept: SampleFields) -> TouchSample:
        """The sample that these fields were made of."""
        sample, edges = cls(), np.cumsum(kept.sizes)[:-1]
        rows, pairs = np.split(np.ascontiguousarray(kept.rows.T), edges), np.split(kept.pairs, edges)
        for i, (material, key, annotation) in enumerate(kept.named()):
            sample.add(material, key, SampledTouch(rows[i], pairs[i], annotation))
        return sample
