"""What a checkpoint says of values and labels must be: sums that touches can have, and annotations of sampled ones."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from scroll_tactile.memory.state import ANNOTATED
from scroll_tactile.memory.touch_rows import LABELS, VALUES, Arrays
from scroll_tactile.quantities import MOST_QUANTITIES, Quantity
from scroll_tactile.statistics.annotations import MOST_AXES, axis_arrays
from scroll_tactile.validation.expected import array, check_annotation, check_quantity, expect, name, whole

__all__ = ["check_targets"]

TOTAL = re.compile("[0-9a-f]{64}")
SAMPLES = "sample", "kept"

CheckAxis = Callable[[Arrays, list[str]], None]


def check_targets(
    arrays: Arrays, attributes: Mapping[str, Any], touches: Mapping[str, int], check_axis: CheckAxis
) -> None:
    """Raise Unexpected for what a checkpoint cannot say of values and labels.

    touches: of each material. check_axis: checks the statistics of an axis, given its arrays and labels.
    """
    quantities = _quantities(attributes.get("quantities", {}))
    if "targets" not in attributes:
        expect(not any(which in attributes for which in ANNOTATED), "targets", "sums of the annotations", None)
        return
    about: Any = attributes["targets"]
    expect(isinstance(about, dict), "targets", "touches, total, sums and axes", about)
    whole("targets.touches", about.get("touches"), 1, sum(touches.values()))
    total = about.get("total")
    expect(isinstance(total, str) and bool(TOTAL.fullmatch(total)), "targets.total", "64 digits", total)
    _check_sums(arrays, about.get("sums"), quantities, touches)
    axes = _axes(about.get("axes"))
    for number, labels in enumerate(axes.values()):
        check_axis(axis_arrays(arrays, number), labels)
    for which, of in zip(ANNOTATED, SAMPLES, strict=True):
        if of in attributes:
            noted = _check_annotations(which, attributes.get(which), len(attributes[of]), quantities, axes)
            expect(noted <= about["touches"], which, f"those of {about['touches']} touches", noted)


def _quantities(declared: Any) -> dict[str, Quantity]:
    expect(
        isinstance(declared, dict) and len(declared) <= MOST_QUANTITIES, "quantities", "quantities by name", declared
    )
    for fields in declared.values():
        expect(isinstance(fields, dict), "quantities", "a unit, a range and a resolution", fields)
    return {named: check_quantity("quantities", named, fields) for named, fields in declared.items()}


def _check_sums(arrays: Arrays, pairs: Any, quantities: Mapping[str, Quantity], touches: Mapping[str, int]) -> None:
    """Check the count, the sum and the sum of squares of each quantity and material."""
    field = "targets.sums"
    expect(isinstance(pairs, list), field, "quantities and materials", pairs)
    for pair in pairs:
        named = isinstance(pair, list) and len(pair) == 2 and all(isinstance(each, str) for each in pair)
        expect(named and pair[0] in quantities and pair[1] in touches, field, "a declared quantity of a material", pair)
    expect(len({tuple(pair) for pair in pairs}) == len(pairs), field, "different ones", pairs)
    sums = array(arrays, "quantity-sums", ("int64",), (len(pairs), 3)).tolist()
    for (quantity, material), (count, total, squares) in zip(pairs, sums, strict=True):
        steps, most = quantities[quantity].steps, touches[material]
        fits = 1 <= count <= most and 0 <= total <= count * steps and 0 <= squares <= count * steps**2
        sound = fits and total**2 <= count * squares
        expect(sound, "quantity-sums", f"sums of 1 to {most} values of {quantity!r}", (count, total, squares))


def _axes(stored: Any) -> dict[str, list[str]]:
    """Axis → its labels."""
    expect(isinstance(stored, list) and len(stored) <= MOST_AXES, "targets.axes", f"at most {MOST_AXES} axes", stored)
    for each in stored:
        whole_ = isinstance(each, list) and len(each) == 2 and isinstance(each[1], list)
        expect(whole_, "targets.axes", "an axis and its labels", each)
        names = [name("targets.axes", own) for own in (each[0], *each[1])][1:]
        expect(len(set(names)) == len(names) > 0, "targets.axes", "different labels", names)
    axes: dict[str, list[str]] = dict(stored)
    expect(len(axes) == len(stored), "targets.axes", "different axes", stored)
    return axes


def _check_annotations(
    field: str, stored: Any, count: int, quantities: Mapping[str, Quantity], axes: Mapping[str, list[str]]
) -> int:
    """How many of so many touches of a sample are annotated."""
    expect(isinstance(stored, list) and len(stored) == count, field, "one of each touch", stored)
    for attributes in stored:
        expect(isinstance(attributes, dict), field, "values or labels", attributes)
        check_annotation(f"{field}.", attributes)
        for quantity, steps in attributes.get(VALUES, {}).items():
            known = quantity in quantities and steps <= quantities[quantity].steps
            expect(known, field, "values of declared quantities", attributes)
        for axis, label in attributes.get(LABELS, {}).items():
            expect(label in axes.get(axis, ()), field, "labels that touches have", attributes)
    return sum(map(bool, stored))
