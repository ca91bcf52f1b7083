"""Statistics: all that learning keeps, as exact integers with an algebra of + and −.

For every scale: counts n_y and sums c_y of each material, and the second moment A of all; of few rows, the rows
that A is of. Sums and sets do not depend on order, batching or grouping, so neither does the memory.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError, MismatchError, UnknownMaterialError
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import rows_of, table_of
from scroll_tactile.statistics.moments import SecondMoment, Sums, require_room

__all__ = ["SECOND", "Statistics"]

IntArray = npt.NDArray[np.int64]
Codes = Mapping[Scale, npt.NDArray[np.int32]]

LARGEST = 2**31 - 1  # of what is kept in int32
SECOND = ("second", "values", "places")  # arrays of a scale: a triangle, or rows; most of a checkpoint


class Statistics:
    """Counts and sums by material and scale, and the second moment of each scale.

    dimension: d. scales: the widths of windows, in readings, ascending.

    `+` joins two, `-` takes one out of another, `==` compares bytes whatever the order of the materials.
    """

    def __init__(self, dimension: int, scales: Sequence[Scale]) -> None:
        self.dimension = dimension
        self.scales = tuple(scales)
        self._places: dict[str, int] = {}
        self._observations = np.zeros(0, dtype=np.int64)
        self._lengths: Counter[int] = Counter()
        self._rows = {scale: np.zeros(0, dtype=np.int64) for scale in self.scales}
        # In int32 until a sum needs more: of ten thousand materials they are 40 MB a scale then.
        self._sums: dict[Scale, Sums] = {scale: np.zeros((0, dimension), dtype=np.int32) for scale in self.scales}
        self._seconds = {scale: SecondMoment(dimension) for scale in self.scales}

    @property
    def materials(self) -> dict[str, int]:
        """Material → number of observations, in alphabetical order; only those that have any."""
        counts = self._observations.tolist()
        return {name: counts[place] for name, place in sorted(self._places.items()) if counts[place]}

    @property
    def material_count(self) -> int:
        """How many materials have observations; `materials` sorts their names."""
        return int(np.count_nonzero(self._observations))

    @property
    def touches(self) -> int:
        """The number of observations."""
        return int(self._observations.sum())

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

    def add(self, material: str, codes: Codes, columns: int = 0) -> None:
        """Add one observation, of so many columns: for each scale its rows of codes, shape (rows, d).

        Raises CapacityError, before anything is added, where a sum would not be exact any more.
        """
        self.require_room(codes)
        place = self._place(material)
        for scale, rows in codes.items():
            self._seconds[scale].add(rows)
            self._rows[scale][place] += len(rows)
            self._add_sums(scale, place, rows.sum(axis=0, dtype=np.int64))
        self._observations[place] += 1
        self._lengths[columns] += 1

    def _add_sums(self, scale: Scale, place: int, more: IntArray) -> None:
        total = self._sums[scale][place] + more
        if self._sums[scale].dtype == np.int32 and np.abs(total).max(initial=0) > LARGEST:
            self._sums = {**self._sums, scale: self._sums[scale].astype(np.int64)}  # who undoes this has those before
        self._sums[scale][place] = total

    def undo(self, material: str, columns: int) -> Callable[[], None]:
        """What takes the next `add` back, of this material and so many columns, however much of it was done.

        It can be called again.
        """
        arrays, length = (self._observations, self._rows, self._sums), self._lengths[columns]
        seconds = [second.undo() for second in self._seconds.values()]
        new = material not in self._places
        place = len(self._places) if new else self._places[material]
        own = slice(place, place + 1)  # empty where the arrays have yet to grow
        before = [(array, array[own].copy()) for array in (arrays[0], *arrays[1].values(), *arrays[2].values())]

        def undo() -> None:
            self._observations, self._rows, self._sums = arrays
            for array, values in before:
                array[own] = values
            for second in seconds:
                second()
            self._lengths[columns] = length
            self._lengths = +self._lengths
            if new:
                self._places.pop(material, None)

        return undo

    def require_room(self, codes: Codes) -> None:
        """Raise CapacityError where these codes could not be added."""
        for scale, rows in codes.items():
            require_room(self._seconds[scale].rows, len(rows))

    def remove(self, material: str, codes: Codes, columns: int = 0) -> None:
        """Take out one observation that was added: the memory is as if it had never been.

        Raises UnknownMaterialError for a material without such an observation.
        """
        place = self._places.get(material)
        if place is None or not self._observations[place] or not self._lengths[columns]:
            raise UnknownMaterialError(f"{material!r} has no observation of {columns} columns that could be taken out")
        for scale, rows in codes.items():
            self._seconds[scale].remove(rows)
            self._rows[scale][place] -= len(rows)
            self._add_sums(scale, place, -rows.sum(axis=0, dtype=np.int64))
        self._observations[place] -= 1
        self._lengths = +(self._lengths - Counter([columns]))

    def _place(self, material: str) -> int:
        place = self._places.get(material)
        if place is None:
            place = self._places[material] = len(self._places)
            if place >= len(self._observations):
                self._grow(max(8, place + place // 4 + 1))  # of ten thousand materials the sums are 80 MB a scale
        return place

    def _grow(self, capacity: int) -> None:
        def grown(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
            larger = np.zeros((capacity, *array.shape[1:]), dtype=array.dtype)
            larger[: len(array)] = array
            return larger

        self._observations = grown(self._observations)
        self._rows = {scale: grown(rows) for scale, rows in self._rows.items()}
        self._sums = {scale: grown(sums) for scale, sums in self._sums.items()}

    def names(self, scale: Scale) -> list[str]:
        """The materials that have rows at a scale, in alphabetical order."""
        rows = self._rows[scale].tolist()
        return [name for name, place in sorted(self._places.items()) if rows[place]]

    def counts(self, scale: Scale, names: Sequence[str]) -> IntArray:
        """Rows of each material, shape (C,); zero of one that was never observed."""
        rows, places = self._rows[scale], self._places
        return np.array([rows[places[name]] if name in places else 0 for name in names], dtype=np.int64)

    def sums(self, scale: Scale, names: Sequence[str]) -> IntArray:
        """Sums of codes of each material, shape (C, d)."""
        return self.totals(scale, names)[1].astype(np.int64)

    def totals(self, scale: Scale, names: Sequence[str]) -> tuple[IntArray, Sums]:
        """Rows, shape (C,), and sums of codes, shape (C, d), of each material; int32 while all of the scale are."""
        places = [self._places[name] for name in names]
        return self._rows[scale][places], self._sums[scale][places]

    def second(self, scale: Scale) -> SecondMoment:
        """The second moment of a scale, over all materials."""
        return self._seconds[scale]

    def digest(self) -> str:
        """Hex of a SHA-256 over all of it in one canonical order: equal if and only if the bytes are."""
        digest = hashlib.sha256(repr((self.dimension, tuple(map(int, self.scales)))).encode())
        names = sorted(self.materials)
        places = [self._places[name] for name in names]
        digest.update(repr(names).encode())
        digest.update(self._observations[places].astype("<i8").tobytes())
        digest.update(repr(sorted(self._lengths.items())).encode())
        for scale in self.scales:
            digest.update(self._rows[scale][places].astype("<i8").tobytes())
            digest.update(self._sums[scale][places].astype("<i8").tobytes())
            if self._seconds[scale].rows:
                digest.update(self._seconds[scale].packed().astype("<i8", copy=False).data)
        return digest.hexdigest()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Statistics):
            return NotImplemented
        return self.digest() == other.digest()

    __hash__ = None  # type: ignore[assignment]  # it changes

    def __add__(self, other: Statistics) -> Statistics:
        return self._combined(other, 1)

    def __sub__(self, other: Statistics) -> Statistics:
        return self._combined(other, -1)

    def _combined(self, other: Statistics, sign: int) -> Statistics:
        if (self.dimension, self.scales) != (other.dimension, other.scales):
            raise MismatchError(
                f"expected statistics of {self.dimension} features at scales {self.scales}; came "
                f"{other.dimension} at {other.scales}"
            )
        joint = Statistics(self.dimension, self.scales)
        if sign > 0:
            for scale in self.scales:
                require_room(self._seconds[scale].rows, other._seconds[scale].rows)
        joint._lengths.update(self._lengths)
        (joint._lengths.update if sign > 0 else joint._lengths.subtract)(other._lengths)
        for part, weight in ((self, 1), (other, sign)):
            for name, place in part._places.items():
                to = joint._place(name)
                joint._observations[to] += weight * part._observations[place]
                for scale in self.scales:
                    joint._rows[scale][to] += weight * part._rows[scale][place]
                    joint._add_sums(scale, to, weight * part._sums[scale][place].astype(np.int64))
        for scale in self.scales:
            joint._seconds[scale] = self._seconds[scale].joined(other._seconds[scale], sign)
        if sign < 0 and not joint._sound():
            raise InputError("statistics can be taken only out of statistics that contain them")
        joint._lengths = +joint._lengths
        return joint

    def _sound(self) -> bool:
        """Whether no count is negative and nothing is left over where there are no rows."""
        if (self._observations < 0).any() or min(self._lengths.values(), default=0) < 0:
            return False
        for scale in self.scales:
            rows = self._rows[scale]
            if (rows < 0).any() or self._sums[scale][rows == 0].any():
                return False
            moment = self._seconds[scale]
            if not moment.rows and moment.packed().any():
                return False
        return True

    def to_arrays(self) -> tuple[dict[str, npt.NDArray[Any]], list[str]]:
        """What a store keeps: arrays by name, and the materials in the order of their first axis.

        Of a second moment whose rows are there these, as `grid.table_of` gives them; of another its triangle.
        """
        names = sorted(self.materials)
        places = [self._places[name] for name in names]
        lengths = np.array(sorted(self._lengths.items()), dtype=np.int64).reshape(-1, 2)
        arrays: dict[str, npt.NDArray[Any]] = {"observations": self._observations[places], "lengths": lengths}
        for scale in self.scales:
            arrays[f"rows-{scale}"] = self._rows[scale][places]
            arrays[f"sums-{scale}"] = self._sums[scale][places].astype(np.int64)
            second = self._seconds[scale]
            if second.rows and (codes := second.codes()) is not None:
                arrays[f"values-{scale}"], arrays[f"places-{scale}"] = table_of(codes)
            elif second.rows:
                arrays[f"second-{scale}"] = second.packed().copy()
        return arrays, names

    @classmethod
    def from_arrays(
        cls,
        dimension: int,
        scales: Sequence[Scale],
        arrays: Mapping[str, npt.NDArray[Any]],
        names: Sequence[str],
        like: Statistics | None = None,
    ) -> Statistics:
        """The statistics that `to_arrays` described; the arrays are taken over or copied.

        like: those whose second moments these have too, where there are no arrays of any.
        """
        statistics = cls(dimension, scales)
        statistics._places = {name: place for place, name in enumerate(names)}
        statistics._observations = arrays["observations"]
        statistics._lengths = Counter(dict(arrays["lengths"].tolist()))
        for scale in statistics.scales:
            statistics._rows[scale], sums = arrays[f"rows-{scale}"], arrays[f"sums-{scale}"]
            narrow = max(int(sums.max(initial=0)), -int(sums.min(initial=0))) <= LARGEST
            statistics._sums[scale] = sums.astype(np.int32) if narrow else sums
            if rows := int(statistics._rows[scale].sum()):
                own = any(f"{name}-{scale}" in arrays for name in SECOND)
                statistics._seconds[scale] = (
                    _second(int(scale), rows, dimension, arrays) if own or like is None else like.second(scale).copy()
                )
        return statistics


def _second(
    scale: int,
    rows: int,
    dimension: int,
    arrays: Mapping[str, npt.NDArray[Any]],
) -> SecondMoment:
    """The second moment of so many rows that arrays describe."""
    second, values, places = (f"{name}-{scale}" for name in SECOND)
    if second in arrays:
        return SecondMoment.of(arrays[second], rows, dimension)
    return SecondMoment.of_codes(rows_of(arrays[values], arrays[places]), rows, dimension)
