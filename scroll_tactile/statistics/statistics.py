"""Statistics: all that learning keeps, as exact integers with an algebra of + and −.

For every scale (a width of windows) and every fold: counts n_y, sums c_y and the second moment A. Sums of
integers do not depend on order, batching or grouping, so neither does the memory.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError, MismatchError, UnknownMaterialError
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.moments import SecondMoment, require_room

__all__ = ["FOLDS", "Statistics", "fold_of"]

IntArray = npt.NDArray[np.int64]
Codes = Mapping[Scale, npt.NDArray[np.int32]]

# Each fold costs one more second moment a scale. Three leave two thirds of the touches to the model that is
# tried on the rest; two made λ and the temperature those of a memory half as large.
FOLDS = 3


def fold_of(key: bytes) -> int:
    """The fold of a stream, from its content hash: the same wherever and whenever it was observed."""
    return int.from_bytes(key[:8], "little") % FOLDS


class Statistics:
    """Counts, sums and second moments by material, scale and fold.

    dimension: d. scales: the widths of windows, in readings, ascending.

    `+` joins two, `-` takes one out of another, `==` compares bytes whatever the order of the materials.
    """

    def __init__(self, dimension: int, scales: Sequence[Scale]) -> None:
        self.dimension = dimension
        self.scales = tuple(scales)
        self._places: dict[str, int] = {}
        self._observations = np.zeros((0, FOLDS), dtype=np.int64)
        self._lengths: Counter[int] = Counter()
        self._rows = {scale: np.zeros((0, FOLDS), dtype=np.int64) for scale in self.scales}
        self._sums = {scale: np.zeros((0, FOLDS, dimension), dtype=np.int64) for scale in self.scales}
        self._seconds = {scale: [SecondMoment(dimension) for _ in range(FOLDS)] for scale in self.scales}

    @property
    def materials(self) -> dict[str, int]:
        """Material → number of observations, in alphabetical order; only those that have any."""
        counts = self._observations.sum(axis=1)
        return {name: int(counts[place]) for name, place in sorted(self._places.items()) if counts[place]}

    @property
    def longest(self) -> int:
        """The columns of the longest touch that is in it, 0 where there is none."""
        return max(self._lengths, default=0)

    def add(self, material: str, fold: int, codes: Codes, columns: int = 0) -> None:
        """Add one observation, of so many columns: for each scale the codes of its windows, shape (windows, d).

        Raises CapacityError, before anything is added, where a sum would not be exact any more.
        """
        self.require_room(codes)
        place = self._place(material)
        for scale, rows in codes.items():
            self._seconds[scale][fold].add(rows)
            self._rows[scale][place, fold] += len(rows)
            self._sums[scale][place, fold] += rows.sum(axis=0, dtype=np.int64)
        self._observations[place, fold] += 1
        self._lengths[columns] += 1

    def require_room(self, codes: Codes) -> None:
        """Raise CapacityError where these codes could not be added: all folds together are summed as well."""
        for scale, rows in codes.items():
            require_room(self._total_rows(scale), len(rows))

    def _total_rows(self, scale: Scale) -> int:
        return sum(moment.rows for moment in self._seconds[scale])

    def remove(self, material: str, fold: int, codes: Codes, columns: int = 0) -> None:
        """Take out one observation that was added: the memory is as if it had never been.

        Raises UnknownMaterialError for a material without an observation in this fold.
        """
        place = self._places.get(material)
        if place is None or not self._observations[place, fold] or not self._lengths[columns]:
            raise UnknownMaterialError(
                f"{material!r} has no observation of {columns} columns in fold {fold} that could be taken out"
            )
        for scale, rows in codes.items():
            self._seconds[scale][fold].remove(rows)
            self._rows[scale][place, fold] -= len(rows)
            self._sums[scale][place, fold] -= rows.sum(axis=0, dtype=np.int64)
        self._observations[place, fold] -= 1
        self._lengths = +(self._lengths - Counter([columns]))

    def _place(self, material: str) -> int:
        place = self._places.get(material)
        if place is None:
            place = self._places[material] = len(self._places)
            if place >= len(self._observations):
                self._grow(max(8, 2 * place))
        return place

    def _grow(self, capacity: int) -> None:
        def grown(array: IntArray) -> IntArray:
            larger = np.zeros((capacity, *array.shape[1:]), dtype=np.int64)
            larger[: len(array)] = array
            return larger

        self._observations = grown(self._observations)
        self._rows = {scale: grown(rows) for scale, rows in self._rows.items()}
        self._sums = {scale: grown(sums) for scale, sums in self._sums.items()}

    def names(self, scale: Scale) -> list[str]:
        """The materials that have rows at a scale, in alphabetical order."""
        rows = self._rows[scale].sum(axis=1)
        return [name for name, place in sorted(self._places.items()) if rows[place]]

    def counts(self, scale: Scale, names: Sequence[str]) -> IntArray:
        """Rows of each material in each fold, shape (C, FOLDS)."""
        return self._rows[scale][[self._places[name] for name in names]]

    def sums(self, scale: Scale, names: Sequence[str]) -> IntArray:
        """Sums of codes of each material in each fold, shape (C, FOLDS, d)."""
        return self._sums[scale][[self._places[name] for name in names]]

    def totals(self, scale: Scale) -> tuple[IntArray, IntArray]:
        """Rows, shape (C,), and sums of codes, shape (C, d), of each of `names(scale)`, over all folds."""
        names = self.names(scale)
        return self.counts(scale, names).sum(axis=1), self.sums(scale, names).sum(axis=1)

    def second(self, scale: Scale, fold: int) -> SecondMoment:
        """The second moment of a scale and fold, over all materials."""
        return self._seconds[scale][fold]

    def total_second(self, scale: Scale) -> IntArray:
        """The lower triangle of A over all folds, shape (d·(d+1)/2,)."""
        total = self._seconds[scale][0].packed().copy()
        for moment in self._seconds[scale][1:]:
            if not moment.empty:
                total += moment.packed()
        return total

    def digest(self) -> str:
        """Hex of a SHA-256 over all of it in one canonical order: equal if and only if the bytes are."""
        digest = hashlib.sha256(repr((self.dimension, tuple(map(int, self.scales)), FOLDS)).encode())
        names = sorted(self.materials)
        places = [self._places[name] for name in names]
        digest.update(repr(names).encode())
        digest.update(self._observations[places].astype("<i8").tobytes())
        digest.update(repr(sorted(self._lengths.items())).encode())
        for scale in self.scales:
            digest.update(self._rows[scale][places].astype("<i8").tobytes())
            digest.update(self._sums[scale][places].astype("<i8").tobytes())
            for moment in self._seconds[scale]:
                digest.update(b"\x01" if moment.rows else b"\x00")
                if moment.rows:
                    digest.update(moment.packed().astype("<i8", copy=False).data)
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
                require_room(self._total_rows(scale), other._total_rows(scale))
        joint._lengths.update(self._lengths)
        (joint._lengths.update if sign > 0 else joint._lengths.subtract)(other._lengths)
        for part, weight in ((self, 1), (other, sign)):
            for name, place in part._places.items():
                to = joint._place(name)
                joint._observations[to] += weight * part._observations[place]
                for scale in self.scales:
                    joint._rows[scale][to] += weight * part._rows[scale][place]
                    joint._sums[scale][to] += weight * part._sums[scale][place]
        for scale in self.scales:
            for fold in range(FOLDS):
                ours, theirs = self._seconds[scale][fold], other._seconds[scale][fold]
                packed = ours.packed() + sign * theirs.packed()
                rows = ours.rows + sign * theirs.rows
                joint._seconds[scale][fold] = SecondMoment.of(packed, rows, self.dimension)
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
            if any(moment.packed().any() for moment in self._seconds[scale] if not moment.rows):
                return False
        return True

    def to_arrays(self) -> tuple[dict[str, npt.NDArray[Any]], list[str]]:
        """What a store keeps: arrays by name, and the materials in the order of their first axis."""
        names = sorted(self.materials)
        places = [self._places[name] for name in names]
        lengths = np.array(sorted(self._lengths.items()), dtype=np.int64).reshape(-1, 2)
        arrays: dict[str, npt.NDArray[Any]] = {"observations": self._observations[places], "lengths": lengths}
        for scale in self.scales:
            arrays[f"rows-{scale}"] = self._rows[scale][places]
            arrays[f"sums-{scale}"] = self._sums[scale][places]
            for fold, moment in enumerate(self._seconds[scale]):
                if moment.rows:
                    arrays[f"second-{scale}-{fold}"] = moment.packed().copy()
        return arrays, names

    @classmethod
    def from_arrays(
        cls,
        dimension: int,
        scales: Sequence[Scale],
        arrays: Mapping[str, npt.NDArray[Any]],
        names: Sequence[str],
    ) -> Statistics:
        """The statistics that `to_arrays` described; the arrays are taken over."""
        statistics = cls(dimension, scales)
        statistics._places = {name: place for place, name in enumerate(names)}
        statistics._observations = arrays["observations"]
        statistics._lengths = Counter(dict(arrays["lengths"].tolist()))
        for scale in statistics.scales:
            statistics._rows[scale] = arrays[f"rows-{scale}"]
            statistics._sums[scale] = arrays[f"sums-{scale}"]
            for fold in range(FOLDS):
                packed = arrays.get(f"second-{scale}-{fold}")
                if packed is not None:
                    rows = int(arrays[f"rows-{scale}"][:, fold].sum())
                    statistics._seconds[scale][fold] = SecondMoment.of(packed, rows, dimension)
        return statistics
