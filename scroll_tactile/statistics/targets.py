"""What is learned of the values and labels of touches: exact sums, with the algebra that `Statistics` has.

A quantity has the count, the sum and the sum of squares of its values, material by material. An axis has statistics of
its own, of the touches that have a label on it, with labels in place of materials; where all touches have one, their
second moments are those of the materials, and a store keeps them once. All annotations are bound to their touches by a
sum of 256-bit numbers modulo 2²⁵⁶ (M. Bellare and D. Micciancio, EUROCRYPT 1997), which knows no order.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import AnnotationError, InputError
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.annotations import MOST_AXES, Annotation
from scroll_tactile.statistics.statistics import SECOND, Statistics

__all__ = ["AXIS", "TargetSums", "axis_arrays"]

AXIS = "axis-"  # the beginning of the names of an axis's arrays, before its number
MODULUS = 2**256
Arrays = Mapping[str, npt.NDArray[Any]]
Codes = Mapping[Scale, npt.NDArray[np.int32]]
Sums = tuple[int, int, int]


class TargetSums:
    """The exact sums of values and labels; empty where no touch has any.

    axes: by the name of each, the statistics of the touches with a label on it; see `Statistics`.

    `+` joins two, `-` takes one out of another, `==` compares digests.
    """

    def __init__(self, dimension: int, scales: Sequence[Scale]) -> None:
        self._dimension, self._scales = dimension, tuple(scales)
        self.axes: dict[str, Statistics] = {}
        self._quantities: dict[tuple[str, str], Sums] = {}
        self._touches = self._total = 0

    def __bool__(self) -> bool:
        return self._touches > 0

    def sums(self, quantity: str) -> dict[str, Sums]:
        """Material → count n, Σ t and Σ t² of a quantity's values, in steps from the low end of its range."""
        return {name: own for (which, name), own in sorted(self._quantities.items()) if which == quantity}

    def require_room(self, annotation: Annotation) -> None:
        """Raise AnnotationError where this annotation would bring one axis too many."""
        axes = self.axes.keys() | {axis for axis, _ in annotation.labels}
        if len(axes) > MOST_AXES:
            raise AnnotationError(f"expected labels on at most {MOST_AXES} axes; came {sorted(axes)}")

    def add(self, material: str, key: bytes, annotation: Annotation, codes: Codes, columns: int) -> None:
        """Add the annotation of an observation, of so many columns and these rows of codes by scale."""
        if annotation:
            self._count(material, key, annotation, 1)
            for axis, label in annotation.labels:
                if axis not in self.axes:
                    self.axes[axis] = Statistics(self._dimension, self._scales)
                self.axes[axis].add(label, codes, columns)

    def remove(self, material: str, key: bytes, annotation: Annotation, codes: Codes, columns: int) -> None:
        """Take out one that was added. Raises UnknownMaterialError for a label without such an observation."""
        if annotation:
            self._count(material, key, annotation, -1)
            for axis, label in annotation.labels:
                self.axes.setdefault(axis, Statistics(self._dimension, self._scales)).remove(label, codes, columns)
                if not self.axes[axis].touches:
                    del self.axes[axis]

    def _count(self, material: str, key: bytes, annotation: Annotation, sign: int) -> None:
        self._touches += sign
        self._total = (self._total + sign * annotation.number(material, key)) % MODULUS
        for name, steps in annotation.values:
            self._change((name, material), (1, steps, steps * steps), sign)

    def _change(self, of: tuple[str, str], more: Sums, sign: int) -> None:
        before = self._quantities.get(of, (0, 0, 0))
        count, total, squares = (own + sign * new for own, new in zip(before, more, strict=True))
        self._quantities[of] = count, total, squares
        if not any(self._quantities[of]):
            del self._quantities[of]

    def undo(self, annotation: Annotation, columns: int) -> Callable[[], None]:
        """What takes the next `add` back, of this annotation, however much of it was done; it can be called again."""
        axes, quantities, counts = dict(self.axes), dict(self._quantities), (self._touches, self._total)
        parts = [self.axes[axis].undo(label, columns) for axis, label in annotation.labels if axis in self.axes]

        def undo() -> None:
            for part in parts:
                part()
            self.axes, self._quantities, (self._touches, self._total) = dict(axes), dict(quantities), counts

        return undo

    def digest(self) -> str:
        """Hex of a SHA-256 over all of it: equal where the annotations are those of the same touches."""
        digest = hashlib.sha256(repr((self._touches, self._total, sorted(self._quantities.items()))).encode())
        for axis in sorted(self.axes):
            digest.update(repr((axis, self.axes[axis].digest())).encode())
        return digest.hexdigest()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, TargetSums):
            return NotImplemented
        return self.digest() == other.digest()

    __hash__ = None  # type: ignore[assignment]  # it changes

    def __add__(self, other: TargetSums) -> TargetSums:
        return self._combined(other, 1)

    def __sub__(self, other: TargetSums) -> TargetSums:
        return self._combined(other, -1)

    def _combined(self, other: TargetSums, sign: int) -> TargetSums:
        joint = TargetSums(self._dimension, self._scales)
        joint._touches = self._touches + sign * other._touches
        joint._total = (self._total + sign * other._total) % MODULUS
        joint._quantities = dict(self._quantities)
        for of, sums in other._quantities.items():
            joint._change(of, sums, sign)
        none = Statistics(self._dimension, self._scales)
        for axis in sorted(self.axes.keys() | other.axes.keys()):
            ours, theirs = self.axes.get(axis, none), other.axes.get(axis, none)
            both = ours + theirs if sign > 0 else ours - theirs
            if both.touches:
                joint.axes[axis] = both
        if joint._touches < 0 or any(count < 0 for count, *_ in joint._quantities.values()):
            raise InputError("sums of values can be taken only out of sums that contain them")
        return joint

    def to_arrays(self, touches: int) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """What a store keeps: arrays by name, and what says of what they are; see `from_arrays`.

        touches: all that the memory has; of an axis on which each has a label no second moments are kept.
        """
        pairs = sorted(self._quantities)
        rows = np.array([self._quantities[pair] for pair in pairs], dtype=np.int64).reshape(-1, 3)
        arrays, axes = {"quantity-sums": rows}, []
        for number, axis in enumerate(sorted(self.axes)):
            own, labels = self.axes[axis].to_arrays()
            if self.axes[axis].touches == touches:
                own = {name: array for name, array in own.items() if not name.startswith(SECOND)}
            arrays |= {f"{AXIS}{number}-{name}": array for name, array in own.items()}
            axes.append([axis, labels])
        total = f"{self._total:064x}"
        return arrays, {"touches": self._touches, "total": total, "sums": [list(pair) for pair in pairs], "axes": axes}

    @classmethod
    def from_arrays(cls, statistics: Statistics, arrays: Arrays, about: Mapping[str, Any]) -> TargetSums:
        """The sums that `to_arrays` described; the arrays are taken over.

        statistics: of the materials, of the same moment. about: `touches`: how many have an annotation; `total`: in
        hexadecimal; `sums`: the quantity and material of each row of `quantity-sums` (n, 3); `axes`: of each its name
        and its labels, in the order of the arrays named `axis-0-…`.
        """
        made = cls(statistics.dimension, statistics.scales)
        made._touches, made._total = about["touches"], int(about["total"], 16)
        rows = arrays["quantity-sums"].tolist() if about["sums"] else []
        made._quantities = {(which, name): tuple(row) for (which, name), row in zip(about["sums"], rows, strict=True)}
        for number, (axis, labels) in enumerate(about["axes"]):
            made.axes[axis] = Statistics.from_arrays(
                made._dimension, made._scales, axis_arrays(arrays, number), labels, like=statistics
            )
        return made


def axis_arrays(arrays: Mapping[str, Any], number: int) -> dict[str, Any]:
    """The arrays of an axis, by the names that those of the materials have."""
    first = f"{AXIS}{number}-"
    return {name.removeprefix(first): array for name, array in arrays.items() if name.startswith(first)}
