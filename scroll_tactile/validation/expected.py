"""What is expected of values that come from a disk, and of a journal's rows; and how what came instead is stored."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from functools import lru_cache
from reprlib import repr as shortened
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scroll_tactile_store import Head, Record
from scroll_tactile_store.records import LateArray

from scroll_tactile.errors import DescriptionError, InputError, MismatchError
from scroll_tactile.health.channel_numbers import from_text
from scroll_tactile.memory.descriptions import checked
from scroll_tactile.memory.touch_rows import (
    ADAPT,
    CHANNELS,
    CODES,
    CORRECTION,
    DECLARE,
    DESCRIBE,
    KINDS,
    LABELS,
    LARGEST_EXPONENT,
    MEMBER,
    MOST_BYTES,
    OBSERVE,
    PACKED_REST,
    PACKED_SHAPE,
    PACKED_WHOLE,
    PACKED_ZERO,
    RETRACT,
    RETRACTS,
    SENSE,
    SOURCE,
    VALUES,
    Arrays,
    declaration,
    only_readings,
    unpack_readings,
)
from scroll_tactile.quantities import MOST_QUANTITIES, MOST_STEPS, Quantity
from scroll_tactile.sensors import Sensor
from scroll_tactile.settings import require_name, require_source
from scroll_tactile.signals.correction import Correction
from scroll_tactile.signals.stream import Stream, fewest_readings
from scroll_tactile.signals.windows import WindowPlan
from scroll_tactile.statistics.annotations import MOST_AXES
from scroll_tactile.statistics.grid import BITS

__all__ = [
    "KEY_BYTES",
    "LONGEST_TOUCH",
    "RowChecks",
    "Unexpected",
    "array",
    "check_annotation",
    "check_correction",
    "check_description",
    "check_quantity",
    "check_readings",
    "check_values",
    "codes",
    "counts",
    "expect",
    "keys",
    "name",
    "source",
    "whole",
]

KEY_BYTES = 32  # of a stream's content hash, see `Stream.key`
ITEM = np.dtype(np.float32).itemsize
SMALLEST_EXPONENT = -149  # the exponent of the smallest float32
POWER = re.compile(rf"{PACKED_WHOLE}(-?[0-9]{{1,3}})")
SCALE = re.compile(rf"{CODES}([1-9][0-9]{{0,8}})")
LONGEST_TOUCH = 2**28  # columns: 256 MiB of the smallest readings


class Unexpected(ValueError):
    """A value from a disk is not what is written there; the message names its field."""


def expect(holds: bool | np.bool, field: str, expected: str, came: object) -> None:
    """Raise Unexpected unless it holds."""
    if not holds:
        raise Unexpected(f"{field}: expected {expected}; came {shortened(came)}")


def whole(field: str, value: Any, least: int, most: int) -> int:
    """A whole number within bounds; Unexpected for anything else."""
    expect(type(value) is int and least <= value <= most, field, f"a whole number from {least} to {most}", value)
    return int(value)


def name(field: str, value: Any) -> str:
    """What can name a material, by the rule that `observe` has; Unexpected for anything else."""
    return _text(field, value, require_name)


def source(field: str, value: Any) -> str:
    """What can say where a touch comes from, by the rule that `observe` has; Unexpected for anything else."""
    return _text(field, value, require_source)


def _text(field: str, value: Any, rule: Callable[[str], str]) -> str:
    try:
        return rule(value)
    except InputError as error:
        raise Unexpected(f"{field}: {error}") from None


def array(
    arrays: Mapping[str, Any], field: str, kinds: Collection[str], shape: tuple[int | None, ...]
) -> npt.NDArray[Any]:
    """The array of that name; Unexpected where there is none, or it is of another type or shape.

    kinds: dtypes as NumPy writes them, such as "int64". shape: None for an axis of any length.
    """
    found: Any = arrays.get(field)
    expected = f"{' or '.join(kinds)} of shape {shape}".replace("None", "any")
    if found is None:
        raise Unexpected(f"{field}: expected {expected}; there is none")
    fits = len(found.shape) == len(shape) and all(
        own in (None, axis) for own, axis in zip(shape, found.shape, strict=True)
    )
    expect(found.dtype.name in kinds and fits, field, expected, f"{found.dtype} {found.shape}")
    return cast("npt.NDArray[Any]", found)


def check_values(values: npt.NDArray[Any] | LateArray, check: Callable[[npt.NDArray[Any]], object]) -> None:
    """Check values; those that are read later, then."""
    if isinstance(values, LateArray):
        before = values.check

        def both(read: npt.NDArray[Any]) -> None:
            if before is not None:
                before(read)
            check(read)

        values.check = both
    else:
        check(values)


def codes(field: str, values: npt.NDArray[Any], most: int | npt.NDArray[np.int64] = 1) -> None:
    """Raise Unexpected for codes, or sums of so many of them, beyond the grid; most: against the values' shape."""
    limit = np.asarray(most, dtype=np.int64) << BITS
    if values.size and limit.ndim:  # the same of all along the last axis
        low, high = (end(axis=-1, keepdims=True) for end in (values.min, values.max))
        outside = bool(((low < -limit) | (high > limit)).any())
    else:
        outside = bool(values.size) and (values.min() < -limit or values.max() > limit)
    expect(not outside, field, f"codes of magnitude at most 2**{BITS} a row", "larger ones")


