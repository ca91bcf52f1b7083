"""What the arrays of a checkpoint, or of what a merge brought, must be; not whether their numbers fit each other."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from scroll_tactile_store.records import from_json

from scroll_tactile.memory.state import ANNOTATED, MOST_CORRECTIONS, WEIGHINGS
from scroll_tactile.memory.touch_rows import LABELS, VALUES, Arrays
from scroll_tactile.quantities import MOST_QUANTITIES, MOST_STEPS, Quantity
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import fewest_readings
from scroll_tactile.signals.windows import Scale, WindowPlan
from scroll_tactile.statistics.annotations import MOST_AXES, axis_arrays
from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.moments import MOST_ROWS
from scroll_tactile.statistics.statistics import SECOND
from scroll_tactile.validation.expected import (
    LONGEST_TOUCH,
    array,
    check_annotation,
    check_correction,
    check_description,
    check_quantity,
    check_readings,
    check_values,
    codes,
    counts,
    expect,
    keys,
    name,
    whole,
)

__all__ = ["CheckpointChecks"]

MOST_STAGES = 2**10  # and scales that judge at one
MODES = ("head", "adapters", "network")
TOTAL = re.compile("[0-9a-f]{64}")
SAMPLES = "sample", "kept"
IntArray = npt.NDArray[np.int64]
CheckAxis = Callable[[Arrays, list[str]], None]


class CheckpointChecks:
    """The checks of checkpoints of one sensor, dimension and plan of windows; each raises Unexpected.

    keeps: whether touches are kept to match with.
    """

    def __init__(self, sensor: Sensor, dimension: int, plan: WindowPlan, keeps: bool) -> None:
        self._sensor, self._dimension, self._plan, self._keeps = sensor, dimension, plan, keeps

    def check(self, arrays: Arrays, attributes: Mapping[str, Any], last_sequence: int | None) -> None:
        """Check all that a memory takes from a checkpoint.

        last_sequence: its last row; None of what a merge brought.
        """
        whole("dimension", attributes.get("dimension"), self._dimension, self._dimension)
        own, scales = list(map(int, self._plan.scales)), attributes.get("scales")
        # 1.0 and True are equal to 1, and are not what is written there.
        expect(scales == own and all(type(scale) is int for scale in scales), "scales", f"{own}", scales)
        materials = _names("materials", attributes.get("materials"))
        expect(len(set(materials)) == len(materials), "materials", "different names", materials)
        touches, totals = self._check_statistics(arrays, len(materials))
        rows = {scale: dict(zip(materials, total.tolist(), strict=True)) for scale, total in totals.items()}
        sampled = _names("sample", attributes.get("sample"), materials)
        self._check_sample(arrays, sampled)

        def check_axis(own: Arrays, labels: list[str]) -> None:
            shared = not any(field.startswith(SECOND) for field in own)  # then they are those of all touches
            seconds = {field: values for field, values in arrays.items() if shared and field.startswith(SECOND)}
            self._check_statistics({**own, **seconds}, len(labels))

        _check_targets(arrays, attributes, dict(zip(materials, touches, strict=True)), check_axis)
        if self._keeps or "kept" in attributes:
            self._check_kept(arrays, _names("kept", attributes.get("kept"), materials))
        if "exemplars" in attributes:
            self._check_exemplars(arrays, attributes["exemplars"], rows, last_sequence)
        for field in ("retracted", "excluded"):
            sequences = counts(field, array(arrays, field, ("int64",), (None,)), 1, last_sequence or 2**63 - 1)
            expect(len(set(sequences.tolist())) == len(sequences), field, "different rows", sequences)
        if last_sequence is not None or "descriptions" in attributes:  # to a merge they are rows of their own
            _check_descriptions(attributes.get("descriptions"))
        if last_sequence is not None or "tuned" in attributes:  # a merge leaves the tuned model where it is
            whole("tuned_last_sequence", attributes.get("tuned_last_sequence"), 0, last_sequence or 2**63 - 1)
        if "tuned" in attributes:
            self._check_tuned(arrays, attributes["tuned"])
        if WEIGHINGS in arrays:
            _check_weighings(arrays)
        if "corrections" in attributes:
            self._check_corrections(attributes["corrections"], last_sequence)

    def _check_corrections(self, pairs: Any, last_sequence: int | None) -> None:
        few = isinstance(pairs, list) and 0 < len(pairs) <= MOST_CORRECTIONS
        expect(few, "corrections", f"1 to {MOST_CORRECTIONS} by their rows", pairs)
        before = 0
        for pair in pairs:
            expect(isinstance(pair, list) and len(pair) == 2, "corrections", "a row and a correction", pair)
            before = whole("corrections", pair[0], before + 1, last_sequence or 2**63 - 1)
            check_correction("corrections", pair[1], self._sensor)

    def _check_statistics(self, arrays: Arrays, count: int) -> tuple[list[int], dict[Scale, IntArray]]:
        """The touches of each of so many materials, or labels, and their rows by scale."""
        touches = self._check_touches(arrays, count)
        totals = {scale: self._check_sums(arrays, scale, count) for scale in self._plan.scales}
        expect(all(touches), "observations", "a touch or more of each material", touches)
        for view in self._plan.views:
            expect(bool((totals[view] >= touches).all()), f"rows-{view}", "a row or more of each touch", totals[view])
        return touches, totals

    def _check_touches(self, arrays: Arrays, count: int) -> list[int]:
        observations = array(arrays, "observations", ("int64",), (count,))
        touches: list[int] = counts("observations", observations, 0, MOST_ROWS).tolist()
        lengths = array(arrays, "lengths", ("int64",), (None, 2))
        counts("lengths", lengths[:, 0], 1, LONGEST_TOUCH)
        counts("lengths", lengths[:, 1], 1, MOST_ROWS)
        expect(len(set(lengths[:, 0].tolist())) == len(lengths), "lengths", "different lengths", lengths[:, 0])
        return touches

    def _check_sums(self, arrays: Arrays, scale: Scale, count: int) -> IntArray:
        """The rows of each material at a scale; no sum of them passes int64."""
        field = f"rows-{scale}"
        rows = counts(field, array(arrays, field, ("int64",), (count,)), 0, MOST_ROWS)
        total = whole(field, int(rows.sum()), 0, MOST_ROWS)
        field = f"sums-{scale}"
        sums = array(arrays, field, ("int64",), (count, self._dimension))
        codes(field, sums, rows[:, None])
        if total:
            self._check_second(arrays, scale, total)
        return rows

    def _check_second(self, arrays: Arrays, scale: Scale, total: int) -> None:
        """The triangle of a scale, or the rows that it is of."""
        field, most = f"second-{scale}", total << 2 * BITS
        if field in arrays:
            packed = array(arrays, field, ("int64",), (self._dimension * (self._dimension + 1) // 2,))
            check_values(packed, partial(counts, field, least=-most, most=most))
            return
        field = f"values-{scale}"
        values = array(arrays, field, ("int32",), (None,))
        count = whole(field, values.shape[0], 1, total * self._dimension)
        check_values(values, partial(codes, field))
        field = f"places-{scale}"
        expect(total <= self._dimension, f"rows-{scale}", f"{self._dimension} or fewer, or a second moment", total)
        places = array(arrays, field, ("int32",), (self._dimension, total))
        check_values(places, partial(counts, field, least=0, most=count - 1))

    def _check_sample(self, arrays: Arrays, materials: list[str]) -> None:
        keys(arrays, "sample-keys", materials)
        sizes = array(arrays, "sample-sizes", ("int64",), (len(materials),))
        counts("sample-sizes", sizes, 1, MOST_STAGES**2)
        pairs = array(arrays, "sample-pairs", ("int64",), (int(sizes.sum()), 3))
        counts("sample-pairs", pairs[:, :2], 0, MOST_STAGES - 1)
        counts("sample-pairs", pairs[:, 2], 1, MOST_ROWS)
        rows = array(arrays, "sample-rows", ("int32",), (self._dimension if len(pairs) else None, len(pairs)))
        check_values(rows, partial(codes, "sample-rows"))

    def _check_kept(self, arrays: Arrays, materials: list[str]) -> None:
        keys(arrays, "kept-keys", materials)
        columns = array(arrays, "kept-columns", ("int64",), (len(materials),))
        counts("kept-columns", columns, fewest_readings(self._sensor), LONGEST_TOUCH)
        array(arrays, "kept-levels", ("uint8",), (int(columns.sum()) * self._sensor.channels,))

    def _check_exemplars(
        self, arrays: Arrays, about: Any, rows: Mapping[Scale, Mapping[str, int]], last_sequence: int | None
    ) -> None:
        expect(isinstance(about, dict), "exemplars", "their materials", about)
        known = list(next(iter(rows.values()), {}))
        materials = _names("exemplars.materials", about.get("materials"), known)
        keys(arrays, "exemplar-keys", materials)
        count = len(materials)
        if "exemplar-sources" in arrays:
            sources = array(arrays, "exemplar-sources", ("int64",), (count,))
            counts("exemplar-sources", sources, 0, 2**63 - 1 if last_sequence is None else last_sequence)
        if "exemplar-readings" not in arrays:
            return
        lengths = array(arrays, "exemplar-lengths", ("int64",), (count,))
        counts("exemplar-lengths", lengths, fewest_readings(self._sensor), LONGEST_TOUCH)
        scales = array(arrays, "exemplar-scales", ("int64",), (count,)).tolist()
        for material, scale in zip(materials, scales, strict=True):
            found = next((totals for own, totals in rows.items() if int(own) == scale and own.width), {})
            expect(found.get(material, 0) > 0, "exemplar-scales", f"windows that {material!r} has", scale)
        array(arrays, "exemplar-codes", ("int32",), (count, self._dimension if count else None))
        codes("exemplar-codes", arrays["exemplar-codes"])
        shape = (int(lengths.sum()), *self._sensor.shape) if count else (0, None)
        readings = array(arrays, "exemplar-readings", ("float32",), shape)
        if count:
            check_readings("exemplar-readings", readings, self._sensor)

    def _check_tuned(self, arrays: Arrays, about: Any) -> None:
        """A tuned model: whether a network takes its tensors is known when one is made."""
        expect(isinstance(about, dict), "tuned", "names, mode, kept and report", about)
        names = _names("tuned.names", about.get("names"))
        expect(bool(names) and len(set(names)) == len(names), "tuned.names", "different names", names)
        expect(about.get("mode") in MODES, "tuned.mode", f"one of {MODES}", about.get("mode"))
        expect(isinstance(about.get("kept"), bool), "tuned.kept", "true or false", about.get("kept"))
        expect(isinstance(about.get("report"), dict), "tuned.report", "a report", about.get("report"))
        heads = {field for field in arrays if field.startswith("tuned-head-")}
        able = {f"tuned-head-{scale}" for scale in self._plan.windows}
        expect(bool(heads) and heads <= able, "tuned", f"heads of {sorted(able)}", sorted(heads))
        for field in heads:
            _check_finite(field, array(arrays, field, ("float64",), (self._dimension, len(names))))
        _check_finite("tuned-bias", array(arrays, "tuned-bias", ("float64",), (len(names),)))
        for field in (field for field in arrays if field.startswith("tuned-net-")):
            _check_finite(field, array(arrays, field, ("float32",), arrays[field].shape))


def _check_weighings(arrays: Arrays) -> None:
    """Check that they are texts by axis; what is in them is read where it is used."""
    text = array(arrays, WEIGHINGS, ("uint8",), (None,)).tobytes()
    try:
        found = from_json(text.decode("ascii"))
    except ValueError:
        found = {"": None}
    sound = all(isinstance(each, str) for each in found.values())
    expect(sound, WEIGHINGS, "texts by axis", text[:50])


def _check_finite(field: str, values: npt.NDArray[np.floating]) -> None:
    expect(bool(np.isfinite(values).all()), field, "finite weights", "others")


def _names(field: str, values: Any, among: list[str] | None = None) -> list[str]:
    expect(isinstance(values, list), field, "names of materials", values)
    names = [name(field, value) for value in values]
    unknown = [] if among is None else sorted(set(names) - set(among))
    expect(not unknown, field, "materials that were observed", unknown)
    return names


def _check_descriptions(descriptions: Any) -> None:
    expect(isinstance(descriptions, dict), "descriptions", "descriptions by material", descriptions)
    for material, constituents in descriptions.items():
        expect(constituents is not None, "descriptions", "a description", constituents)
        check_description("descriptions", name("descriptions", material), constituents)


def _check_targets(
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
    sums = array(arrays, "quantity-sums", ("int64",), (len(pairs), 3))
    counts("quantity-sums", sums[:, 0], 1, MOST_ROWS)
    counts("quantity-sums", sums[:, 1:], 0, MOST_ROWS * MOST_STEPS**2)


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
