"""Annotations: the values and labels that a touch was given beside its material, and the exact sums of them.

A quantity has the count, the sum and the sum of squares of its values, material by material. An axis has statistics of
its own, of the touches that have a label on it, with labels in place of materials; where all touches have one, their
second moments are those of the materials, and a store keeps them once. All annotations are bound to their touches by a
sum of 256-bit numbers modulo 2²⁵⁶ (M. Bellare and D. Micciancio, EUROCRYPT 1997), which knows no order.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Self

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import AnnotationError, InputError
from scroll_tactile.quantities import Quantity
from scroll_tactile.settings import require_name
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.fields import Ints, Must, Name
from scroll_tactile.statistics.statistics import Algebra, Statistics, StatisticsFields

__all__ = ["MOST_AXES", "NO_ANNOTATION", "Annotation", "TargetFields", "TargetSums"]

MOST_AXES = 16  # of a memory: each has second moments of its own where some touches lack its label
MODULUS = 2**256
Codes = Mapping[Scale, npt.NDArray[np.int32]]
Sums = tuple[int, int, int]


@dataclass(frozen=True, order=True)
class Annotation:
    """The values and labels of one touch, each by name, in alphabetical order.

    values: quantity → steps from the low end of its range. labels: axis → name on it, such as slip → north.
    """

    values: tuple[tuple[str, int], ...] = ()
    labels: tuple[tuple[str, str], ...] = ()

    @classmethod
    def of(
        cls, quantities: Mapping[str, Quantity], values: Mapping[str, float] | None, labels: Mapping[str, str] | None
    ) -> Annotation:
        """The annotation of values in their quantities' units, and of labels.

        Raises AnnotationError for a quantity that was not declared, a value that is none of its, and for axes and
        labels that cannot be names.
        """
        numbers, names = _mapping("values", values), _mapping("labels", labels)
        if undeclared := sorted(map(str, numbers.keys() - quantities.keys())):
            raise AnnotationError(
                f"expected values of declared quantities, out of {sorted(quantities)}; came {undeclared[:5]}: declare "
                f"it first, as '{undeclared[0]} [UNIT] LOW..HIGH step RESOLUTION', by memory declare, learner.declare, "
                "or in the heading of its column"
            )
        if len(names) > MOST_AXES:
            raise AnnotationError(f"expected labels on at most {MOST_AXES} axes; came {len(names)}")
        try:
            checked = [(require_name(axis), require_name(label)) for axis, label in names.items()]
        except InputError as error:
            raise AnnotationError(f"expected axes and labels as materials' names are: {error}") from None
        steps = sorted((name, quantities[name].integer(value)) for name, value in numbers.items())
        return cls(tuple(steps), tuple(sorted(checked)))

    def __bool__(self) -> bool:
        return bool(self.values or self.labels)

    def label(self, axis: str) -> str | None:
        """The label on an axis; None where the touch has none there."""
        return dict(self.labels).get(axis)

    def measured(self, quantities: Mapping[str, Quantity]) -> dict[str, float]:
        """Quantity → value in its unit."""
        return {name: quantities[name].value(steps) for name, steps in self.values if name in quantities}

    def number(self, material: str, key: bytes) -> int:
        """A whole number of 256 bits that stands for this annotation of this touch."""
        described = json.dumps([material, key.hex(), self.values, self.labels]).encode()
        return int.from_bytes(hashlib.sha256(described).digest(), "little")

    def shown(self, quantities: Mapping[str, Quantity]) -> str:
        """In words, for messages."""
        return f"values {self.measured(quantities)} and labels {dict(self.labels)}" if self else "no values or labels"


NO_ANNOTATION = Annotation()


@dataclass
class AxisFields:
    """What a store keeps of an axis: its name, and the statistics of its labels (see `StatisticsFields`)."""

    name: Name
    statistics: StatisticsFields


@dataclass
class TargetFields:
    """What a store keeps of the sums of values and labels.

    touches: how many have an annotation. total: the sum of their numbers (see `Annotation.number`), in hexadecimal.
    of: the quantity and material of each row of the sums. sums: n, Σ t and Σ t² (see `TargetSums.sums`), (p, 3).
    """

    touches: int
    total: str
    of: Annotated[list[tuple[Name, Name]], Must("", "p")]
    sums: Annotated[Ints, Must("int64", "p 3")]
    axes: list[AxisFields]


class TargetSums(Algebra):
    """The exact sums of values and labels; empty where no touch has any.

    axes: by the name of each, the statistics of the touches with a label on it; see `Statistics`.
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
        self._count(material, key, annotation, 1)
        for axis, label in annotation.labels:
            self.axes.setdefault(axis, Statistics(self._dimension, self._scales)).add(label, codes, columns)

    def remove(self, material: str, key: bytes, annotation: Annotation, codes: Codes, columns: int) -> None:
        """Take out one that was added. Raises UnknownMaterialError for a label without such an observation."""
        self._count(material, key, annotation, -1)
        for axis, label in annotation.labels:
            self.axes.setdefault(axis, Statistics(self._dimension, self._scales)).remove(label, codes, columns)
            if not self.axes[axis].touches:
                del self.axes[axis]

    def _count(self, material: str, key: bytes, annotation: Annotation, sign: int) -> None:
        if annotation:
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

    def digest(self) -> str:
        """Hex of a SHA-256 over all of it: equal where the annotations are those of the same touches."""
        digest = hashlib.sha256(repr((self._touches, self._total, sorted(self._quantities.items()))).encode())
        for axis in sorted(self.axes):
            digest.update(repr((axis, self.axes[axis].digest())).encode())
        return digest.hexdigest()

    def _combined(self, other: Self, sign: int) -> Self:
        joint = type(self)(self._dimension, self._scales)
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

    def to_fields(self, touches: int) -> TargetFields:
        """What a store keeps of them; touches: all that the memory has.

        Of an axis on which each of these has a label no second moments are kept: they are those of the materials.
        """
        pairs, axes = sorted(self._quantities), []
        for axis, own in sorted(self.axes.items()):
            kept = own.to_fields()
            axes.append(AxisFields(axis, replace(kept, codes={}, second={}) if own.touches == touches else kept))
        sums = np.array([self._quantities[pair] for pair in pairs], dtype=np.int64).reshape(-1, 3)
        return TargetFields(self._touches, f"{self._total:064x}", pairs, sums, axes)

    @classmethod
    def of(cls, statistics: Statistics, kept: TargetFields) -> TargetSums:
        """The sums that these fields were made of; statistics: of the materials, of the same moment."""
        made = cls(statistics.dimension, statistics.scales)
        made._touches, made._total = kept.touches, int(kept.total, 16)
        made._quantities = {pair: tuple(row) for pair, row in zip(kept.of, kept.sums.tolist(), strict=True)}
        for axis in kept.axes:
            own = Statistics.of(made._dimension, made._scales, axis.statistics, statistics)
            made.axes[axis.name] = own
        return made


def _mapping(what: str, given: Any) -> Mapping[Any, Any]:
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise AnnotationError(f"expected {what} as a mapping by name; came {type(given).__name__} {given!r:.60}")
    return given