def counts(field: str, values: npt.NDArray[np.int64], least: int, most: int) -> npt.NDArray[np.int64]:
    """These numbers; Unexpected where any is not within bounds."""
    if values.size:
        low, high = int(values.min()), int(values.max())
        expect(least <= low and high <= most, field, f"numbers from {least} to {most}", (low, high))
    return values


def keys(arrays: Mapping[str, npt.NDArray[Any]], field: str, materials: list[str]) -> None:
    """Raise Unexpected for anything but one content hash for each material's stream, all different."""
    count = len(materials)
    found = array(arrays, field, ("uint8",), (count, KEY_BYTES if count else None))
    pairs = {(material, key.tobytes()) for material, key in zip(materials, found, strict=True)}
    expect(len(pairs) == count, field, "different streams", f"{count} of which {len(pairs)} differ")


class RowChecks:
    """The checks of journal rows of one sensor, dimension and plan of windows.

    Each raises Unexpected; MismatchError for kinds and arrays that this version does not know.
    """

    def __init__(self, sensor: Sensor, dimension: int, plan: WindowPlan) -> None:
        self._sensor, self._dimension, self._plan = sensor, dimension, plan
        self._expected = lru_cache(256)(self._rows_of)

    def check_head(self, head: Head, most_rows: Callable[[], int]) -> None:
        """Check a row without its arrays; most_rows: gives how many the journal can hold."""
        if head.kind not in KINDS:
            raise MismatchError(f"is of kind {head.kind!r}, which this version does not know")
        expect(isinstance(head.time, float), "time", "a number", head.time)
        if head.kind in (OBSERVE, MEMBER):
            name("label", head.label)
            expect(len(head.key) == KEY_BYTES, "key", f"{KEY_BYTES} bytes", head.key)
            if SOURCE in head.attributes:
                source(SOURCE, head.attributes[SOURCE])
            check_annotation("", head.attributes)
        if CHANNELS in head.attributes:
            given = head.attributes[CHANNELS]
            expect(from_text(given, self._sensor.channels) is not None, CHANNELS, "numbers of the channels", given)
        if head.kind == OBSERVE:
            self._check_observation(head.attributes)
        elif head.kind == RETRACT:
            if head.label:
                name("label", head.label)
            _check_spans(head.attributes.get("sequences"), head.sequence, most_rows())
        elif head.kind == SENSE:
            if head.label:
                name("label", head.label)
            whole("columns", head.attributes.get("columns"), 1, LONGEST_TOUCH)
            expect(CHANNELS in head.attributes, CHANNELS, "numbers of the channels", None)
        elif head.kind == ADAPT:
            self._check_adaptation(head)
        elif head.kind == DECLARE:
            check_quantity("quantity", head.label, head.attributes)
        elif head.kind == DESCRIBE:
            name("label", head.label)
            expect("constituents" in head.attributes, "constituents", "a description", None)
            check_description("constituents", head.label, head.attributes["constituents"])

    def _check_adaptation(self, head: Head) -> None:
        told = set(head.attributes)
        expect(not head.label and not head.key, "label", "none of an adaptation", head.label)
        expect(told in ({CORRECTION}, {RETRACTS}), "attributes", f"{CORRECTION} or {RETRACTS}", sorted(told))
        if RETRACTS in told:
            whole(RETRACTS, head.attributes[RETRACTS], 1, head.sequence - 1)
        else:
            check_correction(CORRECTION, head.attributes[CORRECTION], self._sensor)

    def _check_observation(self, attributes: Mapping[str, Any]) -> None:
        columns = whole("columns", attributes.get("columns"), 1, LONGEST_TOUCH)
        if "nbytes" not in attributes:
            return
        each = ITEM * self._sensor.channels
        size = whole("nbytes", attributes["nbytes"], each * fewest_readings(self._sensor), MOST_BYTES)
        readings, frame = size // each, self._plan.widths[0]
        # Of a camera's frames the first may be its resting image, which is no column.
        fitting = (readings * frame, (readings - 1) * frame) if self._sensor.camera else (readings,)
        expect(size % each == 0 and columns in fitting, "columns", f"those of {size} bytes of readings", columns)

    def check_observed(self, record: Record) -> None:
        """Check the arrays of an observation, whose head was checked."""
        arrays, columns = record.arrays, cast(int, record.attributes["columns"])
        if unknown := [own for own in arrays if not _is_known(own)]:
            raise MismatchError(f"has arrays {unknown[:5]}, which this version does not know")
        packed = only_readings(arrays)
        size = cast("int | None", record.attributes.get("nbytes"))
        expect((size is None) == (not packed), "nbytes", "the size of the row's readings", size)
        readings = None if size is None else _unpacked(packed, size, self._sensor)
        if readings is not None:
            check_readings("readings", readings, self._sensor)
        self._check_codes(arrays, columns)
        if readings is not None:
            same = Stream(self._sensor, readings).key == record.key
            expect(same, "key", "the content hash of its readings", record.key)

    def _check_codes(self, arrays: Arrays, columns: int) -> None:
        found = {int(match[1]): field for field in arrays if (match := SCALE.fullmatch(field))}
        expect(bool(found or only_readings(arrays)), "arrays", "codes or readings", sorted(arrays))
        if not found:
            return
        own = self._expected(columns)
        expect(set(found) == set(own), "scales", f"{sorted(own)} of a touch of {columns} columns", sorted(found))
        for number, field in found.items():
            rows = array(arrays, field, ("int32",), (None, self._dimension))
            codes(field, rows)
            expect(len(rows) == own[number], field, f"{own[number]} rows of {columns} columns", len(rows))

    def _rows_of(self, columns: int) -> dict[int, int]:
        """How many rows a touch of so many columns has, by the number of the scale."""
        found: dict[int, int] = {}
        for stage in self._plan.scored_stages(columns):
            for scale, groups in stage.items():
                found[int(scale)] = found.get(int(scale), 0) + len(groups)
        return found


