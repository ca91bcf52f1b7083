"""Quantities: what is measured of a touch beside its material, such as the force it was pressed with, in its unit.

A value is kept as a whole number of steps from the low end of its range, so that sums over touches are exact.

>>> from scroll_tactile.quantities import Quantity
>>> force = Quantity(name="force", unit="N", low=0.0, high=10.0, resolution=0.01)
>>> force.integer(1.4), force.value(140)
(140, 1.4)
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction
from numbers import Real
from typing import Annotated, Any, Self

from pydantic import Field, FiniteFloat, field_validator, model_validator

from scroll_tactile.errors import AnnotationError, InputError
from scroll_tactile.settings import LONGEST_NAME, ValidatedFields

__all__ = ["LONGEST_UNIT", "MOST_QUANTITIES", "MOST_STEPS", "WRITTEN", "Quantity", "require_declarable"]

# Of a range: as many as the features' grid has, so that the squares of 2²³ values add up in int64.
MOST_STEPS = 2**20
MOST_QUANTITIES = 64  # of a memory
LONGEST_UNIT = 40  # characters

# Each text is read in one way, or a long heading from elsewhere would take a power of its length.
_NUMBER = r"[-+]?(?:[0-9]+(?:\.[0-9]+)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
# Its name and unit in brackets; a range and a resolution, which a table's heading may leave out.
WRITTEN = re.compile(
    rf"(?P<name>\S(?:.*?\S)?)\s*\[(?P<unit>[^\[\]]+)\]"
    rf"(?:\s*(?P<low>{_NUMBER})\s*\.\.\s*(?P<high>{_NUMBER})\s+step\s+(?P<resolution>{_NUMBER}))?"
)
_Number = Annotated[FiniteFloat, Field(strict=False)]


class Quantity(ValidatedFields):
    """A number that touches carry, such as a force or a speed; frozen, and equal to another with the same fields.

    name: what it is known by, of 1 to 200 printable characters. unit: of its values, such as "N"; of 1 to 40, "1" for
    a number without one. low, high: its range, in `unit`; a value outside is refused. resolution: the step in which it
    is kept, in `unit`: the range has at most 2²⁰ of these.

    Raises InputError for fields that do not fit together.
    """

    name: Annotated[str, Field(min_length=1, max_length=LONGEST_NAME)]
    unit: Annotated[str, Field(min_length=1, max_length=LONGEST_UNIT)]
    low: _Number
    high: _Number
    resolution: Annotated[_Number, Field(gt=0)]

    @field_validator("name", "unit")
    @classmethod
    def _printable(cls, text: str) -> str:
        if not text.isprintable():
            raise ValueError("of printable characters")
        return str(text)

    @field_validator("low", "high", "resolution")
    @classmethod
    def _without_minus_zero(cls, number: float) -> float:
        return number + 0.0  # −0 becomes 0: equal quantities must be equal on the disk

    @model_validator(mode="after")
    def _has_steps(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"a range whose low, {self.low:g}, is below its high, {self.high:g}")
        if not 1 <= self._steps(self.high) <= MOST_STEPS:
            raise ValueError(
                f"a range of 1 to {MOST_STEPS} steps of its resolution; {self.low:g} to {self.high:g} is none of "
                f"{self.resolution:g}"
            )
        return self

    @classmethod
    def parsed(cls, text: str) -> Quantity:
        """The quantity that `str` wrote: "force [N] 0..10 step 0.01". Raises InputError for anything else."""
        if (found := WRITTEN.fullmatch(text.strip())) is None or found["low"] is None:
            raise InputError(f"expected a quantity such as 'force [N] 0..10 step 0.01'; came {text!r:.80}")
        low, high, resolution = (float(found[name]) for name in ("low", "high", "resolution"))
        return cls(name=found["name"], unit=found["unit"].strip(), low=low, high=high, resolution=resolution)

    @property
    def steps(self) -> int:
        """The largest integer of a value."""
        return self._steps(self.high)

    def integer(self, value: float) -> int:
        """The steps from `low` to a value in `unit`, rounded to the nearest, of two to the even.

        Raises AnnotationError for what is no number, NaN, or outside of the range.
        """
        if isinstance(value, bool) or not isinstance(value, Real) or not self.low <= value <= self.high:
            raise AnnotationError(
                f"expected {self.name!r} as a number {self._range}; came {value!r:.60}. Correct it, or leave it out: "
                "the range stays, and a wider one takes another name"
            )
        return self._steps(float(value))

    def value(self, integer: int) -> float:
        """The value, in `unit`, of so many steps from `low`. Raises AnnotationError for one outside of the range."""
        if not 0 <= integer <= self.steps:
            raise AnnotationError(f"expected {self.name!r} in 0 to {self.steps} steps; came {integer!r:.60}")
        return float(_decimal(self.low) + integer * _decimal(self.resolution))

    def _steps(self, value: float) -> int:
        # In the decimals that were written, 1.4 is 140 steps of 0.01, and these are 1.4 again.
        return round((_decimal(value) - _decimal(self.low)) / _decimal(self.resolution))

    @property
    def _range(self) -> str:
        return f"from {self.low:g} to {self.high:g} {self.unit}"

    def __str__(self) -> str:
        return f"{self.name} [{self.unit}] {_short(self.low)}..{_short(self.high)} step {_short(self.resolution)}"


def _short(number: float) -> str:
    """A number so that it can be read again."""
    return repr(number).removesuffix(".0")


def _decimal(number: float) -> Fraction:
    return Fraction(repr(number))


def require_declarable(quantities: Mapping[str, Quantity], quantity: Any) -> bool:
    """Whether a quantity is new among those that a memory has; False where it is there already, and the same.

    Raises AnnotationError for another unit, range or resolution under its name, and for one too many.
    """
    if not isinstance(quantity, Quantity):
        raise AnnotationError(f"expected a Quantity; came {type(quantity).__name__} {quantity!r:.60}")
    there = quantities.get(quantity.name)
    if there is not None and there != quantity:
        raise AnnotationError(
            f"{quantity.name!r} was declared as {there}; came {quantity}. Values of one mean nothing to the other: "
            "give the same, or take another name"
        )
    if there is None and len(quantities) >= MOST_QUANTITIES:
        raise AnnotationError(f"expected at most {MOST_QUANTITIES} quantities; came {quantity.name!r}, one more")
    return there is None
