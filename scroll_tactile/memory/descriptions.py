"""Descriptions: what materials are made of, as far as it is known."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any, cast

import numpy as np

from scroll_tactile.errors import DescriptionError
from scroll_tactile.quantities import LONGEST_UNIT
from scroll_tactile.settings import LONGEST_NAME

__all__ = [
    "Description",
    "Property",
    "Target",
    "checked",
    "constituents_of",
    "require_constituents",
    "require_units",
    "targets_of",
]

Property = list[float | str]
"""What was measured of a material, such as its hardness: [value, unit], as JSON has it."""

Description = dict[str, float | bool | Property | None]
"""Constituent → its share by mass; or whether it is there, where it is no mass; or None where that is unknown.

Or a property of the material → its value and unit.
"""

SLACK = 1e-6  # of shares that are to sum to one: thirds of six digits pass, a forgotten percent does not


def _require(holds: bool, said: str) -> None:
    if not holds:
        raise DescriptionError(said)


def _value(where: str, value: Any) -> float | bool | Property | None:
    """A value as it is kept. −0 becomes 0: equal descriptions must be equal on the disk."""
    if value is None or isinstance(value, bool | np.bool_):
        return None if value is None else bool(value)
    if isinstance(value, tuple | list):
        number, unit = value if len(value) == 2 else (None, None)
        sound = isinstance(number, Real) and not isinstance(number, bool) and math.isfinite(number)
        sound = sound and isinstance(unit, str) and 0 < len(unit) <= LONGEST_UNIT and unit.isprintable()
        what = f"(62, 'Shore A'), the value finite, the unit of 1 to {LONGEST_UNIT} printable characters"
        _require(sound, f"{where}: expected a property as (value, unit), such as {what}; came {value!r:.60}")
        return [float(cast(float, number)) + 0.0, str(unit)]
    expected = "a share from 0 to 1, True, False, None or (value, unit)"
    _require(isinstance(value, Real), f"{where}: expected {expected}; came {value!r:.60}")
    share = float(value) + 0.0
    hint = ". Shares are parts of one, not percent" if 1 < share <= 100 else ""
    _require(0 <= share <= 1 + SLACK, f"{where}: expected a share from 0 to 1; came {share:g}{hint}")
    return share


def checked(material: str, constituents: Mapping[str, Any]) -> Description:
    """A description as it is kept: in alphabetical order, shares as floats.

    Raises DescriptionError for no constituents, names that cannot be used, values that are neither shares nor truth
    values, shares that are negative or not finite, and shares that do not sum to one (with None among the values: that
    sum to more).
    """
    where, found = f"the description of {material!r}", dict[str, Any]()
    _require(
        isinstance(constituents, Mapping),
        f"expected {where} as a mapping from constituents to shares, such as {{'wool': 0.35, 'viscose': 0.65}}; came "
        f"{type(constituents).__name__} {constituents!r:.60}",
    )
    for name, value in sorted(constituents.items(), key=lambda named: str(named[0])):
        usable = isinstance(name, str) and 0 < len(name) <= LONGEST_NAME and name.isprintable()
        expected = f"constituents as names of 1 to {LONGEST_NAME} printable characters"
        _require(usable, f"{where}: expected {expected}; came {name!r}")
        found[name] = _value(f"{where}, {name!r}", value)
    _require(bool(found), f"{where}: expected at least one constituent. None in place of the mapping removes it")
    shares, unknown = [value for value in found.values() if isinstance(value, float)], None in found.values()
    total = math.fsum(shares)
    _require(
        not shares or (total <= 1 + SLACK and (total >= 1 - SLACK or unknown)),
        f"{where}: expected the shares to sum to {'at most ' if unknown else ''}one; they sum to {total:.6g}. Name all "
        "constituents, or give None for those whose share is unknown",
    )
    return found


def constituents_of(description: Description) -> dict[str, float | bool | None]:
    """A description without the material's properties."""
    return {name: value for name, value in description.items() if not isinstance(value, list)}


def require_units(descriptions: Mapping[str, Description], material: str, description: Description) -> None:
    """Raise DescriptionError where a property has another unit than that of another material."""
    for name, value in description.items():
        for other, there in descriptions.items():
            before = there.get(name)
            if other != material and isinstance(value, list) and isinstance(before, list) and before[1] != value[1]:
                raise DescriptionError(
                    f"the description of {material!r}, {name!r}: expected it in {before[1]}, as of {other!r}; came "
                    f"{value[0]:g} {value[1]}"
                )


def require_constituents(descriptions: Mapping[str, Description], wanted: Collection[str] | None) -> list[str]:
    """The constituents that are asked for, in alphabetical order; all that the descriptions name where it is None.

    Raises DescriptionError where nothing was described, for one that no description names, or none.
    """
    known = {name for description in descriptions.values() for name in constituents_of(description)}
    if not known:
        raise DescriptionError("nothing was described yet: say with describe() what some material is made of")
    if wanted is None:
        return sorted(known)
    missing = sorted(set(wanted) - known)
    if missing or not wanted:
        raise DescriptionError(f"expected constituents out of {sorted(known)}; came {missing or 'none'}")
    return sorted(set(wanted))


@dataclass(frozen=True)
class Target:
    """What is known of one constituent.

    presence: material → whether it has it. share: material → its share by mass. A material of which it is unknown is
    in neither.
    """

    presence: dict[str, bool]
    share: dict[str, float]


def targets_of(descriptions: Mapping[str, Description]) -> dict[str, Target]:
    """Constituent → what is known of it, both in alphabetical order.

    A material whose shares sum to one has nothing else that is a mass: a constituent of which any material has a share
    is absent from it, with a share of 0, where it is not named.
    """
    made_of = {material: constituents_of(description) for material, description in sorted(descriptions.items())}
    names = sorted({name for description in made_of.values() for name in description})
    masses = {
        name for description in made_of.values() for name, value in description.items() if isinstance(value, float)
    }
    targets = {name: Target({}, {}) for name in names}
    for material, description in made_of.items():
        whole = any(isinstance(value, float) for value in description.values()) and None not in description.values()
        for name in names:
            value = description.get(name, 0.0 if whole and name in masses else None)
            if isinstance(value, bool):
                targets[name].presence[material] = value
            elif value is not None:
                targets[name].presence[material] = value > 0
                targets[name].share[material] = value
    return targets