def _is_known(field: str) -> bool:
    return field in (PACKED_SHAPE, PACKED_ZERO, PACKED_REST) or any(
        pattern.fullmatch(field) for pattern in (POWER, SCALE)
    )


def _check_spans(pairs: Any, sequence: int, most_rows: int) -> None:
    """Raise Unexpected for anything but spans of rows before this one, ascending and apart."""
    expect(isinstance(pairs, list) and bool(pairs), "sequences", "spans of rows", pairs)
    before = rows = 0
    for pair in pairs:
        pairing = isinstance(pair, list) and len(pair) == 2 and all(type(end) is int for end in pair)
        expect(pairing and before < pair[0] <= pair[1] < sequence, "sequences", f"rows before {sequence}", pair)
        before, rows = pair[1], rows + pair[1] - pair[0] + 1
    expect(rows <= most_rows, "sequences", f"at most {most_rows} rows, which the journal can hold", rows)


def check_description(field: str, material: str, constituents: Any) -> None:
    """Raise Unexpected for what `describe` would not keep; None removes a description."""
    if constituents is None:
        return
    try:
        kept = checked(material, constituents)
    except DescriptionError as error:
        raise Unexpected(f"{field}: {error}") from None
    same = all(
        type(value) is type(kept[name]) and (not isinstance(value, list) or repr(value) == repr(kept[name]))
        for name, value in constituents.items()
    )
    expect(same, field, "shares as floats", constituents)


