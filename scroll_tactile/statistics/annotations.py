"""Annotations: the values and labels that a touch was given beside its material."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from scroll_tactile.errors import AnnotationError, InputError
from scroll_tactile.quantities import Quantity
from scroll_tactile.settings import require_name

__all__ = ["MOST_AXES", "NO_ANNOTATION", "Annotation", "Annotations", "together"]

MOST_AXES = 16  # of a memory: each has second moments of its own where some touches lack its label


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

Annotations = tuple[tuple[Annotation, int], ...]
"""The annotations of one content, in order, each with the observations that had it; those without any are not in it."""


def together(*parts: Annotations | Iterable[tuple[Annotation, int]]) -> Annotations:
    """The annotations of all parts; what is none is left out."""
    count: Counter[Annotation] = Counter()
    for part in parts:
        for annotation, copies in part:
            if annotation:
                count[annotation] += copies
    return tuple(sorted(count.items()))


def _mapping(what: str, given: Any) -> Mapping[Any, Any]:
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise AnnotationError(f"expected {what} as a mapping by name; came {type(given).__name__} {given!r:.60}")
    return given
