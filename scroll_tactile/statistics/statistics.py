"""Statistics: all that learning keeps, as exact integers with an algebra of + and −.

For every scale: counts n_y and sums c_y of each material, and the second moment A of all; of few rows, the rows
that A is of. Sums and sets do not depend on order, batching or grouping, so neither does the memory.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Self, cast

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError, MismatchError, UnknownMaterialError
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.fields import Ints, Must, Name, expect
from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.moments import MOST_ROWS, SecondMoment, Sums, require_room

__all__ = ["LONGEST_TOUCH", "Algebra", "Statistics", "StatisticsFields"]

Codes = Mapping[Scale, npt.NDArray[np.int32]]

LARGEST = 2**31 - 1  # of what is kept in int32
LONGEST_TOUCH = 2**28  # columns: 256 MiB of the smallest readings


@dataclass
class StatisticsFields:
    """What a store keeps of statistics of C materials or labels, at scales of d features.

    materials: in alphabetical order. observations: of each, (C,). lengths: (L, 2): steps, and how many touches have
    so many. By scale: rows: of codes, of each material, (C,); sums: Σ x of each, (C, d); codes: of no more rows than
    features all of them, feature by feature, which takes half the bytes: (d, rows); second: of more rows the lower
    triangle of Σ x xᵀ, row after row, (d·(d+1)/2,).
    """

    materials: Annotated[list[Name], Must("", "C")]
    observations: Annotated[Ints, Must("int64", "C", 1, MOST_ROWS)]
    lengths: Annotated[Ints, Must("int64", "* 2", 0, (LONGEST_TOUCH, MOST_ROWS))]
    rows: Annotated[dict[Scale, Ints], Must("int64", "C", 0, MOST_ROWS)]
    sums: Annotated[dict[Scale, Ints], Must("int64", "C d")]
    codes: Annotated[dict[Scale, npt.NDArray[np.int32]], Must("int32", "d *", -(2**BITS), 2**BITS)]
    second: Annotated[dict[Scale, Ints], Must("int64", "triangle")]


@dataclass
class _Own:
    """What is known of one material or label: its touches, and by scale its rows and their sum, (d,)."""

    touches: int = 0
    rows: Counter[Scale] = field(default_factory=Counter)
    sums: dict[Scale, Sums] = field(default_factory=dict)

    def add(self, scale: Scale, rows: int, total: Ints) -> None:
        """Add so many rows, or take them out, and their sum."""
        self.rows[scale] += rows
        both = total + self.sums[scale] if scale in self.sums else total
        # Half the memory: of ten thousand materials they are 40 MB a scale then.
        self.sums[scale] = both.astype(np.int32) if np.abs(both).max(initial=0) <= LARGEST else both


class Algebra(ABC):
    """What is added, taken out and compared exactly: `+` joins two, `-` takes one out of another, `==` compares."""

    __hash__ = None  # type: ignore[assignment]  # it changes

    @abstractmethod
    def digest(self) -> str:
        """Hex of a SHA-256 over all of it."""

    @abstractmethod
    def _combined(self, other: Self, sign: int) -> Self: ...

    def __eq__(self, other: object) -> bool:
        return self.digest() == other.digest() if isinstance(other, type(self)) else NotImplemented

    def __add__(self, other: Self) -> Self:
        return self._combined(other, 1)

    def __sub__(self, other: Self) -> Self:
        return self._combined(other, -1)


class Statistics(Algebra):
    """Counts and sums by material and scale, and the second moment of each scale.

    dimension: d. scales: the widths of windows, in readings, ascending.
    """

    def __init__(self, dimension: int, scales: Sequence[Scale]) -> None:
        self.dimension = dimension
        self.scales = tuple(scales)
        self._own: dict[str, _Own] = {}  # of materials that have observations
        self._lengths: Counter[int] = Counter()
        self._seconds = {scale: SecondMoment(dimension) for scale in self.scales}

    @property
    def materials(self) -> dict[str, int]:
        """Material → number of observations, in alphabetical order; only those that have any."""
        return {name: own.touches for name, own in sorted(self._own.items())}

    @property
    def touches(self) -> int:
        """The number of observations."""
        return self._lengths.total()

    @property
    def longest(self) -> int:
        """The length of the longest touch in steps, 0 where there is none."""
        return max(self._lengths, default=0)

    @property
    def fifth_percentile_length(self) -> int:
        """The 5th percentile of the touches' lengths in steps, 0 without touches: a shorter touch may be a prefix."""
        shorter = 0
        for steps, touches in sorted(self._lengths.items()):
            shorter += touches
            if 20 * shorter >= self.touches:
                return steps
        return 0

    def require_room(self, codes: Codes) -> None:
        """Raise CapacityError where these codes could not be added."""
        for scale, rows in codes.items():
            require_room(self._seconds[scale].rows, len(rows))

    def add(self, material: str, codes: Codes, columns: int = 0) -> None:
        """Add one observation, of so many columns: for each scale its rows of codes, shape (rows, d).

        Raises CapacityError, before anything is added, where a sum would not be exact any more.
        """
        self.require_room(codes)
        own = self._own.setdefault(material, _Own())
        for scale, rows in codes.items():
            self._seconds[scale].add(rows)
            own.add(scale, len(rows), rows.sum(axis=0, dtype=np.int64))
        own.touches += 1
        self._lengths[columns] += 1

    def remove(self, material: str, codes: Codes, columns: int = 0) -> None:
        """Take out one observation that was added: the memory is as if it had never been.

        Raises UnknownMaterialError for a material without such an observation.
        """
        own = self._own.get(material)
        if own is None or not self._lengths[columns]:
            raise UnknownMaterialError(f"{material!r} has no observation of {columns} columns that could be taken out")
        for scale, rows in codes.items():
            self._seconds[scale].remove(rows)
            own.add(scale, -len(rows), -rows.sum(axis=0, dtype=np.int64))
        own.touches -= 1
        if not own.touches:
            del self._own[material]
        self._lengths = +(self._lengths - Counter([columns]))

    def names(self, scale: Scale) -> list[str]:
        """The materials that have rows at a scale, in alphabetical order."""
        return sorted(name for name, own in self._own.items() if own.rows[scale])

    def counts(self, scale: Scale, names: Sequence[str]) -> Ints:
        """Rows of each material, shape (C,); zero of one that was never observed."""
        return np.array([self._own.get(name, _Own()).rows[scale] for name in names], dtype=np.int64)

    def sums(self, scale: Scale, names: Sequence[str]) -> Ints:
        """Sums of codes of each material, shape (C, d); zero of one that has no rows."""
        return self.totals(scale, names)[1].astype(np.int64)

    def totals(self, scale: Scale, names: Sequence[str]) -> tuple[Ints, Sums]:
        """Rows, shape (C,), and sums of codes, shape (C, d), of each material; int32 where all of them are."""
        zero = np.zeros(self.dimension, dtype=np.int32)
        own = [self._own.get(name, _Own()).sums.get(scale, zero) for name in names]
        return self.counts(scale, names), cast(Sums, np.stack(own) if own else zero[None][:0])

    def second(self, scale: Scale) -> SecondMoment:
        """The second moment of a scale, over all materials."""
        return self._seconds[scale]

    def digest(self) -> str:
        """Hex of a SHA-256 over all of it in one canonical order: equal if and only if the bytes are."""
        digest = hashlib.sha256(repr((self.dimension, tuple(map(int, self.scales)))).encode())
        names = sorted(self._own)
        digest.update(repr(names).encode())
        digest.update(np.array([self._own[name].touches for name in names], dtype="<i8").tobytes())
        digest.update(repr(sorted(self._lengths.items())).encode())
        for scale in self.scales:
            for array in self.totals(scale, names):
                digest.update(array.astype("<i8").tobytes())
            if self._seconds[scale].rows:
                digest.update(self._seconds[scale].packed().astype("<i8", copy=False).data)
        return digest.hexdigest()

    def _combined(self, other: Self, sign: int) -> Self:
        if (self.dimension, self.scales) != (other.dimension, other.scales):
            raise MismatchError(
                f"expected statistics of {self.dimension} features at scales {self.scales}; came "
                f"{other.dimension} at {other.scales}"
            )
        joint = type(self)(self.dimension, self.scales)
        for scale in self.scales:
            if sign > 0:
                require_room(self._seconds[scale].rows, other._seconds[scale].rows)
            joint._seconds[scale] = self._seconds[scale].joined(other._seconds[scale], sign)
        for part, weight in ((self, 1), (other, sign)):
            for steps, touches in part._lengths.items():
                joint._lengths[steps] += weight * touches
            for name, own in part._own.items():
                to = joint._own.setdefault(name, _Own())
                to.touches += weight * own.touches
                for scale, total in own.sums.items():
                    to.add(scale, weight * own.rows[scale], weight * total.astype(np.int64))
        if sign < 0 and not joint._sound():
            raise InputError("statistics can be taken only out of statistics that contain them")
        joint._own = {name: own for name, own in joint._own.items() if own.touches}
        joint._lengths = +joint._lengths
        return joint

    def _sound(self) -> bool:
        """Whether no count is negative and nothing is left over where there are no rows."""
        for own in self._own.values():
            left = any(own.rows[scale] < 0 or (not own.rows[scale] and own.sums[scale].any()) for scale in own.sums)
            if left or own.touches < 0 or (not own.touches and any(own.rows.values())):
                return False
        moments = self._seconds.values()
        return min(self._lengths.values(), default=0) >= 0 and not any(
            not moment.rows and moment.packed().any() for moment in moments
        )

    def to_fields(self) -> StatisticsFields:
        """What a store keeps of them."""
        names = sorted(self._own)
        touches = np.array([self._own[name].touches for name in names], dtype=np.int64)
        lengths = np.array(sorted(self._lengths.items()), dtype=np.int64).reshape(-1, 2)
        kept = StatisticsFields(names, touches, lengths, {}, {}, {}, {})
        for scale, second in self._seconds.items():
            kept.rows[scale], kept.sums[scale] = self.counts(scale, names), self.sums(scale, names)
            if second.rows and (codes := second.codes()) is not None:
                kept.codes[scale] = np.ascontiguousarray(codes.T)
            elif second.rows:
                kept.second[scale] = second.packed()
        return kept

    @classmethod
    def of(
        cls, dimension: int, scales: Sequence[Scale], kept: StatisticsFields, like: Statistics | None = None
    ) -> Statistics:
        """The statistics that these fields were made of; the arrays are taken over or copied.

        like: those whose second moments these have, too, where they have none of their own. Raises Unexpected where
        there is not one array for each scale.
        """
        made = cls(dimension, scales)
        made._lengths = Counter(dict(kept.lengths.tolist()))
        made._own = {
            name: _Own(touches) for name, touches in zip(kept.materials, kept.observations.tolist(), strict=True)
        }
        for scale in made.scales:
            expect(scale in kept.rows and scale in kept.sums, f"rows-{scale}", "rows and sums of each scale", "none")
            counts = kept.rows[scale].tolist()
            for own, rows, total in zip(made._own.values(), counts, kept.sums[scale], strict=True):
                own.add(scale, rows, total)
            if scale in kept.codes:
                made._seconds[scale] = SecondMoment.of_codes(np.ascontiguousarray(kept.codes[scale].T), dimension)
            elif scale in kept.second:
                made._seconds[scale] = SecondMoment.of(kept.second[scale], sum(counts), dimension)
            elif any(counts):
                expect(like is not None, f"second-{scale}", f"a second moment of {sum(counts)} rows", "none")
                made._seconds[scale] = cast(Statistics, like).second(scale).copy()
        return made