def check_correction(field: str, text: Any, sensor: Sensor) -> None:
    """Raise Unexpected for what is no correction of readings of this sensor."""
    try:
        Correction.from_text(text, sensor)
    except InputError as error:
        raise Unexpected(f"{field}: {error}") from None


def check_annotation(field: str, attributes: Mapping[str, Any]) -> None:
    """Raise Unexpected for values or labels of a touch that `observe` would not keep; field: where they lie."""
    for what, most in ((VALUES, MOST_QUANTITIES), (LABELS, MOST_AXES)):
        if what in attributes:
            stored = attributes[what]
            expect(isinstance(stored, dict) and 0 < len(stored) <= most, field + what, f"1 to {most} by name", stored)
            for named, value in stored.items():
                name(field + what, named)
                whole(field + what, value, 0, MOST_STEPS) if what == VALUES else name(field + what, value)


def check_quantity(field: str, named: str, attributes: Mapping[str, Any]) -> Quantity:
    """The quantity of a name; Unexpected for what could not be declared."""
    fields: dict[str, Any] = {own: attributes.get(own) for own in ("unit", "low", "high", "resolution")}
    numbers = all(type(fields[own]) is float for own in ("low", "high", "resolution"))
    expect(numbers and isinstance(fields["unit"], str), field, "a unit, a range and a resolution", fields)
    try:
        quantity = Quantity(name=name(field, named), **fields)
    except InputError as error:
        raise Unexpected(f"{field}: {error}") from None
    expect(repr(declaration(quantity)) == repr(fields), field, "what `declare` keeps", fields)
    return quantity


def _unpacked(packed: Arrays, size: int, sensor: Sensor) -> npt.NDArray[np.float32]:
    """The readings of a row, whose arrays are looked at before anything is made of them."""
    count = size // (ITEM * sensor.channels)
    shape = (count, *sensor.shape)
    powers = [field for field in packed if field not in (PACKED_SHAPE, PACKED_ZERO, PACKED_REST)]
    one_way = len(packed) == 1 if powers else set(packed) == {PACKED_SHAPE, PACKED_ZERO, PACKED_REST}
    expect(one_way, "readings", "one way of packing", sorted(packed))
    if powers:
        power = int(powers[0].removeprefix(PACKED_WHOLE))
        whole(powers[0], power, SMALLEST_EXPONENT, LARGEST_EXPONENT)
        array(packed, powers[0], ("uint8", "int8", "int16"), (*shape[1:], count))
    else:
        kept = array(packed, PACKED_SHAPE, ("int64",), (len(shape),))
        expect(kept.tolist() == list(shape), PACKED_SHAPE, f"{shape}", kept.tolist())
        values = size // ITEM
        zero = array(packed, PACKED_ZERO, ("uint8",), (-(-values // 8),))
        array(packed, PACKED_REST, ("float32",), (values - int(np.count_nonzero(np.unpackbits(zero, count=values))),))
    with np.errstate(over="ignore"):
        readings = unpack_readings(packed)
    assert readings is not None
    return readings


def check_readings(field: str, readings: npt.NDArray[np.float32], sensor: Sensor) -> None:
    """Raise Unexpected for readings that are not finite, or out of the sensor's range."""
    low, high = sensor.limits
    if not low.ndim and not high.ndim:
        inside = bool(readings.min() >= low and readings.max() <= high)
    else:
        inside = bool(((readings >= low) & (readings <= high)).all())
    expect(inside, field, f"values within the range of {sensor.name!r}", "others, or values that are not finite")
