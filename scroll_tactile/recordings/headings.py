"""Columns that say something of touches, by their headings: values of a quantity, or labels on an axis.

>>> Heading.parsed("force [N] 0..10 step 0.01 from observation.wrench[2]").column
'observation.wrench[2]'
>>> Heading.parsed("slip [label]").unit is None
True
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.quantities import WRITTEN, Quantity

__all__ = ["Heading", "Noted", "noted_in"]

LABEL = "label"  # in brackets behind the name of an axis, in place of a unit
_PLACED = re.compile(rf"{WRITTEN.pattern}(?:\s+from\s+(?P<column>\S.*?))?")

Column = npt.NDArray[Any]


@dataclass(frozen=True)
class Heading:
    """What a column says of touches.

    name: of the quantity, or of the axis. unit: of the values; None of labels. quantity: the one that the heading
    declares by a range; None where it has a name and a unit alone. column: where a data set has it.
    """

    name: str
    unit: str | None
    quantity: Quantity | None
    column: str

    @classmethod
    def found(cls, text: str) -> Heading | None:
        """What a text says; None where it has no unit in brackets. Raises InputError for a range that is none."""
        if (found := _PLACED.fullmatch(text.strip())) is None:
            return None
        name, unit, column = found["name"], found["unit"].strip(), found["column"] or found["name"]
        if unit == LABEL and found["low"] is None:
            return cls(name, None, None, column)
        written = text.strip() if found["column"] is None else text[: text.rindex(" from ")]
        return cls(name, unit, None if found["low"] is None else Quantity.parsed(written), column)

    @classmethod
    def parsed(cls, text: str) -> Heading:
        """What a text says. Raises InputError for one that is no heading."""
        if (heading := cls.found(text)) is None:
            raise InputError(
                "expected a column as 'force [N]', 'force [N] 0..10 step 0.01' or 'slip [label]', with 'from COLUMN' "
                f"behind it where the data set calls it otherwise; came {text!r:.80}"
            )
        return heading


@dataclass(frozen=True)
class Noted:
    """What is noted of a touch beside its material.

    values: (quantity, unit, value) of each that was measured; labels: (axis, label).
    """

    values: tuple[tuple[str, str, float], ...] = ()
    labels: tuple[tuple[str, str], ...] = ()

    def __add__(self, other: Noted) -> Noted:
        """Both. Raises InputError where both say something of one quantity or axis."""
        for mine, theirs in ((self.values, other.values), (self.labels, other.labels)):
            if twice := sorted({said[0] for said in mine} & {said[0] for said in theirs}):
                raise InputError(f"a table and a column both say {twice[0]!r} of this touch; expected one of them")
        return Noted(self.values + other.values, self.labels + other.labels)


def noted_in(columns: Mapping[str, Column], begin: int, end: int) -> Noted:
    """What columns say of the touch of readings `begin` to before `end`.

    columns: by heading one entry a reading, float64 or texts, of shape (T,). A value is the mean of the readings that
    have a finite number, rounded once; a label is the one text that they have. Where no reading has anything, nothing
    is noted.

    Raises InputError for two labels in one touch.
    """
    values, labels = [], []
    for text, column in columns.items():
        heading, own = Heading.parsed(text), column[begin:end]
        if heading.unit is not None:
            numbers = own[np.isfinite(own)].tolist()
            values += [(heading.name, heading.unit, math.fsum(numbers) / len(numbers))] if numbers else []
            continue
        texts = [one.strip() for one in own.tolist()]
        found = list(dict.fromkeys(filter(None, texts)))
        if len(found) > 1:
            change = begin + texts.index(found[1])
            raise InputError(
                f"expected one label of a touch in column {heading.column!r}; came {found[0]!r:.60}, and "
                f"{found[1]!r:.60} from reading {change} on: cut it there, or leave the column out"
            )
        labels += [(heading.name, name) for name in found]
    return Noted(tuple(values), tuple(labels))
